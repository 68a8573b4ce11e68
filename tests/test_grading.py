"""What `ncs check` finds: nothing in a sound scene, and in each that is not the field or the file that has it."""

from __future__ import annotations

import numpy as np
import pytest

from ncs_jax.assembly import assemble
from ncs_jax.cli import main
from ncs_jax.grading import findings
from ncs_jax.scene import load_scene

from .scenes import SCENE, grid, swing, write_scene


def found(folder, text=SCENE, motion=None, cloth=None):
    path = write_scene(folder, text)
    if motion is not None:
        np.savez(folder / "swing.npz", **motion)
    if cloth is not None:
        np.savez(folder / "cloth.npz", **cloth)
    return findings(assemble(load_scene(path)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ncs:tshirt", "ncs:skirt"])
def test_the_packaged_scenes_are_safe(name, plain_jax, capsys):
    assert main(["check", name]) == 0
    assert "safe" in capsys.readouterr().out


def test_a_sound_scene_is_safe(tmp_path, plain_jax):
    assert found(tmp_path) == []


PHYSICS = {
    "density": "density = 20.0",
    "gravity": "gravity = [0.0, -990.0, 0.0]",
    "stiffness": "bending = { stiffness = 1.0 }",
}


@pytest.mark.parametrize("what", PHYSICS)
def test_material_out_of_range(tmp_path, plain_jax, what):
    (finding,) = found(tmp_path, SCENE.replace("[network]", f"[physics]\n{PHYSICS[what]}\n[network]"))
    assert finding.what == what and "safe" in finding.value and "physics" in finding.mend


def test_frame_rate_out_of_range(tmp_path, plain_jax):
    two = found(tmp_path, SCENE.replace("fps = 30", "fps = 1000"))
    assert [finding.what for finding in two] == ["time step", "time step of a recurrence"] and "1/1000" in two[0].value
    (finding,) = found(tmp_path, SCENE.replace("fps = 30", "fps = 120"))
    assert finding.what == "time step of a recurrence" and "swing" in finding.mend


def test_mesh_with_flaws(tmp_path, plain_jax):
    vertices, faces = grid()
    vertices[7] = vertices[6] + [1e-6, 0, 0]
    vertices[20] = vertices[21]
    whats = {f.what: f for f in found(tmp_path, cloth={"vertices": vertices, "faces": faces})}
    assert whats["vertices at one place"].value == "1" and whats["triangles of no area"].value == "2"
    # twice the area, 1e-6 m times 0.05 m, over the square of the diagonal, 0.005 m^2
    assert whats["height of a triangle"].value.startswith("1.0e-05 of its longest edge, 2 such")


def test_motion_with_a_leap_and_a_flip(tmp_path, plain_jax):
    motion = swing()
    motion["trans"][12:, 0] += 2.0
    motion["poses"][15, -1, 0] += 3.0
    whats = {f.what: f for f in found(tmp_path, motion=motion)}
    assert "frame 12" in whats["leap within a frame"].value and "2.0" in whats["leap within a frame"].value
    assert "frame 1" in whats["turn within a frame"].value and "joint 1" in whats["turn within a frame"].value


def test_garment_inside_the_body(tmp_path, plain_jax):
    vertices, faces = grid(origin=(0.0, 0.3, 0.05))
    whats = {f.what for f in found(tmp_path, cloth={"vertices": vertices, "faces": faces})}
    assert "garment inside the body at rest" in whats

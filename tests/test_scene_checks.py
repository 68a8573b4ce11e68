"""What `ncs check` finds: nothing in a sound scene, and in each that is not the field or the file that has it."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.cli import main
from ncs_jax.io import MotionRecord
from ncs_jax.prepare import scene_checks
from ncs_jax.prepare.scene_checks import RANGES, find_risks
from ncs_jax.prepare.setting import set_up
from ncs_jax.prepare.speed_checks import FLUNG, flung, frames_named, good_stretches, thrown
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import load_scene

from .scenes import SCENE, grid, swing, write_scene

UP = np.array([0.0, 1.0, 0.0])
RESULTS = Path(__file__).parents[1] / "experiments" / "results"
SOUND = SCENE.replace("[network]", '[network]\nmethod = "pbns"')


def found(folder, text=SOUND, motion=None, cloth=None):
    path = write_scene(folder, text)
    if motion is not None:
        np.savez(folder / "swing.npz", **motion)
    if cloth is not None:
        np.savez(folder / "cloth.npz", **cloth)
    return find_risks(assemble(load_scene(path)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ncs:tshirt", "ncs:skirt", "ncs:dress"])
def test_the_packaged_scenes_are_safe(name, plain_jax, capsys, tmp_path):
    assert main(["check", name, "--out", str(tmp_path / "check.png")]) == 0
    assert "safe" in capsys.readouterr().out


def test_a_sound_scene_is_safe(tmp_path, plain_jax):
    assert found(tmp_path) == []


def test_a_garment_beside_the_body_is_told(tmp_path, plain_jax):
    """It touches nothing, and so there is nothing else to check of its contact."""
    shirt = io.read_garment("ncs:tshirt")
    io.write_garment(tmp_path / "g.npz", replace(shirt, vertices=shirt.vertices + np.float32([0.9, 0, 0])))
    (tmp_path / "s.toml").write_text('[garment]\nfile = "g.npz"\n[motion]\nfiles = ["ncs:stand"]\n')
    told = {risk.what: risk for risk in find_risks(set_up(load_scene(tmp_path / "s.toml")))}
    assert "none of its 4 has the body in it" in told["openings of the garment"].value


PHYSICS = {
    "density": "density = 20.0",
    "gravity": "gravity = [0.0, -990.0, 0.0]",
    "stiffness": "bending = { stiffness = 1.0 }",
}


@pytest.mark.parametrize("what", PHYSICS)
def test_material_out_of_range(tmp_path, plain_jax, what):
    (risk,) = found(tmp_path, SOUND.replace("[network]", f"[physics]\n{PHYSICS[what]}\n[network]"))
    assert risk.what == what and "safe" in risk.value and "physics" in risk.mend


def test_a_membrane_with_warp_and_weft_needs_a_map(tmp_path, plain_jax):
    woven = SOUND.replace("[network]", '[physics.membrane]\nmodel = "baraff_witkin"\n[network]')
    (risk,) = found(tmp_path, woven)
    assert risk.what == "warp and weft" and "UV" in risk.mend
    vertices, faces = grid()
    assert found(tmp_path, woven, cloth={"vertices": vertices, "faces": faces, "uv": vertices[:, :2]}) == []


def test_frame_rate_out_of_range(tmp_path, plain_jax):
    two = found(tmp_path, SCENE.replace("fps = 30", "fps = 1000"))
    assert [risk.what for risk in two] == ["time step", "time step of a recurrence"] and "1/1000" in two[0].value
    (risk,) = found(tmp_path, SCENE)
    assert risk.what == "time step of a recurrence" and "swing" in risk.mend


def test_mesh_with_flaws(tmp_path, plain_jax):
    vertices, faces = grid()
    vertices[7] = vertices[6] + [1e-6, 0, 0]
    vertices[20] = vertices[21]
    whats = {f.what: f for f in found(tmp_path, cloth={"vertices": vertices, "faces": faces})}
    assert whats["vertices at one place"].value == "1" and whats["triangles of no area"].value == "2"
    # twice the area, 1e-6 m times 0.05 m, over the square of the diagonal, 0.005 m^2
    assert whats["height of a triangle"].value.startswith("1.0e-05 of its longest edge, 2 such")


def test_motion_with_a_jump_and_a_flip(tmp_path, plain_jax):
    motion = swing()
    motion["trans"][12:, 0] += 2.0
    motion["poses"][15, -1, 0] += 3.0
    whats = {f.what: f for f in found(tmp_path, motion=motion)}
    assert "frame 12" in whats["jump within a frame"].value and "2.0" in whats["jump within a frame"].value
    assert "frame 1" in whats["turn within a frame"].value and "joint 1" in whats["turn within a frame"].value


def test_a_limb_that_nothing_drives_is_said_first(tmp_path, plain_jax):
    assembly = assemble(load_scene(write_scene(tmp_path, SCENE)))
    (name, record), mend = *assembly.motions.items(), 'motion.joints = { "x" = "LeftArm" }'
    lame = replace(assembly, motions={name: replace(record, undriven={"left upper arm": mend})})
    first, *rest = find_risks(lame)
    assert (first.what, first.value, first.mend) == (name, "left upper arm is driven by nothing", mend)
    assert [risk.what for risk in rest] == ["time step of a recurrence"]


def test_garment_inside_the_body(tmp_path, plain_jax):
    vertices, faces = grid(origin=(0.0, 0.3, 0.05))
    whats = {f.what for f in found(tmp_path, cloth={"vertices": vertices, "faces": faces})}
    assert "garment inside the body at rest" in whats


# A range, the axis of the stability map that it is of, in so many of its units, and whose cells are not of it: a gated unit is
# at risk by its time step, on every axis.
AXES = {
    "time step": ("time step, s", 1.0, ["training, gated"]),
    "density": ("density, kg/m^2", 1.0, ["training, gated"]),
    "stiffness": ("stiffness, times the default", 1.0, ["training, gated"]),
    "gravity": ("gravity, g", 9.81, ["training, gated"]),
    "size": ("size, times the default", 1.0, ["training, gated"]),
    "distance from the start": ("from the origin, m", 1.0, ["training, gated"]),
    "time step of a recurrence": ("time step, s", 1.0, []),
}


@pytest.mark.parametrize("quantity", AXES)
def test_the_ranges_are_safe_or_refused_in_the_stability_map(quantity):
    axis, unit, others = AXES[quantity]
    low, high = RANGES[quantity]
    rows = []
    for part in ("energies", "networks", "simulator", "training"):
        with (RESULTS / f"stability_{part}.csv").open() as file:
            rows += [row for row in csv.DictReader(file) if row["axis"] == axis and row["subject"] not in others]
    inside = [row for row in rows if low * (1 - 1e-6) <= unit * float(row["value"]) <= high * (1 + 1e-6)]
    assert {float(row["value"]) * unit for row in inside} & {low, high}, "the map has an end of the range"
    assert [row for row in inside if row["state"] not in ("safe", "refused")] == []


def test_a_glitch_is_named_by_its_frames_and_a_turn_that_is_none_is_not(tmp_path, plain_jax):
    """The root half a metre aside for one frame, twice; and a path at an even pace, which no frame breaks."""
    motion = swing()
    motion["trans"] = np.zeros_like(motion["trans"])
    motion["trans"][[7, 20], 0] = 0.5
    whats = {f.what: f for f in found(tmp_path, motion=motion)}
    assert "1.00 m" in whats["jump within a frame"].value and "frame 7, also 20" in whats["jump within a frame"].value
    motion["trans"] = 0.2 * np.arange(len(motion["trans"]))[:, None] * [1.0, 0, 0]
    assert not any(f.what.startswith("jump") for f in found(tmp_path, motion=motion))


def test_frames_are_named_once_a_stretch_the_worst_first():
    size = np.zeros(60)
    size[[0, 1, 2, 9, 20, 21]] = 1, 1, 1, 2, 2, 3
    assert frames_named(size, 0.5) == "frame 20, also 0, 9" and frames_named(size, 2.5) == "frame 21"
    size[30::5] = 1
    assert frames_named(size, 0.5) == "frame 20, also 0, 9, 30, 35, 40 and 3 more"


def test_good_stretches_are_those_of_the_file(tmp_path, plain_jax):
    """As a scene names them: in the file's frames, of which every fourth is used here, without what is below a second."""
    bad = np.zeros(240, bool)
    bad[[78, 79, 100]] = True
    still = np.zeros((240, 1, 3)), np.zeros((240, 3)), 30.0
    assert good_stretches("a.bvh[8:]", MotionRecord(*still, origin=(8, 4.0)), bad) == ["a.bvh[8:317]", "a.bvh[412:965]"]
    assert good_stretches("a.bvh", MotionRecord(*still, origin=(-240, 1.0)), bad) == ["a.bvh[-240:-162]", "a.bvh[-139:]"]
    motion = {"poses": np.zeros((400, 2, 3)), "trans": np.zeros((400, 3)), "fps": np.array(60.0)}
    motion["trans"][160:, 0] = 0.5
    path = write_scene(tmp_path, SOUND.replace("swing.npz", "swing.npz[40:]"))
    np.savez(tmp_path / "swing.npz", **motion)
    risks = find_risks(assemble(load_scene(path)))
    (mend,) = (risk.mend for risk in risks if risk.what == "jump within a frame")
    for stretch in mend.split("of it: ")[1].split(", "):
        path.write_text(path.read_text().replace(re.search(r"swing\.npz\[[^\]]*\]", path.read_text())[0], stretch))
        assert not any(risk.what == "jump within a frame" for risk in find_risks(assemble(load_scene(path))))


@pytest.mark.parametrize("fps", [30, 120])
def test_a_garment_is_thrown_as_its_pendulum_is(fps):
    """Against x'' + (g / L) (x - a) = 0 for a hold that goes from 0 to V at once: A = V sqrt(L / g), at any frame rate."""
    length, pace = 0.5, 2.0
    t = np.arange(fps) / fps
    path = np.zeros((len(t), 3, 3))
    path[:, :, 0] = np.maximum(t - 0.2, 0)[:, None] * pace
    expected = pace * np.sqrt(length / 9.81) / length
    far = thrown(path, np.ones(3), float(fps), np.array([0.0, -9.81, 0.0]), length, 0.0)
    assert abs(far.max() / expected - 1) < 6 / fps and not far[: fps // 6].any()
    upward = np.roll(path, 1, axis=2)
    assert not thrown(upward, np.ones(3), float(fps), np.array([0.0, -9.81, 0.0]), length, 0.0).any()
    still = flung(path, np.ones(3), float(fps), np.array([0.0, -9.81, 0.0]), length, 0.0)
    np.testing.assert_allclose(still, far, atol=1e-9)


def turned_hem(angle, axis):
    """A ring of 0.2 m radius, and one 0.5 m below it, turned about an axis through the upper one's middle."""
    around = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = 0.2 * np.stack([np.cos(around), 0 * around, np.sin(around)], axis=1)
    return np.einsum("tab,pb->tpa", Rotation.from_rotvec(angle[:, None] * np.eye(3)[axis]).as_matrix(), [*ring, *ring - UP / 2])


def test_a_spin_flings_as_a_conical_pendulum_flies():
    """r omega^2 / g, when the start has died down; at rest in the world, the same pendulum sees little of it."""
    gravity, fps, turns = -9.81 * UP, 240, 3.0
    path = turned_hem(2 * np.pi * turns * np.arange(8 * fps) / fps, 1)
    far = flung(path, np.ones(24), float(fps), gravity, 0.5, 2.0)
    assert abs(far[-1] / (0.2 * (2 * np.pi * turns) ** 2 / 9.81) - 1) < 0.01
    assert thrown(path, np.ones(24), float(fps), gravity, 0.5, 2.0)[-1] < 0.6


def test_a_flip_flings_and_a_slow_roll_does_not():
    gravity, time = -9.81 * UP, np.arange(120) / 30
    far = [
        flung(turned_hem(2 * np.pi * np.clip((time - 1) / length, 0, 1), 0), np.ones(24), 30.0, gravity, 0.5, 1.0).max()
        for length in (0.4, 3.0)
    ]
    assert far[0] > FLUNG and far[1] < 1


def test_a_spin_puts_a_swing_at_risk(tmp_path, plain_jax):
    text = SCENE.replace('cell = "gated"', 'cell = "swing"')
    for turns, told in ((5.0, True), (0.3, False)):
        motion = swing(frames=90)
        motion["poses"], motion["trans"] = 0 * motion["poses"], 0 * motion["trans"]
        motion["poses"][:, 0, 1] = (2 * np.pi * turns * np.arange(90) / 30 + np.pi) % (2 * np.pi) - np.pi
        values = [risk.value for risk in found(tmp_path, text, motion) if risk.what == "fast motion"]
        assert bool(values) == told and all("flung off the turning body" in value for value in values)


def test_what_was_found_is_kept_for_the_same_scene(tmp_path, plain_jax, monkeypatch):
    looked = []
    looked_for = scene_checks._looked_for
    monkeypatch.setattr(scene_checks, "_looked_for", lambda *a: looked.append(a) or looked_for(*a))
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "kept"))
    try:
        heavy = SOUND.replace("[network]", "[physics]\ndensity = 20.0\n[network]")
        first = found(tmp_path, heavy)
        assert first and found(tmp_path, heavy) == first and len(looked) == 1
        assert found(tmp_path) == [] and len(looked) == 2
        faster = swing()
        faster["poses"] *= 1.01
        found(tmp_path, heavy, motion=faster)
        assert len(looked) == 3
    finally:
        jax.config.update("jax_compilation_cache_dir", before)

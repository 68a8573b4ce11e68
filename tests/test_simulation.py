"""`ncs simulate`: what it writes, and that stopping it loses nothing."""

import re

import numpy as np
import pytest

from ncs_jax import InputError, io, simulate
from ncs_jax.cli import main
from ncs_jax.runs import simulate as simulation
from ncs_jax.scene.spec import load_scene
from ncs_jax.simulation.solver.minimise import CONVERGED

from .scenes import SCENE, swing, write_scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("plain_jax")]

SMOOTH = SCENE.replace("smoothing = 2", 'smoothing = 2\npins = "pins"') + '[physics.collision]\ndistance = "smooth"\n'


class StopHere(Exception):
    pass


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"), SMOOTH)


@pytest.fixture(scope="module")
def unbroken(scene):
    import jax

    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return simulate(scene)


def test_every_frame_is_in_balance(unbroken):
    assert unbroken.vertices.shape == (24, 30, 3)
    assert unbroken.fps == 30
    assert unbroken.vertices.dtype == np.float32  # enough for such cloth
    assert np.all(unbroken.status == CONVERGED)
    assert np.all(unbroken.residual <= 0.1)
    assert unbroken.iterations.max() > 1
    assert unbroken.seconds.shape == (24,)
    assert unbroken.seconds.argmax() == 0  # it compiles
    assert unbroken.seconds.min() > 0


def test_stopped_and_continued_is_the_same_bit_for_bit(scene, unbroken, tmp_path, monkeypatch):
    monkeypatch.setattr(simulation, "SAVE_EVERY", 0.0)
    partial = tmp_path / "sim.partial.npz"
    seen = []

    def stop(progress):
        seen.append(progress.frame)
        if progress.frame == 10:
            raise StopHere

    with pytest.raises(StopHere):
        simulate(scene, partial=partial, report=stop)
    again = simulate(scene, partial=partial, report=lambda p: seen.append(p.frame))
    assert seen == [*range(11), 9, *range(10, 25)]  # and as each begins; the tenth was not saved yet
    for name in ("vertices", "iterations", "residual", "status"):
        np.testing.assert_array_equal(getattr(again, name), getattr(unbroken, name))


def test_a_partial_file_of_another_simulation_is_refused(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(simulation, "SAVE_EVERY", 0.0)
    partial = tmp_path / "sim.partial.npz"

    def stop(progress):
        if progress.frame == 3:
            raise StopHere

    with pytest.raises(StopHere):
        simulate(scene, partial=partial, report=stop)
    other = write_scene(tmp_path, SMOOTH + "stiffness = 20\n")
    before = partial.read_bytes()
    with pytest.raises(InputError, match="another simulation"):
        simulate(other, partial=partial)
    assert partial.read_bytes() == before


def test_cloth_that_is_stiff_for_its_weight_is_balanced_in_double_precision(tmp_path):
    stiff = SMOOTH + "[physics]\ndensity = 0.01\n[physics.membrane]\nlam = 418.0\nmu = 222.0\n"
    single, chosen = (
        simulate(write_scene(tmp_path, f'{stiff}[simulation]\nprecision = "{name}"\n')) for name in ("single", "auto")
    )
    assert single.vertices.dtype == np.float32 and np.any(single.status != CONVERGED) and single.residual.max() > 0.1
    assert chosen.vertices.dtype == np.float64 and np.all(chosen.status == CONVERGED) and chosen.residual.max() <= 0.1
    expected = simulation.rounding(single.assembly.model)
    assert 0.5 * single.residual.min() < expected < 5 * single.residual.max()


def test_substeps_keep_the_frames(scene, unbroken, tmp_path):
    fine = simulate(write_scene(tmp_path, SMOOTH + "[simulation]\nsubsteps = 2\n"))
    assert fine.vertices.shape == unbroken.vertices.shape
    np.testing.assert_allclose(fine.vertices[0], unbroken.vertices[0], atol=5e-3)  # one static state: 0.1 g leave millimetres
    apart = np.linalg.norm(fine.vertices - unbroken.vertices, axis=-1).max()
    assert 1e-4 < apart < 0.1  # half the time step: less damping, the same motion


def test_a_motion_beside_the_scenes_is_simulated_whole(tmp_path):
    scene = write_scene(tmp_path, SMOOTH.replace("fps = 30", "fps = 30\nframes = [0, 4]").replace('"smooth"', '"plane"'))
    np.savez(tmp_path / "clip.npz", **swing(frames=6))
    assert [len(simulate(scene, name and str(tmp_path / name)).vertices) for name in (None, "clip.npz")] == [4, 6]


def test_the_command_writes_an_animation_that_evaluates(scene, unbroken, tmp_path, capsys):
    out = tmp_path / "sim.npz"
    assert main(["simulate", str(scene), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "24 frames at 30 per second" in said
    assert re.search(r"residual at most \S+ g, median \S+ s", said)
    np.testing.assert_array_equal(io.read_animation(out).vertices, unbroken.vertices)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sim.npz"]
    motion = str(scene.parent / "swing.npz")
    assert main(["evaluate", str(out), "--scene", str(scene), "--motion", motion]) == 0
    assert "out_of_balance" in capsys.readouterr().out


def test_frames_off_tolerance_are_told(tmp_path, capsys):
    scene = write_scene(tmp_path, SMOOTH + "[simulation]\niterations = 1\ntolerance = 1e-3\n")
    assert main(["simulate", str(scene), "--out", str(tmp_path / "sim.npz")]) == 0
    assert "not at tolerance: out of iterations" in capsys.readouterr().out


def test_broken_input_is_one_line(tmp_path, capsys):
    assert main(["simulate", str(tmp_path / "none.toml"), "--out", str(tmp_path / "sim.npz")]) == 2
    scene = write_scene(tmp_path, SMOOTH + "[simulation]\nsubsteps = 0\n")
    assert main(["simulate", str(scene), "--out", str(tmp_path / "sim.npz")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "simulation.substeps" in lines[1]


def test_a_motion_may_be_named_and_who_waits_is_told_why(scene, unbroken, monkeypatch):
    told, reports = [], []
    monkeypatch.setattr(simulation, "tell_a_person", told.append)
    again = simulate(load_scene(scene), str(scene.parent / "swing.npz"))
    np.testing.assert_array_equal(again.vertices, unbroken.vertices)
    assert len(told) == 1 and told[0].startswith("compiling") and "of 24" in told[0]
    simulate(load_scene(scene), str(scene.parent / "swing.npz"), report=reports.append)
    assert len(told) == 1 and [p.compiling for p in reports] == [True] + 24 * [False]

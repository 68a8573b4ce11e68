"""The dial between a network and its simulation: none is the network, more is nearer, streamed or whole."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.cli import main
from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import measure
from ncs_jax.runs.refine import refined_stepper, with_smooth_contact
from ncs_jax.runs.run import load_run
from ncs_jax.runs.simulate import simulate
from ncs_jax.runs.train import train
from ncs_jax.scene.model import local_rotations

from .scenes import SCENE, swing, write_scene

HUNG = SCENE.replace("smoothing = 2", 'smoothing = 2\npins = "pins"')


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a run of ten steps, far from rest, and its clip of 12 frames."""
    folder = tmp_path_factory.mktemp("refined")
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        train(write_scene(folder, HUNG), folder / "run", steps=10)
    np.savez(folder / "clip.npz", **swing(frames=12))
    return folder


def energies(run, clip, x):
    """What the solver minimises: with smooth contact."""
    model = with_smooth_contact(run.assembly, run.track(clip))
    return measure(model, x, run.track(clip), exact=False)


def test_more_is_nearer_to_the_simulation(trained):
    """In energy, in balance and in place, though the network of ten steps knows next to nothing."""
    run, clip = load_run(trained / "run"), str(trained / "clip.npz")
    scene = run.assembly.scene
    smooth = replace(scene.physics, collision=replace(scene.physics.collision, distance="smooth"))
    truth = simulate(replace(scene, physics=smooth), clip).vertices
    found = {n: run.animate(clip, refine=n) for n in (0, 1, 4, 16, 200)}
    assert np.array_equal(found[0], run.animate(clip))
    rows = {n: energies(run, clip, x) for n, x in found.items()}
    total = [float(rows[n]["total"].mean()) for n in found]
    away = [float(np.linalg.norm(x - truth, axis=-1).mean()) for x in found.values()]
    assert np.all(np.diff(away) < 0) and away[4] < 0.05 * away[0], away
    assert np.all(np.diff(total[:3]) < 0) and abs(total[4] / energies(run, clip, truth)["total"].mean() - 1) < 0.01, total
    assert rows[200]["out_of_balance"].max() < 0.11 < rows[0]["out_of_balance"].min()
    assert not np.shares_memory(found[0], found[1])


def test_streamed_it_is_the_whole_motion(trained):
    run, clip = load_run(trained / "run"), str(trained / "clip.npz")
    record, whole = run.motion(clip), run.animate(clip, 1.5, refine=3)
    stream = refined_stepper(run.assembly, run.params, 3)
    step, state = jax.jit(stream.step), stream.init()
    turns = local_rotations(run.assembly.model, jnp.asarray(record.poses))
    for t in range(len(record.poses)):
        state, x = step(state, turns[t], jnp.asarray(record.translation[t]), 1.5)
        np.testing.assert_allclose(x, whole[t], atol=1e-4)


def test_what_cannot_be_refined_is_refused(trained):
    with pytest.raises(InputError, match="refine"):
        load_run(trained / "run").animate(str(trained / "clip.npz"), refine=-1)


def test_by_command_with_a_line_for_each_stage(trained, tmp_path, capsys):
    run, clip, out = load_run(trained / "run"), str(trained / "clip.npz"), str(tmp_path / "a.npz")
    assert main(["animate", str(trained / "run"), "--motion", clip, "--refine", "2", "--out", out]) == 0
    assert "refining frame 12/12" in capsys.readouterr().out
    np.testing.assert_allclose(io.read_animation(out).vertices, run.animate(clip, refine=2, outside=True), atol=1e-6)

"""What sets the methods apart, and what they share."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax import load_run, train
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import total
from ncs_jax.network.compression import compress
from ncs_jax.network.methods.method import Method
from ncs_jax.network.methods.ncs import NCS
from ncs_jax.network.methods.pbns import PBNS
from ncs_jax.network.methods.snug import SNUG
from ncs_jax.network.methods.swing import Swing
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import features_from_records
from ncs_jax.scene.model import local_rotations
from ncs_jax.scene.spec import load_scene, scene_from

from .ready import edited, lowered, prepared, ready, run, scopes
from .scenes import write_scene

codes_of = jax.jit(lambda network, *inputs: network.codes(*inputs), static_argnums=0)
windows_to = jax.jit(lambda network, *inputs: network.windows(*inputs), static_argnums=(0, 4, 5))

METHODS = {"ncs": NCS, "pbns": PBNS, "snug": SNUG, "swing": Swing}


@pytest.mark.parametrize("method", METHODS)
def test_a_stream_and_a_smaller_decoder_give_what_the_sequence_gives(method):
    assembly, params, motion = ready(method=method)
    network = assembly.network
    assert isinstance(network, METHODS[method]) and isinstance(network, Method)
    track = features_from_records(assembly.model, motion)
    whole, alike = compress(network, params, assembly.model, track, rank=16)
    expected = run(assembly, params, motion)
    for net, p, tolerance in ((network, params, 1e-12), (whole, alike, 1e-9)):
        init, step = stepper(assembly.model, net, p)
        step, state = jax.jit(step), init()
        local = local_rotations(assembly.model, jnp.asarray(motion.poses, jnp.float64))
        for frame, (rotations, place) in enumerate(zip(local, jnp.asarray(motion.translation, jnp.float64), strict=True)):
            state, x = step(state, rotations, place)
            np.testing.assert_allclose(x, expected[frame], rtol=0, atol=tolerance)


@pytest.mark.parametrize("method", ["ncs", "pbns", "snug"])  # a swing is of the whole motion
def test_a_window_that_reaches_back_to_the_start_is_the_motion(method):
    assembly, params, motion = ready(method=method)
    track, ends = features_from_records(assembly.model, motion), jnp.array([5, 9], jnp.int32)
    whole = codes_of(assembly.network, params, assembly.model, track)
    for count in (1, 8):  # few windows, and more frames in them than the motion has
        found = windows_to(assembly.network, params, track, jnp.tile(ends, count), 10, 3)
        for of_all, of_windows in zip(whole, found, strict=True):
            assert (of_all is None) == (of_windows is None)
            if of_all is not None:
                np.testing.assert_allclose(of_windows[:, 1], of_all[7:10], rtol=0, atol=1e-13)
    # one that would begin before the motion holds its first frame still: no motion yet
    if method != "snug":  # whose state is not at rest there
        found = windows_to(assembly.network, params, track, ends, 10, 3)[0][:, 0]
        np.testing.assert_allclose(found, whole[0][3:6], atol=1e-13)


def test_a_linear_cell_learns_from_all_the_motion_before_where_windows_overlap():
    """Of two motions end to end, the second from rest again; of many frames and few windows, from the windows alone."""
    assembly, params, motion = ready(cell="linear")
    network = assembly.network
    once = codes_of(network, params, assembly.model, features_from_records(assembly.model, motion)).dynamic
    track, frames = features_from_records(assembly.model, motion, motion), len(once)
    ends = jnp.arange(2 * frames, dtype=jnp.int32)
    found = windows_to(network, params, track, ends, 4, 3).dynamic
    for begin in (0, frames):
        for back in range(3):
            after = found[2 - back, begin + back : begin + frames]
            np.testing.assert_allclose(after, once[: frames - back], rtol=0, atol=1e-13)
            assert not found[2 - back, begin : begin + back].any()  # before it began
    few = windows_to(network, params, track, ends[frames - 1 : frames], 4, 1).dynamic
    assert np.abs(few[0, 0] - once[-1]).max() > 1e-6


def test_a_pose_alone_decides_with_pbns_and_not_with_the_others():
    for method in METHODS:
        assembly, params, motion = ready(method=method)
        backwards = edited(motion, motion.poses[::-1], motion.translation[::-1])
        apart = np.abs(run(assembly, params, motion) - run(assembly, params, backwards)[::-1]).max()
        assert apart < 1e-12 if method == "pbns" else apart > 1e-4


def test_alpha_is_for_ncs_alone():
    for method in METHODS:
        assembly, params, motion = ready(method=method)
        apart = np.abs(run(assembly, params, motion, 2.0) - run(assembly, params, motion, 1.0)).max()
        assert (apart > 1e-4) == assembly.network.controlled == (method in ("ncs", "swing"))


@pytest.mark.parametrize("method", METHODS)
def test_only_a_swing_tells_the_motions_anything(method):
    assembly, params, motion = ready(method=method)
    features = features_from_records(assembly.model, motion)
    told = jax.eval_shape(lambda f: jax.tree.leaves(assembly.network.refresh(params, assembly.model, f)), features)
    more = [leaf.shape for leaf in told[len(jax.tree.leaves(features)) :]]
    assert bool(more) == assembly.network.refreshes == (method == "swing")
    assert not more or more == [(len(motion.poses), assembly.network.modes)]


def test_snug_sees_the_roots_motion():
    assembly, params, motion = ready(method="snug")
    t = np.arange(len(motion.poses))
    faster = edited(motion, motion.poses, motion.translation + 0.01 * t[:, None] ** 2 * [[1.0, 0, 0]])
    apart = run(assembly, params, faster) - run(assembly, params, motion)
    assert np.ptp(apart - faster.translation[:, None] + motion.translation[:, None], axis=1).max() > 1e-5


@pytest.mark.parametrize("method", METHODS)
def test_where_inertia_has_a_gradient(method, rng):
    """By x_{t-1} and x_{t-2} exactly none with NCS, the whole of it with SNUG; PBNS and a swing are trained without."""
    assembly, _, _ = ready(method=method)
    model = assembly.model
    terms = assembly.network.loss(Terms(None, bending=False, collision=None))
    x = model.garment.mesh.rest[None] + jnp.asarray(rng.normal(0, 0.01, (3, *model.garment.mesh.rest.shape)))

    def energy(x):
        return total(x[0], model.garment, model.material, StepInputs(1 / model.fps, x[1], x[2]), terms)

    slope = jax.grad(energy)(x)
    away = np.asarray((x[0] - 2 * x[1] + x[2]) * model.fps**2)
    mass = np.asarray(model.material.density * model.garment.mesh.vertex_area)[:, None]
    share = {"ncs": (1, 0, 0), "pbns": (0, 0, 0), "swing": (0, 0, 0), "snug": (1, -2, 1)}[method]
    weight = mass * np.asarray(model.material.gravity)
    for k in range(3):
        np.testing.assert_allclose(slope[k], share[k] * mass * away - (weight if k == 0 else 0), rtol=1e-9, atol=1e-12)


def test_pbns_traces_no_inertia(plain_jax):
    assembly, spec, ends, pairs = prepared({"network.method": "pbns"})
    text = lowered(assembly, spec, ends, pairs)
    assert "inertia" not in scopes(text) and not re.search("DynamicEncoder", text)
    assert assembly.model.terms.inertia  # by which it is still judged


@pytest.mark.parametrize("method", ["pbns", "snug"])
def test_training_and_coming_back(tmp_path, plain_jax, method):
    tables = load_scene(write_scene(tmp_path)).to_dict()
    tables["network"]["method"] = method
    tables["physics"]["collision"]["search"], tables["motion"]["validation"] = "candidates", []  # what compiles fastest
    reports = []
    made = train(scene_from(tables, source=str(tmp_path / "scene.toml")), tmp_path / "run", steps=40, report=reports.append)
    assert sum(reports[-1].energies.values()) < sum(reports[0].energies.values())
    assert reports[-1].moved is None and not any(r.message for r in reports)
    again = load_run(tmp_path / "run")
    assert isinstance(again.assembly.network, METHODS[method])
    motion = made.assembly.scene.motion.files[0]
    np.testing.assert_array_equal(again.animate(motion), made.animate(motion))

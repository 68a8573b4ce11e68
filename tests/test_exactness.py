"""What holds exactly of the whole network and no weights can break: the world's symmetries, cause before effect, alpha.

The descriptors' and the networks' own parts of this are in their tests; rest and streams are in `test_rollout`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.network.methods.method import decode
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import features_from_records
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import local_rotations
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.step import initial_state

from .ready import assembled, edited, run

GRAVITIES = {"-y": (0.0, -9.81, 0.0), "-z": (0.0, 0.0, -9.81), "+x": (1.62, 0.0, 0.0), "aslant": (3.0, -8.0, 2.0)}
BIG_TURN = np.radians(73)


def awake(state, size):
    """Fresh parameters but for the decoder's last layer and every bias, which start at zero or small: `size` of noise there."""

    def shake(path, p):
        name = "/".join(str(k.key) for k in path)
        if "bias" in name or "coefficients" in name or "offsets" in name:
            key = jax.random.fold_in(jax.random.PRNGKey(5), sum(name.encode()))
            return p + size * jax.random.normal(key, p.shape, p.dtype)
        return p

    return jax.tree_util.tree_map_with_path(shake, state.params)


def tiny(dtype=jnp.float64, gravity=GRAVITIES["-y"]):
    """A scene, its weights, and a motion on which nothing is special: every joint turns, the root tilts and wanders."""
    assembly = assembled({"physics.gravity": gravity}, dtype)
    params = awake(initial_state(assembly.model, assembly.network, 4), 0.2)
    t = np.arange(24)[:, None, None] / 30
    wave = np.array([[2.0, 3.1, 2.6], [5.0, 4.0, 3.0]])
    poses = np.array([[0.3, 0.9, -0.5], [0.6, -0.4, 0.8]]) * np.sin(wave * t + [[0.1, 1.0, 2.0], [0.5, 1.5, 0.2]])
    translation = np.array([0.4, 0.1, 0.8]) * np.sin([2.0, 5.0, 3.0] * t[:, 0] + [0.0, 1.0, 2.0])
    return assembly, params, io.MotionRecord(poses, translation, 30.0, ())


def turned(motion, root, axis, angle=BIG_TURN):
    """Character and motion turned about an axis through the origin; the root's rest position is `root`."""
    turn = Rotation.from_rotvec(angle * np.asarray(axis) / np.linalg.norm(axis))
    poses = np.array(motion.poses, np.float64)
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return edited(motion, poses, turn.apply(motion.translation + root) - root), turn.as_matrix()


# --- space ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gravity", GRAVITIES)
def test_turning_about_gravity_turns_the_prediction(gravity):
    assembly, params, motion = tiny(gravity=GRAVITIES[gravity])
    here = run(assembly, params, motion)
    assert np.abs(here - run(assembly, params, motion, 0.0)).max() > 5e-3  # the dynamics have their part in it
    root = assembly.body.joints[0]
    other, turn = turned(motion, root, GRAVITIES[gravity])
    there = run(assembly, params, other)
    assert np.abs(there - here).max() > 0.1
    np.testing.assert_allclose(there, here @ turn.T, rtol=0, atol=1e-10)
    # gravity is a direction: a turn about any other axis is another situation
    other, turn = turned(motion, root, np.cross(GRAVITIES[gravity], [1.0, 5.0, 2.0]))
    assert np.abs(run(assembly, params, other) - here @ turn.T).max() > 1e-3


@pytest.mark.parametrize("gravity", GRAVITIES)
def test_turning_about_gravity_in_single_precision(plain_jax, gravity):
    assembly, params, motion = tiny(jnp.float32, GRAVITIES[gravity])
    other, turn = turned(motion, assembly.body.joints[0], GRAVITIES[gravity])
    here, there = run(assembly, params, motion), run(assembly, params, other)
    assert here.dtype == np.float32
    np.testing.assert_allclose(there, here @ turn.T, rtol=0, atol=1e-5)


def test_turning_a_stream_about_gravity():
    """Frame by frame with explicit state, as a game would."""
    assembly, params, motion = tiny(gravity=GRAVITIES["aslant"])
    other, turn = turned(motion, assembly.body.joints[0], GRAVITIES["aslant"])
    init, step = stepper(assembly.model, assembly.network, params)
    step = jax.jit(step)
    here, there = init(), init()
    for a, b in zip(*(list(zip(m.poses, m.translation, strict=True)) for m in (motion, other)), strict=True):
        x, y = [], []
        for state, (poses, translation), out in ((here, a, x), (there, b, y)):
            local = local_rotations(assembly.model, jnp.asarray(poses))
            out += step(state, local, jnp.asarray(translation))
        here, there = x[0], y[0]
        np.testing.assert_allclose(y[1], np.asarray(x[1]) @ turn.T, rtol=0, atol=1e-10)
    np.testing.assert_allclose(here.code, there.code, rtol=0, atol=1e-11)
    assert np.abs(here.code).max() > 1e-2


def test_turning_the_recorded_walk_in_single_precision(data, tmp_path, plain_jax):
    """The benchmark scene of the method's design (CMU 01_01 at 15 frames a second, a T-shirt of 4424 vertices, 15 joints)."""
    folder = data / "smpl_research_only"
    path = tmp_path / "walk.toml"
    path.write_text(f"""
[body]
file = "{folder / "body.npz"}"
joints = ["0", "1", "2", "3", "4", "5", "6", "9", "12", "13", "14", "16", "17", "18", "19"]
[garment]
file = "{folder / "tshirt.obj"}"
[motion]
files = ["{folder / "01_01.npz"}"]
fps = 15
[network]
modes = 8
[physics.collision]
stiffness = 0
""")  # collision has no part in the prediction, and it and the other 120 modes take half a minute to prepare
    scene = load_scene(path)
    assembly = assemble(scene)
    assert len(assembly.model.inputs) == 15
    params = awake(initial_state(assembly.model, assembly.network, 0), 0.02)
    motion = load_motion(scene, scene.motion.files[0], assembly.body)
    other, turn = turned(motion, assembly.body.joints[0], scene.physics.gravity)
    here, there, static = (run(assembly, params, *a) for a in ((motion,), (other,), (motion, 0.0)))
    zero = jax.tree.map(jnp.zeros_like, params["decoder"])
    skinned = run(assembly, {**params, "decoder": zero}, motion)
    assert here.shape == (121, 4424, 3) and here.dtype == np.float32
    assert 0.005 < np.sqrt(np.mean((here - skinned) ** 2)) < 0.2  # the network moves the shirt, by centimetres
    assert np.abs(here - static).max() > 0.005
    np.testing.assert_allclose(there, here @ turn.T, rtol=0, atol=1e-5)


def test_the_place_in_the_world_does_not_matter():
    assembly, params, motion = tiny()
    away = np.array([7.0, -3.0, 11.0])
    there = run(assembly, params, edited(motion, translation=motion.translation + away))
    np.testing.assert_allclose(there, run(assembly, params, motion) + away, rtol=0, atol=1e-10)


def test_strength_of_gravity_is_no_input():
    """Descriptors hold its direction alone: what its strength does to the cloth is learned, by the energy."""
    assembly, params, motion = tiny(gravity=(0.0, -9.81, 0.0))
    moon, _, _ = tiny(gravity=(0.0, -1.62, 0.0))
    np.testing.assert_allclose(run(moon, params, motion), run(assembly, params, motion), rtol=0, atol=1e-13)


# --- time -------------------------------------------------------------------------------------------------------------


def test_nothing_is_known_of_the_future():
    assembly, params, motion = tiny()
    poses, translation = motion.poses.copy(), motion.translation.copy()
    poses[15:], translation[15:] = -2 * poses[15:], 0
    here, there = run(assembly, params, motion), run(assembly, params, edited(motion, poses, translation))
    assert np.array_equal(here[:15], there[:15])
    assert np.abs(here[15] - there[15]).max() > 1e-3


def test_the_static_result_knows_only_its_own_frame():
    assembly, params, motion = tiny()
    order = np.random.default_rng(0).permutation(len(motion.poses))
    shuffled = edited(motion, motion.poses[order], motion.translation[order])
    here = run(assembly, params, motion, 0.0)
    np.testing.assert_allclose(run(assembly, params, shuffled, 0.0), here[order], rtol=0, atol=1e-14)
    assert np.abs(run(assembly, params, shuffled) - run(assembly, params, motion)[order]).max() > 1e-3


def test_a_steady_ride_is_rest():
    """Galileo: once the start is forgotten, a constant velocity leaves no trace."""
    assembly, params, motion = tiny()
    frames = 100
    poses = np.repeat(motion.poses[5:6], frames, axis=0)
    velocity = np.array([3.0, 0.5, -1.0])
    ride = edited(motion, poses, velocity * np.arange(frames)[:, None] / 30)
    difference = np.abs(run(assembly, params, ride) - run(assembly, params, ride, 0.0)).max(axis=(1, 2))
    assert difference[1] > 1e-3 and difference[-1] < 1e-8
    braking = edited(ride, translation=np.minimum(np.arange(frames), 60)[:, None] * velocity / 30)
    difference = np.abs(run(assembly, params, braking) - run(assembly, params, braking, 0.0)).max(axis=(1, 2))
    assert difference[59] < 1e-5 and difference[61] > 1e-3


@partial(jax.jit, static_argnums=(0, 4))
def windows(network, params, track, ends, frames):
    return network.windows(params, track, ends, frames, frames)


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0, 2.5, -1.0])
def test_alpha_scales_the_dynamic_code_and_nothing_else(alpha):
    """z = z_S + alpha z_D (15), with the codes that training sees in a window that reaches back to the motion's start."""
    assembly, params, motion = tiny()
    model, network = assembly.model, assembly.network
    track = features_from_records(model, motion)
    frames = len(motion.poses)
    ends = jnp.array([frames - 1], jnp.int32)
    codes = windows(network, params, track, ends, frames)
    z_static, z_dynamic = (z[:, 0] for z in codes[:2])
    np.testing.assert_allclose(network.codes(params, model, track)[0], z_static, rtol=0, atol=1e-13)
    offsets = np.moveaxis(np.asarray(decode(network, params, model, z_static + alpha * z_dynamic)), -1, 0)
    blended = np.einsum("vj,fjab->fvab", model.blend.weights, np.asarray(track.matrices)[:, list(model.blend.joints)])
    unposed = np.asarray(model.garment.mesh.rest)[None] + offsets
    expected = np.einsum("fvab,fvb->fva", blended[..., :3], unposed) + blended[..., 3]
    np.testing.assert_allclose(run(assembly, params, motion, alpha), expected, rtol=0, atol=1e-12)


def test_a_window_that_begins_within_the_motion_begins_at_rest():
    """What training sees is a stream that was switched on at the window's first frame, with the frames before it known."""
    assembly, params, motion = tiny()
    network = assembly.network
    track = features_from_records(assembly.model, motion)
    end, length = 17, 6
    run_window = jax.jit(lambda p, t: network.windows(p, t, jnp.array([end, 2], jnp.int32), length, 2))
    _, z, _ = run_window(params, track)
    h = jnp.zeros(network.dynamic.state)
    for d in track.dynamic[end - length + 1 : end + 1]:
        before = h
        features = network.dynamic.apply({"params": params["dynamic"]}, d, method="features")
        h = network.dynamic.apply({"params": params["dynamic"]}, h, features, method="step")
    np.testing.assert_allclose(z[:, 0], [before, h], rtol=0, atol=1e-13)
    # and one that would begin before the motion does is the motion from its start
    whole = network.dynamic.apply({"params": params["dynamic"]}, track.dynamic[:3], jnp.zeros(network.dynamic.state))
    np.testing.assert_allclose(z[:, 1], whole[1:], rtol=0, atol=1e-13)

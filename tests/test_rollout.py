"""What must hold exactly of a rollout, whatever the weights: DESIGN of the method, equations (15) and (16)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.network import rollout
from ncs_jax.network.methods.method import decode, for_inference, initial_parameters
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import features_from_records
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import local_rotations
from ncs_jax.scene.spec import scene_from

from .ready import animated, assembled, edited, ready, run, shaken


def test_no_motion_has_no_dynamics():
    assembly, params, motion = ready()
    still = edited(motion, np.repeat(motion.poses[3:4], 12, axis=0), np.repeat(motion.translation[3:4], 12, axis=0))
    moving, static = run(assembly, params, still, 1.0), run(assembly, params, still, 0.0)
    assert np.array_equal(moving, static)
    assert np.array_equal(moving, np.broadcast_to(moving[:1], moving.shape))
    assert not np.array_equal(run(assembly, params, motion, 1.0), run(assembly, params, motion, 0.0))


def test_alpha_zero_is_the_static_result():
    assembly, params, motion = ready()
    track = features_from_records(assembly.model, motion)
    static = animated(assembly.model, assembly.network, params, track, None)
    np.testing.assert_allclose(run(assembly, params, motion, 0.0), static, rtol=0, atol=1e-14)


def test_a_long_motion_is_posed_in_parts(monkeypatch, plain_jax):
    assembly, params, motion = ready(jnp.float32)
    far = features_from_records(assembly.model, edited(motion, translation=motion.translation + 100))
    whole = rollout.animated(assembly.model, assembly.network, params, far, 1.5)
    monkeypatch.setattr(rollout, "LONG", 7)
    parts = rollout.animated(assembly.model, assembly.network, params, far, 1.5)
    assert parts.shape == whole.shape and whole.min() > 50
    np.testing.assert_allclose(parts, whole, rtol=0, atol=3e-5)  # 100 m from the origin a number has 4e-6 m


def test_prepended_rest_changes_nothing():
    assembly, params, motion = ready()
    longer = edited(
        motion,
        np.concatenate([np.repeat(motion.poses[:1], 9, axis=0), motion.poses]),
        np.concatenate([np.repeat(motion.translation[:1], 9, axis=0), motion.translation]),
    )
    np.testing.assert_allclose(run(assembly, params, longer)[9:], run(assembly, params, motion), rtol=0, atol=1e-13)


def test_a_stopped_character_comes_to_the_static_result():
    assembly, params, motion = ready()
    stopped = edited(
        motion,
        np.concatenate([motion.poses, np.repeat(motion.poses[-1:], 80, axis=0)]),
        np.concatenate([motion.translation, np.repeat(motion.translation[-1:], 80, axis=0)]),
    )
    difference = np.abs(run(assembly, params, stopped, 1.0) - run(assembly, params, stopped, 0.0)).max(axis=(1, 2))
    assert difference[: len(motion.poses)].max() > 1e-4
    assert difference[-1] < 1e-9


@pytest.mark.parametrize("alpha", [0.0, 1.5])
def test_a_stream_gives_what_the_sequence_gives(plain_jax, alpha):
    assembly, params, motion = ready(jnp.float32)
    init, step = stepper(assembly.model, assembly.network, params)
    step = jax.jit(step)
    local = local_rotations(assembly.model, jnp.asarray(motion.poses))
    state, frames = init(), []
    for rotations, translation in zip(local, jnp.asarray(motion.translation), strict=True):
        state, x = step(state, rotations, translation, alpha)
        frames.append(np.asarray(x))
    np.testing.assert_allclose(np.stack(frames), run(assembly, params, motion, alpha), rtol=0, atol=1e-6)


def test_many_characters_move_by_themselves(monkeypatch):
    """Five who begin at different frames, each with an alpha of its own, in blocks that do not divide them."""
    monkeypatch.setattr("ncs_jax.network.rollout.BLOCK", 2)
    assembly, params, motion = ready()
    init, step = stepper(assembly.model, assembly.network, params)
    step = jax.jit(step)
    rotations = local_rotations(assembly.model, jnp.asarray(motion.poses, jnp.float64))
    places, alphas = jnp.asarray(motion.translation, jnp.float64), jnp.asarray([0.0, 0.5, 1.0, 1.0, 2.0])
    crowd, alone = init(len(alphas)), [init() for _ in alphas]
    for frame in range(4):
        at = frame + np.arange(len(alphas))
        crowd, x = step(crowd, rotations[at], places[at], alphas)
        for i, alpha in enumerate(alphas):
            alone[i], one = step(alone[i], rotations[at[i]], places[at[i]], alpha)
            np.testing.assert_allclose(x[i], one, rtol=0, atol=1e-13)
    for name, leaf in jax.tree.leaves_with_path(jax.tree.map(lambda *a: jnp.stack(a), *alone)):
        np.testing.assert_allclose(dict(jax.tree.leaves_with_path(crowd))[name], leaf, rtol=0, atol=1e-13)


def test_one_linear_map_for_inference():
    assembly, params, _ = ready()
    model, network = assembly.model, assembly.network
    z = jax.random.normal(jax.random.PRNGKey(2), (7, network.code_size(model)), jnp.float64)
    merged, merged_params = for_inference(network, params, model)
    assert merged.decoder.modes == 0 and network.decoder.modes == 6
    np.testing.assert_allclose(decode(merged, merged_params, model, z), decode(network, params, model, z), rtol=0, atol=1e-13)


def turned(motion, root, angle, root_joint=0):
    """The whole motion turned about the y axis through the origin."""
    turn = Rotation.from_rotvec([0.0, angle, 0.0])
    poses = np.array(motion.poses, np.float64)
    poses[:, root_joint] = (turn * Rotation.from_rotvec(poses[:, root_joint])).as_rotvec()
    translation = turn.apply(motion.translation + root) - root
    return edited(motion, poses, translation), turn.as_matrix()


def test_turning_the_world_turns_the_prediction():
    assembly, params, motion = ready()
    other, turn = turned(motion, assembly.body.joints[0], np.radians(73))
    here, there = run(assembly, params, motion), run(assembly, params, other)
    np.testing.assert_allclose(there, here @ turn.T, rtol=0, atol=1e-9)


def test_the_published_descriptor_lacks_that():
    assembly = assembled({"network.descriptor": "six"}, jnp.float64)
    params = shaken(initial_parameters(assembly.network, jax.random.PRNGKey(0), assembly.model))
    motion = next(iter(assembly.motions.values()))
    other, turn = turned(motion, assembly.body.joints[0], np.radians(73))
    assert np.abs(run(assembly, params, other) - run(assembly, params, motion) @ turn.T).max() > 1e-3


def test_turning_the_recorded_walk(data):
    """CMU 01_01 turned by 73 degrees on the real body and T-shirt, with random weights that offset vertices by decimetres."""
    folder = data / "smpl_research_only"
    scene = scene_from(
        {
            "body": {"file": str(folder / "body.npz")},
            "garment": {"file": str(folder / "tshirt.obj")},
            "motion": {"files": [str(folder / "01_01.npz")], "fps": 15},
            "network": {"modes": 8},
        }
    )
    assembly = assemble(scene, dtype=jnp.float64)
    motion = load_motion(scene, scene.motion.files[0], assembly.body)
    params = shaken(initial_parameters(assembly.network, jax.random.PRNGKey(0), assembly.model))
    other, turn = turned(motion, assembly.body.joints[0], np.radians(73))
    here, there = run(assembly, params, motion), run(assembly, params, other)
    assert np.abs(here - run(assembly, params, motion, 0.0)).max() > 1e-3
    np.testing.assert_allclose(there, here @ turn.T, rtol=0, atol=1e-9)

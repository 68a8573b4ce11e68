"""Skeletons and skinning against a plain loop."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.geometry.skinning import Skeleton, blend, blend_from, forward, skin, to_rest_axes, transforms, unpose

from .shapes import rotation

PARENTS = (-1, 0, 0, 1, 3, 2, 0, 4)
SINGLE = Skeleton(jnp.asarray([[0.1, 0.9, 0.0]]), (-1,))


def skeleton(rng, dtype=jnp.float64):
    return Skeleton(jnp.asarray(rng.normal(size=(len(PARENTS), 3)), dtype), PARENTS)


def motion(rng, frames=3):
    local = Rotation.from_rotvec(rng.normal(size=(frames * len(PARENTS), 3))).as_matrix()
    return jnp.asarray(local.reshape(frames, len(PARENTS), 3, 3)), jnp.asarray(rng.normal(size=(frames, 3)))


def by_loop(joints, parents, local, translation):
    world, position = np.zeros_like(local), np.zeros((len(joints), 3))
    for j, parent in enumerate(parents):
        if parent < 0:
            world[j], position[j] = local[j], joints[j] + translation
        else:
            world[j] = world[parent] @ local[j]
            position[j] = position[parent] + world[parent] @ (joints[j] - joints[parent])
    return world, position


run = jax.jit(forward)
weigh = jax.jit(lambda s, p, b: blend(transforms(s, p), b))


def test_forward_against_a_plain_loop(rng):
    s = skeleton(rng)
    local, translation = motion(rng)
    pose = run(s, local, translation)
    for t in range(len(local)):
        world, position = by_loop(np.asarray(s.joints), PARENTS, np.asarray(local[t]), np.asarray(translation[t]))
        np.testing.assert_allclose(pose.rotations[t], world, atol=1e-14)
        np.testing.assert_allclose(pose.positions[t], position, atol=1e-14)
        alone = run(s, local[t], translation[t])  # one frame is called alike
        np.testing.assert_allclose(alone.positions, position, atol=1e-14)


def test_rest_pose_and_single_joint(rng):
    s = skeleton(rng)
    pose = run(s, jnp.broadcast_to(jnp.eye(3), (len(PARENTS), 3, 3)), jnp.zeros(3))
    np.testing.assert_allclose(pose.positions, s.joints, atol=1e-15)
    turn = jnp.asarray(rotation([0, 1, 0], 1.0))
    pose = run(SINGLE, turn[None], jnp.ones(3))
    np.testing.assert_allclose(pose.positions, SINGLE.joints + 1)
    np.testing.assert_array_equal(pose.rotations[0], turn)


def test_a_turn_of_the_root_moves_everything_rigidly(rng):
    s = skeleton(rng)
    local, _ = motion(rng, frames=1)
    turn = rotation([1, 2, 3], 1.3)
    one = run(s, local[0], jnp.zeros(3))
    other = run(s, local[0].at[0].set(turn @ local[0, 0]), jnp.array([1.0, 2, 3]))
    root = s.joints[0]
    expected = (one.positions - root[None]) @ turn.T + (root + jnp.array([1.0, 2, 3]))[None]
    np.testing.assert_allclose(other.positions, expected, atol=1e-13)
    np.testing.assert_allclose(other.rotations, turn[None] @ np.asarray(one.rotations), atol=1e-14)
    dense = rng.dirichlet(np.ones(len(PARENTS)), 20)
    x = jnp.asarray(rng.normal(size=(20, 3)))
    weights = blend_from(dense, dtype=jnp.float64)
    a, b = (skin(weigh(s, pose, weights), x) for pose in (one, other))
    np.testing.assert_allclose(b, (a - root[None]) @ turn.T + (root + jnp.array([1.0, 2, 3]))[None], atol=1e-13)


def test_rest_rotations_are_only_other_axes(rng):
    """The same character, its joints' rotations given in each joint's own rest frame (Mixamo), ends in the same pose.

    With rest rotations Q_j in the world, such a file says: G_j = G_parent (Q_parent^-1 Q_j) R_j, p_j = p_parent + G_parent o_j,
    the bone o_j = Q_parent^-1 (J_j - J_parent). Relative to rest the joint has then turned by G_j Q_j^-1.
    """
    s = skeleton(rng)
    joints = np.asarray(s.joints)
    local, translation = motion(rng, frames=1)
    q = Rotation.from_rotvec(rng.normal(size=(len(PARENTS), 3))).as_matrix()
    r = np.asarray(local[0])
    world, position = np.zeros_like(q), np.zeros_like(joints)
    for j, parent in enumerate(PARENTS):
        if parent < 0:
            world[j], position[j] = q[j] @ r[j], joints[j] + np.asarray(translation[0])
        else:
            world[j] = world[parent] @ q[parent].T @ q[j] @ r[j]
            position[j] = position[parent] + world[parent] @ q[parent].T @ (joints[j] - joints[parent])
    pose = run(s, to_rest_axes(local[0], jnp.asarray(q)), translation[0])
    np.testing.assert_allclose(pose.positions, position, atol=1e-13)
    np.testing.assert_allclose(pose.rotations, world @ np.swapaxes(q, 1, 2), atol=1e-13)
    without = run(s, local[0], translation[0])
    assert jnp.max(jnp.abs(without.positions - pose.positions)) > 0.1


def test_skinning_against_a_plain_loop_and_back(rng):
    s = skeleton(rng)
    local, translation = motion(rng, frames=1)
    pose = run(s, local[0], translation[0])
    dense = rng.dirichlet(0.3 * np.ones(len(PARENTS)), 30)
    dense[:5] = np.eye(len(PARENTS))[:5]
    x = rng.normal(size=(30, 3))
    right = np.zeros_like(x)
    for v in range(len(x)):
        for j in range(len(PARENTS)):
            moved = np.asarray(pose.rotations[j]) @ (x[v] - joints_of(s)[j]) + np.asarray(pose.positions[j])
            right[v] += dense[v, j] * moved
    blended = weigh(s, pose, blend_from(dense, dtype=jnp.float64))
    posed = skin(blended, jnp.asarray(x))
    np.testing.assert_allclose(posed, right, atol=1e-12)
    np.testing.assert_allclose(jax.jit(unpose)(blended, posed), x, atol=1e-9)


def joints_of(s):
    return np.asarray(s.joints)


def test_only_the_largest_weights_are_kept_and_rows_sum_to_one(rng):
    dense = rng.dirichlet(np.ones(12), 40)
    dense[:, 5] = 0
    kept = blend_from(dense, most=3)
    table = np.zeros_like(dense)
    table[:, list(kept.joints)] = np.asarray(kept.weights)
    assert kept.weights.dtype == jnp.float32 and 5 not in kept.joints
    np.testing.assert_allclose(table.sum(axis=1), 1, rtol=1e-6)
    assert ((table > 0).sum(axis=1) == 3).all()
    np.testing.assert_array_equal(np.argsort(table, axis=1)[:, -3:], np.argsort(dense, axis=1)[:, -3:])


def test_unposing_where_opposite_rotations_cancel_is_zero_and_finite():
    blended = jnp.zeros((2, 3, 4)).at[1, :, :3].set(jnp.eye(3))
    x = jnp.ones((2, 3))
    np.testing.assert_array_equal(unpose(blended, x), [[0, 0, 0], [1, 1, 1]])
    assert jnp.all(jnp.isfinite(jax.grad(lambda b: jnp.sum(unpose(b, x)))(blended)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_type_is_kept(rng, dtype):
    s = skeleton(rng, dtype)
    local, translation = motion(rng, frames=1)
    pose = run(s, local[0].astype(dtype), translation[0].astype(dtype))
    blended = weigh(s, pose, blend_from(rng.dirichlet(np.ones(len(PARENTS)), 4), dtype=dtype))
    assert pose.positions.dtype == pose.rotations.dtype == blended.dtype == dtype
    assert unpose(blended, skin(blended, jnp.ones((4, 3), dtype))).dtype == dtype

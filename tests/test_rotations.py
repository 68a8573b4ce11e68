"""Rotations against SciPy's, at every angle where a formula changes, and motions at another frame rate."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from ncs_jax.geometry.rotations import (
    axis_angle_to_matrix,
    axis_angle_to_quaternion,
    matrix_to_quaternion,
    matrix_to_six,
    quaternion_to_axis_angle,
    quaternion_to_matrix,
    resample,
    slerp,
)

ANGLES = [0.0, 1e-9, 1e-6, 0.99e-4, 1.01e-4, 1e-2, 1.0, np.pi / 2, 3.0, np.pi - 1e-3, np.pi - 1e-7]


def rotvecs(rng, angles=ANGLES, each=6):
    axes = np.concatenate([np.eye(3), rng.normal(size=(each, 3))])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return (np.array(angles)[:, None, None] * axes).reshape(-1, 3)


def wxyz(rotation):
    return rotation.as_quat(scalar_first=True, canonical=True)


def test_conversions_agree_with_scipy_at_every_angle(rng):
    a = rotvecs(rng)
    right = Rotation.from_rotvec(a)
    q = axis_angle_to_quaternion(jnp.asarray(a))
    np.testing.assert_allclose(q, wxyz(right), atol=1e-15)
    np.testing.assert_allclose(axis_angle_to_matrix(jnp.asarray(a)), right.as_matrix(), atol=4e-15)
    np.testing.assert_allclose(matrix_to_quaternion(jnp.asarray(right.as_matrix())), wxyz(right), atol=1e-12)
    np.testing.assert_allclose(quaternion_to_matrix(q), right.as_matrix(), atol=4e-15)
    # relative, so that small turns keep their digits
    np.testing.assert_allclose(quaternion_to_axis_angle(q), a, rtol=1e-11, atol=1e-20)
    np.testing.assert_allclose(quaternion_to_axis_angle(-q), a, rtol=1e-11, atol=1e-20)
    np.testing.assert_array_equal(matrix_to_six(jnp.asarray(right.as_matrix()))[:, :3], right.as_matrix()[:, :, 0])
    np.testing.assert_array_equal(matrix_to_six(jnp.asarray(right.as_matrix()))[:, 3:], right.as_matrix()[:, :, 1])


def test_turns_beyond_half_a_turn_are_the_same_rotation(rng):
    a = rotvecs(rng, [3.5, 6.0, 2 * np.pi + 0.3])
    back = quaternion_to_axis_angle(axis_angle_to_quaternion(jnp.asarray(a)))
    np.testing.assert_allclose(back, Rotation.from_rotvec(a).as_rotvec(), atol=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_round_trips_keep_dtype_and_digits(rng, dtype):
    a = jnp.asarray(rotvecs(rng, [0.0, 1e-6, 1e-3, 0.1, 1.0, 3.0]), dtype)
    there = axis_angle_to_matrix(a)
    back = quaternion_to_axis_angle(matrix_to_quaternion(there))
    assert there.dtype == back.dtype == dtype
    np.testing.assert_allclose(np.asarray(back), np.asarray(a), atol=3e-6 if dtype == jnp.float32 else 1e-14)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_derivatives_are_finite_at_rest_and_right_beside_it(dtype):
    first = jax.jit(jax.jacfwd(axis_angle_to_matrix))
    second = jax.jit(jax.hessian(axis_angle_to_matrix))
    for size in (0, 1e-30, 1e-12, 1e-4, 1):
        a = jnp.array([0.6, 0, -0.8], dtype) * dtype(size)
        assert jnp.all(jnp.isfinite(first(a))) and jnp.all(jnp.isfinite(second(a)))
    generators = np.zeros((3, 3, 3))
    for i, j, k in [(0, 1, 2), (1, 2, 0), (2, 0, 1)]:  # d exp([a]x) / d a_k at 0
        generators[j, i, k], generators[i, j, k] = 1, -1
    np.testing.assert_allclose(first(jnp.zeros(3, dtype)), generators, atol=0)
    back = jax.jit(jax.jacfwd(lambda a: quaternion_to_axis_angle(axis_angle_to_quaternion(a))))
    for size in (0, 1e-12, 1e-7, 1e-5, 1e-2):
        np.testing.assert_allclose(back(jnp.array([0.6, 0, -0.8], dtype) * dtype(size)), np.eye(3), atol=2e-3 * size + 1e-6)


def test_slerp_goes_at_constant_speed_along_the_shorter_arc(rng):
    for angle in (0.0, 1e-7, 0.999e-3, 1.001e-3, 0.5, 3.0):
        step = rotvecs(rng, [angle], 1)[3]
        start = Rotation.from_rotvec([0.3, -1.2, 2.0])
        ends = Rotation.concatenate([start, start * Rotation.from_rotvec(step)])
        p, q = jnp.asarray(ends.as_quat(scalar_first=True))
        for t in (0.0, 0.2, 0.5, 1.0):
            right = wxyz(Slerp([0, 1], ends)(t))
            for sign in (1, -1):  # q and -q are one rotation
                got = np.asarray(slerp(p, sign * q, t))
                np.testing.assert_allclose(got * np.sign(got[0]), right, atol=1e-12)
                travelled = (start.inv() * Rotation.from_quat(got, scalar_first=True)).magnitude()
                np.testing.assert_allclose(travelled, t * angle, atol=1e-10)


def test_slerp_derivative_is_finite_between_equal_rotations():
    q = jnp.array([1.0, 0, 0, 0])
    assert jnp.all(jnp.isfinite(jax.jacfwd(lambda p: slerp(p, q, 0.3))(q)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(("source", "target"), [(120.0, 15.0), (90.0, 30.0), (25.0, 75.0), (30.0, 30.0), (30.0, 210.0)])
def test_resample_keeps_frames_exactly_at_whole_ratios(rng, dtype, source, target):
    frames = 301
    poses = jnp.asarray(rng.normal(size=(frames, 2, 3)), dtype)
    translation = jnp.asarray(rng.normal(size=(frames, 3)), dtype)
    new_poses, new_translation = resample(poses, translation, source, target)
    assert new_poses.dtype == new_translation.dtype == dtype
    if source >= target:
        every = round(source / target)
        np.testing.assert_array_equal(new_poses, poses[::every])
        np.testing.assert_array_equal(new_translation, translation[::every])
    else:
        every = round(target / source)
        assert len(new_poses) == (frames - 1) * every + 1
        np.testing.assert_array_equal(new_poses[::every], poses)
        np.testing.assert_array_equal(new_translation[::every], translation)


def test_resample_between_frames_is_slerp(rng):
    a = np.cumsum(0.3 * rng.normal(size=(60, 3)), axis=0)
    a = Rotation.from_rotvec(a).as_rotvec()  # jumps from pi to -pi: one rotation, two vectors
    assert np.linalg.norm(np.diff(a, axis=0), axis=1).max() > 3
    new, moved = resample(jnp.asarray(a)[:, None], jnp.asarray(a), 24.0, 60.0)
    times = np.arange(len(new)) * 24 / 60
    assert len(new) == 148 and times[-1] <= 59
    right = Slerp(np.arange(60), Rotation.from_rotvec(a))(times)
    assert (right.inv() * Rotation.from_rotvec(np.array(new)[:, 0])).magnitude().max() < 1e-7
    np.testing.assert_allclose(moved[:, 1], np.interp(times, np.arange(60), a[:, 1]), atol=1e-12)


def test_resample_of_one_frame():
    new, moved = resample(jnp.ones((1, 2, 3)), jnp.ones((1, 3)), 30.0, 60.0)
    assert new.shape == (1, 2, 3) and moved.shape == (1, 3)
    np.testing.assert_array_equal(new, 1)

"""Pose descriptors: zero without motion, and, without the heading, blind to a turn about gravity."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.scene.descriptors import ACCELERATION_SCALE, DESCRIPTORS, RATE_SCALE, Joints, dynamic, static

from .shapes import rotation

DT = 1 / 30
GRAVITY = np.array([0.0, -9.81, 0.0])
every_kind = pytest.mark.parametrize("kind", DESCRIPTORS)
run_static = jax.jit(static, static_argnums=2)
run_dynamic = jax.jit(dynamic, static_argnums=5)


def frames(rng, joints=4, count=3, speed=0.1):
    """A short motion: local rotations, world rotations of a chain, positions."""
    start, step = rng.normal(size=(2, joints, 3))
    place, way = rng.normal(size=(2, joints, 3))
    result = []
    for t in range(count):
        local = (Rotation.from_rotvec(start) * Rotation.from_rotvec(speed * t**1.5 * step)).as_matrix()
        world = [local[0]]
        for r in local[1:]:
            world.append(world[-1] @ r)
        position = place + speed * t**1.5 * way
        result.append(Joints(jnp.asarray(local), jnp.asarray(np.stack(world)), jnp.asarray(position)))
    return result[::-1]  # now, previous, before


def turned(frame, turn):
    """The same frame of the whole motion turned about the origin: the root's local rotation is its world one."""
    return Joints(
        frame.local.at[0].set(turn @ frame.local[0]),
        jnp.asarray(turn[None] @ np.asarray(frame.world)),
        frame.positions @ turn.T,
    )


@every_kind
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_shape_and_type(rng, kind, dtype):
    now, previous, before = (jax.tree.map(lambda a: a.astype(dtype), f) for f in frames(rng))
    g = jnp.asarray(GRAVITY, dtype)
    s, d = run_static(now, g, kind), run_dynamic(now, previous, before, g, DT, kind)
    assert s.shape == (4, DESCRIPTORS[kind] + 3) and d.shape == (4, DESCRIPTORS[kind] + 6)
    assert s.dtype == d.dtype == dtype


@every_kind
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_no_motion_is_exactly_zero(rng, kind, dtype):
    still = jax.tree.map(lambda a: a.astype(dtype), frames(rng, joints=40)[0])
    d = run_dynamic(still, still, still, jnp.asarray(GRAVITY, dtype), DT, kind)
    np.testing.assert_array_equal(d, 0)
    now, previous, before = frames(rng)
    assert jnp.any(run_dynamic(now, previous, before, jnp.asarray(GRAVITY), DT, kind))


@every_kind
def test_gravity_is_seen_from_each_joint(rng, kind):
    now = frames(rng)[0]
    seen = run_static(now, jnp.asarray(GRAVITY), kind)[:, -3:]
    np.testing.assert_allclose(seen, -np.asarray(now.world)[:, 1], atol=1e-14)  # R^T (0, -1, 0)
    np.testing.assert_array_equal(run_static(now, jnp.zeros(3), kind)[:, -3:], 0)  # no gravity, no down


@every_kind
def test_acceleration_is_seen_from_each_joint(rng, kind):
    now, previous, before = frames(rng)
    a = np.asarray(now.positions - 2 * previous.positions + before.positions) / DT**2
    right = np.einsum("jab,ja->jb", np.asarray(now.world), a)
    got = run_dynamic(now, previous, before, jnp.asarray(GRAVITY), DT, kind)[:, -3:]
    np.testing.assert_allclose(got, ACCELERATION_SCALE * right, atol=1e-10)


def test_a_steady_velocity_is_no_acceleration(rng):
    still = frames(rng)[0]
    at = lambda t: Joints(still.local, still.world, still.positions + 0.5 * t)  # noqa: E731
    np.testing.assert_allclose(run_dynamic(at(2), at(1), at(0), jnp.asarray(GRAVITY), DT, "six"), 0, atol=1e-12)


@pytest.mark.parametrize("gravity", [GRAVITY, np.array([0, 0, -9.81]), np.array([1.0, -2, 3])])
def test_without_heading_a_turn_about_gravity_changes_nothing(rng, gravity):
    motion = frames(rng)
    turn = rotation(gravity, np.deg2rad(73))
    other = [turned(f, turn) for f in motion]
    g = jnp.asarray(gravity)
    for kind in DESCRIPTORS:
        same = [
            np.abs(np.asarray(run_static(motion[0], g, kind) - run_static(other[0], g, kind))).max(),
            np.abs(np.asarray(run_dynamic(*motion, g, DT, kind) - run_dynamic(*other, g, DT, kind))).max(),
        ]
        if kind == "heading_free":
            assert max(same) < 1e-10
        else:
            assert same[0] > 0.05
    # any other turn is seen: the root's tilt is not lost
    other = [turned(f, rotation(np.cross(gravity, [1, 5, 2]), np.deg2rad(73))) for f in motion]
    tilt = run_static(motion[0], g, "heading_free") - run_static(other[0], g, "heading_free")
    assert jnp.max(jnp.abs(tilt[0])) > 0.05


def test_without_heading_turning_on_the_spot_is_still_seen(rng):
    still = frames(rng)[0]
    motion = [turned(still, rotation(GRAVITY, a)) for a in (0.2, 0.1, 0.0)]
    d = run_dynamic(*motion, jnp.asarray(GRAVITY), DT, "heading_free")
    assert jnp.max(jnp.abs(d[0, :6])) > 0.05


@pytest.mark.parametrize("kind", ["quaternion", "axis_angle"])
def test_the_rate_is_continuous_through_half_a_turn(rng, kind):
    """There the quaternion's sign and the axis-angle vector jump; the joint does not."""
    axis = np.array([0.6, 0, 0.8])
    one = lambda a: jnp.asarray(rotation(axis, a))[None]  # noqa: E731
    at = lambda a: Joints(one(a), one(a), jnp.zeros((1, 3)))  # noqa: E731
    rates = []
    for middle in (1.0, np.pi - 0.02, np.pi - 1e-6, np.pi, np.pi + 1e-6, np.pi + 0.02, 2 * np.pi):
        d = run_dynamic(at(middle + 0.05), at(middle - 0.05), at(middle - 0.15), jnp.asarray(GRAVITY), DT, kind)
        rates.append(float(jnp.linalg.norm(d[0, : DESCRIPTORS[kind]])))
    expected = RATE_SCALE * (0.1 if kind == "axis_angle" else 2 * np.sin(0.025)) / DT
    np.testing.assert_allclose(rates, expected, rtol=1e-6)


def test_axis_angle_rate_is_the_angular_velocity(rng):
    omega = np.array([0.3, -2.0, 1.0])
    now, before = (Rotation.from_rotvec([0.5, 1, 2]) * Rotation.from_rotvec(omega * t) for t in (DT, 0))
    frame = lambda r: Joints(jnp.asarray(r.as_matrix()[None]), jnp.asarray(r.as_matrix()[None]), jnp.zeros((1, 3)))  # noqa: E731
    d = run_dynamic(frame(now), frame(before), frame(before), jnp.asarray(GRAVITY), DT, "axis_angle")
    np.testing.assert_allclose(d[0, :3], RATE_SCALE * omega, rtol=1e-9)

"""Pose descriptors, static (8) and dynamic (9), one frame at a time.

No motion means a dynamic descriptor of zero: it may be scaled, never shifted.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.geometry.numerics import norm
from ncs_jax.geometry.rotations import matrix_to_quaternion, matrix_to_six, quaternion_to_axis_angle

__all__ = ["DESCRIPTORS", "Joints", "dynamic", "static"]

DESCRIPTORS = {"heading_free": 6, "six": 6, "quaternion": 4, "axis_angle": 3}

# Rates (1/s) and accelerations (m/s^2) enter the network at about the size of 1.
RATE_SCALE = 0.1
ACCELERATION_SCALE = 0.03


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Joints:
    """The input joints at one frame: local rotations, world rotations and world positions (m). The first is the root."""

    local: Float[Array, "*frames joints 3 3"]
    world: Float[Array, "*frames joints 3 3"]
    positions: Float[Array, "*frames joints 3"]


def _unposed(world: Float[Array, "joints 3 3"], vectors: Float[Array, "joints 3"]) -> Float[Array, "joints 3"]:
    """R^-1 v for every joint."""
    return jnp.einsum("jab,ja->jb", world, vectors, precision="highest")


def _down(gravity: Float[Array, 3]) -> Float[Array, 3]:
    """g/|g|; zero in a scene without gravity, which has no down."""
    length = norm(gravity)
    return gravity / jnp.where(length > 0, length, 1)


def _numbers(local: Float[Array, "joints 3 3"], kind: str) -> Float[Array, "joints numbers"]:
    if kind == "axis_angle":
        return quaternion_to_axis_angle(matrix_to_quaternion(local))
    if kind == "quaternion":
        return matrix_to_quaternion(local)
    six = matrix_to_six(local)
    return six.at[0].set(0) if kind == "heading_free" else six


def _numbers_rate(now: Joints, previous: Joints, dt, kind: str) -> Float[Array, "joints numbers"]:
    a, b = _numbers(now.local, kind), _numbers(previous.local, kind)
    if kind == "quaternion":  # q and -q are one rotation
        b = jnp.where(jnp.sum(a * b, axis=-1, keepdims=True) < 0, -b, b)
    if kind == "axis_angle":  # the vector jumps at half a turn, the rotation in between does not
        step = jnp.matmul(jnp.swapaxes(previous.local, -1, -2), now.local, precision="highest")
        return _numbers(step, kind) / dt
    rate = (a - b) / dt
    if kind == "heading_free":
        turn = jnp.matmul(now.world[0].T, (now.world[0] - previous.world[0]) / dt, precision="highest")
        rate = rate.at[0].set(matrix_to_six(turn))
    return rate


def static(now: Joints, gravity: Float[Array, 3], kind: str = "heading_free") -> Float[Array, "joints numbers"]:
    """Return the static descriptor of a frame: each joint's rotation and the gravity direction it sees.

        d_S = (rotation, R^-1 g/|g|)

    With `heading_free` the root's rotation is given by its gravity direction alone, which is all of it but the heading: a
    turn of the whole motion about gravity then changes nothing, exactly. `six`: the first two columns (Zhou et al. 2019);
    `quaternion` and `axis_angle` are for comparison.

    Args:
        now: input joints. gravity: (3,) m/s^2. kind: a key of `DESCRIPTORS`.

    Returns:
        (joints, DESCRIPTORS[kind] + 3), dimensionless. Source: slides, equation (8).
    """
    down = jnp.broadcast_to(_down(gravity), now.positions.shape)
    return jnp.concatenate([_numbers(now.local, kind), _unposed(now.world, down)], axis=-1)


def dynamic(
    now: Joints, previous: Joints, before: Joints, gravity: Float[Array, 3], dt, kind: str = "heading_free"
) -> Float[Array, "joints numbers"]:
    """Return the dynamic descriptor of a frame: the rate of the static one and the unposed acceleration of each joint.

        d_D = (d/dt d_S, R^-1 a),  a = (p_t - 2 p_{t-1} + p_{t-2}) / dt^2

    Differences look backward, so a stream gives what a whole sequence gives. With `heading_free` the root's rate is that of
    its rotation seen from itself, R_t^T (R_t - R_{t-1}) / dt, which keeps the turning and drops the heading.

    Args:
        now, previous, before: input joints at t, t-1, t-2. gravity: (3,) m/s^2. dt: s. kind: a key of `DESCRIPTORS`.

    Returns:
        (joints, DESCRIPTORS[kind] + 6): rates times 0.1 s, accelerations times 0.03 s^2/m; zero without motion.
        Source: slides, equation (9).
    """
    down = jnp.broadcast_to(_down(gravity), now.positions.shape)
    gravity_rate = (_unposed(now.world, down) - _unposed(previous.world, down)) / dt
    # the difference of two differences: 10 km from the origin it loses no more than each position already has
    acceleration = ((now.positions - previous.positions) - (previous.positions - before.positions)) / dt**2
    return jnp.concatenate(
        [
            RATE_SCALE * _numbers_rate(now, previous, dt, kind),
            RATE_SCALE * gravity_rate,
            ACCELERATION_SCALE * _unposed(now.world, acceleration),
        ],
        axis=-1,
    )

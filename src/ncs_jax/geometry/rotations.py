"""Rotations: axis-angle, unit quaternions (w, x, y, z), matrices, the 6D form, and interpolation in time."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.geometry.numerics import norm, signed_angle

__all__ = [
    "axis_angle_to_matrix",
    "axis_angle_to_quaternion",
    "matrix_to_quaternion",
    "matrix_to_six",
    "quaternion_to_axis_angle",
    "quaternion_to_matrix",
    "resample",
    "slerp",
]


def axis_angle_to_quaternion(a: Float[Array, "*rows 3"]) -> Float[Array, "*rows 4"]:
    """Return q = (cos(|a|/2), sin(|a|/2) a/|a|), smooth through a = 0 (radians)."""
    square = jnp.sum(a * a, axis=-1, keepdims=True)
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1, square))
    # sin(t/2)/t and cos(t/2) by their series below 1e-4 rad: the next terms are under 1e-17.
    ratio = jnp.where(small, 0.5 - square / 48, jnp.sin(angle / 2) / angle)
    real = jnp.where(small, 1 - square / 8, jnp.cos(angle / 2))
    return jnp.concatenate([real, ratio * a], axis=-1)


def quaternion_to_axis_angle(q: Float[Array, "*rows 4"]) -> Float[Array, "*rows 3"]:
    """Return axis times angle, the angle in [0, pi] whatever the sign of q."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    sine = norm(q[..., 1:])[..., None]
    small = sine < 1e-6
    angle = 2 * signed_angle(sine, q[..., :1])
    return q[..., 1:] * jnp.where(small, 2, angle / jnp.where(small, 1, sine))


def quaternion_to_matrix(q: Float[Array, "*rows 4"]) -> Float[Array, "*rows 3 3"]:
    """Return the rotation matrix of a unit quaternion."""
    w, x, y, z = jnp.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def axis_angle_to_matrix(a: Float[Array, "*rows 3"]) -> Float[Array, "*rows 3 3"]:
    """Return the rotation matrix exp([a]x) (radians)."""
    return quaternion_to_matrix(axis_angle_to_quaternion(a))


def matrix_to_quaternion(r: Float[Array, "*rows 3 3"]) -> Float[Array, "*rows 4"]:
    """Return the unit quaternion of a rotation matrix, w >= 0, by its largest component (Shepperd 1978)."""
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    a, b, c = r[..., 2, 1], r[..., 0, 2], r[..., 1, 0]
    d, e, f = r[..., 1, 2], r[..., 2, 0], r[..., 0, 1]
    candidates = jnp.stack(
        [
            jnp.stack([1 + xx + yy + zz, a - d, b - e, c - f], axis=-1),
            jnp.stack([a - d, 1 + xx - yy - zz, c + f, b + e], axis=-1),
            jnp.stack([b - e, c + f, 1 - xx + yy - zz, a + d], axis=-1),
            jnp.stack([c - f, b + e, a + d, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )
    best = jnp.argmax(jnp.stack([xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy], axis=-1), axis=-1)
    q = jnp.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    q = q / jnp.sqrt(jnp.sum(q * q, axis=-1, keepdims=True))
    return jnp.where(q[..., :1] < 0, -q, q)


def matrix_to_six(r: Float[Array, "*rows 3 3"]) -> Float[Array, "*rows 6"]:
    """Return the first two columns, a continuous description of a rotation (Zhou et al. 2019)."""
    return jnp.concatenate([r[..., :, 0], r[..., :, 1]], axis=-1)


def slerp(p: Float[Array, "*rows 4"], q: Float[Array, "*rows 4"], t: Float[Array, "*rows"] | float) -> Float[Array, "*rows 4"]:
    """Interpolate two unit quaternions along the **shorter** arc.

    q and -q are the same rotation: the one nearer to p is used.
    """
    dot = jnp.sum(p * q, axis=-1, keepdims=True)
    q = jnp.where(dot < 0, -q, q)
    t = jnp.broadcast_to(jnp.asarray(t, p.dtype), dot.shape[:-1])[..., None]
    angle = 2 * signed_angle(norm(q - p)[..., None], norm(q + p)[..., None])
    small = angle < 1e-3
    sine = jnp.sin(jnp.where(small, 1, angle))
    a = jnp.where(small, 1 - t, jnp.sin((1 - t) * angle) / sine)
    b = jnp.where(small, t, jnp.sin(t * angle) / sine)
    mixed = a * p + b * q
    return mixed / jnp.sqrt(jnp.sum(mixed * mixed, axis=-1, keepdims=True))


@functools.partial(jax.jit, static_argnums=(2, 3))
def resample(
    poses: Float[Array, "frames joints 3"],
    translation: Float[Array, "frames 3"],
    source_fps: float,
    fps: float,
) -> tuple[Float[Array, "new joints 3"], Float[Array, "new 3"]]:
    """Resample a motion to another frame rate: rotations by slerp, translations linearly; whole ratios keep frames exactly."""
    frames = poses.shape[0]
    count = int((frames - 1) * fps / source_fps + 1e-6) + 1
    # Times, in source frames, are known on the host: in float32 they would lose whole ratios after some hundred frames.
    times = np.arange(count) * source_fps / fps
    times = np.where(np.abs(times - np.round(times)) < 1e-6, np.round(times), times)
    low = np.minimum(np.floor(times).astype(np.int32), frames - 1)
    high = np.minimum(low + 1, frames - 1)
    t = jnp.asarray(times - low, poses.dtype)[:, None]
    q = axis_angle_to_quaternion(poses)
    mixed = quaternion_to_axis_angle(slerp(q[low], q[high], jnp.broadcast_to(t, (count, poses.shape[1]))))
    moved = translation[low] + t * (translation[high] - translation[low])
    whole = jnp.asarray(times == low)[:, None, None]
    return jnp.where(whole, poses[low], mixed), moved

"""Rotations: axis-angle, unit quaternions (w, x, y, z), matrices, the 6D form, and interpolation in time."""

from __future__ import annotations

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

BLOCK = 256  # frames that are resampled together


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


def resample(
    poses: Float[Array | np.ndarray, "frames joints 3"],
    translation: Float[Array | np.ndarray, "frames 3"],
    source_fps: float,
    fps: float,
) -> tuple[Float[np.ndarray, "new joints 3"], Float[np.ndarray, "new 3"]]:
    """Resample a motion to another frame rate: rotations by slerp, translations linearly; whole ratios keep frames exactly.

    It works in blocks of frames: motions of all lengths share one program, and where every frame is kept none is compiled.
    """
    poses, translation = np.asarray(poses), np.asarray(translation)
    frames = len(poses)
    count = int((frames - 1) * fps / source_fps + 1e-6) + 1
    # In double precision: in single one, times would lose whole ratios after some hundred frames.
    times = np.arange(count) * source_fps / fps
    times = np.where(np.abs(times - np.round(times)) < 1e-6, np.round(times), times)
    low = np.minimum(np.floor(times).astype(np.int32), frames - 1)
    high = np.minimum(low + 1, frames - 1)
    t = (times - low).astype(poses.dtype)
    new, between = poses[low], np.flatnonzero(times != low)
    for first in range(0, len(between), BLOCK):
        some = between[first : first + BLOCK]
        at = np.pad(some, (0, BLOCK - len(some)), mode="edge")
        new[some] = np.asarray(_between(*map(jnp.asarray, (poses[low[at]], poses[high[at]], t[at]))))[: len(some)]
    moved = translation[low] + t[:, None].astype(translation.dtype) * (translation[high] - translation[low])
    return new, moved


@jax.jit
def _between(
    a: Float[Array, "frames joints 3"], b: Float[Array, "frames joints 3"], t: Float[Array, "frames"]
) -> Float[Array, "frames joints 3"]:
    """Return rotations a share t of the way from a to b, axis times angle."""
    mixed = slerp(axis_angle_to_quaternion(a), axis_angle_to_quaternion(b), jnp.broadcast_to(t[:, None], a.shape[:2]))
    return quaternion_to_axis_angle(mixed)

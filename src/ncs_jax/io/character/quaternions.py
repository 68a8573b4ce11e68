"""Quaternions (w, x, y, z) in NumPy, for the readers and writers of files."""

from __future__ import annotations

import numpy as np

__all__ = ["about_axis", "from_axis_angle", "from_matrix", "multiply", "slerp", "to_axis_angle", "to_matrix"]


def about_axis(axis: int, angle: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) that turn by an angle (N,), rad, about a coordinate axis."""
    q = np.zeros((*np.shape(angle), 4))
    q[..., 0], q[..., axis + 1] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def from_axis_angle(vectors: np.ndarray) -> np.ndarray:
    """Return unit quaternions (..., 4) of axis times angle (..., 3), rad."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    half = np.sinc(angle / (2 * np.pi)) / 2  # sin(angle / 2) / angle
    return np.concatenate([np.cos(angle / 2), half * vectors], axis=-1)


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the product p q (..., 4): first q turns, then p."""
    a, u, b, v = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    return np.concatenate([a * b - (u * v).sum(-1, keepdims=True), a * v + b * u + np.cross(u, v)], axis=-1)


def to_axis_angle(q: np.ndarray) -> np.ndarray:
    """Return axis times angle (..., 3), rad, of quaternions (..., 4) of any length but zero; the angle is at most pi.

    q and -q are the same rotation and give the same result: the one with w >= 0 is used.
    """
    q = np.where(q[..., :1] < 0, -q, q)
    length = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    small = length < 1e-12 * np.abs(q[..., :1])
    angle = 2 * np.arctan2(length, q[..., :1])
    return q[..., 1:] * np.where(small, 2 / np.where(small, q[..., :1], 1), angle / np.where(length > 0, length, 1))


def to_matrix(q: np.ndarray) -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(r: np.ndarray) -> np.ndarray:
    """Return quaternions (..., 4), not of unit length, of rotation matrices (..., 3, 3), by the method of Shepperd (1978)."""
    (a, f, e), (c, b, g), (d, h, i) = np.moveaxis(r, (-2, -1), (0, 1))
    ways = np.stack(
        [
            np.stack([1 + a + b + i, h - g, e - d, c - f], axis=-1),
            np.stack([h - g, 1 + a - b - i, f + c, e + d], axis=-1),
            np.stack([e - d, f + c, 1 - a + b - i, g + h], axis=-1),
            np.stack([c - f, e + d, g + h, 1 - a - b + i], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(np.stack([a + b + i, a - b - i, b - a - i, i - a - b], axis=-1), axis=-1)
    return np.take_along_axis(ways, best[..., None, None], axis=-2)[..., 0, :]


def slerp(p: np.ndarray, q: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Interpolate from unit quaternion p to q (..., 4) along the shorter arc, by the share t (...)."""
    q = np.where((p * q).sum(-1, keepdims=True) < 0, -q, q)
    angle = 2 * np.arctan2(np.linalg.norm(q - p, axis=-1), np.linalg.norm(q + p, axis=-1))
    small = angle < 1e-6
    sine = np.sin(np.where(small, 1, angle))
    mixed = np.where(small, 1 - t, np.sin((1 - t) * angle) / sine)[..., None] * p
    mixed = mixed + np.where(small, t, np.sin(t * angle) / sine)[..., None] * q
    return mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)

"""Quaternions (w, x, y, z), as far as files need them."""

from __future__ import annotations

import numpy as np

__all__ = ["about_axis", "multiply", "to_axis_angle"]


def about_axis(axis: int, angle: np.ndarray) -> np.ndarray:
    """Turn by an angle (N,), rad, about a coordinate axis: (N, 4)."""
    q = np.zeros((*np.shape(angle), 4))
    q[..., 0], q[..., axis + 1] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The product p q (..., 4): first q turns, then p."""
    a, u, b, v = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    return np.concatenate([a * b - (u * v).sum(-1, keepdims=True), a * v + b * u + np.cross(u, v)], axis=-1)


def to_axis_angle(q: np.ndarray) -> np.ndarray:
    """Axis times angle (..., 3), rad, of quaternions (..., 4) of any length but zero; the angle is at most pi.

    q and -q are one rotation and give one result: of the two, the one with w >= 0 is taken.
    """
    q = np.where(q[..., :1] < 0, -q, q)
    length = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    small = length < 1e-12 * np.abs(q[..., :1])
    angle = 2 * np.arctan2(length, q[..., :1])
    return q[..., 1:] * np.where(small, 2 / np.where(small, q[..., :1], 1), angle / np.where(length > 0, length, 1))

"""Normals of a moving mesh, for formats that carry their shading with them."""

from __future__ import annotations

import numpy as np

__all__ = ["vertex_normals"]


def vertex_normals(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals (V, 3) float32 of vertices: the mean of the triangles around, by area; +Y where they cancel."""
    a, b, c = (x[faces[:, k]].astype(np.float64) for k in range(3))
    double = np.cross(b - a, c - a)
    corners = faces.T.reshape(-1)
    summed = np.stack([np.bincount(corners, np.tile(double[:, k], 3), len(x)) for k in range(3)], axis=-1)
    length = np.linalg.norm(summed, axis=1, keepdims=True)
    return np.where(length > 0, summed / np.where(length > 0, length, 1), [0.0, 1.0, 0.0]).astype(np.float32)

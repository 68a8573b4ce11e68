"""Triangles of a mesh that pass through each other, on the host and in float64: for checks, which are done once."""

from __future__ import annotations

import numpy as np

__all__ = ["self_intersections"]

ROUNDING = 1e-12  # of the mesh's size: so near to its plane, a point is on no side of a triangle


def self_intersections(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return pairs of triangles (N, 2), each once, that share no vertex and pass through each other.

    Two triangles do where an edge of one goes through the inside of the other, as in `energies.contact.intersections`; in one
    plane, or where they only touch, they do not.

    Args:
        x: (V, 3), m. faces: (F, 3).
    """
    from scipy.spatial import cKDTree

    corners = np.asarray(x, np.float64)[faces]
    if not len(corners):
        return np.zeros((0, 2), int)
    low, high = corners.min(axis=1), corners.max(axis=1)
    reach = float(np.linalg.norm(high - low, axis=1).max())  # of two that meet, the boxes' middles are no farther apart
    near = cKDTree((low + high) / 2).query_pairs(reach, output_type="ndarray")
    a, b = near.T
    near = near[((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)]
    a, b = near.T
    near = near[~(faces[a][:, :, None] == faces[b][:, None]).any(axis=(1, 2))]
    a, b = near.T
    least = ROUNDING * float(np.ptp(x, axis=0).max())
    return near[_pierces(corners[a], corners[b], least) | _pierces(corners[b], corners[a], least)]


def _pierces(edges: np.ndarray, triangles: np.ndarray, least: float) -> np.ndarray:
    """Return whether an edge of each first triangle (N, 3, 3) goes through the second (N, 3, 3): signs of volumes."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    bound = least * np.linalg.norm(normal, axis=1)
    side = np.einsum("nki,ni->nk", edges - a[:, None], normal)
    found = np.zeros(len(edges), bool)
    for k in range(3):
        p, q = edges[:, k], edges[:, (k + 1) % 3]
        above, below = side[:, k], side[:, (k + 1) % 3]
        apart = (above > bound) & (below < -bound) | (above < -bound) & (below > bound)
        u, v, w = (corner - p for corner in (a, b, c))
        around = np.stack([np.einsum("ni,ni->n", q - p, np.cross(f, g)) for f, g in ((u, v), (v, w), (w, u))])
        found |= apart & ((around > 0).all(axis=0) | (around < 0).all(axis=0))
    return found

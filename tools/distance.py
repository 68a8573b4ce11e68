"""Exact signed distance from points to a closed, or open but oriented, triangle mesh (NumPy, for the asset scripts)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

__all__ = ["signed_distance"]


def signed_distance(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, *, barycentric: bool = False
) -> tuple[np.ndarray, ...]:
    """Distance (N,) to the nearest triangle, positive on its normal's side; that face (N,); direction outward (N, 3).

    Candidates are all faces whose bounding sphere can hold a nearer point than the nearest vertex does. Where several
    faces are equally near, the one that is seen most squarely decides the sign.
    """
    t = vertices[faces]
    centre = t.mean(1)
    radius = np.linalg.norm(t - centre[:, None], axis=2).max()
    reach = cKDTree(vertices).query(points)[0] + radius + 1e-9
    found = cKDTree(centre).query_ball_point(points, reach)
    count = np.array([len(f) for f in found])
    owner, face = np.repeat(np.arange(len(points)), count), np.concatenate([np.array(f, dtype=int) for f in found])
    bary = closest_barycentric(points[owner], t[face])
    offset = points[owner] - np.einsum("nk,nkd->nd", bary, t[face])
    length = np.linalg.norm(offset, axis=1)
    normal = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    squarely = (normal[face] * offset).sum(1)
    best = np.full(len(points), np.inf)
    np.minimum.at(best, owner, length)
    order = np.lexsort((-np.abs(squarely), length > best[owner] + 1e-7, owner))
    first = order[np.r_[0, np.cumsum(count)[:-1]]]
    sign = np.where(squarely[first] >= 0, 1.0, -1.0)
    away = np.where(
        length[first, None] > 1e-6, sign[:, None] * offset[first] / np.maximum(length[first, None], 1e-12), normal[face[first]]
    )
    out = (sign * length[first], face[first], away)
    return (*out, bary[first]) if barycentric else out


def closest_barycentric(p: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (N, 3) of the point of triangle t (N, 3, 3) nearest to p (N, 3)."""
    a, ab, ac = t[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    g11, g12, g22 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    r1, r2 = ((p - a) * ab).sum(1), ((p - a) * ac).sum(1)
    det = np.maximum(g11 * g22 - g12**2, 1e-30)
    v, w = (g22 * r1 - g12 * r2) / det, (g11 * r2 - g12 * r1) / det
    best = np.stack([1 - v - w, v, w], 1)
    outside = (best < 0).any(1)
    nearest = np.full(len(p), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        d = t[:, j] - t[:, i]
        s = np.clip(((p - t[:, i]) * d).sum(1) / np.maximum((d * d).sum(1), 1e-30), 0, 1)
        r = ((p - t[:, i] - s[:, None] * d) ** 2).sum(1)
        pick = outside & (r < nearest)
        nearest[pick] = r[pick]
        best[pick] = 0
        best[pick, i], best[pick, j] = 1 - s[pick], s[pick]
    return best

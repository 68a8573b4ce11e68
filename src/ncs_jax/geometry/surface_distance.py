"""The point of a triangle mesh that is closest to another point, on the host: for preparations, which compile nothing.

What energies and simulations search for in every step is found by programs (`energies.contact`); tests hold the two equal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_jax.geometry.mesh import topology

__all__ = ["SurfacePoints", "border_of", "closest_on_surface", "distance_and_direction", "signed_distance"]

SAME = 1e-9  # m; triangles whose distances differ by less share the closest point


class SurfacePoints(NamedTuple):
    """The closest points of a mesh to N points: triangle (N,), barycentric weights (N, 3), vector from there (N, 3), m.

    normal: sum of the unit normals of all triangles that hold the closest point (N, 3).
    """

    face: np.ndarray
    weights: np.ndarray
    gap: np.ndarray
    normal: np.ndarray


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _share(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return np.clip(p / np.where(q > 0, q, 1), 0, 1)


def _weights(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return what `closest_point.closest_weights` does, components first: x (3, ...), corners (3 corners, 3, ...)."""
    a, b, c = corners
    edges = ((a, b - a), (b, c - b), (c, a - c))
    normal = _cross(edges[0][1], edges[1][1])
    square = _dot(normal, normal)
    over = np.stack([_dot(_cross(edges[k][1], x - edges[k][0]), normal) for k in (1, 2, 0)])
    best, least = over / np.where(square > 0, square, 1), np.where((square > 0) & (over > 0).all(axis=0), -1.0, np.inf)
    for k, (corner, edge) in enumerate(edges):
        s = _share(_dot(x - corner, edge), _dot(edge, edge))
        gap = x - corner - s * edge
        away = _dot(gap, gap)
        nearer = away < least
        least = np.where(nearer, away, least)
        on_edge = np.zeros_like(best)
        on_edge[k], on_edge[(k + 1) % 3] = 1 - s, s
        best = np.where(nearer, on_edge, best)
    return best


def closest_on_surface(x: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> SurfacePoints:
    """Return the closest points of a mesh, vertices (V, 3) and faces (F, 3), to points x (N, 3), m; exact, in float64.

    Where several triangles hold the closest point, `face` is any of them.
    """
    x, corners = np.asarray(x, np.float64), np.asarray(vertices, np.float64)[faces]
    centres = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centres[:, None], axis=-1).max(axis=1)
    owner, near = _candidates(x, centres, radius)
    points, around = x[owner].T, np.moveaxis(corners[near], 0, -1)  # components before pairs
    weights = _weights(points, around)
    gap = points - sum(weights[k] * around[k] for k in range(3))
    away = np.sqrt(_dot(gap, gap))
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    least = np.minimum.reduceat(away, first)
    touching = np.flatnonzero(away <= least[owner] + SAME)
    best = touching[np.flatnonzero(np.diff(owner[touching], prepend=-1))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    held = (normals / np.where(size > 0, size, 1))[near[touching]]
    normal = np.stack([np.bincount(owner[touching], held[:, i], minlength=len(x)) for i in range(3)], axis=1)
    return SurfacePoints(near[best], weights[:, best].T, gap[:, best].T, normal)


def _candidates(x: np.ndarray, centres: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of points and triangles, in the points' order, among which are the nearest ones of every point.

    A triangle is no nearer than its centre less its radius, and no farther than its centre.
    """
    from scipy.spatial import cKDTree

    small = radius <= np.quantile(radius, 0.9)
    groups = [np.flatnonzero(group) for group in (small, ~small) if group.any()]
    trees = [cKDTree(centres[group]) for group in groups]
    reach = np.min([tree.query(x)[0] for tree in trees], axis=0) + SAME
    owners, found = [], []
    for group, tree in zip(groups, trees, strict=True):
        lists = tree.query_ball_point(x, reach + radius[group].max())
        owner = np.repeat(np.arange(len(x)), [len(a) for a in lists])
        near = group[np.concatenate([np.asarray(a, np.int64) for a in lists])] if len(owner) else np.zeros(0, np.int64)
        kept = np.linalg.norm(x[owner] - centres[near], axis=1) <= (reach[owner] + radius[near])
        owners.append(owner[kept])
        found.append(near[kept])
    owner, near = np.concatenate(owners), np.concatenate(found)
    order = np.argsort(owner, kind="stable")
    return owner[order], near[order]


def signed_distance(
    x: np.ndarray, vertices: np.ndarray, faces: np.ndarray, border: np.ndarray, clear: float = np.inf
) -> np.ndarray:
    """Return what `contact.distance.nearest_distance` does, (N,) in m, negative inside.

    The sign is that of the pseudo-normal of what holds the closest point: a face, the sum of an edge's two, or at a vertex the
    faces' weighted by their angles. Where all of it is on the rim, vertices `border` (V,), everything counts as outside. A
    point that is farther than `clear` outside the tangent plane of the nearest vertex is `clear` away.
    Source: Baerentzen and Aanaes 2005.
    """
    from scipy.spatial import cKDTree

    x, vertices = np.asarray(x, np.float64), np.asarray(vertices, np.float64)
    normals, distance = _vertex_normals(vertices, faces), np.full(len(x), clear)
    _, near = cKDTree(vertices).query(x)
    some = np.flatnonzero(np.sum((x - vertices[near]) * normals[near], axis=1) < clear)
    if not some.size:
        return distance
    distance[some], _ = _signed(x[some], vertices, faces, border, normals)
    return distance


def border_of(faces: np.ndarray, count: int) -> np.ndarray:
    """Return which of `count` vertices are on the rim of a mesh: they end an edge of one triangle alone."""
    edges, sides, _ = topology(faces)
    border = np.zeros(count, bool)
    border[edges[sides[:, 1] < 0]] = True
    return border


def distance_and_direction(
    x: np.ndarray, vertices: np.ndarray, faces: np.ndarray, border: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return `signed_distance` (N,), m, and its gradient (N, 3): the unit vectors that lead away from the surface.

    On the surface itself, within 1e-9 m, that is the pseudo-normal. Arguments as of `signed_distance`.
    """
    vertices = np.asarray(vertices, np.float64)
    return _signed(np.asarray(x, np.float64), vertices, faces, border, _vertex_normals(vertices, faces))


def _signed(x, vertices, faces, border, normals) -> tuple[np.ndarray, np.ndarray]:
    points = closest_on_surface(x, vertices, faces)
    zero, corner = points.weights <= 0, faces[points.face, points.weights.argmax(axis=1)]
    normal = np.where((zero.sum(axis=1) == 2)[:, None], normals[corner], points.normal)
    outside = np.sum(points.gap * normal, axis=1) >= 0
    outside |= (border[faces[points.face]] | zero).all(axis=1)
    size = np.linalg.norm(points.gap, axis=1)
    side, on = np.where(outside, 1.0, -1.0), size < SAME
    away = np.where(on[:, None], normal, side[:, None] * points.gap)
    length = np.linalg.norm(away, axis=1, keepdims=True)
    return side * size, away / np.where(length > 0, length, 1)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals (V, 3), the faces' weighted by their angles; zero where there is no face."""
    p = vertices[faces]
    total = np.zeros_like(vertices)
    for k in range(3):
        first, second = p[:, (k + 1) % 3] - p[:, k], p[:, (k + 2) % 3] - p[:, k]
        across = np.cross(first, second)
        size = np.linalg.norm(across, axis=1)
        weighted = across * (np.arctan2(size, np.sum(first * second, axis=1)) / np.where(size > 0, size, 1))[:, None]
        for i in range(3):
            total[:, i] += np.bincount(faces[:, k], weighted[:, i], minlength=len(vertices))
    size = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(size > 0, size, 1)

"""Which triangles pass through each other, on the host: exact, and nothing is compiled."""

from __future__ import annotations

import numpy as np

__all__ = ["crossed", "crossing_pairs"]

PIECE = 200_000  # pairs of triangles that are looked at together, which bounds the memory


def crossed(
    x: np.ndarray, faces: np.ndarray, others: np.ndarray | None = None, other_faces: np.ndarray | None = None
) -> np.ndarray:
    """Return which triangles of a mesh (F,) another one passes through, by the arguments and the rule of `crossing_pairs`."""
    pairs, found = crossing_pairs(x, faces, others, other_faces), np.zeros(len(faces), bool)
    found[pairs if others is None else pairs[:, 0]] = True
    return found


def crossing_pairs(
    x: np.ndarray, faces: np.ndarray, others: np.ndarray | None = None, other_faces: np.ndarray | None = None
) -> np.ndarray:
    """Return pairs of triangles (N, 2), each once, that pass through each other: of two meshes, or of one, but for neighbours.

    Two triangles pass through each other where an edge of one goes through the inside of the other. An edge p q goes through a
    triangle a b c where p and q lie on different sides of its plane, and p q on one side of all three edges,

        sign V(a, b, c, p) = -sign V(a, b, c, q),   sign V(p, q, a, b) = sign V(p, q, b, c) = sign V(p, q, c, a),

    V: volumes of tetrahedra. Triangles in one plane, or that only touch, do not.

    Args:
        x: (V, 3), m, faces (F, 3). others: (B, 3), m, other_faces: of another mesh; None: triangles of the mesh itself that
            share no corner are asked, as `energies.contact.intersections.intersecting` does in a program.

    A triangle with a corner that is not finite passes through none. Source: Moeller and Trumbore 1997; Ericson 2005, 5.3.4.
    """
    x, alone = np.asarray(x, np.float64), others is None or other_faces is None
    y, second = (x, faces) if others is None or other_faces is None else (np.asarray(others, np.float64), other_faces)
    first, last = x[faces], y[second]
    i, j = _near(first, last)
    if alone:
        apart = (i < j) & ~(faces[i][:, :, None] == faces[j][:, None, :]).any(axis=(1, 2))
        i, j = i[apart], j[apart]
    some = np.array_split(np.arange(len(i)), -(-len(i) // PIECE) or 1)
    hit = np.concatenate([_through(first[i[part]], last[j[part]]) for part in some])
    return np.stack([i[hit], j[hit]], axis=1)


def _near(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of triangles (F, 3, 3) and (G, 3, 3) whose boxes overlap."""
    from scipy.spatial import cKDTree

    pairs = []
    for one, a in _by_size(first):
        for other, b in _by_size(last):
            reach = a[2].max() + b[2].max()
            near = cKDTree(a[3]).sparse_distance_matrix(cKDTree(b[3]), reach, output_type="ndarray")
            i, j = near["i"], near["j"]
            near = (a[0][i] <= b[1][j]).all(axis=1) & (b[0][j] <= a[1][i]).all(axis=1)
            pairs.append((one[i[near]], other[j[near]]))
    if not pairs:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    i, j = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return i, j


def _by_size(corners: np.ndarray):
    """Yield small and large triangles apart: which they are, and of each the box's ends, the radius and the centre."""
    good = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    centre = corners[good].mean(axis=1)
    radius = np.linalg.norm(corners[good] - centre[:, None], axis=2).max(axis=1, initial=0)
    small = radius <= np.quantile(radius, 0.95) if len(good) else np.zeros(0, bool)
    for group in (small, ~small):
        if group.any():
            own = corners[good[group]]
            yield good[group], (own.min(axis=1), own.max(axis=1), radius[group], centre[group])


def _through(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return which pairs of triangles, (P, 3, 3) each, pass through each other."""
    a, b = first.transpose(1, 2, 0), last.transpose(1, 2, 0)  # corners, components, pairs
    found = np.zeros(len(first), bool)
    for one, other in ((a, b), (b, a)):
        normal = _cross(other[1] - other[0], other[2] - other[0])
        least = 8 * np.finfo(np.float64).eps * np.abs(first).max(initial=0) * np.sqrt(_dot(normal, normal))
        above = [_dot(corner - other[0], normal) for corner in one]
        for k in range(3):
            p, q, up, down = one[k], one[(k + 1) % 3], above[k], above[(k + 1) % 3]
            at = np.flatnonzero((up > least) & (down < -least) | (up < -least) & (down > least))
            start, along = p[:, at], q[:, at] - p[:, at]
            around = [other[m][:, at] - start for m in range(3)]
            side = [_dot(along, _cross(around[m], around[(m + 1) % 3])) for m in range(3)]
            found[at] |= np.all(np.greater(side, 0), axis=0) | np.all(np.less(side, 0), axis=0)
    return found


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])

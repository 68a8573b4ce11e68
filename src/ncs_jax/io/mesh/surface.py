"""Checks that triangles are an oriented manifold without loose vertices, as cloth must be; its boundary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["boundary_loops", "check_surface", "oriented"]

CLEAR = 0.75  # so large a share of a component's triangles tells its side; else its outside does


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the loops of a surface's boundary, its holes: the vertices of each in turn."""
    edges = [tuple(e) for e in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()]
    after = {e: edges[i + 1 - 3 * (i % 3 == 2)] for i, e in enumerate(edges)}  # the next edge in its triangle
    border = dict.fromkeys(e for e in edges if e[::-1] not in after)
    loops = []
    while border:
        edge, loop = next(iter(border)), []
        while edge in border:
            del border[edge]
            loop.append(edge[0])
            edge = after[edge]
            while edge[::-1] in after:
                edge = after[edge[::-1]]
        loops.append(np.array(loop))
    return loops


def check_surface(file: Path, faces: np.ndarray, count: int) -> None:
    """Raise an InputError unless triangles (F, 3) of vertices 0 to count - 1 form an oriented manifold that uses them all."""
    if count == 0 or len(faces) == 0:
        raise InputError(
            "a mesh with vertices and triangles expected", file=file, field="faces" if count else "vertices",
            value=f"{count} vertices, {len(faces)} faces", mend="export the garment's mesh",
        )  # fmt: skip
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    _three_corners(file, faces, half)
    owner = np.repeat(np.arange(len(faces)), 3)
    _manifold(file, half, owner, count)
    _oriented(file, half, owner, count)
    used = np.zeros(count, bool)
    used[faces] = True
    loose = np.flatnonzero(~used)
    if len(loose):
        first = ", ".join(map(str, loose[:5]))
        raise InputError(
            "every vertex in some triangle expected", file=file, field="faces", value=f"{len(loose)} loose, first: {first}",
            mend="delete loose vertices",
        )  # fmt: skip


def _three_corners(file: Path, faces: np.ndarray, half: np.ndarray) -> None:
    same = np.flatnonzero((half[:, 0] == half[:, 1]).reshape(-1, 3).any(axis=1))
    if len(same):
        raise InputError(
            "three different vertices a triangle expected", file=file, field=f"faces, face {same[0]}",
            value=faces[same[0]].tolist(), mend="delete degenerate faces",
        )  # fmt: skip


def _manifold(file: Path, half: np.ndarray, owner: np.ndarray, count: int) -> None:
    low, high = half.min(axis=1), half.max(axis=1)
    keys, number, faces = np.unique(low * count + high, return_inverse=True, return_counts=True)
    if faces.max() > 2:
        edge = int(faces.argmax())
        a, b = (int(i) for i in divmod(keys[edge], count))
        raise InputError(
            f"at most two triangles at an edge expected, a manifold: vertices {a} and {b} join {faces[edge]}", file=file,
            field="faces", value=f"faces {', '.join(map(str, owner[number.reshape(-1) == edge][:5]))}",
            mend="delete inner or doubled faces, or split the edge",
        )  # fmt: skip


def _oriented(file: Path, half: np.ndarray, owner: np.ndarray, count: int) -> None:
    one, other = _against(half, count)
    if len(one):
        a, b = half[one[0]].tolist()
        raise InputError(
            f"neighbouring triangles facing the same side expected: both run from vertex {a} to {b}", file=file, field="faces",
            value=f"faces {owner[one[0]]} and {owner[other[0]]}",
            mend="recalculate normals, so that all faces look outward, or let `ncs fit` turn them and take what it writes",
        )  # fmt: skip


def _against(half: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of half-edges (N,), (N,) that run the same way along one edge: their triangles face opposite sides."""
    directed = half[:, 0] * count + half[:, 1]
    order = np.argsort(directed, kind="stable")
    twice = np.flatnonzero(np.diff(directed[order]) == 0)
    return order[twice], order[twice + 1]


def oriented(file: Path, x: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (F, 3), turned so that neighbours face the same side, and the numbers of those that were turned.

    A connected component in which all agree stays as it is. Else it faces the side of most of its triangles, or, where less
    than `CLEAR` of them agree, outward: the sum of area times n . (c - middle), c the triangles' centres, is positive. A turned
    triangle (a, b, c) becomes (a, c, b). What is no manifold is left as it is, for `check_surface` to refuse.

    Args:
        file: for errors. x: vertices (V, 3), m.

    Raises:
        InputError: a component has one side only, as a Moebius strip has.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    total, half = len(faces), faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    edge = np.unique(np.sort(half, axis=1), axis=0, return_inverse=True, return_counts=True)
    if total == 0 or edge[2].max() > 2:
        return faces, np.zeros(0, int)
    order = np.argsort(edge[1].reshape(-1), kind="stable")
    first = np.flatnonzero(np.diff(edge[1].reshape(-1)[order]) == 0)
    one, other = order[first], order[first + 1]
    against = half[one, 0] == half[other, 0]
    a, b = one // 3, other // 3
    # every triangle is there twice, as it is and turned: neighbours that face the same side are joined
    joined = np.concatenate([a, a + total]), np.concatenate([b + total * against, b + total * ~against])
    graph = coo_array((np.ones(2 * len(a), bool), joined), shape=(2 * total, 2 * total))
    own, turned = np.split(connected_components(graph, directed=False)[1], 2)
    same = np.flatnonzero(own == turned)
    if len(same):
        raise InputError(
            "a surface with two sides expected: one side runs over into the other, as on a Moebius strip", file=file,
            field="faces", value=f"{len(same)} triangles that hang together, the first is face {same[0]}",
            mend="cut it open along a seam where it is twisted, or turn one end",
        )  # fmt: skip
    count = np.bincount(own, minlength=2 * total)
    share = count[own] / (count[own] + count[turned])
    flip = (share < 0.5) | ((share == 0.5) & (own > turned))
    for label in np.unique(np.minimum(own, turned)[(share > 1 - CLEAR) & (share < CLEAR)]):
        part = np.flatnonzero(np.minimum(own, turned) == label)
        corners = x[np.where(flip[part, None], faces[part][:, [0, 2, 1]], faces[part])].astype(np.float64)
        corners -= corners.mean(axis=(0, 1))
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flip[part] ^= np.einsum("ti,ti->", area, corners.mean(axis=1)) < 0
    return np.where(flip[:, None], faces[:, [0, 2, 1]], faces), np.flatnonzero(flip)

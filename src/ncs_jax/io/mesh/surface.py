"""Checks that triangles are an oriented manifold without loose vertices, as cloth must be; its boundary."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["boundary_loops", "check_surface"]


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
    directed = half[:, 0] * count + half[:, 1]
    order = np.argsort(directed, kind="stable")
    twice = np.flatnonzero(np.diff(directed[order]) == 0)
    if len(twice):
        one, other = order[twice[0]], order[twice[0] + 1]
        a, b = half[one].tolist()
        raise InputError(
            f"neighbouring triangles facing the same side expected: both run from vertex {a} to {b}", file=file, field="faces",
            value=f"faces {owner[one]} and {owner[other]}", mend="recalculate normals, so that all faces look outward",
        )  # fmt: skip

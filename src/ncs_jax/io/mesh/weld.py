"""Merging of vertices at one place, for files that store a vertex once for each of its triangles, seams or parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["distinct", "weld"]


def weld(file: Path, x: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which vertices stay (N,), in the file's order, and which of these each vertex (V,) is merged into, 0 to N - 1.

    Vertices within the tolerance (m) of each other are merged into the first of them, and so are chains of such vertices. A
    tolerance of 0 merges vertices at exactly one place.

    Raises:
        InputError: two corners of a triangle would become one.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if tolerance > 0:
        a, b = cKDTree(x).query_pairs(tolerance, output_type="ndarray").T
        _, group = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(len(x), len(x))), directed=False)
        kept, number = distinct(group)
    else:
        kept, number = distinct(x)
    corners = number[faces]
    lost = np.flatnonzero((corners == np.roll(corners, 1, axis=1)).any(axis=1)) if tolerance > 0 else ()
    if len(lost):
        raise InputError(
            "a tolerance smaller than every edge expected, else triangles collapse", file=file, field="garment.weld",
            value=f"{tolerance:g} m, face {lost[0]}", mend="choose a smaller one",
        )  # fmt: skip
    return kept, number


def distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first of all equal rows (N,), in their order, and for each row (V,) the number of its first, 0 to N - 1."""
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return first[order], rank[number.reshape(-1)]

"""Vertices at one place made one, for files that store a vertex once for each of its triangles, seams or parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["weld"]


def weld(file: Path, x: np.ndarray, faces: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices stay (N,), in the file's order, and which of them each vertex (V,) becomes, 0 to N - 1.

    Vertices within the tolerance (m) of each other become the first of them, at its place, and so does a chain of such
    vertices; with 0, those at exactly one place.

    Raises:
        InputError: two corners of a triangle would become one.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if tolerance > 0:
        a, b = cKDTree(x).query_pairs(tolerance, output_type="ndarray").T
        _, group = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(len(x), len(x))), directed=False)
    else:
        _, group = np.unique(x, axis=0, return_inverse=True)
    _, first, number = np.unique(group.reshape(-1), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    number = rank[number.reshape(-1)]
    corners = number[faces]
    lost = np.flatnonzero((corners == np.roll(corners, 1, axis=1)).any(axis=1)) if tolerance > 0 else ()
    if len(lost):
        raise InputError(
            "a tolerance smaller than every edge expected: it would close triangles", file=file, field="garment.weld",
            value=f"{tolerance:g} m, face {lost[0]}", mend="choose a smaller one",
        )  # fmt: skip
    return first[order], number

"""What a garment surrounds."""

from __future__ import annotations

import numpy as np

__all__ = ["ENCLOSED", "enclosure"]

ENCLOSED = 0.25  # of a full turn: what a garment surrounds by so much at rest is within it, however far the garment stands off


def enclosure(x: np.ndarray, garment: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return by how much a garment surrounds each point (points,): the absolute winding number of its vertices' area vectors,

        w(x) = | sum_v (x_v - x) . a_v / (4 pi |x_v - x|^3) |,    a_v = sum of a third of the area vectors of v's triangles.

    It is near 1 in a closed surface, 0 far outside, and some half in an opening. Good to a hundredth where points are farther
    from the garment than its edges are long (`test_enclosure_is_the_winding_number_away_from_the_cloth`). Source: Barill et al.
    2018, the first term of their expansion.
    """
    a, b, c = (np.asarray(garment, np.float32)[faces[:, k]] for k in range(3))
    area = np.zeros(garment.shape, np.float32)
    np.add.at(area, faces, (np.cross(b - a, c - a) / 6)[:, None])
    found = np.zeros(len(x))
    for some in np.array_split(np.arange(len(x)), -(-len(x) * len(garment) // 1_000_000) or 1):
        apart = np.asarray(garment, np.float32) - np.asarray(x, np.float32)[some, None]
        cubed = np.maximum(np.einsum("pvi,pvi->pv", apart, apart), 1e-12) ** 1.5
        found[some] = np.abs(np.sum(np.einsum("pvi,vi->pv", apart, area) / cubed, axis=1)) / (4 * np.pi)
    return found

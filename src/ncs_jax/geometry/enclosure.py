"""What a garment surrounds."""

from __future__ import annotations

import numpy as np

__all__ = ["ENCLOSED", "beside", "enclosure", "facing"]

ENCLOSED = 0.25  # of a full turn: what a garment surrounds by so much at rest is within it, however far the garment stands off


def enclosure(x: np.ndarray, garment: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return by how much a garment surrounds each point (points,): the winding number of its vertices' area vectors,

        w(x) = +- sum_v (x_v - x) . a_v / (4 pi |x_v - x|^3),    a_v = sum of a third of the area vectors of v's triangles,

    + where these face outward, see `facing`. It is near 1 in a closed surface, 0 far outside, some half in an opening, less
    before one, and negative beside a garment whose openings one looks into from behind. Good to a hundredth where points are
    farther from the garment than its edges are long (`test_enclosure_is_the_winding_number_away_from_the_cloth`).
    Source: Barill et al. 2018, the first term of their expansion.
    """
    garment = np.asarray(garment, np.float32)
    area, sign = _areas(garment, faces), facing(garment, faces)
    found = np.zeros(len(x))
    for some in np.array_split(np.arange(len(x)), -(-len(x) * len(garment) // 1_000_000) or 1):
        apart = garment - np.asarray(x, np.float32)[some, None]
        cubed = np.maximum(np.einsum("pvi,pvi->pv", apart, apart), 1e-12) ** 1.5
        found[some] = sign * np.sum(np.einsum("pvi,vi->pv", apart, area) / cubed, axis=1) / (4 * np.pi)
    return found


def beside(x: np.ndarray, garment: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return which points (points,) are beside a garment, as an arm is beside a dress: neither in it nor before an opening.

    There `enclosure` is negative, but near a flat sheet, of which no side is the outer one, it is beyond `-ENCLOSED`.
    """
    within = enclosure(x, garment, faces)
    return (within > -ENCLOSED) & (within < 0)


def facing(garment: np.ndarray, faces: np.ndarray) -> float:
    """Return 1 where the triangles of a garment (V, 3) face outward, -1 where they face inward: the sign of its volume."""
    return 1.0 if np.sum((garment - garment.mean(axis=0)) * _areas(garment, faces)) >= 0 else -1.0


def _areas(garment: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return a third of the area vectors (V, 3) of the triangles around each vertex, m^2."""
    a, b, c = (garment[faces[:, k]] for k in range(3))
    area = np.zeros(garment.shape, garment.dtype)
    np.add.at(area, faces, (np.cross(b - a, c - a) / 6)[:, None])
    return area

"""Polygons cut into triangles that do not fold: fans where they are convex, ears where they are not."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["triangle_corners", "triangulate"]

FOLDED = 0.1  # of the area of a polygon that crosses itself may be folded; more is refused
SLIVER = 0.03  # of its length squared too, for what is so slim that its area says little


def triangulate(file: Path, x: np.ndarray, counts: np.ndarray, corners: np.ndarray, skip: Collection[int] = ()) -> np.ndarray:
    """Cut polygons into triangles (F, 3) int32 of vertices, see `triangle_corners`."""
    return np.asarray(corners)[triangle_corners(file, x, counts, corners, skip)].astype(np.int32)


def triangle_corners(
    file: Path, x: np.ndarray, counts: np.ndarray, corners: np.ndarray, skip: Collection[int] = ()
) -> np.ndarray:
    """Cut polygons into triangles (F, 3) of places in `corners`, in the polygons' order and each facing as its polygon does.

    A polygon is cut by a fan from its first corner, if every triangle of the fan faces as the polygon's normal (Newell's); else
    by one from its second corner; else ear by ear, seen along the normal. A polygon of no area is cut by a fan. Corners that
    repeat the one before are left out, and with them a polygon of fewer than three. One that crosses itself a little, as
    where two corners almost coincide, is cut so that the least area is folded.

    Args:
        file: what an error names. x: (V, 3) vertices. counts: (P,) corners of each polygon. corners: (sum of counts,) vertices
            from 0 to V - 1, polygon after polygon. skip: polygons to leave out.

    Raises:
        InputError: a polygon has fewer than three corners, counts and corners do not fit, or a polygon crosses itself so that
            more than `FOLDED` of its area, or `SLIVER` of its length squared, would be folded.
    """
    counts = np.asarray(counts).reshape(-1)
    if counts.dtype.kind not in "iu" or (counts < 3).any() or counts.sum(dtype=np.float64) != len(corners):
        few = np.flatnonzero(counts < 3)
        raise InputError(
            f"polygons of three corners or more expected, {len(corners)} corners in all", file=file,
            field=f"faces, face {few[0]}" if len(few) else "faces",
            value=f"{counts[few[0]]} corners" if len(few) else f"{counts.sum(dtype=np.float64):.0f} corners",
            mend="delete such faces, or export the mesh again",
        )  # fmt: skip
    kept = np.ones(len(counts), bool)
    kept[[i for i in skip if 0 <= i < len(counts)]] = False
    corners = np.asarray(corners)
    counts, left = _without_repeats(counts, corners)
    kept &= counts > 2
    starts = np.cumsum(counts, dtype=np.int64) - counts
    first = np.cumsum(np.where(kept, counts - 2, 0), dtype=np.int64) - np.where(kept, counts - 2, 0)
    triangles = np.empty((int(np.where(kept, counts - 2, 0).sum()), 3), np.int64)
    for n in np.unique(counts[kept]):
        number = np.flatnonzero(kept & (counts == n))
        polygons = left[starts[number, None] + np.arange(n)]
        triangles[first[number, None] + np.arange(n - 2)] = _equal(file, x, corners, polygons, number)
    return triangles


def _without_repeats(counts: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the counts of polygons, and the places of the corners that are left: in those of four corners or more, no corner
    repeats the one before; the first follows the last.
    """
    stops = np.cumsum(counts, dtype=np.int64)
    before = np.roll(corners, 1)
    before[stops - counts] = corners[stops - 1]
    same = (before == corners) & np.repeat(counts > 3, counts)
    owner = np.repeat(np.arange(len(counts)), counts)
    return counts - np.bincount(owner[same], minlength=len(counts)), np.flatnonzero(~same)


def _equal(file: Path, x: np.ndarray, corners: np.ndarray, polygons: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Cut polygons (P, n) of equally many corners' places into triangles (P, n - 2, 3); their numbers are for an error."""
    n = polygons.shape[1]
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    if n == 3:
        return polygons[:, fan]
    places = x[corners[polygons]]
    with np.errstate(all="ignore"):  # numbers that are not finite are reported later
        places = places - places[:, :1]
        normal = np.cross(places, np.roll(places, -1, axis=1)).sum(axis=1)  # twice the area
        area = np.linalg.norm(normal, axis=1)
        unit = normal / np.where(area > 0, area, 1)[:, None]
        size = np.abs(places).max(axis=(1, 2)) ** 2

    def faces_up(cut: np.ndarray) -> np.ndarray:
        a, b, c = (places[:, cut[:, k]] for k in range(3))
        with np.errstate(all="ignore"):
            return (np.einsum("pti,pi->pt", np.cross(b - a, c - a), unit) > 1e-9 * size[:, None]).all(axis=1)

    turned = (fan + 1) % n
    first = faces_up(fan) | ~(area > 1e-9 * size)
    result = np.where(first[:, None, None], polygons[:, fan], polygons[:, turned])
    for p in np.flatnonzero(~first & ~faces_up(turned)):
        result[p] = polygons[p][_ears(file, places[p], unit[p], int(number[p]))]
    return result


def _ears(file: Path, x: np.ndarray, unit: np.ndarray, number: int) -> np.ndarray:
    """Cut one polygon (n, 3) into triangles (n - 2, 3), the roundest ear first, to avoid slivers."""
    across = np.eye(3)[np.abs(unit).argmin()]
    u = np.cross(across, unit)
    flat = np.stack([x @ u, x @ np.cross(unit, u)], axis=1)
    left, cut = list(range(len(x))), []
    least = 1e-9 * np.abs(x).max() ** 2
    whole, lost = abs(float(_cross(flat, np.roll(flat, -1, axis=0)).sum())), 0.0  # twice the areas: whole, and folded
    most = max(FOLDED * whole, SLIVER * float((np.ptp(flat, axis=0) ** 2).sum()))
    while len(left) > 2:
        a, b, c = (flat[np.roll(left, k)] for k in (1, 0, -1))
        area = _cross(b - a, c - b)
        fat = area / sum(np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a)))
        ears = (
            k
            for k in np.argsort(-fat, kind="stable").tolist()
            if area[k] > least and not _holds(a[k], b[k], c[k], flat[[v for v in left if v not in _around(left, k)]])
        )
        line = np.abs(area) <= least  # a corner where the outline goes straight on, or turns back: a spike, which is cut first
        spikes = np.flatnonzero(line & (np.sum((b - a) * (c - b), axis=1) <= 0))
        ear = int(spikes[0]) if len(spikes) else int(area.argmax()) if line.all() else next(ears, None)
        if ear is None:
            ear, folded = _least_folded(flat, left)
            lost += folded
        if lost > most:
            raise InputError(
                "a polygon that does not cross itself expected", file=file, field=f"faces, face {number}",
                value=f"{len(x)} corners", mend="triangulate it where the mesh was made",
            )  # fmt: skip
        cut.append(_around(left, ear))
        del left[ear]
    return np.array(cut)


def _least_folded(flat: np.ndarray, left: list[int]) -> tuple[int, float]:
    """Return the corner to cut where none is an ear, the one that folds the least, and twice the area that it folds.

    Cutting a corner folds its triangle where that faces the other way; the other corners in the triangle fold what they span.
    """
    costs = []
    for k in range(len(left)):
        a, b, c = flat[_around(left, k)]
        rest = [v for i, v in enumerate(left) if i != k]
        after = flat[rest]
        own, others = float(_cross(b - a, c - b)), float(_cross(after, np.roll(after, -1, axis=0)).sum())
        costs.append(max(-own, 0.0) + max(-others, 0.0))
    best = int(np.argmin(costs))
    return best, costs[best]


def _around(left: list[int], k: int) -> list[int]:
    return [left[k - 1], left[k], left[(k + 1) % len(left)]]


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def _holds(a: np.ndarray, b: np.ndarray, c: np.ndarray, points: np.ndarray) -> bool:
    """Tell whether a point lies in the triangle or on its border, but at no corner, where a bridge to a hole may end."""
    points = points[(points != a).any(axis=1) & (points != b).any(axis=1) & (points != c).any(axis=1)]
    inside = (_cross(b - a, points - a) >= 0) & (_cross(c - b, points - b) >= 0) & (_cross(a - c, points - c) >= 0)
    return bool(inside.any())

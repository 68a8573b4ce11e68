"""What lies at every pixel of a picture of triangles: the nearest one, or all of them, one behind the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

__all__ = ["Fragments", "fragments", "rasterise", "sample"]

FRAGMENTS = 30_000_000
"""Most pixels that one picture may touch; a sane garment touches a fiftieth of it."""


class Fragments(NamedTuple):
    """What triangles leave at the pixels of a picture, in the order of the pixels, and there of the depth.

    pixel: row * width + column. face: which triangle. depth: as it was given, float32. Each is (N,).
    """

    pixel: np.ndarray
    face: np.ndarray
    depth: np.ndarray


def fragments(x: np.ndarray, y: np.ndarray, depth: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> Fragments:
    """Return everything that lies at every pixel, hidden or not: what is one behind the other, in this order.

    Args:
        x, y: (V,) in pixels, pixel centres at .5. depth: (V,), affine on the screen. faces: (F, 3), all finite.
        size: width and height in pixels.

    A pixel belongs to every triangle that its centre is in, or nearer to than 1e-4 pixel.
    """
    index, plane, spans = _spanned(x, y, depth, faces, *size)
    parts = list(_values(index, plane, spans, size[0]))
    pixel, face, value = (np.concatenate(part) for part in zip(*parts, strict=True)) if parts else (np.zeros(0, np.int64),) * 3
    if not len(pixel):
        return Fragments(pixel, face, np.zeros(0, np.float32))
    low, span = value.min(), max(float(np.ptp(value)), 1e-12)
    fine = ((value - low) * ((2**32 - 1) / span)).astype(np.uint64)
    order = np.argsort((pixel.astype(np.uint64) << np.uint64(32)) | fine)
    return Fragments(pixel[order], face[order], value[order].astype(np.float32))


def rasterise(
    x: np.ndarray, y: np.ndarray, near: np.ndarray, faces: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest face at every pixel.

    Args:
        x, y: (V,) in pixels, pixel centres at .5. near: (V,), > 0, larger is nearer, affine on the screen (1/z in perspective).
        faces: (F, 3), all finite.

    Returns:
        (height, width) face index, -1 where there is none, and nearness, 0 there.
    """
    index, plane, spans = _spanned(x, y, near, faces, width, height)
    keys = np.zeros(height * width, np.uint64)
    for pixel, face, value in _values(index, plane, spans, width):
        near = np.maximum(value, 1e-12).astype(np.float32)
        key = (near.view(np.uint32).astype(np.uint64) << np.uint64(32)) | (face + 1).astype(np.uint64)
        np.maximum.at(keys, pixel, key)
    nearest = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64) - 1
    nearness = (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)
    return nearest.reshape(height, width), nearness.reshape(height, width)


def _spanned(x, y, value, faces, width, height):
    """Return which faces a picture shows, the plane of the value on each, and the pixels that each covers in each row."""
    fx, fy, fn = x[faces], y[faces], value[faces]
    area = (fx[:, 1] - fx[:, 0]) * (fy[:, 2] - fy[:, 0]) - (fx[:, 2] - fx[:, 0]) * (fy[:, 1] - fy[:, 0])
    low = np.clip(np.ceil(fy.min(1) - 0.5), 0, height)
    rows = np.clip(np.floor(fy.max(1) - 0.5) + 1, 0, height) - low
    across = np.clip(fx.max(1), 0, width) - np.clip(fx.min(1), 0, width)
    seen = (rows > 0) & (across > 0) & (np.abs(area) > 1e-12)
    # A garment that has blown up can fill the picture a thousand times over: its largest triangles are left out.
    cost = np.where(seen, rows * (across + 1), 0)
    order = np.argsort(cost)
    seen[order[np.cumsum(cost[order]) > FRAGMENTS]] = False
    index = np.flatnonzero(seen)
    edges, plane = _edge_functions(fx[index], fy[index], fn[index], area[index])
    return index, plane, _spans(edges, low[index].astype(np.int64), rows[index].astype(np.int64), width)


def _edge_functions(fx, fy, fn, area):
    """Return the edge functions a x + b y + c, positive inside, (a, b, c) each (F, 3), and the plane of nearness."""
    nx, ny = np.roll(fx, -1, 1), np.roll(fy, -1, 1)
    sign = np.sign(area)[:, None]
    a, b = (fy - ny) * sign, (nx - fx) * sign
    c = -(a * fx + b * fy)
    turned = np.roll(fn, -2, 1)  # the corner that faces edge i is i + 2
    return (a, b, c), [(coefficient * turned).sum(1) / np.abs(area) for coefficient in (a, b, c)]


def _spans(edges, low, rows, width):
    """Return the pixels that each triangle covers in each row: triangle, row, first column and how many."""
    a, b, c = edges
    face = np.repeat(np.arange(len(low)), rows)
    row = np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows) + low[face]
    left, right = np.zeros(len(face)), np.full(len(face), width - 1.0)
    middle = row + 0.5
    for i in range(3):
        ai = a[face, i]
        rest = b[face, i] * middle + c[face, i]
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = -rest / ai - 0.5
        # 1e-4 pixel of overlap: neighbours leave no crack between them.
        left = np.where(ai > 0, np.maximum(left, np.ceil(bound - 1e-4)), left)
        right = np.where(ai < 0, np.minimum(right, np.floor(bound + 1e-4)), right)
        right = np.where((ai == 0) & (rest < 0), -1, right)
    count = (right - left + 1).astype(np.int64)
    keep = count > 0
    return face[keep], row[keep], left[keep].astype(np.int64), count[keep]


def _values(index, plane, spans, width):
    """Yield pixels, the faces at them and the value of each there, a run of spans at a time."""
    face, row, left, count = spans
    start = plane[1][face] * (row + 0.5) + plane[2][face]
    ends = np.cumsum(count)
    for first, last in _runs(ends, 2_000_000):
        n = count[first:last]
        span = np.repeat(np.arange(first, last), n)
        column = np.arange(len(span)) - np.repeat(ends[first:last] - n - (ends[first] - n[0]), n) + left[span]
        yield row[span] * width + column, index[face[span]], plane[0][face[span]] * (column + 0.5) + start[span]


def _runs(ends: np.ndarray, size: int) -> Iterator[tuple[int, int]]:
    """Cut spans into runs of about `size` pixels, which bounds the memory."""
    first = 0
    while first < len(ends):
        base = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, base + size)))
        yield first, last
        first = last


def sample(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate a (H, W) image at points in pixels, bilinearly; 0 outside it."""
    height, width = image.shape
    x, y = x - 0.5, y - 0.5
    inside = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    i, j = y.astype(np.int32), x.astype(np.int32)
    u, v = x - j, y - i
    top = image[i, j] * (1 - u) + image[i, j + 1] * u
    low = image[i + 1, j] * (1 - u) + image[i + 1, j + 1] * u
    return np.where(inside, top * (1 - v) + low * v, 0)

"""The depth test: which triangle is nearest at every pixel."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

__all__ = ["rasterise", "sample"]

FRAGMENTS = 30_000_000
"""Most pixels that one picture may touch; a sane garment touches a fiftieth of it."""


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
    fx, fy, fn = x[faces], y[faces], near[faces]
    area = (fx[:, 1] - fx[:, 0]) * (fy[:, 2] - fy[:, 0]) - (fx[:, 2] - fx[:, 0]) * (fy[:, 1] - fy[:, 0])
    low = np.clip(np.ceil(fy.min(1) - 0.5), 0, height)
    rows = np.clip(np.floor(fy.max(1) - 0.5) + 1, 0, height) - low
    across = np.clip(fx.max(1), 0, width) - np.clip(fx.min(1), 0, width)
    seen = (rows > 0) & (across > 0) & (np.abs(area) > 1e-12)
    if not seen.any():
        return np.full((height, width), -1), np.zeros((height, width), np.float32)
    # A garment that has blown up can fill the picture a thousand times over: its largest triangles are left out.
    cost = np.where(seen, rows * (across + 1), 0)
    order = np.argsort(cost)
    seen[order[np.cumsum(cost[order]) > FRAGMENTS]] = False
    index = np.flatnonzero(seen)
    edges, plane = _edge_functions(fx[index], fy[index], fn[index], area[index])
    spans = _spans(edges, low[index].astype(np.int64), rows[index].astype(np.int64), width)
    keys = np.zeros(height * width, np.uint64)
    _keep_nearest(keys, width, index, plane, spans)
    nearest = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64) - 1
    nearness = (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)
    return nearest.reshape(height, width), nearness.reshape(height, width)


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


def _keep_nearest(keys, width, index, plane, spans):
    """Write into every pixel's key the largest of nearness (high bits) and face number plus one (low bits)."""
    face, row, left, count = spans
    start = plane[1][face] * (row + 0.5) + plane[2][face]
    ends = np.cumsum(count)
    for first, last in _runs(ends, 2_000_000):
        n = count[first:last]
        span = np.repeat(np.arange(first, last), n)
        column = np.arange(len(span)) - np.repeat(ends[first:last] - n - (ends[first] - n[0]), n) + left[span]
        value = np.maximum(plane[0][face[span]] * (column + 0.5) + start[span], 1e-12).astype(np.float32)
        key = (value.view(np.uint32).astype(np.uint64) << np.uint64(32)) | (index[face[span]] + 1).astype(np.uint64)
        np.maximum.at(keys, row[span] * width + column, key)


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

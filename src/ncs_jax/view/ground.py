"""The floor of a picture: a faded grid, the sun's shadow, and the darkness where feet touch it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageFilter

from ncs_jax.geometry.depth_buffer import rasterise, sample
from ncs_jax.view.camera import Projection
from ncs_jax.view.lighting import ShadowMap

__all__ = ["Ground", "draw_ground"]


@dataclass(frozen=True)
class Ground:
    """Describe a floor.

    Attributes:
        height: m. centre: (x, z), m. radius: from the centre to where it has faded away, m.
        cell: of its square grid, m; 0 draws none.
    """

    height: float
    centre: Sequence[float] | np.ndarray = (0.0, 0.0)
    radius: float = 1.5
    cell: float = 0.5


class _Pixels(NamedTuple):
    """Hold the pixels that show the floor, each array (N,).

    row, column: of the picture. x, z: of the floor there, m. far: from the floor's centre, in radii.
    size: of what the pixel shows, m.
    """

    row: np.ndarray
    column: np.ndarray
    x: np.ndarray
    z: np.ndarray
    far: np.ndarray
    size: np.ndarray


def draw_ground(
    image: np.ndarray, ground: Ground, projection: Projection, shadows: ShadowMap, vertices: np.ndarray, faces: np.ndarray
) -> None:
    """Draw the floor into a picture (height, width, 3), sRGB in 0..1: vertices and faces are what stands on it."""
    pixels = _floor_pixels(ground, projection)
    if not len(pixels.row):
        return
    fade = (1 - pixels.far**2) ** 2
    lit = shadows.on_ground(np.stack([pixels.x, np.full(len(pixels.x), ground.height), pixels.z], 1))
    touch = _contact_shadow(vertices, faces, ground, pixels.x, pixels.z)
    dark = 1 - (1 - 0.26 * (1 - lit)) * (1 - 0.34 * touch)
    dark = dark * np.clip(1.6 * (1 - pixels.far), 0, 1)
    line = _grid_lines(ground, projection.axes, pixels)
    paper = image[pixels.row, pixels.column] * (1 - 0.16 * (line * fade)[:, None])
    image[pixels.row, pixels.column] = paper * (1 - dark[:, None] * np.array([0.92, 0.97, 1.0]))


def _floor_pixels(ground: Ground, projection: Projection) -> _Pixels:
    """Return the pixels whose ray meets the floor within its radius."""
    axes, distance, focal = projection.axes, projection.distance, projection.focal
    height, width = projection.height, projection.width
    u = (np.arange(width) + 0.5 - width / 2) / focal
    v = (height / 2 - np.arange(height) - 0.5) / focal
    eye = projection.eye
    if projection.perspective:
        direction = axes[2] + v[:, None] * axes[1]  # its height is the same along a row
        slope = direction[:, 1]
    else:
        direction = np.broadcast_to(axes[2], (height, 3))
        slope = np.full(height, axes[2][1])
    rows = np.flatnonzero(slope < -1e-4)
    rise = 0.0 if projection.perspective else v[rows] * distance * axes[1][1]
    t = (ground.height - eye[1] - rise) / slope[rows]
    start = eye + (0.0 if projection.perspective else (v[rows] * distance)[:, None] * axes[1]) + t[:, None] * direction[rows]
    depth = t if projection.perspective else np.full(len(rows), distance)
    wide = depth[:, None] * u[None, :]
    px = start[:, None, 0] + wide * axes[0][0]
    pz = start[:, None, 2] + wide * axes[0][2]
    far = np.hypot(px - ground.centre[0], pz - ground.centre[1]) / ground.radius
    r, c = np.nonzero((far < 1) & (t > 0)[:, None])
    return _Pixels(rows[r], c, px[r, c], pz[r, c], far[r, c], (depth / focal)[r])


def _grid_lines(ground: Ground, axes: np.ndarray, pixels: _Pixels) -> np.ndarray:
    """Return how much of each pixel the grid's lines cover: 5 mm wide, never thinner than a pixel but paler instead."""
    grazing = np.abs(axes[2][1])
    line = np.zeros(len(pixels.x))
    for p, axis in ((pixels.x, 0), (pixels.z, 2)) if ground.cell > 0 else ():
        stretch = np.hypot(axes[0][axis], axes[1][axis] / max(grazing, 0.05))
        foot = np.maximum(pixels.size * stretch, 1e-6)
        off = np.abs((p / ground.cell + 0.5) % 1 - 0.5) * ground.cell
        cover = np.clip((0.0035 + foot - off) / foot, 0, 1) * np.minimum(1, 0.010 / foot)
        line = np.maximum(line, cover)
    return line


def _contact_shadow(vertices, faces, ground, px, pz):
    """Return how much of the sky is hidden close above the floor, (N,) in 0..1, from a height map taken from below."""
    size, reach = 192, 0.30
    used = vertices[np.unique(faces)] if len(faces) else np.zeros((0, 3))
    used = used[used[:, 1] < ground.height + reach]
    if len(used) < 3:
        return np.zeros(len(px))
    low, high = used[:, [0, 2]].min(0) - 0.15, used[:, [0, 2]].max(0) + 0.15
    scale = size / min(max(high[0] - low[0], high[1] - low[1]), 4.0)
    lowest = vertices[faces][:, :, 1].max(1) < ground.height + 3 * reach
    near = np.maximum(10.0 - (vertices[:, 1] - ground.height), 1e-3)
    x, y = (vertices[:, 0] - low[0]) * scale, (vertices[:, 2] - low[1]) * scale
    _, nearness = rasterise(x, y, near, faces[lowest], size, size)
    hidden = np.where(nearness > 0, np.exp(-np.clip(10.0 - nearness, 0, 50) / 0.07), 0)
    soft = Image.fromarray((hidden * 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(float(0.022 * scale)))
    return sample(np.asarray(soft, np.float32) / 255, (px - low[0]) * scale, (pz - low[1]) * scale)

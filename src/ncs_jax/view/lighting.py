"""The light of a picture: the sun with its shadows, a fill, and the sky."""

from __future__ import annotations

import math

import numpy as np
from PIL import Image, ImageFilter

from ncs_jax.geometry.depth_buffer import rasterise, sample

__all__ = ["ShadowMap", "linear", "shade"]


def linear(colour) -> np.ndarray:
    """Return the light of an sRGB colour in 0..1."""
    c = np.asarray(colour, float)
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0) + 0.055) / 1.055) ** 2.4)


def _display(light):
    """Return light as sRGB in 0..1, by a table."""
    return _TABLE[np.clip(light * 4095 + 0.5, 0, 4095).astype(np.int32)]


_STEPS = np.arange(4096) / 4095
_TABLE = np.where(_STEPS <= 0.0031308, 12.92 * _STEPS, 1.055 * _STEPS ** (1 / 2.4) - 0.055).astype(np.float32)


class ShadowMap:
    """A shadow map: what the sun reaches, from one picture of nearness taken along its direction."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, direction: np.ndarray, size: int = 512) -> None:
        """Draw the meshes as the sun sees them; direction points towards the sun, of length one."""
        side = np.cross([0.0, 1.0, 0.0], direction)
        side /= np.linalg.norm(side)
        self.direction = direction
        self.axes = np.stack([side, np.cross(direction, side), direction])
        v = vertices @ self.axes.T
        used = v[np.unique(faces)] if len(faces) else np.zeros((1, 3))
        # Far stray vertices must not cost the rest its resolution.
        low, high = np.quantile(used, 0.002, axis=0) - 0.06, np.quantile(used, 0.998, axis=0) + 0.06
        self.low, self.size = low, size
        self.scale = size / max(high[0] - low[0], high[1] - low[1])
        depth = np.maximum(v[:, 2] - low[2] + 1.0, 1e-3)
        _, self.map = rasterise((v[:, 0] - low[0]) * self.scale, (v[:, 1] - low[1]) * self.scale, depth, faces, size, size)
        blurred = Image.fromarray(((self.map > 0) * 255).astype(np.uint8))
        self.shade = np.asarray(blurred.filter(ImageFilter.GaussianBlur(float(0.02 * self.scale))), np.float32) / 255

    def _project(self, points):
        p = points @ self.axes.T
        return (p[:, 0] - self.low[0]) * self.scale, (p[:, 1] - self.low[1]) * self.scale, p[:, 2] - self.low[2] + 1.0

    def on_ground(self, points: np.ndarray) -> np.ndarray:
        """Return the share of light that reaches (N, 3) points below everything, with soft edges."""
        x, y, _ = self._project(points)
        return 1 - sample(self.shade, x, y)

    def on_surface(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the share of light that reaches (N, 3) points of the drawn surfaces."""
        # Off the surface by about a texel, so that it does not shade itself.
        x, y, depth = self._project(points + normals * (0.004 + 1.0 / self.scale))
        depth = (depth + 0.006).astype(np.float32)
        reach = np.zeros(len(points), np.float32)
        flat, radius = self.map.ravel(), max(1.0, 0.005 * self.scale)
        for k in range(8):  # a spiral of taps, evenly dense
            r, angle = radius * math.sqrt((k + 0.5) / 8), 2.39996 * k
            i = np.clip(y + r * math.sin(angle), 0, self.size - 1).astype(np.int32)
            j = np.clip(x + r * math.cos(angle), 0, self.size - 1).astype(np.int32)
            reach += flat[i * self.size + j] <= depth
        return reach / 8


def shade(position, normal, colour, view, axes, shadows: ShadowMap) -> np.ndarray:
    """Return the sRGB colours (N, 3) of points: a key light with shadows, a fill, a sky, and a sheen at grazing angles.

    Args:
        position, normal, colour, view: (N, 3), the colour as light, the view towards the camera. axes: the camera's.
    """
    dot = lambda direction: normal @ direction  # noqa: E731
    fill = 0.7 * axes[0] - 0.6 * axes[2] + np.array([0.0, 0.15, 0.0])
    fill /= np.linalg.norm(fill)
    facing = dot(shadows.direction)
    lit = np.clip(facing, 0, 1)
    reach = np.zeros(len(lit))
    some = lit > 0
    reach[some] = shadows.on_surface(position[some], normal[some])
    sky = 0.5 + 0.5 * normal[:, 1]
    rim = (1 - np.clip((normal * view).sum(1), 0, 1)) ** 3
    warm, cool, above, below = (
        np.array(c) for c in ((1.0, 0.97, 0.92), (0.86, 0.93, 1.0), (0.93, 0.97, 1.0), (0.78, 0.70, 0.64))
    )
    energy = 0.84 * (lit * reach)[:, None] * warm + 0.15 * np.clip(dot(fill), 0, 1)[:, None] * cool
    energy += 0.31 * (sky[:, None] * above + (1 - sky[:, None]) * below)
    return _display(colour * energy + (0.05 * rim * (0.4 + 0.6 * sky))[:, None] * above)

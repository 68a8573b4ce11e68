"""Where a picture is taken from, and where a point lies in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Camera", "Projection"]


@dataclass(frozen=True)
class Camera:
    """A camera: where a picture is taken from.

    Attributes:
        target: (3,) point in the middle of the picture, m. width, height: what must be in sight around it, m.
        azimuth: degrees, 0 looks from +Z and 90 from +X. elevation: degrees.
        fov: of the height in sight, degrees; 0 is orthographic.
    """

    target: Sequence[float] | np.ndarray
    height: float
    width: float = 0.0
    azimuth: float = 0.0
    elevation: float = 6.0
    fov: float = 18.0

    def axes(self) -> np.ndarray:
        """Return the picture's right, up and forward in the world, as rows (3, 3)."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        back = np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
        right = np.array([math.cos(a), 0.0, -math.sin(a)])
        return np.stack([right, np.cross(back, right), -back])

    def projection(self, width: int, height: int) -> Projection:
        """Return how this camera maps the world into a picture of so many pixels."""
        tall = max(self.height, self.width / (width / height))
        distance = tall / 2 / math.tan(math.radians(self.fov) / 2) if self.fov > 0 else 50.0 * tall
        focal = height / tall * distance
        return Projection(self.axes(), np.asarray(self.target, float), distance, focal, self.fov > 0, width, height)


@dataclass(frozen=True)
class Projection:
    """A projection: how a camera maps the world into a picture.

    Attributes:
        axes: right, up and forward, rows. target: (3,), m. distance: of the camera from the target, m. focal: length in pixels.
        perspective: whether what is farther is smaller. width, height: of the picture in pixels.
    """

    axes: np.ndarray
    target: np.ndarray
    distance: float
    focal: float
    perspective: bool
    width: int
    height: int

    @property
    def eye(self) -> np.ndarray:
        """Return the camera's place (3,), m."""
        return self.target - self.axes[2] * self.distance

    def project(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return x and y in pixels, nearness, and what lies in front of the camera, each (V,).

        Nearness is positive, larger where nearer, and affine on the screen: 1/z in perspective.
        """
        local = (vertices - self.target) @ self.axes.T
        z = self.distance + local[:, 2]
        if self.perspective:
            in_front = z > 0.05 * self.distance
            near = 1 / np.maximum(z, 0.05 * self.distance)
            scale = self.focal * near
        else:
            in_front = z > 0
            near = np.maximum(2 * self.distance - z, 1e-6)
            scale = np.full(len(z), self.focal / self.distance)
        return self.width / 2 + local[:, 0] * scale, self.height / 2 - local[:, 1] * scale, near, in_front

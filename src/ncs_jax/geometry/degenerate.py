"""Triangles too slim to have a normal. NumPy alone, so that readers of files need not import JAX."""

from __future__ import annotations

import numpy as np

__all__ = ["LINE", "relative_heights"]

LINE = 2e-6  # height of a triangle, of its longest edge, up to which it is a line: float32 positions resolve no more


def relative_heights(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the height of each triangle (F,) over its longest edge, as a share of that edge; 0 where all corners coincide."""
    a, b, c = (x[faces[:, k]].astype(np.float64) for k in range(3))
    double = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    return double / np.where(longest > 0, longest, 1)

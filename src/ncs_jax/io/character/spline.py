"""Cubic spans between the keys of an animation."""

from __future__ import annotations

import numpy as np

__all__ = ["hermite"]


def hermite(
    t: np.ndarray, span: np.ndarray, a: np.ndarray, b: np.ndarray, leaving: np.ndarray, arriving: np.ndarray
) -> np.ndarray:
    """Return Hermite's cubic between keys of values a and b, at the share t (0 to 1) of a span (s).

    `leaving` and `arriving` are the slopes at a and at b, per second.
    """
    return (
        (2 * t**3 - 3 * t**2 + 1) * a
        + span * (t**3 - 2 * t**2 + t) * leaving
        + (3 * t**2 - 2 * t**3) * b
        + span * (t**3 - t**2) * arriving
    )

"""Cubic spans between the keys of an animation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

__all__ = ["hermite", "key_rate", "onto_keys"]

ROUNDING = 1e-4  # s by which a time in single precision, or a frame's number over its rate, misses a key


def onto_keys(times: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return times (n,), those at a key but for rounding moved onto it: just before it, a held value would be the last one."""
    near = keys[np.searchsorted((keys[1:] + keys[:-1]) / 2, times)]
    return np.where(np.abs(times - near) < ROUNDING, near, times)


def key_rate(keys: Iterable[np.ndarray]) -> float:
    """Return the frames per second of an animation's keys, s, if there are 10 to 240 a second at a constant rate; else 30."""
    times = np.unique(np.concatenate([np.round(t, 5) for t in keys]))
    if len(times) > 2:
        fps = (len(times) - 1) / (times[-1] - times[0])
        even = np.abs(times - np.linspace(times[0], times[-1], len(times))).max() * fps < 0.01
        if even and 10 <= fps <= 240:
            return float(round(fps)) if abs(fps - round(fps)) < 1e-4 * fps else float(fps)
    return 30.0


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

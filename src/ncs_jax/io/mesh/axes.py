"""Units and axes of a file: to metres and Y up."""

from __future__ import annotations

import numpy as np

__all__ = ["TURNS", "upright"]

# What turns an axis that is up to Y, about a third one that stays; a point, as a row, times it.
TURNS = {
    "x": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "y": np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "z": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def upright(x: np.ndarray, scale: float, up: str) -> np.ndarray:
    """Points (..., 3) of a file with so many metres a unit and that axis up, in metres and Y up; what is so stays as it is."""
    if scale == 1 and up == "y":
        return x
    with np.errstate(over="ignore", invalid="ignore"):  # what gets too large is refused by whoever reads it
        return np.ascontiguousarray(x @ TURNS[up].astype(x.dtype) * x.dtype.type(scale))

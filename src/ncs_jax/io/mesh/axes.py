"""Units and axes of a file: to metres and Y up."""

from __future__ import annotations

import numpy as np

__all__ = ["TURNS", "upright"]

# For each axis that may be up, the rotation that turns it to Y; it multiplies points, as rows, from the right.
TURNS = {
    "x": np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "y": np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "z": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def upright(x: np.ndarray, scale: float, up: str) -> np.ndarray:
    """Return points (..., 3) of a file in metres and Y up, given its metres a unit and its axis that is up."""
    if scale == 1 and up == "y":
        return x
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that get too large are refused by the reader
        return np.ascontiguousarray(x @ TURNS[up].astype(x.dtype) * x.dtype.type(scale))

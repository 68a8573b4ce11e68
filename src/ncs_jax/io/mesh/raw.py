"""A garment's mesh as a file has it, before units, welding and checks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

__all__ = ["RawGarment"]


@dataclass(frozen=True, eq=False)
class RawGarment:
    """What a reader finds in a file; nothing is checked yet.

    Attributes:
        file: the path. vertices: (V, 3) in the file's unit. faces: (F, 3). uv: (F, 3, 2) of corners, (V, 2), or None. unit:
            metres a unit, and up: the axis that is up, as the file says. splits: whether the format stores a vertex once for
            each triangle, texture coordinate or normal. groups: vertex sets by name. weights: (V, J) of the joints
            `joint_names`, or None. notes: what was mended.
    """

    file: Path
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    unit: float = 1.0
    up: str = "y"
    splits: bool = False
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    weights: np.ndarray | None = None
    joint_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

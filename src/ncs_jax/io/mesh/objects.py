"""A moving mesh as the objects that it consists of: of garments that are worn together each is one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["CLOTH", "MovingObject", "objects_of"]

CLOTH = (0.32, 0.47, 0.65), (0.85, 0.73, 0.45), (0.90, 0.47, 0.33)  # colours of objects, in turn


class MovingObject(NamedTuple):
    """A moving mesh: its name and colour, (T, V, 3) and at rest (V, 3) in m, (F, 3), texture coordinates (F, 3, 2) if any."""

    name: str
    colour: tuple[float, ...]
    vertices: np.ndarray
    rest: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None


def objects_of(
    names: Sequence[str], first: Sequence[int], vertices: np.ndarray, rest: np.ndarray, faces: np.ndarray, uv: np.ndarray | None
) -> list[MovingObject]:
    """Return the objects of a mesh whose vertices and triangles are those of one after the other.

    Args:
        names: of the objects. first: the first vertex of each but the first. vertices: (T, V, 3) m. rest: (V, 3) m.
        faces: (F, 3). uv: (F, 3, 2), or None.
    """
    found = []
    for k, (name, low, high) in enumerate(zip(names, (0, *first), (*first, vertices.shape[1]), strict=True)):
        own = (faces[:, 0] >= low) & (faces[:, 0] < high)
        colour, maps = CLOTH[k % len(CLOTH)], None if uv is None else uv[own]
        found.append(MovingObject(name, colour, vertices[:, low:high], rest[low:high], faces[own] - low, maps))
    return found

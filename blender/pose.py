"""Bone matrices of Blender as the package's poses: local rotations since rest, and the root's way. NumPy alone."""

from __future__ import annotations

import numpy as np

UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's Z up to Y up
GIVE = 0.01  # m, and of its size: what a bone may slide and grow
SLIDE = 0.05  # of its length, what a bone may slide besides


class Wrong(Exception):
    """Something that whoever uses the add-on can mend, in a sentence."""


def to_metres(points: np.ndarray, unit: float) -> np.ndarray:
    """Return points (..., 3) of Blender's world in metres with Y up; `unit` is metres for one of its units."""
    return unit * (points @ UP.T)


def from_metres(points: np.ndarray, unit: float) -> np.ndarray:
    """Return points (..., 3) in metres with Y up as Blender's world has them."""
    return points @ UP / unit


class Skeleton:
    """The bones that carry a character, at rest.

    names: (J,), each after its parent. parents: (J,), -1 for the root. rest: (J, 4, 4) bone to Blender's world at rest.
    unit: metres for one of Blender's units.
    """

    def __init__(self, names: list[str], parents: list[int], rest: np.ndarray, unit: float) -> None:
        self.names, self.parents, self.unit = list(names), np.array(parents), float(unit)
        self.rest = np.array(rest, np.float64)
        self.joints = to_metres(self.rest[:, :3, 3], self.unit)
        self._back = np.linalg.inv(self.rest)

    def pose(self, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations (J, 3, 3), along the world's axes at rest, and the root's translation (3,), m, Y up.

        Since rest a bone has turned by G_j = A_j B_j^-1, its matrix (J, 4, 4) now times the inverse of that at rest. Seen from
        its parent that is R_j = G_parent^T G_j.

        Raises:
            Wrong: a bone has grown, is sheared, or has left its place on its parent.
        """
        turned = UP @ (now @ self._back)[:, :3, :3] @ UP.T
        off = np.abs(np.swapaxes(turned, 1, 2) @ turned - np.eye(3)).max(axis=(1, 2))
        if (bad := ~(off < 2 * GIVE)).any():
            bone = self.names[int(np.argmax(bad))]
            raise Wrong(
                f"bone {bone} changes its size in a pose. Cloth follows bones that turn: remove its scale, and Stretch To"
            )
        for _ in range(2):  # to the nearest rotation (Newton-Schulz)
            turned = turned @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(turned, 1, 2) @ turned)
        above, place = self.parents[1:], to_metres(now[:, :3, 3], self.unit)
        bones = self.joints[1:] - self.joints[above]
        slid = np.linalg.norm(place[1:] - place[above] - np.einsum("jab,jb->ja", turned[above], bones), axis=1)
        most = np.maximum(GIVE, SLIDE * np.linalg.norm(bones, axis=1))
        if (slid > most).any():
            j = int(np.argmax(slid / most))
            raise Wrong(f"bone {self.names[j + 1]} leaves its place by {slid[j]:.2f} m. Cloth follows bones that turn")
        local = turned.copy()
        local[1:] = np.swapaxes(turned[above], 1, 2) @ turned[1:]
        return local, place[0] - self.joints[0]

    def facts(self) -> dict:
        """Return all of it as JSON has it."""
        return {"names": self.names, "parents": self.parents.tolist(), "rest": self.rest.tolist(), "unit": self.unit}


def between(first: tuple, last: tuple, steps: int) -> list[tuple]:
    """Return the poses of `steps` frames after the first, the last among them, evenly turned and moved."""
    out = []
    for k in range(1, steps):
        s = k / steps
        left, _, right = np.linalg.svd((1 - s) * first[0] + s * last[0])
        turns = left @ right
        if (np.linalg.det(turns) < 0).any():  # half a turn within the gap: nothing tells which way
            return [*out, *[last] * (steps - k + 1)]
        out.append((turns, (1 - s) * first[1] + s * last[1]))
    return [*out, last]

"""Which way a character faces: by how its trunk lies, and not by its outline, which a long stride turns aside."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ncs_jax.io.records import BodyRecord
from ncs_jax.prepare.joint_names import Limbs, anatomy
from ncs_jax.prepare.retarget import body_names, called
from ncs_jax.prepare.skeleton import body_axes

__all__ = ["heading", "trunk_axes", "up_of"]


def trunk_axes(body: BodyRecord, turns: np.ndarray) -> np.ndarray:
    """Return matrices (frames, 3, 3) whose columns point left, up and ahead of a character: the mean of hips to chest.

        sum over hips and spine of R_j A,   A: the axes at rest

    A body whose joints have no names is turned by its root, and at rest it faces +Z.

    Args:
        body: the character. turns: world rotations since rest (frames, joints, 3, 3).
    """
    names = called(body_names(body), body.bones)
    of = anatomy(names, body.parents.tolist(), body.joints) if names else Limbs({"hips": 0}, (), ())
    return turns[:, [of.roles["hips"], *of.spine]].mean(axis=1) @ body_axes(body.joints, of)


def heading(axes: np.ndarray) -> float:
    """Return how far a character is turned about +Y, its up, from +Z towards +X, degrees: the nearest to its axes (3, 3).

    Who bends over keeps a heading; who stands on the head has none, and any is returned.
    """
    return math.degrees(math.atan2(axes[0, 2] - axes[2, 0], axes[0, 0] + axes[2, 2]))


def up_of(gravity: Sequence[float]) -> tuple[float, float, float]:
    """Return the direction opposite to gravity, as three numbers; without gravity Y."""
    x, y, z = (-float(g) for g in gravity)
    return (x, y, z) if x or y or z else (0.0, 1.0, 0.0)

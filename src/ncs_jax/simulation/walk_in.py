"""The way of a body from rest, where the garment lies on it, into the pose in which a simulation begins."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.geometry.skinning import Skeleton, forward, transforms
from ncs_jax.scene.model import Model

__all__ = ["FALL", "SETTLE", "walk_in"]

ANGLE = 0.1  # rad: the farthest that a joint turns between two poses
FALL = 20  # iterations at rest, in which the garment falls onto the body,
SETTLE = 4  # and in each pose after that


def walk_in(model: Model, matrices: Float[Array, "joints 3 4"]) -> Float[Array, "poses joints 3 4"]:
    """Return the poses from rest up to the given one, and without it, for a garment to follow in a few iterations each.

    Skinning alone presses cloth together under an arm that is let down, and the equilibrium next to it stands as a wide bell:
    the packaged dress at 1.83 J. Cloth that follows the arm falls in folds: 1.78 J, as it does over a second of motion.

    The root stays where the pose has it. Every other joint turns from its rest evenly, about one axis, relative to its parent;
    no pose is `ANGLE` from the next one. There are none where nothing turns; none on a moving mesh, whose rest is its first
    frame; and none over other garments: where these are in such poses is not known.
    """
    from scipy.spatial.transform import Rotation

    if model.under or model.body_blend is None:
        return matrices[None][:0]
    skeleton = model.skeleton
    world, parents = np.asarray(matrices, np.float64)[..., :3], np.asarray(skeleton.parents)
    child = parents >= 0
    local = np.where(child[:, None, None], np.swapaxes(world[parents], 1, 2) @ world, world)
    turn = Rotation.from_matrix(local).as_rotvec()
    count = int(np.ceil(np.linalg.norm(turn[child], axis=1).max(initial=0) / ANGLE - 0.1))
    shares = np.where(child[:, None], np.arange(max(count, 0))[:, None, None] / max(count, 1), 1)
    rotations = Rotation.from_rotvec((shares * turn).reshape(-1, 3)).as_matrix().reshape(-1, len(parents), 3, 3)
    root, rest = np.argmin(parents), np.asarray(skeleton.joints, np.float64)
    moved = world[root] @ rest[root] + np.asarray(matrices, np.float64)[root, :, 3] - rest[root]
    dtype = np.dtype(matrices.dtype)
    return _moved(skeleton, rotations.astype(dtype), np.tile(moved.astype(dtype), (len(rotations), 1)))


@jax.jit
def _moved(skeleton: Skeleton, rotations: Array, translation: Array) -> Array:
    return transforms(skeleton, forward(skeleton, rotations, translation))

"""A character posed on the host, in float64: for preparations and checks, which are done once and compile nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ncs_jax.geometry.skinning import Blend, Correctives
from ncs_jax.io.records import BodyRecord

__all__ = ["carried", "corrected_rest", "joint_places", "joint_transforms", "skinned", "world_axes", "world_turns"]


def world_axes(poses: np.ndarray, rest_rotations: np.ndarray | None) -> np.ndarray:
    """Return local rotations since rest along the world's axes (frames, joints, 3, 3) of axis-angle poses.

    Args:
        poses: (frames, joints, 3) in each joint's own axes, `rest_rotations` (joints, 3, 3); None: they are the world's.
    """
    from scipy.spatial.transform import Rotation

    local = Rotation.from_rotvec(poses.reshape(-1, 3).astype(np.float64)).as_matrix().reshape(*poses.shape, 3)
    return local if rest_rotations is None else rest_rotations @ local @ np.swapaxes(rest_rotations, -1, -2)


def world_turns(local: np.ndarray, parents: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return world rotations since rest (frames, joints, 3, 3) of local ones along the world's axes: R_j = R_parent R_local."""
    turns = local.copy()
    for j, parent in enumerate(parents):  # parents come first
        if parent >= 0:
            turns[:, j] = turns[:, parent] @ turns[:, j]
    return turns


def joint_places(turns: np.ndarray, joints: np.ndarray, parents: Sequence[int] | np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return places (frames, joints, 3) by world rotations, p_j = p_parent + R_parent (J_j - J_parent), from the root's."""
    places = np.zeros(turns.shape[:3])
    for j, parent in enumerate(parents):
        if parent < 0:
            places[:, j] = root
        else:
            places[:, j] = places[:, parent] + turns[:, parent] @ (joints[j] - joints[parent]).astype(np.float64)
    return places


def joint_transforms(body: BodyRecord, poses: np.ndarray) -> np.ndarray:
    """Return the rigid motion [R_j | t_j] (frames, joints, 3, 4) of every joint from rest to pose, its root in place."""
    turns, joints = world_turns(world_axes(poses, body.rest_rotations), body.parents), body.joints.astype(np.float64)
    places = joint_places(turns, joints, body.parents, joints[0])
    shift = places - np.einsum("tjab,jb->tja", turns, joints)
    return np.concatenate([turns, shift[..., None]], axis=-1)


def carried(rest: np.ndarray, weights: Blend, transforms: np.ndarray) -> np.ndarray:
    """Return vertices (verts, 3), m, in one pose, by linear blend skinning of those at rest; transforms (joints, 3, 4)."""
    return skinned(rest, np.asarray(weights.weights, np.float64), transforms[list(weights.joints)])


def skinned(rest: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Return points (verts, 3) that joints carry from rest, x = sum_j w_j M_j (x0, 1); weights (verts, joints)."""
    blended = (weights @ transforms.reshape(-1, 12)).reshape(-1, 3, 4)
    return np.einsum("vab,vb->va", blended[:, :, :3], rest) + blended[:, :, 3]


def corrected_rest(
    rest: np.ndarray, correctives: Correctives | None, transforms: np.ndarray, parents: Sequence[int] | np.ndarray
) -> np.ndarray:
    """Return vertices at rest (verts, 3), m, as one pose corrects them: `skinning.corrected`; transforms (joints, 3, 4)."""
    if correctives is None or not correctives.joints:
        return rest
    joints = np.array(correctives.joints)
    turns, above = transforms[joints, :, :3], transforms[np.asarray(parents)[joints], :, :3]
    entries = (np.swapaxes(above, -1, -2) @ turns - np.eye(3)).ravel()
    return rest + np.asarray(correctives.directions, np.float64) @ entries

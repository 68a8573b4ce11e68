"""Skeletons, forward kinematics and linear blend skinning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = [
    "Blend",
    "Correctives",
    "Pose",
    "Skeleton",
    "blend",
    "blend_from",
    "corrected",
    "correctives_from",
    "forward",
    "skin",
    "to_rest_axes",
    "transforms",
    "unpose",
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Skeleton:
    """Rest joints (joints, 3) in m; `parents` is a static tuple with parents[j] < j and -1 at the root."""

    joints: Float[Array, "joints 3"]
    parents: tuple[int, ...] = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pose:
    """The joints in a frame of motion: world rotations since rest, and world positions in m."""

    rotations: Float[Array, "*frames joints 3 3"]
    positions: Float[Array, "*frames joints 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Blend:
    """Skinning weights, sparse by column: only the joints that move some vertex are kept; rows sum to 1.

    The blend is then one small matrix product. On a CPU that is ten times faster over a batch than gathering each vertex's own
    few joints, because their 12 numbers each do not stay in registers.
    """

    weights: Float[Array, "verts used"]
    joints: tuple[int, ...] = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Correctives:
    """Pose correctives of SMPL: how a vertex moves before skinning, m, by each entry of R_j - I of some joints, row by row."""

    directions: Float[Array, "verts 3 entries"]
    joints: tuple[int, ...] = field(metadata={"static": True})


def to_rest_axes(
    rotations: Float[Array, "*frames joints 3 3"], rest_rotations: Float[Array, "joints 3 3"]
) -> Float[Array, "*frames joints 3 3"]:
    """Return local rotations along the world's axes, Q_j R_j Q_j^T, of those in each joint's own rest frame Q_j (Mixamo, glTF).

    A skeleton without rest rotations (SMPL) does not need it.
    """
    return jnp.einsum("jab,...jbc,jdc->...jad", rest_rotations, rotations, rest_rotations, precision="highest")


def forward(skeleton: Skeleton, rotations: Float[Array, "*frames joints 3 3"], translation: Float[Array, "*frames 3"]) -> Pose:
    """Compute forward kinematics: R_j = R_parent R_local, p_j = p_parent + R_parent (J_j - J_parent).

    Args:
        skeleton: rest joints and parents. rotations: local rotations since rest. translation: (..., 3) of the root, m.

    Returns:
        World rotations and joint positions; joints of one depth are computed at once.
    """
    parents = np.asarray(skeleton.parents)
    depth = np.zeros(len(parents), int)
    for j, parent in enumerate(parents):
        depth[j] = depth[parent] + 1 if parent >= 0 else 0
    order = np.argsort(depth, kind="stable")
    place = np.argsort(order)
    roots = order[depth[order] == 0]
    world = rotations[..., roots, :, :]
    position = jnp.broadcast_to(skeleton.joints[roots], (*world.shape[:-2], 3)) + translation[..., None, :]
    for level in range(1, int(depth.max(initial=0)) + 1):
        here = order[depth[order] == level]
        above = place[parents[here]]
        turns = world[..., above, :, :]
        bone = skeleton.joints[here] - skeleton.joints[parents[here]]
        offset = jnp.einsum("...jab,jb->...ja", turns, bone, precision="highest")
        position = jnp.concatenate([position, position[..., above, :] + offset], axis=-2)
        world = jnp.concatenate([world, jnp.matmul(turns, rotations[..., here, :, :], precision="highest")], axis=-3)
    return Pose(world[..., place, :, :], position[..., place, :])


def transforms(skeleton: Skeleton, pose: Pose) -> Float[Array, "*frames joints 3 4"]:
    """Return the rigid motion [R_j | p_j - R_j J_j] of every joint from rest to pose."""
    shift = pose.positions - jnp.einsum("...jab,jb->...ja", pose.rotations, skeleton.joints, precision="highest")
    return jnp.concatenate([pose.rotations, shift[..., None]], axis=-1)


def blend_from(dense: np.ndarray, most: int = 8, dtype=jnp.float32) -> Blend:
    """Keep the `most` largest weights of every row of a dense (verts, joints) table, and the columns that are left."""
    dense = np.asarray(dense, np.float64)
    if dense.shape[1] > most:
        kth = np.partition(dense, -most, axis=1)[:, -most, None]
        dense = np.where(dense >= kth, dense, 0)
    dense = dense / dense.sum(axis=1, keepdims=True)
    used = np.flatnonzero(dense.max(axis=0) > 1e-4)
    kept = dense[:, used]
    return Blend(jax.device_put((kept / kept.sum(axis=1, keepdims=True)).astype(dtype)), tuple(int(j) for j in used))


def blend(matrices: Float[Array, "joints 3 4 *poses"], weights: Blend) -> Float[Array, "verts 3 4 *poses"]:
    """Return the blended transform of every vertex, sum_j w_vj [R_j | t_j], in any number of poses."""
    used = matrices[np.asarray(weights.joints)]
    blended = jnp.matmul(weights.weights, used.reshape(used.shape[0], -1), precision="highest")
    return blended.reshape(-1, *matrices.shape[1:])


def skin(transforms: Float[Array, "verts 3 4 *poses"], x: Float[Array, "verts 3 *#poses"]) -> Float[Array, "verts 3 *poses"]:
    """Pose positions by linear blend skinning, from unposed ones, m."""
    return sum((transforms[:, :, i] * x[:, i, None] for i in range(3)), start=transforms[:, :, 3])


def correctives_from(posedirs: np.ndarray, number: Mapping[int, int] | None = None, dtype=jnp.float32) -> Correctives:
    """Return pose correctives without the joints that move no vertex by more than a nanometre.

    Args:
        posedirs: (verts, 3, 9 (joints - 1)) m, as in a body, of some of its vertices. number: of the body's joints in the
            skeleton; None: it has them all.
    """
    verts = len(posedirs)
    by_joint = np.asarray(posedirs).reshape(verts, 3, -1, 9)
    moving = np.flatnonzero(np.abs(by_joint).max(axis=(0, 1, 3), initial=0) > 1e-9)
    joints = tuple(int(j) + 1 if number is None else number[int(j) + 1] for j in moving)
    return Correctives(jax.device_put(by_joint[:, :, moving].reshape(verts, 3, -1).astype(dtype)), joints)


def corrected(
    x: Float[Array, "verts 3 *#poses"],
    correctives: Correctives | None,
    matrices: Float[Array, "joints 3 4 *poses"],
    parents: Sequence[int],
) -> Float[Array, "verts 3 *#poses"]:
    """Return unposed positions as a pose corrects them, m: x + P vec(R_j - I) (Loper et al. 2015, (9)); x where P is None.

    R_j = R_parent^T R_world are the local rotations in the joints' transforms, in any number of poses.
    """
    if correctives is None or not correctives.joints:
        return x
    joints = np.asarray(correctives.joints)
    own, above = matrices[joints, :, :3], matrices[np.asarray(parents)[joints], :, :3]
    local = [above[:, c, :, None] * own[:, c, None, :] for c in range(3)]
    eye = jnp.eye(3, dtype=x.dtype).reshape(1, 3, 3, *(1,) * (matrices.ndim - 3))
    entries = (local[0] + local[1] + local[2] - eye).reshape(9 * len(joints), -1)
    directions = correctives.directions
    moved = jnp.matmul(directions.reshape(-1, directions.shape[2]), entries, precision="highest")
    return x + moved.reshape(*directions.shape[:2], *matrices.shape[3:])


def unpose(transforms: Float[Array, "verts 3 4"], x: Float[Array, "verts 3"]) -> Float[Array, "verts 3"]:
    """Return the inverse of `skin`, by the adjugate; zeros where it is singular: opposite rotations cancel in the blend."""
    a, b, c = transforms[..., 0], transforms[..., 1], transforms[..., 2]
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-2)
    determinant = jnp.sum(a * jnp.cross(b, c), axis=-1)
    singular = jnp.abs(determinant) < 1e-6
    solution = jnp.sum(rows * (x - transforms[..., 3])[:, None, :], axis=-1)
    return jnp.where(singular[:, None], 0, solution / jnp.where(singular, 1, determinant)[:, None])

"""Everything about a scene that does not change while it runs: the character, the garment on it, and what they are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.collision import Surface, closest_weights, nearest_triangle, surface_from, vertex_normals
from ncs_jax.kinematics import Blend, Skeleton, blend, forward, skin, to_rest_axes, transforms
from ncs_jax.objective import Garment, Material, Terms
from ncs_jax.rotations import axis_angle_to_matrix

__all__ = [
    "Model",
    "Vibrations",
    "local_rotations",
    "pose_body",
    "posed_bodies",
    "smooth_weights",
    "touchable",
    "transfer_weights",
    "used_joints",
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Vibrations:
    """Movements of a garment about its drape, in unposed space: see `vibration.softest`.

    directions: displacements (verts, 3, modes), m. energy: twice what moving by one of them takes, the same for all, J.
    """

    directions: Float[Array, "verts 3 modes"]
    energy: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Layer:
    """A garment worn below, which collides as a part of the body: what animates it."""

    model: Model
    params: dict
    network: Any = field(metadata={"static": True})

    @property
    def rest(self) -> Float[Array, "verts 3"]:
        """Its place at rest, m."""
        return self.model.garment.mesh.rest


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """Constants of a scene. The skeleton holds only the joints that matter, the `source_joints` of the motion's.

    `inputs` are the joints that the network reads, the root first. `body` and its `surface` are the part of the body that the
    garment can touch, `None` in a scene without a body or without collision. To the surface also belong the garments `under`
    this one, after the body: each of their vertices goes by a transform of its own, which a track has after those of the
    joints.
    """

    skeleton: Skeleton
    rest_rotations: Float[Array, "joints 3 3"] | None
    garment: Garment
    blend: Blend
    material: Material
    basis: Float[Array, "verts modes"]  # smooth modes that the decoder works with, m
    body: Float[Array, "body 3"] | None
    body_blend: Blend | None
    surface: Surface | None
    terms: Terms = field(metadata={"static": True})
    inputs: tuple[int, ...] = field(metadata={"static": True})
    source_joints: tuple[int, ...] = field(metadata={"static": True})
    descriptor: str = field(metadata={"static": True})
    fps: float = field(metadata={"static": True})
    moves: bool = field(default=True, metadata={"static": True})  # False: nothing dynamic is traced
    vibrations: Vibrations | None = None  # where the network swings along them
    under: tuple[Layer, ...] = ()  # garments worn below this one


def pose_body(model: Model, matrices: Float[Array, "joints 3 4 *poses"]) -> Float[Array, "body 3 *poses"]:
    """The touchable body in one frame or several, and the garments under this one, m."""
    lanes = (1,) * (matrices.ndim - 3)
    body = skin(blend(matrices, model.body_blend), model.body.reshape(model.body.shape + lanes))
    if not model.under:
        return body
    rest = jnp.concatenate([layer.rest for layer in model.under])
    return jnp.concatenate([body, rest.reshape(rest.shape + lanes) + matrices[len(model.skeleton.parents) :, :, 3]])


def posed_bodies(model: Model, matrices: Float[Array, "frames joints 3 4"], lanes: int) -> Float[Array, "frames body 6"]:
    """Positions in m and normals of the touchable body in many frames, `lanes` of them at a time."""
    frames = len(matrices)
    at = np.minimum(np.arange(-(-frames // lanes) * lanes), frames - 1).reshape(-1, lanes)

    def some(matrices):
        body = pose_body(model, jnp.moveaxis(matrices, 0, -1))
        return jnp.concatenate([body, vertex_normals(body, model.surface)], axis=1)

    blocks = lax.map(some, matrices[at])
    return jnp.moveaxis(blocks, -1, 1).reshape(-1, *blocks.shape[1:3])[:frames]


def transfer_weights(garment: np.ndarray, body: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Skinning weights (verts, joints) of each garment vertex, interpolated at the nearest point of the body's **surface**."""
    surface = surface_from(garment, body, faces)

    @jax.jit
    def nearest(x, body, surface):
        index, _ = nearest_triangle(x, body, surface)
        return index, closest_weights(x, body[surface.faces[index]])

    x, points = jnp.asarray(garment, jnp.float32), jnp.asarray(body, jnp.float32)
    index, barycentric = nearest(x, points, surface)
    return np.einsum("vk,vkj->vj", np.asarray(barycentric, np.float64), np.asarray(weights)[faces[np.asarray(index)]])


def smooth_weights(weights: np.ndarray, edges: np.ndarray, times: int) -> np.ndarray:
    """Replace each vertex's weights by the mean of its neighbours', `times` times over."""
    from scipy.sparse import coo_matrix, diags

    verts = len(weights)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    neighbours = coo_matrix((np.ones(len(i)), (i, j)), shape=(verts, verts)).tocsr()
    degree = np.asarray(neighbours.sum(axis=1)).ravel()
    mean = diags(1 / np.maximum(degree, 1)) @ neighbours + diags((degree == 0).astype(float))
    for _ in range(times):
        weights = mean @ weights
    return weights / weights.sum(axis=1, keepdims=True)


def touchable(
    skeleton: Skeleton,
    garment: np.ndarray,
    garment_blend: Blend,
    body: np.ndarray,
    body_blend: Blend,
    rotations: Sequence[np.ndarray],
    reach: float,
) -> np.ndarray:
    """Which body vertices come within `reach` (m) of the skinned rest garment in any of the given poses; (body,) bool.

    `rotations` are local ones, (joints, 3, 3) each; the rest pose is always looked at.
    """
    from scipy.spatial import cKDTree

    @jax.jit
    def posed(local):
        m = transforms(skeleton, forward(skeleton, local, jnp.zeros(3, local.dtype)))
        return skin(blend(m, garment_blend), jnp.asarray(garment, local.dtype)), skin(
            blend(m, body_blend), jnp.asarray(body, local.dtype)
        )

    near = np.zeros(len(body), bool)
    rest = np.broadcast_to(np.eye(3), (len(skeleton.parents), 3, 3))
    dtype = skeleton.joints.dtype
    for local in [rest, *rotations]:
        cloth, skin_ = posed(jnp.asarray(local, dtype))
        distance, _ = cKDTree(np.asarray(cloth)).query(np.asarray(skin_), distance_upper_bound=reach)
        near |= np.isfinite(distance)
    return near


def used_joints(parents: Sequence[int], weights: np.ndarray, least: float = 0.01) -> tuple[int, ...]:
    """The joints whose weight reaches `least` on some vertex of (verts, joints), with all their ancestors, in order."""
    wanted = set(np.flatnonzero(np.asarray(weights).max(axis=0, initial=0) >= least).tolist())
    for j in list(wanted):
        while (j := int(parents[j])) >= 0:
            wanted.add(j)
    return tuple(sorted(wanted | {list(parents).index(-1)}))


@jax.jit
def local_rotations(model: Model, poses: Float[Array, "*frames all 3"]) -> Float[Array, "*frames joints 3 3"]:
    """Local rotation matrices, along the world's axes at rest, of the joints that matter, from axis-angle poses of all."""
    local = axis_angle_to_matrix(poses[..., np.asarray(model.source_joints), :])
    return local if model.rest_rotations is None else to_rest_axes(local, model.rest_rotations)

"""The part of the body that a garment can touch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.energies.contact.surface import Surface, surface_from
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import (
    Blend,
    Correctives,
    Skeleton,
    blend,
    blend_from,
    corrected,
    correctives_from,
    forward,
    skin,
    transforms,
)
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Layer, Model, pose_body, pose_rest

__all__ = ["Skinned", "covered_by_layers", "surface_of", "touchable", "touchable_faces", "touchable_part"]


class Skinned(NamedTuple):
    """Vertices at rest (verts, 3), m, with what poses them."""

    rest: np.ndarray
    blend: Blend
    correctives: Correctives | None = None


def touchable(skeleton: Skeleton, garment: Skinned, body: Skinned, rotations: Sequence[np.ndarray], reach: float) -> np.ndarray:
    """Return which body vertices (body,) come within `reach` (m) of the skinned rest garment in any of the given poses.

    `rotations` holds the local rotations (joints, 3, 3) of every pose. The rest pose is always checked too.
    """
    from scipy.spatial import cKDTree

    near = np.zeros(len(body.rest), bool)
    rest = np.broadcast_to(np.eye(3), (len(skeleton.parents), 3, 3))
    dtype = skeleton.joints.dtype
    worn = [(jnp.asarray(w.rest, dtype), w.blend, w.correctives) for w in (garment, body)]
    for local in [rest, *rotations]:
        cloth, skin_ = map(np.asarray, _posed(skeleton, worn, jnp.asarray(local, dtype)))
        distance, _ = cKDTree(cloth).query(skin_, distance_upper_bound=reach)
        near |= np.isfinite(distance)
    return near


@jax.jit
def _posed(skeleton: Skeleton, worn, local) -> list[jax.Array]:
    """Return vertices (m) posed by local rotations, of all at rest with their skinning weights and pose correctives."""
    m = transforms(skeleton, forward(skeleton, local, jnp.zeros(3, local.dtype)))
    return [skin(blend(m, weights), corrected(rest, more, m, skeleton.parents)) for rest, weights, more in worn]


COVER = 0.06  # m; a garment below covers the skin that is nearer to it,
RIM = 0.1  # m; but none that is nearer to its rim


def touchable_faces(model: Model, body: io.BodyRecord, part: np.ndarray) -> np.ndarray:
    """Return the triangles of the touchable part of the body and of the garments below, all facing outward."""
    from scipy.spatial import cKDTree

    faces, count = [_submesh(body.faces, part, len(body.vertices))], len(part)
    for layer in model.under:
        own, rest = np.asarray(layer.model.garment.mesh.faces), np.asarray(layer.rest)
        _, near = cKDTree(body.vertices).query(rest)
        outward = np.sum(vertex_normals(rest, own) * vertex_normals(body.vertices, body.faces)[near])
        faces.append(count + (own if outward >= 0 else own[:, ::-1]))
        count += len(rest)
    return np.concatenate(faces)


def covered_by_layers(body: io.BodyRecord, under: tuple[Layer, ...]) -> np.ndarray:
    """Return which body vertices (body,) a garment below covers: its nearest point is in front of them and not at its rim.

    The garment above does not touch these vertices, because there is cloth between. If they stayed, the skin would hold it off
    where it has passed through that cloth.
    """
    from scipy.spatial import cKDTree

    hidden, normals = np.zeros(len(body.vertices), bool), vertex_normals(body.vertices, body.faces)
    for layer in under:
        rest, faces = np.asarray(layer.rest), np.asarray(layer.model.garment.mesh.faces)
        away, near = cKDTree(rest).query(body.vertices)
        gap = rest[near] - body.vertices
        rim = rest[np.concatenate([*boundary_loops(faces), np.zeros(0, int)]).astype(int)]
        inner = np.ones(len(body.vertices), bool) if not len(rim) else cKDTree(rim).query(body.vertices)[0] > RIM
        hidden |= (away < COVER) & inner & (np.sum(gap * normals, axis=1) > 0.5 * away)
    return hidden


def surface_of(model: Model, faces, track: MotionFeatures | None, smooth: bool, samples: int = 8) -> Surface:
    """Return the touchable body as a surface, with its search prepared for what comes near in some poses of the motion."""
    poses = []
    if track is not None:
        frames = np.unique(np.linspace(0, len(track.start) - 1, samples).astype(int))
        poses = list(zip(*map(np.asarray, _worn(model, track.matrices[frames])), strict=True))
    rest, body = np.asarray(model.garment.mesh.rest), np.concatenate([model.body, *(layer.rest for layer in model.under)])
    return surface_from(rest, body, faces, smooth=smooth, posed=poses)


@jax.jit
def _worn(model: Model, matrices) -> tuple[jax.Array, jax.Array]:
    """Return the rest garment, skinned, and the body in several frames, m."""
    return jax.vmap(lambda m: (pose_rest(model, m), pose_body(model, m)))(matrices)


def touchable_part(scene, body, garment, weights, records) -> np.ndarray:
    """Return the numbers of the body vertices that the garment can touch in the scene's motions."""
    if scene.body.part == "all":
        return np.arange(len(body.vertices))
    skeleton = Skeleton(jnp.asarray(body.joints, jnp.float32), tuple(int(p) for p in body.parents))
    poses = np.concatenate([r.poses for r in records]) if records else np.zeros((0, len(body.parents), 3), np.float32)
    some = poses[np.unique(np.linspace(0, len(poses) - 1, min(len(poses), 60)).astype(int))] if len(poses) else poses
    local = np.asarray(jax.jit(axis_angle_to_matrix)(jnp.asarray(some)))
    if body.rest_rotations is not None:
        local = body.rest_rotations @ local @ np.swapaxes(body.rest_rotations, -1, -2)
    # A point of a triangle is at most its longest edge / sqrt(3) from a corner.
    corners = body.vertices[body.faces]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()
    more = None if body.posedirs is None else correctives_from(body.posedirs)
    near = touchable(
        skeleton,
        Skinned(garment.vertices, blend_from(weights)),
        Skinned(body.vertices, blend_from(body.weights), more),
        list(local),
        scene.physics.collision.reach + edge / np.sqrt(3),
    )
    return np.unique(body.faces[near[body.faces].any(axis=1)])


def _submesh(faces: np.ndarray, kept: np.ndarray, verts: int) -> np.ndarray:
    """Return the triangles of the kept vertices, which are numbered anew."""
    number = np.full(verts, -1)
    number[kept] = np.arange(len(kept))
    inside = number[faces]
    return inside[(inside >= 0).all(axis=1)]

"""A garment's skinning weights from those of the body, and the joints that they use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ncs_jax.geometry.mesh import adjacency
from ncs_jax.geometry.surface_distance import closest_on_surface
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.records import BodyRecord, GarmentRecord

__all__ = ["smooth_weights", "transfer_weights", "used_joints", "with_body_weights"]


def transfer_weights(garment: np.ndarray, body: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return a garment's skinning weights (verts, joints): the body's, interpolated at the nearest point of its **surface**."""
    nearest = closest_on_surface(garment, body, faces)
    return np.einsum("vk,vkj->vj", nearest.weights, np.asarray(weights)[faces[nearest.face]])


def smooth_weights(weights: np.ndarray, edges: np.ndarray, times: int) -> np.ndarray:
    """Replace each vertex's weights by the mean of its neighbours' weights, `times` times."""
    from scipy.sparse import diags_array

    neighbours = adjacency(edges, len(weights))
    degree = np.asarray(neighbours.sum(axis=1)).ravel()
    mean = diags_array(1 / np.maximum(degree, 1)) @ neighbours + diags_array((degree == 0).astype(float))
    for _ in range(times):
        weights = mean @ weights
    return weights / weights.sum(axis=1, keepdims=True)


def used_joints(parents: Sequence[int], weights: np.ndarray, least: float = 0.01) -> tuple[int, ...]:
    """Return the joints whose weight (verts, joints) reaches `least` on some vertex, and all joints above them, in order."""
    wanted = np.flatnonzero(np.asarray(weights).max(axis=0, initial=0) >= least).tolist()
    return tuple(sorted({list(parents).index(-1)}.union(*(path_to_root(parents, j) for j in wanted))))


def with_body_weights(garment: GarmentRecord, body: BodyRecord) -> GarmentRecord:
    """Return a garment whose own skinning weights, if any, are for the body's joints, found by name.

    A garment that was skinned to joints that the body does not have loses its weights; a note says so.
    """
    if garment.weights is None or not garment.joint_names:
        return garment
    used = np.flatnonzero(garment.weights.max(axis=0) > 0)
    place = {name: j for j, name in enumerate(body.joint_names)}
    missing = [garment.joint_names[j] for j in used if garment.joint_names[j] not in place]
    if missing:
        note = f"the garment's own skinning weights are not used: the body has no joint {missing[0]}"
        return replace(garment, weights=None, joint_names=(), notes=(*garment.notes, note))
    weights = np.zeros((len(garment.vertices), len(body.parents)), garment.weights.dtype)
    weights[:, [place[garment.joint_names[j]] for j in used]] = garment.weights[:, used]
    return replace(garment, weights=weights, joint_names=())

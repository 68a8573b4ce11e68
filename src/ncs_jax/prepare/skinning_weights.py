"""A garment's skinning weights from those of the body, cloth that hangs free about limbs, and the joints that they use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ncs_jax.geometry.enclosure import ENCLOSED, enclosure
from ncs_jax.geometry.mesh import adjacency
from ncs_jax.geometry.surface_distance import closest_on_surface
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.records import BodyRecord, GarmentRecord

__all__ = ["hung_weights", "smooth_weights", "transfer_weights", "used_joints", "with_body_weights"]

NEAR, FREE = 0.05, 0.15  # m; cloth that is nearer to the skin that it surrounds follows it as it lies; farther, it hangs free
REACH, STEP = 2.0, 0.05  # times the nearest distance, and m; see `hung_weights`


def transfer_weights(garment: np.ndarray, body: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return a garment's skinning weights (verts, joints): the body's, interpolated at the nearest point of its **surface**."""
    nearest = closest_on_surface(garment, body, faces)
    return np.einsum("vk,vkj->vj", nearest.weights, np.asarray(weights)[faces[nearest.face]])


def hung_weights(garment: GarmentRecord, body: BodyRecord, weights: np.ndarray) -> np.ndarray:
    """Return skinning weights (verts, joints) by which cloth that hangs free about limbs goes where the limbs go.

        w(x) = (1 - h) w_lying + h int w_body(p) f(x, p) dA / int f(x, p) dA,
        f = max(n . r, 0) / |r|^3 max(1 - |r|^2 / (REACH d)^2, 0) s(r_y / STEP),    r = x - p,

    over the skin that the garment surrounds (`enclosure`). Each joint counts by the solid angle that its skin takes of what the
    cloth sees; of the skin above it, as cloth hangs from that (s falls from 1 to 0 where the skin is `STEP` above to `STEP`
    below); and of the skin that is not much farther than the nearest, d. h rises from 0 to 1 where the cloth is `NEAR` to
    `FREE` away from the skin. So a raised thigh takes its side of a wide skirt along, and a bent knee hardly does. By the hips
    alone the thigh would pass through the skirt, and no collision brings it back: cloth on either side of a limb is outside of
    it. `weights`: w_lying (verts, joints), returned as they are where nothing hangs free.
    """
    from scipy.spatial import cKDTree

    x, faces = np.asarray(garment.vertices, np.float64), garment.faces
    if cKDTree(body.vertices).query(x)[0].max(initial=0) <= NEAR:
        return weights
    within = np.abs(enclosure(body.vertices, x, faces)) > ENCLOSED
    inner = body.faces[within[body.faces].all(axis=1)]
    if not len(inner):
        return weights
    hangs = _smooth_step((np.linalg.norm(closest_on_surface(x, body.vertices, inner).gap, axis=1) - NEAR) / (FREE - NEAR))
    free = np.flatnonzero(hangs)
    corners = np.asarray(body.vertices, np.float64)[inner]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2  # times the area
    centre, of_face = corners.mean(axis=1), np.asarray(body.weights, np.float64)[inner].mean(axis=1)
    result = np.array(weights, np.float64)
    for some in np.array_split(free, -(-len(free) * len(inner) // 1_000_000) or 1):
        apart = x[some, None] - centre
        square = np.einsum("vfi,vfi->vf", apart, apart)
        seen = np.maximum(np.einsum("vfi,fi->vf", apart, normal), 0) * _smooth_step((1 - apart[..., 1] / STEP) / 2)
        nearest = np.where(seen > 0, square, np.inf).min(axis=1, keepdims=True)
        seen *= np.maximum(1 - square / (REACH**2 * nearest), 0) / square**1.5
        total = seen.sum(axis=1, keepdims=True)
        mean = np.where(total > 0, seen @ of_face / np.where(total > 0, total, 1), result[some])
        result[some] += hangs[some, None] * (mean - result[some])
    return result


def _smooth_step(t: np.ndarray) -> np.ndarray:
    """Return 0 below 0, 1 above 1, and between them 3 t^2 - 2 t^3."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


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

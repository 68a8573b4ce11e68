"""Into how many pieces contact cuts the triangles of a garment, so that none sinks into the body's curves between points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ncs_jax import io
from ncs_jax.geometry.skinning import blend_from, correctives_from
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.prepare.posing import carried, corrected_rest, joint_transforms

__all__ = ["FINEST", "SPARE", "bent_most", "pieces_of", "posed_skins", "sags"]

FINEST = 2  # pieces that an edge is cut into, at most
SPARE = 0.75  # of the thickness: what cloth may sink between points of contact
RING = (0.7, 1.5)  # how far from a vertex of the body its curve is looked at, in circumradii of a triangle
MANY = 0.9  # of the skin near a triangle curves no more than it is ready for
QUANTILE = 0.75  # of what a ring falls: its axis' direction falls nothing, and across it everything


def sags(skin: np.ndarray, faces: np.ndarray, edge: float) -> np.ndarray:
    """Return how deep a flat triangle lies in the skin under its middle when its corners are on it, at each vertex (V,), m.

        s = L^2 / (6 R),   in the place of 1/R what the skin falls from the tangent plane around: -2 n . (x_j - x) / |x_j - x|^2

    Seen at the triangle's own scale, a facet, a pore, or a finger that it is too wide to lie on does not count.

    Args:
        skin: (V, 3), m, with its faces (F, 3). edge: L, of the triangle, m.
    """
    from scipy.spatial import cKDTree

    radius, normals = edge / np.sqrt(3), vertex_normals(skin, faces)
    pairs = cKDTree(skin).query_pairs(RING[1] * radius, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    gap = skin[j] - skin[i]
    square = np.sum(gap * gap, axis=1)
    kept = (square > (RING[0] * radius) ** 2) & (np.sum(normals[i] * normals[j], axis=1) > 0)
    i, gap, square = i[kept], gap[kept], square[kept]
    falls = -np.sum(normals[i] * gap, axis=1) * radius**2 / np.where(square > 0, square, 1)
    order = np.lexsort((falls, i))
    at, first, count = np.unique(i[order], return_index=True, return_counts=True)
    found = np.zeros(len(skin))
    found[at] = np.maximum(falls[order][first + (QUANTILE * (count - 1)).astype(int)], 0)
    return found


def pieces_of(
    x: np.ndarray, faces: np.ndarray, skins: Sequence[np.ndarray], skin_faces: np.ndarray, thickness: float
) -> np.ndarray:
    """Return into how many pieces contact cuts the edges of each triangle (F,): as few as leave thickness, `FINEST` at most.

        n = ceil(sqrt(s / (`SPARE` eps))),   as a triangle cut into n^2 sinks by s / n^2

    s is the largest of `sags`, in any of the poses, of the skin that a triangle may come to lie on: within the triangle's size
    of what is nearest to it, and, as cloth that stands off may move, within that distance more.

    Args:
        x: (V, 3), faces (F, 3): the garment at rest, m. skins: (B, 3) the body at rest, then in other poses, m, with its faces.
        thickness: eps, m.
    """
    from scipy.spatial import cKDTree

    corners = np.asarray(x, np.float64)[faces]
    edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1).max(axis=1)
    usual = float(np.mean(edges))
    sunk = np.max([sags(np.asarray(skin, np.float64), skin_faces, usual) for skin in skins], axis=0)
    tree, centres = cKDTree(skins[0]), corners.mean(axis=1)
    away, _ = tree.query(centres)
    near = tree.query_ball_point(centres, away + edges)
    deepest = np.array([np.quantile(sunk[some], MANY) if some else 0.0 for some in near]) * (edges / usual) ** 2
    return np.clip(np.ceil(np.sqrt(deepest / (SPARE * thickness))), 1, FINEST).astype(np.int8)


def bent_most(poses: np.ndarray) -> np.ndarray:
    """Return those of axis-angle poses (frames, joints, 3) in which some joint is bent the most."""
    angles = np.linalg.norm(poses, axis=2)
    return poses[np.unique(angles[:, angles.any(axis=0)].argmax(axis=0))] if angles.any() else poses[:1]


def posed_skins(body: io.BodyRecord, part: np.ndarray, poses: np.ndarray) -> list[np.ndarray]:
    """Return a part of the body, vertices `part`, at rest and in axis-angle poses (frames, joints, 3): (V, 3) each, m."""
    blend, more = blend_from(body.weights[part]), None if body.posedirs is None else correctives_from(body.posedirs[part])
    skin = body.vertices[part]
    return [skin] + [
        carried(corrected_rest(skin, more, transforms, body.parents), blend, transforms)
        for transforms in joint_transforms(body, poses)
    ]

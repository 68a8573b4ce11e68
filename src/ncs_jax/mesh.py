"""What a triangle mesh fixes once: edges, hinges, areas, rest frames and lumped masses."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ncs_jax.numerics import normalize, signed_angle

__all__ = ["Mesh", "dihedral", "material_axes", "mesh_from", "topology", "vertex_rings"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mesh:
    """A garment's rest state. Lengths in m, areas in m^2, angles in rad; elements of zero rest area weigh nothing.

    A hinge is an edge between two faces: its vertices are the two ends, then the one opposite in each face.
    """

    rest: Float[Array, "verts 3"]
    faces: Int[Array, "faces 3"]
    edges: Int[Array, "edges 2"]
    hinges: Int[Array, "hinges 4"]
    face_area: Float[Array, "faces"]
    face_axes: Float[Array, "faces 2 2"]  # inverse of the rest edges (e1, e2) in the face's material axes (u, v), 1/m
    vertex_area: Float[Array, "verts"]  # a third of the adjacent faces
    edge_length: Float[Array, "edges"]
    edge_weight: Float[Array, "edges"]  # 1 inside an equilateral mesh, 1/2 on its border
    hinge_angle: Float[Array, "hinges"]
    hinge_length: Float[Array, "hinges"]
    hinge_area: Float[Array, "hinges 2"]


def dihedral(x: Float[Array, "*hinges 4 3"], areas: Float[Array, "*hinges 2"]) -> Float[Array, "*hinges"]:
    """Signed angle phi in (-pi, pi] between the two faces of a hinge; 0 where flat, opposite for mirrored folds.

        phi = atan2((n0 x n1) . e, n0 . n1)

    `x` holds the two ends of the edge and the vertex opposite in each face; the normals n0, n1 are taken per rest area
    `areas` (m^2) so that products of them stay near 1 in float32, also in second derivatives. Exactly folded or collapsed
    hinges have finite derivatives; a face of zero area gives angle 0.
    """
    a, b, c, d = jnp.moveaxis(x, -2, 0)
    edge = b - a
    n0 = jnp.cross(edge, c - a) / (2 * areas[..., 0, None])
    n1 = jnp.cross(d - a, edge) / (2 * areas[..., 1, None])
    sine = jnp.sum(jnp.cross(n0, n1) * normalize(edge), axis=-1)
    return signed_angle(sine, jnp.sum(n0 * n1, axis=-1))


def topology(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (edges, 2), the faces on each side (edges, 2; -1 where there is none) and hinges (hinges, 4) of a manifold mesh."""
    faces = np.asarray(faces)
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    owner = np.tile(np.arange(len(faces)), 3)
    keys, first, inverse, counts = np.unique(
        np.sort(half, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    if counts.size and counts.max() > 2:
        worst = keys[counts.argmax()]
        raise ValueError(f"edge {worst.tolist()} has {counts.max()} faces; a manifold mesh has at most two")
    inverse = inverse.reshape(-1)
    second = np.full(len(keys), -1)
    rest = np.ones(len(half), bool)
    rest[first] = False
    second[inverse[rest]] = np.flatnonzero(rest)
    sides = np.stack([owner[first], np.where(second >= 0, owner[second], -1)], axis=1)
    inner = second >= 0
    hinges = np.concatenate([half[first[inner]], opposite[first[inner], None], opposite[second[inner], None]], axis=1)
    return half[first].astype(np.int32), sides.astype(np.int32), hinges.astype(np.int32)


def material_axes(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None, warp: tuple[float, float, float] = (0, 1, 0)
) -> np.ndarray:
    """Unit warp direction u of every face (faces, 3), in its plane.

    From the UV map where there is one (the direction of growing v, the usual grain line), else the projection of `warp`;
    where a face is nearly square to `warp`, that of the next axis is blended in, so neighbouring faces stay aligned.
    """
    p = np.asarray(vertices, np.float64)[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    normal = np.cross(e1, e2)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)

    def in_plane(d):
        return d - normal * np.sum(normal * d, axis=1, keepdims=True)

    first = np.asarray(warp, np.float64) / np.linalg.norm(warp)
    squareness = np.sum(normal * first, axis=1, keepdims=True) ** 2
    axis = in_plane(np.broadcast_to(first, normal.shape)) + squareness**8 * in_plane(
        np.broadcast_to(np.roll(first, 1), normal.shape)
    )
    if uv is not None:
        q = np.asarray(uv, np.float64)[faces]
        d1, d2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
        det = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
        mapped = (d1[:, :1] * e2 - d2[:, :1] * e1) * np.sign(det)[:, None]
        axis = np.where((np.abs(det) > 1e-12)[:, None], mapped, axis)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    edge = e1 / np.maximum(np.linalg.norm(e1, axis=1, keepdims=True), 1e-300)
    return np.where(length > 1e-9, axis / np.maximum(length, 1e-300), edge)


def mesh_from(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    uv: np.ndarray | None = None,
    warp: tuple[float, float, float] = (0, 1, 0),
    dtype=jnp.float32,
) -> Mesh:
    """Precompute a garment mesh in float64 and store it in `dtype`.

    Args:
        vertices: (verts, 3) rest positions in m. faces: (faces, 3) vertex indices of a manifold mesh.
        uv: (verts, 2) texture coordinates, whose v direction is the warp. warp: the warp direction where there is no UV map.
        dtype: jnp.float32 or jnp.float64.

    Raises:
        ValueError: an edge has more than two faces, or an index is out of range.
    """
    x, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    if faces.size and (faces.min() < 0 or faces.max() >= len(x)):
        raise ValueError(f"faces name vertices {faces.min()} to {faces.max()}, the mesh has {len(x)}")
    edges, sides, hinges = topology(faces)
    p = x[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    normal = np.cross(e1, e2)
    area = np.linalg.norm(normal, axis=1) / 2
    u = material_axes(x, faces, uv, warp)
    v = np.cross(normal / np.maximum(2 * area, 1e-300)[:, None], u)
    shape = np.stack([[np.sum(a * b, axis=1) for b in (e1, e2)] for a in (u, v)]).transpose(2, 0, 1)
    good = area > 1e-12 * np.maximum(np.sum(e1 * e1 + e2 * e2, axis=1), 1e-300)
    axes = np.linalg.inv(np.where(good[:, None, None], shape, np.eye(2))) * good[:, None, None]
    area = area * good
    vertex_area = np.bincount(faces.reshape(-1), np.repeat(area / 3, 3), minlength=len(x))
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    edge_area = area[sides[:, 0]] + np.where(sides[:, 1] >= 0, area[sides[:, 1]], 0)
    weight = 2 / np.sqrt(3) * edge_area / np.where(length > 0, length, 1) ** 2 * (length > 0)
    inner = sides[:, 1] >= 0
    h = x[hinges]
    hinge_area = area[sides[inner]]
    with jax.enable_x64(True):
        angle = np.asarray(jax.jit(dihedral)(jnp.asarray(h), jnp.asarray(np.where(hinge_area > 0, hinge_area, 1.0))))
    array = lambda a: jnp.asarray(a, dtype)  # noqa: E731
    return Mesh(
        rest=array(x),
        faces=jnp.asarray(faces),
        edges=jnp.asarray(edges),
        hinges=jnp.asarray(hinges),
        face_area=array(area),
        face_axes=array(axes),
        vertex_area=array(vertex_area),
        edge_length=array(length),
        edge_weight=array(weight),
        hinge_angle=array(angle),
        hinge_length=array(length[inner]),
        hinge_area=array(hinge_area),
    )


def vertex_rings(faces: np.ndarray, verts: int) -> np.ndarray:
    """Faces around each vertex (verts, most), padded with len(faces): gathering over it replaces a scatter."""
    owner = np.asarray(faces).reshape(-1)
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=verts)
    table = np.full((verts, max(int(counts.max(initial=0)), 1)), len(faces), np.int32)
    slot = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    table[owner[order], slot] = order // 3
    return table

"""Triangle meshes at rest: edges, hinges, areas, rest frames and lumped areas, computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ncs_jax.geometry.numerics import least_length, norm
from ncs_jax.geometry.soa_vectors import Vector, cross, dot, length, minus, plus, times

__all__ = [
    "LINE",
    "Mesh",
    "Rings",
    "adjacency",
    "corners",
    "dihedral",
    "edge_strain",
    "gathered",
    "material_axes",
    "mesh_from",
    "relative_heights",
    "spread",
    "topology",
    "vertex_rings",
    "with_middles",
]

LINE = 2e-6  # rest height of a face, of its longest edge, up to which it is a line: float32 positions resolve no more


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rings:
    """Which elements meet at each vertex, face and hinge of a whole mesh, so that forces are gathered without a scatter.

    `faces` and `edges` list where a vertex occurs in them: `corner * elements + element`, padded with `corners * elements`.
    `folds` are the hinges opposite the three corners of every face, padded with the number of hinges; `turned` is -1 where the
    face is oriented opposite to what the hinge assumes. `sides` are the two faces of a hinge; `behind` is -1 where the second
    is oriented so.
    """

    faces: Int[Array, "verts most_faces"]
    edges: Int[Array, "verts most_edges"]
    folds: Int[Array, "faces 3"]
    turned: Float[Array, "faces 3"]
    sides: Int[Array, "hinges 2"]
    behind: Float[Array, "hinges"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mesh:
    """A garment's rest state. Lengths in m, areas in m^2, angles in rad; elements of zero rest area weigh nothing.

    A face has zero rest area if its height is at most `LINE` times its longest edge.

    A hinge is an edge between two faces: its vertices are the two ends, then the opposite vertex of each face.
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
    rings: Rings | None = None  # None in a part of a mesh


def corners(x: Float[Array, "verts 3 *poses"], elements: Int[Array, "elements corners"]) -> list[Vector]:
    """Return the positions of every element's first corner, second corner and so on, by component (elements, *poses)."""
    return [[p[:, i] for i in range(3)] for p in (x[elements[:, k]] for k in range(elements.shape[1]))]


def gathered(told: Sequence[Vector], ring: Int[Array, "verts most"]) -> Float[Array, "verts 3 *poses"]:
    """Return the sum at every vertex of what elements tell their corners, as `corners` has them; ring: as those of `Rings`."""
    rows = jnp.stack([jnp.stack(corner, axis=1) for corner in told])
    rows = rows.reshape(-1, *rows.shape[2:])
    start = jnp.zeros((len(ring), *rows.shape[1:]), rows.dtype)
    return sum((jnp.take(rows, at, axis=0, mode="fill", fill_value=0) for at in ring.T), start=start)


def spread(constant: Float[Array, "elements"], like: Float[Array, "elements *poses"]) -> Float[Array, "elements ..."]:
    """Return an element's constant with trailing axes of size 1, so that it broadcasts over all poses."""
    return constant.reshape(constant.shape + (1,) * (like.ndim - constant.ndim))


def _normals(hinge: Sequence[Vector], areas: Sequence[Array]):
    a, b, c, d = hinge
    edge = minus(b, a)
    return times(0.5 / areas[0], cross(edge, minus(c, a))), times(0.5 / areas[1], cross(minus(d, a), edge)), edge


@jax.custom_jvp
def dihedral(hinge: Sequence[Vector], areas: Sequence[Array]) -> Array:
    """Return the signed angle phi in (-pi, pi] between the two faces of a hinge: 0 where flat, opposite for mirrored folds.

        phi = atan2((n0 x n1) . e / |e|, n0 . n1),   dphi/dx_c = -|e| / (2 A0) n0 / |n0|^2,   likewise d,
        dphi/dx_a = -(1 - t_c) dphi/dx_c - (1 - t_d) dphi/dx_d,   dphi/dx_b = -t_c dphi/dx_c - t_d dphi/dx_d,
        t_c, t_d: where the heights of the two faces meet the edge, 0 at a and 1 at b

    `hinge` holds the two ends a, b of the edge and the opposite vertex of each face, c, d, see `corners`. The normals n0, n1
    are divided by the rest areas `areas` (m^2), so that their products stay near 1 in float32, also in second derivatives.
    Exactly folded or collapsed hinges have finite derivatives. A face of zero area gives angle 0.
    """
    n0, n1, edge = _normals(hinge, areas)
    long = length(edge)
    return jnp.arctan2(dot(cross(n0, n1), edge) / jnp.where(long > 0, long, 1), dot(n0, n1))


@dihedral.defjvp
def _dihedral_jvp(primals, tangents):
    hinge, areas = primals
    n0, n1, edge = _normals(hinge, areas)
    long = length(edge)
    unit = times(1 / jnp.where(long > 0, long, 1), edge)

    def outward(normal, area):
        size = dot(normal, normal)
        solid = size > least_length(size.dtype)
        return times(jnp.where(solid, -0.5 * long / (area * jnp.where(solid, size, 1)), 0), normal)

    def along(corner):
        return dot(minus(corner, hinge[0]), unit) / jnp.where(long > 0, long, 1)

    c, d = outward(n0, areas[0]), outward(n1, areas[1])
    s, t = along(hinge[2]), along(hinge[3])
    a = plus(times(s - 1, c), times(t - 1, d))
    b = plus(times(-s, c), times(-t, d))
    change = sum(dot(slope, moved) for slope, moved in zip((a, b, c, d), tangents[0], strict=True))
    return dihedral(hinge, areas), change


def topology(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return edges (edges, 2), the faces on their sides (edges, 2; -1: none) and hinges (hinges, 4) of a manifold mesh."""
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
    """Return the unit warp direction u of every face (faces, 3), in its plane.

    It comes from the UV map where there is one: the direction of growing v, the usual grain line. Else it is the projection of
    `warp`; where a face is nearly perpendicular to `warp`, the projection of the next axis is blended in, so that neighbouring
    faces stay aligned.
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
        q = np.asarray(uv, np.float64) if np.ndim(uv) == 3 else np.asarray(uv, np.float64)[faces]
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
    """Compute the rest state of a garment in float64 and store it in `dtype`.

    Args:
        vertices: (verts, 3) rest positions in m. faces: (faces, 3) vertex indices of a manifold mesh.
        uv: (faces, 3, 2) texture coordinates of corners, or (verts, 2) of vertices, whose v direction is the warp.
        warp: the warp direction where there is no UV map.
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
    good = relative_heights(x, faces) > LINE
    area = np.linalg.norm(normal, axis=1) / 2
    u = material_axes(x, faces, uv, warp)
    v = np.cross(normal / np.maximum(2 * area, 1e-300)[:, None], u)
    shape = np.stack([[np.sum(a * b, axis=1) for b in (e1, e2)] for a in (u, v)]).transpose(2, 0, 1)
    axes = np.linalg.inv(np.where(good[:, None, None], shape, np.eye(2))) * good[:, None, None]
    area = area * good
    vertex_area = np.bincount(faces.reshape(-1), np.repeat(area / 3, 3), minlength=len(x))
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    edge_area = area[sides[:, 0]] + np.where(sides[:, 1] >= 0, area[sides[:, 1]], 0)
    weight = 2 / np.sqrt(3) * edge_area / np.where(length > 0, length, 1) ** 2 * (length > 0)
    inner = sides[:, 1] >= 0
    hinge_area = area[sides[inner]]
    with jax.enable_x64(True):
        angle = np.asarray(_rest_angles(jnp.asarray(x), hinges, jnp.asarray(np.where(hinge_area > 0, hinge_area, 1.0))))
    array = lambda a: jax.device_put(np.asarray(a, dtype))  # noqa: E731, without a program for every shape
    return Mesh(
        rest=array(x),
        faces=jax.device_put(faces),
        edges=jax.device_put(edges),
        hinges=jax.device_put(hinges),
        face_area=array(area),
        face_axes=array(axes),
        vertex_area=array(vertex_area),
        edge_length=array(length),
        edge_weight=array(weight),
        hinge_angle=array(angle),
        hinge_length=array(length[inner]),
        hinge_area=array(hinge_area),
        rings=_rings(faces, edges, hinges, sides[inner], len(x), dtype),
    )


@jax.jit
def _rest_angles(x, hinges, areas):
    return dihedral(corners(x, hinges), [areas[:, 0], areas[:, 1]])


def _rings(faces, edges, hinges, sides, verts: int, dtype) -> Rings:
    folds, turned = np.full(faces.shape, len(hinges), np.int32), np.ones(faces.shape)
    each = np.arange(len(hinges))
    for side in (0, 1):
        around = faces[sides[:, side]]
        corner = np.argmax(around == hinges[:, 2 + side, None], axis=1)
        folds[sides[:, side], corner] = each
        after = around[each, (corner + 1) % 3]
        turned[sides[:, side], corner] = np.where(after == hinges[:, side], 1, -1)
    return Rings(
        jax.device_put(_places(faces, verts)),
        jax.device_put(_places(edges, verts)),
        jax.device_put(folds),
        jax.device_put(turned.astype(dtype)),
        jax.device_put(sides.astype(np.int32)),
        jax.device_put(turned[sides[:, 1], corner].astype(dtype)),
    )


def _places(elements: np.ndarray, verts: int) -> np.ndarray:
    """Return where each vertex occurs in the elements, as in `Rings`."""
    owner = elements.T.reshape(-1)
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=verts)
    table = np.full((verts, max(int(counts.max(initial=0)), 1)), len(owner), np.int32)
    slot = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    table[owner[order], slot] = order
    return table


def vertex_rings(faces: np.ndarray, verts: int) -> np.ndarray:
    """Return the faces around each vertex (verts, most), padded with len(faces): a gather over them replaces a scatter."""
    places = _places(np.asarray(faces), verts)
    return np.where(places < 3 * len(faces), places % max(len(faces), 1), len(faces)).astype(np.int32)


def relative_heights(x: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the height of each triangle (F,) over its longest edge, as a share of that edge; 0 where all corners coincide."""
    a, b, c = (x[faces[:, k]].astype(np.float64) for k in range(3))
    double = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    return double / np.where(longest > 0, longest, 1)


def edge_strain(x: Float[Array, "verts 3"], mesh: Mesh) -> Float[Array, "edges"]:
    """Return |l/l0 - 1| of every edge."""
    lengths = norm(x[mesh.edges[:, 1]] - x[mesh.edges[:, 0]])
    return jnp.abs(lengths / jnp.where(mesh.edge_length > 0, mesh.edge_length, 1) - 1)


def adjacency(edges: np.ndarray, verts: int):
    """Return the sparse symmetric matrix (verts, verts) that is 1 where an edge of (edges, 2) joins two vertices."""
    from scipy.sparse import coo_array

    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    return coo_array((np.ones(len(i)), (i, j)), shape=(verts, verts)).tocsr()


def with_middles(x, *elements):
    """Return vertices (verts, 3), then the middles of edges (edges, 2), of faces, m: of arrays of NumPy or of JAX."""
    numbers = jnp if isinstance(x, jax.Array) else np
    return numbers.concatenate([x, *(x[corners].mean(axis=1) for corners in elements)])

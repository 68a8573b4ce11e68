"""Points between the vertices of a garment at which contact also looks, each carried by the corners of its triangle."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = ["MOST", "ContactPoints", "contact_points", "on_vertices", "with_points"]

MOST = 4  # pieces that an edge is cut into, at most
WHOLE = 12  # in which every number of pieces is contained


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ContactPoints:
    """Points of a garment's triangles, beside its vertices, and what each of both counts in contact.

        x_p = sum_k w_pk x_k,   k the corners of p's triangle

    weights: w, which add up to 1; zero for the corner across from an edge that holds the point. shares: of the vertices, then
    of the points, in vertices: they add up to the number of vertices, see `contact_points`.
    """

    corners: Int[Array, "points 3"]
    weights: Float[Array, "points 3"]
    shares: Float[Array, "all"]


def contact_points(faces: np.ndarray, area: np.ndarray, pieces: np.ndarray, verts: int) -> ContactPoints | None:
    """Return the points that cut every edge of a triangle into so many pieces, and those inside; None where all are whole.

        a_p = sum_f sum_k (A_f / sum_(g at k) A_g) 3 q_p w_pk,   q_p = c_p / (3 n^2)

    Contact is the integral of its density over the cloth, taken by the trapezoidal rule: on whole triangles at their corners,
    where each vertex counts 1; on a triangle cut into n^2 equal ones at theirs, c_p of which meet at p. A vertex shares what it
    counts among the points of its triangles as its linear shape function does. So what is pressed in by the same depth
    everywhere costs the same however it is cut.

    Args:
        faces: (faces, 3) corners. area: (faces,) at rest, m^2. pieces: (faces,) n, from 1 to `MOST`. verts: of the garment.
    """
    faces, pieces = np.asarray(faces), np.asarray(pieces)
    if not (pieces > 1).any():
        return None
    area = np.asarray(area, np.float64)
    around = np.bincount(faces.ravel(), np.repeat(area, 3), verts)
    count = np.bincount(faces.ravel(), minlength=verts)
    of_corner = np.where(around[faces] > 0, area[:, None] / np.where(around > 0, around, 1)[faces], 1 / count[faces])
    keys, owners, weights, shares = [], [], [], []
    for n in np.unique(pieces):
        cut = np.flatnonzero(pieces == n)
        nodes = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)])
        meet = np.array([6, 3, 1])[(nodes == 0).sum(axis=1)]
        counts = np.einsum("fk,pk,p->fp", of_corner[cut], nodes / n, meet / n**2)
        keys.append(_keys(faces[cut], nodes * (WHOLE // n)).reshape(-1, 6))
        owners.append(np.repeat(cut, len(nodes)))
        weights.append(np.tile(nodes / n, (len(cut), 1)))
        shares.append(counts.ravel())
    _, first, place = np.unique(np.concatenate(keys), axis=0, return_index=True, return_inverse=True)
    corners, carried = faces[np.concatenate(owners)][first], np.concatenate(weights)[first]
    total = np.bincount(place.reshape(-1), np.concatenate(shares))
    vertex, between = carried.max(axis=1) == 1, carried.max(axis=1) < 1
    own = np.ones(verts)  # of a vertex without a triangle
    own[corners[vertex, carried[vertex].argmax(axis=1)]] = total[vertex]
    return ContactPoints(
        corners=jax.device_put(corners[between].astype(np.int32)),
        weights=jnp.asarray(carried[between]),
        shares=jnp.asarray(np.concatenate([own, total[between]])),
    )


def _keys(faces: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return for each node of each face (faces, nodes, 6) the vertices that carry it, in order, and by how much."""
    carried = np.broadcast_to(nodes[None], (len(faces), *nodes.shape))
    by = np.where(carried > 0, faces[:, None, :], -1)
    order = np.argsort(by, axis=2, kind="stable")
    return np.concatenate([np.take_along_axis(a, order, axis=2) for a in (by, carried)], axis=2)


def with_points(x, points: ContactPoints | None):
    """Return positions (verts, 3, *poses) followed by those of the points, m: of arrays of NumPy or of JAX."""
    if points is None:
        return x
    numbers = jnp if isinstance(x, jax.Array) else np
    corners, weights = (numbers.asarray(a) for a in (points.corners, points.weights))
    weights = weights.astype(x.dtype).reshape(-1, 3, *(1,) * (x.ndim - 1))
    between = sum(weights[:, k] * x[corners[:, k]] for k in range(3))
    return numbers.concatenate([x, between])


def on_vertices(values: Float[Array, "all 3"], points: ContactPoints | None) -> Float[Array, "verts 3"]:
    """Return what vectors at the vertices and the points, as forces, are at the vertices alone."""
    if points is None:
        return values
    verts = len(values) - len(points.corners)
    each = points.weights.astype(values.dtype)[..., None] * values[verts:, None]
    return values[:verts].at[points.corners].add(each)

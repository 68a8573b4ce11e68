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
    """Points of a garment's triangles at which contact looks as it does at vertices.

        x_p = sum_k w_pk x_k,   k the corners of p's triangle

    weights: w, which add up to 1; zero for the corner across from an edge that holds the point.
    """

    corners: Int[Array, "points 3"]
    weights: Float[Array, "points 3"]


def contact_points(faces: np.ndarray, pieces: np.ndarray) -> ContactPoints | None:
    """Return the points that cut every edge of a triangle into so many pieces, and those inside; None where all are whole.

    They are the vertices that a finer mesh would have there, and as such each counts in contact as a vertex does. A point that
    triangles share is there once.

    Args:
        faces: (faces, 3) corners. pieces: (faces,) from 1 to `MOST`.
    """
    faces, pieces = np.asarray(faces), np.asarray(pieces)
    if not (pieces > 1).any():
        return None
    keys, owners, weights = [], [], []
    for n in np.unique(pieces[pieces > 1]):
        cut = np.flatnonzero(pieces == n)
        nodes = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)])
        nodes = nodes[nodes.max(axis=1) < n]
        keys.append(_keys(faces[cut], nodes * (WHOLE // n)).reshape(-1, 6))
        owners.append(np.repeat(cut, len(nodes)))
        weights.append(np.tile(nodes / n, (len(cut), 1)))
    _, first = np.unique(np.concatenate(keys), axis=0, return_index=True)
    return ContactPoints(
        corners=jax.device_put(faces[np.concatenate(owners)][first].astype(np.int32)),
        weights=jnp.asarray(np.concatenate(weights)[first]),
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


def on_vertices(
    values: Float[Array, "all components *poses"], points: ContactPoints | None
) -> Float[Array, "verts components *poses"]:
    """Return what is at the vertices and the points, as forces, at the vertices alone."""
    if points is None:
        return values
    verts = len(values) - len(points.corners)
    weights = points.weights.astype(values.dtype)
    each = weights.reshape(*weights.shape, *(1,) * (values.ndim - 1)) * values[verts:, None]
    return values[:verts].at[points.corners].add(each)

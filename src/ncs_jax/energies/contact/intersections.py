"""Where a garment passes through itself: which triangles do, and how long the curves are along which they do."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.pairs import LEAST, Groups, candidate_room, keep_candidates, overlapping_members
from ncs_jax.geometry.closest_point import ratio, triangle_weights
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.numerics import normalize
from ncs_jax.geometry.soa_vectors import cross, dot, minus

__all__ = ["Crossings", "contour_length", "crossings", "intersecting"]

STEEP = 5.0  # times its own length that an end of a curve moves, at most, where an edge is almost in a triangle's plane


class Crossings(NamedTuple):
    """Edges that go through triangles, and which faces beside them do: none where the list is not full.

    `overflow`: there are more than the search has room for.
    """

    edges: Int[Array, "crossings"]
    faces: Int[Array, "crossings"]
    sides: Int[Array, "crossings 2"]  # the faces of the edge; -1 where there is none, or it shares a vertex with the triangle
    overflow: Bool[Array, ""]


def crossings(x: Float[Array, "verts 3"], mesh: Mesh, groups: Groups) -> Crossings:
    """Return the edges that go through the inside of a triangle.

    An edge p q goes through a triangle a b c where p and q lie on different sides of it, and p q on one side of all three
    edges: signs of volumes. Triangles in one plane, or that only touch, do not pass through each other.
    Source: Moeller and Trumbore 1997; Ericson 2005, 5.3.4.
    """
    x = lax.stop_gradient(x)
    ends, corners = (x[k].reshape(len(k), -1) for k in (mesh.edges, mesh.faces))

    rounding = 8 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x))  # m: so near to its plane, a point is on no side of a triangle

    def keep(i, j):
        p, q = ends[i].T.reshape(2, 3, -1)
        a, b, c = corners[j].T.reshape(3, 3, -1)
        n = cross(minus(b, a), minus(c, a))
        above, below = dot(minus(p, a), n), dot(minus(q, a), n)
        a, b, c, along = (minus(k, p) for k in (a, b, c, q))
        around = [dot(along, cross(f, g)) for f, g in ((a, b), (b, c), (c, a))]
        inside = (around[0] > 0) & (around[1] > 0) & (around[2] > 0) | (around[0] < 0) & (around[1] < 0) & (around[2] < 0)
        least = rounding * jnp.sqrt(dot(n, n))
        return inside & ((above > least) & (below < -least) | (above < -least) & (below > least))

    first, second = (mesh.edges, groups.edges), (mesh.faces, groups.faces)
    i, j, found, full = overlapping_members(x, first, second, jnp.zeros((), x.dtype), candidate_room(len(mesh.edges)))
    i, j, real, fuller = keep_candidates(keep, i, j, found, max(4 * len(mesh.faces), LEAST))
    sides = groups.edge_sides[i]
    shared = jnp.any(mesh.faces[sides][:, :, :, None] == mesh.faces[j][:, None, None, :], axis=(2, 3))
    return Crossings(i, j, jnp.where((sides >= 0) & ~shared & real[:, None], sides, -1), full | fuller)


def intersecting(x: Float[Array, "verts 3"], mesh: Mesh, groups: Groups) -> tuple[Bool[Array, "faces"], Bool[Array, ""]]:
    """Return which triangles pass through another that shares no vertex with them, and whether the search ran out of room."""
    found = crossings(x, mesh, groups)
    none = len(mesh.faces)
    sides = jnp.where(found.sides >= 0, found.sides, none)
    hit = jnp.where(jnp.any(found.sides >= 0, axis=-1), found.faces, none)
    marked = jnp.zeros(none, bool).at[sides.reshape(-1)].set(True, mode="drop").at[hit].set(True, mode="drop")
    return marked, found.overflow


def contour_length(x: Float[Array, "verts 3"], mesh: Mesh, found: Crossings) -> Float[Array, ""]:
    """Return the length of the curves along which a garment passes through itself, m, differentiable by x.

        L = sum_ends -r . P,   dP = (I - e n^T / (n . e)) dp_e + e n^T / (n . e) dp_t

    Args:
        x: (verts, 3) positions in m. found: its `crossings`.

    Each piece of the curves is where two triangles meet. It ends at P, where an edge of the one, with the direction e, goes
    through the other, whose normal is n; r goes from there into the piece, and -r . P of both its ends add up to its length.
    p_e and p_t are the points of edge and triangle that are at P, with weights that are constants to the derivative, as r, e
    and n are: so it is exact, as long as n . e is not small (`STEEP`). Less length is less cloth on the wrong side: the cloth
    goes back the way it came. Source: Volino and Magnenat-Thalmann 2006, Resolving surface collisions through intersection
    contour minimization.
    """
    y = lax.stop_gradient(x)
    edge, triangle = mesh.edges[found.edges], mesh.faces[found.faces]
    (p, q), (a, b, c) = (jnp.moveaxis(y[k], 1, 0) for k in (edge, triangle))
    n, e = normalize(jnp.cross(b - a, c - a)), normalize(q - p)
    into = jnp.sum(n * e, axis=-1)
    into = jnp.where(into < 0, -1, 1) * jnp.maximum(jnp.abs(into), 1 / STEEP)
    before, behind = (jnp.abs(jnp.sum((k - a) * n, axis=-1)) for k in (p, q))
    t = ratio(before, before + behind)[:, None]
    at = p + t * (q - p)
    weights = jnp.stack(triangle_weights(*(jnp.moveaxis(k, -1, 0) for k in (at, a, b, c))), axis=-1)
    of_edge = jnp.sum(jnp.concatenate([1 - t, t], axis=1)[..., None] * x[edge], axis=1)
    of_triangle = jnp.sum(weights[..., None] * x[triangle], axis=1)
    length = jnp.zeros((), x.dtype)
    for side in found.sides.T:
        corners = mesh.faces[side]
        third = y[corners].sum(axis=1) - p - q
        normal = jnp.cross(q - p, third - p)
        r = normalize(jnp.cross(n, normal))
        inwards = jnp.cross(normal, e)  # of the triangle, from the edge
        r = jnp.where(jnp.sum(r * inwards, axis=-1, keepdims=True) < 0, -r, r)
        middle = (y[corners].sum(axis=1) + y[triangle].sum(axis=1)) / 6  # the same for both ends
        slope = (jnp.sum(r * e, axis=-1) / into)[:, None] * n
        ends = -jnp.sum(r * (of_edge - middle), axis=-1) + jnp.sum(slope * (of_edge - of_triangle), axis=-1)
        length += jnp.sum(jnp.where(side >= 0, ends, 0))
    return length

"""Which triangles of a garment pass through each other."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ncs_jax.energies.contact.pairs import LEAST, Groups, candidate_room, keep_candidates, overlapping_members
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.soa_vectors import cross, dot, minus

__all__ = ["intersecting"]


def intersecting(x: Float[Array, "verts 3"], mesh: Mesh, groups: Groups) -> tuple[Bool[Array, "faces"], Bool[Array, ""]]:
    """Return which triangles pass through another that shares no vertex with them, and whether the search ran out of room.

    Two triangles pass through each other where an edge of one goes through the inside of the other; triangles in one plane, or
    that only touch, do not. An edge p q goes through a triangle a b c where p and q lie on different sides of it, and p q on
    one side of all three edges: signs of volumes. Source: Moeller and Trumbore 1997; Ericson 2005, 5.3.4.
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
    counts = (sides >= 0) & ~shared & real[:, None]
    sides = jnp.where(counts, sides, len(mesh.faces))
    hit = jnp.where(jnp.any(counts, axis=-1), j, len(mesh.faces))
    marked = jnp.zeros(len(mesh.faces), bool).at[sides.reshape(-1)].set(True, mode="drop").at[hit].set(True, mode="drop")
    return marked, full | fuller

"""Mass-spring cloth: one spring an edge."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.geometry.mesh import Mesh, corners, spread
from ncs_jax.geometry.soa_vectors import Vector, length, minus

__all__ = ["mass_spring", "per_edge"]


def per_edge(edge: Sequence[Vector], mesh: Mesh, stiffness) -> Float[Array, "edges *poses"]:
    """Return the energy of every spring, J."""
    now = length(minus(edge[1], edge[0]))
    return stiffness / 2 * spread(mesh.edge_weight, now) * (now - spread(mesh.edge_length, now)) ** 2


def mass_spring(x: Float[Array, "verts 3 *poses"], mesh: Mesh, stiffness) -> Float[Array, "*poses"]:
    """Return the energy of the edge springs in J.

        E = 1/2 k sum_edges w (l - l0)^2,  w = (2/sqrt(3)) (A0 + A1) / l0^2

    The weight w is 1 inside an equilateral mesh and 1/2 on its border; it makes the cloth's stiffness independent of the
    resolution, there with Lame parameters lambda = mu = sqrt(3)/4 k.

    Args:
        x: (verts, 3, *poses) positions in m. mesh: rest state. stiffness: k in N/m.

    An edge collapsed to a point has zero derivative. Source: Provot 1995; slides, cloth models.
    """
    return jnp.sum(per_edge(corners(x, mesh.edges), mesh, stiffness), axis=0)

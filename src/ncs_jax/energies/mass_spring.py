"""Mass-spring cloth: one spring an edge."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.mesh import Mesh
from ncs_jax.numerics import norm

__all__ = ["mass_spring"]


def mass_spring(x: Float[Array, "verts 3"], mesh: Mesh, stiffness) -> Float[Array, ""]:
    """Energy of the edge springs in J.

        E = 1/2 k sum_edges w (l - l0)^2,  w = (2/sqrt(3)) (A0 + A1) / l0^2

    The weight w is 1 inside an equilateral mesh and 1/2 on its border; it makes the cloth's stiffness independent of the
    resolution, there with Lame parameters lambda = mu = sqrt(3)/4 k.

    Args:
        x: (verts, 3) positions in m. mesh: rest state. stiffness: k in N/m.

    An edge collapsed to a point has zero derivative. Source: Provot 1995; slides, cloth models.
    """
    length = norm(x[mesh.edges[:, 1]] - x[mesh.edges[:, 0]])
    return stiffness / 2 * jnp.sum(mesh.edge_weight * (length - mesh.edge_length) ** 2)

"""Bending of hinges by their signed dihedral angle, equation (11)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.mesh import Mesh, dihedral

__all__ = ["bending"]


def bending(x: Float[Array, "verts 3"], mesh: Mesh, stiffness: Float[Array, ""] | float) -> Float[Array, ""]:
    """Bending energy in J.

        E = sum_hinges k l^2 / (8 (A0 + A1)) (phi - phi_rest)^2,  the difference wrapped to (-pi, pi]

    Args:
        x: (verts, 3) positions in m. mesh: rest state. stiffness: k in N m.

    Source: slides, equation (11); Grinspun et al. 2003. Wrapping is where the fold passes through itself: one-sided there.
    """
    areas = jnp.where(mesh.hinge_area > 0, mesh.hinge_area, 1)
    change = dihedral(x[mesh.hinges], areas) - mesh.hinge_angle
    change = change - 2 * np.pi * jnp.round(change / (2 * np.pi))
    solid = jnp.all(mesh.hinge_area > 0, axis=-1)
    weight = jnp.where(solid, mesh.hinge_length**2 / (8 * jnp.sum(areas, axis=-1)), 0)
    return stiffness * jnp.sum(weight * change * change)

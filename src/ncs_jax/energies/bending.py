"""Bending of hinges by their signed dihedral angle, equation (11)."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.mesh import Mesh, corners, dihedral, spread
from ncs_jax.vectors import Vector

__all__ = ["angles", "bending", "per_hinge"]


def angles(hinge: Sequence[Vector], mesh: Mesh) -> Float[Array, "hinges *poses"]:
    """How far every hinge is folded from its rest, phi - phi_rest wrapped to (-pi, pi]."""
    areas = [spread(jnp.where(a > 0, a, 1), hinge[0][0]) for a in (mesh.hinge_area[:, 0], mesh.hinge_area[:, 1])]
    change = dihedral(hinge, areas) - spread(mesh.hinge_angle, hinge[0][0])
    return change - 2 * np.pi * jnp.round(change / (2 * np.pi))


def per_hinge(hinge: Sequence[Vector], mesh: Mesh, stiffness) -> Float[Array, "hinges *poses"]:
    """Energy of every hinge, J; none beside a face of zero area."""
    solid = jnp.all(mesh.hinge_area > 0, axis=-1)
    areas = jnp.sum(jnp.where(mesh.hinge_area > 0, mesh.hinge_area, 1), axis=-1)
    weight = jnp.where(solid, mesh.hinge_length**2 / (8 * areas), 0)
    change = angles(hinge, mesh)
    return stiffness * spread(weight, change) * change * change


def bending(x: Float[Array, "verts 3 *poses"], mesh: Mesh, stiffness: Float[Array, ""] | float) -> Float[Array, "*poses"]:
    """Bending energy in J.

        E = sum_hinges k l^2 / (8 (A0 + A1)) (phi - phi_rest)^2,  the difference wrapped to (-pi, pi]

    Args:
        x: (verts, 3, *poses) positions in m. mesh: rest state. stiffness: k in N m.

    Source: slides, equation (11); Grinspun et al. 2003. Wrapping is where the fold passes through itself: one-sided there.
    """
    return jnp.sum(per_hinge(corners(x, mesh.hinges), mesh, stiffness), axis=0)

"""Baraff-Witkin membrane: stretch along the warp and weft, and shear between them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.energies.membrane import Columns, per_face
from ncs_jax.geometry.mesh import Mesh, corners
from ncs_jax.geometry.soa_vectors import dot, length

__all__ = ["baraff_witkin", "density"]


def density(w: Columns, stretch, shear) -> Array:
    """Return the energy per rest area, J/m^2: k_s ((|w_u| - 1)^2 + (|w_v| - 1)^2) + k_sh (w_u . w_v)^2."""
    u, v = length(w[0]) - 1, length(w[1]) - 1
    return stretch * (u * u + v * v) + shear * dot(w[0], w[1]) ** 2


def baraff_witkin(x: Float[Array, "verts 3 *poses"], mesh: Mesh, stretch, shear) -> Float[Array, "*poses"]:
    """Return the Baraff-Witkin membrane energy in J.

        E = sum_faces A ( k_s ((|w_u| - 1)^2 + (|w_v| - 1)^2) + k_sh (w_u . w_v)^2 )

    Args:
        x: (verts, 3, *poses) positions in m. mesh: rest state, whose material axes matter here: give it a UV map.
        stretch, shear: k_s and k_sh in N/m.

    Where a material axis is collapsed to a point its derivative is taken as zero. Source: Baraff and Witkin 1998, section 4.
    """
    return jnp.sum(per_face(density, corners(x, mesh.faces), mesh, stretch, shear), axis=0)

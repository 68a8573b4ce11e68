"""Baraff-Witkin membrane: stretch along the warp and weft, and shear between them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.energies.membrane import deformation
from ncs_jax.mesh import Mesh
from ncs_jax.numerics import norm

__all__ = ["baraff_witkin", "density"]


def density(w: Float[Array, "2 *faces 3"], stretch, shear) -> Float[Array, "*faces"]:
    """Energy per rest area, J/m^2: k_s ((|w_u| - 1)^2 + (|w_v| - 1)^2) + k_sh (w_u . w_v)^2."""
    excess = norm(w) - 1
    return stretch * jnp.sum(excess * excess, axis=0) + shear * jnp.sum(w[0] * w[1], axis=-1) ** 2


def baraff_witkin(x: Float[Array, "verts 3"], mesh: Mesh, stretch, shear) -> Float[Array, ""]:
    """Baraff-Witkin membrane energy in J.

        E = sum_faces A ( k_s ((|w_u| - 1)^2 + (|w_v| - 1)^2) + k_sh (w_u . w_v)^2 )

    Args:
        x: (verts, 3) positions in m. mesh: rest state, whose material axes matter here: give it a UV map.
        stretch, shear: k_s and k_sh in N/m.

    Where a material axis is collapsed to a point its derivative is taken as zero. Source: Baraff and Witkin 1998, section 4.
    """
    return jnp.sum(mesh.face_area * density(deformation(x, mesh), stretch, shear))

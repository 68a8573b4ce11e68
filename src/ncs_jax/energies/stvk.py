"""St. Venant-Kirchhoff membrane."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.energies.membrane import Columns, per_face
from ncs_jax.geometry.mesh import Mesh, corners
from ncs_jax.geometry.soa_vectors import dot

__all__ = ["density", "stvk"]


def density(w: Columns, lam, mu) -> Array:
    """Return the energy per rest area, J/m^2: mu |G|^2 + lambda/2 tr(G)^2 with the Green strain G = (F^T F - I)/2."""
    uu, vv, uv = (dot(w[0], w[0]) - 1) / 2, (dot(w[1], w[1]) - 1) / 2, dot(w[0], w[1]) / 2
    return mu * (uu * uu + vv * vv + 2 * uv * uv) + lam / 2 * (uu + vv) ** 2


def stvk(x: Float[Array, "verts 3 *poses"], mesh: Mesh, lam, mu) -> Float[Array, "*poses"]:
    """Return the St. Venant-Kirchhoff membrane energy in J.

        E = sum_faces A (mu |G|^2 + lambda/2 tr(G)^2)

    Args:
        x: (verts, 3, *poses) positions in m. mesh: rest state. lam, mu: Lame parameters times thickness, N/m.

    It softens under compression: its stiffness is negative below a stretch of 1/sqrt(3); `neo_hookean` does not.
    Source: slides, cloth models; Montes et al. 2020.
    """
    return jnp.sum(per_face(density, corners(x, mesh.faces), mesh, lam, mu), axis=0)

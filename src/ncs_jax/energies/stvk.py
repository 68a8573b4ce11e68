"""St. Venant-Kirchhoff membrane."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.energies.membrane import deformation
from ncs_jax.mesh import Mesh

__all__ = ["density", "stvk"]


def density(w: Float[Array, "2 *faces 3"], lam, mu) -> Float[Array, "*faces"]:
    """Energy per rest area, J/m^2: mu |G|^2 + lambda/2 tr(G)^2 with the Green strain G = (F^T F - I)/2."""
    uu = (jnp.sum(w[0] * w[0], axis=-1) - 1) / 2
    vv = (jnp.sum(w[1] * w[1], axis=-1) - 1) / 2
    uv = jnp.sum(w[0] * w[1], axis=-1) / 2
    return mu * (uu * uu + vv * vv + 2 * uv * uv) + lam / 2 * (uu + vv) ** 2


def stvk(x: Float[Array, "verts 3"], mesh: Mesh, lam, mu) -> Float[Array, ""]:
    """St. Venant-Kirchhoff membrane energy in J.

        E = sum_faces A (mu |G|^2 + lambda/2 tr(G)^2)

    Args:
        x: (verts, 3) positions in m. mesh: rest state. lam, mu: Lame parameters times thickness, N/m.

    It softens under compression: its stiffness is negative below a stretch of 1/sqrt(3); `neo_hookean` does not.
    Source: slides, cloth models; Montes et al. 2020.
    """
    # A face of zero rest area has zero axes and zero area: it weighs nothing.
    return jnp.sum(mesh.face_area * density(deformation(x, mesh), lam, mu))

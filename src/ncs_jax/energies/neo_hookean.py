"""A membrane that resists compression: stable neo-Hookean, stress-free at rest."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.energies.membrane import Columns, per_face
from ncs_jax.geometry.mesh import Mesh, corners
from ncs_jax.geometry.soa_vectors import cross, dot, length

__all__ = ["density", "neo_hookean"]


def density(w: Columns, lam, mu) -> Array:
    """Return the energy per area, J/m^2: mu/2 (|F|^2 - 2) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2, J = |w_u x w_v|."""
    stretch = dot(w[0], w[0]) + dot(w[1], w[1]) - 2
    area = length(cross(w[0], w[1])) - 1
    return mu / 2 * stretch - mu * area + (lam + mu) / 2 * area * area


def neo_hookean(x: Float[Array, "verts 3 *poses"], mesh: Mesh, lam, mu) -> Float[Array, "*poses"]:
    """Return a compression-safe membrane energy in J.

        E = sum_faces A [ mu/2 (|F|^2 - 2) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2 ],  J = |w_u x w_v|

    Equal to St. Venant-Kirchhoff to second order in the strain. Along one axis, with the other held at a stretch s, its
    stiffness is mu + (lambda + mu) s^2 at every stretch; with the other free, it is positive down to half the rest length at
    least (`tests/test_energies.py`). Finite at zero area, where the derivative of J is taken as zero.

    Args:
        x: (verts, 3, *poses) positions in m. mesh: rest state. lam, mu: Lame parameters times thickness, N/m.

    Source: Smith, de Goes, Kim 2018 (stable neo-Hookean), reduced here to a membrane without a logarithm.
    """
    return jnp.sum(per_face(density, corners(x, mesh.faces), mesh, lam, mu), axis=0)

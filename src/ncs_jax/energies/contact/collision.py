"""Collision with the body, equation (12)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.geometry.mesh import spread

__all__ = ["collision"]


def collision(
    distance: Float[Array, "points *poses"], thickness, stiffness, shares: Float[Array, "points"] | None = None
) -> Float[Array, "*poses"]:
    """Return the collision energy in J.

        E = k_c sum_p a_p min(d(x_p) - eps, 0)^2

    Args:
        distance: (points, *poses) signed distance to the posed body, m. thickness: eps, m. stiffness: k_c, J/m^2 a vertex.
        shares: a_p, in vertices, of vertices and of the points between them, see `points.contact_points`; None: of vertices
            alone, each of which counts 1. k_c of a vertex is then spread over the cloth around it.

    Zero with zero derivative for cloth farther than eps; continuous in value and first derivative at eps.
    Source: slides, equation (12).
    """
    square = jnp.minimum(distance - thickness, 0) ** 2
    return stiffness * jnp.sum(square if shares is None else spread(shares.astype(square.dtype), square) * square, axis=0)

"""Collision with the body, equation (12)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["collision"]


def collision(distance: Float[Array, "points *poses"], thickness, stiffness) -> Float[Array, "*poses"]:
    """Return the collision energy in J.

        E = k_c sum_p min(d(x_p) - eps, 0)^2

    Args:
        distance: (points, *poses) signed distance to the posed body, m, of vertices and of the points between them, see
            `points.contact_points`. thickness: eps, m. stiffness: k_c, J/m^2 each.

    Zero with zero derivative for cloth farther than eps; continuous in value and first derivative at eps.
    Source: slides, equation (12).
    """
    return stiffness * jnp.sum(jnp.minimum(distance - thickness, 0) ** 2, axis=0)

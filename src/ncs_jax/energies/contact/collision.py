"""Collision with the body, equation (12)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["collision"]


def collision(distance: Float[Array, "verts *poses"], thickness, stiffness) -> Float[Array, "*poses"]:
    """Return the collision energy in J.

        E = k_c sum_v min(d(x_v) - eps, 0)^2

    Args:
        distance: (verts, *poses) signed distance to the posed body in m. thickness: eps in m. stiffness: k_c in J/m^2 a vertex.

    Zero with zero derivative for cloth farther than eps; continuous in value and first derivative at eps.
    Source: slides, equation (12).
    """
    return stiffness * jnp.sum(jnp.minimum(distance - thickness, 0) ** 2, axis=0)

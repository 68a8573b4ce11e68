"""Gravity, equation (14)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["gravity"]


def gravity(x: Float[Array, "verts 3"], mass: Float[Array, "verts"], acceleration: Float[Array, 3]) -> Float[Array, ""]:
    """Potential energy in a uniform field in J: E = - sum_v m x . g.

    Args:
        x: (verts, 3) in m. mass: (verts,) in kg. acceleration: (3,) g in m/s^2, any direction.

    Source: slides, equation (14).
    """
    return -jnp.sum(jnp.sum(mass[:, None] * x, axis=0) * acceleration)  # no matrix product: accelerators round those

"""Gravity, equation (14)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["gravity"]


def gravity(
    x: Float[Array, "verts 3 *poses"], mass: Float[Array, "verts"], acceleration: Float[Array, 3]
) -> Float[Array, "*poses"]:
    """Return the potential energy in a uniform field in J: E = - sum_v m x . g.

    Args:
        x: (verts, 3, *poses) in m. mass: (verts,) in kg. acceleration: (3,) g in m/s^2, any direction.

    Source: slides, equation (14).
    """
    poses = (1,) * (x.ndim - 2)
    moment = jnp.sum(mass.reshape(-1, 1, *poses) * x, axis=0)
    return -jnp.sum(moment * acceleration.reshape(3, *poses), axis=0)  # no matrix product: accelerators round those

"""Pinning chosen vertices to where skinning alone would carry them."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["pinning"]


def pinning(unposed: Float[Array, "pins 3"], rest: Float[Array, "pins 3"], stiffness) -> Float[Array, ""]:
    """Return the energy of the pins in J: E = k_p sum_pins |unposed x - rest|^2.

    Args:
        unposed: (pins, 3) positions taken back through skinning, m. rest: (pins, 3) rest positions, m. stiffness: k_p in N/m.

    Source: slides, pinning.
    """
    return stiffness * jnp.sum((unposed - rest) ** 2)

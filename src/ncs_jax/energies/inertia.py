"""Inertia, equation (13)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["inertia", "project"]


def project(
    previous: Float[Array, "verts 3 *poses"], before: Float[Array, "verts 3 *poses"], ratio: float = 1.0
) -> Float[Array, "verts 3 *poses"]:
    """Return where the vertices go without forces: x_proj = x_{t-1} + (x_{t-1} - x_{t-2}) * ratio; ratio = dt_t / dt_{t-1}."""
    return previous + (previous - before) * ratio


def inertia(
    x: Float[Array, "verts 3 *poses"], target: Float[Array, "verts 3 *poses"], mass: Float[Array, "verts"], dt
) -> Float[Array, "*poses"]:
    """Return the inertia potential in J, whose minimiser together with the other energies is a step of implicit Euler.

        E = 1 / (2 dt^2) sum_v m |x_t - x_proj|^2

    The target is a plain argument: whoever trains decides whether it carries a gradient (`objective` stops it).

    Args:
        x, target: (verts, 3, *poses) in m. mass: (verts,) in kg. dt: time step in s.

    Source: slides, equation (13); Martin et al. 2011.
    """
    difference = (x - target) / dt
    return jnp.sum(mass.reshape(-1, *(1,) * (x.ndim - 1)) * difference * difference, axis=(0, 1)) / 2

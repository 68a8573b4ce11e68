"""Inertia, equation (13)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["inertia", "project"]


def project(previous: Float[Array, "verts 3"], before: Float[Array, "verts 3"], ratio: float = 1.0) -> Float[Array, "verts 3"]:
    """Where the vertices go without forces: x_proj = x_{t-1} + (x_{t-1} - x_{t-2}) * ratio, with ratio = dt_t / dt_{t-1}."""
    return previous + (previous - before) * ratio


def inertia(x: Float[Array, "verts 3"], target: Float[Array, "verts 3"], mass: Float[Array, "verts"], dt) -> Float[Array, ""]:
    """Inertia potential in J, whose minimiser together with the other energies is a step of implicit Euler.

        E = 1 / (2 dt^2) sum_v m |x_t - x_proj|^2

    The target is a plain argument: whoever trains decides whether it carries a gradient (`objective` stops it).

    Args:
        x, target: (verts, 3) in m. mass: (verts,) in kg. dt: time step in s.

    Source: slides, equation (13); Martin et al. 2011.
    """
    difference = (x - target) / dt
    return jnp.sum(mass[:, None] * difference * difference) / 2

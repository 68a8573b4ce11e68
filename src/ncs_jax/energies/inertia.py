"""Inertia, equation (13), and the acceleration that forces out of balance give."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["G", "imbalance", "inertia", "out_of_balance", "project"]

G = 9.81  # m/s^2, the unit of what is out of balance


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

    The target is a plain argument: whoever trains decides whether it carries a gradient (`total.energy_terms` stops it).

    Args:
        x, target: (verts, 3, *poses) in m. mass: (verts,) in kg. dt: time step in s.

    Source: slides, equation (13); Martin et al. 2011.
    """
    difference = (x - target) / dt
    return jnp.sum(mass.reshape(-1, *(1,) * (x.ndim - 1)) * difference * difference, axis=(0, 1)) / 2


def imbalance(gradient: Float[Array, "verts 3"], mass: Float[Array, "verts"]) -> Float[Array, "verts"]:
    """Return |dE/dx_v|^2 / m_v, N^2/kg: squared out-of-balance forces over mass; 0 where there is no mass."""
    heavy = mass > 0
    return jnp.where(heavy, jnp.sum(gradient * gradient, axis=-1) / jnp.where(heavy, mass, 1), 0)


def out_of_balance(gradient: Float[Array, "verts 3"], mass: Float[Array, "verts"]) -> Float[Array, ""]:
    """Return the mass-weighted r.m.s. of M^-1 dE/dx, in multiples of `G`: the residual of every solver here."""
    return jnp.sqrt(jnp.sum(imbalance(gradient, mass)) / jnp.sum(mass)) / G

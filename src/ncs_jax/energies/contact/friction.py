"""Friction on the body: Coulomb's law as a potential of one step, its normal force that of contact where the step begins."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.geometry.numerics import norm, normalize

__all__ = ["SLIP", "friction", "slipping"]

SLIP = 0.01  # m/s: slower than this, cloth creeps where it ought to stick


def slipping(x: Float[Array, "verts 3"], advected: Float[Array, "verts 3"], lagged_normal_force: Float[Array, "verts 3"]):
    """Return how far every vertex has slipped along the body, (verts, 3) in m, and the normals of contact (verts, 3)."""
    normal = normalize(lagged_normal_force)
    gap = x - advected
    return gap - jnp.sum(gap * normal, axis=-1, keepdims=True) * normal, normal


def friction(
    x: Float[Array, "verts 3"], advected: Float[Array, "verts 3"], lagged_normal_force: Float[Array, "verts 3"], coefficient, dt
) -> Float[Array, ""]:
    """Return the potential of friction in J.

        E = mu sum_v |f_v| h(|u_v|),   u_v the part of x - x_advected along the body,
        h(u) = u^2 / (2 s)  for  u < s,   u - s/2  beyond,   s = dt * 0.01 m/s

    Its force is that of Coulomb, mu |f|, once cloth slips; below s it grows from zero, so cloth that sticks creeps by less than
    10 mm/s. f is taken where the step begins, as otherwise there is no potential.

    Args:
        x: (verts, 3) in m. advected: where the body alone would carry the last positions, m. lagged_normal_force: (verts, 3)
            f, the derivative of contact there, N. coefficient: mu. dt: time step in s.

    Source: Li et al. 2020 (incremental potential contact), section 5, with a quadratic in place of their cubic.
    """
    along, _ = slipping(x, advected, lagged_normal_force)
    length = norm(along)
    slip = SLIP * dt
    sticks = length < slip
    height = jnp.where(sticks, jnp.sum(along * along, axis=-1) / (2 * slip), length - slip / 2)
    return coefficient * jnp.sum(norm(lagged_normal_force) * height)

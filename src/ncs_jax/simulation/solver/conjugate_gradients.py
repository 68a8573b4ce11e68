"""Preconditioned conjugate gradients for matrices that are known by their products."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.simulation.solver.problem import dot

__all__ = ["conjugate_gradients"]


def conjugate_gradients(
    matrix: Callable, preconditioner: Callable, right: Float[Array, "verts 3"], tolerance: float, most: int
) -> Float[Array, "verts 3"]:
    """Return x with |matrix(x) - right| <= tolerance |right|, in at most `most` steps; fewer where it is not definite.

    Source: Nocedal and Wright 2006, algorithm 5.3.
    """

    def unfinished(state):
        _, r, _, rho, count, definite = state
        return (jnp.sqrt(dot(r, r)) > tolerance * jnp.sqrt(dot(right, right))) & (count < most) & definite & (rho > 0)

    def iterate(state):
        x, r, p, rho, count, _ = state
        image = matrix(p)
        curvature = dot(p, image)
        definite = curvature > 0
        size = jnp.where(definite, rho / jnp.where(definite, curvature, 1), 0)
        x, r = x + size * p, r - size * image
        z = preconditioner(r)
        new = dot(r, z)
        return x, r, z + new / rho * p, new, count + 1, definite

    z = preconditioner(right)
    state = (jnp.zeros_like(right), right, z, dot(right, z), jnp.zeros((), jnp.int32), jnp.asarray(True))
    return lax.while_loop(unfinished, iterate, state)[0]

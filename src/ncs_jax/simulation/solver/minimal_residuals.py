"""Preconditioned minimal residuals for symmetric matrices that are known by their products, definite or not."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.simulation.solver.problem import dot

__all__ = ["minimal_residuals"]


def minimal_residuals(
    matrix: Callable, preconditioner: Callable, right: Float[Array, "verts 3"], tolerance: float, most: int
) -> tuple[Float[Array, "verts 3"], Float[Array, ""]]:
    """Return x with |matrix(x) - right|_P <= tolerance |right|_P, in at most `most` steps, and what share of |right|_P is left.

    The preconditioner P has to be positive definite, |r|_P^2 = r . P r; the matrix may be indefinite, as that of an equilibrium
    that is not stable. Source: Paige and Saunders 1975; Elman, Silvester and Wathen 2014, algorithm 4.1.
    """
    zero, one = jnp.zeros_like(right), jnp.ones((), right.dtype)

    def norm(z, v):
        return jnp.sqrt(jnp.maximum(dot(z, v), 0))

    def unfinished(state):
        *_, rest, count = state
        return (jnp.abs(rest) > tolerance * whole) & (count < most)

    def iterate(state):
        x, (v, before), z, (w, earlier), (size, last), (c, s, old_c, old_s), rest, count = state
        z = z / size
        image = matrix(z)
        along = dot(image, z)
        onward = image - along / size * v - size / last * before
        shaped = preconditioner(onward)
        new = norm(shaped, onward)
        diagonal, second, third = c * along - old_c * s * size, s * along + old_c * c * size, old_s * size
        first = jnp.hypot(diagonal, new)
        first = jnp.where(first > 0, first, 1)
        w, earlier = (z - third * earlier - second * w) / first, w
        old_c, old_s, c, s = c, s, diagonal / first, new / first
        x, rest = x + c * rest * w, -s * rest
        # a Krylov space that is exhausted holds the solution: rest is then zero
        return x, (onward, v), shaped, (w, earlier), (jnp.where(new > 0, new, 1), size), (c, s, old_c, old_s), rest, count + 1

    start = preconditioner(right)
    whole = norm(start, right)
    size = jnp.where(whole > 0, whole, 1)
    state = (
        zero, (right, zero), start, (zero, zero), (size, one), (one, 0 * one, one, 0 * one), whole, jnp.zeros((), jnp.int32),
    )  # fmt: skip
    x, *_, rest, _ = lax.while_loop(unfinished, iterate, state)
    return x, jnp.abs(rest) / size

"""A frame's equilibrium as a differentiable function of all that it depends on, by the implicit function theorem."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.simulation.solver.cholesky import solve
from ncs_jax.simulation.solver.minimal_residuals import minimal_residuals
from ncs_jax.simulation.solver.minimise import Settings, Solution, minimise
from ncs_jax.simulation.solver.problem import Problem, energy, evaluate, factor_stiffness, hold_pins

__all__ = ["equilibrium"]

UNSOLVED = 1e-3  # of a cotangent, that a solve leaves


def equilibrium(
    settings: Settings, problem: Problem, start: Float[Array, "verts 3"]
) -> tuple[Float[Array, "verts 3"], Solution]:
    """Return what `minimise` finds, with the derivative of the minimum itself and not of the way to it.

    Where grad E(x, s) = 0, the implicit function theorem gives dx/ds = -H^-1 d(grad E)/ds with the exact Hessian H; in
    reverse one solve with H for a cotangent, by minimal residuals that the factored approximation of H preconditions: an
    equilibrium need not be stable. What exact pins hold moves with them, and H is that of the rest. Where the solve fails, as
    where H is singular, the derivative is NaN.
    """
    leaves, tree = jax.tree.flatten(problem)
    # A Python number, as the time step, is part of the program. Topology has no derivative.
    kinds = tuple(leaf if isinstance(leaf, float) else bool(jnp.issubdtype(leaf.dtype, jnp.inexact)) for leaf in leaves)
    numbers = [leaf for leaf, kind in zip(leaves, kinds, strict=True) if kind is True]
    topology = [leaf for leaf, kind in zip(leaves, kinds, strict=True) if kind is False]
    return _implicit((settings, tree, kinds), numbers, topology, start)


def _joined(static, numbers, topology) -> Problem:
    _, tree, kinds = static
    numbers, topology = iter(numbers), iter(topology)
    every = [next(numbers) if kind is True else next(topology) if kind is False else kind for kind in kinds]
    return jax.tree.unflatten(tree, every)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _implicit(static, numbers, topology, start):
    return minimise(static[0], _joined(static, numbers, topology), start)


def _implicit_forward(static, numbers, topology, start):
    x, solution = _implicit(static, numbers, topology, start)
    return (x, solution), (numbers, topology, x)


def _implicit_backward(static, kept, cotangents):
    numbers, topology, x = kept
    along, _ = cotangents
    problem = _joined(static, numbers, topology)
    free = jnp.ones(len(x), x.dtype) if problem.free is None else problem.free.astype(x.dtype)

    def balance(numbers, x):
        problem = _joined(static, numbers, topology)
        x = hold_pins(problem, x)
        return jax.grad(energy, argnums=1)(problem, x) * free[:, None], x

    _, hessian = jax.linearize(lambda x: balance(numbers, x)[0], x)
    factor = factor_stiffness(problem, x, evaluate(problem, x))
    tolerance = 1e-6 if x.dtype == jnp.float32 else 1e-12  # nearly the rounding
    right = along * free[:, None]
    adjoint, left = minimal_residuals(hessian, lambda r: solve(problem.order, factor, r), right, tolerance, 1000)
    adjoint = jnp.where(left < UNSOLVED, adjoint, jnp.nan)
    _, back = jax.vjp(lambda numbers: balance(numbers, x), numbers)
    (result,) = back((-adjoint, along))
    return result, None, None


_implicit.defvjp(_implicit_forward, _implicit_backward)

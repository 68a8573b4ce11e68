"""Which way down: projected Newton, with a new factor at every place, and quasi-Newton, which learns from where it has been.

Newton's step is the dearer and the better: to 0.1 g it is the only one, to 10 g quasi-Newton comes first.

A direction is made at the start of a frame, `begin(problem, x, point) -> memory`, and asked at every place,
`along(problem, x, point, memory) -> (p, memory)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ncs_jax.energies.contact import self_contact
from ncs_jax.energies.contact.layers import layer_blocks, layer_product
from ncs_jax.simulation.solver.cholesky import Factor, factorise, solve
from ncs_jax.simulation.solver.conjugate_gradients import conjugate_gradients
from ncs_jax.simulation.solver.problem import dot, stiffness_blocks
from ncs_jax.simulation.solver.stiffness import multiply

__all__ = ["DIRECTIONS", "Direction"]

FORCING, TURNS = 0.01, 100  # of the conjugate gradients: what is left, and the most steps
MEMORY = 8  # steps that quasi-Newton remembers
REFRESH = 20  # steps after which it begins anew


@dataclass(frozen=True)
class Direction:
    """How a solver finds its way, and whether patches find their own equilibrium between its steps."""

    begin: Callable
    along: Callable
    patches: bool


def _newton(problem, x, point, memory):
    """-H^-1 g, H with element Hessians made positive semi-definite (Teran et al. 2005).

    Cloth that touches cloth couples vertices that no element does: then the rest of the matrix preconditions the whole.
    """
    garment, material, terms = problem.model.garment, problem.model.material, problem.model.terms
    alone = replace(problem, model=replace(problem.model, terms=replace(terms, layers=None)))
    diagonal, off = stiffness_blocks(alone, x, point._replace(repulsion=None))
    near, products = diagonal, []
    if point.repulsion is not None:
        near = near + self_contact.blocks(point.repulsion, x, material.self_contact)
        products.append(lambda p: self_contact.product(point.repulsion, p, material.self_contact))
    if terms.layers:
        given = x, garment.uppers, material.thickness, material.collision
        near = near + layer_blocks(*given) / 2
        products.append(layer_product(*given))
    factor = factorise(problem.order, near, off)
    if not products:
        return -solve(problem.order, factor, point.gradient), memory
    free = jnp.ones((len(x), 1), x.dtype) if problem.free is None else problem.free[:, None].astype(x.dtype)

    def matrix(p):
        return multiply(problem.couplings, diagonal, off, p) + free * sum(product(p) for product in products)

    return -conjugate_gradients(matrix, lambda r: solve(problem.order, factor, r), point.gradient, FORCING, TURNS), memory


class _Memory(NamedTuple):
    """Of L-BFGS: a factor, the steps since it was made, newest first, how the gradient changed with each, their 1/(s . y)."""

    factor: Factor
    steps: jax.Array
    changes: jax.Array
    weights: jax.Array  # zero: nothing there
    taken: jax.Array
    x: jax.Array
    gradient: jax.Array


def _fresh(problem, x, point) -> _Memory:
    """With one number a pair of vertices, alike in all directions: traces of the blocks of cloth at rest that touches as now.

    A partial trace of a positive definite matrix is one. It takes a tenth of the time of a Newton step's factor, and, unlike
    that, does not know which way the cloth lay when the frame began, so it stays good while the cloth turns.
    """
    none = jnp.zeros((MEMORY, *x.shape), x.dtype)
    traces = [
        jnp.trace(b, axis1=1, axis2=2)[:, None, None] for b in stiffness_blocks(problem, problem.model.garment.mesh.rest, point)
    ]
    factor = factorise(problem.order, *traces)
    return _Memory(factor, none, none, jnp.zeros(MEMORY, x.dtype), jnp.zeros((), jnp.int32), x, point.gradient)


def _remembered(memory: _Memory, x, gradient) -> _Memory:
    step, change = x - memory.x, gradient - memory.gradient
    product = dot(step, change)
    # a step along which the energy is not convex teaches nothing
    good = product > jnp.finfo(x.dtype).eps * jnp.sqrt(dot(step, step) * dot(change, change))
    weight = jnp.where(good, 1 / jnp.where(good, product, 1), 0)

    def pushed(table, new):
        return jnp.where(good, jnp.concatenate([new[None], table[:-1]]), table)

    return _Memory(
        memory.factor, pushed(memory.steps, step), pushed(memory.changes, change), pushed(memory.weights, weight),
        memory.taken + 1, x, gradient,
    )  # fmt: skip


def _quasi_newton(problem, x, point, memory):
    """L-BFGS (Nocedal and Wright, algorithm 7.4) whose first matrix is that of projective dynamics (Liu et al. 2017)."""
    memory = _remembered(memory, x, point.gradient)
    memory = lax.cond(memory.taken % REFRESH == 0, lambda: _fresh(problem, x, point), lambda: memory)
    q, shares = point.gradient, []
    for k in range(MEMORY):
        share = memory.weights[k] * dot(memory.steps[k], q)
        q = q - share * memory.changes[k]
        shares.append(share)
    p = solve(problem.order, memory.factor, q)
    for k in reversed(range(MEMORY)):
        p = p + memory.steps[k] * (shares[k] - memory.weights[k] * dot(memory.changes[k], p))
    return -p, memory


DIRECTIONS = {
    "newton": Direction(lambda problem, x, point: None, _newton, patches=True),
    "quasi_newton": Direction(_fresh, _quasi_newton, patches=False),
}

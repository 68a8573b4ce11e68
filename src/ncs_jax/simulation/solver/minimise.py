"""The way to a frame's equilibrium: steps of the whole garment, and between them one of the patch that is worst off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact import self_contact
from ncs_jax.energies.inertia import G, imbalance, out_of_balance
from ncs_jax.simulation.solver.directions import DIRECTIONS
from ncs_jax.simulation.solver.patch import SIZE, Patch, pairs_of, patch_around, solve_dense
from ncs_jax.simulation.solver.problem import (
    Problem,
    evaluate,
    find_neighbours,
    line_search,
    max_displacement,
    refresh_neighbours,
    stiffness_blocks,
    trust_radius,
    with_neighbours,
)

__all__ = ["CONVERGED", "LIMIT", "NOT_FINITE", "STALLED", "Settings", "Solution", "minimise"]

CONVERGED, LIMIT, STALLED, NOT_FINITE = range(4)

SHARE = 0.5  # of the imbalance that a patch must hold to be worth a solve of its own
LOCAL = 20  # steps of a patch


@dataclass(frozen=True)
class Settings:
    """How a frame is solved.

    solver: "newton" or "quasi_newton", see `directions`. tolerance: out-of-balance acceleration, the mass-weighted r.m.s. of
    M^-1 grad E, in multiples of 9.81 m/s^2; None: 0.1 in float32, 0.001 in float64. iterations: at most, a frame; first: of the
    first frame, which starts far from rest. inertia: False: every frame is the static state in its pose. exact_pins: pins are
    held where the body carries them; otherwise by the scene's springs.
    """

    solver: str = "newton"  # or "quasi_newton", see `directions`
    tolerance: float | None = None  # out-of-balance acceleration in g; None: 0.1 in float32, 0.001 in float64
    iterations: int = 100
    first: int = 1000  # iterations of the first frame, which starts far from rest
    inertia: bool = True  # False: every frame is the static state in its pose
    exact_pins: bool = False  # pins are held where the body carries them; otherwise by the scene's springs


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """How the solve of a frame went.

    residual: out-of-balance acceleration, the mass-weighted r.m.s. of M^-1 grad E, in multiples of 9.81 m/s^2.
    status: CONVERGED (0), LIMIT (1, out of iterations), STALLED (2, no step lowers the energy) or NOT_FINITE (3).
    """

    iterations: Int[Array, "*frames"]
    residual: Float[Array, "*frames"]
    status: Int[Array, "*frames"]


def _on_patch(problem: Problem, patch: Patch) -> Problem:
    """Return the problem of a patch alone."""
    near, only = problem.neighbours, None
    if near is not None:
        only = patch.groups
        near = near if near.pairs is None else near._replace(pairs=pairs_of(patch, near.pairs))
    return replace(problem, model=patch.model, couplings=patch.couplings, only=only, neighbours=near)


def relax_patch(problem: Problem, x: Float[Array, "verts 3"], neighbours, left: Float[Array, "verts"], tolerance):
    """Return positions after the patch of the greatest imbalance came to its own equilibrium, if it holds most of what is left.

    neighbours: from `find_neighbours`. left: squared imbalances over mass, of which the patch shall keep no more than a quarter
    of `tolerance`. Returns also the neighbours found last, and how many steps the patch took.
    """
    patch = patch_around(left, problem.model, problem.couplings)
    moves = patch.place < SIZE

    def local(neighbours):
        return _on_patch(with_neighbours(problem, neighbours), patch)

    def unfinished(state):
        _, point, _, count, moved = state
        kept = jnp.sum(jnp.where(moves, imbalance(point.gradient, problem.mass), 0))
        return moved & (count < LOCAL) & (kept > 0.25 * tolerance)

    def iterate(state):
        x, point, neighbours, count, _ = state
        here, springs = local(neighbours), None
        if point.repulsion is not None:
            v, at = self_contact.springs(point.repulsion, problem.model.material.self_contact), point.repulsion.vertices
            springs = at, v if problem.free is None else v * problem.free[at][..., None]
        p = -solve_dense(patch, *stiffness_blocks(here, x, point._replace(repulsion=None)), point.gradient, springs)
        x, point, _, moved = line_search(here, None, x, point, p)
        if problem.model.terms.self_contact:

            def again():
                neighbours = find_neighbours(problem, x)
                return evaluate(local(neighbours), x), neighbours

            point, neighbours = lax.cond(
                max_displacement(x, neighbours.found_at) > trust_radius(problem, x) / 2, again, lambda: (point, neighbours)
            )
        return x, point, neighbours, count + 1, moved

    worth = patch.whole & (jnp.sum(jnp.where(moves, left, 0)) > SHARE * jnp.sum(left))
    state = (x, evaluate(local(neighbours), x), neighbours, jnp.zeros((), jnp.int32), worth)
    x, _, neighbours, count, _ = lax.while_loop(unfinished, iterate, state)
    return x, neighbours, count


def _settled(problem: Problem, judged, x, known, stale):
    """Evaluate where what is known is stale, and find what is near anew before it can no longer be trusted.

    That is in any case before the frame is done. The program has the evaluation once.

    Args:
        judged: returns status and what is left. known: point, neighbours, status, what is left. stale: whether x is another
            place than the point's; None: it never is.
    """

    def far(neighbours, status):
        if neighbours is None:
            return jnp.asarray(False)
        done = (status == CONVERGED) | (status == STALLED)
        return max_displacement(x, neighbours.found_at) > jnp.where(done, 0, trust_radius(problem, x) / 2)

    def unsettled(state):
        _, neighbours, status, _, stale = state
        return far(neighbours, status) if stale is None else stale | far(neighbours, status)

    def again(state):
        _, neighbours, _, _, stale = state
        if stale is None:
            neighbours = find_neighbours(problem, x)
        elif neighbours is not None:
            neighbours = lax.cond(stale, lambda: neighbours, lambda: find_neighbours(problem, x))
        point = evaluate(with_neighbours(problem, neighbours), x)
        return point, neighbours, *judged(point, False, x), None if stale is None else jnp.asarray(False)

    return lax.while_loop(unsettled, again, (*known, stale))[:4]


def minimise(settings: Settings, problem: Problem, start: Float[Array, "verts 3"]) -> tuple[Float[Array, "verts 3"], Solution]:
    """Return positions that minimise the energy, found from `start`, and how the solve went."""
    direction = DIRECTIONS[settings.solver]
    mass = jnp.sum(problem.mass)
    usual = 0.1 if start.dtype == jnp.float32 else 0.001
    tolerance = usual if settings.tolerance is None else settings.tolerance
    first = problem.moving <= 0 if problem.first is None else problem.first
    limit = jnp.where(first, settings.first, settings.iterations) if problem.limit is None else problem.limit

    def unfinished(state):
        *_, status, _, iteration = state
        return (status < 0) & (iteration < limit)

    def iterate(state):
        x, point, memory, neighbours, _, _, iteration = state
        p, memory = direction.along(with_neighbours(problem, neighbours), x, point, memory)
        x, point, neighbours, moved = line_search(problem, neighbours, x, point, p)
        status, left = judged(point, ~moved, p)
        if direction.patches and x.shape[0] > 4 * SIZE:

            def relax(x, neighbours):
                enough = mass * (tolerance * G) ** 2
                x, neighbours, count = relax_patch(problem, x, neighbours, imbalance(point.gradient, problem.mass), enough)
                return x, neighbours, count > 0

            x, neighbours, stale = lax.cond(status < 0, relax, lambda *same: (*same, jnp.asarray(False)), x, neighbours)
        else:
            stale = None
        if neighbours is not None or stale is not None:
            point, neighbours, status, left = _settled(problem, judged, x, (point, neighbours, status, left), stale)
        return x, point, memory, neighbours, status, left, iteration + 1

    def judged(point, stuck, p):
        left = out_of_balance(point.gradient, problem.mass)
        finite = jnp.isfinite(point.value) & jnp.isfinite(left) & jnp.all(jnp.isfinite(p))
        status = jnp.where(left <= tolerance, CONVERGED, jnp.where(stuck, STALLED, -1))
        return jnp.where(finite, status, NOT_FINITE).astype(jnp.int32), left

    neighbours = refresh_neighbours(problem, start, problem.neighbours)
    point = evaluate(with_neighbours(problem, neighbours), start)
    status, left = judged(point, False, start)
    if neighbours is not None:  # as `_settled` would, but without a program of its own: one step is taken in any case
        status = jnp.where((status == CONVERGED) & (max_displacement(start, neighbours.found_at) > 0), -1, status)
    memory = direction.begin(with_neighbours(problem, neighbours), start, point)
    state = (start, point, memory, neighbours, status, left, jnp.zeros((), jnp.int32))
    x, *_, status, left, iterations = lax.while_loop(unfinished, iterate, state)
    return x, Solution(iterations, left, jnp.where(status < 0, LIMIT, status))

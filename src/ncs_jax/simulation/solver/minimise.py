"""The way to a frame's equilibrium: steps of the whole garment, and between them one of the patch that is worst off."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact import self_contact
from ncs_jax.simulation.solver.directions import DIRECTIONS
from ncs_jax.simulation.solver.patch import SIZE, Patch, pairs_of, patch_around, solve_dense
from ncs_jax.simulation.solver.problem import (
    Problem,
    blocks,
    come,
    descended,
    evaluated,
    imbalance,
    knowing,
    look,
    looked,
    trusted,
)

__all__ = ["CONVERGED", "LIMIT", "NOT_FINITE", "STALLED", "Settings", "Solution", "minimise"]

CONVERGED, LIMIT, STALLED, NOT_FINITE = range(4)
STANDARD_GRAVITY = 9.81  # m/s^2, the unit of residuals

SHARE = 0.5  # of the imbalance that a patch must hold to be worth a solve of its own
LOCAL = 20  # steps of a patch


@dataclass(frozen=True)
class Settings:
    """How a frame is solved."""

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
    status: CONVERGED, LIMIT (out of iterations), STALLED (no step lowers the energy) or NOT_FINITE.
    """

    iterations: Int[Array, "*frames"]
    residual: Float[Array, "*frames"]
    status: Int[Array, "*frames"]


def _on_patch(problem: Problem, patch: Patch) -> Problem:
    """The same frame seen by a patch alone."""
    only = None if problem.near is None and problem.pairs is None else patch.verts
    pairs = None if problem.pairs is None else pairs_of(patch, problem.pairs)
    return replace(problem, model=patch.model, couplings=patch.couplings, only=only, pairs=pairs)


def relaxed(problem: Problem, x: Float[Array, "verts 3"], seen, left: Float[Array, "verts"], tolerance):
    """Positions after the patch of the greatest imbalance has found its own equilibrium, if it holds most of what is left.

    seen: from `look`, if anything. left: squared imbalances over mass, of which the patch shall keep no more than a quarter of
    `tolerance`. Returns also what was seen last, and how many steps the patch took.
    """
    patch = patch_around(left, problem.model, problem.couplings)
    moves = patch.place < SIZE

    def local(seen):
        return _on_patch(knowing(problem, seen), patch)

    def unfinished(state):
        _, point, _, count, moved = state
        kept = jnp.sum(jnp.where(moves, imbalance(problem, point.gradient), 0))
        return moved & (count < LOCAL) & (kept > 0.25 * tolerance)

    def iterate(state):
        x, point, seen, count, _ = state
        here, springs = local(seen), None
        if point.folds is not None:
            v = self_contact.springs(point.folds, problem.model.material.self_contact)
            springs = point.folds.vertices, v if problem.free is None else v * problem.free[point.folds.vertices][..., None]
        p = -solve_dense(patch, *blocks(here, x, point._replace(folds=None)), point.gradient, springs)
        x, point, _, moved = descended(here, None, x, point, p)
        if problem.pairs is not None:

            def again():
                seen = look(problem, x)
                return evaluated(local(seen), x), seen

            point, seen = lax.cond(come(x, seen[-1]) > trusted(problem, x) / 2, again, lambda: (point, seen))
        return x, point, seen, count + 1, moved

    worth = patch.whole & (jnp.sum(jnp.where(moves, left, 0)) > SHARE * jnp.sum(left))
    state = (x, evaluated(local(seen), x), seen, jnp.zeros((), jnp.int32), worth)
    x, _, seen, count, _ = lax.while_loop(unfinished, iterate, state)
    return x, seen, count


def minimise(settings: Settings, problem: Problem, start: Float[Array, "verts 3"]) -> tuple[Float[Array, "verts 3"], Solution]:
    """Positions that minimise the energy, found from `start`."""
    direction = DIRECTIONS[settings.solver]
    mass = jnp.sum(problem.mass)
    tolerance = settings.tolerance
    if tolerance is None:
        tolerance = 0.1 if start.dtype == jnp.float32 else 0.001
    limit = jnp.where(problem.moving > 0, settings.iterations, settings.first)

    def unfinished(state):
        *_, status, _, iteration = state
        return (status < 0) & (iteration < limit)

    def iterate(state):
        x, point, memory, seen, _, _, iteration = state
        p, memory = direction.along(knowing(problem, seen), x, point, memory)
        x, point, seen, moved = descended(problem, seen, x, point, p)
        status, left = judged(point, ~moved, p)
        if direction.patches and x.shape[0] > 4 * SIZE:

            def relax(x, point, seen):
                enough = mass * (tolerance * STANDARD_GRAVITY) ** 2
                x, seen, count = relaxed(problem, x, seen, imbalance(problem, point.gradient), enough)
                point = lax.cond(count > 0, lambda: evaluated(knowing(problem, seen), x), lambda: point)
                return x, point, seen, *judged(point, False, x)

            x, point, seen, status, left = lax.cond(status < 0, relax, lambda *same: (*same, status, left), x, point, seen)
        point, seen, status, left = looked_again(x, point, seen, status, left)
        return x, point, memory, seen, status, left, iteration + 1

    def looked_again(x, point, seen, status, left):
        """With what is near found anew before that can no longer be trusted, and in any case before the frame is done."""
        if seen is None:
            return point, seen, status, left

        def again():
            seen = look(problem, x)
            point = evaluated(knowing(problem, seen), x)
            return point, seen, *judged(point, False, x)

        done = (status == CONVERGED) | (status == STALLED)
        far = jnp.where(done, 0, trusted(problem, x) / 2)
        return lax.cond(come(x, seen[-1]) > far, again, lambda: (point, seen, status, left))

    def judged(point, stuck, p):
        left = jnp.sqrt(jnp.sum(imbalance(problem, point.gradient)) / mass) / STANDARD_GRAVITY
        finite = jnp.isfinite(point.value) & jnp.isfinite(left) & jnp.all(jnp.isfinite(p))
        status = jnp.where(left <= tolerance, CONVERGED, jnp.where(stuck, STALLED, -1))
        return jnp.where(finite, status, NOT_FINITE).astype(jnp.int32), left

    seen = None if problem.seen is None else looked(problem, start, (problem.near, problem.pairs, problem.seen))
    point = evaluated(knowing(problem, seen), start)
    status, left = judged(point, False, start)
    if seen is not None:  # as `looked_again` would, but without a program of its own: one step is taken in any case
        status = jnp.where((status == CONVERGED) & (come(start, seen[-1]) > 0), -1, status)
    memory = direction.begin(knowing(problem, seen), start, point)
    state = (start, point, memory, seen, status, left, jnp.zeros((), jnp.int32))
    x, *_, status, left, iterations = lax.while_loop(unfinished, iterate, state)
    return x, Solution(iterations, left, jnp.where(status < 0, LIMIT, status))

"""What one frame minimises: its energy, the derivative, a positive definite stiffness, and steps that accept no increase."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact import self_contact as folds
from ncs_jax.energies.contact.pairs import Pairs, nearby_pairs
from ncs_jax.energies.contact.safe_steps import free_share, swept_share
from ncs_jax.energies.contact.self_contact import Repulsion, repulsion
from ncs_jax.energies.contact.smooth import Quadrics, nearby_quadrics
from ncs_jax.energies.inertia import inertia
from ncs_jax.energies.terms import StepInputs
from ncs_jax.energies.total import energies
from ncs_jax.scene.model import Model
from ncs_jax.simulation.solver.cholesky import Elimination, factorise
from ncs_jax.simulation.solver.contact import Contact, touching
from ncs_jax.simulation.solver.stiffness import Couplings, stiffness

__all__ = ["TALL", "Point", "Problem", "apart", "blocks", "come", "descended", "dot", "energy", "evaluated", "factored",
           "imbalance", "knowing", "look", "looked", "placed", "reach", "static_step", "touched", "trusted",
           "unhindered"]  # fmt: skip

CLEARANCE = 0.01  # m: how far past the body's surface one iteration may carry a vertex, which contact then still pushes out
STATIC = 1 / 30  # s: the time step that damps the way to a static state, where the frame's own is shorter,
TALL = 2.0  # m: of garments up to this size; beyond, it grows with the root of the size, as a pendulum's period
LEAST_STEP = 1e-6  # of a step: below it the line search gives up
REACH = 2  # how far the search for self-contact looks, in thicknesses of the cloth


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """All that one frame's energy depends on beside the positions."""

    model: Model
    couplings: Couplings
    order: Elimination
    body: Float[Array, "body 3"] | None  # posed
    blended: Float[Array, "verts 3 4"] | None  # skinning transforms of the garment, where it is pinned
    target: Float[Array, "verts 3"]  # where the vertices go without forces
    force: Float[Array, "verts 3"] | None  # external, N
    moving: Float[Array, ""]  # 0: inertia is left out, the frame is static
    pinned: Float[Array, "pins 3"] | None = None  # where the pins are held, if exactly
    near: Quadrics | None = None  # the body near the garment, where contact is smooth,
    pairs: Pairs | None = None  # of cloth near cloth, where it touches itself,
    seen: Float[Array, "verts 3"] | None = None  # as both were found from here
    carried: Float[Array, "verts 3"] | None = None  # see `Frame`, where there is friction
    pressed: Float[Array, "verts 3"] | None = None
    only: Int[Array, "some"] | None = None  # the vertices that move, if not all

    @property
    def frame(self) -> StepInputs:
        """What it brings to the energies."""
        return StepInputs(1 / self.model.fps, body=self.body, blended=self.blended, carried=self.carried, pressed=self.pressed)

    @property
    def mass(self) -> Float[Array, "verts"]:
        """Of the vertices, kg."""
        return self.model.material.density * self.model.garment.mesh.vertex_area

    @property
    def free(self) -> Bool[Array, "verts"] | None:
        """Which vertices no exact pin holds; None: all."""
        return None if self.pinned is None else jnp.ones(self.target.shape[0], bool).at[self.model.garment.pins].set(False)


class Point(NamedTuple):
    """What is known of a place."""

    value: Float[Array, ""]  # J
    gradient: Float[Array, "verts 3"]  # N; zero where an exact pin holds
    contact: Contact | None
    folds: Repulsion | None


def dot(a, b):
    """Inner product of two fields."""
    return jnp.sum(a * b)


def energy(problem: Problem, x: Float[Array, "verts 3"], **without) -> Float[Array, ""]:
    """What a frame minimises, J; perhaps without some of its terms."""
    model = problem.model
    held = model.terms.pinning and problem.pinned is None
    terms = replace(model.terms, **{"inertia": False, "pinning": held, **without})
    parts = energies(x, model.garment, model.material, problem.frame, terms, model.surface)
    value = sum(parts.values(), start=jnp.zeros((), x.dtype))
    if problem.force is not None:
        value = value - dot(problem.force, x)
    return value + problem.moving * inertia(x, problem.target, problem.mass, problem.frame.dt)


def placed(problem: Problem, x: Float[Array, "verts 3"]) -> Float[Array, "verts 3"]:
    """x with the exact pins where they are held."""
    return x if problem.pinned is None else x.at[problem.model.garment.pins].set(problem.pinned)


def look(problem: Problem, x: Float[Array, "verts 3"]):
    """The body near the garment, if its contact is smooth; cloth near cloth, if it touches itself; and from where."""
    model = problem.model
    x, near, pairs = lax.stop_gradient(x), None, None
    if model.terms.collision == "smooth":
        near = nearby_quadrics(x, lax.stop_gradient(problem.body), model.surface)
    if model.terms.self_contact:
        pairs = nearby_pairs(x, model.garment.mesh, model.garment.groups, reach(problem))
    return None if near is None and pairs is None else (near, pairs, x)


def reach(problem: Problem):
    """How far the search for self-contact looks, m."""
    return REACH * problem.model.material.self_thickness


def trusted(problem: Problem, x: Float[Array, "verts 3"]) -> Float[Array, ""]:
    """How far a vertex may come from where `look` was, m, until what it left out could matter."""
    far = jnp.asarray(jnp.inf, x.dtype)
    if problem.model.terms.collision == "smooth":
        far = 2 * problem.model.surface.spacing.astype(x.dtype)
    if problem.model.terms.self_contact:
        far = jnp.minimum(far, (reach(problem) - problem.model.material.self_thickness) / 2)
    return far


def come(x: Float[Array, "verts 3"], seen: Float[Array, "verts 3"]) -> Float[Array, ""]:
    """How far a vertex has come since."""
    return jnp.sqrt(jnp.max(jnp.sum((x - seen) ** 2, axis=-1)))


def looked(problem: Problem, x: Float[Array, "verts 3"], seen):
    """What is near: found anew if a vertex has come farther since it was than can be trusted."""
    if seen is None:
        return None
    return lax.cond(come(x, seen[-1]) > trusted(problem, x), lambda: look(problem, x), lambda: seen)


def knowing(problem: Problem, seen) -> Problem:
    """The problem that knows what `look` found."""
    return problem if seen is None else replace(problem, near=seen[0], pairs=seen[1], seen=seen[2])


def touched(problem: Problem, x: Float[Array, "verts 3"]) -> Contact | None:
    """Contact with the body, where the scene has any."""
    model = problem.model
    if model.terms.collision is None:
        return None
    return touching(x, problem.body, model.surface, model.material, model.terms, problem.near, problem.only)


def evaluated(problem: Problem, x: Float[Array, "verts 3"]) -> Point:
    """Energy, gradient and contact."""
    value, gradient = jax.value_and_grad(lambda x: energy(problem, x, collision=None, self_contact=False))(x)
    contact, found = touched(problem, x), None
    if contact is not None:
        value, gradient = value + contact.energy, gradient + contact.gradient
    if problem.pairs is not None:
        material = problem.model.material
        found = repulsion(x, problem.pairs, material.self_thickness)
        value = value + jnp.where(problem.pairs.overflow, jnp.nan, folds.energy(found, material.self_contact))
        gradient = gradient + folds.gradient(found, x, material.self_contact)
    if problem.pinned is not None:
        gradient = jnp.where(problem.free[:, None], gradient, 0)
    return Point(value, gradient, contact, found)


def static_step(model: Model) -> Float[Array, ""]:
    """The time step that damps the way to a static state, s."""
    size = jnp.max(jnp.ptp(model.garment.mesh.rest, axis=0))
    return STATIC * jnp.sqrt(jnp.maximum(1, size / TALL))


def imbalance(problem: Problem, gradient: Float[Array, "verts 3"]) -> Float[Array, "verts"]:
    """Squared out-of-balance forces over mass; none where there is no mass."""
    mass = problem.mass
    return jnp.where(mass > 0, jnp.sum(gradient * gradient, axis=-1) / jnp.where(mass > 0, mass, 1), 0)


def blocks(problem: Problem, x: Float[Array, "verts 3"], point: Point):
    """Blocks of a positive definite approximation of the energy's Hessian; of self-contact those of single vertices."""
    model, terms = problem.model, problem.model.terms
    if problem.pinned is not None:
        terms = replace(terms, pinning=False)
    touching = None if point.contact is None else point.contact.blocks
    diagonal, off = stiffness(x, problem.couplings, model.garment, model.material, problem.frame, terms, touching)
    # Without inertia the mass still holds what nothing else does: it damps the way to the static state, however short a frame.
    mass, dt = problem.mass, problem.frame.dt
    dt = jnp.where(problem.moving > 0, dt, jnp.maximum(dt, static_step(model)))
    weight = jnp.where(mass > 0, mass, jnp.mean(mass)) / dt**2
    if problem.pinned is not None:
        off = jnp.where(jnp.all(problem.free[problem.couplings.pairs], axis=1)[:, None, None], off, 0)
    if point.folds is not None:
        diagonal = diagonal + folds.blocks(point.folds, x, model.material.self_contact)
    return diagonal + weight[:, None, None] * jnp.eye(3, dtype=x.dtype)[None], off


def factored(problem: Problem, x: Float[Array, "verts 3"], point: Point):
    """Their Cholesky factor."""
    return factorise(problem.order, *blocks(problem, x, point))


def apart(problem: Problem, x: Float[Array, "verts 3"], p: Float[Array, "verts 3"]):
    """The share of the way p on which no cloth can pass through other cloth, or a patch come near what is not known."""
    left = reach(problem) - 2 * come(x, problem.seen)  # what was not found is at least so far apart
    if problem.only is not None:
        left = left - problem.model.material.self_thickness
    share = free_share(x, p, problem.pairs, jnp.maximum(left, 0))
    if problem.only is not None:
        return share

    def swept():
        found, full = swept_share(x, p, problem.model.garment.mesh, problem.model.garment.groups)
        return jnp.where(full, share, jnp.maximum(found, share))

    return lax.cond(share < 1, swept, lambda: share)


def unhindered(contact: Contact | None, p: Float[Array, "verts 3"]):
    """The share of a vertex's way p that does not carry it through the body: to the surface, and a little into it."""
    if contact is None:
        return jnp.ones((), p.dtype)
    reach = jnp.maximum(contact.distance, 0) * 0.9 + CLEARANCE
    length = jnp.sqrt(jnp.sum(p * p, axis=-1))
    return jnp.minimum(1, reach / jnp.maximum(length, jnp.finfo(p.dtype).tiny))


def descended(problem: Problem, seen, x: Float[Array, "verts 3"], point: Point, p: Float[Array, "verts 3"]):
    """As far along p as the energy falls: the new positions, what is known of them, what is near, and whether they moved.

    seen: from `look`, and found anew where a step goes far; None: as the problem knows it.
    """
    slope = dot(point.gradient, p)
    noise = 16 * jnp.finfo(x.dtype).eps * jnp.abs(point.value)  # of a sum over a garment; with 4 eps float32 stalls

    longest = jnp.min(unhindered(point.contact, p))
    if problem.pairs is not None:
        longest = jnp.minimum(longest, apart(knowing(problem, seen), x, p))

    def too_long(search):
        t, new, _ = search
        lower = new.value <= point.value + 1e-4 * t * slope
        # Where the fall is less than the energy's rounding, the slope tells: it must not have turned.
        level = (jnp.abs(new.value - point.value) <= noise) & (dot(new.gradient, p) <= 0) & (-t * slope <= noise)
        return (t > longest) | ~(lower | level) & (t > LEAST_STEP)

    def shorter(search):
        t = search[0] / 2
        there = x + t * p
        near = looked(problem, there, seen)
        return t, evaluated(knowing(problem, near), there), near

    t, *new = lax.while_loop(too_long, shorter, (2 * longest, point, seen))
    moved = t > LEAST_STEP
    point, seen = jax.tree.map(functools.partial(jnp.where, moved), tuple(new), (point, seen))
    return jnp.where(moved, x + t * p, x), point, seen, moved

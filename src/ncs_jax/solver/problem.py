"""What one frame minimises: its energy, the derivative, a positive definite stiffness, and steps that accept no increase."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.inertia import inertia
from ncs_jax.energies.smooth_contact import Quadrics, nearby_quadrics
from ncs_jax.model import Model
from ncs_jax.objective import Frame, energies
from ncs_jax.solver.cholesky import Elimination, factorise
from ncs_jax.solver.contact import Contact, touching
from ncs_jax.solver.stiffness import Couplings, stiffness

__all__ = ["Point", "Problem", "blocks", "descended", "dot", "energy", "evaluated", "factored", "imbalance", "look", "placed",
           "touched", "unhindered", "with_body_near"]  # fmt: skip

CLEARANCE = 0.01  # m: how far past the body's surface one iteration may carry a vertex, which contact then still pushes out
LEAST_STEP = 1e-6  # of a step: below it the line search gives up


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
    seen: Float[Array, "verts 3"] | None = None  # as it was found from here
    carried: Float[Array, "verts 3"] | None = None  # see `Frame`, where there is friction
    pressed: Float[Array, "verts 3"] | None = None
    only: Int[Array, "some"] | None = None  # the vertices whose contact changes, if not all

    @property
    def frame(self) -> Frame:
        """What it brings to the energies."""
        return Frame(1 / self.model.fps, body=self.body, blended=self.blended, carried=self.carried, pressed=self.pressed)

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


def dot(a, b):
    """Inner product of two fields."""
    return jnp.sum(a * b)


def energy(problem: Problem, x: Float[Array, "verts 3"], **without) -> Float[Array, ""]:
    """What a frame minimises, J; perhaps without some of its terms."""
    model = problem.model
    terms = replace(model.terms, inertia=False, pinning=model.terms.pinning and problem.pinned is None, **without)
    parts = energies(x, model.garment, model.material, problem.frame, terms, model.surface)
    value = sum(parts.values(), start=jnp.zeros((), x.dtype))
    if problem.force is not None:
        value = value - dot(problem.force, x)
    return value + problem.moving * inertia(x, problem.target, problem.mass, problem.frame.dt)


def placed(problem: Problem, x: Float[Array, "verts 3"]) -> Float[Array, "verts 3"]:
    """x with the exact pins where they are held."""
    return x if problem.pinned is None else x.at[problem.model.garment.pins].set(problem.pinned)


def look(problem: Problem, x: Float[Array, "verts 3"]):
    """The body near the garment, if its contact is smooth, and from where it was seen."""
    if problem.model.terms.collision != "smooth":
        return None
    x, body = lax.stop_gradient(x), lax.stop_gradient(problem.body)
    return nearby_quadrics(x, body, problem.model.surface), x


def with_body_near(problem: Problem, seen) -> Problem:
    """The problem that knows what `look` found."""
    return problem if seen is None else replace(problem, near=seen[0], seen=seen[1])


def touched(problem: Problem, x: Float[Array, "verts 3"]) -> Contact | None:
    """Contact with the body, where the scene has any."""
    model = problem.model
    if model.terms.collision is None:
        return None
    return touching(x, problem.body, model.surface, model.material, model.terms, problem.near, problem.only)


def evaluated(problem: Problem, x: Float[Array, "verts 3"]) -> Point:
    """Energy, gradient and contact."""
    value, gradient = jax.value_and_grad(lambda x: energy(problem, x, collision=None))(x)
    contact = touched(problem, x)
    if contact is not None:
        value, gradient = value + contact.energy, gradient + contact.gradient
    if problem.pinned is not None:
        gradient = jnp.where(problem.free[:, None], gradient, 0)
    return Point(value, gradient, contact)


def imbalance(problem: Problem, gradient: Float[Array, "verts 3"]) -> Float[Array, "verts"]:
    """Squared out-of-balance forces over mass; none where there is no mass."""
    mass = problem.mass
    return jnp.where(mass > 0, jnp.sum(gradient * gradient, axis=-1) / jnp.where(mass > 0, mass, 1), 0)


def blocks(problem: Problem, x: Float[Array, "verts 3"], contact: Contact | None):
    """Blocks of a positive definite approximation of the energy's Hessian."""
    model, terms = problem.model, problem.model.terms
    if problem.pinned is not None:
        terms = replace(terms, pinning=False)
    touching = None if contact is None else contact.blocks
    diagonal, off = stiffness(x, problem.couplings, model.garment, model.material, problem.frame, terms, touching)
    # Without inertia the mass still holds what nothing else does: it damps the way to the static state.
    mass = problem.mass
    weight = jnp.where(mass > 0, mass, jnp.mean(mass)) / problem.frame.dt**2
    if problem.pinned is not None:
        off = jnp.where(jnp.all(problem.free[problem.couplings.pairs], axis=1)[:, None, None], off, 0)
    return diagonal + weight[:, None, None] * jnp.eye(3, dtype=x.dtype)[None], off


def factored(problem: Problem, x: Float[Array, "verts 3"], contact: Contact | None):
    """Their Cholesky factor."""
    return factorise(problem.order, *blocks(problem, x, contact))


def unhindered(contact: Contact | None, p: Float[Array, "verts 3"]):
    """The share of a vertex's way p that does not carry it through the body: to the surface, and a little into it."""
    if contact is None:
        return jnp.ones((), p.dtype)
    reach = jnp.maximum(contact.distance, 0) * 0.9 + CLEARANCE
    length = jnp.sqrt(jnp.sum(p * p, axis=-1))
    return jnp.minimum(1, reach / jnp.maximum(length, jnp.finfo(p.dtype).tiny))


def descended(problem: Problem, x: Float[Array, "verts 3"], point: Point, p: Float[Array, "verts 3"]):
    """As far along p as the energy falls: the new positions, what is known of them, and whether they moved."""
    slope = dot(point.gradient, p)
    noise = 16 * jnp.finfo(x.dtype).eps * jnp.abs(point.value)  # of a sum over a garment; with 4 eps float32 stalls

    def too_long(search):
        t, new = search
        lower = new.value <= point.value + 1e-4 * t * slope
        # Where the fall is less than the energy's rounding, the slope tells: it must not have turned.
        level = (jnp.abs(new.value - point.value) <= noise) & (dot(new.gradient, p) <= 0) & (-t * slope <= noise)
        return ~(lower | level) & (t > LEAST_STEP)

    def at(t):
        return t, evaluated(problem, x + t * p)

    t, new = lax.while_loop(too_long, lambda search: at(search[0] / 2), at(jnp.min(unhindered(point.contact, p))))
    moved = t > LEAST_STEP
    point = jax.tree.map(functools.partial(jnp.where, moved), new, point)
    return jnp.where(moved, x + t * p, x), point, moved

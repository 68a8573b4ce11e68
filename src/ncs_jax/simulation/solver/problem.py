"""What one frame minimises: its energy, the derivative, a positive definite stiffness, and steps that accept no increase."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact import self_contact
from ncs_jax.energies.contact.layers import layer_blocks
from ncs_jax.energies.contact.pairs import Pairs, nearby_pairs
from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.contact.safe_steps import free_share, swept_share
from ncs_jax.energies.contact.self_contact import Repulsion, repulsion
from ncs_jax.energies.contact.smooth import Quadrics, nearby_quadrics
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.energies.elements import energies_and_gradient
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import required
from ncs_jax.scene.model import Model
from ncs_jax.simulation.solver.cholesky import Elimination, factorise
from ncs_jax.simulation.solver.contact import Contact, evaluate_contact
from ncs_jax.simulation.solver.stiffness import Couplings, stiffness

__all__ = [
    "LEAST_STEP",
    "TALL",
    "Neighbours",
    "Point",
    "Problem",
    "accepts",
    "body_contact",
    "collision_free_step",
    "dot",
    "energy",
    "evaluate",
    "factor_stiffness",
    "find_neighbours",
    "hold_pins",
    "line_search",
    "max_displacement",
    "refresh_neighbours",
    "search_radius",
    "share_outside_body",
    "static_step",
    "stiffness_blocks",
    "trust_radius",
    "with_neighbours",
]

CLEARANCE = 0.01  # m: how far past the body's surface one iteration may carry a vertex, which contact then still pushes out
STATIC = 1 / 30  # s: the time step that damps the way to a static state, where the frame's own is shorter,
TALL = 2.0  # m: of garments up to this size; beyond, it grows with the root of the size, as a pendulum's period
LEAST_STEP = 1e-6  # of a step: below it the line search gives up
REACH = 2  # how far the search for self-contact looks, in thicknesses of the cloth


class Neighbours(NamedTuple):
    """What is near the garment where it was looked for."""

    quadrics: Quadrics | None  # the body near the garment, where contact is smooth
    pairs: Pairs | None  # cloth near cloth, where the garment touches itself
    found_at: Float[Array, "verts 3"]  # the positions then, m


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """All that one frame's energy depends on beside the positions."""

    model: Model
    couplings: Couplings
    order: Elimination | None  # None: nothing is factorised here
    inputs: StepInputs  # with `moving` 0 where inertia is left out, and the frame is static
    pinned: Float[Array, "pins 3"] | None = None  # where the pins are held, if exactly
    neighbours: Neighbours | None = None
    only: Bool[Array, "blocks"] | None = None  # of a patch: in which groups of cloth, as the surface has them, something moves
    first: Bool[Array, ""] | None = None  # whether no frame was before; None: a static one is taken for that
    limit: Int[Array, ""] | None = None  # of iterations; None: the settings'

    @property
    def step(self) -> StepInputs:
        """Return the inputs, their time step a number of the program: as an array its square would be rounded twice."""
        return replace(self.inputs, dt=1 / self.model.fps)

    @property
    def terms(self) -> Terms:
        """Return those that are minimised: pins that are held exactly are none."""
        terms = self.model.terms
        return replace(terms, pinning=terms.pinning and self.pinned is None)

    @property
    def mass(self) -> Float[Array, "verts"]:
        """Return the vertices' masses, kg."""
        return self.model.material.density * self.model.garment.mesh.vertex_area

    @property
    def moving(self) -> Float[Array, ""]:
        """Return 1, or 0 in a static frame."""
        return required(self.inputs.moving, "inputs.moving")

    @property
    def thickness(self) -> Float[Array, ""]:
        """Return how near cloth comes to cloth, m."""
        return required(self.model.material.self_thickness, "material.self_thickness")

    @property
    def surface(self) -> Surface:
        """Return the touchable body."""
        return required(self.model.surface, "model.surface")

    @property
    def free(self) -> Bool[Array, "verts"] | None:
        """Return which vertices no exact pin holds; None: all."""
        return None if self.pinned is None else jnp.ones(self.mass.shape, bool).at[self.model.garment.pins].set(False)


class Point(NamedTuple):
    """What is known of a place."""

    value: Float[Array, ""]  # J
    gradient: Float[Array, "verts 3"]  # N; zero where an exact pin holds
    contact: Contact | None
    repulsion: Repulsion | None


def dot(a, b):
    """Return the inner product of two fields."""
    return jnp.sum(a * b)


def energy(problem: Problem, x: Float[Array, "verts 3"]) -> Float[Array, ""]:
    """Return what a frame minimises, J."""
    model = problem.model
    parts = energy_terms(x, model.garment, model.material, problem.step, problem.terms, model.surface)
    return sum(parts.values(), start=jnp.zeros((), x.dtype))


def hold_pins(problem: Problem, x: Float[Array, "verts 3"]) -> Float[Array, "verts 3"]:
    """Return x with the exact pins where they are held."""
    return x if problem.pinned is None else x.at[problem.model.garment.pins].set(problem.pinned)


def find_neighbours(problem: Problem, x: Float[Array, "verts 3"]) -> Neighbours | None:
    """Find the body near the garment, if its contact is smooth, and cloth near cloth, if it touches itself; else None."""
    model = problem.model
    x, quadrics, pairs = lax.stop_gradient(x), None, None
    if model.terms.collision == "smooth":
        body = lax.stop_gradient(required(problem.step.body, "step.body"))
        quadrics = nearby_quadrics(with_points(x, problem.surface.points), body, problem.surface)
    if model.terms.self_contact:
        pairs = nearby_pairs(x, model.garment.mesh, required(model.garment.groups, "garment.groups"), search_radius(problem))
    return None if quadrics is None and pairs is None else Neighbours(quadrics, pairs, x)


def search_radius(problem: Problem):
    """Return how far the search for self-contact looks, m."""
    return REACH * problem.thickness


def trust_radius(problem: Problem, x: Float[Array, "verts 3"]) -> Float[Array, ""]:
    """Return how far a vertex may come from where neighbours were found, m, until what was left out could matter."""
    far = jnp.asarray(jnp.inf, x.dtype)
    if problem.model.terms.collision == "smooth":
        far = 2 * problem.surface.spacing.astype(x.dtype)
    if problem.model.terms.self_contact:
        far = jnp.minimum(far, (search_radius(problem) - problem.thickness) / 2)
    return far


def max_displacement(x: Float[Array, "verts 3"], since: Float[Array, "verts 3"]) -> Float[Array, ""]:
    """Return how far a vertex has come since, at most, m."""
    return jnp.sqrt(jnp.max(jnp.sum((x - since) ** 2, axis=-1)))


def refresh_neighbours(problem: Problem, x: Float[Array, "verts 3"], neighbours: Neighbours | None) -> Neighbours | None:
    """Return what is near: found anew if a vertex has come farther since it was than can be trusted."""
    if neighbours is None:
        return None
    far = max_displacement(x, neighbours.found_at) > trust_radius(problem, x)
    return lax.cond(far, lambda: find_neighbours(problem, x), lambda: neighbours)


def with_neighbours(problem: Problem, neighbours: Neighbours | None) -> Problem:
    """Return the problem that knows what is near."""
    return problem if neighbours is None else replace(problem, neighbours=neighbours)


def body_contact(problem: Problem, x: Float[Array, "verts 3"]) -> Contact | None:
    """Return contact with the body, where the scene has any."""
    model = problem.model
    if model.terms.collision is None:
        return None
    quadrics = None if problem.neighbours is None else problem.neighbours.quadrics
    return evaluate_contact(x, problem.step, problem.surface, model.material, model.terms, quadrics, problem.only)


def evaluate(problem: Problem, x: Float[Array, "verts 3"]) -> Point:
    """Return energy, gradient and contact."""
    model, pairs = problem.model, None if problem.neighbours is None else problem.neighbours.pairs
    others = replace(problem.terms, collision=None, self_contact=False)
    parts, gradient, _ = energies_and_gradient(x, model.garment, model.material, problem.step, others)
    value = sum(parts.values(), start=jnp.zeros((), x.dtype))
    contact, found = body_contact(problem, x), None
    if contact is not None:
        value, gradient = value + contact.energy, gradient + contact.gradient
    if pairs is not None:
        stiff = required(model.material.self_contact, "material.self_contact")
        found = repulsion(x, pairs, problem.thickness)
        value = value + jnp.where(pairs.overflow, jnp.nan, self_contact.energy(found, stiff))
        gradient = gradient + self_contact.gradient(found, x, stiff)
    if (free := problem.free) is not None:
        gradient = jnp.where(free[:, None], gradient, 0)
    return Point(value, gradient, contact, found)


def static_step(model: Model) -> Float[Array, ""]:
    """Return the time step that damps the way to a static state, s."""
    size = jnp.max(jnp.ptp(model.garment.mesh.rest, axis=0))
    return STATIC * jnp.sqrt(jnp.maximum(1, size / TALL))


def stiffness_blocks(problem: Problem, x: Float[Array, "verts 3"], point: Point):
    """Return blocks of a positive definite approximation of the energy's Hessian; of self-contact those of single vertices."""
    model, step = problem.model, problem.step
    contact = None if point.contact is None else point.contact.blocks
    diagonal, off = stiffness(x, problem.couplings, model.garment, model.material, step, problem.terms, contact)
    # Without inertia the mass still holds what nothing else does: it damps the way to the static state, however short a frame.
    mass, dt = problem.mass, step.dt
    dt = jnp.where(problem.moving > 0, dt, jnp.maximum(dt, static_step(model)))
    weight = jnp.where(mass > 0, mass, jnp.mean(mass)) / dt**2
    if (free := problem.free) is not None:
        off = jnp.where(jnp.all(free[problem.couplings.pairs], axis=1)[:, None, None], off, 0)
    if point.repulsion is not None:
        stiff = required(model.material.self_contact, "material.self_contact")
        diagonal = diagonal + self_contact.blocks(point.repulsion, x, stiff)
    if problem.terms.layers:
        diagonal = diagonal + layer_blocks(x, model.garment.uppers, model.material.thickness, model.material.collision)
    return diagonal + weight[:, None, None] * jnp.eye(3, dtype=x.dtype)[None], off


def factor_stiffness(problem: Problem, x: Float[Array, "verts 3"], point: Point):
    """Return the Cholesky factor of `stiffness_blocks`."""
    return factorise(required(problem.order, "order"), *stiffness_blocks(problem, x, point))


def collision_free_step(problem: Problem, x: Float[Array, "verts 3"], p: Float[Array, "verts 3"]):
    """Return the share of the way p on which no cloth can pass through other cloth, or a patch come near what is not known."""
    near = required(problem.neighbours, "neighbours")
    # what was not found is at least so far apart
    left = search_radius(problem) - 2 * max_displacement(x, near.found_at)
    if problem.only is not None:
        left = left - problem.thickness
    share = free_share(x, p, required(near.pairs, "neighbours.pairs"), jnp.maximum(left, 0))
    if problem.only is not None:
        return share

    def swept():
        found, full = swept_share(x, p, problem.model.garment.mesh, problem.model.garment.groups)
        return jnp.where(full, share, jnp.maximum(found, share))

    return lax.cond(share < 1, swept, lambda: share)


def share_outside_body(problem: Problem, contact: Contact | None, p: Float[Array, "verts 3"]):
    """Return the share of a vertex's way p that carries nothing through the body: to the surface, and a little into it.

    What a vertex carries is itself and the points of contact on its triangles.
    """
    if contact is None:
        return jnp.ones((), p.dtype)
    reach = jnp.maximum(contact.distance, 0) * 0.9 + CLEARANCE
    points, verts = problem.couplings.points, len(p)
    p = with_points(p, points)
    length = jnp.sqrt(jnp.sum(p * p, axis=-1))
    share = jnp.minimum(1, reach / jnp.maximum(length, jnp.finfo(p.dtype).tiny))
    if points is None:
        return share
    carried = jnp.where(points.weights > 0, share[verts:, None], 1)
    return share[:verts].at[points.corners].min(carried)


def accepts(point: Point, new: Point, t, p: Float[Array, "verts 3"]):
    """Return whether the energy falls enough from a place to one that is t p away."""
    slope = dot(point.gradient, p)
    noise = 16 * jnp.finfo(p.dtype).eps * jnp.abs(point.value)  # of a sum over a garment; with 4 eps float32 stalls
    lower = new.value <= point.value + 1e-4 * t * slope
    # Where the fall is less than the energy's rounding, the slope tells: it must not have turned.
    level = (jnp.abs(new.value - point.value) <= noise) & (dot(new.gradient, p) <= 0) & (-t * slope <= noise)
    return lower | level


def line_search(
    problem: Problem, neighbours: Neighbours | None, x: Float[Array, "verts 3"], point: Point, p: Float[Array, "verts 3"]
):
    """Go as far along p as the energy falls: return the place, what is known of it, what is near, and whether it is another.

    neighbours: found anew where a step goes far; None: as the problem knows them.
    """
    longest = jnp.min(share_outside_body(problem, point.contact, p))
    if problem.model.terms.self_contact:
        longest = jnp.minimum(longest, collision_free_step(with_neighbours(problem, neighbours), x, p))

    def too_long(search):
        t, new, _ = search
        return (t > longest) | ~accepts(point, new, t, p) & (t > LEAST_STEP)

    def shorter(search):
        t = search[0] / 2
        there = x + t * p
        near = refresh_neighbours(problem, there, neighbours)
        return t, evaluate(with_neighbours(problem, near), there), near

    t, *new = lax.while_loop(too_long, shorter, (2 * longest, point, neighbours))
    moved = t > LEAST_STEP
    point, neighbours = jax.tree.map(functools.partial(jnp.where, moved), tuple(new), (point, neighbours))
    return jnp.where(moved, x + t * p, x), point, neighbours, moved

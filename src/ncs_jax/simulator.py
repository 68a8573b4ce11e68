"""Full-space simulation: every frame is one step of implicit Euler, the minimum of the energy that trains the network.

    x_t = argmin_x  E(x) + 1/(2 dt^2) sum_v m |x - x_proj|^2,   x_proj = 2 x_{t-1} - x_{t-2}

The minimum is found by projected Newton: element Hessians made positive semi-definite, a sparse Cholesky factorisation, and a
line search that accepts no increase. Between two steps of the whole, the patch that holds most of the imbalance finds its own
equilibrium (see `patch`). Source: Baraff and Witkin 1998; Martin et al. 2011; Teran et al. 2005; Lanzkron et al. 1996.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.cholesky import Elimination, elimination, factorise, solve
from ncs_jax.contact import Contact, touching
from ncs_jax.energies.inertia import inertia, project
from ncs_jax.energies.smooth_contact import Quadrics, nearby_quadrics
from ncs_jax.kinematics import blend, forward, skin, transforms, unpose
from ncs_jax.model import Model, pose_body
from ncs_jax.motion import Track
from ncs_jax.objective import Frame, energies
from ncs_jax.patch import SIZE, Patch, patch_around, solve_dense
from ncs_jax.stiffness import Couplings, couplings_from, stiffness

__all__ = ["CONVERGED", "LIMIT", "NOT_FINITE", "STALLED", "Settings", "Simulation", "Simulator", "Solution", "simulate",
           "simulator_from", "stepper"]  # fmt: skip

CONVERGED, LIMIT, STALLED, NOT_FINITE = range(4)
STANDARD_GRAVITY = 9.81  # m/s^2, the unit of residuals

CLEARANCE = 0.01  # m: how far past the body's surface one iteration may carry a vertex, which contact then still pushes out
LEAST_STEP = 1e-6  # of a Newton step: below it the line search gives up
SHARE = 0.5  # of the imbalance that a patch must hold to be worth a solve of its own
LOCAL = 20  # steps of a patch


@dataclass(frozen=True)
class Settings:
    """How a frame is solved. tolerance: out-of-balance acceleration in g; None: 0.1 in float32, 0.001 in float64."""

    tolerance: float | None = None
    iterations: int = 100
    first: int = 1000  # iterations of the first frame, which starts far from rest
    inertia: bool = True  # False: every frame is the static state in its pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Simulator:
    """A model with what its solver finds out once: which vertices couple, and in which order they are eliminated."""

    model: Model
    couplings: Couplings
    order: Elimination


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """What goes from frame to frame: the two last positions, the same two unposed, how the last solve went."""

    previous: Float[Array, "verts 3"]
    before: Float[Array, "verts 3"]
    unposed: Float[Array, "verts 3"]
    unposed_before: Float[Array, "verts 3"]
    started: Bool[Array, ""]
    solution: Solution


class Simulation(NamedTuple):
    """`init() -> state`; `step(state, rotations, translation) -> (state, vertices)`, as of a network's `Rollout`."""

    init: Callable
    step: Callable
    follow: Callable  # the same step from the joints' transforms (joints, 3, 4)


def simulator_from(model: Model) -> Simulator:
    """Precompute a model's couplings and order of elimination."""
    couplings = couplings_from(model.garment.mesh)
    return Simulator(model, couplings, elimination(np.asarray(couplings.pairs), np.asarray(model.garment.mesh.rest)))


def _dot(a, b):
    return jnp.sum(a * b)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Step:
    """All that one frame's energy depends on beside the positions."""

    simulator: Simulator
    body: Float[Array, "body 3"] | None  # posed
    blended: Float[Array, "verts 3 4"] | None  # skinning transforms of the garment, where it is pinned
    target: Float[Array, "verts 3"]  # where the vertices go without forces
    force: Float[Array, "verts 3"] | None  # external, N
    moving: Float[Array, ""]  # 0: inertia is left out, the frame is static
    near: Quadrics | None = None  # the body near the garment, where contact is smooth,
    seen: Float[Array, "verts 3"] | None = None  # as it was found from here
    only: Int[Array, "some"] | None = None  # the vertices whose contact changes, if not all

    @property
    def frame(self) -> Frame:
        return Frame(1 / self.simulator.model.fps, body=self.body, blended=self.blended)


def _energy(step: Step, x: Float[Array, "verts 3"], **without) -> Float[Array, ""]:
    """What a frame minimises, J; perhaps without some of its terms."""
    model = step.simulator.model
    mass = model.material.density * model.garment.mesh.vertex_area
    terms = replace(model.terms, inertia=False, **without)
    parts = energies(x, model.garment, model.material, step.frame, terms, model.surface)
    value = sum(parts.values(), start=jnp.zeros((), x.dtype))
    if step.force is not None:
        value = value - _dot(step.force, x)
    return value + step.moving * inertia(x, step.target, mass, step.frame.dt)


def _touching(step: Step, x: Float[Array, "verts 3"]) -> Contact | None:
    model = step.simulator.model
    if model.terms.collision is None:
        return None
    return touching(x, step.body, model.surface, model.material, model.terms, step.near, step.only)


def _look(step: Step, x: Float[Array, "verts 3"]):
    """The body near the garment, if its contact is smooth, and from where it was seen."""
    model = step.simulator.model
    if model.terms.collision != "smooth":
        return None
    x, body = lax.stop_gradient(x), lax.stop_gradient(step.body)
    return nearby_quadrics(x, body, model.surface), x


def _with(step: Step, seen) -> Step:
    return step if seen is None else replace(step, near=seen[0], seen=seen[1])


def _evaluated(step: Step, x: Float[Array, "verts 3"]):
    """Energy, gradient and contact."""
    value, gradient = jax.value_and_grad(lambda x: _energy(step, x, collision=None))(x)
    contact = _touching(step, x)
    return (value, gradient, None) if contact is None else (value + contact.energy, gradient + contact.gradient, contact)


def _blocks(step: Step, x: Float[Array, "verts 3"], contact: Contact | None):
    """Blocks of a positive definite approximation of the energy's Hessian."""
    simulator, model = step.simulator, step.simulator.model
    touching = None if contact is None else contact.blocks
    diagonal, off = stiffness(x, simulator.couplings, model.garment, model.material, step.frame, model.terms, touching)
    # Without inertia the mass still holds what nothing else does: it damps the way to the static state.
    mass = model.material.density * model.garment.mesh.vertex_area
    weight = jnp.where(mass > 0, mass, jnp.mean(mass)) / step.frame.dt**2
    return diagonal + weight[:, None, None] * jnp.eye(3, dtype=x.dtype)[None], off


def _factored(step: Step, x: Float[Array, "verts 3"], contact):
    return factorise(step.simulator.order, *_blocks(step, x, contact))


def _descended(step: Step, x: Float[Array, "verts 3"], point, p: Float[Array, "verts 3"]):
    """As far along p as the energy falls: the new positions, their `_evaluated`, and whether they moved."""
    value, gradient, contact = point
    slope = _dot(gradient, p)
    noise = 16 * jnp.finfo(x.dtype).eps * jnp.abs(value)  # of a sum over a garment; with 4 eps float32 stalls

    def too_long(search):
        t, (new, there, _) = search
        lower = new <= value + 1e-4 * t * slope
        # Where the fall is less than the energy's rounding, the slope tells: it must not have turned.
        level = (jnp.abs(new - value) <= noise) & (_dot(there, p) <= 0) & (-t * slope <= noise)
        return ~(lower | level) & (t > LEAST_STEP)

    def at(t):
        return t, _evaluated(step, x + t * p)

    t, new = lax.while_loop(too_long, lambda search: at(search[0] / 2), at(jnp.min(_unhindered(contact, p))))
    moved = t > LEAST_STEP
    point = jax.tree.map(functools.partial(jnp.where, moved), new, point)
    return jnp.where(moved, x + t * p, x), point, moved


def _on_patch(step: Step, patch: Patch) -> Step:
    """The same frame seen by a patch alone."""
    simulator = replace(step.simulator, model=patch.model, couplings=patch.couplings)
    return replace(step, simulator=simulator, only=None if step.near is None else patch.verts)


def _relaxed(step: Step, x: Float[Array, "verts 3"], left: Float[Array, "verts"], tolerance):
    """Positions after the patch of the greatest imbalance has found its own equilibrium, if it holds most of what is left.

    left: squared imbalances over mass, of which the patch shall keep no more than a quarter of `tolerance`. Returns also how
    many steps the patch took.
    """
    patch = patch_around(left, step.simulator.model, step.simulator.couplings)
    local = _on_patch(step, patch)
    moves = patch.place < SIZE

    def imbalance(point):
        return jnp.where(moves, _imbalance(step, point[1]), 0)

    def unfinished(state):
        _, point, count, moved = state
        return moved & (count < LOCAL) & (jnp.sum(imbalance(point)) > 0.25 * tolerance)

    def iterate(state):
        x, point, count, _ = state
        _, gradient, contact = point
        p = -solve_dense(patch, *_blocks(local, x, contact), gradient)
        x, point, moved = _descended(local, x, point, p)
        return x, point, count + 1, moved

    worth = patch.whole & (jnp.sum(jnp.where(moves, left, 0)) > SHARE * jnp.sum(left))
    state = (x, _evaluated(local, x), jnp.zeros((), jnp.int32), worth)
    x, _, count, _ = lax.while_loop(unfinished, iterate, state)
    return x, count


def _imbalance(step: Step, gradient: Float[Array, "verts 3"]) -> Float[Array, "verts"]:
    """Squared out-of-balance forces over mass; none where there is no mass."""
    mass = step.simulator.model.material.density * step.simulator.model.garment.mesh.vertex_area
    return jnp.where(mass > 0, jnp.sum(gradient * gradient, axis=-1) / jnp.where(mass > 0, mass, 1), 0)


def _minimise(settings: Settings, problem: Step, start: Float[Array, "verts 3"]) -> tuple[Float[Array, "verts 3"], Solution]:
    """Positions that minimise the energy, found from `start`."""
    model = problem.simulator.model
    mass = jnp.sum(model.material.density * model.garment.mesh.vertex_area)
    tolerance = settings.tolerance
    if tolerance is None:
        tolerance = 0.1 if start.dtype == jnp.float32 else 0.001
    limit = jnp.where(problem.moving > 0, settings.iterations, settings.first)

    def unfinished(state):
        *_, status, _, iteration = state
        return (status < 0) & (iteration < limit)

    def iterate(state):
        x, point, seen, _, _, iteration = state
        step = _with(problem, seen)
        _, gradient, contact = point
        p = -solve(step.simulator.order, _factored(step, x, contact), gradient)
        x, point, moved = _descended(step, x, point, p)
        status, left = judged(point, ~moved, p)
        if x.shape[0] > 4 * SIZE:

            def relax(x, point):
                x, count = _relaxed(step, x, _imbalance(step, point[1]), mass * (tolerance * STANDARD_GRAVITY) ** 2)
                point = lax.cond(count > 0, lambda: _evaluated(step, x), lambda: point)
                return x, point, *judged(point, False, x)

            x, point, status, left = lax.cond(status < 0, relax, lambda x, point: (x, point, status, left), x, point)
        return x, *looked_again(x, point, seen, status, left), iteration + 1

    def looked_again(x, point, seen, status, left):
        """With the body found anew where a vertex has come far since it was, and before the frame is done in any case."""
        if seen is None:
            return point, seen, status, left

        def again():
            seen = _look(problem, x)
            point = _evaluated(_with(problem, seen), x)
            return point, seen, *judged(point, status == STALLED, x)

        come = jnp.max(jnp.sum((x - seen[1]) ** 2, axis=-1))
        far = jnp.where(status == CONVERGED, 0, model.surface.spacing.astype(x.dtype) ** 2)
        return lax.cond(come > far, again, lambda: (point, seen, status, left))

    def judged(point, stuck, p):
        value, gradient, _ = point
        left = jnp.sqrt(jnp.sum(_imbalance(problem, gradient)) / mass) / STANDARD_GRAVITY
        finite = jnp.isfinite(value) & jnp.isfinite(left) & jnp.all(jnp.isfinite(p))
        status = jnp.where(left <= tolerance, CONVERGED, jnp.where(stuck, STALLED, -1))
        return jnp.where(finite, status, NOT_FINITE).astype(jnp.int32), left

    seen = None if problem.near is None else (problem.near, problem.seen)
    point = _evaluated(problem, start)
    state = (start, *looked_again(start, point, seen, *judged(point, False, start)), jnp.zeros((), jnp.int32))
    x, _, _, status, left, iterations = lax.while_loop(unfinished, iterate, state)
    return x, Solution(iterations, left, jnp.where(status < 0, LIMIT, status))


def _unhindered(contact, p: Float[Array, "verts 3"]):
    """The share of a vertex's way p that does not carry it through the body: to the surface, and a little into it."""
    if contact is None:
        return jnp.ones((), p.dtype)
    reach = jnp.maximum(contact.distance, 0) * 0.9 + CLEARANCE
    length = jnp.sqrt(jnp.sum(p * p, axis=-1))
    return jnp.minimum(1, reach / jnp.maximum(length, jnp.finfo(p.dtype).tiny))


def _equilibrium(settings: Settings, step: Step, start) -> tuple[Float[Array, "verts 3"], Solution]:
    """`_minimise`, whose derivative is that of the minimum itself and not of the way to it.

    Where grad E(x, s) = 0, the implicit function theorem gives dx/ds = -H^-1 d(grad E)/ds with the exact Hessian H; in
    reverse one solve with H for a cotangent, by conjugate gradients that the factored approximation of H preconditions.
    """
    leaves, tree = jax.tree.flatten(step)
    smooth = tuple(jnp.issubdtype(leaf.dtype, jnp.inexact) for leaf in leaves)  # topology has no derivative
    numbers = [leaf for leaf, is_smooth in zip(leaves, smooth, strict=True) if is_smooth]
    topology = [leaf for leaf, is_smooth in zip(leaves, smooth, strict=True) if not is_smooth]
    return _implicit((settings, tree, smooth), numbers, topology, start)


def _joined(static, numbers, topology) -> Step:
    _, tree, smooth = static
    numbers, topology = iter(numbers), iter(topology)
    return jax.tree.unflatten(tree, [next(numbers if is_smooth else topology) for is_smooth in smooth])


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _implicit(static, numbers, topology, start):
    return _minimise(static[0], _joined(static, numbers, topology), start)


def _implicit_forward(static, numbers, topology, start):
    x, solution = _implicit(static, numbers, topology, start)
    return (x, solution), (numbers, topology, x)


def _implicit_backward(static, kept, cotangents):
    numbers, topology, x = kept
    along, _ = cotangents
    step = _joined(static, numbers, topology)
    gradient = jax.grad(_energy, argnums=1)
    _, hessian = jax.linearize(lambda x: gradient(step, x), x)
    factor = _factored(step, x, _touching(step, x))
    adjoint = _conjugate_gradients(hessian, lambda r: solve(step.simulator.order, factor, r), along)
    _, back = jax.vjp(lambda numbers: gradient(_joined(static, numbers, topology), x), numbers)
    (result,) = back(-adjoint)
    return result, None, None


_implicit.defvjp(_implicit_forward, _implicit_backward)


def _conjugate_gradients(matrix: Callable, preconditioner: Callable, right: Float[Array, "verts 3"]) -> Float[Array, "verts 3"]:
    """x with matrix(x) = right to nearly the rounding of the type; ends early where the matrix is not positive definite."""
    tolerance = 1e-6 if right.dtype == jnp.float32 else 1e-12
    most = 1000

    def unfinished(state):
        _, r, _, rho, count, definite = state
        return (jnp.sqrt(_dot(r, r)) > tolerance * jnp.sqrt(_dot(right, right))) & (count < most) & definite & (rho > 0)

    def iterate(state):
        x, r, p, rho, count, _ = state
        image = matrix(p)
        curvature = _dot(p, image)
        definite = curvature > 0
        size = jnp.where(definite, rho / jnp.where(definite, curvature, 1), 0)
        x, r = x + size * p, r - size * image
        z = preconditioner(r)
        new = _dot(r, z)
        return x, r, z + new / rho * p, new, count + 1, definite

    z = preconditioner(right)
    state = (jnp.zeros_like(right), right, z, _dot(right, z), jnp.zeros((), jnp.int32), jnp.asarray(True))
    return lax.while_loop(unfinished, iterate, state)[0]


def _expected(step: Step, state: State, blended: Float[Array, "verts 3 4"]) -> tuple[Step, Float[Array, "verts 3"]]:
    """Where a frame's search starts: the last frame goes on as it moves in unposed space, but through no limb, however fast."""
    carried = skin(blended, state.unposed)
    step = _with(step, _look(step, carried))
    onward = skin(blended, 2 * state.unposed - state.unposed_before) - carried
    return step, carried + jnp.atleast_1d(_unhindered(_touching(step, carried), onward))[:, None] * onward


def stepper(simulator: Simulator, settings: Settings | None = None) -> Simulation:
    """A simulation frame by frame: pure functions with explicit state, to be jitted by the caller.

    `step` takes one frame's local rotations (joints, 3, 3) of the model's joints (see `model.local_rotations`) and the root's
    translation (3,) in m, if wanted an external force (verts, 3) in N, and returns the state, whose `solution` tells how the
    solve went, and the vertices (verts, 3) in m.
    The first frame is the static state in its pose: before it the character is taken to have stood there.
    """
    settings = settings or Settings()
    model = simulator.model
    rest = model.garment.mesh.rest
    dtype = rest.dtype

    def init() -> State:
        nothing = Solution(jnp.zeros((), jnp.int32), jnp.zeros((), dtype), jnp.zeros((), jnp.int32))
        return State(rest, rest, rest, rest, jnp.asarray(False), nothing)

    def follow(
        state: State, matrices: Float[Array, "joints 3 4"], force: Float[Array, "verts 3"] | None = None
    ) -> tuple[State, Float[Array, "verts 3"]]:
        blended = blend(matrices, model.blend)
        body = None if model.body is None or model.surface is None else pose_body(model, matrices)
        moving = state.started & settings.inertia
        problem = Step(
            simulator, body, blended if model.terms.pinning else None, project(state.previous, state.before), force,
            moving.astype(dtype),
        )  # fmt: skip
        problem, start = _expected(problem, state, blended)
        x, solution = _equilibrium(settings, problem, lax.stop_gradient(start))
        unposed = unpose(blended, x)
        first = ~state.started
        before = (jnp.where(first, x, state.previous), jnp.where(first, unposed, state.unposed))
        return State(x, before[0], unposed, before[1], jnp.asarray(True), solution), x

    def step(state: State, rotations, translation, force=None):
        return follow(state, transforms(model.skeleton, forward(model.skeleton, rotations, translation)), force)

    return Simulation(init, step, follow)


def simulate(
    simulator: Simulator, track: Track, settings: Settings | None = None, *, state: State | None = None, forces=None
) -> tuple[Float[Array, "frames verts 3"], Solution]:
    """Vertices over one whole motion (frames, verts, 3) in m, and how every frame's solve went.

    Args:
        simulator: from `simulator_from`. track: of one motion, from `motion.track`. settings: tolerance and iterations.
        state: to go on from; else the motion begins at rest. forces: external ones (frames, verts, 3) in N.

    It may be differentiated in reverse with respect to the simulator's material and rest state, the track's transforms, the
    state and the forces: by the implicit function theorem, so memory grows with frames and not with iterations.
    """
    simulation = stepper(simulator, settings)

    def frame(state, inputs):
        state, x = simulation.follow(state, *inputs)
        return state, (x, state.solution)

    _, result = lax.scan(frame, simulation.init() if state is None else state, (track.matrices, forces))
    return result

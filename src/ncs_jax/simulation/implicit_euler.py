"""Full-space simulation: every frame is one step of implicit Euler, the minimum of the energy that trains the network.

    x_t = argmin_x  E(x) + 1/(2 dt^2) sum_v m |x - x_proj|^2,   x_proj = 2 x_{t-1} - x_{t-2}

The minimum is found by projected Newton or by a quasi-Newton method (see `solver.directions`), with a line search that accepts
no increase. Source: Baraff and Witkin 1998; Martin et al. 2011.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.safe_steps import limit_approach
from ncs_jax.geometry.skinning import blend, forward, skin, unpose
from ncs_jax.geometry.skinning import transforms as joint_transforms
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model
from ncs_jax.scene.step_inputs import Past, step_inputs
from ncs_jax.simulation.solver.cholesky import Elimination, elimination
from ncs_jax.simulation.solver.equilibrium import equilibrium
from ncs_jax.simulation.solver.minimise import Settings, Solution
from ncs_jax.simulation.solver.problem import (
    Problem,
    body_contact,
    collision_free_step,
    find_neighbours,
    hold_pins,
    share_outside_body,
    with_neighbours,
)
from ncs_jax.simulation.solver.stiffness import Couplings, couplings_from

APPROACH = 8  # safe steps towards where the next frame is sought,
WORTH = 0.1  # each at least so much of the way

__all__ = ["Simulation", "SimulationState", "Simulator", "simulate", "simulator_from", "stepper"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Simulator:
    """A model with what its solver finds out once: which vertices couple, and in which order they are eliminated."""

    model: Model
    couplings: Couplings
    order: Elimination


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SimulationState:
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
    couplings = couplings_from(model.garment.mesh, model.points)
    return Simulator(model, couplings, elimination(np.asarray(couplings.pairs), np.asarray(model.garment.mesh.rest)))


def _expected(problem: Problem, state: SimulationState, advected, transforms) -> Float[Array, "verts 3"]:
    """Return where a frame's search starts: the last frame goes on as in unposed space, but through no limb, however fast."""
    onward = skin(transforms, 2 * state.unposed - state.unposed_before) - advected
    start = advected + jnp.atleast_1d(share_outside_body(problem, body_contact(problem, advected), onward))[:, None] * onward
    return lax.stop_gradient(hold_pins(problem, start))


def _approached(problem: Problem, x: Float[Array, "verts 3"], *targets: Float[Array, "verts 3"]):
    """Go as far from x to one target after the other as cloth comes without passing through itself.

    Returns the problem with what is near there, and the place.

    Cloth that would come too near to cloth gives way, all else goes on: what stays behind, a limb might go through.
    """

    def approached(state, target):
        def unfinished(state):
            _, t, count, _ = state
            return (t >= WORTH) & (t < 1) & (count < APPROACH)

        def go(state):
            x, _, count, neighbours = state
            way = limit_approach(x, target - x, neighbours.pairs)
            t = collision_free_step(with_neighbours(problem, neighbours), x, way)
            x = jnp.where(t < WORTH, x, x + t * way)
            return x, t, count + 1, find_neighbours(problem, x)

        x, neighbours = state
        x, _, _, neighbours = lax.while_loop(
            unfinished, go, (x, jnp.full((), WORTH, x.dtype), jnp.zeros((), jnp.int32), neighbours)
        )
        return (x, neighbours), None

    (x, neighbours), _ = lax.scan(approached, (x, find_neighbours(problem, x)), jnp.stack(targets))
    return with_neighbours(problem, neighbours), hold_pins(problem, x)


def stepper(simulator: Simulator, settings: Settings | None = None) -> Simulation:
    """Return a simulation frame by frame: pure functions with explicit state, to be jitted by the caller.

    `step` takes one frame's local rotations (joints, 3, 3) of the model's joints (see `model.local_rotations`) and the root's
    translation (3,) in m, if wanted an external force (verts, 3) in N, and returns the state, whose `solution` tells how the
    solve went, and the vertices (verts, 3) in m.
    The first frame is the static state in its pose, as if the character had stood there, next to the garment as the body alone
    carries it there; a loose one falls in other folds where it is led there, see `walk_in`.
    """
    settings = settings or Settings()
    model = simulator.model
    # The past carries a derivative here: that of a frame by the frames before.
    model = replace(model, terms=replace(model.terms, inertia=True, through_time=True))
    rest, dtype = model.garment.mesh.rest, model.garment.mesh.rest.dtype

    def init() -> SimulationState:
        nothing = Solution(jnp.zeros((), jnp.int32), jnp.zeros((), dtype), jnp.zeros((), jnp.int32))
        return SimulationState(rest, rest, rest, rest, jnp.asarray(False), nothing)

    def follow(
        state: SimulationState,
        matrices: Float[Array, "joints 3 4"],
        force: Float[Array, "verts 3"] | None = None,
        start: Float[Array, "verts 3"] | None = None,
        limit: Int[Array, ""] | None = None,
        still: Bool[Array, ""] | None = None,
    ) -> tuple[SimulationState, Float[Array, "verts 3"]]:
        # start: where the search begins, m; None: where the last frame leads. limit: of iterations, else the settings'.
        # still: whether the body has stood in this pose before, as in a first frame; None: only there.
        # seen from the root joint: float32 tells places 5 m off no finer than 0.5 um, which in a pin of 1000 N/m is 1 mN
        origin = lax.stop_gradient(matrices[:1, :, 3])
        matrices = matrices.at[:, :, 3].add(-origin)
        transforms = blend(matrices, model.blend)
        first = ~state.started if still is None else ~state.started | still
        moving = (~first & settings.inertia).astype(dtype)
        previous = state.previous - origin
        past = Past(previous, state.before - origin, state.unposed, moving)
        step = step_inputs(model, matrices, past, transforms=transforms, force=force)
        exact = settings.exact_pins and len(model.garment.pins) > 0
        pinned = skin(transforms, rest)[model.garment.pins] if exact else None
        problem = Problem(model, simulator.couplings, simulator.order, step, pinned, first=first, limit=limit)
        advected = skin(transforms, state.unposed)
        if start is None:
            problem = with_neighbours(problem, find_neighbours(problem, advected))
            start = _expected(problem, state, advected, transforms)
        else:
            start = lax.stop_gradient(hold_pins(problem, start - origin))
            problem = with_neighbours(problem, find_neighbours(problem, start))
        if model.terms.self_contact:
            last = jnp.where(state.started, hold_pins(problem, previous), start)
            problem, start = _approached(problem, *map(lax.stop_gradient, (last, advected, start)))
        x, solution = equilibrium(settings, problem, start)
        unposed, x = unpose(transforms, x), x + origin
        before = (jnp.where(first, x, state.previous), jnp.where(first, unposed, state.unposed))
        return SimulationState(x, before[0], unposed, before[1], jnp.asarray(True), solution), x

    def step(state: SimulationState, rotations, translation, force=None):
        return follow(state, joint_transforms(model.skeleton, forward(model.skeleton, rotations, translation)), force)

    return Simulation(init, step, follow)


def simulate(
    simulator: Simulator,
    track: MotionFeatures,
    settings: Settings | None = None,
    *,
    state: SimulationState | None = None,
    forces=None,
) -> tuple[Float[Array, "frames verts 3"], Solution]:
    """Return the vertices over one whole motion (frames, verts, 3) in m, and how every frame's solve went.

    Args:
        simulator: from `simulator_from`. track: of one motion, from `features.motion_features`. settings: tolerance and
            iterations. state: to go on from, measured from the track's origin; else the motion begins at rest. forces:
            external ones (frames, verts, 3) in N.

    It may be differentiated in reverse with respect to the simulator's material and rest state, the track's transforms, the
    state and the forces: by the implicit function theorem, so memory grows with frames and not with iterations.
    """
    simulation = stepper(simulator, settings)

    def frame(state, inputs):
        state, x = simulation.follow(state, *inputs)
        return state, (x, state.solution)

    _, (x, solution) = lax.scan(frame, simulation.init() if state is None else state, (track.matrices, forces))
    return track.absolute(x), solution

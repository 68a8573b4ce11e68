"""Full-space simulation: every frame is one step of implicit Euler, the minimum of the energy that trains the network.

    x_t = argmin_x  E(x) + 1/(2 dt^2) sum_v m |x - x_proj|^2,   x_proj = 2 x_{t-1} - x_{t-2}

The minimum is found by projected Newton or by a quasi-Newton method (see `solver.directions`), with a line search that accepts
no increase. Source: Baraff and Witkin 1998; Martin et al. 2011.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ncs_jax.energies.contact.safe_steps import yielding
from ncs_jax.energies.inertia import project
from ncs_jax.energies.total import contact_force
from ncs_jax.geometry.skinning import blend, forward, skin, transforms, unpose
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body
from ncs_jax.simulation.solver.cholesky import Elimination, elimination
from ncs_jax.simulation.solver.equilibrium import equilibrium
from ncs_jax.simulation.solver.minimise import Settings, Solution
from ncs_jax.simulation.solver.problem import Problem, apart, knowing, look, placed, touched, unhindered
from ncs_jax.simulation.solver.stiffness import Couplings, couplings_from

APPROACH = 8  # safe steps towards where the next frame is sought,
WORTH = 0.1  # each at least so much of the way

__all__ = ["Simulation", "Simulator", "simulate", "simulator_from", "stepper"]


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
    couplings = couplings_from(model.garment.mesh)
    return Simulator(model, couplings, elimination(np.asarray(couplings.pairs), np.asarray(model.garment.mesh.rest)))


def _expected(problem: Problem, state: SimulationState, carried, blended) -> Float[Array, "verts 3"]:
    """Where a frame's search starts: the last frame goes on as it moves in unposed space, but through no limb, however fast."""
    onward = skin(blended, 2 * state.unposed - state.unposed_before) - carried
    start = carried + jnp.atleast_1d(unhindered(touched(problem, carried), onward))[:, None] * onward
    return lax.stop_gradient(placed(problem, start))


def _approached(problem: Problem, x: Float[Array, "verts 3"], *targets: Float[Array, "verts 3"]):
    """As far from x to one target after the other as cloth comes without passing through itself; and the problem there.

    Cloth that would come too near to cloth gives way, all else goes on: what stays behind, a limb might go through.
    """

    def approached(state, target):
        def unfinished(state):
            _, t, count, _ = state
            return (t >= WORTH) & (t < 1) & (count < APPROACH)

        def go(state):
            x, _, count, seen = state
            way = yielding(x, target - x, seen[1])
            t = apart(knowing(problem, seen), x, way)
            x = jnp.where(t < WORTH, x, x + t * way)
            return x, t, count + 1, look(problem, x)

        x, seen = state
        x, _, _, seen = lax.while_loop(unfinished, go, (x, jnp.full((), WORTH, x.dtype), jnp.zeros((), jnp.int32), seen))
        return (x, seen), None

    (x, seen), _ = lax.scan(approached, (x, look(problem, x)), jnp.stack(targets))
    return knowing(problem, seen), placed(problem, x)


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

    def init() -> SimulationState:
        nothing = Solution(jnp.zeros((), jnp.int32), jnp.zeros((), dtype), jnp.zeros((), jnp.int32))
        return SimulationState(rest, rest, rest, rest, jnp.asarray(False), nothing)

    def follow(
        state: SimulationState, matrices: Float[Array, "joints 3 4"], force: Float[Array, "verts 3"] | None = None
    ) -> tuple[SimulationState, Float[Array, "verts 3"]]:
        # seen from the root joint: float32 tells places 5 m off no finer than 0.5 um, which in a pin of 1000 N/m is 1 mN
        origin = lax.stop_gradient(matrices[:1, :, 3])
        matrices = matrices.at[:, :, 3].add(-origin)
        previous, earlier = state.previous - origin, state.before - origin
        blended = blend(matrices, model.blend)
        body = None if model.body is None or model.surface is None else pose_body(model, matrices)
        moving = (state.started & settings.inertia).astype(dtype)
        carried = skin(blended, state.unposed)
        pressed = None
        if model.terms.friction:
            pressed = moving * contact_force(carried, body, model.surface, model.terms, model.material)
        problem = Problem(
            model, simulator.couplings, simulator.order, body, blended if model.terms.pinning else None,
            project(previous, earlier), force, moving,
            pinned=skin(blended, rest)[model.garment.pins] if settings.exact_pins and len(model.garment.pins) else None,
            carried=carried if model.terms.friction else None,
            pressed=pressed,
        )  # fmt: skip
        problem = knowing(problem, look(problem, carried))
        start = _expected(problem, state, carried, blended)
        if model.terms.self_contact:
            last = jnp.where(state.started, placed(problem, previous), start)
            problem, start = _approached(problem, *map(lax.stop_gradient, (last, carried, start)))
        x, solution = equilibrium(settings, problem, start)
        unposed = unpose(blended, x)
        x, first = x + origin, ~state.started
        before = (jnp.where(first, x, state.previous), jnp.where(first, unposed, state.unposed))
        return SimulationState(x, before[0], unposed, before[1], jnp.asarray(True), solution), x

    def step(state: SimulationState, rotations, translation, force=None):
        return follow(state, transforms(model.skeleton, forward(model.skeleton, rotations, translation)), force)

    return Simulation(init, step, follow)


def simulate(
    simulator: Simulator,
    track: MotionFeatures,
    settings: Settings | None = None,
    *,
    state: SimulationState | None = None,
    forces=None,
) -> tuple[Float[Array, "frames verts 3"], Solution]:
    """Vertices over one whole motion (frames, verts, 3) in m, and how every frame's solve went.

    Args:
        simulator: from `simulator_from`. track: of one motion, from `motion.track`. settings: tolerance and iterations.
        state: to go on from, measured from the track's origin; else the motion begins at rest. forces: external ones (frames,
            verts, 3) in N.

    It may be differentiated in reverse with respect to the simulator's material and rest state, the track's transforms, the
    state and the forces: by the implicit function theorem, so memory grows with frames and not with iterations.
    """
    simulation = stepper(simulator, settings)

    def frame(state, inputs):
        state, x = simulation.follow(state, *inputs)
        return state, (x, state.solution)

    _, (x, solution) = lax.scan(frame, simulation.init() if state is None else state, (track.matrices, forces))
    return track.absolute(x), solution

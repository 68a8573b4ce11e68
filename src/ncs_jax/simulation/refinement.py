"""Between a network and a simulation: some iterations of the solver on every frame that a network gives.

    x_t^0 = S_t(u_t + d_{t-1}),   x_t = x_t^0 after N iterations towards argmin_x E(x) + 1/(2 dt^2) sum_v m |x - x_proj|^2,
    d_t = S_t^-1(x_t) - u_t

u is the network's garment in unposed space, S the skinning, x_proj = 2 x_{t-1} - x_{t-2} of the refined frames, and d what the
iterations have changed, which the next frame takes over: they add up from frame to frame, and the errors of the past do not.
N = 0 is the network. The more, the nearer to the simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ncs_jax.geometry.skinning import blend, skin, unpose
from ncs_jax.simulation.implicit_euler import SimulationState, Simulator, stepper
from ncs_jax.simulation.solver.minimise import Settings

__all__ = ["Refinement", "RefinementState", "refiner"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RefinementState:
    """What goes from frame to frame: the refined frames before, and what was changed in the last one, d (verts, 3), m."""

    simulated: SimulationState
    change: Float[Array, "verts 3"]


class Refinement(NamedTuple):
    """`init() -> state`; `follow(state, matrices, guess, iterations) -> (state, vertices)`: pure functions."""

    init: Callable[[], RefinementState]
    follow: Callable[..., tuple[RefinementState, Array]]


def refiner(simulator: Simulator, settings: Settings | None = None) -> Refinement:
    """Return the refinement of a network's frames, to be jitted by the caller.

    `follow` takes the joints' transforms (joints, 3, 4), the network's vertices there (verts, 3), m, and how many iterations,
    at most: an array, so that one program has them all. A frame that is in balance takes fewer. It returns the state, whose
    `simulated.solution` tells what is left, and the vertices (verts, 3), m. Nothing of it has a derivative.

    Args:
        simulator: from `simulator_from`, of a model with smooth contact. settings: solver and tolerance.
    """
    simulation, model = stepper(simulator, settings), simulator.model

    def init() -> RefinementState:
        return RefinementState(simulation.init(), jnp.zeros_like(model.garment.mesh.rest))

    def follow(
        state: RefinementState,
        matrices: Float[Array, "joints 3 4"],
        guess: Float[Array, "verts 3"],
        iterations: Int[Array, ""],
    ) -> tuple[RefinementState, Float[Array, "verts 3"]]:
        transforms = blend(matrices, model.blend)
        unposed = unpose(transforms, guess)
        start = skin(transforms, unposed + state.change)
        simulated, x = simulation.follow(state.simulated, matrices, start=start, limit=iterations)
        return jax.lax.stop_gradient((RefinementState(simulated, simulated.unposed - unposed), x))

    return Refinement(init, follow)

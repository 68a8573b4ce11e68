"""How far any trajectory of a garment is from balance, whoever made it: the residual that the solvers here report of their own.

Of frame t it is the mass-weighted r.m.s. of M^-1 grad E at x_t in multiples of 9.81 m/s^2, with the inertia of the trajectory's
own x_{t-1} and x_{t-2}. So it says how well that step was solved, and not how well those before it were.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.energies.inertia import out_of_balance
from ncs_jax.geometry.skinning import blend, skin, unpose
from ncs_jax.scene.step_inputs import Past, step_inputs
from ncs_jax.simulation.implicit_euler import Simulator
from ncs_jax.simulation.solver.problem import Problem, evaluate, find_neighbours, with_neighbours


def residuals(
    simulator: Simulator,
    matrices: Float[Array, "frames joints 3 4"],
    positions: Float[np.ndarray, "frames verts 3"],
    *,
    exact_pins: bool = False,
) -> np.ndarray:
    """Return what is out of balance in every frame but the first, g: of a garment that was at rest in the first.

    Args:
        simulator: of the model. matrices: what the body does in these frames. positions: of the garment, m, seen from the
            motion's origin. exact_pins: pins are held where the body carries them, and nothing is out of balance there.
    """
    first = positions[:1]
    x = np.concatenate([first, positions]).astype(simulator.model.garment.mesh.rest.dtype)  # x_{-1} is x_0
    program = jax.jit(_residual, static_argnums=3)
    steps = range(1, len(positions))
    return np.array([float(program(simulator, matrices[t - 1 : t + 1], x[t - 1 : t + 2], exact_pins)) for t in steps])


def _residual(
    simulator: Simulator, matrices: Float[Array, "2 joints 3 4"], x: Float[Array, "3 verts 3"], exact_pins: bool
) -> Float[Array, ""]:
    """Return what is out of balance at the last of three positions; the body is given in the last two frames."""
    model = simulator.model
    model = replace(model, terms=replace(model.terms, inertia=True))
    origin = matrices[1, :1, :, 3]  # as the simulation sees it: from the root joint
    matrices, x = matrices.at[..., 3].add(-origin[None]), x - origin[None]
    transforms = blend(matrices[1], model.blend)
    unposed = unpose(blend(matrices[0], model.blend), x[1])
    step = step_inputs(model, matrices[1], Past(x[1], x[0], unposed, jax.numpy.ones((), x.dtype)), transforms=transforms)
    pinned = None
    if exact_pins and len(model.garment.pins):
        pinned = skin(transforms, model.garment.mesh.rest)[model.garment.pins]
    problem = Problem(model, simulator.couplings, simulator.order, step, pinned)
    point = evaluate(with_neighbours(problem, find_neighbours(problem, x[2])), x[2])
    return out_of_balance(point.gradient, problem.mass)

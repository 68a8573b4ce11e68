"""Refine a trained garment's animation by the solver: the dial between the network and the simulation of its scene."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.geometry.skinning import forward, transforms
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import Assembly, tell_a_person
from ncs_jax.prepare.touchable import surface_of, touchable_faces
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model
from ncs_jax.simulation.implicit_euler import Simulator, simulator_from
from ncs_jax.simulation.refinement import RefinementState, refiner
from ncs_jax.simulation.solver.minimise import Settings

__all__ = ["refined", "refined_stepper"]


@functools.partial(jax.jit, static_argnums=1)
def _follow(simulator: Simulator, settings: Settings, state: RefinementState, matrices, guess, iterations):
    return refiner(simulator, settings).follow(state, matrices, guess, iterations)


def refined(
    assembly: Assembly,
    track: MotionFeatures,
    vertices: np.ndarray,
    iterations: int,
    report: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """Return a network's animation (frames, verts, 3), m, after so many iterations of the solver on every frame.

    The energy is that of the scene with smooth contact, as in a simulation: see `simulation.refinement`. The solver is
    quasi-Newton, whose iteration is the cheapest; a frame that reaches the scene's tolerance takes no more of them.

    Args:
        track: of the motion. report: called with the frame that is done, and of how many.
    """
    model, settings = with_smooth_contact(assembly, track), _settings(assembly)
    simulator, count = simulator_from(model), jnp.asarray(iterations, jnp.int32)
    state, frames = refiner(simulator, settings).init(), len(track.start)
    guess = track.relative(vertices).astype(model.basis.dtype, copy=False)
    if report is None:
        tell_a_person(f"compiling the solver, which may take a minute, then {frames} frames")
    found = np.empty_like(vertices)
    for t in range(frames):
        state, x = _follow(simulator, settings, state, track.matrices[t], guess[t], count)
        found[t] = x
        if report is not None:
            report(t + 1, frames)
    return found if track.origin is None else found + np.asarray(track.origin)[:, None]


class Stream(NamedTuple):
    """`init() -> state`; `step(state, rotations, translation, alpha) -> (state, vertices)`, as of a network's `Rollout`."""

    init: Callable
    step: Callable


def refined_stepper(assembly: Assembly, params: dict, iterations: int) -> Stream:
    """Return the streaming animator of a trained garment whose every frame is refined: pure functions, to be jitted.

    As `network.rollout.stepper`, of one character, of a run's assembly and parameters. The frames are those of
    `Run.animate(motion, alpha, refine=iterations)`.
    """
    model, settings = assembly.model, _settings(assembly)
    stream = stepper(model, assembly.network, params)
    refinement = refiner(simulator_from(with_smooth_contact(assembly)), settings)

    def step(state, rotations, translation, alpha=1.0):
        streamed, guess = stream.step(state[0], rotations, translation, alpha)
        matrices = transforms(model.skeleton, forward(model.skeleton, rotations, translation))
        found, x = refinement.follow(state[1], matrices, guess, jnp.asarray(iterations, jnp.int32))
        return (streamed, found), x

    return Stream(lambda: (stream.init(), refinement.init()), step)


def _settings(assembly: Assembly) -> Settings:
    return Settings("quasi_newton", assembly.scene.simulation.tolerance, inertia=assembly.scene.physics.inertia)


def with_smooth_contact(assembly: Assembly, track: MotionFeatures | None = None) -> Model:
    """Return an assembly's model whose contact with the body is smooth: a solver converges with no other."""
    model = assembly.model
    if model.surface is None or model.terms.collision == "smooth" or assembly.body is None:
        return model
    faces, pieces = touchable_faces(model, assembly.body, assembly.prepared.part), assembly.prepared.pieces
    surface = surface_of(model, faces, track, smooth=True, pieces=pieces)
    layers = model.terms.layers and "triangle"  # which converges too
    return replace(model, terms=replace(model.terms, collision="smooth", layers=layers), surface=surface)

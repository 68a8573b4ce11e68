"""The simulator's own solver against motions known in closed form, of implicit Euler (Martin et al. 2011)."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.objective import Frame, total
from ncs_jax.simulator import stepper
from ncs_jax.solver.minimise import CONVERGED

from ..shapes import rotation
from ..test_simulator import SETTINGS, TOLERANCE, advance, loose, thrown

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def weightless(tmp_path_factory):
    """A sheet of springs in no field, and the pose of its joint."""
    simulator, pose = loose(tmp_path_factory.mktemp("weightless"))
    material = replace(simulator.model.material, gravity=jnp.zeros(3))
    return replace(simulator, model=replace(simulator.model, material=material)), pose


def masses(simulator):
    return np.asarray(simulator.model.material.density * simulator.model.garment.mesh.vertex_area)[:, None]


def follow(simulator, pose, state, steps):
    """Positions (steps + 2, verts, 3): the two frames of the state, then those of the simulator."""
    frames = [np.asarray(state.before), np.asarray(state.previous)]
    for _ in range(steps):
        state, x = advance(simulator, SETTINGS, state, pose, jnp.zeros(3))
        assert state.solution.status == CONVERGED
        frames.append(np.asarray(x))
    return np.stack(frames)


def recursion(w, dt, start, steps):
    """u_n (1 + w^2 dt^2) = 2 u_{n-1} - u_{n-2}, u_{-1} = u_0: what implicit Euler makes of a vibration of frequency w."""
    u = [start, start]
    for _ in range(steps):
        u.append((2 * u[-1] - u[-2]) / (1 + (w * dt) ** 2))
    return np.array(u)


def test_momentum_without_gravity(weightless, rng):
    """sum m v is kept, and sum x_n x m (v_n - v_{n-1}) = 0: inner forces have no sum and no torque."""
    simulator, pose = weightless
    rest, mass, fps = np.asarray(simulator.model.garment.mesh.rest), masses(simulator), simulator.model.fps
    start = rest + 5e-3 * rng.normal(size=rest.shape)
    velocity = np.array([0.4, 0.1, -0.2]) + np.cross([3.0, -2.0, 5.0], start - rest.mean(axis=0))
    frames = follow(simulator, pose, thrown(simulator, start, jnp.asarray(velocity)), 8)
    v = np.diff(frames, axis=0) * fps
    momentum = np.sum(mass * v, axis=1)
    left = 9.81 * TOLERANCE * mass.sum() / fps  # what the tolerance lets pass in a step
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=0, atol=8 * left)
    pull = mass * np.diff(v, axis=0)
    torque = np.sum(np.cross(frames[2:], pull), axis=1)
    assert np.abs(torque).max() < np.abs(frames).max() * 3 * left
    assert np.abs(pull).sum(axis=1).max() > 1e4 * left  # there were forces


@pytest.mark.parametrize("mode", [0, 5])
def test_a_vibration_has_the_frequency_of_its_mode(weightless, mode):
    """K a = w^2 M a: a little of a vibration a of the resting sheet stays along it, and follows the recursion."""
    simulator, pose = weightless
    model, mass, dt = simulator.model, np.repeat(masses(simulator), 3, axis=1), 1 / simulator.model.fps
    rest, terms = model.garment.mesh.rest, replace(model.terms, inertia=False)
    hessian = jax.jit(jax.hessian(lambda x: total(x, model.garment, model.material, Frame(), terms)))(rest)
    scale = mass.reshape(-1) ** -0.5
    squares, modes = np.linalg.eigh(scale[:, None] * np.asarray(hessian).reshape(rest.size, -1) * scale)
    first = np.flatnonzero(squares > 30**2)[mode]  # below lie rigid motions and bending
    w, along = np.sqrt(squares[first]), (scale * modes[:, first]).reshape(-1, 3)
    along /= np.abs(along).max()
    frames = follow(simulator, pose, thrown(simulator, np.asarray(rest) + 1e-4 * along), 12)
    u = np.sum(mass * along * (frames - np.asarray(rest)), axis=(1, 2)) / np.sum(mass * along**2)
    expected = recursion(w, dt, 1e-4, 12)
    np.testing.assert_allclose(u, expected, rtol=0, atol=2e-3 * 1e-4)
    np.testing.assert_allclose(frames - np.asarray(rest), u[:, None, None] * along, rtol=0, atol=1e-2 * 1e-4)


def test_a_sheet_on_one_pin_swings_as_a_rigid_pendulum(tmp_path):
    """theta'' = -(m g d / I) theta for small angles, of a sheet too stiff to do anything else, in its own plane."""
    simulator, pose = loose(tmp_path, pins=(27,))
    old = simulator.model.material
    stiff = replace(old, membrane=tuple(300 * m for m in old.membrane), pinning=jnp.asarray(1e4))
    simulator = replace(simulator, model=replace(simulator.model, material=stiff))
    state, still = advance(simulator, SETTINGS, stepper(simulator, SETTINGS).init(), pose, jnp.zeros(3))
    assert state.solution.status == CONVERGED
    mass, pin = masses(simulator), np.asarray(still)[27]
    arm = np.asarray(still) - pin
    inertia, lever = np.sum(mass * arm[:, :2] ** 2), -np.sum(mass[:, 0] * arm[:, 1])
    w, dt = np.sqrt(9.81 * lever / inertia), 1 / simulator.model.fps
    frames = follow(simulator, pose, thrown(simulator, pin + arm @ rotation([0, 0, 1], 0.02).T), 24)
    centre = np.sum(mass * (frames - pin), axis=1) / mass.sum()
    angle = np.arctan2(centre[:, 0], -centre[:, 1])
    expected = recursion(w, dt, angle[1], 24)
    assert expected.min() < -0.5 * 0.02  # it has swung to the other side
    np.testing.assert_allclose(angle, expected, rtol=0, atol=0.03 * 0.02)

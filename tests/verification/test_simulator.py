"""The simulator's own solver against motions known in closed form, of implicit Euler (Martin et al. 2011)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from ncs_jax.energies.terms import StepInputs
from ncs_jax.energies.total import total
from ncs_jax.scene.model import local_rotations
from ncs_jax.simulation.implicit_euler import simulator_from, stepper
from ncs_jax.simulation.solver.minimise import CONVERGED

from ..scenes import grid
from ..shapes import rotation
from ..simulators import SETTINGS, TOLERANCE, advance, loose, thrown, written
from .newton import order

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
    hessian = jax.jit(jax.hessian(lambda x: total(x, model.garment, model.material, StepInputs(), terms)))(rest)
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


SOFT = 1.0  # N/m: mu of cloth that stretches by an eighth under its own weight


def elastic(folder, vertices, faces, pins=(), dtype=jnp.float64):
    """Soft cloth by itself whose lambda is zero, so that it does not narrow; and its pose."""
    assembly = written(folder, vertices, faces, pins, dtype, collision={"stiffness": 0}, membrane={"model": "stvk"})
    model, motion = assembly.model, next(iter(assembly.motions.values()))
    material = replace(model.material, membrane=(jnp.zeros((), dtype), jnp.asarray(SOFT, dtype)))
    pose = local_rotations(model, jnp.asarray(motion.poses, dtype))[0]
    return simulator_from(replace(model, material=material)), pose


def hung(folder, rows, dtype, tolerance):
    """How far the vertices of a strip of 0.2 m on its pins hang below where the closed form has them, and how far that sags.

    P(s) = q (L - s) = mu F (F^2 - 1): the weight below, and the first Piola-Kirchhoff stress of St. Venant and Kirchhoff for a
    stretch F along and none across; y(s) = integral of F. The mass of a cell is shared by its four corners, not by its two
    triangles, whose vertices have more of it at the ends of the diagonals: so every row stays straight.
    """
    length, columns = 0.2, 3
    vertices, faces = grid(rows + 1, columns, length / rows)
    simulator, pose = elastic(folder, vertices, faces, np.arange(rows * columns, (rows + 1) * columns), dtype)
    half = [np.r_[0.5, np.ones(n - 2), 0.5] * length / rows for n in (rows + 1, columns)]
    mesh = simulator.model.garment.mesh
    mesh = replace(mesh, vertex_area=jnp.asarray(np.outer(*half).reshape(-1), dtype))
    simulator = replace(simulator, model=replace(simulator.model, garment=replace(simulator.model.garment, mesh=mesh)))
    settings = replace(SETTINGS, tolerance=tolerance, exact_pins=True)
    state, x = advance(simulator, settings, stepper(simulator, settings).init(), pose, jnp.zeros(3, dtype))
    assert state.solution.status == CONVERGED and x.dtype == dtype
    weight = 9.81 * float(simulator.model.material.density)
    stretch = lambda s: brentq(lambda f: SOFT * f * (f * f - 1) - weight * (length - s), 1, 2, xtol=1e-15)  # noqa: E731
    below = vertices[:, 1].max() - vertices[:, 1]
    hangs = {s: quad(stretch, 0, s, epsabs=1e-13)[0] for s in np.unique(below)}
    x, sag = np.asarray(x, np.float64), hangs[below.max()] - length
    assert np.abs(x - vertices)[:, [0, 2]].max() < 1e-3 * sag
    return x[:, 1] - (vertices[:, 1].max() - np.array([hangs[s] for s in below])), sag


def test_a_strip_hangs_as_its_closed_form_to_second_order_in_its_cells(tmp_path):
    errors = []
    for rows in (5, 10, 20):
        folder = tmp_path / str(rows)
        folder.mkdir()
        error, sag = hung(folder, rows, jnp.float64, 1e-8)
        errors.append(np.abs(error).max())
    assert sag > 0.01 and errors[-1] < 1e-3 * sag and abs(order(errors) - 2) < 0.2


def test_an_elastic_throw_converges_with_the_step(tmp_path):
    """A sheet that spins, stretches and falls: its places after 0.05 s by four steps, each half as long as the one before."""
    simulator, pose = elastic(tmp_path, *grid())
    rest = np.asarray(simulator.model.garment.mesh.rest)
    arm = rest - rest.mean(axis=0)
    start = rest + 0.05 * arm * np.cos(np.pi * arm[:, 1:2] / 0.25)
    velocity = np.cross([4.0, -3.0, 6.0], arm) + 2.0 * arm
    ends = []
    for steps in (10, 20, 40, 80):
        timed = replace(simulator, model=replace(simulator.model, fps=steps / 0.05))
        ends.append(follow(timed, pose, thrown(timed, start, jnp.asarray(velocity)), steps)[-1])
    differences = [np.abs(b - a).max() for a, b in pairwise(ends)]
    moved = np.abs(ends[-1] - start).max()
    assert moved > 0.02 and differences[-1] < 0.02 * moved and abs(order(differences) - 1) < 0.2


# --- in single precision ------------------------------------------------------------------------------------------------


def test_a_strip_hangs_as_its_closed_form_in_single_precision(tmp_path):
    error, sag = hung(tmp_path, 10, jnp.float32, 0.003)
    assert np.abs(error).max() < 0.01 * sag

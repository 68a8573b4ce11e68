"""Minimal residuals against direct solves, and derivatives of an equilibrium that is not stable."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.io.tables.npz import write_npz
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import scene_from
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.solver.minimal_residuals import minimal_residuals
from ncs_jax.simulation.solver.minimise import CONVERGED, Settings

from .shapes import sheet


def system(rng, eigenvalues):
    """A symmetric matrix (n, n) with these eigenvalues, and a positive definite preconditioner."""
    n = len(eigenvalues)
    turn, _ = np.linalg.qr(rng.normal(size=(n, n)))
    other = rng.normal(size=(n, n))
    return turn * eigenvalues @ turn.T, other @ other.T / n + np.eye(n)


def solved(matrix, preconditioner, right, tolerance=1e-12, most=1000):
    def along(m):
        return lambda v: (m @ v.reshape(-1)).reshape(v.shape)

    return minimal_residuals(along(jnp.asarray(matrix)), along(jnp.asarray(preconditioner)), right, tolerance, most)


@pytest.mark.parametrize("negative", [0, 1, 17, 60])
def test_definite_or_not(rng, negative):
    values = rng.uniform(0.1, 10, 60) * np.where(np.arange(60) < negative, -1, 1)
    matrix, preconditioner = system(rng, values)
    right = jnp.asarray(rng.normal(size=(20, 3)))
    x, left = solved(matrix, preconditioner, right)
    np.testing.assert_allclose(x.reshape(-1), np.linalg.solve(matrix, right.reshape(-1)), rtol=1e-8, atol=1e-9)
    assert left <= 1e-12


def test_what_is_left_is_told(rng):
    values = rng.uniform(0.1, 10, 60) * np.where(np.arange(60) < 9, -1, 1)
    matrix, preconditioner = system(rng, values)
    right = jnp.asarray(rng.normal(size=(20, 3)))
    x, left = solved(matrix, preconditioner, right, most=10)
    rest = np.asarray(right).reshape(-1) - matrix @ x.reshape(-1)
    norms = [np.sqrt(v @ preconditioner @ v) for v in (rest, np.asarray(right).reshape(-1))]
    assert left > 1e-3 and left == pytest.approx(norms[0] / norms[1], rel=1e-9)
    _, left = solved(*system(rng, np.where(np.arange(60) < 5, 0.0, values)), right)  # singular: there is no solution
    assert left > 1e-3
    x, left = solved(matrix, preconditioner, jnp.zeros((20, 3)))
    assert left == 0 and jnp.all(x == 0)
    x, left = solved(np.eye(60), np.eye(60), right)  # the first direction already is the solution
    np.testing.assert_allclose(x, right, rtol=1e-12)


@pytest.mark.slow
def test_gradients_through_an_equilibrium_that_is_not_stable(tmp_path):
    """A sheet that hangs flat from two corners would fold, and has no force that makes it, until the corners are moved."""
    vertices, faces = sheet(10, 10, 0.3 / 9)
    way = np.zeros((5, 3))
    way[:, 2] = 0.05 * (1 - np.cos(np.arange(5) / 5))
    write_npz(tmp_path / "sheet.npz", vertices=vertices, faces=faces, group_pins=np.array([90, 99]))
    write_npz(tmp_path / "bar.npz", poses=np.zeros((5, 1, 3)), trans=way, fps=np.array(30.0))
    tables = {
        "body": {"file": "none"},
        "garment": {"file": "sheet.npz", "pins": "pins"},
        "motion": {"files": ["bar.npz"]},
        "network": {"modes": 0},
        "physics": {"bending": {"stiffness": 1e-4}},
    }
    assembly = assemble(scene_from(tables, source=str(tmp_path / "scene.toml")), dtype=jnp.float64)
    simulator = simulator_from(assembly.model)

    def height(density):
        model = replace(simulator.model, material=replace(simulator.model.material, density=density))
        settings = Settings(tolerance=1e-7, iterations=300, first=3000)
        x, solution = simulate(replace(simulator, model=model), assembly.track, settings)
        return jnp.mean(x[-1, :10, 1]), (x, solution)

    density = simulator.model.material.density
    slope, (x, solution) = jax.jit(jax.grad(height, has_aux=True))(density)
    assert np.all(np.asarray(solution.status) == CONVERGED)
    assert np.ptp(x[0, :, 2]) < 1e-9 and np.ptp(x[-1, :, 2]) > 1e-3
    apart = 1e-3 * density
    higher, lower = (jax.jit(height)(density + sign * apart)[0] for sign in (1, -1))
    np.testing.assert_allclose(slope, (higher - lower) / (2 * apart), rtol=1e-4)

"""The simulator's options: the fast solver, and pins that are held exactly."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from ncs_jax.assembly import track_of
from ncs_jax.kinematics import blend, skin
from ncs_jax.simulator import simulate, simulator_from
from ncs_jax.solver.minimise import CONVERGED, LIMIT, Settings

from .test_simulator import sleeve

pytestmark = pytest.mark.slow

run = jax.jit(simulate, static_argnums=2)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    assembly = sleeve(tmp_path_factory.mktemp("sleeve"))
    motion = next(iter(assembly.motions.values()))
    return simulator_from(assembly.model), jax.tree.map(lambda a: a[:4], track_of(assembly.model, motion))


def test_quasi_newton_comes_to_where_newton_comes(scene):
    simulator, track = scene
    exact, _ = run(simulator, track, Settings(tolerance=1e-5, iterations=300))
    found, solution = run(simulator, track, Settings("quasi_newton", tolerance=1e-4, iterations=3000, first=3000))
    assert np.all(np.asarray(solution.status) == CONVERGED)
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-4)
    _, few = run(simulator, track, Settings("quasi_newton", tolerance=1e-4, iterations=5, first=3000))
    assert np.all(np.asarray(few.status)[1:] == LIMIT) and np.all(np.asarray(few.iterations)[1:] == 5)


def test_exact_pins_are_where_the_body_carries_them(scene):
    simulator, track = scene
    model = simulator.model
    carried = jax.vmap(lambda matrices: skin(blend(matrices, model.blend), model.garment.mesh.rest))(track.matrices)
    settings = Settings(tolerance=1e-6, iterations=300)
    gaps = {}
    for exact in (True, False):
        x, solution = run(simulator, track, replace(settings, exact_pins=exact))
        assert np.all(np.asarray(solution.status) == CONVERGED)
        gaps[exact] = np.abs(np.asarray(x - carried))[:, np.asarray(model.garment.pins)].max()
    assert gaps[True] < 1e-15 and gaps[False] > 1e-6

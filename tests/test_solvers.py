"""What a scene may ask of the simulator: the fast solver, exact pins, fast bodies, cloth that touches itself."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.intersections import intersecting
from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.metrics.quality import measure
from ncs_jax.prepare.build import features_from_records
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import load_scene
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.solver.minimise import CONVERGED, LIMIT, Settings

from .scenes import SCENE, grid, write_scene
from .shapes import tube
from .simulators import sleeve, thrown, written

pytestmark = pytest.mark.slow

run = jax.jit(simulate, static_argnums=2)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    assembly = sleeve(tmp_path_factory.mktemp("sleeve"))
    motion = next(iter(assembly.motions.values()))
    return simulator_from(assembly.model), jax.tree.map(lambda a: a[:4], features_from_records(assembly.model, motion))


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


def thrown_by(folder, cloth, way):
    """A scene whose post goes `way` (frames,) along z, and its loose cloth, which rests before it does; and what is left."""
    assembly = written(folder, *cloth, collision={"distance": "smooth", "stiffness": 200.0})
    model = assembly.model
    track = jax.tree.map(lambda a: a[: len(way)], features_from_records(model, next(iter(assembly.motions.values()))))
    start = jnp.zeros_like(track.matrices).at[:, :, 2, 3].set(way[:, None])
    track = replace(track, matrices=track.matrices[:1] + start)
    simulator = simulator_from(model)
    state = thrown(simulator, model.garment.mesh.rest)
    x, solution = run(simulator, track, Settings(tolerance=0.01, iterations=500), state=state)
    assert np.all(np.asarray(solution.status) == CONVERGED)
    return np.asarray(x), measure(model, x, track)["depth_max"]


def test_a_post_that_runs_thirty_centimetres_a_frame_goes_through_no_cloth(tmp_path):
    """A sleeve of 0.1 m round a post of 0.08 m stays round it, there and back."""
    vertices, faces = tube(12, 6, 0.1, 0.25)
    way = 0.3 * np.array([0, 1, 2, 3, 2, 1, 0.0])
    x, depth = thrown_by(tmp_path, (vertices + [0, 0.6, 0], faces), way)
    assert depth.max() < 2
    rings = (x - way[:, None, None] * [0, 0, 1]).reshape(len(way), -1, 12, 3)
    angles = np.unwrap(np.arctan2(rings[..., 2], rings[..., 0]), axis=2, period=2 * np.pi)
    turns = np.abs(angles[..., -1] - angles[..., 0]) / (2 * np.pi)
    assert np.all(turns > 0.5) and np.all(turns < 1.5)
    assert np.abs(x[..., 2].mean(axis=1) - way).max() < 0.06  # it went with the post, which is not to be had by standing still


def test_a_post_that_leaves_at_thirty_centimetres_a_frame_takes_no_cloth_along(tmp_path):
    vertices, faces = grid()
    n = np.arange(6)
    x, depth = thrown_by(tmp_path, (vertices, faces), -0.3 * n)
    fall = 9.81 / 30**2 * (n + 1) * (n + 2) / 2  # a step before the first frame it was at rest
    np.testing.assert_allclose(x[..., 1], vertices[:, 1] - fall[:, None], atol=1e-3)
    np.testing.assert_allclose(x[..., 2], 0.09, atol=1e-3)
    assert depth.max() == 0


SHEET, SHEET_FACES = grid()


@pytest.mark.parametrize("touches", [True, False])
def test_two_sheets_pressed_together_stay_apart_if_they_touch(tmp_path, rng, touches):
    vertices = np.concatenate([SHEET, SHEET + [0.013, 0.007, 0.02]])
    faces = np.concatenate([SHEET_FACES, SHEET_FACES + len(SHEET)])
    text = SCENE.replace("body.npz", "none").replace('files = ["swing.npz"]\nvalidation = ["swing.npz"]', "files = []")
    text += "[physics]\ngravity = [0, 0, 0]\n" + "[physics.self_contact]\nstiffness = 20\n" * touches
    path = write_scene(tmp_path, text)
    np.savez(tmp_path / "cloth.npz", vertices=vertices, faces=faces)
    assembly = assemble(load_scene(path), dtype=jnp.float64)
    track = jax.tree.map(lambda a: jnp.repeat(a, 6, axis=0), assembly.track)
    force = rng.uniform(0, 0.02, (6, len(vertices), 3)) * [0, 0, 1]
    force[:, len(SHEET) :] *= -1
    force[0] = 0
    model = replace(assembly.model, moves=True)
    x, solution = run(simulator_from(model), track, Settings(tolerance=1e-3, iterations=300), forces=jnp.asarray(force))
    assert np.all(np.asarray(solution.status) == CONVERGED)
    mesh = model.garment.mesh
    through = [np.asarray(intersecting(frame, mesh, groups_from(mesh))[0]) for frame in x]
    assert np.any(through) != touches

"""Curves along which a garment passes through itself: how long they are, and that cloth which shortens them comes apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.energies.contact.intersections import contour_length, crossings, intersecting
from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.runs.run import assemble
from ncs_jax.runs.train import train
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.loss import UNTANGLED, tangle

from .scenes import FREE, write_scene
from .shapes import ball, sheet


def joined(*parts):
    """Several meshes as one, and its groups; they lie far from each other at rest."""
    starts = np.cumsum([0, *(len(x) for x, _ in parts)])
    rest = np.concatenate([x + [10.0 * k, 0, 0] for k, (x, _) in enumerate(parts)])
    mesh = mesh_from(rest, np.concatenate([f + k for (_, f), k in zip(parts, starts, strict=False)]))
    return mesh, groups_from(mesh), np.concatenate([x for x, _ in parts])


def crossing_sheets():
    """Two sheets of 0.25 m at right angles, the second one 46 mm below the first with its lower edge."""
    x, faces = sheet(6, 6, 0.05)
    x = x - x.mean(axis=0)
    upright = x[:, [2, 0, 1]] + [0.003, 0.0123, 0.0793]
    return joined((x, faces), (upright, faces))


def length(mesh, groups):
    """The length as a function of positions."""
    return jax.jit(lambda x: contour_length(x, mesh, crossings(x, mesh, groups)))


def test_two_sheets_meet_along_a_line():
    mesh, groups, x = crossing_sheets()
    assert float(length(mesh, groups)(x)) == pytest.approx(0.25 - 0.0123, rel=1e-9)
    assert float(length(mesh, groups)(x + 7.0)) == pytest.approx(0.25 - 0.0123, rel=1e-9)  # wherever they are


def test_a_sheet_cuts_a_ball_in_a_circle():
    """At half of its height: 2 pi sqrt(3/4) times its radius."""
    x, faces = sheet(61, 61, 0.004)
    around, facets = ball(4, 0.1)
    around = Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).apply(around)  # no edge goes exactly through an edge
    mesh, groups, x = joined((x - [0.1207, 0.1213, -0.05], faces), (around, facets))
    assert float(length(mesh, groups)(x)) == pytest.approx(2 * np.pi * 0.1 * np.sqrt(0.75), rel=3e-3)


def test_a_sheet_that_lies_flat_has_no_curve_and_no_slope():
    mesh, groups, x = joined(sheet(6, 6, 0.05))
    value, slope = jax.value_and_grad(length(mesh, groups))(x)
    assert value == 0 and not np.any(slope)


def test_the_slope_is_that_of_finite_differences(rng):
    mesh, groups, x = crossing_sheets()
    x = x + 0.002 * rng.normal(size=x.shape)
    found, way = length(mesh, groups), rng.normal(size=x.shape)
    slope = float(jnp.sum(jax.grad(found)(x) * way))
    step = 1e-7 * way
    assert (found(x + step) - found(x - step)) / 2e-7 == pytest.approx(slope, rel=1e-6)
    np.testing.assert_allclose(jax.grad(found)(x).sum(axis=0), 0, atol=1e-12)  # nothing moves as a whole


def test_a_corner_that_pokes_through_is_drawn_back():
    mesh, groups, x = crossing_sheets()
    turned = (x[36:] - x[36:].mean(axis=0)) @ Rotation.from_euler("x", 45, degrees=True).as_matrix().T
    x = np.concatenate([x[:36], turned + [0.003, 0.012, 0.125 * np.sqrt(2) - 0.008]])
    found = jax.jit(jax.value_and_grad(length(mesh, groups)))
    first = float(found(x)[0])
    for _ in range(200):
        value, slope = found(x)
        if not value:
            break
        x = x - 1e-4 * np.asarray(slope)
    assert first == pytest.approx(0.016, rel=1e-6) and value == 0 and not np.any(intersecting(jnp.asarray(x), mesh, groups)[0])
    assert np.ptp(x[:36, 2]) < 0.02 and x[36:, 2].min() > x[:36, 2].min()


def test_some_poses_count_for_all(tmp_path, rng):
    """Over all whole numbers that choose them the mean is that of all poses; each time two of 20 are looked at."""
    text = FREE.replace("[training]", "[training]\nuntangling = 0.3")
    model = assemble(load_scene(write_scene(tmp_path, text))).model
    mesh, groups, count = model.garment.mesh, model.garment.groups, UNTANGLED + 4
    x = jnp.asarray(mesh.rest)[..., None] + 0.06 * jnp.asarray(rng.normal(size=(*mesh.rest.shape, count)), jnp.float32)
    some = jax.jit(lambda turn: tangle(model, 0.3, turn, x))
    parts, slopes = zip(*(some(jnp.int32(turn)) for turn in range(count)), strict=True)
    values = np.array([part["untangling"] for part in parts])
    assert np.all(np.count_nonzero(values, axis=1) == 2)
    each = jax.vmap(jax.value_and_grad(lambda y: 0.3 * length(mesh, groups)(y - y.mean(axis=0, keepdims=True))), -1, (0, -1))
    whole, slope = each(x)
    np.testing.assert_allclose(values.mean(axis=0), whole, rtol=1e-4)
    np.testing.assert_allclose(np.mean(slopes, axis=0), slope, atol=1e-4 * float(jnp.abs(slope).max()))


def test_only_a_scene_that_untangles_looks_at_it(tmp_path, plain_jax):
    plain = write_scene(tmp_path, FREE)
    assert assemble(load_scene(plain)).model.garment.groups is None
    told: list[dict] = []
    scene = write_scene(tmp_path, FREE.replace("[training]", "[training]\nuntangling = 0.3"))
    train(scene, tmp_path / "run", steps=10, report=lambda report: told.append(report.energies))
    assert told[-1]["untangling"] >= 0 and "untangling" in (tmp_path / "run" / "log.csv").read_text().splitlines()[0]

"""Evaluation: quantities of animations whose answers are known."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ncs_jax
from ncs_jax import InputError
from ncs_jax.energies.contact.intersections import intersecting
from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.metrics.penetration import CLEAR, depths_in, depths_on_host
from ncs_jax.metrics.quality import BLOCK, measure, summarise
from ncs_jax.prepare.build import features_from_records
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import load_scene, scene_from

from .scenes import SCENE, grid, write_scene
from .shapes import tube


def assembled(folder, **physics):
    tables = load_scene(write_scene(folder)).to_dict()
    tables["physics"].update(physics)
    return assemble(scene_from(tables), dtype=jnp.float64)


def still(model, frames=4):
    """A track of the rest pose."""
    from ncs_jax.io import MotionRecord

    return features_from_records(model, MotionRecord(np.zeros((frames, 2, 3)), np.zeros((frames, 3)), model.fps, ()))


@pytest.fixture(scope="module")
def assembly(tmp_path_factory):
    return assembled(tmp_path_factory.mktemp("scene"))


def test_the_rest_garment_has_no_strain(assembly):
    model = assembly.model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 4, axis=0)
    rows = measure(model, x, still(model))
    for name in ("strain_mean", "strain_p99", "shear_mean", "hinge_mean", "membrane", "bending", "penetrating", "depth_max"):
        np.testing.assert_allclose(rows[name], 0, atol=1e-8), name
    np.testing.assert_allclose(rows["total"], sum(rows[n] for n in ("membrane", "bending", "collision", "gravity", "inertia")))
    assert np.all(rows["out_of_balance"] > 0.99)  # nothing holds it up


def test_a_stretch_is_its_strain_and_a_shear_its_angle(assembly):
    model = assembly.model
    rest = np.asarray(model.garment.mesh.rest)
    x = rest[None] * np.array([1.1, 1.1, 1])
    sheared = rest + 0.2 * rest[:, 1:2] * [1, 0, 0]
    rows = measure(model, np.concatenate([x, x, sheared[None], sheared[None]]), still(model))
    np.testing.assert_allclose(rows["strain_mean"][:2], 10, rtol=1e-9)
    np.testing.assert_allclose(rows["strain_p99"][:2], 10, rtol=1e-9)
    np.testing.assert_allclose(rows["shear_mean"][:2], 0, atol=1e-9)
    np.testing.assert_allclose(rows["shear_mean"][2:], np.degrees(np.arctan(0.2)), rtol=1e-9)


def test_depth_and_share_of_what_is_inside(assembly):
    """A sheet 60 mm from the axis of a twelve-sided post whose corners are at 80 mm: its middle column of five is inside."""
    model = assembly.model
    rest = np.asarray(model.garment.mesh.rest)
    x = np.stack([rest, rest - [0, 0, 0.03]])
    rows = measure(model, x, still(model, 2))
    np.testing.assert_allclose(rows["penetrating"], [0, 20], atol=1e-5)
    assert rows["depth_max"][0] == 0
    assert 80 * np.cos(np.pi / 12) - 60 <= rows["depth_max"][1] <= 20  # a side's middle, a corner
    assert rows["middle_depth_max"][0] == 0 and rows["middle_depth_max"][1] == pytest.approx(rows["depth_max"][1], abs=1e-3)
    fast = measure(model, x, still(model, 2), exact=False)
    assert "middle_depth_max" not in fast
    # The next columns are half a millimetre outside a side, and inside the plane through its corner.
    np.testing.assert_allclose(fast["penetrating"], [0, 60], atol=1e-5)
    np.testing.assert_allclose(rows["within_1mm"], [0, 60], atol=1e-5)


def test_skin_between_vertices(assembly):
    """Columns 5 cm apart on both sides of the post's corner, 2 mm inside of which the edges pass."""
    model = assembly.model
    x = np.asarray(model.garment.mesh.rest) + [0.025, 0, 0.078 - 0.09]
    rows = measure(model, x[None].repeat(2, axis=0), still(model, 2))
    assert rows["depth_max"][0] == 0 and 1.5 < rows["middle_depth_max"][0] <= 2
    assert summarise(rows)["middle_depth_max"] == rows["middle_depth_max"].max()


def test_a_crease_of_a_garment_below_that_is_folded_too_far_does_not_turn_outside_into_inside():
    """A sleeve with a ridge whose flanks pass through each other: what is 2 cm before its tip is not inside."""
    around, rings, tip = 24, 14, 6
    x, faces = tube(around, rings, 0.1, 0.5)
    x, angle = x.reshape(rings, around, 3), 2 * np.pi / around
    x[:, tip] *= [1.3, 1, 1.3]
    for side in (-1, 1):  # each flank's foot past the other's
        turned = angle * tip - side * np.radians(0.5)
        x[:, tip + side, [0, 2]] = 0.1 * np.array([np.sin(turned), np.cos(turned)])
    body = jnp.asarray(x.reshape(-1, 3), jnp.float32)
    out = np.array([np.sin(angle * tip), 0, np.cos(angle * tip)])
    points = np.array([0.15 * out, -0.105 * out, -0.095 * out, [0, 0, 0]]) + [0, 0.24, 0]
    surface = surface_from(points, np.asarray(body), faces)
    depth = jax.jit(depths_in, static_argnums=3)
    single, layered = (np.asarray(depth(jnp.asarray(points, jnp.float32), body, surface, worn)) for worn in (False, True))
    assert single[0] > 0.015, "by the pseudo-normal alone it is inside"
    np.testing.assert_allclose(layered[0], -single[0], rtol=1e-6)
    np.testing.assert_allclose(layered[1:], single[1:])
    assert layered[1] < 0 < layered[2] < layered[3]
    for worn, found in ((False, single), (True, layered)):
        host = depths_on_host(points[None], np.asarray(body)[None], faces, layered=worn)[0]
        np.testing.assert_allclose(host, np.maximum(found, -CLEAR), atol=1e-6)


def test_a_free_fall_is_in_balance(tmp_path):
    model = assembled(tmp_path, collision={"stiffness": 0}).model
    rest, dt = np.asarray(model.garment.mesh.rest), 1 / model.fps
    n = np.arange(6)
    x = rest + np.array([0, -9.81, 0]) * (dt**2 * n * (n + 1) / 2)[:, None, None]
    rows = measure(model, x, still(model, 6))
    assert "penetrating" not in rows
    np.testing.assert_allclose(rows["out_of_balance"][1:], 0, atol=1e-6)
    assert rows["out_of_balance"][0] == pytest.approx(1)


def test_a_force_out_of_balance_is_in_multiples_of_g(tmp_path):
    model = assembled(tmp_path, collision={"stiffness": 0}, gravity=[0, 0, 2.0]).model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 3, axis=0)
    np.testing.assert_allclose(measure(model, x, still(model, 3))["out_of_balance"], 2 / 9.81, rtol=1e-9)


def test_frames_do_not_depend_on_how_many_there_are(assembly, rng):
    model = assembly.model
    x = np.asarray(model.garment.mesh.rest) + 0.002 * rng.normal(size=(BLOCK + 7, 30, 3))
    whole, part = measure(model, x, still(model, BLOCK + 7)), measure(model, x[:9], still(model, 9))
    for name, values in part.items():
        np.testing.assert_allclose(whole[name][:9], values, rtol=1e-12, atol=1e-12)
    assert all(len(values) == BLOCK + 7 for values in whole.values())


def test_triangles_that_pass_through_each_other(assembly):
    """The sheet as it is; its right columns turned over and pushed through the left ones; only where it is asked for."""
    model = assembly.model
    rest = np.asarray(model.garment.mesh.rest)
    folded = rest.copy()
    right = rest[:, 0] > 0.02
    folded[right, 0] = -rest[right, 0] - 0.013
    folded[right, 2] += 0.02 - 0.6 * (rest[right, 0] - 0.05)
    x = np.stack([rest, folded, rest])
    assert "self_intersecting" not in measure(model, x, still(model, 3))
    share = measure(model, x, still(model, 3), self_contact=True)["self_intersecting"]
    assert share[0] == share[2] == 0
    groups = groups_from(model.garment.mesh)
    through, overflow = jax.jit(intersecting)(jnp.asarray(folded), model.garment.mesh, groups)
    assert not overflow and through.any()
    np.testing.assert_allclose(share[1], 100 * np.mean(through), rtol=1e-12)


def test_a_scene_with_self_contact_is_asked(tmp_path):
    model = assembled(tmp_path, self_contact={"stiffness": 10.0, "thickness": 0.002}).model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 2, axis=0)
    rows = measure(model, x, still(model, 2))
    np.testing.assert_array_equal(rows["self_intersecting"], 0)
    np.testing.assert_array_equal(rows["self_contact"], 0)
    assert "self_intersecting" not in measure(model, x, still(model, 2), self_contact=False)


def test_summary():
    rows = {"total": np.array([1.0, 3.0]), "depth_max": np.array([1.0, 5.0]), "out_of_balance": np.array([1.0, 2.0, 90.0])}
    assert summarise(rows) == {"total": 2.0, "depth_max": 5.0, "out_of_balance": 2.0}
    assert isinstance(jax.tree.leaves(summarise(rows))[0], float)


def test_a_frames_inputs_give_what_a_motion_is_measured_with(tmp_path, plain_jax):
    """With friction; the example of the page runs as it stands, of this scene."""
    page = (Path(__file__).parents[1] / "docs" / "api" / "terms.md").read_text()
    block = re.search(r"```python\n(.*?)```", page, re.DOTALL)[1]
    scene = write_scene(tmp_path, SCENE + "[physics.collision]\nfriction = 0.5\n")
    vertices, faces = grid(origin=(0.0, 0.3, 0.082))  # so near that it touches
    np.savez(tmp_path / "cloth.npz", vertices=vertices, faces=faces)
    found: dict = {}
    exec(block.replace("ncs:tshirt", str(scene)), found)
    model, track, step = found["model"], found["track"], found["step"]
    assert step.advected is not None
    assert model.terms.collision and model.terms.friction and model.terms.inertia
    shapes = jnp.stack([found["skinned"](t) for t in range(13)]).at[12, :, 0].add(0.002)  # it slides
    part = jax.tree.map(lambda a: a[:13], track)
    rows = measure(model, part.absolute(shapes), part, exact=False)
    assert rows["friction"][12] > 0
    for name, value in found["energies"](shapes[12]).items():
        np.testing.assert_allclose(value, rows[name][12], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(found["of_each"][0], sum(found["parts"].values()), rtol=1e-6)
    assert np.ptp(found["of_each"]) > 0 and np.isfinite(found["force"]).all()
    with pytest.raises(InputError, match=r"previous: .*the garment in the frame before"):
        ncs_jax.frame_inputs(model, track, 12)

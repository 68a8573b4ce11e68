"""Skin that would show between the vertices of a coarse garment, and the contact that keeps it covered."""

import numpy as np
import pytest
import trimesh

from ncs_jax import io
from ncs_jax.geometry.surface_distance import border_of
from ncs_jax.prepare.covering import LOAD, SPARE, contact_for, least_thickness, sinking, vertex_share
from ncs_jax.prepare.fit import fit
from ncs_jax.prepare.scene_checks import find_risks
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import CollisionSpec, load_scene

from .scenes import SCENE, write_scene
from .shapes import tube


@pytest.fixture(scope="module")
def ball():
    """A ball of 10 cm, fine enough to be round to 0.05 mm."""
    return trimesh.creation.icosphere(subdivisions=5, radius=0.1)


@pytest.mark.parametrize("subdivisions", [2, 3])
def test_triangles_sink_into_a_ball_by_their_sagitta(ball, subdivisions):
    """R - sqrt(R^2 - r^2) for the circle of radius r around each triangle; and the height above the ball does not matter."""
    coarse = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.1)
    corners = coarse.triangles
    a, b, c = (np.linalg.norm(corners[:, i] - corners[:, (i + 1) % 3], axis=1) for i in range(3))
    around = a * b * c / (4 * coarse.area_faces)
    expected = np.percentile(0.1 - np.sqrt(0.01 - around**2), 99)
    for lifted in (1.0, 1.1):
        found = sinking(lifted * coarse.vertices, coarse.faces, ball.vertices, ball.faces)
        assert found == pytest.approx(expected, rel=0.05, abs=1e-4)
    assert sinking(2 * coarse.vertices, coarse.faces, ball.vertices, ball.faces) == 0  # 10 cm away: not on the skin


def test_facets_of_a_coarse_body_count_under_fine_cloth():
    """Cloth is fine and the body a cube: a triangle across its edge is cut by it."""
    cube = trimesh.creation.box(extents=(0.2, 0.2, 0.2))
    cloth = trimesh.creation.icosphere(subdivisions=3, radius=0.13)
    assert sinking(cloth.vertices, cloth.faces, cube.vertices, cube.faces) > 0.001
    flat, faces = cloth.vertices * 0.1 + [0.0, 0.12, 0.0], cloth.faces  # over one side of it nothing sinks
    assert sinking(flat, faces, cube.vertices, cube.faces) < 1e-6


def test_the_contact_holds_the_load_of_a_vertex_at_its_least_thickness():
    """The derivative of k (eps - d)^2 at what triangles sink is P a. Finer meshes need less, and the defaults at least."""
    x, faces = tube(24, 12, 0.1, 0.4)
    share, k, sunk = vertex_share(x, faces), 20.0, 0.003
    assert share == pytest.approx(2 * np.pi * 0.1 * 0.4 / len(x), rel=0.01)
    eps = least_thickness(sunk, share, k)
    assert 2 * k * (eps - sunk) == pytest.approx(LOAD * share)
    found = contact_for(x, faces, sunk)
    assert found.thickness == pytest.approx(SPARE * found.least, abs=1e-3) and found.thickness >= SPARE * found.least
    assert found.stiffness >= 15 and found.stiffness % 5 == 0
    fine = contact_for(*tube(96, 48, 0.1, 0.4), 0.0)
    assert (fine.thickness, fine.stiffness) == (0.004, 10.0)
    given = contact_for(x, faces, sunk, 0.001)
    assert given.thickness == 0.001 < given.least


def test_contact_between_vertices_asks_for_less():
    """Of n pieces an edge, each sinks by a square of n less and bears as much less."""
    x, faces = tube(12, 6, 0.1, 0.4)
    pieces = np.full(len(faces), 2)
    assert vertex_share(x, faces, pieces) == pytest.approx(vertex_share(x, faces) / 4)
    assert contact_for(x, faces, 0.003, pieces=pieces).stiffness < contact_for(x, faces, 0.003).stiffness
    assert vertex_share(x, faces, pieces[:0]) == vertex_share(x, faces)


def test_a_fit_asks_for_less_where_its_scene_looks_between_vertices(monkeypatch):
    skin, around = tube(64, 40, 0.08, 0.5)
    weights = np.ones((len(skin), 1), np.float32)
    body = io.BodyRecord(skin, around, np.zeros((1, 3)), np.array([-1], np.int32), weights)
    cloth = io.GarmentRecord(tube(10, 6, 0.09, 0.3)[0] + [0, 0.1, 0], tube(10, 6, 0.09, 0.3)[1])
    found = {}
    for points in ("0", "auto"):
        monkeypatch.setattr("ncs_jax.prepare.fit.CollisionSpec", lambda points=points: CollisionSpec(points=points))
        found[points] = fit("g.npz", cloth, body, move=(0, 0, 0)).contact
    assert found["auto"].thickness < found["0"].thickness and found["auto"].stiffness < found["0"].stiffness


def test_a_border_is_where_a_mesh_ends():
    x, faces = tube(8, 4, 0.1, 0.4)
    np.testing.assert_array_equal(np.flatnonzero(border_of(faces, len(x))), [*range(8), *range(24, 32)])


def test_a_check_says_first_that_contact_is_too_thin_and_what_mends_it(tmp_path, plain_jax):
    """A tube of six sides around the post, which has 16: its sides cut deep into it."""
    text = SCENE.replace("fps = 30", "fps = 1000").replace("[network]", '[network]\nmethod = "pbns"')
    path = write_scene(tmp_path, text)
    x, faces = tube(8, 12, 0.09, 0.35)
    np.savez(tmp_path / "cloth.npz", vertices=(x + [0, 0.3, 0]).astype(np.float32), faces=faces)
    risks = find_risks(assemble(load_scene(path)))
    assert risks[0].what == "thickness of the collision" and len(risks) > 1 and "4 mm" in risks[0].value
    thickness, stiffness = (float(risks[0].mend.split(f"{name} = ")[1].split(",")[0]) for name in ("thickness", "stiffness"))
    mended = f"[physics.collision]\nthickness = {thickness:g}\nstiffness = {stiffness:g}\n[network]"
    path.write_text(text.replace("[network]", mended))
    assert "thickness of the collision" not in [risk.what for risk in find_risks(assemble(load_scene(path)))]

"""Cloth put out of the body: what lies too deep comes to the margin, and nothing else moves."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.distance import plane_distance
from ncs_jax.energies.contact.nearest import boxes_around, nearest_of_few, nearest_vertex
from ncs_jax.energies.contact.outside import put_outside
from ncs_jax.energies.contact.points import contact_points, with_points
from ncs_jax.energies.contact.surface import surface_from, vertex_normals
from ncs_jax.geometry.closest_point import triangle_square
from ncs_jax.metrics.quality import measure
from ncs_jax.runs.outside import LIMB, STRETCHED, outside_body, pushing
from ncs_jax.runs.outside import MARGIN as MARGIN_OF
from ncs_jax.runs.run import load_run
from ncs_jax.runs.train import train

from .ready import assembled
from .scenes import SCENE, swing, write_scene
from .shapes import ball, tube

RADIUS, MARGIN = 0.2, 0.004
BALL, TRIANGLES = ball(4, RADIUS)


def put(cloth, faces=None, skin=None, bodies=1):
    """The cloth (verts, 3) about the ball, in so many equal poses; `faces`: with points between its vertices, 3 an edge."""
    points = None if faces is None else contact_points(faces, np.full(len(faces), 3))
    surface = surface_from(cloth, BALL, TRIANGLES, points=points)
    x, body = (jnp.repeat(jnp.asarray(a, jnp.float32)[..., None], bodies, axis=2) for a in (cloth, BALL))
    skin = np.ones(len(BALL)) if skin is None else skin
    found = np.asarray(put_outside(x, body, surface, jnp.asarray(skin, jnp.float32), MARGIN))
    return found, None if points is None else np.asarray(with_points(jnp.asarray(found), points))


def around(depths, rng):
    """Directions, and points by so much inside of the ball."""
    way = rng.normal(size=(len(depths), 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return way, way * (RADIUS - np.asarray(depths))[:, None]


def test_what_is_a_little_inside_comes_to_the_margin_and_the_rest_stays(rng):
    depths = np.concatenate([np.linspace(-0.003, 0.015, 40), np.linspace(-0.05, -0.006, 40), np.linspace(0.09, 0.15, 40)])
    way, cloth = around(depths, rng)
    found, _ = put(cloth, bodies=3)
    assert np.array_equal(found[..., 0], found[..., 2])
    moved = found[..., 0] - cloth.astype(np.float32)
    height = np.linalg.norm(found[..., 0], axis=1) - RADIUS
    np.testing.assert_allclose(height[:40], MARGIN, atol=1e-3)  # the ball is made of triangles of 1.3 cm
    assert np.linalg.norm(np.cross(way[:40], moved[:40]), axis=1).max() < 2e-3
    assert not moved[40:].any()


def test_skin_that_does_not_push_lets_cloth_be(rng):
    _, cloth = around(np.full(60, 0.008), rng)
    found, _ = put(cloth, skin=(BALL[:, 0] > 0).astype(float))
    moved = np.linalg.norm(found[..., 0] - cloth.astype(np.float32), axis=1)
    assert moved[cloth[:, 0] > 0.02].min() > 0.01 and not moved[cloth[:, 0] < -0.02].any()


def test_what_is_inside_between_vertices_is_carried_out_by_its_corners():
    """A triangle over the ball's top whose corners are outside, and whose middle is not."""
    corner = np.array([[0.05, 0, 0], [-0.025, 0.045, 0], [-0.025, -0.045, 0]]) + [0, 0, 0.199]
    faces = np.array([[0, 1, 2]])
    assert np.linalg.norm(corner, axis=1).min() > RADIUS + MARGIN > RADIUS > np.linalg.norm(corner.mean(axis=0))
    _, every = put(corner, faces)
    height = np.linalg.norm(every[..., 0], axis=1) - RADIUS
    assert height.min() > MARGIN - 1.5e-3, height
    alone, _ = put(corner)
    assert np.array_equal(alone[..., 0], corner.astype(np.float32))


def test_what_the_plane_of_the_nearest_vertex_calls_inside_stays_where_it_is_outside():
    """Over the sides of a coarse limb: outside by more than the margin, or by half of it, and below the planes of its edges."""
    body, triangles = tube(8, 4, 0.06, 0.2)
    angle = (np.arange(8) + 0.5) * np.pi / 4
    height = 0.06 * np.cos(np.pi / 8) + np.where(np.arange(8) % 2, MARGIN + 1e-4, MARGIN / 2)
    cloth = np.stack([height * np.sin(angle), np.full(8, 0.1), height * np.cos(angle)], axis=1)
    surface = surface_from(cloth, body, triangles)
    x, skin = (jnp.asarray(a, jnp.float32) for a in (cloth, body))
    index, _ = nearest_vertex(x, skin, surface)
    assert plane_distance(x, skin, vertex_normals(skin, surface), index).max() < MARGIN - 2e-3
    moved = np.linalg.norm(put_outside(x, skin, surface, jnp.ones(len(skin), x.dtype), MARGIN) - x, axis=1)
    assert not moved[1::2].any()
    np.testing.assert_allclose(moved[::2], MARGIN / 2, rtol=0.02)


@pytest.mark.parametrize("poses", [1, 3])
@pytest.mark.parametrize("torn", [False, True])
def test_few_points_find_their_triangle(rng, poses, torn):
    """As a search of all of them does, also where groups are torn apart by a pose, so that every point is in many boxes."""
    body = np.stack([BALL * rng.uniform(0.8, 1.2, 3) for _ in range(poses)], axis=2)
    pose = np.arange(200) % poses
    x = body[rng.integers(len(BALL), size=200), :, pose] + rng.normal(size=(200, 3)) * rng.choice([0.01, 0.1], (200, 1))
    surface = surface_from(BALL[:10], rng.permutation(BALL) if torn else BALL, TRIANGLES)
    every, at = jnp.asarray(body), jnp.asarray(pose, jnp.int32)
    found = nearest_of_few(list(jnp.asarray(x.T)), at, every, surface, boxes_around(every, surface))
    corners = jnp.transpose(every[TRIANGLES][..., at], (1, 2, 0, 3))  # (3 corners, 3, triangles, points)
    square = triangle_square(jnp.asarray(x.T)[:, None], *corners)
    np.testing.assert_allclose(square[found, jnp.arange(200)], square.min(axis=0), rtol=1e-9)


@pytest.fixture
def _plain(plain_jax):
    yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("outside")
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        train(write_scene(folder, SCENE), folder / "run", steps=2)
        run = load_run(folder / "run")
    np.savez(folder / "clip.npz", **swing(frames=40))
    return run, str(folder / "clip.npz")


def test_an_animation_is_put_outside_of_its_body(trained, _plain):
    """Pressed into the post by two centimetres, in more frames than are done at once."""
    run, clip = trained
    model, track = run.assembly.model, run.track(clip)
    pressed = run.animate(clip) - np.float32([0, 0, 0.02])
    out = outside_body(model, track, pressed)
    assert out.shape == pressed.shape and out.dtype == pressed.dtype
    inside, left = (measure(model, x, track)["depth_max"] for x in (pressed, out))
    assert np.median(inside) > 5 and left.max() < 0.25 * inside.max(), (inside, left)  # the post has twelve sides
    far = np.linalg.norm(out - pressed, axis=2)
    assert 0 < np.mean(far > 0) < 0.9
    np.testing.assert_array_equal(outside_body(model, track, pressed[:5]), out[:5])
    np.testing.assert_array_equal(run.animate(clip, outside=True), outside_body(model, track, run.animate(clip)))


def test_without_contact_nothing_is_put_anywhere(trained, _plain):
    run, clip = trained
    x = run.animate(clip)
    assert outside_body(replace(run.assembly.model, surface=None), run.track(clip), x) is x


def test_edges_that_would_sink_into_a_limb_are_cut_until_they_do_not():
    """The longest of a triangle's edges against sqrt(8 LIMB margin) / STRETCHED; what contact looks at stays."""
    model = assembled().model
    mesh = model.garment.mesh
    rest, faces = np.asarray(mesh.rest), np.asarray(mesh.faces)
    longest = np.max([np.linalg.norm(rest[faces[:, k]] - rest[faces[:, k - 1]], axis=1) for k in range(3)], axis=0)
    margin = (STRETCHED * longest.max()) ** 2 / (8 * LIMB)

    def points(thickness, **surface):
        material = replace(model.material, thickness=jnp.float32(thickness))
        return pushing(replace(model, material=material, surface=replace(model.surface, **surface))).surface

    few, middles, thirds, most = (points(share * margin / MARGIN_OF) for share in (1.01, 0.26, 0.12, 1e-3))
    assert few.points is None and few.halfway is None and middles.halfway is not None
    edges = len(mesh.edges)
    assert [len(each.points.corners) for each in (middles, thirds, most)] == [
        edges, 2 * edges + len(faces), 3 * edges + 3 * len(faces),
    ]  # fmt: skip
    own = contact_points(faces, np.where(np.arange(len(faces)) == 3, 2, 1))
    kept = points(1.01 * margin / MARGIN_OF, points=own).points
    assert np.array_equal(kept.corners, own.corners) and np.array_equal(kept.weights, own.weights)

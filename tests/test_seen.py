"""What a person sees: skin through cloth, and surfaces that cross, of spheres, tubes and sheets whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax import InputError
from ncs_jax.energies.contact.intersections import intersecting
from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.geometry.depth_buffer import fragments, rasterise
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.geometry.triangle_crossings import crossed
from ncs_jax.metrics.quality import summarise
from ncs_jax.metrics.seen import EVERY, VISIBLE, measure_seen, shown_skin, touchable_bodies
from ncs_jax.metrics.skin import covered_skin, skin_pixels

from .scenes import post
from .shapes import ball, sheet, tube
from .test_evaluation import assembled, still


def joined(*meshes):
    """Several meshes as one: vertices and faces."""
    starts = np.cumsum([0, *(len(x) for x, _ in meshes)])
    return np.concatenate([x for x, _ in meshes]), np.concatenate([f + k for (_, f), k in zip(meshes, starts, strict=False)])


def leg(at=(0.0, 0.0, 0.0)):
    """A closed post, 1 m high and 8 cm thick all around."""
    body = post(around=32)
    return body["vertices"] + at, body["faces"]


def skirt(radius=0.12, flare=0.0):
    """A tube about the y axis from 0.3 to 0.8 m, wider below."""
    x, faces = tube(48, 21, radius, 0.5)
    wider = 1 + flare * (0.5 - x[:, 1:2])
    return x * np.concatenate([wider, np.ones_like(wider), wider], axis=1) + [0, 0.3, 0], faces


# --- crossing triangles ---------------------------------------------------------------------------------------------


def test_a_plane_crosses_a_ball_in_a_circle():
    """At half of its height: what is crossed lies about a circle of 0.1 sqrt(3/4) m, and goes all around."""
    x, faces = sheet(61, 61, 0.004)
    x = x - [0.12, 0.12, -0.05]
    around, facets = ball(4, 0.1)
    through = crossed(x, faces, around, facets)
    radius = np.linalg.norm(x[faces][..., :2], axis=-1)
    circle = 0.1 * np.sqrt(0.75)
    assert (radius[through].max(axis=1) > circle - 2e-4).all() and (radius[through].min(axis=1) < circle).all()
    surely = (radius.max(axis=1) > circle) & (radius.min(axis=1) < circle - 2e-4)  # facets are within 0.2 mm of the ball
    assert surely.sum() > 200 and through[surely].all()
    there = crossed(around, facets, x, faces)  # and the other way round
    assert (around[facets[there]][..., 2].max(axis=1) > 0.05).all() and (around[facets[there]][..., 2].min(axis=1) < 0.05).all()


def test_what_only_touches_or_lies_within_is_not_crossed():
    outer, faces = ball(3, 0.1)
    inner, _ = ball(3, 0.09)
    assert not crossed(inner, faces, outer, faces).any() and not crossed(outer, faces).any()
    flat, own = sheet()
    assert not crossed(flat, own, flat + [0.003, 0.002, 0], own).any()  # in one plane
    assert not crossed(flat, own, flat[:, [0, 2, 1]], own).any()  # an edge on the other's plane
    broken = inner + [0.05, 0, 0]
    assert crossed(broken, faces, outer, faces).any()
    broken[0] = np.nan
    assert not crossed(broken, faces, outer, faces)[(faces == 0).any(axis=1)].any()
    assert not crossed(np.full_like(inner, np.nan), faces, outer, faces).any()


def test_it_is_what_the_program_finds(rng):
    x, faces = sheet(12, 12, 0.01)
    mesh = mesh_from(x, faces)
    crumpled = x + 0.01 * rng.normal(size=x.shape)
    through, overflow = jax.jit(intersecting)(jnp.asarray(crumpled), mesh, groups_from(mesh))
    assert not overflow and 0.1 < np.mean(through) < 1
    np.testing.assert_array_equal(crossed(crumpled, faces), through)


# --- layers of a picture --------------------------------------------------------------------------------------------


def test_everything_at_a_pixel_comes_in_the_order_of_the_depth():
    x, faces = joined(ball(3, 0.1), ball(3, 0.05))
    at = 200 * (x + 0.11)
    found = fragments(at[:, 0], at[:, 1], at[:, 2], faces, (44, 44))
    same = np.diff(found.pixel) == 0
    assert (np.diff(found.pixel) >= 0).all() and (np.diff(found.depth)[same] >= 0).all()
    middle = found.pixel == 22 * 44 + 22
    np.testing.assert_allclose(np.unique(found.depth[middle].round()), 200 * np.array([0.01, 0.06, 0.16, 0.21]), atol=1)
    assert set(found.face[middle] >= 1280) == {False, True}
    nearest, depth = rasterise(at[:, 0], at[:, 1], at[:, 2], faces, 44, 44)
    last = np.flatnonzero(np.diff(found.pixel, append=-1))
    np.testing.assert_array_equal(np.flatnonzero(nearest.ravel() >= 0), found.pixel[last])
    np.testing.assert_allclose(depth.ravel()[found.pixel[last]], found.depth[last])
    nothing = fragments(at[:, 0] + 100, at[:, 1], at[:, 2], faces, (44, 44))
    assert not len(nothing.pixel) and not len(nothing.depth)


# --- skin through cloth ---------------------------------------------------------------------------------------------


def test_a_ball_shows_through_its_cover_where_it_is_outside():
    """Two balls, 10 and 10.5 cm: shifted by 2 cm along z, they meet in the plane z = (r^2 - R^2 + d^2) / (2 d)."""
    (body, faces), (cover, cloth) = ball(4, 0.1), ball(4, 0.105)
    skin = covered_skin(body, faces, cover, cloth)
    assert skin.covered.all()
    shown, seen = skin_pixels(skin, body, cover)
    assert not len(shown) and seen * skin.pixel**2 == pytest.approx(6 * np.pi * 0.105**2, rel=0.01)
    d = 0.02
    plane = (0.1**2 - 0.105**2 + d**2) / (2 * d)
    u, z = np.meshgrid(np.linspace(-0.1, 0.1, 801), np.linspace(-0.1, plane, 801))
    within = (u**2 + z**2 < 0.1**2) & (u**2 + (z - d) ** 2 < 0.105**2)  # from a side, cloth lies beneath
    side = within.mean() * 0.2 * (plane + 0.1)
    expected = np.pi * (0.1**2 - plane**2) + 4 * side
    for turned in (cloth, cloth[:, ::-1]):  # nobody says which side of a garment is its outside
        skin = covered_skin(body, faces, cover, turned)
        shown, _ = skin_pixels(skin, body, cover + [0, 0, d])
        assert len(shown) * skin.pixel**2 == pytest.approx(expected, rel=0.02)


def test_what_is_covered_ends_at_the_openings():
    body, faces = leg()
    skin = covered_skin(body, faces, *skirt())
    height = body[faces].mean(axis=1)[:, 1]
    assert skin.covered[(height > 0.36) & (height < 0.74)].all()
    assert not skin.covered[(height < 0.27) | (height > 0.83)].any()


@pytest.mark.parametrize("flare", [0.0, 1.5])
def test_legs_seen_from_below_and_through_a_neck_do_not_count(flare):
    """Of a straight skirt and of a wide one; pushed through the cloth, the leg counts."""
    body, faces = leg()
    x, cloth = skirt(flare=flare)
    skin = covered_skin(body, faces, x, cloth)
    for moved in (0.0, 0.035):  # without touching: 4 cm are free
        shown, seen = skin_pixels(skin, body + [moved, 0, 0], x)
        assert not len(shown) and seen > 10_000
    lifted, _ = skin_pixels(skin, body + [0, 0.3, 0], x)  # covered skin comes out at the top, and is seen
    assert not len(lifted)
    through, _ = skin_pixels(skin, body + [0.08, 0, 0], x)
    assert len(through) > 500 and body[faces[through], 0].min(axis=1).mean() > 0.02  # on the side to which it is moved


def test_an_arm_pressed_into_the_garment_does_not_count():
    """Beside it at rest, within it now: it is not what the garment covers."""
    trunk, arm = leg(), leg((0.3, 0, 0))
    body, faces = joined(trunk, arm)
    x, cloth = skirt()
    skin = covered_skin(body, faces, x, cloth)
    assert not skin.covered[len(trunk[1]) :].any() and skin.covered[: len(trunk[1])].any()
    pressed = body - np.where(np.arange(len(body)) < len(trunk[0]), 0, 0.14)[:, None] * [1, 0, 0]
    assert crossed(x, cloth, pressed, faces).any()
    assert not len(skin_pixels(skin, pressed, x)[0])


def test_a_bump_counts_by_its_size():
    """A few of the cover's vertices lie 1 cm deep: a patch that two of the views see a part of, and no other one."""
    body, faces = leg()
    x, cloth = skirt(0.09)
    skin = covered_skin(body, faces, x, cloth)
    assert not len(skin_pixels(skin, body, x)[0])
    dented = x.copy()
    patch = (np.abs(x[:, 1] - 0.55) < 0.03) & (x[:, 2] > 0.08)
    dented[patch] *= np.array([0.07 / 0.09, 1, 0.07 / 0.09])
    shown, _ = skin_pixels(skin, body, dented)
    area = len(shown) * skin.pixel**2
    assert 0.03 * 0.05 < area < 2.5 * 0.1 * 0.08


# --- of a scene -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def assembly(tmp_path_factory):
    return assembled(tmp_path_factory.mktemp("scene"))


def test_frames_of_a_scene(assembly):
    """A sheet before a post, and 2 cm within it from the frame 10 on; the root walks, and cloth and body with it."""
    model = assembly.model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 17, axis=0)
    x[10:, :, 2] -= 0.03
    found = measure_seen(model, x, still(model, 17))
    assert set(found) == {"self_intersecting", "body_intersecting", "skin_pixels", "skin_share"}
    assert all(len(row) == -(-17 // EVERY) for row in found.values())
    np.testing.assert_array_equal(found["self_intersecting"], 0)
    for name in ("body_intersecting", "skin_pixels", "skin_share"):
        assert (found[name][:2] == 0).all() and (found[name][2:] > 0).all(), name
    # The post is 9.9 cm wide in the sheet's plane, the sheet 20 cm; from behind the post hides all but 4 cm.
    # At the sheet's ends the post is not covered.
    assert 0.2 < found["skin_share"][2] / 100 < 0.099 / 0.24 + 0.01
    assert summarise(found)["body_intersecting"] == pytest.approx(found["body_intersecting"].mean())
    assert len(measure_seen(model, x, still(model, 17), 1)["skin_share"]) == 17


def test_where_skin_shows_most_is_told(assembly):
    """The sheet comes into the post by degrees; half of the frames are looked at."""
    model = assembly.model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 12, axis=0)
    x[4:, :, 2] -= np.linspace(0.01, 0.03, 8)[:, None]
    track, frames = still(model, 12), np.arange(0, 12, 2)
    body = touchable_bodies(model, track, frames)
    found = shown_skin(model, x[frames], body, frames)
    pixels = measure_seen(model, x, track, 2)["skin_pixels"]
    assert pixels.max() > VISIBLE > pixels[0] == 0
    assert (found.looked, found.shown, found.frame, found.pixels) == (
        6, (pixels >= VISIBLE).sum(), 2 * pixels.argmax(), pixels.max(),
    )  # fmt: skip
    covered = np.ptp(x[0], axis=0).max()
    assert np.linalg.norm(body[0][found.vertex] - x[found.frame], axis=1).min() < covered
    clean = shown_skin(model, x[:3], body[:3], np.arange(3))
    assert (clean.shown, clean.pixels, clean.vertex) == (0, 0, 0)


def test_without_a_body_only_the_cloth_is_asked(tmp_path):
    model = assembled(tmp_path, collision={"stiffness": 0}).model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 2, axis=0)
    assert set(measure_seen(model, x, still(model, 2))) == {"self_intersecting"}


def test_what_cannot_be_looked_at_is_told(assembly):
    model = assembly.model
    x = np.repeat(np.asarray(model.garment.mesh.rest)[None], 11, axis=0)
    with pytest.raises(InputError, match="at most the track's 4 frames"):
        measure_seen(model, x, still(model, 4))
    with pytest.raises(InputError, match="30 vertices"):
        measure_seen(model, x[:, :-1], still(model, 11))
    x[5, 3] = np.nan
    with pytest.raises(InputError, match="frame 5"):
        measure_seen(model, x, still(model, 11))

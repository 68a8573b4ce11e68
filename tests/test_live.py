"""A garment live in a browser: what is shown, how it is coloured, and one look at it in a real browser."""

import subprocess

import numpy as np
import pytest
from PIL import Image

from ncs_jax import InputError, io, train
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.view.character import animation_of, body_vertices
from ncs_jax.view.live import BINS, COLOURS, THROUGH, View, animated_garment, colour_bins, vertex_values, view

from .browser import CHROMIUM
from .scenes import write_scene

pytest.importorskip("viser")


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def carried(scene):
    return animated_garment(str(scene))


def test_a_scene_is_shown_as_the_body_carries_it(carried):
    x = carried.animate(carried.motions[0], 1.0)
    model, track = carried.run.assembly.model, carried.run.track(carried.motions[0])
    assert x.shape == (24, 30, 3) and not carried.controlled
    assert np.abs(x[0] - np.asarray(model.garment.mesh.rest)).max() < 1e-5  # the motion begins at rest
    speed = vertex_values("speed as seen from the body", carried.run, x, track, 5, None)
    assert np.abs(speed).max() < 1e-2  # and the garment does not move of itself


def test_an_animation_of_a_run_is_on_its_body(carried):
    run, name = carried.run, carried.motions[0]
    x, assembly = carried.animate(name, 1.0), run.assembly
    made = animation_of(assembly, run.motion(name), x)
    assert made.garment is x and made.fps == assembly.model.fps and made.body.worn == 0
    np.testing.assert_array_equal(made.garment_faces, assembly.garment.faces)
    np.testing.assert_array_equal(made.body.vertices, body_vertices(assembly.body, run.motion(name)))
    np.testing.assert_allclose(made.body.vertices[0], assembly.body.vertices, atol=1e-6)  # the motion begins at rest
    with pytest.raises(InputError, match="23 frames"):
        animation_of(assembly, run.motion(name), x[:-1])


def test_colours_are_of_what_they_say(carried):
    run, name = carried.run, carried.motions[0]
    x, track = carried.animate(name, 1.0), carried.run.track(name)
    assert isinstance(track, MotionFeatures)
    stretched = x.copy()
    stretched[0] = x[0].mean(axis=0) + 1.2 * (x[0] - x[0].mean(axis=0))
    np.testing.assert_allclose(vertex_values("strain", run, stretched, track, 0, None), 20, rtol=1e-3)
    aside = x + np.array([0, 0, 0.02], np.float32)
    np.testing.assert_allclose(vertex_values("distance to the overlay", run, x, track, 3, aside), 20, rtol=1e-3)
    assert not vertex_values("distance to the overlay", run, x, track, 3, None).any()
    inside = x.copy()
    inside[0, :, 2] -= 0.03  # the cloth hangs 1 cm before a post of 8 cm
    depth = vertex_values("distance inside the body", run, inside, track, 0, None)
    assert (
        depth.max() == pytest.approx(20, abs=1.5)
        and not vertex_values("distance inside the body", run, x, track, 0, None).any()
    )
    through = vertex_values(THROUGH, run, inside, track, 0, None)
    assert set(through) == {0.0, 100.0} and through[depth > 0].all()  # what is inside, and the triangles that go in
    assert (through > 0).sum() > (depth > 0).sum()
    assert not vertex_values(THROUGH, run, x, track, 0, None).any()
    folded = x.copy()
    right = x[0, :, 0] > 0.02
    folded[0, right] = x[0, right] * [-1, 1, 1] + np.array([-0.013, 0, 0.02]) - 0.6 * (x[0, right, :1] - 0.05) * [0, 0, 1]
    assert 0 < vertex_values(THROUGH, run, folded, track, 0, None).mean() < 100
    u = x.copy()
    u[4] += np.array([0, 0.01, 0], np.float32)
    np.testing.assert_allclose(vertex_values("speed as seen from the body", run, u, track, 4, None), 300, rtol=2e-2)


def test_faces_have_the_colour_of_their_corners():
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    assert colour_bins(np.array([0, 0, 0, 3.0]), faces, 2.0).tolist() == [0, BINS // 2]
    assert colour_bins(np.full(4, 99.0), faces, 2.0).tolist() == [BINS - 1] * 2


def test_what_cannot_be_shown_is_named(scene, tmp_path):
    file = tmp_path / "moved.npz"
    io.write_animation(file, np.zeros((3, 30, 3), np.float32), np.array([[0, 1, 2]], np.int32), 30.0)
    without = (str(file),), "add scene SCENE"
    for given, told in (without, ((str(file), str(scene)), "24, 30, 3"), (("nowhere.toml",), "nowhere")):
        with pytest.raises(InputError, match=told):
            animated_garment(*given)


def test_the_page_plays_scrubs_and_colours(carried):
    there = carried.animate(carried.motions[0], 1.0)
    window = View(carried, {"other": there + np.float32(0.02)}, port=0)
    try:
        window.playing.value, window.scrub.value, window.overlay.value = False, 7, "other"
        window.wait(0.2)
        assert window.frame == 7 and window.other.visible
        middle = there[7].mean(axis=0) * [1, 0, 1]
        np.testing.assert_allclose(window.cloths[0][1].vertices, there[7] - middle, atol=1e-5)
        for name in COLOURS:
            window.colour.value = name
            window.wait(0.1)
            assert name in window.caption.content and not window.cloths[0][1].visible
            assert sum(len(part.faces) for part in window.bins if part.visible) == len(window.faces)
        assert "mean 34.6" in window.caption.content  # mm: 20 along each axis
    finally:
        window.close()


def test_a_notebook_shows_the_page_which_plays_until_it_is_closed(scene):
    window = view(str(scene), port=0)
    try:
        assert f'src="{window.address}"' in window._repr_html_()
        player = window._player
        assert player.is_alive() and window._repr_html_() and window._player is player
    finally:
        window.close()
    assert not player.is_alive()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_shows_a_run(scene, tmp_path):
    train(scene, tmp_path / "run", steps=10)
    window = view(str(tmp_path / "run"), port=0)
    picture = tmp_path / "page.png"
    try:
        assert window.subject.controlled
        window.playing.value = False
        command = [str(CHROMIUM), "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        command += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=900,700", "--virtual-time-budget=15000"]
        with subprocess.Popen([*command, f"--screenshot={picture}", window.address], stderr=subprocess.DEVNULL) as browser:
            for _ in range(120):
                window.wait(0.5)
                if browser.poll() is not None:
                    break
    finally:
        window.close()
    r, g, b = np.moveaxis(np.asarray(Image.open(picture).convert("RGB")).astype(int), 2, 0)
    assert ((r > 150) & (r > 1.4 * g) & (g > b)).sum() > 500  # the cloth

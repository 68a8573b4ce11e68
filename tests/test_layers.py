"""A garment worn over another one, which collides as part of the body."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
import pytest

from ncs_jax import InputError, Run, assemble, load_run, load_scene, measure, simulate, train
from ncs_jax.cli import main
from ncs_jax.energies.contact.distance import plane_distance
from ncs_jax.energies.contact.nearest import nearest_vertex
from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.contact.surface import vertex_normals
from ncs_jax.scene.model import pose_body
from ncs_jax.training.step import initial_state
from ncs_jax.view.browser_runtime import BrowserRuntime
from ncs_jax.view.character import posed_body
from ncs_jax.view.living import write_living_page

from .scenes import SCENE, write_scene
from .shapes import tube
from .test_viewer import Page


@pytest.fixture(scope="module", autouse=True)
def _plain():
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sleeve around the upper half of the post, learned, and the scene of a wider one over it."""
    folder = tmp_path_factory.mktemp("layers")
    write_scene(folder)
    for name, radius in (("inner", 0.1), ("outer", 0.115)):
        x, faces = tube(24, 14, radius, 0.5)
        pins = np.arange(13 * 24, 14 * 24)
        np.savez(folder / f"{name}.npz", vertices=x + [0, 0.35, 0], faces=faces, group_pins=pins)
        text = SCENE.replace('"cloth.npz"', f'"{name}.npz"\npins = "pins"')
        (folder / f"{name}.toml").write_text(text)
    train(load_scene(folder / "inner.toml"), folder / "run", steps=20)
    text = (folder / "outer.toml").read_text().replace("smoothing = 2", 'smoothing = 2\nover = ["run"]')
    (folder / "outer.toml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def worn(folder):
    return assemble(load_scene(folder / "outer.toml"))


def test_what_collides_is_the_body_and_the_garment_below_where_it_is(folder, worn):
    """Its vertices are those that its own run animates, frame by frame, and its triangles are appended to the body's."""
    below, model, track = load_run(folder / "run"), worn.model, worn.track
    x = below.animate(str(folder / "swing.npz"))
    bodies = np.asarray(jax.vmap(lambda m: pose_body(model, m))(track.matrices))
    np.testing.assert_allclose(bodies[:, len(model.body) :], x, atol=1e-6)
    assert model.surface.faces.max() == bodies.shape[1] - 1
    own = np.asarray(below.assembly.garment.faces)
    np.testing.assert_array_equal(np.asarray(model.surface.faces)[-len(own) :] - len(model.body), own)


def test_what_is_drawn_below_is_the_body_and_then_the_garments(folder, worn):
    (motion,) = worn.motions.values()
    x, below = load_run(folder / "run").animate(str(folder / "swing.npz")), worn.model.under[0].model.garment.mesh
    posed = posed_body(worn, motion)
    vertices, faces, count = posed.vertices, posed.faces, posed.worn
    assert count == x.shape[1] and vertices.shape[1] == len(worn.body.vertices) + count
    np.testing.assert_allclose(vertices[:, -count:], x, atol=1e-6)
    np.testing.assert_array_equal(faces[: len(worn.body.faces)], worn.body.faces)
    np.testing.assert_array_equal(faces[len(worn.body.faces) :], np.asarray(below.faces) + len(worn.body.vertices))


def test_a_living_page_runs_both_garments(folder, worn, tmp_path):
    """The one below is drawn as the last vertices of the body."""
    below, (motion,) = load_run(folder / "run"), worn.motions.values()
    run = Run(worn, initial_state(worn.model, worn.network, 0).params)
    write_living_page(tmp_path / "a.html", run, {"swing": motion}, BrowserRuntime("1", b"", b"", b"", ""))
    page = Page(tmp_path / "a.html")
    steps, body = page.scene["live"]["steps"], page.scene["body"]
    assert [step["first"] for step in steps] == [0, 3 * len(worn.body.vertices)]
    assert body["worn"] == len(below.assembly.garment.vertices) == body["verts"] - len(worn.body.vertices)
    np.testing.assert_array_equal(page.faces("body-faces"), posed_body(worn, motion).faces)
    for step, each in zip(steps, (run, below), strict=True):
        graph = np.frombuffer(page.bytes(step["id"]), np.uint8).reshape(4, -1).T.tobytes()[: step["bytes"]]
        session, turns = onnxruntime.InferenceSession(graph), np.tile(np.eye(3, dtype=np.float32), (len(step["joints"]), 1, 1))
        zeros = [np.zeros(n, np.float32) for n in (step["state"], 3)]
        inputs = {"state": zeros[0], "rotations": turns, "translation": zeros[1], "alpha": np.ones(1, np.float32)}
        at_rest = motion.__class__(0 * motion.poses[:1], 0 * motion.translation[:1], motion.fps, ())
        np.testing.assert_allclose(session.run(None, inputs)[1], each.animate(at_rest)[0], rtol=0, atol=1e-4)


def test_skin_that_is_covered_does_not_collide(worn):
    """But for a band along the rims of what covers it, where it may be bared."""
    part = worn.body.vertices[worn.prepared.part]
    assert len(part) and not np.any(
        (part[:, 1] > 0.46) & (part[:, 1] < 0.74) & (np.linalg.norm(part[:, [0, 2]], axis=1) > 0.07)
    )
    assert np.any((part[:, 1] > 0.75) & (part[:, 1] < 0.85)) and np.any(part[:, 1] < 0.44)


def test_cloth_through_the_garment_below_is_pushed_out_by_it(folder, worn):
    """A ring 5 mm inside the garment below and 15 mm off the skin is inside; on skin alone it would be outside."""
    model, track = worn.model, worn.track
    body = pose_body(model, track.matrices[0])
    x = jnp.asarray(worn.garment.vertices * [0.095 / 0.115, 1, 0.095 / 0.115], jnp.float32)
    middle = np.asarray((x[:, 1] > 0.5) & (x[:, 1] < 0.7))
    points = with_points(x, model.surface.points)
    index, _ = nearest_vertex(points, body, model.surface)
    distance = np.asarray(plane_distance(points, body, vertex_normals(body, model.surface), index))[: len(x)]
    assert distance[middle].max() < 0
    bare = assemble(dataclasses.replace(worn.scene, garment=dataclasses.replace(worn.scene.garment, over=())))
    body = pose_body(bare.model, bare.track.matrices[0])
    points = with_points(x, bare.model.surface.points)
    index, _ = nearest_vertex(points, body, bare.model.surface)
    distance = np.asarray(plane_distance(points, body, vertex_normals(body, bare.model.surface), index))[: len(x)]
    assert distance[middle].min() > 0.01


def test_a_garment_that_faces_inward_collides_outward(folder, worn):
    inward = load_scene(folder / "inner.toml")
    arrays = dict(np.load(folder / "inner.npz"))
    np.savez(folder / "inward.npz", **{**arrays, "faces": arrays["faces"][:, ::-1]})
    inward = dataclasses.replace(inward, garment=dataclasses.replace(inward.garment, file="inward.npz"))
    train(inward, folder / "inward", steps=2)
    over = dataclasses.replace(worn.scene.garment, over=("inward",))
    turned = assemble(dataclasses.replace(worn.scene, garment=over)).model.surface.faces
    np.testing.assert_array_equal(np.sort(turned, axis=1), np.sort(worn.model.surface.faces, axis=1))
    body = pose_body(worn.model, worn.track.matrices[0])
    surface = dataclasses.replace(worn.model.surface, faces=turned)
    around = np.sum(vertex_normals(body, surface) * vertex_normals(body, worn.model.surface), axis=1)
    np.testing.assert_allclose(around[len(worn.model.body) :], 1, atol=1e-3)


def test_train_load_animate_check_and_simulate(folder, capsys):
    run = train(folder / "outer.toml", folder / "over", steps=20, report=None)
    again = load_run(folder / "over")
    motion = str(folder / "swing.npz")
    np.testing.assert_array_equal(again.animate(motion), run.animate(motion))
    assert np.isfinite(again.evaluate(motion)["collision"]).all()
    assert main(["check", str(folder / "outer.toml")]) == 0
    assert "over      run: 336 vertices" in capsys.readouterr().out
    assert run.evaluate(motion)["penetrating"].shape == (24,)


def test_it_is_simulated_over_the_garment_below(worn):
    """With smooth contact, which converges: each frame to tolerance, and outside the garment below."""
    collision = dataclasses.replace(worn.scene.physics.collision, distance="smooth")
    scene = dataclasses.replace(
        worn.scene,
        physics=dataclasses.replace(worn.scene.physics, collision=collision),
        motion=dataclasses.replace(worn.scene.motion, frames=(0, 4)),
    )
    found = simulate(scene, "swing.npz")
    assert found.status.max() == 0
    run = Run(found.assembly, {})
    depth = measure(run.assembly.model, found.vertices, run.track("swing.npz"))["depth_max"]
    assert depth.max() < 1  # mm


def test_a_garment_below_of_another_rate_or_body_is_refused(folder, worn):
    def changed(**tables):
        return dataclasses.replace(worn.scene, **tables)

    with pytest.raises(InputError, match=r"garment\.over\[0\]: a garment trained at 60 frames per second expected \(found 30"):
        assemble(changed(motion=dataclasses.replace(worn.scene.motion, fps=60.0)))
    body = dict(np.load(folder / "body.npz"))
    np.savez(folder / "other.npz", **{**body, "vertices": 1.01 * body["vertices"]})
    with pytest.raises(InputError, match=r"garment\.over\[0\]: a garment on the same body expected"):
        assemble(changed(body=dataclasses.replace(worn.scene.body, file="other.npz")))
    with pytest.raises(InputError, match=r"run\.json: no run there"):
        assemble(changed(garment=dataclasses.replace(worn.scene.garment, over=("gone",))))


def test_check_draws_the_garment_below_and_sends_nobody_to_a_dead_end(folder, tmp_path, capsys, monkeypatch):
    """Both garments are in the picture, each at its place; one that lies inside the lower is not to be fitted to bare skin."""
    from ncs_jax.view import motion_sheet

    drawn = []
    render = motion_sheet.render
    monkeypatch.setattr(motion_sheet, "render", lambda meshes, *a, **k: drawn.append(meshes) or render(meshes, *a, **k))
    text = (folder / "outer.toml").read_text()
    for name, file in (("outer", "outer"), ("inside", "inner")):
        (folder / f"{name}.toml").write_text(text.replace("outer.npz", f"{file}.npz"))
        assert main(["check", str(folder / f"{name}.toml"), "--out", str(tmp_path / "check.png")]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert ("garment inside the body at rest" in said) == (name == "inside")
        assert "push it out: ncs fit" not in said
        assert ("room over the garment below" in said) == (name == "inside")
    body, upper, below = (np.asarray(mesh.vertices) for mesh in drawn[0])
    radius = [np.median(np.linalg.norm((x - x.mean(0))[:, [0, 2]], axis=1)) for x in (upper, below)]
    assert len(upper) == len(below) == 336 and radius[0] > radius[1] + 0.01 and len(body) > 100

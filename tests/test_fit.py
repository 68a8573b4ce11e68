"""A garment brought onto a body: unit, axes and place, out of the skin, pins, weights."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ncs_jax import InputError, assemble, io, load_scene
from ncs_jax.cli import main
from ncs_jax.cli.fit import HOLES
from ncs_jax.geometry.mesh import topology
from ncs_jax.geometry.triangle_crossings import crossing_pairs
from ncs_jax.io.mesh.axes import TURNS
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.io.packaged import ASSETS
from ncs_jax.prepare import garment_placement
from ncs_jax.prepare.fit import BAND, Room, bring_apart, fit, pins_of, push_out, settle
from ncs_jax.prepare.garment_placement import place
from ncs_jax.prepare.hanging import RAYS, trunk_of
from ncs_jax.prepare.wearing import cloth_of, skin_of

from .scenes import post, write_scene
from .shapes import tube
from .starts import twenty_starts


@pytest.fixture
def body(tmp_path):
    np.savez(tmp_path / "body.npz", **post())
    return io.read_body(tmp_path / "body.npz")


def sleeve(radius=0.1, bottom=0.3, height=0.4, around=24, rings=12):
    """A tube around the post."""
    x, faces = tube(around, rings, radius, height)
    return io.GarmentRecord(x + [0, bottom, 0], faces)


def inside(points, body):
    """How deep in the post, which is convex: by the nearest of its planes; negative outside, but for sharp edges, m."""
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return -np.einsum("pfi,fi->pf", points[:, None] - a, normal).max(axis=1)


@pytest.mark.parametrize("radius", [0.085, 0.075, 0.06])
def test_a_garment_inside_the_body_comes_out_of_it(body, radius):
    given = sleeve(radius)
    found = fit("g.npz", given, body, clearance=0.004, move=(0, 0, 0))
    x, edges = found.garment.vertices, topology(given.faces)[0]
    assert inside(x, body).max() < -0.0038 and inside(x[edges].mean(axis=1), body).max() < -0.0038
    if radius < 0.08:
        assert inside(given.vertices, body).max() == pytest.approx(found.depth[0].max(), abs=1e-6)
    ring = np.linalg.norm(x[:, [0, 2]], axis=1).reshape(12, 24)
    assert np.ptp(ring[1:-1]) < 0.004  # a tube it stays, with the post's corners
    np.testing.assert_array_equal(found.garment.faces, given.faces)


def test_a_garment_that_fits_stays_as_it_is(body):
    given = sleeve(0.1)
    found = fit("g.npz", given, body, move=(0, 0, 0))
    np.testing.assert_array_equal(found.garment.vertices, given.vertices)
    with pytest.raises(InputError, match="girth of its waist"):  # the post is alike from top to bottom
        fit("g.npz", given, body)


@pytest.mark.parametrize(("scale", "up"), [(0.01, "z"), (0.0254, "y"), (1.0, "z")])
def test_units_axes_and_place_are_found(body, scale, up):
    given = sleeve(0.085)
    x = (given.vertices + [3, 1, 2]) / scale
    x = x if up == "y" else x @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    found = place("g.obj", io.GarmentRecord(x, given.faces), body)
    placed, moved = found.garment, found.shift
    assert (placed.scale, placed.up) == (scale, up)
    assert np.linalg.norm(moved + [3, 1, 2]) < 1 and np.abs(placed.vertices.mean(axis=0)[[0, 2]]).max() < 0.01
    np.testing.assert_allclose(placed.vertices - placed.vertices.mean(0), given.vertices - given.vertices.mean(0), atol=1e-6)


def wide_skirt():
    """In centimetres and Z up, on the packaged body, and wider than its box by more than a tenth of its size."""
    x, faces = tube(32, 12, 0.17, 0.5)
    wide = 1 + 0.9 * (0.5 - x[:, 1:2]) / 0.5
    x = x * np.where([True, False, True], wide, 1) + [0, 0.53, 0.03]
    return x, io.GarmentRecord(100 * x @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), faces)


def test_a_wide_skirt_in_place_stays_there():
    """It is not a collar, X up, though as that it would be nearer to the body."""
    x, given = wide_skirt()
    found = place("g.obj", given, io.read_body(ASSETS / "body.npz"))
    placed = found.garment
    assert (placed.scale, placed.up) == (0.01, "z") and not found.shift.any()
    assert found.doubt and not place("g.obj", given, io.read_body(ASSETS / "body.npz"), move=(0, 0, 0)).doubt
    np.testing.assert_allclose(placed.vertices, x, atol=1e-6)


def test_what_cannot_be_pushed_out_is_refused():
    with pytest.raises(InputError, match=r"g\.npz: vertices: .*lies on the body expected.*up=x.*move"):
        fit("g.npz", wide_skirt()[1], io.read_body(ASSETS / "body.npz"), scale=0.01, up="x")


def test_a_garment_of_no_size_is_refused(body):
    with pytest.raises(InputError, match=r"g\.obj: vertices: a garment about the size of the body.*scale"):
        place("g.obj", io.GarmentRecord(1e7 * sleeve().vertices, sleeve().faces), body)


@pytest.mark.parametrize(("option", "what"), [("--clearance", "6.0"), ("--weld", "0.2"), ("--clearance", "600.0")])
def test_a_length_that_cannot_be_in_metres_is_told_in_metres(capsys, tmp_path, option, what):
    assert main(["fit", "ncs:tshirt", "--out", str(tmp_path / "a.npz"), option, what]) == 2
    metres = "" if what == "600.0" else f": {float(what):g} mm is {option} {float(what) / 1000:g}"
    line = f"ncs: {option}: metres, 0.1 at most, expected (found {what}); metres are meant{metres}\n"
    assert capsys.readouterr().err == line and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--body", "body.glb", "--betas", "1", "2"], "body.glb: --betas: an SMPL model as .npz expected for this option"),
        (["--betas", "1"], "body.npz: --betas: an SMPL model with shapedirs expected for this option"),
        (["--body", "body.glb", "--part", "hair"], "body.glb: --part: no such mesh in the file (found 'hair')"),
        (["--mesh", "Dres"], "two.obj: --mesh: no such mesh in the file (found 'Dres')"),
        ([], "two.obj: --mesh: "),
        (["--mesh", "Dress", "--weld", "0.1"], "two.obj: --weld: a tolerance smaller than every edge expected"),
    ],
)
def test_what_an_option_says_is_named_by_the_option(capsys, tmp_path, monkeypatch, given, words):
    """And not by the field of a scene that it stands for."""
    monkeypatch.chdir(tmp_path)
    io.write_body("body.glb", io.read_body(ASSETS / "body.npz"))
    corners = "v 0 1 0\nv 0.02 1 0\nv 0 1.02 0\n"
    (tmp_path / "two.obj").write_text(f"{corners}{corners}o Dress\nf 1 2 3\no Hat\nf 4 5 6\n")
    assert main(["fit", "two.obj", "--out", "a.npz", *given]) == 2
    error = capsys.readouterr().err
    assert words in error and "body." not in error.replace("body.glb", "").replace("body.npz", "") and "garment." not in error


@pytest.mark.parametrize(
    ("unit", "given", "mend"),
    [
        (0.0254, 2.54, "2.54 centimetres is --scale 0.0254$"),
        (0.0254, 25.4, "25.4 millimetres is --scale 0.0254$"),
        (0.01, 100, "100 units to a metre is --scale 0.01$"),
        (0.01, 7, "--scale 0.01 for centimetres, --scale 0.0254 for inches$"),
        (1e-7, 1.0, "leave it out, so that it is found$"),
    ],
)
def test_a_unit_that_is_not_in_metres_is_told_in_metres(body, unit, given, mend):
    shirt = io.GarmentRecord(sleeve().vertices / unit, sleeve().faces)
    words = rf"g\.obj: scale: a unit in which .*in metres \(found '{given:g}, .* m'\); .*"
    with pytest.raises(InputError, match=words + mend.replace("--scale", "scale")):
        place("g.obj", shirt, body, scale=given)


@pytest.mark.parametrize(
    ("scale", "up", "offset"),
    [
        (1.0, "y", (0.0, -0.21, -0.03)),
        (0.0254, "y", (0.0, -0.78, 0.0)),
        (0.3048, "z", (0.25, 0.1, -0.3)),
        (0.1, "x", (-0.3, 0.2, 0.1)),
    ],
)
def test_a_shirt_of_another_origin_unit_and_axes_comes_home(scale, up, offset):
    """To 1 cm of where it was made, and its front stays in front; from places whose box lies within the body's box too."""
    body, shirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "tshirt.npz")
    x = (shirt.vertices + offset) @ TURNS[up].T / scale
    found = place("g.obj", replace(shirt, vertices=x), body)
    assert not found.doubt and (found.scale, found.up, found.turn) == (scale, up, 0) and found.lying > 0.8
    assert np.linalg.norm(found.garment.vertices - shirt.vertices, axis=1).mean() < 0.01


@pytest.mark.parametrize("aside", [-0.3, 0.21])
def test_a_loose_garment_alike_left_and_right_comes_into_the_middle(aside):
    """Cloth that hangs free tells nothing of the place sideways: it came to lie 4 mm off, and other dresses 2 cm."""
    body, shirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "tshirt.npz")
    middle = shirt.vertices.mean(axis=0)
    wide = ((shirt.vertices - middle) * [1.06, 1, 1.06] + middle).astype(np.float32)
    found = place("g.obj", replace(shirt, vertices=wide + np.array([aside, 0, 0.1], np.float32)), body)
    assert not found.doubt and np.abs(found.garment.vertices - wide)[:, 0].max() < 0.0015


def test_the_body_is_no_garment(tmp_path, capsys):
    assert main(["body", "--out", str(tmp_path / "body.obj")]) == 0
    out = tmp_path / "fitted.npz"
    assert main(["fit", str(tmp_path / "body.obj"), "--body", "ncs:body", "--out", str(out)]) == 2
    assert "this is the body itself" in capsys.readouterr().err and not out.exists()


def test_left_handed_axes_are_told_by_faces_that_look_inward():
    body, shirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "tshirt.npz")
    found = place("g.obj", replace(shirt, vertices=(shirt.vertices + [0.1, 0.2, 0.1]) * [-1, 1, 1]), body)
    assert found.mirrored and not found.doubt
    assert np.linalg.norm(found.garment.vertices - shirt.vertices, axis=1).mean() < 0.01


def test_a_shirt_in_another_pose_of_the_arms_is_refused_with_the_bones_in_its_way():
    """Its sleeves point straight up: no place lets both arms through."""
    body, shirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "tshirt.npz")
    x = shirt.vertices.copy()
    for side in (-1, 1):
        arm = body.joints[body.joint_names.index("LeftArm" if side * body.joints[8, 0] > 0 else "RightArm")]
        sleeve = side * (x[:, 0] - arm[0]) > 0
        c, s = np.cos(side * 1.9), np.sin(side * 1.9)
        x[sleeve] = (x[sleeve] - arm) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + arm
    with pytest.raises(InputError, match=r"g\.obj: vertices: .*(bones pass through its cloth|openings).*move"):
        fit("g.obj", replace(shirt, vertices=x), body)  # nor is it a sock, in a unit in which nothing is in its way


def test_a_place_that_is_given_is_kept():
    body, shirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "tshirt.npz")
    found = place("g.obj", replace(shirt, vertices=shirt.vertices + [0.0, 0.01, 0.0]), body, move=(0.0, -0.02, 0.0))
    np.testing.assert_allclose(found.garment.vertices, shirt.vertices - [0.0, 0.01, 0.0], atol=1e-6)
    assert found.options == "--scale 1 --up=y --move 0.000 -0.020 0.000"


def sheet(side=0.3, height=1.005, count=9):
    """A flat square, whose outside nothing tells, above the origin."""
    x, z = np.meshgrid(*2 * [np.linspace(-side / 2, side / 2, count)], indexing="ij")
    k = np.arange(count**2).reshape(count, count)
    a, b, c, d = (q.ravel() for q in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    points = np.stack([x.ravel(), np.full(count**2, height), z.ravel()], axis=1)
    return io.GarmentRecord(points, np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]).astype(np.int32))


@pytest.mark.parametrize(("given", "move"), [(sleeve(), (0.5, 0, 0)), (sheet(), (0.5, 0, 0)), (sheet(), (0, 0.4, 0))])
def test_a_place_that_is_given_beside_the_body_is_refused(body, given, move):
    """With the unit of its file, though in others it would touch: before, it was taken as it was said."""
    with pytest.raises(InputError, match=r"none of its openings, and 0 % .*scale 1 up=y move.*leave out move=\(0, 0, 0\)"):
        place("g.obj", given, body, move=move).check("g.obj")


def test_what_lies_on_the_body_at_a_given_place_is_kept_though_nothing_passes_through_it(body):
    over = replace(sheet(), faces=sheet().faces[:, ::-1])
    for given, aside, lies in ((sheet(), 0, True), (over, 0, True), (sheet(), 0.24, False), (over, 0.24, False)):
        found = place("g.obj", given, body, move=(aside, 0, 0))
        assert found.threaded == 0 and found.given and bool(found.doubt) != lies and bool(found.warning) == lies
    found = place("g.obj", sleeve(0.075), body, move=(0, 0, 0))
    assert found.threaded == 1 and not found.doubt and not found.warning


def test_a_given_place_takes_no_guess_of_unit_and_axes_against_what_speaks_against_it():
    """A skirt in inches 20 inches too low: in centimetres, upside down, the legs pass through some of it. Said, it is kept."""
    body, skirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "skirt.npz")
    inches = replace(skirt, vertices=skirt.vertices / 0.0254 + [0, 28, 0], weights=None)
    with pytest.raises(InputError, match=r"unit and axes are not stated.*as they are guessed.*state unit and axes by scale"):
        place("g.obj", inches, body, move=(0, 0, 0)).check("g.obj")
    found = place("g.obj", inches, body, move=(0, 0, 0), scale=0.0254, up="y")
    assert (found.scale, found.up, found.doubt) == (0.0254, "y", "") and found.warning


def test_what_nothing_carries_is_pinned_around_its_highest_hole(body):
    found = fit("g.npz", sleeve(0.1), body, move=(0, 0, 0)).garment
    top = found.vertices[:, 1].max()
    np.testing.assert_array_equal(found.groups["pins"], np.flatnonzero(found.vertices[:, 1] >= top - BAND - 1e-6))
    own = io.GarmentRecord(found.vertices, found.faces, groups={"pins": np.array([3, 4], np.int32)})
    np.testing.assert_array_equal(fit("g.npz", own, body, move=(0, 0, 0)).garment.groups["pins"], [3, 4])


def test_what_lies_on_top_of_the_body_needs_no_pins(body):
    """A tube that is closed above the post's lid, as a T-shirt is above shoulders."""
    x, faces = tube(24, 12, 0.1, 0.4)
    x = np.concatenate([x + [0, 0.61, 0], [[0, 1.01, 0]]])
    last = np.arange(11 * 24, 12 * 24)
    lid = np.stack([last, np.roll(last, -1), np.full(24, len(x) - 1)], axis=1).astype(np.int32)
    found = fit("g.npz", io.GarmentRecord(x, np.concatenate([faces, lid])), body)
    assert "pins" not in found.garment.groups and found.carried > 0.01


@pytest.mark.parametrize(("width", "held"), [(0.04, True), (0.12, False)])
def test_straps_that_friction_alone_keeps_on_shoulders_are_pinned_there(width, held):
    """A strip over skin that faces up, whose ends hang down."""
    along = np.linspace(0, 0.6, 25)
    path = np.stack([np.clip(along, 0.15, 0.45), 1 - np.abs(along - np.clip(along, 0.15, 0.45))], axis=1)
    x = np.array([[z, y, side] for z, y in path for side in np.linspace(0, width, 5)])
    grid = np.arange(len(x)).reshape(-1, 5)
    quads = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32)
    lies = x[:, 1] > 0.999
    away = np.where(lies[:, None], [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    pins, carried, straps = pins_of(io.GarmentRecord(x, faces), np.full(len(x), 0.005), away)
    assert carried > 0.01 and straps == held
    middle = np.flatnonzero(lies & (np.abs(x[:, 0] - 0.3) < 0.14))  # the bends look half aside
    assert lies[pins].all() and (np.isin(middle, pins).all() if held else not len(pins))
    given = io.GarmentRecord(x, faces), np.full(len(x), 0.005), away
    assert np.isin(middle, pins_of(*given, "shoulders")[0]).all() and not len(pins_of(*given, "none")[0])


def test_the_command_writes_a_file_to_train_with(tmp_path, capsys):
    scene = write_scene(tmp_path)
    given = sleeve(0.075)
    tilted = 100 * given.vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    trimesh.Trimesh(tilted, given.faces, process=False).export(tmp_path / "g.obj")
    command = ["fit", str(tmp_path / "g.obj"), "--body", str(tmp_path / "body.npz"), "--out"]
    assert main([*command, str(tmp_path / "fitted.npz"), "--stay"]) == 0
    told = capsys.readouterr().out
    assert "0.01 m a unit, Z up" in told and "0 inside now" in told and 'pins = "pins"' in told
    beside = [*command, str(tmp_path / "beside.npz"), "--move", "0.5", "0", "0"]
    assert main(beside) == 2 and not (tmp_path / "beside.npz").exists()
    printed = capsys.readouterr()
    assert "beside.png: the place that was given" in printed.out and "none of its openings" in printed.err
    assert (tmp_path / "fitted.png").read_bytes()[:4] == b"\x89PNG"
    written = io.read_garment(tmp_path / "fitted.npz")
    text = scene.read_text().replace('"cloth.npz"', '"fitted.npz"\npins = "pins"')
    scene.write_text(text)
    a = assemble(load_scene(scene))
    assert written.weights is None and len(a.prepared.weights) == len(written.vertices)
    assert main(["check", str(scene), "--out", str(tmp_path / "check.png")]) == 0
    assert "inside the body at rest" not in capsys.readouterr().out
    assert main([*command, str(tmp_path / "fitted.obj")]) == 2
    assert "ends in .npz expected" in capsys.readouterr().err
    assert main(["fit", str(tmp_path / "gone.obj"), "--body", str(tmp_path / "body.npz"), "--out", "x.npz"]) == 2
    assert "gone.obj" in capsys.readouterr().err


def test_a_scene_that_is_there_is_kept_and_what_differs_in_it_is_said(tmp_path, capsys):
    np.savez(tmp_path / "body.npz", **post())
    trimesh.Trimesh(sleeve(0.075).vertices, sleeve().faces, process=False).export(tmp_path / "g.obj")
    command = ["fit", str(tmp_path / "g.obj"), "--body", str(tmp_path / "body.npz"), "--stay", "--out", str(tmp_path / "x.npz")]
    scene, told = tmp_path / "x.toml", []
    for text, more in (("", []), ("\n# my note\n", []), ("", ["--pins", "none"]), ("\nbroken", [])):
        if scene.exists():
            scene.write_text(text := scene.read_text() + text)
        assert main([*command, *more]) == 0
        told.append(capsys.readouterr().out.split("kept ")[-1].splitlines())
        assert not text or scene.read_text() == text
    assert told[0][-1].startswith("next:") and told[1] == [f"{scene}, which is there, and says the same"]
    assert told[2][1].split() == ["garment.pins", '"pins",', "found", "now:", "nothing", "to", "say"] and len(told[2]) == 3
    assert "A scene for this garment" in told[3][0] and "[garment]" in told[3]


@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_vertices_are_welded_in_metres_whatever_the_unit_that_is_found(tmp_path, capsys, scale):
    """Single precision splits them: each triangle has its own, off by what a float of a thousand millimetres is."""
    np.savez(tmp_path / "body.npz", **post())
    given = sleeve(0.085)
    corners = given.vertices[given.faces].reshape(-1, 3)
    corners = corners + np.random.default_rng(0).uniform(-1e-7, 1e-7, corners.shape)
    np.savez(tmp_path / "g.npz", vertices=corners / scale, faces=np.arange(len(corners)).reshape(-1, 3))
    command = ["fit", str(tmp_path / "g.npz"), "--body", str(tmp_path / "body.npz"), "--stay", "--out", str(tmp_path / "x.npz")]
    main(command)
    count = f"{len(corners) - len(given.vertices)} vertices lie where another one is"
    told = capsys.readouterr().out
    assert count in told and "--weld 1e-05 joins them" in told and told.count("hole ") <= HOLES + 1
    assert main([*command, "--weld", "1e-5"]) == 0
    told = capsys.readouterr().out
    assert f": {len(given.vertices)} vertices" in told and "doubled" not in told and f"{scale:g} m a unit" in told


def test_a_refused_garment_is_drawn_though_the_folder_of_its_file_is_missing(tmp_path, capsys):
    """One that lies on nothing ends in a picture, one line and exit code 2, not in a traceback."""
    write_scene(tmp_path)
    given = sleeve(0.3)
    trimesh.Trimesh(given.vertices, given.faces, process=False).export(tmp_path / "g.obj")
    command = ["fit", str(tmp_path / "g.obj"), "--body", str(tmp_path / "body.npz"), "--scale", "1", "--up", "x"]
    out = tmp_path / "missing" / "folder" / "fitted.npz"
    assert main([*command, "--out", str(out)]) == 2
    assert out.with_suffix(".png").read_bytes()[:4] == b"\x89PNG" and not out.exists()
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_weights_of_another_body_are_refused(tmp_path):
    scene = write_scene(tmp_path)
    cloth = dict(np.load(tmp_path / "cloth.npz"))
    np.savez(tmp_path / "cloth.npz", blend_weights=np.full((len(cloth["vertices"]), 4), 0.25), **cloth)
    with pytest.raises(InputError, match=r"cloth\.npz: blend_weights: a weight for each of the body's 2 joints expected"):
        assemble(load_scene(scene))
    np.savez(tmp_path / "cloth.npz", blend_weights=np.full((len(cloth["vertices"]), 2), 0.3), **cloth)
    with pytest.raises(InputError, match=r"blend_weights, vertex 0: weights that sum to 1 expected"):
        assemble(load_scene(scene))


def shirt_with_a_skirt():
    """The packaged T-shirt with a wide skirt hung on its hem: two thirds of the cloth touch nothing."""
    shirt = io.read_garment(ASSETS / "tshirt.npz")
    x, loops = shirt.vertices.astype(np.float64), boundary_loops(shirt.faces)
    hem = min(loops, key=lambda loop: x[loop, 1].mean())
    middle, rows = x[hem].mean(axis=0), 20
    rings = [hem, *(np.arange(len(hem)) + len(x) + r * len(hem) for r in range(rows))]
    wide = [middle + (x[hem] - middle) * [1 + 0.15 * r, 0, 1 + 0.15 * r] - [0, 0.035 * r, 0] for r in range(1, rows + 1)]
    strips = [np.stack(t, axis=1) for a, b in itertools.pairwise(rings)
              for t in ((np.roll(a, -1), a, np.roll(b, -1)), (a, b, np.roll(b, -1)))]  # fmt: skip
    faces = np.concatenate([shirt.faces, *strips]).astype(np.int32)
    return io.GarmentRecord(np.concatenate([x, *wide]).astype(np.float32), faces)


def test_a_loose_garment_that_shoulders_carry_is_accepted_with_a_warning():
    """It is home to 1 cm; a loose skirt, which nothing carries, is refused above."""
    body, given = io.read_body(ASSETS / "body.npz"), shirt_with_a_skirt()
    x = (given.vertices + [0.2, -0.1, 0.15]) * 100
    found = place("g.obj", replace(given, vertices=x.astype(np.float32)), body)
    assert not found.doubt and found.scale == 0.01
    assert np.linalg.norm(found.garment.vertices - given.vertices, axis=1).mean() < 0.01
    assert "what carries it tells its height" in found.warning


def test_units_are_compared_only_once_the_best_place_of_each_is_refined(monkeypatch):
    """Else close cloth, half inside the body beside its place, lost to another unit by the last digits of the body."""
    body, shirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "tshirt.npz")
    skin, fine = skin_of(body), cloth_of(shirt, 600)
    ways = list(garment_placement._ways(shirt, shirt, skin, False, (None, None, None)))
    refined = []

    def moved(way, cloth, skin, most=100):
        refined.append((way.scale, most))
        return way

    monkeypatch.setattr(garment_placement, "_moved", moved)
    garment_placement._search(ways, cloth_of(shirt, 100), fine, skin)
    units = {w.scale for w in ways}
    assert len(units) > 3 and {scale for scale, most in refined if most == garment_placement.BRIEFLY} == units
    assert len([most for _, most in refined if most == 100]) == garment_placement.FINE  # and only these to the end


def hung_at(y, ease=0.01):
    """A flared tube that hangs from the packaged body's trunk at a height, m, and is wider there by its ease on all sides."""
    trunk = trunk_of(io.read_body(ASSETS / "body.npz"))
    reach, count = trunk.reach[np.abs(trunk.heights - y).argmin()], len(RAYS)
    middle = reach @ RAYS * 2 / count
    rings = [np.insert((reach - RAYS @ middle + ease + 0.3 * down)[:, None] * RAYS + middle, 1, y - down, 1) for down in
             np.linspace(0, 0.4, 12)]  # fmt: skip
    return io.GarmentRecord(np.concatenate(rings), tube(count, 12)[1])


@pytest.mark.parametrize(("scale", "up"), [(0.01, "z"), (0.0254, "x")])
def test_a_skirt_that_hangs_where_its_file_has_it_stays_there(scale, up):
    """Its waist fits around the trunk in one unit and axis alone, and nowhere else above or below."""
    body, skirt = io.read_body(ASSETS / "body.npz"), hung_at(0.885)
    found = place("g.obj", replace(skirt, vertices=skirt.vertices @ TURNS[up].T / scale), body)
    assert not found.doubt and (found.scale, found.up, found.turn) == (scale, up, 0) and not found.shift.any()
    assert "only its waist tells where" in found.warning
    np.testing.assert_allclose(found.garment.vertices, skirt.vertices, atol=1e-6)


@pytest.mark.parametrize("off", [0.0, 0.038])
def test_a_skirt_whose_waist_is_held_as_well_higher_or_lower_is_refused_though_it_fits(off):
    """The packaged one fits as well four centimetres above its place: whether its file has it there or here, none can tell."""
    body, skirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "skirt.npz")
    x = (skirt.vertices + [0, off, 0]) @ TURNS["z"].T / 0.0254
    given = replace(skirt, vertices=x, weights=None)
    found = place("g.obj", given, body)
    assert (found.scale, found.up) == (0.0254, "z") and not found.shift.any()
    with pytest.raises(InputError, match=r"held as well \d+ cm (higher|lower).*move=\(0, 0, 0\)"):
        found.check("g.obj")
    place("g.obj", given, body, move=(0, 0, 0)).check("g.obj")


def test_a_skirt_off_its_place_is_refused_with_the_unit_and_the_place_that_its_waist_tells():
    body, skirt = io.read_body(ASSETS / "body.npz"), io.read_garment(ASSETS / "skirt.npz")
    x = (skirt.vertices + [0.2, -0.25, 0.15]) @ TURNS["z"].T / 0.0254
    found = place("g.obj", replace(skirt, vertices=x, weights=None), body)
    assert "girth of its waist" in found.doubt and (found.scale, found.up, found.turn) == (0.0254, "z", 0)
    assert np.linalg.norm(found.garment.vertices - skirt.vertices, axis=1).mean() < 0.05
    with pytest.raises(InputError, match=r"girth of its waist.*scale 0\.0254 up=z move"):
        found.check("g.obj")


# --- starts that intersect ------------------------------------------------------------------------------------------------


def test_triangles_that_pass_through_each_other_are_found():
    """Against every edge and triangle tried by itself; triangles that share a vertex, touch, or lie in a plane do not count."""
    x = np.random.default_rng(0).random((60, 3))
    faces = np.arange(60).reshape(20, 3)
    found = {tuple(sorted(pair)) for pair in crossing_pairs(x, faces).tolist()}

    def through(p, q, a, b, c):
        volume = lambda *t: np.linalg.det([v - t[0] for v in t[1:]])  # noqa: E731
        around = [volume(p, q, *side) for side in ((a, b), (b, c), (c, a))]
        return volume(p, a, b, c) * volume(q, a, b, c) < 0 and abs(sum(np.sign(around))) == 3

    expected = {
        (i, j)
        for i, j in itertools.combinations(range(20), 2)
        for one, other in ((i, j), (j, i))
        for k in range(3)
        if through(x[3 * one + k], x[3 * one + (k + 1) % 3], *x[3 * other : 3 * other + 3])
    }
    assert found == expected and len(expected) > 20
    flat, both = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0], [1, 1, 0], [0, 0, 1]], float), [[0, 1, 2], [3, 4, 5]]
    assert not len(crossing_pairs(flat, np.array([[0, 1, 2], [1, 2, 3]])))
    assert not len(crossing_pairs(flat * [1, 1, 0], np.array(both)))
    assert not len(crossing_pairs(flat, np.array(both)))  # a corner in the other's inside touches it
    assert len(crossing_pairs(flat - [[0, 0, 0.1 * (k > 2)] for k in range(6)], np.array(both))) == 1


REFUSED = {
    *("shirt hem through", "shirt folded", "shirt spike", "skirt spike"),
    *(f"{garment} pressed through the back" for garment in ("shirt", "skirt")),
}


@pytest.mark.parametrize(
    "name",
    [n for n in twenty_starts() if "crumple" in n or "spike" in n or "0.9" in n]
    + [pytest.param(n, marks=pytest.mark.slow) for n in twenty_starts() if not ("crumple" in n or "spike" in n or "0.9" in n)],
)
def test_a_start_that_intersects_ends_without_or_is_refused_with_its_faces(name):
    """Ten garments in the body, ten through themselves: none is written that still is."""
    given, body = twenty_starts()[name], io.read_body("ncs:body")
    through = len(crossing_pairs(given.vertices, given.faces))
    assert bool(through) != ("pushed" in name or "scaled" in name)
    found = place("x.npz", given, body, move=(0.0, 0.0, 0.0), scale=1.0, up="y", turn=0)
    if name in REFUSED:
        with pytest.raises(InputError, match=r"not pass through itself.*pairs: \d+ and \d+ at \("):
            settle("x.npz", found, body)
        return
    settled = settle("x.npz", found, body)
    assert not len(crossing_pairs(settled.garment.vertices, settled.garment.faces))
    assert settled.depth[1].max() < 0


def test_cloth_gives_way_to_the_body_with_little_strain():
    """A shirt 3 cm too far to the front: at the back all of it goes along, and not what lies in the body alone."""
    given, body = twenty_starts()["shirt pushed 0.03 along (0, 0, 1)"], io.read_body("ncs:body")
    edges = topology(given.faces)[0]

    def strain(x):
        lengths = [np.linalg.norm(np.diff(np.asarray(v, np.float64)[edges], axis=1)[:, 0], axis=1) for v in (x, given.vertices)]
        return lengths[0] / lengths[1] - 1

    found = place("x.npz", given, body, move=(0.0, 0.0, 0.0), scale=1.0, up="y", turn=0)
    settled = settle("x.npz", found, body)
    assert settled.depth[0].max() > 0.02 and settled.depth[1].max() < -0.0035
    x = given.vertices.astype(np.float64)
    pushed = push_out(x, Room(x, given.faces, body, settled.contact.thickness))
    assert np.abs(strain(pushed)).max() > 1
    assert np.abs(strain(settled.garment.vertices)).max() < 0.25
    assert np.sqrt(np.mean(strain(settled.garment.vertices) ** 2)) < 0.04


def test_cloth_that_is_apart_stays_as_it_is(body):
    garment = sleeve()
    x = garment.vertices.astype(np.float64)
    assert bring_apart(x, garment.faces, Room(x, garment.faces, body, 0.004)) is x

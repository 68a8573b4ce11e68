"""What is drawn: the depth test, what is left out, and the pictures that a run writes."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.energies.terms import MEASURED, NAMES
from ncs_jax.errors import InputError
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.posing import skinned
from ncs_jax.scene.spec import scene_from
from ncs_jax.view import curves, pictures, preview
from ncs_jax.view.animation import Animation, PosedBody, upright, upright_axes
from ncs_jax.view.camera import Camera
from ncs_jax.view.character import body_vertices, posed_body
from ncs_jax.view.ground import Ground
from ncs_jax.view.heading import heading, trunk_axes
from ncs_jax.view.motion_sheet import MARGIN, TILE, TITLE, motion_sheet, posed
from ncs_jax.view.rasteriser import PAPER, DrawnMesh, render

RED, GREEN = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1)


def tube(rings: int, around: int, radius: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """An open cylinder about Y, its faces outward."""
    angle = 2 * np.pi * np.arange(around) / around
    height = np.linspace(low, high, rings)
    grid = np.stack(np.broadcast_arrays(radius * np.sin(angle), height[:, None], radius * np.cos(angle)), -1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    return grid.reshape(-1, 3), faces.astype(np.int32)


@pytest.fixture(scope="module")
def swing() -> Animation:
    """A ring of cloth about a leaning cylinder that walks 1 m along X in 2 s."""
    fps, frames = 15.0, 30
    body, body_faces = tube(12, 20, 0.15, 0.0, 1.6)
    cloth, faces = tube(8, 24, 0.22, 0.7, 1.3)
    t = np.arange(frames) / fps
    lean = 0.2 * np.sin(2 * np.pi * t)[:, None]
    shift = np.stack([0.5 * t, 0 * t, 0 * t], -1)[:, None]

    def move(v, lag):
        return np.stack([v[:, 0] + lag * v[:, 1], v[:, 1] + 0 * lag, v[:, 2] + 0 * lag], -1)

    post = PosedBody((move(body, 0.5 * lean) + shift).astype(np.float32), body_faces)
    return Animation((move(cloth, lean) + shift).astype(np.float32), faces, fps, post)


def square(z: float, half: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """A square that faces +Z."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


CAMERA = Camera((0.0, 0.0, 0.0), 1.2, elevation=0.0)


def hue(picture: np.ndarray) -> str:
    """Which channel leads in the middle."""
    middle = picture[picture.shape[0] // 2, picture.shape[1] // 2].astype(int)
    return "RGB"[middle.argmax()] if np.ptp(middle) > 20 else "-"


@pytest.mark.parametrize("fov", [0.0, 18.0])
@pytest.mark.parametrize("gap", [0.003, -0.003])
def test_three_millimetres_decide_what_is_seen(fov: float, gap: float):
    camera = Camera((0.0, 0.0, 0.0), 1.2, elevation=0.0, fov=fov)
    meshes = [DrawnMesh(*square(gap), RED), DrawnMesh(*square(0.0), GREEN)]
    for order in (meshes, meshes[::-1]):
        assert hue(render(order, camera, (60, 60))) == ("R" if gap > 0 else "G")


def test_depth_is_compared_at_each_pixel():
    """Two squares that cross: painting the farther one first would get one half wrong."""
    vertices, faces = square(0.0)
    leaning = vertices + np.outer(vertices[:, 0], [0.0, 0.0, 0.4])
    picture = render([DrawnMesh(vertices, faces, RED), DrawnMesh(leaning, faces, GREEN)], CAMERA, (80, 80)).astype(int)
    left, right = picture[40, 20], picture[40, 60]
    assert left.argmax() == 0 and right.argmax() == 1


def test_neighbours_leave_no_crack():
    vertices, faces = tube(40, 60, 0.4, -0.5, 0.5)
    picture = render([DrawnMesh(vertices, faces, RED)], CAMERA, (120, 120), samples=1).astype(int)
    inner = picture[20:100, 30:90]
    assert (inner[..., 0] - inner[..., 2] > 20).all()


def test_the_picture_has_the_size_and_place_asked_for():
    picture = render([DrawnMesh(*square(0.0, 0.3), RED)], Camera((0.0, 0.0, 0.0), 1.0, elevation=0.0, fov=0.0), (50, 100))
    assert picture.shape == (100, 50, 3) and picture.dtype == np.uint8
    rows, columns = np.nonzero((picture != PAPER).any(2))
    assert (rows.min(), rows.max() + 1) == (20, 80)
    assert (columns.min(), columns.max() + 1) == (0, 50)


def test_width_in_sight_counts_too():
    picture = render([DrawnMesh(*square(0.0, 0.3), RED)], Camera((0.0, 0.0, 0.0), 0.1, 1.0, elevation=0.0, fov=0.0), (100, 50))
    columns = np.nonzero((picture != PAPER).any(2))[1]
    assert (columns.min(), columns.max() + 1) == (20, 80)


@pytest.mark.parametrize(("view", "axis"), [("front", 2), ("side", 0)])
def test_views_look_from_where_they_say(view: str, axis: int):
    camera = Camera((0.0, 0.0, 0.0), 1.0, azimuth=pictures.VIEWS[view], elevation=0.0)
    assert np.argmin(camera.axes()[2]) == axis


def test_the_inside_has_its_own_colour():
    vertices, faces = square(0.0)
    assert hue(render([DrawnMesh(vertices, faces, RED, GREEN)], CAMERA, (40, 40))) == "R"
    assert hue(render([DrawnMesh(vertices, faces[:, ::-1], RED, GREEN)], CAMERA, (40, 40))) == "G"
    assert hue(render([DrawnMesh(vertices, faces[:, ::-1], RED)], CAMERA, (40, 40))) == "R"


def test_colours_can_differ_by_vertex():
    vertices, faces = square(0.0)
    colour = np.where(vertices[:, :1] < 0, RED, GREEN)
    picture = render([DrawnMesh(vertices, faces, colour)], CAMERA, (60, 60)).astype(int)
    assert picture[30, 10].argmax() == 0 and picture[30, 50].argmax() == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
def test_what_is_not_finite_is_left_out(bad: float):
    vertices, faces = square(0.0)
    other, _ = square(0.1)
    other[0, 1] = bad
    picture = render([DrawnMesh(vertices, faces, RED), DrawnMesh(other, faces, GREEN)], CAMERA, (60, 60), ground=Ground(-0.5))
    assert hue(picture) == "R"
    nothing = render([DrawnMesh(np.full((4, 3), bad), faces, RED)], CAMERA, (60, 60), ground=Ground(-0.5))
    assert (nothing[:20] == PAPER).all()
    assert render([], CAMERA, (10, 10)).shape == (10, 10, 3)


def test_degenerate_triangles_are_no_error():
    vertices = np.array([[0.0, 0, 0], [0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]])
    assert (render([DrawnMesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [1, 1, 1]]), RED)], CAMERA, (30, 30)) == PAPER).all()


def test_a_garment_that_blew_up_is_drawn_in_bounded_time(rng: np.random.Generator):
    vertices = rng.normal(size=(1000, 3)) * 3
    faces = rng.integers(0, 1000, (2000, 3))
    start = time.perf_counter()
    render([DrawnMesh(vertices, faces, RED)], Camera((0.0, 0.0, 0.0), 1.0), (400, 500))
    assert time.perf_counter() - start < 20


def test_shadow_falls_on_the_ground():
    vertices, faces = tube(6, 20, 0.15, 0.05, 0.8)
    camera = Camera((0.0, 0.4, 0.0), 1.6, elevation=20.0)
    lit = render([], camera, (80, 80), ground=Ground(0.0, cell=0)).astype(int)
    shaded = render([DrawnMesh(vertices, faces, RED)], camera, (80, 80), ground=Ground(0.0, cell=0)).astype(int)
    grey = np.ptp(shaded, axis=2) < 25  # the floor, not the tube
    assert (lit == PAPER).all()
    assert ((lit - shaded).min(2) > 20)[grey].sum() > 30


def test_the_grid_stands_still_under_a_moving_camera():
    """The same patch of floor, seen from a camera that moved by one cell, looks the same."""

    def at(x):
        return render([], Camera((x, 0.0, 0.0), 1.0, elevation=40.0), (80, 80), ground=Ground(0.0, (x, 0.0)))

    assert (at(0.0) == at(0.5)).all()
    assert (at(0.0) != at(0.25)).any()


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, -1, 0), (0, 0, -2.0), (1, 2, 3)])
def test_upright_is_a_rotation_that_brings_up_to_y(up: tuple, rng: np.random.Generator):
    turned = upright(np.concatenate([np.eye(3), [np.array(up) / np.linalg.norm(up)]]), up)
    assert np.allclose(turned[3], [0, 1, 0], atol=1e-12)
    assert np.allclose(turned[:3] @ turned[:3].T, np.eye(3), atol=1e-12) and np.linalg.det(turned[:3]) > 0


def test_a_z_up_character_that_faces_minus_y_comes_to_face_the_front():
    assert np.allclose(upright(np.array([[0.0, -1.0, 0.0]]), (0, 0, 1)), [[0, 0, 1]])


def test_contact_sheet(tmp_path, swing):
    pictures.contact_sheet(tmp_path / "a.png", swing, frames=3, tile=120)
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    cloth = picture[..., 0] - picture[..., 2] > 60
    # Two rows of three, each with its garment in the middle.
    filled = cloth[: cloth.shape[0] // 2].any(0)
    assert (np.diff(filled.astype(int)) == 1).sum() == 3
    assert (np.diff(cloth.any(1).astype(int)) == 1).sum() == 2


def test_moments_may_be_chosen(tmp_path, swing):
    for name, frames in (("even", 2), ("chosen", [0, len(swing.garment) - 1]), ("other", [0, 1])):
        pictures.contact_sheet(tmp_path / f"{name}.png", swing, frames=frames, tile=60, labels=("one", "two"))
    even, chosen, other = (np.asarray(Image.open(tmp_path / f"{name}.png")) for name in ("even", "chosen", "other"))
    assert (even == chosen).all() and (even.shape != other.shape or (even != other).any())
    with pytest.raises(InputError, match="moments from 0"):
        pictures.contact_sheet(tmp_path / "a.png", swing, frames=[0, len(swing.garment)])


def test_alphas_are_shown_where_they_are_farthest_apart(swing):
    away = np.where(np.isin(np.arange(16), (0, 5, 9, 14)), 1.0, 0.1)
    far = replace(swing, garment=np.zeros((16, *swing.garment.shape[1:])) + away[:, None, None], body=None)
    near = replace(far, garment=0 * far.garment)
    apart = preview._apart({"0": near, "1": near, "1.5": far})
    np.testing.assert_allclose(apart, np.sqrt(3) * away, rtol=1e-6)
    assert {0, 5, 9, 14} < set(moments := preview._moments(apart)) and len(moments) == 8 and moments == sorted(set(moments))
    assert preview._moments(apart[:3]) == [0, 1, 2]


def test_animations_are_drawn_below_each_other(tmp_path, swing):
    still = replace(swing, garment=np.repeat(swing.garment[:1], len(swing.garment), axis=0))
    pictures.contact_sheet(tmp_path / "a.png", {"network": swing, "simulation": still, "rest": still}, frames=2, tile=100)
    picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    cloth = picture[..., 0] - picture[..., 2] > 60
    assert (np.diff(cloth.any(1).astype(int)) == 1).sum() == 3
    first, second, third = (picture[40 + 100 * row : 140 + 100 * row, 56:-56] for row in range(3))
    assert (first != second).any() and (second == third).all()
    with pytest.raises(InputError, match="as many frames"):
        pictures.contact_sheet(tmp_path / "a.png", {"network": swing, "simulation": swing.until(4)})


def test_a_garment_worn_below_is_blue(tmp_path, swing):
    def blue(worn):
        dressed = replace(swing, body=replace(swing.body, worn=worn))
        pictures.contact_sheet(tmp_path / "a.png", dressed, frames=2, tile=120)
        r, _, b = np.moveaxis(np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int), 2, 0)
        return (b > r + 10).sum()

    verts = swing.body.vertices.shape[1]
    assert blue(0) == 0 and 0 < blue(verts // 2) < blue(verts)


def test_contact_sheet_turns_with_the_character(tmp_path, swing):
    """A character that has turned by 90 degrees is seen from its front all the same."""
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.float32)
    vertices = swing.garment[0] * np.float32([1, 1, 0.4])
    stage = pictures._stage(Animation(np.stack([vertices, vertices @ turn.T]), swing.garment_faces, 30.0))
    assert stage.heading(1) == pytest.approx(90, abs=1e-3)
    assert stage.bounds(1, 90.0)[3] == pytest.approx(stage.bounds(0, 0.0)[3], rel=1e-5)


def striding(angles: np.ndarray, turn: np.ndarray) -> PosedBody:
    """The packaged body in strides: legs and arms swing by angles, rad, the other way on the other side; turned about up."""
    body = io.read_body(packaged("body"))
    poses = np.zeros((len(angles), len(body.parents), 3))
    for name, sign in (("LeftUpLeg", 1), ("RightUpLeg", -1), ("LeftArm", -1), ("RightArm", 1)):
        poses[:, body.joint_names.index(name), 0] = sign * angles
    poses[:, 0, 1] = turn
    assembly: Any = SimpleNamespace(body=body, model=SimpleNamespace(under=()))
    posed_there = posed_body(assembly, io.MotionRecord(poses, np.zeros((len(angles), 3)), 30.0))
    assert posed_there is not None
    return posed_there


def test_a_long_stride_is_seen_from_the_side_that_it_is_seen_from(plain_jax):
    """Left and right leg ahead by turns: the outline turns by a quarter and more, the character does not."""
    angles, turn = np.array([0.8, -0.8, 0.0, 0.8, -0.8]), np.radians([0.0, 0.0, 60.0, 60.0, -120.0])
    body = striding(angles, turn)
    cloth = np.repeat(tube(3, 9, 0.3, 0.5, 1.0)[0][None], 5, axis=0)
    shown = Animation(cloth, tube(3, 9, 0.3, 0.5, 1.0)[1], 30.0, body)
    found = [pictures._stage(shown).heading(k) for k in range(5)]
    np.testing.assert_allclose(found, np.degrees(turn), atol=1e-3)
    assert abs(pictures._stage(replace(shown, body=replace(body, axes=None))).heading(1)) > 45  # by its outline
    np.testing.assert_allclose([heading(each) for each in shown.until(4).every(3).body.axes], [0, 60], atol=1e-3)


def test_a_character_with_z_up_is_seen_from_its_front():
    """Standing and bent over, facing -Y at rest as Blender's do, and turned."""
    names = ("Hips", "Spine", "Head", "LeftArm", "RightArm", "LeftUpLeg", "RightUpLeg")
    joints = np.array([[0, 0, 1], [0, 0, 1.2], [0, 0, 1.6], [0.2, 0, 1.5], [-0.2, 0, 1.5], [0.1, 0, 0.9], [-0.1, 0, 0.9]])
    body = io.BodyRecord(joints, np.zeros((0, 3), int), joints, np.array([-1, 0, 1, 1, 1, 0, 0]), np.eye(7), names)
    for bent in (0.0, 80.0):
        about = Rotation.from_euler("xz", [bent, 50.0], degrees=True).as_matrix()
        axes = trunk_axes(body, np.broadcast_to(about, (1, 7, 3, 3)))
        assert heading(upright_axes(axes, (0, 0, 1))[0]) == pytest.approx(50, abs=1e-6)


def test_animation_gif(tmp_path, swing):
    pictures.animation_gif(tmp_path / "a.gif", swing, max_frames=10, size=(90, 120))
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.size == (90, 120) and gif.n_frames == 10 and gif.info["loop"] == 0
        seconds = []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            seconds.append(gif.info["duration"] / 1000)
            shown = np.asarray(gif.convert("RGB"))
            assert tuple(shown[0, 0]) == PAPER
    assert sum(seconds) == pytest.approx(10 / 15, abs=0.01)


def test_animation_gif_keeps_to_its_size(tmp_path, swing):
    pictures.animation_gif(tmp_path / "a.gif", swing, size=(90, 120), max_frames=12)
    whole = (tmp_path / "a.gif").stat().st_size
    pictures.animation_gif(tmp_path / "a.gif", swing, size=(90, 120), max_frames=12, max_bytes=whole // 2)
    assert (tmp_path / "a.gif").stat().st_size <= whole // 2


def test_half_a_garment_that_is_nan_and_no_body(tmp_path, swing):
    garment = swing.garment.copy()
    garment[5:] = np.nan
    garment[2, 3] = 1e20
    broken = replace(swing, garment=garment, body=None)
    pictures.contact_sheet(tmp_path / "a.png", broken, frames=2, tile=60)
    pictures.animation_gif(tmp_path / "a.gif", broken, max_frames=3, size=(40, 50))
    pictures.contact_sheet(tmp_path / "b.png", replace(broken, garment=garment * np.nan), frames=2, tile=60)
    assert all((tmp_path / name).stat().st_size > 100 for name in ("a.png", "a.gif", "b.png"))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda a: replace(a, garment=np.zeros((4, 3))), "garment"),
        (lambda a: replace(a, garment=a.garment[:0]), "garment"),
        (lambda a: replace(a, garment=a.garment[:, :-1]), "garment_faces"),
        (lambda a: replace(a, garment_faces=np.zeros((3, 4), int)), "garment_faces"),
        (lambda a: replace(a, garment_faces=a.garment_faces.astype(float)), "garment_faces"),
        (lambda a: replace(a, fps=0.0), "fps"),
        (lambda a: replace(a, fps=np.nan), "fps"),
        (lambda a: replace(a, up=(0.0, 0.0, 0.0)), "up"),
        (lambda a: replace(a, body=PosedBody(a.body.vertices[:2], a.body.faces)), "body"),
        (lambda a: PosedBody(a.body.vertices[0], a.body.faces), "body"),
        (lambda a: replace(a.body, faces=None), "body_faces"),
        (lambda a: PosedBody(a.body.vertices, a.body.faces - 1), "body_faces"),
        (lambda a: PosedBody(a.body.vertices, a.body.faces, worn=-1), "worn"),
        (lambda a: PosedBody(a.body.vertices, a.body.faces, worn=10_000), "worn"),
    ],
)
def test_an_animation_that_does_not_fit_together_is_refused(swing, change, field: str):
    with pytest.raises(InputError) as caught:
        change(swing)
    assert caught.value.field == field


def test_an_animation_turns_upright_and_ends_early(swing):
    def lying(x):  # Z up, facing -Y
        return np.stack([x[..., 0], -x[..., 2], x[..., 1]], -1)

    body = replace(swing.body, vertices=lying(swing.body.vertices), worn=7)
    turned = replace(swing, garment=lying(swing.garment), body=body, up=(0.0, 0.0, 2.0)).y_up()
    np.testing.assert_allclose(turned.garment, swing.garment, atol=1e-6)
    np.testing.assert_allclose(turned.body.vertices, swing.body.vertices, atol=1e-6)
    assert turned.up == (0.0, 1.0, 0.0) and turned.body.worn == 7
    early = swing.until(5)
    assert len(early.garment) == len(early.body.vertices) == 5
    assert np.array_equal(replace(swing, body=None).until(None).garment, swing.garment)


def test_energy_curves(tmp_path):
    pytest.importorskip("matplotlib")
    rows = [
        {"step": str(i), "total": str(1 + 5 / (i + 1)), "membrane": str(0.5 / (i + 1)), "gravity": "-0.2", "dropped": "0",
         "validation_total": "1.5" if i % 5 == 0 else "", "nonsense": "abc", "strain": "nan" if i == 3 else "1.0"}
        for i in range(30)
    ]  # fmt: skip
    curves.energy_curves(tmp_path / "a.png", rows)
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width > 1500
    text = ",".join(rows[0]) + "\n" + "\n".join(",".join(row.values()) for row in rows)
    (tmp_path / "log.csv").write_text(text)
    curves.energy_curves(tmp_path / "b.png", tmp_path / "log.csv")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with pytest.raises(InputError, match="rows"):
        curves.energy_curves(tmp_path / "c.png", [{"step": "1", "other": "2"}])


def test_every_energy_that_a_log_holds_is_drawn(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    names, drawn = [*NAMES, "wind", *MEASURED, "validation_total"], []
    monkeypatch.setattr(curves, "_curve", lambda axes, column, colour, label: drawn.append(label))
    curves.energy_curves(tmp_path / "a.png", [{"step": i, **dict.fromkeys(names, 1.0 + i)} for i in range(3)])
    terms = {name.replace("_", " ") for name in NAMES if name != "total"}
    assert set(drawn) == terms | {"wind", "training", "mean strain", "penetrating vertices"} and len(drawn) == len(set(drawn))


def test_matplotlib_stays_out_until_it_is_asked_for():
    pytest.importorskip("matplotlib")
    code = (
        "import sys, io; from ncs_jax.view import curves; early = 'matplotlib' in sys.modules;"
        "curves.energy_curves(io.BytesIO(), [{'step': 1, 'total': 2.0}]);"
        "sys.exit(early or 'matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- motions as they were imported ----------------------------------------------------------------------------------------


LEFT = {"Arm": (1, 15, 20), "ForeArm": (-1, 28, 0), "Hand": (-1, 25, 0), "UpLeg": (0, 9, -4), "Leg": (-1, 0, -40),
        "Foot": (-1, 0, -40)}  # parent, or the joint before; offset to the left and up, cm  # fmt: skip


def figure_in(tmp_path, poses: np.ndarray, up: str = "y"):
    """A scene with a motion of a person of another skeleton, 15 joints, in cm; joint 3 is the left arm."""
    names, parents, joints = ["Hips", "Chest", "Head"], [-1, 0, 1], [(0.0, 90.0, 0.0), (0.0, 120.0, 0.0), (0.0, 150.0, 0.0)]
    for side, sign in (("Left", 1), ("Right", -1)):
        for part, (above, out, rise) in LEFT.items():
            parents.append(above if above >= 0 else len(names) - 1)
            x, y, z = joints[parents[-1]]
            names.append(side + part)
            joints.append((x + sign * out, y + rise, z))
    given = {"joint_names": np.array(names), "joints": np.array(joints), "parents": np.array(parents)}
    fields: dict[str, Any] = given | {"trans": np.zeros((len(poses), 3)), "poses": poses, "fps": 30.0}
    np.savez(tmp_path / "m.npz", **fields)
    return scene_from({"motion": {"files": ["m.npz"], "up": up}}, str(tmp_path / "scene.toml"))


def sheet(tmp_path, scene) -> np.ndarray:
    body, garment = io.read_body(packaged("body")), io.read_garment(packaged("tshirt"))
    weights = np.zeros((len(garment.vertices), len(body.parents)))
    weights[:, 0] = 1
    record = load_motion(scene, "m.npz", body)
    prepared, model = SimpleNamespace(weights=weights), SimpleNamespace(under=())
    made: Any = SimpleNamespace(scene=scene, body=body, garment=garment, prepared=prepared, model=model)
    motion_sheet(tmp_path / "sheet.png", made, {"m.npz": record})
    return np.asarray(Image.open(tmp_path / "sheet.png")).astype(int)


def test_a_motion_is_drawn_on_the_character_above_its_own_skeleton(tmp_path):
    """The skeleton's left is blue and right of the picture's middle; an arm that rises does so in both rows."""
    poses = np.zeros((20, 15, 3))
    poses[:, 3, 2] = np.linspace(-1.2, 1.2, 20)  # the left arm, from below to above
    picture = sheet(tmp_path, figure_in(tmp_path, poses))
    (width, height), columns = TILE, 8
    tops = {"skin": [], "blue": []}
    for column in range(columns):
        x = MARGIN + column * width
        above = picture[TITLE : TITLE + height, x : x + width]
        below = picture[TITLE + height : TITLE + 2 * height, x : x + width]
        blue = (below[..., 2] > below[..., 0] + 60) & (below[..., 2] > below[..., 1] + 40)
        red = below[..., 0] > below[..., 2] + 60
        assert blue.sum() > 100 and red.sum() > 100
        assert np.nonzero(blue)[1].mean() > np.nonzero(red)[1].mean() + 10
        skin = np.abs(above - PAPER).max(axis=2) > 40
        beside = skin[:, 115:]  # where only the left arm reaches
        tops["skin"].append(np.nonzero(beside)[0].min() if beside.any() else height)
        tops["blue"].append(np.nonzero(blue)[0].min())
    assert tops["blue"][0] > tops["blue"][-1] + 20 and tops["skin"][0] > tops["skin"][-1] + 20


def test_a_motion_that_lies_down_is_seen_to_lie_in_both_rows(tmp_path):
    """A skeleton along Y called one along Z falls over: the picture shows it beside one that stands."""
    poses, spread = 1e-3 * np.ones((9, 15, 3)), {}
    for up in ("y", "z"):
        picture = sheet(tmp_path, figure_in(tmp_path, poses, up))
        for row in range(2):
            part = picture[TITLE + row * TILE[1] : TITLE + (row + 1) * TILE[1], MARGIN : MARGIN + TILE[0]]
            ink = np.nonzero(np.abs(part - PAPER).max(axis=2) > 60)
            spread[up, row] = np.ptp(ink[0]) / np.ptp(ink[1])
    assert min(spread["y", 0], spread["y", 1]) > 1.3 * max(spread["z", 0], spread["z", 1])


def test_the_character_of_a_sheet_is_posed_as_everywhere(rng: np.random.Generator):
    body = io.read_body(packaged("body"))
    body = replace(body, rest_rotations=Rotation.random(len(body.parents), rng=rng).as_matrix())
    motion = io.MotionRecord(rng.normal(size=(3, len(body.parents), 3)), rng.normal(size=(3, 3)), 30.0)
    matrices = posed(body, motion, np.array([0, 2]))
    np.testing.assert_allclose(
        [skinned(body.vertices, body.weights, each) for each in matrices], body_vertices(body, motion)[[0, 2]], atol=2e-5
    )

"""A body that is a mesh for each frame: its files, its regions, what a scene makes of it, and the same simulation."""

import os
import subprocess
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from ncs_jax import InputError, assemble, io, load_scene, simulate, train
from ncs_jax.cli import main
from ncs_jax.io.mesh.axes import TURNS
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.moving_body import resampled
from ncs_jax.prepare.regions import find_regions
from ncs_jax.prepare.scene_checks import find_risks
from ncs_jax.prepare.setting import set_up
from ncs_jax.scene.model import pose_body
from ncs_jax.simulation.walk_in import walk_in
from ncs_jax.view.character import animation_of, body_vertices

from .scenes import SCENE, grid, post, write_scene

BLENDER = os.environ.get("NCS_BLENDER", "")
MOVING = """
[body]
file = "frames.npz"
[garment]
file = "cloth.npz"
smoothing = 2
[motion]
fps = 30
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The post of `scenes.py` as it swings: vertices (24, V, 3) and faces; its rest pose is the first frame."""
    folder = tmp_path_factory.mktemp("post")
    write_scene(folder)
    body = io.read_body(folder / "body.npz")
    return body_vertices(body, io.read_motion(folder / "swing.npz")), body.faces


def write_moving(folder: Path, walk, text=MOVING, **more) -> Path:
    x, faces = walk
    cloth, triangles = grid()
    np.savez(folder / "cloth.npz", vertices=cloth, faces=triangles)
    np.savez(folder / "frames.npz", **{"vertices": x, "faces": faces, "fps": 30.0} | more)
    (folder / "scene.toml").write_text(text)
    return folder / "scene.toml"


def write_objs(folder: Path, x, faces, name="walk.{}.obj") -> Path:
    folder.mkdir()
    for t, frame in enumerate(x):
        trimesh.Trimesh(frame, faces, process=False).export(folder / name.format(t))
    return folder


# --- files ------------------------------------------------------------------------------------------------------------------


def test_every_format_gives_the_same_frames(walk, tmp_path):
    """Among them a folder of trimesh's .obj in centimetres with Z up, whose numbers have no zeros in front."""
    x, faces = walk
    turned = 100 * x @ TURNS["z"].T
    objs = write_objs(tmp_path / "objs", turned, faces)
    (objs / "readme.txt").write_text("not a frame")
    np.savez(tmp_path / "a.npz", vertices=x, faces=faces)
    for name in ("a.h5", "a.pc2", "a.mdd", "a.usdc"):
        io.write_animation(tmp_path / name, x, faces, 24)
    trimesh.Trimesh(x[5], faces, process=False).export(tmp_path / "mesh.obj")
    mesh = {"mesh": tmp_path / "mesh.obj"}
    given = {
        "objs": {"scale": 0.01, "up": "z", "fps": 24}, "a.npz": {"fps": 24}, "a.h5": {}, "a.pc2": mesh | {"fps": 24},
        "a.mdd": mesh, "a.usdc": {},
    }  # fmt: skip
    for name, options in given.items():
        assert io.is_moving_body(tmp_path / name), name
        body = io.read_moving_body(tmp_path / name, **options)
        assert body.fps == 24 and body.frames.shape == x.shape and not body.notes, name
        np.testing.assert_allclose(body.frames, x, atol=2e-6, err_msg=name)
        np.testing.assert_array_equal(body.faces, faces, err_msg=name)
        np.testing.assert_array_equal(body.vertices, body.frames[0])
    assert np.isnan(io.read_moving_body(tmp_path / "a.npz").fps)


def test_a_body_of_one_pose_is_no_moving_one(tmp_path):
    np.savez(tmp_path / "body.npz", **post())
    assert not any(map(io.is_moving_body, ("ncs:body", tmp_path / "body.npz", tmp_path / "none.npz", tmp_path / "hero.fbx")))


def test_quads_are_cut_once_however_they_fold(tmp_path):
    """Which way a fan goes depends on the fold of a quad, and frames fold it either way: the mesh is still one."""
    base = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.2, -1]], float)
    lines = "f 1/1/1 2/1/1 3/1/1 4/1/1\n" + "".join(f"f {a} {b} 5\n" for a, b in ((2, 1), (3, 2), (4, 3), (1, 4)))
    (tmp_path / "q").mkdir()
    for t, bend in enumerate(([1, 1, 0], [0.4, 0.4, 0.3], [1, 1, 0.8])):
        x = base.copy()
        x[2] = bend  # of which the second makes the quad not convex
        text = "vt 0 0\nvn 0 0 1\n" + "".join("v {} {} {}\n".format(*p) for p in x) + lines
        (tmp_path / "q" / f"f{t}.obj").write_text(text if t < 2 else text.replace("v 0.5", "v \\\n0.5"))
    body = io.read_moving_body(tmp_path / "q")
    assert body.frames.shape == (3, 5, 3) and body.faces.shape == (6, 3)
    np.testing.assert_allclose(body.frames[2, 4], base[4])


BROKEN = {
    "vertices": (lambda x, f: (x[:-1], f[(f < len(x) - 1).all(axis=1)]), "vertices and .* polygons'"),
    "faces": (lambda x, f: (x, f[[1, 0, *range(2, len(f))]]), "polygon 0 of other vertices"),
    "corners": (lambda x, f: (x, np.concatenate([f[:7], f[8:7:-1], f[9:], f[:1]])), "polygon 7 of other vertices"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_frame_with_another_mesh_is_named(walk, tmp_path, name):
    x, faces = walk
    change, message = BROKEN[name]
    folder = write_objs(tmp_path / "objs", x[:12], faces)
    trimesh.Trimesh(*change(x[10], faces), process=False).export(folder / "walk.10.obj")
    with pytest.raises(InputError, match=rf"walk\.10\.obj: frame 10: .*walk\.0\.obj.*{message}"):
        io.read_moving_body(folder)


def test_files_that_cannot_be_a_body_say_why(walk, tmp_path):
    x, faces = walk
    io.write_animation(tmp_path / "a.pc2", x, faces, 24)
    io.write_animation(tmp_path / "a.usdc", x, faces, 24)
    trimesh.Trimesh(x[0, :-1], faces[(faces < x.shape[1] - 1).all(axis=1)], process=False).export(tmp_path / "less.obj")
    (tmp_path / "a.abc").write_bytes(b"Ogawa")
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "nan.npz", vertices=np.where(np.arange(3) == 1, np.nan, x), faces=faces)
    for name, options, message in (
        ("a.pc2", {}, "body.mesh: a mesh with the faces expected"),
        ("a.pc2", {"mesh": tmp_path / "less.obj"}, f"less.obj: body.mesh: .*{x.shape[1]} vertices.*{x.shape[1] - 1}"),
        ("a.usdc", {"up": "z"}, "body.up: .*USD says both"),
        ("a.usdc", {"mesh": tmp_path / "less.obj"}, "body.mesh: no mesh expected"),
        ("a.abc", {}, r"export \.usdc"),
        ("empty", {}, "an .obj for each frame"),
        ("nan.npz", {}, "frame 0, vertex 0"),
    ):
        with pytest.raises(InputError, match=message):
            io.read_moving_body(tmp_path / name, **options)


def test_triangles_that_look_inward_are_turned(walk, tmp_path):
    x, faces = walk
    np.savez(tmp_path / "a.npz", vertices=x, faces=faces[:, ::-1])
    body = io.read_moving_body(tmp_path / "a.npz")
    np.testing.assert_array_equal(body.faces, faces)
    assert "turned" in body.notes[0]


# --- frames and regions -----------------------------------------------------------------------------------------------------


def test_frames_between_frames_lie_on_smooth_paths():
    """A point on a circle, 20 degrees a frame: the chord is off by 15 mm a metre, the cubic by less than 1."""
    turn = np.radians(20) * np.arange(12)
    x = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)[:, None]
    fine = resampled(x, 30.0, 120.0)
    assert len(fine) == 45
    np.testing.assert_array_equal(fine[::4], x)
    assert np.abs(np.linalg.norm(fine[4:-4], axis=-1) - 1).max() < 1e-3
    assert resampled(x, 24.0, 24.0) is x
    np.testing.assert_array_equal(resampled(x, 30.0, 10.0), x[::3])
    line = np.arange(5.0)[:, None, None] * [1.0, 2.0, 3.0]
    np.testing.assert_allclose(resampled(line, 25.0, 60.0)[:, 0, 0], np.arange(10) * 25 / 60, atol=1e-12)  # its ends too


def test_regions_move_as_the_mesh_does(walk):
    """The post's middle is blended between two rigid halves, which are found again."""
    x, _ = walk
    weights, motions = find_regions(x)
    assert weights.shape == (x.shape[1], motions.shape[1]) and weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(motions[0], np.broadcast_to(np.eye(4)[:3], motions[0].shape), atol=1e-9)
    turns = motions[..., :3]
    np.testing.assert_allclose(turns @ np.swapaxes(turns, -1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-9)
    assert np.linalg.det(turns).min() > 0.99
    there = np.einsum("vk,tkab,vb->tva", weights, turns, x[0].astype(float)) + np.einsum(
        "vk,tka->tva", weights, motions[..., 3]
    )
    assert np.linalg.norm(there - x, axis=-1).max() < 5e-4


def test_what_moves_as_a_whole_has_one_region(walk):
    x, _ = walk
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = np.stack([x[0], x[0] @ turn.T + [1, 2, 3]]).astype(np.float64)
    weights, motions = find_regions(moved)
    assert weights.shape[1] == 1
    np.testing.assert_allclose(motions[1, 0], np.c_[turn, [1, 2, 3]], atol=1e-9)


# --- a scene ----------------------------------------------------------------------------------------------------------------


def test_contact_keeps_to_the_vertices_of_the_file(walk, tmp_path):
    scene = load_scene(write_moving(tmp_path, walk))
    assert scene.motion.files == () and scene.moves_by_itself
    made = assemble(scene, dtype=jnp.float64)
    part = made.prepared.part
    assert 0 < len(part) < walk[0].shape[1] and made.model.terms.inertia
    for t in (0, 7, 23):
        np.testing.assert_array_equal(pose_body(made.model, made.track.matrices[t]), walk[0][t, part].astype(np.float64))
    drawn = animation_of(made, None, np.zeros((24, 30, 3)))
    np.testing.assert_array_equal(drawn.body.vertices, walk[0])


def test_a_garment_begins_on_the_first_frame(walk, tmp_path):
    """A moving mesh has no joints to turn from rest: its rest is its first frame."""
    made = assemble(load_scene(write_moving(tmp_path, walk)))
    assert walk_in(made.model, made.track.matrices[0]).shape == (0, *made.track.matrices.shape[1:])


def test_frames_are_chosen_and_resampled_to_the_scene(walk, tmp_path):
    text = MOVING.replace("fps = 30", "fps = 60\nframes = [4, 12]").replace("[garment]", "fps = 15\n[garment]")
    setting = set_up(load_scene(write_moving(tmp_path, walk, text)))
    assert setting.body.frames.shape[0] == 29 and setting.body.fps == 60
    np.testing.assert_array_equal(setting.body.frames[::4], walk[0][4:12])
    np.testing.assert_array_equal(setting.body.vertices, walk[0][4])
    assert any("8 frames at 15 per second, made 29 at 60" in note for note in setting.body.notes)


REFUSED = {
    "betas": ("[garment]", "betas = [1.0]\n[garment]", "body.betas: no betas"),
    "part": ("[garment]", 'part = "skin"\n[garment]', "body.part: auto or all"),
    "joints": ("[garment]", 'joints = ["0"]\n[garment]', "body.joints: no joints"),
    "motion": ("fps = 30", 'files = ["ncs:walk"]\nfps = 30', "motion.files: no motion"),
    "over": ("smoothing = 2", 'over = ["runs/a"]', "garment.over|no run there"),
    "unit": ("[garment]", "scale = 1000\n[garment]", "body in metres expected.*scale = 0.01 below .body."),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_a_moving_body_is_refused(walk, tmp_path, name):
    old, new, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        set_up(load_scene(write_moving(tmp_path, walk, MOVING.replace(old, new))))


def test_frames_per_second_are_asked_for(walk, tmp_path):
    scene = write_moving(tmp_path, walk)
    np.savez(tmp_path / "frames.npz", vertices=walk[0], faces=walk[1])
    with pytest.raises(InputError, match=r"scene\.toml: body\.fps: frames per second expected"):
        set_up(load_scene(scene))
    scene.write_text(MOVING.replace("[garment]", "fps = 30\n[garment]"))
    assert set_up(load_scene(scene)).body.fps == 30


def test_a_character_has_none_of_its_fields(tmp_path):
    scene = write_scene(tmp_path, SCENE.replace('"body.npz"', '"body.npz"\nup = "z"'))
    with pytest.raises(InputError, match=r"body\.up: a mesh for each frame expected"):
        set_up(load_scene(scene))


def test_training_on_it_is_refused_before_anything_is_read(walk, tmp_path, capsys):
    scene = write_moving(tmp_path, walk)
    (tmp_path / "cloth.npz").unlink()
    with pytest.raises(InputError, match=r"body\.file: a skinned character expected to train on.*ncs simulate"):
        train(scene, tmp_path / "run")
    assert main(["train", str(scene), "--out", str(tmp_path / "run")]) == 2 and not (tmp_path / "run").exists()
    assert "no pose that a network could read" in capsys.readouterr().err


def test_a_check_tells_what_jumps_and_draws_the_mesh(walk, tmp_path, capsys):
    scene = write_moving(tmp_path, walk)
    assert main(["check", str(scene), "--out", str(tmp_path / "check.png")]) == 0
    said = capsys.readouterr().out
    assert "a mesh of 24 frames at 30 per second" in said and "check.png: the mesh in some frames" in said
    assert "at risk" not in said and "cell" not in said and (tmp_path / "check.png").stat().st_size > 10_000
    x = walk[0].copy()
    x[15:] += [0.4, 0, 0]
    risks = find_risks(set_up(load_scene(write_moving(tmp_path, (x, walk[1])))))
    found = next(risk for risk in risks if "jump" in risk.what)
    assert "frame 15" in found.value and "0.4" in found.value


def test_a_garment_is_fitted_to_the_first_frame(tmp_path, capsys):
    """The packaged T-shirt onto the packaged body, given as a folder of .obj in centimetres with Z up: by its shape alone."""
    body = io.read_body("ncs:body")
    x = np.stack([body.vertices, body.vertices + np.float32([0.01, 0, 0])])
    write_objs(tmp_path / "objs", 100 * x @ TURNS["z"].T, body.faces)
    out = tmp_path / "shirt.npz"
    command = ["fit", str(packaged("tshirt")), "--body", str(tmp_path / "objs"), "--body-scale", "0.01", "--body-up", "z"]
    assert main([*command, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "the body passes through 100 % of its openings" in said and "not moved" in said and "ncs simulate" in said
    given, found = io.read_garment("ncs:tshirt").vertices, io.read_garment(out).vertices
    assert np.linalg.norm(found - given, axis=1).max() < 0.01
    scene = load_scene(tmp_path / "shirt.toml")
    assert scene.body.scale == 0.01 and scene.body.up == "z" and scene.moves_by_itself
    with pytest.raises(InputError, match=r"body\.fps"):
        set_up(scene)
    assert main([*command[:4], "--betas", "1", "--out", str(out)]) == 2
    assert main(["fit", str(packaged("tshirt")), "--body-up", "z", "--out", str(out)]) == 2
    assert "--body-up: a mesh for each frame expected" in capsys.readouterr().err


# --- simulations ------------------------------------------------------------------------------------------------------------


def packaged_walk(folder: Path, frames: int) -> Path:
    """Write the packaged body's walk, led into from its rest pose, as a motion."""
    motion, body = io.read_motion(packaged("walk")), io.read_body("ncs:body")
    s = np.linspace(0, 1, 9)[:8, None]
    lead = s * s * (3 - 2 * s)
    poses = np.concatenate([lead[..., None] * motion.poses[:1], motion.poses[: frames - 8]]).astype(np.float32)
    trans = np.concatenate([lead * motion.translation[:1], motion.translation[: frames - 8]]).astype(np.float32)
    names = np.array(body.joint_names)
    np.savez(folder / "walk.npz", poses=poses, trans=trans, mocap_framerate=30.0, joint_names=names)
    return folder / "walk.npz"


SAME = """
[garment]
file = "ncs:tshirt"
[physics.collision]
distance = "smooth"
[simulation]
tolerance = 1e-7
precision = "double"
iterations = 300
"""


@pytest.mark.slow
@pytest.mark.usefixtures("plain_jax")
def test_a_walk_given_as_meshes_is_simulated_as_with_the_skinned_body(tmp_path):
    """To 0.1 mm in every vertex and frame. Both touch the whole body: the width of smooth contact is by the part's edges."""
    motion = packaged_walk(tmp_path, 20)
    body = io.read_body("ncs:body")
    write_objs(tmp_path / "objs", 100 * body_vertices(body, io.read_motion(motion)) @ TURNS["z"].T, body.faces)
    (tmp_path / "a.toml").write_text(f'[body]\npart = "all"\n[motion]\nfiles = ["{motion}"]\nup = "y"\n' + SAME)
    (tmp_path / "b.toml").write_text('[body]\npart = "all"\nfile = "objs"\nfps = 30\nscale = 0.01\nup = "z"\n' + SAME)
    skinned, meshes = (simulate(tmp_path / name) for name in ("a.toml", "b.toml"))
    assert skinned.status.max() == meshes.status.max() == 0 and meshes.vertices.shape == skinned.vertices.shape
    assert np.ptp(meshes.vertices, axis=0).max() > 0.05  # it moves
    apart = np.linalg.norm(skinned.vertices - meshes.vertices, axis=-1).max(axis=1)
    assert apart.max() < 1e-4, apart


@pytest.mark.slow
@pytest.mark.usefixtures("plain_jax")
def test_the_command_simulates_it_and_writes_the_mesh_too(walk, tmp_path, capsys):
    text = MOVING + '[physics.collision]\ndistance = "smooth"\nfriction = 0.2\n[simulation]\nsubsteps = 2\n'
    scene = write_moving(tmp_path, walk, text)
    assert main(["simulate", str(scene), "--out", str(tmp_path / "sim.glb"), "--body"]) == 0
    assert "24 frames at 30 per second" in capsys.readouterr().out
    scenes = trimesh.load(tmp_path / "sim.glb")
    assert set(scenes.geometry) == {"cloth", "frames"}
    np.testing.assert_allclose(scenes.geometry["frames"].vertices, walk[0][0], atol=1e-6)
    assert main(["simulate", str(scene), "--out", str(tmp_path / "sim.npz")]) == 0
    assert main(["evaluate", str(tmp_path / "sim.npz"), "--scene", str(scene)]) == 0
    assert "out_of_balance" in capsys.readouterr().out
    assert main(["view", str(tmp_path / "sim.npz"), "--scene", str(scene)]) == 2
    assert "a character expected to be shown live" in capsys.readouterr().err
    for wrong in (["--out", "a.npz", "--body"], ["--out", "a.glb", "--motion", "ncs:walk"]):
        assert main(["simulate", str(scene), *wrong]) == 2
    said = capsys.readouterr().err
    assert "motion.files: no motion" in said and "holds a body" in said


@pytest.mark.slow
@pytest.mark.skipif(not BLENDER, reason="NCS_BLENDER names no Python with bpy, which needs a NumPy older than ours")
def test_what_blender_exports_is_read(tmp_path):
    """An armature bends a tube of quads, which Blender writes as .obj files with its own axes, and as .usdc."""
    script = Path(__file__).with_name("blender_frames.py")
    subprocess.run([BLENDER, str(script), str(tmp_path)], check=True, stdout=subprocess.DEVNULL)
    with np.load(tmp_path / "truth.npz") as truth:
        expected = truth["vertices"]
    for name, options in (("objs", {"fps": 24}), ("frames.usdc", {})):
        body = io.read_moving_body(tmp_path / name, **options)
        assert body.fps == 24 and not body.notes
        np.testing.assert_allclose(body.frames, expected, atol=2e-6, err_msg=name)

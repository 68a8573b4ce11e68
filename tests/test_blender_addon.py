"""The Blender add-on: its zip, what it computes and calls without Blender, and all of it within Blender."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from blender import commands, pose, process, scene_file
from ncs_jax.cli import main
from ncs_jax.cli.check import tell
from ncs_jax.cli.progress import WorkProgress
from ncs_jax.errors import InputError
from ncs_jax.geometry.skinning import Skeleton, forward
from ncs_jax.runs.run import Run, load_run
from ncs_jax.runs.stream import AGAIN, BEGIN, NEXT, serve_frames
from ncs_jax.runs.train import train
from ncs_jax.scene.spec import load_scene
from tools.pack_blender import pack
from tools.run_docs import refused

from .ready import ready
from .scenes import write_scene

ROOT = Path(__file__).parents[1]
BLENDER = os.environ.get("NCS_BLENDER", "")


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


# --- the zip ------------------------------------------------------------------------------------------------------------


def test_the_zip_is_an_extension_of_plain_files(tmp_path):
    file = pack(tmp_path / "a")
    assert file.read_bytes() == pack(tmp_path / "b").read_bytes()
    with zipfile.ZipFile(file) as packed:
        names = packed.namelist()
        manifest = tomllib.loads(packed.read("blender_manifest.toml").decode())
        for name in names:
            if name.endswith(".py"):
                compile(packed.read(name), name, "exec")
    assert {"__init__.py", "blender_manifest.toml", "panel.py", "LICENSE"} <= set(names) and not any("/" in n for n in names)
    assert file.stat().st_size < 60_000
    assert manifest["type"] == "add-on" and manifest["blender_version_min"] == "4.5.0" and manifest["schema_version"] == "1.0.0"
    assert re.fullmatch(r"[a-z_]+", manifest["id"]) and re.fullmatch(r"\d+\.\d+\.\d+", manifest["version"])
    assert (
        len(manifest["tagline"]) <= 64 and not manifest["tagline"].endswith(".") and manifest["license"][0].startswith("SPDX:")
    )
    assert all(len(reason) <= 64 and not reason.endswith(".") for reason in manifest["permissions"].values())


def test_what_is_packed_imports_nothing_but_blender_numpy_and_python():
    allowed = {*sys.stdlib_module_names, "bpy", "mathutils", "numpy"}
    for file in (ROOT / "blender").glob("*.py"):
        text = file.read_text()
        assert not set(re.findall(r"^\s*(?:import|from) (\w+)", text, re.MULTILINE)) - allowed, file.name
        assert len(text.splitlines()) <= 450, file.name


# --- poses --------------------------------------------------------------------------------------------------------------


def bones(rng, joints=6, unit=0.5):
    """A chain with a side branch at rest, whose bones are turned and scaled, as Blender's matrices have them."""
    parents = [-1, 0, 1, 2, 1, 4][:joints]
    rest = np.tile(np.eye(4), (joints, 1, 1))
    rest[:, :3, :3] = 0.01 * Rotation.random(joints, random_state=rng).as_matrix()
    rest[:, :3, 3] = rng.normal(size=(joints, 3))
    return pose.Skeleton([f"bone {j}" for j in range(joints)], parents, rest, unit)


def posed(skeleton, local, way):
    """Blender's matrices of a pose, by the package's own kinematics."""
    rig = Skeleton(jnp.asarray(skeleton.joints), tuple(skeleton.parents.tolist()))
    found = forward(rig, jnp.asarray(local), jnp.asarray(way))
    turned, place = np.asarray(found.rotations, np.float64), np.asarray(found.positions, np.float64)
    now = skeleton.rest.copy()
    now[:, :3, :3] = pose.UP.T @ turned @ pose.UP @ skeleton.rest[:, :3, :3]
    now[:, :3, 3] = pose.from_metres(place, skeleton.unit)
    return now


def test_a_pose_is_that_of_the_packages_kinematics(rng):
    skeleton = bones(rng)
    local, way = Rotation.random(6, random_state=rng).as_matrix(), rng.normal(size=3)
    rotations, translation = skeleton.pose(posed(skeleton, local, way))
    np.testing.assert_allclose(rotations, local, atol=1e-5)
    np.testing.assert_allclose(translation, way, atol=1e-5)
    again = pose.Skeleton(**json.loads(json.dumps(skeleton.facts())))
    np.testing.assert_array_equal(again.pose(posed(skeleton, local, way))[0], rotations)


def test_a_bone_that_does_more_than_turn_is_named(rng):
    skeleton = bones(rng)
    local = Rotation.random(6, random_state=rng).as_matrix()
    now = posed(skeleton, local, np.zeros(3))
    grown, slid, small = now.copy(), now.copy(), now.copy()
    grown[3, :3, :3] *= 1.1
    slid[5, :3, 3] += 1
    small[5, :3, 3] += 0.001
    with pytest.raises(pose.Wrong, match="bone 3 changes its size"):
        skeleton.pose(grown)
    with pytest.raises(pose.Wrong, match=r"bone 5 leaves its place by 0\.87 m"):
        skeleton.pose(slid)
    np.testing.assert_allclose(skeleton.pose(small)[0], local, atol=1e-5)


def test_poses_between_turn_evenly(rng):
    first, last = Rotation.random(4, random_state=rng), Rotation.from_rotvec([0, 0, 1.2])
    found = pose.between((first.as_matrix(), np.zeros(3)), ((first * last).as_matrix(), np.array([0, 0, 3.0])), 3)
    assert len(found) == 3
    for k, (turns, way) in enumerate(found, 1):
        angle = (first.inv() * Rotation.from_matrix(turns)).magnitude()
        np.testing.assert_allclose(angle, 0.4 * k, atol=0.05)  # a blend, not a slerp
        np.testing.assert_allclose(way, [0, 0, k])
    half = np.diag([1.0, -1, -1])[None]
    assert all(np.linalg.det(turns[0]) > 0 for turns, _ in pose.between((np.eye(3)[None], way), (half, way), 4))


# --- files and commands -------------------------------------------------------------------------------------------------


def test_a_scene_file_is_one_of_the_package(tmp_path):
    write_scene(tmp_path)
    (tmp_path / "scene").mkdir()
    own = tmp_path / "own.toml"
    scene_file.write_scene(tmp_path / "scene", True, ['motions/a "b".npz'], 24.0, own)
    scene = load_scene(tmp_path / "scene" / "scene.toml")
    assert scene.garment.pins == "pins" and scene.motion.fps == 24 and scene.motion.files == ('motions/a "b".npz',)
    fitted = (
        '[body]\nfile = "x"\n[garment]\nfile = "fitted.npz"\n[motion]\nfiles = []\n[physics.collision]\nthickness = 0.006\n'
    )
    (tmp_path / "scene" / "fitted.toml").write_text(fitted)
    own.write_text("[physics]\ndensity = 0.3\n[physics.collision]\nstiffness = 20\n[training]\nsteps = 7\nwindow = 9\n")
    scene_file.write_scene(tmp_path / "scene", False, ["motions/a.npz"], 30.0, own)
    scene = load_scene(tmp_path / "scene" / "scene.toml")
    assert (scene.garment.file, scene.body.file, scene.motion.files) == ("fitted.npz", "body.npz", ("motions/a.npz",))
    collision = scene.physics.collision
    assert (collision.thickness, collision.stiffness, scene.physics.density, scene.training.steps) == (0.006, 20, 0.3, 7)
    assert scene.training.window == 9


def test_every_action_has_a_file_name():
    names = ["Armature|mixamo.com|Layer0", "Walk", "walk", "Été [1:2]", "..", "#1"]
    found = scene_file.file_names(names)
    assert found == ["Armature_mixamo.com_Layer0", "Walk", "walk_", "Été_1_2", "motion", "1"]


def test_the_command_lines_are_accepted():
    lines = [
        commands.check(),
        commands.fit(True, "--scale 0.0254 --up=-z --move 0 1 -2"),
        commands.fit(False),
        commands.train(0.05, False),
        commands.train(10, True),
    ]
    for line in [*lines, commands.animate(1 / 3), commands.animate(1.5e-7), commands.stream()]:
        assert not refused(main, line), line


def test_the_command_is_found_where_it_is(tmp_path, monkeypatch):
    inner = tmp_path / "env" / ("Scripts" if os.name == "nt" else "bin")
    inner.mkdir(parents=True)
    ncs, python = inner / "ncs", inner / "python3.13"
    for file in (ncs, python):
        file.touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert process.find_command("", tmp_path / "none") == []
    assert process.find_command("", tmp_path / "env") == process.find_command(str(tmp_path / "env"), tmp_path) == [str(ncs)]
    assert process.find_command(str(python), tmp_path) == [str(python), "-m", "ncs_jax.cli"]
    assert process.find_command(str(tmp_path / "gone"), tmp_path / "env") == []
    monkeypatch.setenv("PATH", str(inner))
    assert process.find_command("", tmp_path / "none") == [str(ncs)]
    make, install = process.install_commands(tmp_path / "new", "ncs-jax")
    assert make[0] == sys.executable and make[1:3] == ["-m", "venv"] and install[-1] == "ncs-jax"


def test_progress_is_read_from_what_a_training_prints(capsys):
    stream = io.StringIO()
    with WorkProgress("reading the scene", console=Console(file=stream)) as told:
        assert process.progress(stream.getvalue()) == ("reading the scene ...", -1.0)
        told.show("step 30/120", 30, 120, "total 0.2 J (membrane 0.1)", "strain 1.0 %, penetrating 0.0 %", left=90.0)
        line, share = process.progress(stream.getvalue())
        assert share == 0.25 and line.startswith("step 30/120, ") and "left" in line
        told.say("only 120 steps fitted in")
    assert process.progress(stream.getvalue())[1] == -1.0 and process.progress("") == ("", -1.0)
    printed = "step 1/2\nncs: scene.toml: garment.file: no such file\n  a second line\n"
    assert process.reason(printed) == "ncs: scene.toml: garment.file: no such file"
    warned = "ncs: warning: only 20 steps fitted\n"
    tell("note", "nothing")
    tell("beyond", words := "in 3 of 24 frames, the worst of which is at the joint Spine" + " and so on" * 20)
    told = f"{warned}{capsys.readouterr().out}{warned}"
    assert process.warnings(told) == ["only 20 steps fitted", words] and told.count("\n") > 4
    assert process.reason("Traceback\nKeyError: 1\n") == "KeyError: 1" and process.reason("")


def ended(running: process.Process, seconds: float = 20.0) -> int | None:
    until = time.monotonic() + seconds
    while running.running() and time.monotonic() < until:
        time.sleep(0.02)
    return running.code


@pytest.mark.skipif(os.name == "nt", reason="Windows has no Ctrl-C for one process")
def test_a_command_runs_apart_and_stops_as_by_ctrl_c(tmp_path):
    waits = "import signal, time\nsignal.signal(signal.SIGINT, signal.default_int_handler)\nprint('step 3/4', flush=True)\n"
    waits += "try:\n time.sleep(60)\nexcept KeyboardInterrupt:\n print('kept')\n exit(130)"
    running = process.Process([sys.executable, "-c", waits], tmp_path, tmp_path / "log")
    while "step" not in running.text():
        assert running.running()
        time.sleep(0.02)
    assert process.progress(running.text()) == ("step 3/4", 0.75)
    running.stop()
    assert ended(running) == 130 and running.text().endswith("kept\n")
    running.stop()
    deaf = "import signal, time\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\nprint('on', flush=True)\ntime.sleep(60)"
    running = process.Process([sys.executable, "-c", deaf], tmp_path, tmp_path / "log")
    while "on" not in running.text():
        time.sleep(0.02)
    running.stop()
    running.stop()  # the second time at once
    assert ended(running) not in (None, 0)
    with pytest.raises(OSError):
        process.Process([str(tmp_path / "none")], tmp_path, tmp_path / "log")


# --- frames for another program -----------------------------------------------------------------------------------------


def frames(motion, kinds, alphas):
    """Requests of the frames of a motion."""
    turns = Rotation.from_rotvec(motion.poses.reshape(-1, 3)).as_matrix().reshape(*motion.poses.shape[:2], 3, 3)
    rows = zip(kinds, alphas, motion.translation, turns, strict=True)
    return [np.concatenate([[kind, alpha], way, turn.ravel()]).astype("<f4") for kind, alpha, way, turn in rows]


def answers(run, requests):
    source, sink = io.BytesIO(b"".join(r.tobytes() for r in requests) + b"half"), io.BytesIO()
    assert serve_frames(run, source, sink) == len(requests)
    line, _, data = sink.getvalue().partition(b"\n")
    facts = json.loads(line)
    assert facts["numbers"] == len(requests[0]) and facts["fps"] == run.assembly.model.fps
    return np.frombuffer(data, "<f4").reshape(len(requests), facts["vertices"], 3)


@pytest.mark.parametrize("method", ["ncs", "swing"])
def test_frames_in_a_row_are_those_of_animate(method):
    assembly, params, motion = ready(jnp.float32, method)
    run = Run(assembly, params)
    whole, count = run.animate(motion, 1.5, outside=True), len(motion.poses)
    kinds = [BEGIN, *[NEXT] * (count - 1)]
    np.testing.assert_allclose(answers(run, frames(motion, kinds, [1.5] * count)), whole, rtol=0, atol=1e-5)
    asked = frames(motion, kinds, [1.5] * count)
    others = (AGAIN, 0.0), (AGAIN, 1.5), (BEGIN, 1.5)
    static, again, anew = (frames(motion, [kind] * count, [alpha] * count) for kind, alpha in others)
    other = answers(run, [*asked[:9], static[8], again[8], *asked[9:12], anew[12], *asked[13:]])
    np.testing.assert_allclose(other[9], run.animate(motion, 0.0, outside=True)[8], rtol=0, atol=1e-5)
    kept = [*range(8), 10, 11, 12, 13]  # 8 and 9 were taken back
    np.testing.assert_allclose(other[kept], whole[:12], rtol=0, atol=1e-5)
    np.testing.assert_allclose(other[14], run.animate(motion, 0.0, outside=True)[12], rtol=0, atol=1e-5)  # without a past
    assert np.abs(other[15] - whole[13]).max() > 1e-4
    with pytest.raises(InputError, match="alpha: a number from 0 to 10"):
        answers(run, frames(motion, kinds, [-1.0] * count))


@pytest.mark.slow
def test_the_command_streams(tmp_path):
    from blender.worker import Worker  # as the add-on asks

    train(write_scene(tmp_path), tmp_path / "run", steps=10)
    run = load_run(tmp_path / "run")
    motion = run.motion(str(tmp_path / "swing.npz"))
    names = [str(j) for j in range(2)] if not run.assembly.body.joint_names else list(run.assembly.body.joint_names)
    skeleton = pose.Skeleton(names, [-1, 0], np.tile(np.eye(4), (2, 1, 1)), 1.0)
    worker = Worker([sys.executable, "-m", "ncs_jax.cli"], tmp_path, skeleton)
    while not worker.ready():
        time.sleep(0.1)
    asked = frames(motion, [BEGIN, *[NEXT] * (len(motion.poses) - 1)], [1.0] * len(motion.poses))
    found = [worker.frame(int(r[0]), r[1], r[5:].reshape(2, 3, 3), r[2:5]) for r in asked]
    np.testing.assert_allclose(found, run.animate(motion, outside=True), rtol=0, atol=1e-5)
    worker.close()
    gone = Worker([sys.executable, "-m", "ncs_jax.cli"], tmp_path / "run", skeleton)
    with pytest.raises(pose.Wrong, match="no run there"):
        while not gone.ready():
            time.sleep(0.1)
    gone.close()


# --- in Blender ---------------------------------------------------------------------------------------------------------


def fake_wheel(folder: Path) -> None:
    """A wheel of the package's name, whose command refuses everything."""
    info, name = "ncs_jax-0.0.1.dist-info", "ncs_jax-0.0.1-py3-none-any.whl"
    with zipfile.ZipFile(folder / name, "w") as packed:
        packed.writestr("ncs_fake.py", "import sys\ndef main():\n    sys.exit('ncs: the fake is here')\n")
        packed.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\nName: ncs-jax\nVersion: 0.0.1\n")
        packed.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        packed.writestr(f"{info}/entry_points.txt", "[console_scripts]\nncs = ncs_fake:main\n")
        packed.writestr(f"{info}/RECORD", "")


@pytest.fixture(scope="module")
def in_blender(tmp_path_factory):
    """What Blender shows after `blender_addon.py`, and the folder."""
    folder = tmp_path_factory.mktemp("blender")
    (folder / "user").mkdir()
    fake_wheel(folder)
    script, assets = ROOT / "tests" / "blender_addon.py", ROOT / "src" / "ncs_jax" / "assets"
    command = [BLENDER, str(script), str(folder), str(assets), str(pack(folder)), str(Path(sys.executable).with_name("ncs"))]
    path = os.pathsep.join(p for p in os.environ["PATH"].split(os.pathsep) if not (Path(p) / "ncs").exists())
    user = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user"), "PATH": path}
    done = subprocess.run(command, env=user, capture_output=True, text=True, check=False)
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    with np.load(folder / "truth.npz") as truth:
        return folder, dict(truth)


needs_blender = pytest.mark.skipif(
    not BLENDER, reason="NCS_BLENDER names no Python with bpy, which needs a NumPy older than ours"
)


@pytest.mark.slow
@needs_blender
def test_baked_and_live_frames_are_those_of_animate(in_blender):
    """Check, Fit, Train, Resume, Bake and Live by script, from nothing, in half metres."""
    folder, truth = in_blender
    work = folder / "hero_ncs" / "trained_1"
    run = load_run(work / "run")
    first = run.animate(run.motion(str(work / "motions" / "Armature_mixamo.com_Layer0.npz")), 1.25, outside=True)
    second = run.animate(run.motion(str(work / "motions" / "Turn.npz")), 1.25, outside=True)
    assert min(np.ptp(x, axis=0).max() for x in (first, second)) > 0.1 and np.abs(first - second).max() > 0.1
    np.testing.assert_allclose(truth["baked"], second, rtol=0, atol=1e-4)
    np.testing.assert_allclose(truth["live"], second, rtol=0, atol=1e-4)
    np.testing.assert_allclose(truth["other"], first, rtol=0, atol=1e-4)
    static = run.animate(run.motion(str(work / "motions" / "Armature_mixamo.com_Layer0.npz")), 0.0, outside=True)
    np.testing.assert_allclose(truth["static"], static[-1], rtol=0, atol=1e-4)
    assert 0.01 < np.abs(truth["by_hand"] - truth["static"]).max() < 1.0
    assert float(truth["ms"]) < 1000 / 24
    assert truth["modifiers"].tolist() == ["WELD", "MESH_CACHE", "SUBSURF"] and truth["hidden"] and truth["gone"]


@pytest.mark.slow
@needs_blender
def test_alpha_has_keys(in_blender):
    folder, truth = in_blender
    run = load_run(folder / "hero_ncs" / "trained_1" / "run")
    motion = str(folder / "hero_ncs" / "trained_1" / "motions" / "Armature_mixamo.com_Layer0.npz")
    np.testing.assert_allclose(truth["keyed_baked"], truth["keyed_live"], rtol=0, atol=1e-6)
    for frame, alpha in ((0, 0.0), (-1, 2.0)):
        np.testing.assert_allclose(
            truth["keyed_baked"][frame], run.animate(run.motion(motion), alpha, outside=True)[frame], rtol=0, atol=1e-4
        )
    assert np.abs(truth["keyed_baked"] - truth["other"]).max() > 1e-4
    np.testing.assert_allclose(truth["keys"], truth["keyed_baked"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(truth["again"], truth["keyed_baked"], rtol=0, atol=1e-6)
    assert truth["blocks"].tolist() == ["Basis", *(f"Neural Cloth {frame:04}" for frame in range(1, 25))]
    assert truth["blocks_again"] == 1 and "MESH_CACHE" not in truth["keyed_modifiers"]
    assert "after its first modifiers" in str(truth["more"]) and "shape keys of its own" in str(truth["keys_of_its_own"])


@pytest.mark.slow
@needs_blender
def test_blender_stays_free_and_a_training_is_cancelled(in_blender):
    _, truth = in_blender
    assert float(truth["check_tick"]) < 2 and str(truth["check_said"]).startswith(("good", "at risk: "))
    assert float(truth["train_tick"]) < 2 and str(truth["train_said"]) == "stopped"


@pytest.mark.slow
@needs_blender
def test_what_is_wrong_is_said(in_blender):
    folder, truth = in_blender
    said = json.loads(str(truth["refusals"]))
    assert (
        "Choose a character" in said["nothing"]
        and "Preserve Volume" in said["volume"]
        and "no vertex group waist" in said["pins"]
    )
    assert said["untrained"].count("Train first") == 2 and "bone mixamorig:Spine changes its size" in said["scale"]
    assert all(word in str(truth["drawn"]) for word in ("Garment", "Train", "Live", "Alpha", "Train: stopped", "Found: "))
    assert "ncs is not on PATH" in str(truth["lost"]) and "the fake is here" in str(truth["installed"])
    assert {f"Neural Cloth: {what}" for what in ("Check", "Fit", "Train", "Bake")} <= set(truth["texts"].tolist())
    assert {"check.png", "fitted.png"} <= set(truth["images"].tolist())
    scene = load_scene(folder / "hero_ncs" / "trained_1" / "scene.toml")
    assert set(scene.motion.files) == {"motions/Armature_mixamo.com_Layer0.npz", "motions/Turn.npz"}
    assert scene.garment.file == "fitted.npz" and scene.motion.fps == 30

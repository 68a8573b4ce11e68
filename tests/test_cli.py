"""The commands: what they print and write, and one line with exit code 2 for every broken input."""

import gc
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from ncs_jax import io
from ncs_jax.cli import animate, check, main, preview
from ncs_jax.cli.parser import _never_lost
from ncs_jax.cli.progress import WorkProgress
from ncs_jax.cli.train import _TrainingBar
from ncs_jax.errors import InputError
from ncs_jax.io import MotionRecord
from ncs_jax.metrics.quality import measure
from ncs_jax.metrics.seen import SkinShown
from ncs_jax.prepare.joint_names import listed
from ncs_jax.prepare.scene_checks import Risk
from ncs_jax.runs.run import load_run
from ncs_jax.runs.train import train
from ncs_jax.view.character import body_vertices
from ncs_jax.view.preview import preview as draw_preview

from .characters import skinned
from .scenes import SCENE, grid, post, swing, write_scene
from .test_living_page import package
from .test_viewer import Page


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A run that was trained for a moment, and shows skin between its vertices; (scene file, run folder)."""
    import jax

    folder = tmp_path_factory.mktemp("trained")
    scene = write_scene(folder, SCENE + '[physics.collision]\npoints = "0"\n')
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        train(scene, folder / "run", steps=10)
    return scene, folder / "run"


def truncated(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def rewrite(path, **arrays):
    with np.load(path) as old:
        np.savez(path, **{**dict(old), **arrays})


def edited(scene, old, new):
    text = scene.read_text()
    assert old in text
    scene.write_text(text.replace(old, new))


def truncated_npz(folder, scene):
    truncated(folder / "body.npz")
    return ["body.npz"]


def nan_in_a_pose(folder, scene):
    poses = swing()["poses"]
    poses[7, 1, 2] = np.nan
    rewrite(folder / "swing.npz", poses=poses)
    return ["swing.npz", "poses", "nan", "7"]


def wrong_joint_count(folder, scene):
    rewrite(folder / "swing.npz", **swing(joints=3))
    return ["swing.npz", "poses", "3 joints", "2 joints expected"]


def quaternion_of_zero_length(folder, scene):
    quaternions = np.zeros((24, 2, 4))
    quaternions[..., 0] = 1
    quaternions[5, 1] = 0
    np.savez(folder / "swing.npz", quaternions=quaternions, trans=np.zeros((24, 3)), fps=30.0)
    return ["swing.npz", "quaternions", "5"]


def empty_mesh(folder, scene):
    np.savez(folder / "cloth.npz", vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), np.int32))
    return ["cloth.npz"]


def non_manifold_mesh(folder, scene):
    vertices, faces = grid()
    np.savez(folder / "cloth.npz", vertices=vertices, faces=np.concatenate([faces, faces[:1, ::-1], faces[:1]]))
    return ["cloth.npz", "faces"]


def faces_out_of_range(folder, scene):
    vertices, faces = grid()
    faces[3, 1] = len(vertices)
    np.savez(folder / "cloth.npz", vertices=vertices, faces=faces)
    return ["cloth.npz", "faces", str(len(vertices))]


def missing_file(folder, scene):
    (folder / "cloth.npz").unlink()
    return ["cloth.npz"]


def unwritable_output_folder(folder, scene):
    (folder / "run").write_text("in the way")  # no folder can be made below a file, whoever tries
    edited(scene, "steps = 40", "steps = 41")
    return ["run", "folder that can be written", "--out"]


def unknown_key(folder, scene):
    edited(scene, "smoothing", "smothing")
    return ["scene.toml", "garment.smothing", "did you mean smoothing"]


def not_toml(folder, scene):
    scene.write_text("[body\n")
    return ["scene.toml", "TOML"]


def wrong_type(folder, scene):
    edited(scene, "batch = 4", 'batch = "four"')
    return ["scene.toml", "training.batch", "four", "whole number"]


def out_of_range(folder, scene):
    edited(scene, "batch = 4", "batch = 0")
    return ["scene.toml", "training.batch", "0", "from 1"]


def garment_in_centimetres(folder, scene):
    vertices, faces = grid()
    np.savez(folder / "cloth.npz", vertices=100 * vertices, faces=faces)
    return ["cloth.npz", "vertices", "centimetres", "scale = 0.01"]


def garment_elsewhere(folder, scene):
    vertices, faces = grid(origin=(0.0, 3.0, 0.0))
    np.savez(folder / "cloth.npz", vertices=vertices, faces=faces)
    return ["cloth.npz", "on the body"]


def translation_in_centimetres(folder, scene):
    rewrite(folder / "swing.npz", trans=swing()["trans"] * 10000)
    return ["swing.npz", "trans", "metres"]


def no_such_joint(folder, scene):
    edited(scene, 'file = "body.npz"', 'file = "body.npz"\njoints = ["2"]')
    return ["scene.toml", "body.joints[0]", "2", "0 to 1"]


def missing_motion(folder, scene):
    edited(scene, 'files = ["swing.npz"]', 'files = ["swung.npz"]')
    return ["scene.toml: motion.files: no such file or folder (found 'swung.npz')", "seen from"]


def missing_body(folder, scene):
    (folder / "body.npz").unlink()
    return ["scene.toml: body.file: no such file or folder (found 'body.npz')"]


def a_garment_as_the_body(folder, scene):
    (folder / "dress.obj").write_text("v 0 0 0\n")
    edited(scene, 'file = "body.npz"', 'file = "dress.obj"')
    return ["dress.obj: body.file: a character with skeleton", "they are the garment, and the body is ncs:body"]


def no_such_pins(folder, scene):
    edited(scene, "smoothing = 2", 'pins = "collar"')
    return ["scene.toml", "garment.pins", "collar", "pins"]


BROKEN = [
    truncated_npz,
    nan_in_a_pose,
    wrong_joint_count,
    quaternion_of_zero_length,
    empty_mesh,
    non_manifold_mesh,
    faces_out_of_range,
    missing_file,
    unwritable_output_folder,
    unknown_key,
    not_toml,
    wrong_type,
    out_of_range,
    garment_in_centimetres,
    garment_elsewhere,
    translation_in_centimetres,
    no_such_joint,
    no_such_pins,
    missing_motion,
    missing_body,
    a_garment_as_the_body,
]


def one_line(capsys, words):
    output = capsys.readouterr()
    line = "\n".join(line for line in output.err.strip().splitlines() if not line.endswith(" ..."))  # but for progress
    assert line.startswith("ncs: ") and "\n" not in line and "Traceback" not in output.err + output.out, output
    for word in words:
        assert word in line, (word, line)


@pytest.mark.parametrize("broken", BROKEN, ids=lambda f: f.__name__)
def test_broken_input_is_one_line_and_exit_code_2(tmp_path, capsys, broken):
    scene = write_scene(tmp_path)
    words = broken(tmp_path, scene)
    before = {p: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}
    assert main(["train", str(scene), "--out", str(tmp_path / "run" / "deeper")]) == 2
    one_line(capsys, words)
    assert {p: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == before
    assert not (tmp_path / "run").is_dir()


def process(*arguments):
    source = str(Path(__file__).parents[1] / "src")
    line = [sys.executable, "-m", "ncs_jax.cli", *map(str, arguments)]
    return subprocess.run(line, env={**os.environ, "PYTHONPATH": source}, capture_output=True, text=True, check=False)


def test_a_real_process_exits_with_2(tmp_path):
    scene = write_scene(tmp_path)
    truncated(tmp_path / "cloth.npz")
    done = process("check", scene)
    assert done.returncode == 2
    progress, error = done.stderr.splitlines()
    assert progress == "reading cloth.npz and body.npz ..." and error.startswith(f"ncs: {tmp_path / 'cloth.npz'}")
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "nowhere.toml"], ["nowhere.toml", "no such scene"]),
        (["check", "ncs:tshirt", "--out", "check.jpg2"], ["--out", "'check.jpg2'", ".png expected"]),
        (["check", "ncs:nothing"], ["ncs:nothing", "ncs:tshirt"]),
        (["animate", "nowhere", "--out", "a.npz"], ["nowhere", "run"]),
        (["evaluate", "nowhere"], ["nowhere"]),
        (["train", "ncs:tshirt", "--out", "nowhere", "--resume"], ["nowhere", "--resume"]),
        (["train", "ncs:tshirt", "--out", "nowhere", "--resume", "--preset", "fast"], ["--preset", "'fast'", "leave it out"]),
    ],
)
def test_wrong_names(tmp_path, capsys, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    one_line(capsys, words)


@pytest.mark.parametrize("command", ["check", "train --out r", "demo --out r --scene"])
def test_a_character_without_a_motion_is_refused(tmp_path, capsys, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    edited(scene := write_scene(tmp_path), 'files = ["swing.npz"]', "files = []")
    assert main([*command.split(), str(scene)]) == 2
    one_line(capsys, ["scene.toml: motion.files: a motion to train on expected (found [])", "ncs:walk"])
    assert not (tmp_path / "r").exists()


def test_cloth_without_a_character_needs_no_motion(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    edited(scene := write_scene(tmp_path), 'files = ["swing.npz"]\nvalidation = ["swing.npz"]', "files = []")
    edited(scene, 'file = "body.npz"', 'file = "none"')
    edited(scene, "smoothing = 2", 'pins = "pins"')
    assert main(["check", str(scene)]) == 0
    assert "the character never moves" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    ["", "fly", "train ncs:tshirt", "train a --out b --steps 0", "train a --out b --seed=-1", "animate a --out b --alpha nan",
     "demo --minutes 0", "train a --out b --hosts first,2,0", "train a --out b --hosts first:123,2,2",
     "train a --out b --hosts first:65536,2,0"],
)  # fmt: skip
def test_wrong_options(capsys, arguments):
    with pytest.raises(SystemExit) as stop:
        main(arguments.split())
    assert stop.value.code == 2
    assert "usage: ncs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("animate a --out b --alpha 1,5", "--alpha: a finite number expected, found 1,5; write 1.5, with a point"),
        ("animate a --out b --adapt long", "--adapt: a number of seconds above 0 expected, found long"),
        ("train a --out b --minutes 2m", "--minutes: a number of minutes above 0 expected, found 2m"),
        ("animate a --out b --alpha -0,5", "--alpha: a finite number expected, found -0,5; write -0.5, with a point"),
        ("animate a --out b --alpha -3", "--alpha: a number from 0 to 10 expected, found -3; 0 is static, 1 as trained"),
        ("evaluate a --alpha 1e3", "--alpha: a number from 0 to 10 expected, found 1e3; 0 is static, 1 as trained"),
        ("evaluate a --alpha -inf", "--alpha: a finite number expected, found -inf"),
        ("body --out b --betas 1 -,5", "--betas: a finite number expected, found -,5; write -.5, with a point"),
        ("animate a --out b --alpha much", "--alpha: a finite number expected, found much"),
        ("animate a --out b --refine 4,0", "--refine: a whole number from 1 expected, found 4,0"),
        ("animate a --out b --refine 4.5", "--refine: a whole number from 1 expected, found 4.5"),
        (
            "fit a --out b --scale 0,0254",
            "--scale: a number of metres a unit above 0 expected, found 0,0254; write 0.0254, with",
        ),
        ("fit a --out b --clearance inf", "--clearance: a number of metres above 0 expected, found inf"),
        ("fit a --out b --move 0 ,1 0", "--move: a finite number expected, found ,1; write .1, with a point"),
        ("fit a --out b --turn 90,0", "--turn: a whole number from 0 expected, found 90,0"),
        ("train a --out b --steps 5,000", "--steps: a whole number from 1 expected, found 5,000; write 5000, without commas"),
        ("train a --out b --seed one", "--seed: a whole number from 0 to 2147483647 expected, found one"),
    ],
)
def test_numbers_that_are_none_say_how_they_are_written(capsys, line, words):
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert stop.value.code == 2 and f"argument {words}" in capsys.readouterr().err


def test_python_refuses_the_alpha_that_the_commands_refuse(run_folder):
    run = load_run(run_folder[1])
    for measured in (run.animate, run.evaluate):
        with pytest.raises(InputError, match=r"alpha: a number from 0 to 10 expected \(found 150\)"):
            measured(run.assembly.scene.motions[0], 150)


def test_hosts_that_cannot_be_joined(capsys):
    line = ["train", "ncs:tshirt", "--out", "nowhere", "--hosts"]
    assert main([*line, "nowhere.invalid:1234,2,1"]) == 2
    one_line(capsys, ["--hosts", "HOST:PORT,COUNT,RANK"])
    with socket.create_server(("", 0)) as taken:
        assert main([*line, f"localhost:{taken.getsockname()[1]},2,0"]) == 2
    one_line(capsys, ["--hosts", "in use", "free port"])


COMMANDS = ("demo", "train", "preview", "animate", "export", "stream", "simulate", "evaluate", "view", "body", "fit", "check")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_every_option(capsys, command):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    options = re.split(r"\n  (?=-)", text.split("\noptions:")[1])[1:]
    assert options[0].startswith("-h, --help") and len(options) > 1
    for option in options:  # its name and value, then two spaces or a line's end, then what it is for
        assert re.search(r"^\S.*?(  +|\n +)\S.*\w", option), option


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    overview, table = text.split("positional arguments:")
    told = re.findall(r"^    (\w+)  +\w", table, re.MULTILINE)
    assert tuple(re.findall(r"^  ncs (\w+) ", overview, re.MULTILINE)) == COMMANDS and sorted(told) == sorted(COMMANDS)


def test_check_says_what_is_in_a_scene_and_draws_it(tmp_path, capsys, monkeypatch):
    scene = write_scene(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["check", str(scene)]) == 0
    text, progress = capsys.readouterr()
    words = "30 vertices", "40 triangles", "membrane, bending, collision, gravity, inertia (stvk)", "24 frames"
    for word in ("at risk: 1 in", *words):
        assert word in text
    assert "picture   check.png: each motion" in text
    with Image.open(tmp_path / "check.png") as picture:
        assert picture.format == "PNG" and picture.width > 8 * 100
    for step in (
        "reading cloth.npz and body.npz ...",
        "reading swing.npz ...",
        "looking for risks ...",
        "drawing the motions ...",
    ):
        assert step in progress and step not in text


def test_check_warns_first_and_is_worth_as_much_without_its_picture(tmp_path, capsys):
    scene = write_scene(tmp_path)
    vertices, faces = grid(origin=(0.0, 0.3, 0.05))
    np.savez(tmp_path / "cloth.npz", vertices=vertices, faces=faces)
    assert main(["check", str(scene), "--out", str(scene / "check.png")]) == 0  # a file is no folder
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"at risk: [1-9] in .*scene.toml", lines[0]) and "good" not in lines[0]
    assert lines[1].startswith("  at risk") and "inside the body" in "".join(lines)
    risks = [i for i, line in enumerate(lines) if line.startswith("  at risk")]
    assert max(risks) < next(i for i, line in enumerate(lines) if line.startswith("  garment"))
    assert any(line.startswith("  picture   none: ") and "scene.toml" in line for line in lines)


def told(motions, capsys) -> str:
    """What `ncs check` prints of motions, each given by its notes."""
    records = {name: MotionRecord(np.zeros((5, 1, 3)), np.zeros((5, 3)), 30.0, notes=notes) for name, notes in motions.items()}
    spec = SimpleNamespace(files=tuple(motions), validation=tuple(motions)[:1])
    made: Any = SimpleNamespace(
        scene=SimpleNamespace(motion=spec), motions=records, model=SimpleNamespace(fps=30.0, moves=True)
    )
    check._tell_motions(made, check._alike(records))
    return capsys.readouterr().out


def test_check_tells_motions_that_match_alike_once(capsys):
    pairs, other = "retargeted by joint names, 3 of 5: Hips by hip", "retargeted by joint names, 2 of 5: Hips by root"
    many = {f"{k}.bvh": (pairs, f"a unit is 0.0{k} m", "turned from Z up to Y up") for k in range(1, 10)}
    text = told(many | {"odd.bvh": (other,), "plain.npz": (), "plainer.npz": ()}, capsys)
    assert text.count(pairs) == 1 and text.count("turned from") == 1 and text.count(other) == 1
    assert "alike     9 motions: 1.bvh, 2.bvh, 3.bvh, 4.bvh, 5.bvh, 6.bvh and 3 more\n" in text
    assert all(f"{name}: a unit is {notes[1][10:]}" in text for name, notes in many.items())
    assert text.index("odd.bvh: 5 frames") < text.index(other) < text.index("alike")  # alone, below its own line
    alone = told({"1.bvh": many["1.bvh"]}, capsys)
    assert "alike" not in alone and alone.count(pairs) == 1


def test_check_counts_many_motions_and_their_risks(tmp_path, capsys):
    pairs, other = "retargeted by joint names, 3 of 5: Hips by hip", "retargeted by joint names, 2 of 5: Hips by root"
    many = {f"{k}.bvh": (pairs, f"a unit is {k} m") for k in range(2990)}
    text = told(many | {f"odd{k}.bvh": (other,) for k in range(10)}, capsys)
    assert "3000 motions: 15000 frames at 30 per second, 8.33 minutes; 5 to 5 frames each" in text
    assert text.count("\n") < 12 and "2990 motions" in text and "10 motions" in text and text.count(other) == 1
    risks = [Risk("fast motion", f"thrown by {k} in {k}.bvh", "it lags", "slow it", f"{k}.bvh") for k in range(400)]
    check._tell_risks([*risks, Risk("size", "9 m", "rounding", "scale it")], tmp_path / "check.txt")
    text = capsys.readouterr().out
    assert text.count("at risk") == 4 and "and 397 more of this kind, in 400 motions" in text and "size: 9 m" in text
    rows = (tmp_path / "check.txt").read_text().splitlines()
    assert (
        len(rows) == 402 and rows[7].startswith("6.bvh\tfast motion: thrown by 6") and str(tmp_path) in text.replace("\n", "")
    )
    check._tell_risks(risks[:6], tmp_path / "few.txt")
    assert capsys.readouterr().out.count("at risk") == 6 and not (tmp_path / "few.txt").exists()


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            "Hips mixamorig:LeftHandThumb1 mixamorig:RightHandPinky3 mixamorig:LeftHand",
            "Hips, mixamorig:LeftHand and 2 finger, face or helper joints",
        ),
        ("pelvis left_index1 left_middle2 jaw left_eye_smplhf head", "pelvis, head and 4 finger, face or helper joints"),
        ("LThumb LeftFingerBase LeftHandFinger1 LeftHand Head", "LeftHand, Head and 3 finger, face or helper joints"),
        ("thumb_01_l pinky_metacarpal_r hand_l foot_l", "hand_l, foot_l and 2 finger, face or helper joints"),
        ("Tongue01 UpperTeeth lEye rEye LeftToeBase LeftFoot", "LeftToeBase, LeftFoot and 4 finger, face or helper joints"),
        (
            "CC_Base_JawRoot CC_Base_Teeth01 CC_Base_L_Index1 CC_Base_L_Forearm",
            "CC_Base_L_Forearm and 3 finger, face or helper joints",
        ),
        ("0 1 2", "0, 1, 2"),
    ],
)
def test_check_counts_fingers_and_parts_of_the_face(names, expected):
    assert listed(names.split(), {name: name for name in names.split()}) == expected


def test_train_says_where_it_is(run_folder, tmp_path, capsys):
    scene, _ = run_folder
    assert main(["train", str(scene), "--out", str(tmp_path / "run"), "--steps", "20", "--seed", "3"]) == 0
    text = capsys.readouterr().out
    last = "step 20: validation total [0-9.]+ J, strain [0-9.]+ %, penetrating [0-9.]+ %"
    assert re.search(last, text) and len(re.findall(r"step 20/20  total [0-9.]+ J \(bending .*membrane .*strain", text)) == 1
    assert text.startswith("reading the scene")
    facts = json.loads((tmp_path / "run" / "run.json").read_text())
    assert facts["steps"] == 20 and facts["seed"] == 3 and "jax" in facts["versions"]
    assert any((tmp_path / "run" / "tensorboard").iterdir())
    assert main(["train", str(scene), "--out", str(tmp_path / "run")]) == 2


def test_resume_drops_no_option(run_folder, tmp_path, capsys, monkeypatch):
    scene, given = run_folder
    out = tmp_path / "run"
    shutil.copytree(given, out)
    line = ["train", str(scene), "--out", str(out), "--resume"]
    for option, word in (("--preset", "fast"), ("--seed", "7"), ("--steps", "5"), ("--from", str(given))):
        assert main([*line, option, word]) == 2
        one_line(capsys, [option.strip("-")])
    with monkeypatch.context() as patch:  # nothing is assembled anew, as its scene is there
        patch.setattr("ncs_jax.runs.train.assemble_run", None)
        assert main([*line, "--steps", "10"]) == 0
    assert f"{out} has its 10 steps already: nothing was trained" in capsys.readouterr().out
    assert main([*line, "--minutes", "0.001"]) == 0
    said = capsys.readouterr()
    assert "step 20/20" in said.out
    first, last = said.err.strip().splitlines()
    assert first.startswith(
        "ncs: warning: 0.001 minutes hold about 10 steps on this machine, up to step 20: too few to learn from"
    )
    assert re.search("300 steps in all take about [0-9]+ minutes? more$", first)
    assert last.startswith("ncs: warning: only 20 steps were taken")
    assert last.endswith(f"ncs train --out {out} --resume --minutes M goes on")
    with pytest.raises(SystemExit):
        main([*line, "--minutes", "1", "--steps", "30"])


def test_an_interrupted_training_keeps_its_last_steps(run_folder, tmp_path, capsys, monkeypatch):
    """Ctrl-C between two reports: the steps under way are taken, kept, and gone on from by the command that it prints."""
    scene, _ = run_folder
    out, shown = tmp_path / "ein lauf", []
    show, handler = _TrainingBar.show, signal.getsignal(signal.SIGINT)

    def pressed(self, report):
        show(self, report)
        shown.append(report.step)
        if len(shown) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    def early(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("ncs_jax.runs.train.assemble_run", early)
        assert main(["train", str(scene), "--out", str(out), "--steps", "100"]) == 130
    assert capsys.readouterr().err == "ncs: interrupted before the first step: the same command begins again\n"
    monkeypatch.setattr(_TrainingBar, "show", pressed)
    assert main(["train", str(scene), "--out", str(out), "--steps", "100"]) == 130
    said = capsys.readouterr()
    assert "stopping after these steps" in said.out and signal.getsignal(signal.SIGINT) is handler
    assert said.err == f"ncs: interrupted; `ncs train --out '{out}' --resume` goes on from the last checkpoint\n"
    assert shown == [10, 20] and load_run(out).steps == 30
    assert not load_run(out).trained.strain  # which is known at the end
    assert main(["train", "--out", str(out), "--resume", "--steps", "40"]) == 0
    said = capsys.readouterr().out
    assert "going on from step 30" in said and "step 40/40" in said
    strain = load_run(out).trained.strain
    del shown[1:]
    assert strain > 0 and main(["train", "--out", str(out), "--resume", "--steps", "90"]) == 130  # it is not that of step 40
    assert not load_run(out).trained.strain and load_run(out).known.strain > 0
    step = load_run(out).steps
    assert main(["train", "--out", str(out), "--resume", "--steps", str(step)]) == 0  # nothing is left but that
    assert "nothing was trained" in capsys.readouterr().out and load_run(out).trained.strain > 0


def test_ctrl_c_that_python_drops_comes_again(monkeypatch):
    """JAX has the collector of garbage call it, and what is raised there is dropped."""
    monkeypatch.setattr(sys, "unraisablehook", _never_lost(sys.unraisablehook))
    pressed = []

    def collected(phase, info):
        if phase == "start" and not pressed:
            pressed.append(phase)
            signal.raise_signal(signal.SIGINT)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.callbacks.append(collected)
    try:
        with pytest.raises(KeyboardInterrupt):
            gc.collect()
            pressed.append("later")
            time.sleep(10)
    finally:
        gc.callbacks.remove(collected)
        signal.signal(signal.SIGINT, handler)
    assert pressed == ["start", "later"]


def test_a_run_is_drawn_again_the_picture_first(run_folder, tmp_path, capsys, monkeypatch):
    """Its pictures, and what they show, are looked at in `test_viewer` and `test_pictures`."""
    _, folder = run_folder
    monkeypatch.setattr("ncs_jax.view.pictures.render", lambda *_, **__: np.zeros((520, 400, 3), np.uint8))
    shutil.copy(folder.parent / "swing.npz", tmp_path / "other.npz")
    monkeypatch.setattr("ncs_jax.view.preview.LOOKED_AT", 8)
    # what is put outside of the post is so in all frames
    monkeypatch.setattr("ncs_jax.runs.outside.pushing", lambda model: None)
    # nothing of this post is covered so that it could show
    monkeypatch.setattr(
        "ncs_jax.view.preview.shown_skin", lambda model, x, body, frames: SkinShown(len(x), 3, frames[2], 40, 1)
    )
    out = tmp_path / "drawn"
    assert main(["preview", str(folder), "--out", f"{out}.png"]) == 2 and not Path(f"{out}.png").exists()
    assert "a folder expected" in capsys.readouterr().err
    assert main(["preview", str(folder), "--motion", str(tmp_path / "other.npz"), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    written = [Path(line.strip()).name for line in text.splitlines() if line.startswith(f"  {out}")]
    assert written == ["preview.png", "preview.html", "alphas.png", "preview.gif", "energies.png"]
    assert re.search(
        r"other.npz, which it never trained on, one frame in 3:\n  mean strain [0-9.]+ %, penetrating vertices", text
    )
    run = load_run(folder)
    other = run.track(str(tmp_path / "other.npz"))
    quick = draw_preview(run, out, str(tmp_path / "other.npz"))
    rows = measure(run.assembly.model, run.animate(other, outside=True), other)
    every = int(quick["every"])
    assert every == 3 and rows["penetrating"][::every].any()
    np.testing.assert_allclose(quick["strain_mean"], rows["strain_mean"][::every].mean(), rtol=1e-3)
    np.testing.assert_allclose(quick["penetrating"], rows["penetrating"][::every].mean(), atol=1e-6)
    np.testing.assert_allclose(quick["depth_max"], rows["depth_max"][::every].max(), atol=1e-2)
    looked = len(rows["penetrating"][::every])
    assert (quick["skin_looked"], quick["skin_shown"], quick["skin_frame"], quick["skin_pixels"]) == (looked, 3, 2 * every, 40)
    told = f"skin shows in 3 of {looked} frames that were looked at, most in frame 6: 40 pixels of six views"
    assert told in " ".join(text.split())
    names = tuple(f"joint_{j}" for j in range(len(run.assembly.body.parents)))
    check.tell_skin(SkinShown(9, 1, 4, 30, 1), replace(run.assembly, body=replace(run.assembly.body, joint_names=names)))
    joint = run.assembly.body.weights[run.assembly.prepared.part[1]].argmax()
    assert f"most in frame 4 by joint_{joint}: 30 pixels" in capsys.readouterr().out
    check.tell_skin(SkinShown(9, 0, 4, 10, 1), run.assembly)
    assert not capsys.readouterr().out
    page = (out / "preview.html").read_text()
    assert "mean strain" in page and "10 steps on" in page and {p.name for p in out.iterdir()} == set(written)


@pytest.mark.parametrize(
    ("name", "trained"),
    [("a.bvh", True), ("a.bvh[3:9]", True), ("b.bvh[3:9]", True), ("b.bvh[:4]", True), ("b.bvh[5:7]", True), ("b.bvh", True)]
    + [("b.bvh[:3]", False), ("b.bvh[9:]", False), ("b.bvh[-4:]", True), ("ncs:walk", True), ("c.bvh", False)],
)
def test_what_a_run_was_trained_on_is_known_from_any_folder(tmp_path, monkeypatch, name, trained):
    monkeypatch.chdir(tmp_path)
    assert preview._is_trained_on((f"{tmp_path}/a.bvh", f"{tmp_path}/b.bvh[3:9]", "ncs:walk"), name) == trained


def test_progress_in_a_terminal_of_80_columns_is_whole():
    console = Console(file=StringIO(), force_terminal=True, width=80, height=30, legacy_windows=False, _environ={})
    parts = " ".join(f"{name} 1.23e-05" for name in ("bending", "collision", "gravity", "hold", "membrane", "inertia"))
    with WorkProgress("reading the scene", console=console) as progress:
        progress.say("step 200: validation total 1.3 J, strain 4.7 %, penetrating 0.3 % of vertices, and more than a line")
        progress.show("step 200/5000", 200, 5000, f"total 1.2753 J ({parts})", "strain 2.7 %", left=3725)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue())
    lines = [line.strip() for line in re.split(r"[\r\n]+", text)]
    bar = next(line for line in lines if line.startswith("step 200/5000, 1:02:05 left"))
    assert bar.endswith("4% 0:00:00") and len(bar) <= 80
    assert re.sub(r"\s+", " ", text).count(f"total 1.2753 J ({parts}) strain 2.7 %") == 1  # words are not cut


def test_progress_in_a_file_is_lines_as_time_goes_by(monkeypatch):
    console, now = Console(file=StringIO(), width=80), [0.0]
    monkeypatch.setattr("ncs_jax.cli.progress.time.monotonic", lambda: now[0])
    with WorkProgress("reading", console=console) as progress:
        for frame in range(1, 25):
            now[0] += 3.0
            progress.show(f"frame {frame}/24", frame, 24, "x" * 100, left=None)
    lines = console.file.getvalue().splitlines()
    told = [int(re.match(r"frame (\d+)/24  x{100}$", line)[1]) for line in lines[1:]]
    assert lines[0] == "reading ..." and told == [1, 5, 9, 13, 17, 21, 24]


def test_a_wait_is_told_with_its_seconds_until_something_is_shown(monkeypatch):
    monkeypatch.setattr("ncs_jax.cli.progress.EVERY", 0.02)
    console = Console(file=StringIO(), width=80)

    def wait(line):
        end = time.monotonic() + 5
        while line not in console.file.getvalue() and time.monotonic() < end:
            time.sleep(0.005)
        return console.file.getvalue().splitlines()

    with WorkProgress("reading", console=console) as progress:
        assert wait("reading, 0:00")[:2] == ["reading ...", "reading, 0:00"]
        progress.begin("compiling")
        wait("compiling, 0:00")
        progress.show("drawing", 0.25, 1.0)
        shown = wait("drawing  25%")
        time.sleep(0.1)
        assert console.file.getvalue().splitlines() == shown
    assert shown[-1] == "drawing  25%" and "compiling ..." in shown


@pytest.mark.parametrize("name", ["a.pc2", "a.usdc", "frames"])
def test_a_body_in_a_format_without_one_is_refused_before_the_run_is_read(run_folder, tmp_path, capsys, monkeypatch, name):
    monkeypatch.setattr("ncs_jax.runs.run.load_run", None)
    assert main(["animate", str(run_folder[1]), "--body", "--out", str(tmp_path / name)]) == 2
    one_line(capsys, [".glb expected", name])


PLACES = {  # below a file, whoever tries; or what is there already
    "animate": "file/a.npz", "animate --adapt 20": "file/b/a.glb", "animate --adapted c --adapt 20": "full", "simulate": "full",
    "simulate --body": "taken.glb", "export": "file/a.onnx", "export --format web": "file/a.html", "preview": "file/b",
}  # fmt: skip


@pytest.mark.parametrize("line", PLACES)
def test_a_place_that_cannot_be_written_is_refused_before_any_work(run_folder, tmp_path, capsys, monkeypatch, line):
    monkeypatch.setattr("ncs_jax.runs.run.load_run", None)
    monkeypatch.setattr("ncs_jax.runs.simulate.simulate", None)
    (tmp_path / "file").write_text("in the way")
    for name in ("full", "taken.glb"):
        (tmp_path / name).mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    command, *options = line.split()
    target, before = str(run_folder[command != "simulate"]), sorted(tmp_path.rglob("*"))
    assert main([command, target, *options, "--out", str(tmp_path / PLACES[line])]) == 2
    words = {"full": "an empty or new folder expected (found 'letter.txt')", "taken.glb": "a file expected (found 'a folder')"}
    one_line(capsys, [words.get(PLACES[line], f"{tmp_path / 'file'} is not a folder")])
    assert sorted(tmp_path.rglob("*")) == before


READ = {
    "animate RUN --out": "cloth.npz",
    "animate RUN --motion DIR/swing.npz[0:5] --out": "swing.npz",
    "animate RUN --adapt 20 --out": "body.npz",
    "simulate SCENE --out": "cloth.npz",
    "body --body DIR/body.glb --out": "body.glb",
    "fit DIR/cloth.npz --body DIR/body.npz --out": "cloth.npz",
    "fit DIR/cloth.npz --body ncs:body --from DIR/body.npz --out": "body.npz",
}


@pytest.mark.parametrize("line", READ)
def test_what_is_read_is_not_written_over(run_folder, capsys, line):
    scene, folder = run_folder
    file = scene.parent / READ[line]
    if not file.exists():
        file.write_bytes(b"a body")
    before = file.read_bytes()
    places = {"RUN": str(folder), "SCENE": str(scene)}
    words = [places.get(word, word.replace("DIR", str(scene.parent))) for word in line.split()]
    assert main([*words, str(file)]) == 2
    one_line(capsys, [f"--out: another file than those that are read expected (found '{file}'); give another name"])
    assert file.read_bytes() == before


@pytest.mark.parametrize(("command", "drawn"), [("animate", ".mp4, .png, "), ("simulate", "")])
def test_an_unknown_suffix_is_told_all_that_the_command_writes(run_folder, tmp_path, capsys, command, drawn):
    target = str(run_folder[command == "animate"])
    assert main([command, target, "--out", str(tmp_path / "a.abc")]) == 2
    one_line(capsys, ["a.abc: one of .npz, .h5, .hdf5, .pc2, .mdd, ", f".glb, {drawn}or a folder", "found '.abc'"])


def test_animate_draws_the_moments_that_are_asked_for(run_folder, tmp_path, capsys):
    folder, picture = str(run_folder[1]), tmp_path / "new" / "a.png"
    sizes = []
    for more in ([], ["--frames", "3", "23", "--checker"]):
        assert main(["animate", folder, "--out", str(picture), *more]) == 0
        with Image.open(picture) as drawn:
            sizes.append(drawn.size)
    assert re.findall(r"(\d+) of 24 frames", capsys.readouterr().out) == ["8", "2"]
    assert sizes[0][0] > 3 * sizes[1][0] > 300
    assert main(["animate", folder, "--out", str(picture), "--frames", "24"]) == 2
    one_line(capsys, ["--frames: frames 0 to 23 of the motion expected (found 24)"])
    assert main(["animate", folder, "--out", str(tmp_path / "a.npz"), "--frames", "2"]) == 2
    one_line(capsys, ["a.npz: --frames: .png expected"])
    assert main(["animate", folder, "--out", str(picture), "--body"]) == 2
    one_line(capsys, ["a.png: --body: .glb expected"])


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.pc2", "a.mdd", "a.usdc", "a.glb", "frames"])
def test_animate_in_every_format(run_folder, tmp_path, capsys, name):
    _, folder = run_folder
    assert main(["animate", str(folder), "--out", str(tmp_path / name), "--alpha", "1.5"]) == 0
    said = capsys.readouterr().out
    assert "24 frames" in said and ("Forward Z, Up -Y" in said) == (name in ("a.pc2", "a.mdd"))
    assert (tmp_path / name).exists()
    if name == "a.glb":
        assert (tmp_path / name).read_bytes()[:4] == b"glTF"
    elif name != "frames":
        assert io.read_animation(tmp_path / name).vertices.shape == (24, 30, 3)
    else:
        assert len(list((tmp_path / name).glob("*.obj"))) == 24


def test_animate_with_the_body(run_folder, tmp_path, capsys):
    _, folder = run_folder
    assert main(["animate", str(folder), "--out", str(tmp_path / "a.glb"), "--body"]) == 0
    run = load_run(folder)
    theirs = skinned(tmp_path / "a.glb", np.arange(24) / run.assembly.model.fps)
    ours = body_vertices(run.assembly.body, run.motion(run.assembly.scene.motion.files[0]))
    assert np.abs(ours - theirs).max() < 1e-5
    data = (tmp_path / "a.glb").read_bytes()
    parts = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert [mesh["name"] for mesh in parts["meshes"]] == ["cloth", "body"]  # as their files are
    assert main(["animate", str(folder), "--out", str(tmp_path / "a.usdc"), "--body"]) == 2
    one_line(capsys, ["a.usdc", ".glb", "body"])


def test_evaluate_a_run_and_the_animation_it_wrote(run_folder, tmp_path, capsys):
    scene, folder = run_folder
    assert main(["evaluate", str(folder), "--json"]) == 0
    (whole,) = json.loads(capsys.readouterr().out).values()
    assert len(whole["frames"]["total"]) == 24 and {"strain_mean", "penetrating", "out_of_balance"} <= set(whole["mean"])
    run = load_run(folder)
    (name,) = run.assembly.scene.motion.files
    rows = run.evaluate(name)
    assert not {"skin_pixels", "skin_share", "body_intersecting", "self_intersecting"} & set(run.evaluate(name, seen=0))
    for seen in ("skin_pixels", "skin_share", "body_intersecting", "self_intersecting"):  # of one frame in five
        assert len(whole["frames"][seen]) == 5 and whole["frames"][seen] == rows[seen].tolist(), seen
    assert main(["animate", str(folder), "--as-trained", "--out", str(tmp_path / "a.npz")]) == 0
    assert main(["animate", str(folder), "--out", str(tmp_path / "out.npz")]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "out.npz"), "--scene", str(scene), "--json"]) == 0
    (out,) = json.loads(capsys.readouterr().out).values()
    assert out["mean"]["depth_max"] < 0.8 * whole["mean"]["depth_max"], "cloth is put out of the body"
    assert main(["evaluate", str(tmp_path / "a.npz"), "--scene", str(scene), "--json"]) == 0
    (again,) = json.loads(capsys.readouterr().out).values()
    assert whole["mean"].pop("gain") > 0  # over what alpha = 0 gives, which a file does not tell
    assert whole["mean"].pop("outside") == 0 == whole["beyond"]["outside"]  # of what the run was trained on
    assert whole["beyond"]["strain"] == pytest.approx(1, abs=0.1) and not whole["beyond"]["told"]
    assert run.trained.strain == pytest.approx(whole["mean"]["strain_mean"], rel=0.1)
    for name, value in whole["mean"].items():
        assert again["mean"][name] == pytest.approx(value, rel=2e-3, abs=1e-3), name
    assert main(["evaluate", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "strain_mean [%]" in text and "out_of_balance [g]" in text and "skin_share [%], " in text
    assert main(["evaluate", str(tmp_path / "a.npz")]) == 2
    one_line(capsys, ["--scene"])


def test_a_run_without_motions_asks_for_one(run_folder, tmp_path, capsys):
    _, folder = run_folder
    run = shutil.copytree(folder, tmp_path / "run")
    facts = json.loads((run / "run.json").read_text())
    facts["scene"]["motion"] |= {"files": [], "validation": []}
    (run / "run.json").write_text(json.dumps(facts))
    for command in (["evaluate", str(run)], ["animate", str(run), "--out", str(tmp_path / "x.npz")]):
        assert main(command) == 2
        assert capsys.readouterr().err == "ncs: --motion: a motion is needed; give one: the scene has none\n"


def test_evaluate_of_all_motions_tells_the_deepest_of_them(run_folder, tmp_path, monkeypatch, capsys):
    _, folder = run_folder
    np.savez(tmp_path / "nods.npz", **swing(size=3.0))
    motions = (*load_run(folder).assembly.scene.motion.files, str(tmp_path / "nods.npz"))
    monkeypatch.setattr("ncs_jax.scene.spec.Scene.motions", motions)
    assert main(["evaluate", str(folder)]) == 0
    said = capsys.readouterr()
    assert "nods.npz: " in said.err and "beyond the poses and speeds that the run was trained on" in said.err
    told, quantity = {}, ""
    for line in said.out.splitlines():
        if line.startswith("  "):
            told[quantity].append(float(line.split()[-1]))
        else:
            told[quantity := line.split()[0].rstrip(",")] = []
    *each, every = told["depth_max"]
    assert every == max(each) > min(each)
    *each, every = told["strain_mean"]
    assert every == pytest.approx(np.mean(each), rel=1e-3)


def test_evaluate_beside_a_reference(run_folder, tmp_path, capsys):
    _, folder = run_folder
    assert main(["animate", str(folder), "--as-trained", "--out", str(tmp_path / "a.npz")]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(folder), "--reference", str(tmp_path / "a.npz"), "--json"]) == 0
    (same,) = json.loads(capsys.readouterr().out).values()
    assert same["mean"]["distance"] < 1e-3 and same["mean"]["dynamic_share"] == pytest.approx(1, abs=1e-4)
    assert main(["evaluate", str(folder), "--alpha", "3", "--reference", str(tmp_path / "a.npz")]) == 0
    text = capsys.readouterr().out
    assert "dynamic_share, speed over" in text and "hem_correlation" in text and "distance [mm]" in text
    io.write_animation(tmp_path / "b.npz", np.zeros((7, 30, 3), np.float32), grid()[1], 30.0)
    assert main(["evaluate", str(folder), "--reference", str(tmp_path / "b.npz")]) == 2
    one_line(capsys, ["b.npz", "vertices", "(7, 30, 3)", "--motion"])


def test_an_animation_of_another_motion_is_refused(run_folder, tmp_path, capsys):
    scene, _ = run_folder
    io.write_animation(tmp_path / "b.npz", np.zeros((7, 30, 3), np.float32), grid()[1], 30.0)
    assert main(["evaluate", str(tmp_path / "b.npz"), "--scene", str(scene)]) == 2
    one_line(capsys, ["b.npz", "vertices", "(7, 30, 3)", "--motion"])


def test_animate_with_a_smaller_decoder_tells_the_error(run_folder, tmp_path, capsys):
    _, folder = run_folder
    assert main(["animate", str(folder), "--out", str(tmp_path / "a.npz")]) == 0
    assert "mm" not in capsys.readouterr().out
    assert main(["animate", str(folder), "--out", str(tmp_path / "b.npz"), "--rank", "3", "--bfloat16"]) == 0
    told = capsys.readouterr().out
    a, b = (io.read_animation(tmp_path / name).vertices for name in ("a.npz", "b.npz"))
    apart = 1000 * np.linalg.norm(a - b, axis=-1)
    assert apart.max() > 0 and f"{apart.mean():.2g} mm from the whole decoder, {apart.max():.2g} at most" in told
    assert main(["animate", str(folder), "--out", str(tmp_path / "c.npz"), "--rank", "1000"]) == 2
    one_line(capsys, ["--rank", "1000"])
    assert not (tmp_path / "c.npz").exists()


def test_export_says_what_it_wrote_and_how_far_it_is(run_folder, tmp_path, capsys):
    _, folder = run_folder
    out = tmp_path / "step.onnx"
    assert main(["export", str(folder), "--out", str(out), "--rank", "3", "--opset", "17"]) == 0
    text = capsys.readouterr().out
    assert f"{out}: onnx, opset 17" in text and f"{out}.json says how" in text
    assert "24 frames" in text and "ms each; at most" in text and "mm from the whole network" in text
    beyond = json.loads(Path(f"{out}.json").read_text())["beyond"]
    assert beyond["motion"].endswith("swing.npz") and beyond["outside"] == 0 and not beyond["told"]
    assert main(["export", str(folder), "--out", str(tmp_path / "step"), "--format", "stablehlo"]) == 0
    text = capsys.readouterr().out
    assert "stablehlo" in text and "whole" not in text and (tmp_path / "step.json").exists()
    assert main(["export", str(folder), "--out", str(out), "--rank", "1000"]) == 2
    one_line(capsys, ["--rank", "1000"])
    assert main(["export", str(folder), "--out", str(out), "--opset", "3"]) == 2
    one_line(capsys, ["--opset", "13 to 21", "3"])
    assert main(["export", str(folder), "--out", str(tmp_path / "a.foo")]) == 2
    one_line(capsys, ["a.foo", ".onnx"])
    assert main(["export", str(folder), "--out", str(tmp_path / "a.stablehlo")]) == 2
    one_line(capsys, ["a.stablehlo", "--format stablehlo"])
    assert not list(tmp_path.glob("a.*"))


def test_export_writes_a_page_that_runs_the_garment(run_folder, tmp_path, capsys, monkeypatch):
    _, folder = run_folder
    out = tmp_path / "page.html"
    monkeypatch.chdir(tmp_path)
    web = ["export", str(folder), "--format", "web"]
    assert main([*web, "--out", str(out)]) == 2
    one_line(capsys, ["--runtime", "npm pack onnxruntime-web"])
    package(tmp_path / "node_modules" / "onnxruntime-web")
    assert main([*web, "--out", str(tmp_path / "page.onnx")]) == 2
    one_line(capsys, ["page.onnx", ".html"])
    assert main([*web, "--out", str(out), "--opset", "17"]) == 2
    one_line(capsys, ["--opset", "17", "leave it out"])
    assert main(["export", str(folder), "--out", str(tmp_path / "a.onnx"), "--refine", "2"]) == 2
    one_line(capsys, ["--refine", "--format web"])
    assert not list(tmp_path.glob("*.*"))
    assert main([*web, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert f"{out}: " in text and "1 motion; open it in a browser" in text and "24 frames of its network" in text
    (name,) = [motion["name"] for motion in Page(out).scene["live"]["motions"]]
    assert name.endswith("swing.npz")


def test_animate_a_motion_from_the_current_folder(run_folder, tmp_path, capsys, monkeypatch):
    _, folder = run_folder
    np.savez(tmp_path / "other.npz", **swing(frames=9))
    monkeypatch.chdir(tmp_path)
    assert main(["animate", str(folder), "--motion", "other.npz", "--out", "c.npz"]) == 0
    said = capsys.readouterr().out
    assert "9 frames" in said and "at risk" not in said
    leap = swing(frames=9)
    leap["trans"][4:, 0] = 0.7
    np.savez(tmp_path / "leap.npz", **leap)
    assert main(["animate", str(folder), "--motion", "leap.npz", "--out", "c.npz"]) == 0
    assert "at risk   jump within a frame: 0.70 m in leap.npz, frame 4" in capsys.readouterr().out
    assert main(["animate", str(folder), "--motion", "other.npz[2:-1]", "--out", "c.npz"]) == 0
    assert "6 frames" in capsys.readouterr().out
    assert main(["animate", str(folder), "--motion", "nowhere.npz", "--out", "d.npz"]) == 2
    one_line(capsys, ["nowhere.npz"])
    assert main(["animate", str(folder), "--motion", "other.npz[2:30]", "--out", "d.npz"]) == 2
    one_line(capsys, ["other.npz: frames", "(2, 30)"])
    assert main(["animate", str(folder), "--out", "d.gif"]) == 2
    one_line(capsys, ["d.gif", ".npz"])


def test_animate_tells_where_skin_shows(run_folder, tmp_path, capsys, monkeypatch):
    """Of what is written, in frames evenly spread and the one that is most beyond the training."""
    _, folder = run_folder
    looked = []

    def shown(model, x, body, frames):
        looked.append((x, body, frames))
        return SkinShown(len(x), 1, frames[-1], 25, 0)

    monkeypatch.setattr("ncs_jax.metrics.seen.LOOKED_AT", 3)
    monkeypatch.setattr("ncs_jax.metrics.seen.shown_skin", shown)
    monkeypatch.setattr("ncs_jax.metrics.coverage.Coverage.worst", (7, "joint", "pose"))
    np.savez(tmp_path / "other.npz", **swing(frames=9))
    out = tmp_path / "c.npz"
    assert main(["animate", str(folder), "--motion", str(tmp_path / "other.npz"), "--out", str(out)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "skin shows in 1 of 4 frames that were looked at, most in frame 7: 25 pixels of six views" in said
    ((x, body, frames),) = looked
    assert list(frames) == [0, 3, 6, 7] and body.shape[1] == load_run(folder).assembly.model.body.shape[0]
    np.testing.assert_allclose(x, np.load(out)["vertices"][frames], atol=1e-6)


@pytest.mark.parametrize("whole", [False, True])
def test_animate_tells_in_a_line_how_a_motion_was_brought_onto_the_skeleton(capsys, monkeypatch, whole):
    monkeypatch.setattr("ncs_jax.prepare.scene_checks.motion_risks", lambda _: [])
    retargeted = "retargeted by joint names, 3 of the body's 4 joints are driven, of these by one of another name: a by b"
    notes = ("its take walk is read", retargeted, "the lowest sole is as high as at rest")
    motions = {"many": SimpleNamespace(notes=notes), "one": SimpleNamespace(notes=notes[:1]), "none": SimpleNamespace(notes=())}
    animate._tell_motions(SimpleNamespace(motions=motions), whole)
    said = capsys.readouterr().out.splitlines()
    line = "retargeted by joint names, 3 of the body's 4 joints are driven; --notes prints all 3 lines on it"
    expected = ["motion    " + notes[0], *(" " * 10 + note for note in notes[1:])] if whole else ["motion    " + line]
    assert said == [f"  {words}" for words in (*expected, "motion    " + notes[0])]


@pytest.mark.parametrize("file", ["run.json", "prepared.npz"])
def test_a_damaged_run_is_refused(run_folder, tmp_path, capsys, file):
    copy = tmp_path / "run"
    shutil.copytree(run_folder[1], copy)
    truncated(copy / file)
    assert main(["evaluate", str(copy)]) == 2
    one_line(capsys, [file, "train again"])


def test_a_damaged_checkpoint_is_refused(run_folder, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run_folder[1], copy)
    for path in (copy / "checkpoints" / "10").rglob("d/*"):
        truncated(path)
    done = process("evaluate", copy)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()  # and nothing of the arrays that were still being read
    assert line.startswith(f"ncs: {copy / 'checkpoints' / '10'}: the checkpoint cannot be read")


def test_a_body_file_that_is_not_one(tmp_path, capsys):
    scene = write_scene(tmp_path)
    arrays = post()
    del arrays["parents"]
    np.savez(tmp_path / "body.npz", **arrays)
    assert main(["check", str(scene)]) == 2
    one_line(capsys, ["body.npz", "parents"])


def test_the_picture_of_a_check_shows_what_is_at_risk_and_else_what_moves():
    sizes = {"a": 0, "b": 2, "a[3:9]": 1}
    motion = {name: SimpleNamespace(poses=np.array([[[0.0]], [[size]]]), uncertain={}) for name, size in sizes.items()}
    risk = lambda *names: [SimpleNamespace(motion=name) for name in names]  # noqa: E731
    first = lambda *names: check._worst_first([["a", "b"], ["a[3:9]"]], SimpleNamespace(motions=motion), risk(*names))  # noqa: E731
    assert first() == [["b", "a"], ["a[3:9]"]]
    assert first("a") == [["a", "b"], ["a[3:9]"]]
    assert first("a[3:9]") == [["a[3:9]"], ["b", "a"]]

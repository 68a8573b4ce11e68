"""Really run what the README and the pages show, at small sizes, in a temporary folder: the second half of `tools.run_docs`.

The files that a page takes for granted (a trained run, a character, a capture) are made first, from the packaged ones.
Trainings have 3 steps and simulations 3 frames. The packaged T-shirt stands in for the benchmark scene. Only read, not run:
commands for several hosts, installations, tests, and what is not complete in running text. `make` is asked what it would do. A
command that occurs twice is run once a page.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

import numpy as np

from ncs_jax.errors import required
from tools.run_docs import ROOT, Sample, command_fault, samples, written_out

STEPS = "3"
RUNS = ("RUN", "runs/demo", "runs/tshirt", "runs/skirt", "runs/shirt")
BENCHMARK = "experiments/benchmark.toml"
NAMES = {"SCENE": "ncs:tshirt", "GARMENT": "shirt.obj", "BODY": "character.glb", "FILE": "walk.npz", BENCHMARK: "ncs:tshirt"}
ELSEWHERE = ("--hosts", "--format web", "hero_ncs", "blender_addon")  # other machines, a package of npm, Blender
SHORT = """[garment]
file = "ncs:skirt"
pins = "pins"
[motion]
files = ["ncs:walk"]
frames = [0, 3]
[physics.collision]
distance = "smooth"
"""
BVH = """HIERARCHY
ROOT Hips
{ OFFSET 0 95 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
%s}
MOTION
Frames: 8
Frame Time: 0.033333
%s
"""


def follow(chosen: Sequence[Path], *, experiments: bool = False) -> list[str]:
    """Run what the pages show, in their order, and return what went wrong, one line each.

    `experiments`: run these and the benchmarks too, which have tests of their own at their smallest size.
    """
    found = []
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        furnish()
        for page in chosen:
            names: dict = {}
            done: set[str] = set()
            for sample in samples(str(page.relative_to(ROOT)), page.read_text(encoding="utf-8")):
                again = sample.text in done
                done.add(sample.text)
                if not again and (why := _followed(sample, names, experiments)) is not None:
                    print(f"{sample}{': ' if why else ''}{why}", flush=True)
                    found += [f"{sample}: {why}"] if why else []
    return found


def furnish() -> None:
    """Make the files that the pages name: runs, a garment, a character that moves, a capture, a simulation."""
    from ncs_jax import io, train
    from ncs_jax.io.packaged import packaged

    run = train("ncs:tshirt", RUNS[0], steps=int(STEPS))
    for name in RUNS[1:]:
        shutil.copytree(RUNS[0], name)
    shirt = io.read_garment(packaged("tshirt"))
    lines = [f"v {x} {y} {z}" for x, y, z in shirt.vertices] + [f"f {a} {b} {c}" for a, b, c in shirt.faces + 1]
    Path("shirt.obj").write_text("\n".join(lines) + "\n")
    garment, motion = run.animate("ncs:walk"), run.motion("ncs:walk")
    worn_by = required(run.assembly.body, "body"), motion
    io.write_animation("character.glb", garment, shirt.faces, 30.0, rest=shirt.vertices, worn_by=worn_by)
    io.write_animation("walk.npz", garment, shirt.faces, 30.0, rest=shirt.vertices)
    Path("dance.bvh").write_text(capture())
    Path("short.toml").write_text(SHORT)
    for name in ("src", "benchmarks", "Makefile", "pyproject.toml"):
        Path(name).symlink_to(ROOT / name)
    Path("docs").mkdir()
    shutil.copy(ROOT / "docs" / "host_loop.py", "docs")


def capture() -> str:
    """Return a capture of legs and arms that swing, in centimetres."""

    def chain(names: Sequence[str], offsets: Sequence[str]) -> str:
        text = "{ OFFSET 0 -5 0 }\n"
        for name, offset in zip(reversed(names), reversed(offsets), strict=True):
            kind = "End Site" if name == "End" else f"JOINT {name}"
            channels = "" if name == "End" else "CHANNELS 3 Zrotation Xrotation Yrotation\n"
            text = f"{kind}\n{{ OFFSET {offset}\n{channels}{'' if name == 'End' else text}}}\n"
        return text

    inner, joints = "", 1
    for side, sign in (("Left", 1), ("Right", -1)):
        inner += chain(
            [f"{side}UpLeg", f"{side}Leg", f"{side}Foot", "End"], [f"{9 * sign} -5 0", "0 -42 0", "0 -42 0", "0 -6 12"]
        )
        joints += 3
    arms = ""
    for side, sign in (("Left", 1), ("Right", -1)):
        arms += chain([f"{side}Arm", f"{side}ForeArm", "End"], [f"{18 * sign} 20 0", f"{28 * sign} 0 0", f"{25 * sign} 0 0"])
        joints += 2
    head = chain(["Head", "End"], ["0 28 0", "0 18 0"])
    inner += f"JOINT Spine\n{{ OFFSET 0 20 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n{arms}{head}}}\n"
    joints += 2
    rows = [[0, 95, t, *np.round(10 * np.sin(t + np.arange(3 * joints)), 3)] for t in range(8)]
    return BVH % (inner, "\n".join(" ".join(map(str, row)) for row in rows))


def _followed(sample: Sample, names: dict, experiments: bool) -> str | None:
    """Run a sample; return what went wrong, empty where nothing did, None where it is not run."""
    try:
        if sample.kind == "python":
            return _run_python(sample, names)
        if sample.kind == "toml":
            first = sample.text.splitlines()[0]
            if first.startswith("# ") and first.endswith(".toml"):
                Path(first[2:]).write_text(sample.text)
                return ""
            return None
        if sample.kind == "sh" or not command_fault(next(iter(written_out(sample.text))), lenient=False):
            return _run_command(sample, experiments)
    except (Exception, SystemExit) as error:  # whatever a reader would see
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {error} ({where.filename}:{where.lineno})"
    return None


def _run_python(sample: Sample, names: dict) -> str:
    """Run a block after those before it on its page, with trainings of a few steps."""
    import ncs_jax

    train = ncs_jax.train

    def short(scene, out, **options):
        shutil.rmtree(out, ignore_errors=True)
        return train(scene, out, steps=int(STEPS))

    with mock.patch.object(ncs_jax, "train", short):
        exec(compile(sample.text, f"{sample.page}:{sample.line}", "exec"), names)
    return ""


def _run_command(sample: Sample, experiments: bool) -> str | None:
    elsewhere = any(word in sample.text for word in ELSEWHERE)
    if sample.text.startswith(("srun", "CUDA_VISIBLE_DEVICES")) or elsewhere:
        return None
    words = [NAMES.get(word, word) for word in next(iter(written_out(sample.text)))]
    program, *rest = words
    if program == "make":
        return _shell(["make", "-n", *rest])
    if program == "python" and rest[0] == "-m":
        tested = rest[1].startswith("tests.") or rest[1] == "tools.run_docs"
        if not experiments:
            tested |= rest[1].startswith(("experiments", "benchmarks"))
        return None if tested else _module(rest[1:])
    if program == "python":
        return _shell([sys.executable, *rest])
    if program != "ncs" or not rest or "--help" in rest or rest == ["check"] or rest[0] == "stream":  # which is not complete
        return None
    return _viewed(rest) if rest[0] == "view" else _ncs(rest)


def _ncs(rest: list[str]) -> str:
    """Run a command in this process, so that nothing is compiled twice; a training has few steps."""
    from ncs_jax.cli import main

    if rest[0] == "demo":
        rest = ["train", "ncs:demo", "--out", "runs/demo", "--preview"]
    if rest[0] == "train":
        for option in ("--minutes", "--steps"):
            if option in rest:
                at = rest.index(option)
                del rest[at : at + 2]
        folder = Path(rest[rest.index("--out") + 1])
        more = "6" if "--resume" in rest else STEPS
        if "--resume" not in rest:
            shutil.rmtree(folder, ignore_errors=True)
        rest = [*rest, "--steps", more]
    if rest[0] == "simulate":  # a frame takes seconds
        return _simulated(rest)
    if "--out" in rest and rest[rest.index("--out") + 1] == NAMES["FILE"]:
        rest[rest.index("--out") + 1] = {"export": "out.onnx"}.get(rest[0], "out.npz")
    elif NAMES["FILE"] in rest and "--motion" not in rest:  # which is of this motion
        rest = [*rest, "--motion", "ncs:walk"]
    return "" if main(rest) == 0 else "exit code 2"


def _simulated(rest: list[str]) -> str:
    """Simulate a few frames; where the page names a motion and goes on with all of it, an animation stands in for the file."""
    from ncs_jax.cli import main

    out = rest[rest.index("--out") + 1]
    out = "out.npz" if out == NAMES["FILE"] else out
    code = main(["simulate", "short.toml", "--out", out])
    if code == 0 and "--motion" in rest and rest[1] == "ncs:tshirt" and Path("runs/tshirt").exists():
        code = main(["animate", "runs/tshirt", "--motion", rest[rest.index("--motion") + 1], "--out", out])
    return "" if code == 0 else "exit code 2"


def _viewed(rest: list[str]) -> str:
    """Serve a page until it says where."""
    command = [sys.executable, "-m", "ncs_jax.cli", *rest, "--port", "8123"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as served:
        try:
            line = next((line for line in required(served.stdout, "stdout") if "http" in line), "")
        finally:
            served.terminate()
    return "" if line else "no page was served"


def _module(words: list[str]) -> str:
    """Run a module at its smallest size, with its results in this folder."""
    name, *rest = words
    told = subprocess.run([sys.executable, "-m", name, "--help"], capture_output=True, text=True, cwd=ROOT, check=False).stdout
    more = [option for option in ("--quick",) if option in told]
    more += ["--out", "out"] if "--out" in told and "--out" not in rest else []
    return _shell([sys.executable, "-m", name, *rest, *more])


def _shell(command: list[str]) -> str:
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    return "" if done.returncode == 0 else f"exit code {done.returncode}: {done.stderr.strip().splitlines()[-1:]}"

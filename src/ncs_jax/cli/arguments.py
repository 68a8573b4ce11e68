"""Declare commands, and read the values of their options."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from ncs_jax.errors import InputError, check_alpha

__all__ = [
    "BLENDER",
    "FORMATS",
    "add_adapting",
    "add_alpha",
    "add_body",
    "as_options",
    "body_of",
    "body_table",
    "check_adapted",
    "check_file",
    "check_motions",
    "check_not_read",
    "check_run",
    "check_scene_kept",
    "command",
    "finite",
    "hosts",
    "mesh_names",
    "positive",
    "seed",
    "tell_written",
    "whole",
]

BLENDER = (
    "  in Blender's Mesh Cache: Forward Z, Up -Y (on an object that is turned by 90 degrees about X, as an .obj's import does: "
    "Forward Y, Up Z); Start Frame: the action's first; object at the origin, scale 1"
)
OPTIONS = {
    "body.file": "--body",
    **{f"body.{name}": f"--{name}" for name in ("part", "betas")},
    **{f"body.{name}": f"--body-{name}" for name in ("scale", "up", "fps", "mesh")},
    **{f"garment.{name}": f"--{name}" for name in ("mesh", "scale", "up", "weld")},
}  # what stands for the field of a scene
MOVING = ("scale", "up", "fps", "mesh")  # what a scene says of a body that is a mesh for each frame
NEGATIVE = re.compile(r"-([.,]?\d|inf\b|nan\b)")  # as numbers below 0 begin, and no option
FORMATS = ".npz, .h5, .pc2, .mdd, .glb, .usd, .usdc, .usda, .usdz, or a folder of .obj"


def command(commands, name: str, run: Callable, text: str) -> argparse.ArgumentParser:
    """Add a command that calls `run` with its options, and return its parser."""
    parser = commands.add_parser(name, help=text, description=text)
    parser.set_defaults(run=run)
    parser._negative_number_matcher = NEGATIVE  # argparse takes -0,5 and -1e-3 for options
    return parser


def add_body(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which body is meant."""
    parser.add_argument("--body", default="ncs:body", metavar="FILE", help="body file (default: ncs:body, the packaged one)")
    parser.add_argument("--part", nargs="+", default=[], metavar="NAME", help="meshes of the file that are the body")
    parser.add_argument(
        "--betas", nargs="+", type=finite, default=[], metavar="B", help="shape of an SMPL model (default: mean)"
    )
    mesh = parser.add_argument_group("a body that is a mesh for each frame (folder of .obj, .npz, .h5, .pc2, .mdd, USD)")
    mesh.add_argument(
        "--body-scale",
        type=partial(positive, of="metres a unit"),
        default=0.0,
        metavar="M",
        help="metres a unit, 0.01 for cm (default: 1)",
    )
    mesh.add_argument("--body-up", choices=("x", "y", "z"), default="", help="the axis that is up in it (default: y)")
    mesh.add_argument(
        "--body-fps",
        type=partial(positive, of="frames a second"),
        default=0.0,
        metavar="N",
        help="frames per second, for the scene",
    )
    mesh.add_argument("--body-mesh", default="", metavar="FILE", help="mesh with the faces of a .pc2 or .mdd")


def add_adapting(parser: argparse.ArgumentParser) -> None:
    """Add the options with which a run is adapted to the motion first."""
    parser.add_argument(
        "--adapt", type=partial(positive, of="seconds"), metavar="SECONDS",
        help="first train on the motion itself for so many seconds, say 20, from the run's weights; the run stays as it is",
    )  # fmt: skip
    parser.add_argument("--adapted", metavar="RUN", help="folder of the adapted run (default: RUN_adapted_MOTION beside RUN)")


def add_alpha(parser: argparse.ArgumentParser) -> None:
    """Add the option that sets how much a garment moves."""
    parser.add_argument(
        "--alpha", type=_alpha, default=1.0, help="how much the garment moves: 0 static, 1 as trained, more exaggerates; to 10"
    )


def _alpha(text: str) -> float:
    value = _number(text, "a finite number", math.isfinite)
    try:
        check_alpha(value)
    except InputError as error:
        raise argparse.ArgumentTypeError(f"{error.expected}, found {text}; {error.mend}") from None
    return value


def check_motions(scene) -> None:
    """Raise an InputError where a scene has a character and no motion to train on: nothing that moves would be learned."""
    if not scene.motion.files and scene.body.file not in ("", "none") and not scene.moves_by_itself:
        mend = 'name one, as "walk.fbx" or "ncs:walk"; ncs simulate --motion takes one besides'
        raise InputError("a motion to train on expected", file=scene.source, field="motion.files", value=[], mend=mend)


def check_adapted(options) -> None:
    """Raise an InputError where the folder of an adapted run is named, and nothing is to be adapted."""
    if options.adapted and options.adapt is None:
        there = (Path(options.adapted) / "run.json").exists()
        mend = f"add --adapt 20, or give {options.adapted} as the RUN" if there else "add --adapt 20"
        raise InputError("--adapt expected beside it", field="--adapted", value=options.adapted, mend=mend)


def check_file(name: str) -> None:
    """Raise an InputError where a file or folder is not there: at once, before JAX is imported, which takes seconds."""
    if not name.startswith("ncs:") and not Path(name).exists():
        raise InputError("no such file", file=name, mend="check the path")


def check_not_read(out: str, *read: str | Path) -> None:
    """Raise an InputError where a file that is to be written is one of those that are read: it would be gone."""
    place = Path(out).expanduser()
    for name in read:
        file = Path(re.sub(r"(\.\w+)(#[^/]*)?(\[[^/]*\])?$", r"\1", str(name))).expanduser()  # without an animation and frames
        if place.exists() and file.exists() and place.samefile(file):
            raise InputError(
                "another file than those that are read expected",
                field="--out",
                value=out,
                mend="give another name: this one is read",
            )


def check_scene_kept(out: str, scene, *motions: str) -> None:
    """Raise an InputError where a file that is to be written is one that a scene, or a motion beside it, is read from."""
    given = scene.body.file, scene.body.mesh, scene.garment.file, *scene.garment.over, *scene.garment.layers, *scene.motions
    own = [scene.path(name) for name in given if name not in ("", "none") and not name.startswith("ncs:")]
    files: tuple[str | Path, ...] = (out,)
    if scene.garment.layers:
        from ncs_jax.io.animation.animation import animation_files

        files = animation_files(out, mesh_names(scene)[:-1])
    for file in files:
        check_not_read(str(file), *filter(None, [scene.source]), *own, *motions)


def tell_written(files: Sequence[Path], frames: int, fps: float, ends: Sequence[int], more: str = "") -> None:
    """Print what was written: of garments in a file each, up to which vertex each goes; and how Blender reads a Mesh Cache."""
    first = (0, *ends[:-1]) if len(files) > 1 else (0,)
    for file, start, end in zip(files, first, ends[-len(files) :], strict=True):
        print(f"{file}: {frames} frames at {fps:g} per second, {end - start} vertices{more}")
    if files[0].suffix.lower() in (".pc2", ".mdd"):
        print(BLENDER)


def check_run(folder: str) -> None:
    """Raise an InputError where a folder is not a run's: at once, as `check_file`."""
    if not (Path(folder) / "run.json").exists():
        raise InputError("no run there", file=Path(folder) / "run.json", mend="give a folder that ncs train made")


@contextmanager
def as_options() -> Iterator[None]:
    """Name options in errors that name the fields of a scene which they stand for."""
    try:
        yield
    except InputError as error:
        if error.field not in OPTIONS:
            raise
        mend = re.sub(r"\b(?:body|garment)\.\w+", lambda found: OPTIONS.get(found[0], found[0]), error.mend or "")
        if "body.shapes" in mend:  # which no option gives
            mend = "leave it out: the file alone says what shape it has"
        expected = error.expected.replace("this field", "this option")
        raise InputError(expected, file=error.file, field=OPTIONS[error.field], value=error.value, mend=mend) from None


def body_of(options):
    """Return the body that the options of `add_body` mean."""
    from ncs_jax.prepare.garment_checks import check_body_size

    with as_options():
        body = _body_of(options)
    check_body_size(options.body, body)
    return body


def _body_of(options):
    from ncs_jax import io

    own = {name: getattr(options, f"body_{name}") for name in MOVING}
    if io.is_moving_body(options.body):
        for name in ("part", "betas"):
            if value := getattr(options, name):
                raise InputError("a character expected for this option", field=f"--{name}", value=value, mend="leave it out")
        from ncs_jax.prepare.curve_skeleton import with_curve_skeleton

        return with_curve_skeleton(io.read_moving_body(options.body, **own | {"mesh": own["mesh"] or None}))
    for name, value in own.items():
        if value:
            raise InputError(
                "a mesh for each frame expected for this option", field=f"--body-{name}", value=value, mend="leave it out"
            )
    return io.read_body(options.body, betas=options.betas, part=options.part)


def _from(file: str, folder: Path) -> str:
    """Return a file's path as a scene in a folder names it."""
    return file if file.startswith("ncs:") or Path(file).is_absolute() else os.path.relpath(file, folder).replace(os.sep, "/")


def body_table(options, folder: Path) -> str:
    """Return the lines of a scene file in a folder that mean the body of these options."""
    lines = [f"[body]\nfile = {json.dumps(_from(options.body, folder))}"]
    lines += [f"{name} = {json.dumps(value)}" for name in ("part", "betas") if (value := getattr(options, name))]
    own = {name: getattr(options, f"body_{name}") for name in MOVING}
    if own["mesh"]:
        own["mesh"] = _from(own["mesh"], folder)
    lines += [f"{name} = {json.dumps(value)}" for name, value in own.items() if value]
    return "\n".join(lines)


def mesh_names(scene) -> tuple[str, ...]:
    """Return what a scene's garments and body are called where a file names its meshes: as their own files, if these differ."""
    from ncs_jax.io.mesh.joined import garment_names

    garments = garment_names((scene.garment.file, *scene.garment.layers))
    (body,) = garment_names([scene.body.file])
    return ("garment", "body") if garments == [body] else (*garments, "body" if body in garments else body)


def positive(text: str, of: str = "") -> float:
    """Return a number above 0; `of` says what it counts, as seconds."""
    return _number(text, f"a number {f'of {of} ' if of else ''}above 0", lambda value: 0 < value < math.inf)


def whole(text: str, least: int = 1) -> int:
    """Return a whole number, at least 1."""
    return int(_number(text, f"a whole number from {least}", lambda value: value >= least, int))


def seed(text: str) -> int:
    """Return a seed, 0 to 2^31 - 1."""
    return int(_number(text, f"a whole number from 0 to {2**31 - 1}", lambda value: 0 <= value < 2**31, int))


def finite(text: str) -> float:
    """Return a finite number."""
    return _number(text, "a finite number", math.isfinite)


def _number(text: str, expected: str, good: Callable[[float], bool], kind: type[float] | type[int] = float) -> float:
    """Return the number that a text is, or say what is expected; of one with a comma, how it is written with a point."""
    try:
        value = kind(text)
    except ValueError:
        meant = ""
        if re.fullmatch(r"-?\d{1,3}(,\d{3})+", text) and kind is int:
            meant = f"; write {text.replace(',', '')}, without commas"
        elif re.fullmatch(r"-?\d*,\d+", text) and kind is float:
            meant = f"; write {text.replace(',', '.')}, with a point"
        raise argparse.ArgumentTypeError(f"{expected} expected, found {text}{meant}") from None
    if not good(value):
        raise argparse.ArgumentTypeError(f"{expected} expected, found {text}")
    return value


def hosts(text: str) -> dict:
    """Return the arguments of `jax.distributed.initialize`, none for `auto`."""
    if text == "auto":
        return {}
    found = re.fullmatch(r"(.+):(\d+),(\d+),(\d+)", text)
    if not found or not 0 < int(found[2]) < 65536 or int(found[4]) >= int(found[3]):
        raise argparse.ArgumentTypeError(f"HOST:PORT,COUNT,RANK with RANK below COUNT, or auto, expected, found {text}")
    every = {"cluster_detection_method": "deactivate"}  # all devices of this host, whoever started the command
    address = f"{found[1]}:{found[2]}"
    return {"coordinator_address": address, "num_processes": int(found[3]), "process_id": int(found[4]), **every}

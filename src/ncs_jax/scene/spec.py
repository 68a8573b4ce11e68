"""Scene files: one TOML file that describes body, garment, motion, physics, network and training, checked field by field."""

from __future__ import annotations

import dataclasses
import json
import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ncs_jax.errors import InputError
from ncs_jax.scene.motion_lists import each_motion
from ncs_jax.scene.motion_names import LISTS, named_motions, split_frames, with_settings
from ncs_jax.scene.parsing import checked_value, parse_table, read_toml

__all__ = [
    "PRESETS",
    "BendingSpec",
    "BodySpec",
    "CollisionSpec",
    "GarmentSpec",
    "MembraneSpec",
    "MotionSpec",
    "NetworkSpec",
    "PhysicsSpec",
    "PinningSpec",
    "Scene",
    "SelfContactSpec",
    "SimulationSpec",
    "TrainingSpec",
    "load_scene",
    "scene_from",
    "template",
]


def _f(default: Any, text: str, *, low: float = -math.inf, high: float = math.inf, choices: tuple = (), **marks: bool):
    """Return a field with its help text and range.

    Of the marks, `above` excludes the lower end, and `each` lets a motion's own table override the field.
    """
    meta = {"help": text, "low": low, "high": high, "choices": choices, "above": False, "each": False} | marks
    if isinstance(default, list | dict):
        return field(default_factory=lambda: default, metadata=meta)
    if isinstance(default, type):
        return field(default_factory=default, metadata=meta)
    return field(default=default, metadata=meta)


def _listed(names: tuple[str, ...] | str) -> tuple[str, ...]:
    """Return names as a tuple; one may stand by itself."""
    return names if isinstance(names, tuple) else (names,) if names else ()


@dataclass(frozen=True)
class BodySpec:
    """[body]: the character."""

    file: str = _f("ncs:body", "body file, ncs:NAME for a packaged one, a mesh for each frame, or 'none' for no body")
    joints: tuple[str, ...] = _f((), "names or numbers of joints that the network reads; empty: those that move the garment")
    part: tuple[str, ...] | str = _f("auto", "auto: the garment touches what it can reach; all; or names of the meshes to read")
    betas: tuple[float, ...] | str = _f(
        (), 'shape of an SMPL model; empty: the mean; "motion": as the motions say', choices=("motion",)
    )
    shapes: dict[str, float] = _f({}, "weights of blend shapes by name (glTF, FBX); others as in the file")
    correctives: bool = _f(True, "use the pose correctives of an SMPL model that has some")
    fps: float = _f(0.0, "of a mesh for each frame: frames per second; 0: as the file says", low=0, high=1e6)
    scale: float = _f(0.0, "of a mesh for each frame: metres a unit, 0.01 for cm; 0: as the file says, else 1", low=0, high=1e6)
    up: str = _f("", "of a mesh for each frame: the axis that is up; empty: as USD says, else y", choices=("", "x", "y", "z"))
    mesh: str = _f("", "the faces of a .pc2 or .mdd: a mesh file of the same vertices")

    @property
    def meshes(self) -> tuple[str, ...]:
        """Return the names of the meshes to read, none for all."""
        return () if self.part in ("auto", "all", "") else _listed(self.part)


@dataclass(frozen=True)
class GarmentSpec:
    """[garment]: what the character wears."""

    file: str = _f("ncs:tshirt", "garment mesh in its rest shape on the resting body")
    mesh: tuple[str, ...] | str = _f((), "names of the garment's meshes, in a file that holds several objects")
    scale: float = _f(0.0, "metres a unit of the file, 0.01 for cm; 0: as the file says, else 1", low=0, high=1e6)
    up: str = _f("", "axis that is up in the file; empty: as the file says, else y", choices=("", "x", "y", "z"))
    weld: float = _f(0.0, "merge vertices within this distance of each other, m; 0: none", low=0, high=1)
    smoothing: int = _f(10, "how often each vertex's skinning weights become its neighbours' mean", low=0, high=10000)
    pins: str = _f("", "name of the vertex group that is pinned; empty: none")
    learn_weights: bool = _f(False, "train the skinning weights too")
    over: tuple[str, ...] = _f((), "run folders of trained garments worn below this one; they collide as part of the body")
    layers: tuple[str, ...] = _f(
        (), "garments worn over `file`, outwards, FILE or FILE#MESH: one model with it, in which each feels the others"
    )

    @property
    def meshes(self) -> tuple[str, ...]:
        """Return the names of the garment's meshes, none where none is named."""
        return _listed(self.mesh)


@dataclass(frozen=True)
class MotionSpec:
    """[motion]: what the character does."""

    files: tuple[str, ...] = _f(
        ("ncs:walk",),
        "motions to train on: FILE, FILE[10:300], FOLDER, *.bvh, LIST.txt; empty: none, for cloth without a character",
    )
    validation: tuple[str, ...] = _f((), "motions to validate on, not to train on")
    fps: float = _f(30.0, "frames per second of the physics", low=1, high=1000)
    mirror: bool = _f(False, "train on the mirror image of every motion too")
    frames: tuple[int, ...] = _f(
        (), "first frame to use of every file, and the frame to stop before; empty: all frames", low=0, high=10**9, each=True
    )
    scale: float = _f(0.0, "metres a unit of the files; 0: 1, or by the legs for another skeleton", low=0, high=1e6, each=True)
    up: str = _f("auto", "axis that points up in the files; auto: as found", choices=("auto", "x", "y", "z"), each=True)
    rest: str = _f(
        "auto", "pose in which a skeleton of the files is a person: auto; zero; or the number of a frame in T-pose", each=True
    )
    joints: dict[str, str] = _f(
        {}, 'the body\'s joint for a joint of a motion, where names do not tell; "" for none', each=True
    )
    broken: str = _f("refuse", "motions that cannot be used: refuse the scene; or skip them", choices=("refuse", "skip"))
    own: dict[str, dict[str, Any]] = field(default_factory=dict, metadata={"internal": True})  # by motion, what its table says
    found: tuple[str, ...] = field(default=(), metadata={"internal": True})  # in words, what names of many motions stand for
    lone: bool = field(default=False, metadata={"internal": True})  # one motion, which `joints` need not be meant for


@dataclass(frozen=True)
class MembraneSpec:
    """[physics.membrane]: resistance to stretch and shear."""

    model: str = _f("stvk", "membrane model", choices=("stvk", "neo_hookean", "baraff_witkin", "mass_spring", "none"))
    lam: float = _f(41.8, "Lame parameter lambda times thickness, N/m (stvk, neo_hookean)", low=0, high=1e9)
    mu: float = _f(22.2, "Lame parameter mu times thickness, N/m (stvk, neo_hookean)", low=0, high=1e9)
    stretch: float = _f(40.0, "stretch stiffness, N/m (baraff_witkin)", low=0, high=1e9)
    shear: float = _f(20.0, "shear stiffness, N/m (baraff_witkin)", low=0, high=1e9)
    stiffness: float = _f(60.0, "spring stiffness, N/m (mass_spring)", low=0, high=1e9)


@dataclass(frozen=True)
class BendingSpec:
    """[physics.bending]: resistance to bending."""

    stiffness: float = _f(1e-5, "bending stiffness, N m; 0: no bending", low=0, high=1e6)


@dataclass(frozen=True)
class CollisionSpec:
    """[physics.collision]: contact with the body."""

    stiffness: float = _f(10.0, "k_c, J/m^2 a vertex; 0: no collision", low=0, high=1e9)
    thickness: float = _f(0.004, "distance to keep from the body, m", low=0, high=0.1)
    distance: str = _f("plane", "signed distance to the body", choices=("plane", "smooth", "triangle"))
    search: str = _f("exact", "search for the nearest feature", choices=("exact", "candidates"))
    points: str = _f("0", "points inside an edge that touch too; auto: as the body's curves ask", choices=("auto", *"0123"))
    friction: float = _f(0.0, "coefficient of friction between garment and body; 0: none", low=0, high=10)
    reach: float = _f(0.08, "the body can be touched within this distance of the skinned garment, m", low=0.005, high=10)


@dataclass(frozen=True)
class SelfContactSpec:
    """[physics.self_contact]: contact of the garment with itself."""

    stiffness: float = _f(0.0, "k_s, J/m^2 a pair; 0: cloth passes through cloth", low=0, high=1e9)
    thickness: float = _f(0.003, "distance to keep between cloth and cloth, m", low=0, high=0.1, above=True)


@dataclass(frozen=True)
class PinningSpec:
    """[physics.pinning]: springs that hold pinned vertices."""

    stiffness: float = _f(1000.0, "k_p, N/m a pinned vertex", low=0, high=1e9)


@dataclass(frozen=True)
class PhysicsSpec:
    """[physics]: what the garment is made of, in SI units."""

    gravity: tuple[float, ...] = _f((0.0, -9.81, 0.0), "gravity, m/s^2", low=-1000, high=1000)
    density: float = _f(0.15, "mass per area, kg/m^2", low=1e-4, high=1e3)
    inertia: bool = _f(True, "mass resists acceleration")
    membrane: MembraneSpec = _f(MembraneSpec, "")
    bending: BendingSpec = _f(BendingSpec, "")
    collision: CollisionSpec = _f(CollisionSpec, "")
    pinning: PinningSpec = _f(PinningSpec, "")
    self_contact: SelfContactSpec = _f(SelfContactSpec, "")


@dataclass(frozen=True)
class NetworkSpec:
    """[network]: the method, and the sizes of its networks."""

    method: str = _f("ncs", "ncs; pbns, of the pose alone; snug, one recurrent network", choices=("ncs", "pbns", "snug"))
    descriptor: str = _f("heading_free", "pose descriptor", choices=("heading_free", "six", "quaternion", "axis_angle"))
    static: tuple[int, ...] = _f((64, 128, 256), "layer sizes, static encoder; snug takes the last", low=1, high=65536)
    joint: tuple[int, ...] = _f((32, 32), "layer sizes, dynamic encoder, each joint by itself", low=1, high=65536)
    dynamic: tuple[int, ...] = _f((256, 256), "layer sizes, dynamic encoder, all joints; snug's encoder", low=1, high=65536)
    cell: str = _f("auto", "what ncs remembers by, see docs/choosing.md", choices=("auto", "gated", "linear", "swing"))
    vibrations: int = _f(12, "number of the garment's vibrations that a swing cell moves", low=1, high=256)
    damping: float = _f(1.0, "damping of a swing cell, 1/s", low=0, high=1e6)
    decoder: tuple[int, ...] = _f((256, 256, 256), "layer sizes, decoder", low=1, high=65536)
    modes: int = _f(128, "smooth modes of the garment that the decoder also moves; 0: none", low=0, high=4096)


@dataclass(frozen=True)
class TrainingSpec:
    """[training]: the optimisation."""

    steps: int = _f(5000, "optimiser steps", low=1, high=10_000_000)
    batch: int = _f(32, "windows in a step", low=1, high=65536)
    window: int = _f(11, "frames in a window; with inertia at least 3 are taken", low=1, high=10000)
    learning_rate: float = _f(1e-3, "Adam's peak step size", low=0, high=1, above=True)
    motion_augmentation: float = _f(0.0, "share of a batch that gets another window's motion", low=0, high=1)
    recombined: float = _f(0.0, "share of a batch in poses put together of the motions' limbs", low=0, high=0.9)
    focus: float = _f(0.0, "share of a batch from the frames in which contact costs most", low=0, high=0.9)
    untangling: float = _f(0.0, "J/m of the curves along which the garment passes through itself", low=0, high=1e6)
    validate_every: int = _f(200, "steps between validations", low=1, high=10_000_000)
    checkpoint_every: int = _f(200, "steps between checkpoints", low=1, high=10_000_000)
    seed: int = _f(0, "seed of all random numbers", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class SimulationSpec:
    """[simulation]: how `ncs simulate` solves a frame."""

    solver: str = _f("newton", "newton for accuracy, quasi_newton for speed", choices=("newton", "quasi_newton"))
    tolerance: float = _f(0.1, "out-of-balance acceleration to stop at, g", low=1e-9, high=1e6)
    precision: str = _f("auto", "auto: double where single cannot reach the tolerance", choices=("auto", "single", "double"))
    iterations: int = _f(100, "iterations in a step, at most", low=1, high=1_000_000)
    substeps: int = _f(1, "time steps in a frame", low=1, high=1000)
    pins: str = _f("springs", "how pins are held", choices=("springs", "exact"))


@dataclass(frozen=True)
class Scene:
    """A validated scene. `source` is the file it came from; relative paths resolve from its folder."""

    body: BodySpec = _f(BodySpec, "")
    garment: GarmentSpec = _f(GarmentSpec, "")
    motion: MotionSpec = _f(MotionSpec, "")
    physics: PhysicsSpec = _f(PhysicsSpec, "")
    network: NetworkSpec = _f(NetworkSpec, "")
    training: TrainingSpec = _f(TrainingSpec, "")
    simulation: SimulationSpec = _f(SimulationSpec, "")
    source: str = field(default="", metadata={"internal": True})

    def path(self, name: str) -> Path:
        """Return the path of a file that this scene names."""
        if name.startswith("ncs:"):
            from ncs_jax.io.packaged import packaged

            return packaged(name[4:])
        path = Path(name).expanduser()
        return path if path.is_absolute() or not self.source else Path(self.source).parent / path

    def there(self, name: str, field: str) -> Path:
        """Return the path of a file that a field of this scene names.

        Raises:
            InputError: there is none.
        """
        path = self.path(name)
        if name.startswith("ncs:") or path.exists() or ("#" in path.name and Path(str(path).rpartition("#")[0]).exists()):
            return path  # the file, or an animation or a mesh in it
        seen = "" if Path(name).is_absolute() else f"; it is seen from {Path(self.source).parent.absolute()}"
        if field.startswith("motion.") and self.motion.found:  # "FILE: 3 motions"
            seen += f", or what lists it: {', '.join(note.rpartition(': ')[0] for note in self.motion.found)}"
        raise InputError("no such file or folder", file=self.source, field=field, value=name, mend=f"check the path{seen}")

    def motion_file(self, name: str) -> tuple[Path, MotionSpec]:
        """Return the path of a motion, and its settings: the scene's, but for frames in its name and `own_settings`."""
        file, frames = split_frames(name)
        own = self.own_settings(name) | ({} if frames is None else {"frames": frames})
        return self.path(file), dataclasses.replace(self.motion, **own)

    def own_settings(self, name: str) -> dict[str, Any]:
        """Return the settings that a motion has in place of the scene's: what its table says.

        A motion that the scene does not name, or not with these frames, is taken whole: `frames` are of the scene's own files.
        A packaged one knows its unit, axis and zero pose.
        """
        if name in self.motions:
            return self.motion.own.get(name, {})
        file, frames = split_frames(name)
        path = self.path(file).resolve()
        alike = [own for own in self.motions if self.path(split_frames(own)[0]).resolve() == path]  # by another path, too
        own = self.motion.own.get(alike[0], {}) if alike else {}
        if frames is None and alike and split_frames(alike[0])[1] is None:
            return own
        known = ("frames", "scale", "up", "rest") if not alike and name.startswith("ncs:") else ("frames",)
        return own | {key: getattr(MotionSpec(), key) for key in known}

    @property
    def moves_by_itself(self) -> bool:
        """Tell whether the body is a mesh for each frame, which needs no motion: see `io.read_moving_body`."""
        from ncs_jax.io.character.moving_body import is_moving_body

        return self.body.file not in ("", "none") and is_moving_body(self.path(self.body.file))

    @property
    def motions(self) -> tuple[str, ...]:
        """Return the names of all motions, those to train on first."""
        return (*self.motion.files, *self.motion.validation)

    def without_network(self) -> Scene:
        """Return the scene without what only a network needs, for a simulation or for an animation that exists already."""
        return dataclasses.replace(self, network=dataclasses.replace(self.network, method="pbns", modes=0))

    def to_dict(self) -> dict:
        """Return plain tables, as in the file, with absolute paths, so that the scene can be rebuilt from any folder."""
        tables = dataclasses.asdict(self)
        del tables["source"]

        def absolute(name):
            return name if name.startswith("ncs:") or name in ("", "none") else str(self.path(name).resolve())

        tables["body"] |= {name: absolute(tables["body"][name]) for name in ("file", "mesh")}
        tables["garment"]["file"] = absolute(tables["garment"]["file"])
        for each in ("over", "layers"):
            tables["garment"][each] = [absolute(name) for name in tables["garment"][each]]
        own, _, _ = (tables["motion"].pop(name) for name in ("own", "found", "lone"))
        for key in LISTS:
            given = [(name, split_frames(name)[0]) for name in tables["motion"][key]]
            tables["motion"][key] = [
                with_settings(absolute(file) + name.removeprefix(file), own.get(name, {})) for name, file in given
            ]
        return tables


PRESETS: dict[str, dict] = {
    "fast": {
        "network": {"static": (64, 128, 128), "dynamic": (128, 128), "decoder": (128, 128, 128), "modes": 64},
        "training": {"steps": 2000},
    },
    "balanced": {
        "network": {"static": (64, 128, 256), "dynamic": (256, 256), "decoder": (256, 256, 256), "modes": 128},
        "training": {"steps": 5000},
    },
    "accurate": {
        "network": {"static": (64, 128, 256), "dynamic": (256, 256), "decoder": (256, 256, 256), "modes": 128},
        "training": {"steps": 15000},
    },
}  # values that `ncs train --preset` puts in place of a scene's own; experiments/speed_accuracy.py measures them


def load_scene(path: str | Path, preset: str | None = None) -> Scene:
    """Read and check a scene file; `ncs:NAME` names a packaged scene.

    Args:
        path: the file. preset: one of PRESETS, whose values replace the scene's own.

    Raises:
        InputError: the file is missing or not TOML, a key is unknown, or a value has the wrong type or is out of its range.
    """
    file = Path(path)
    if str(path).startswith("ncs:"):
        from ncs_jax.io.packaged import packaged

        file = packaged(str(path)[4:], ".toml")
    elif file.exists() and file.suffix.lower() != ".toml":
        kind = "a folder" if file.is_dir() else f"a {file.suffix or 'file without suffix'}"
        mend = "of a garment, ncs fit writes one; of a run, ncs view and ncs evaluate read its folder"
        raise InputError("a scene file that ends in .toml expected", file=file, value=kind, mend=mend)
    if not (tables := read_toml(file)):
        mend = 'write [garment] and file = "...", or let ncs fit write it; ncs:tshirt is a packaged one'
        raise InputError("a scene expected", file=file, value="an empty file", mend=mend)
    if preset is not None and preset not in PRESETS:
        raise InputError(f"one of {', '.join(PRESETS)} expected", field="preset", value=preset)
    for table, values in PRESETS[preset].items() if preset else ():
        if isinstance(own := tables.get(table, {}), dict):
            tables[table] = {**own, **values}
    return scene_from(tables, source=str(file))


def scene_from(tables: dict, source: str = "") -> Scene:
    """Return a scene from plain tables, which are checked like a file."""
    own: dict[str, dict[str, Any]] = {}
    if isinstance(motion := tables.get("motion"), dict):
        kinds, fields = typing.get_type_hints(MotionSpec), {f.name: f.metadata for f in dataclasses.fields(MotionSpec)}
        each = tuple(name for name, meta in fields.items() if meta.get("each"))
        check = lambda name, value, where: checked_value(kinds[name], value, fields[name], source or "scene", where)  # noqa: E731
        motion, own = named_motions(motion, source or "scene", check, each)
        tables = {**tables, "motion": motion}
    scene = dataclasses.replace(parse_table(Scene, tables, source or "scene", ""), source=source)
    if "files" not in tables.get("motion", {}) and scene.moves_by_itself:
        scene = dataclasses.replace(scene, motion=dataclasses.replace(scene.motion, files=()))
    gravity = scene.physics.gravity
    if len(gravity) != 3:
        raise InputError("three numbers expected", file=source, field="physics.gravity", value=list(gravity))
    if len(scene.motion.frames) > 2:
        raise InputError("one or two numbers expected", file=source, field="motion.frames", value=list(scene.motion.frames))
    for name in ("static", "decoder"):
        if not getattr(scene.network, name):
            raise InputError("at least one layer expected", file=source, field=f"network.{name}", value=[])
    if scene.network.cell == "linear" and scene.network.static[-1] % 2:
        raise InputError("an even last size expected", file=source, field="network.static", value=list(scene.network.static))
    if scene.garment.file in ("", "none"):
        raise InputError("a garment is needed", file=source, field="garment.file", value=scene.garment.file)
    found = each_motion({key: getattr(scene.motion, key) for key in LISTS}, own, scene.path, source)
    motion = dataclasses.replace(scene.motion, files=found.files, validation=found.validation, own=found.own, found=found.told)
    return dataclasses.replace(scene, motion=motion)


def template() -> str:
    """Return a whole scene file: every field with its default, and in a comment its meaning and its range."""
    return "\n".join(_tables(Scene(), "")).strip() + "\n"


def _tables(spec, where: str) -> Iterator[str]:
    """Yield the lines of a table's own fields, then those of the tables in it."""
    fields = [f for f in dataclasses.fields(spec) if not f.metadata.get("internal")]
    nested = [f for f in fields if dataclasses.is_dataclass(getattr(spec, f.name))]
    if where:
        yield f"\n[{where}]"
    for f in fields:
        if f not in nested:
            value, meta = getattr(spec, f.name), f.metadata
            text = f"{f.name} = {json.dumps(value)}"
            note = meta["help"]
            if meta["choices"] and isinstance(value, str):
                note += ": " + ", ".join(meta["choices"])
            elif math.isfinite(meta["low"]):
                note += f"; {'above' if meta['above'] else 'from'} {meta['low']:.10g} to {meta['high']:.10g}"
            yield f"{text:36} # {note}"
    for f in nested:
        yield from _tables(getattr(spec, f.name), f"{where}.{f.name}".lstrip("."))

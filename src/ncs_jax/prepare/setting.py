"""A scene set up: its files read and checked against each other, and what is found out once from them.

That is all that a check needs. `build` adds what moves: features of the motions, the body's surface, the network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.enclosure import facing
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.prepare.constants import model_from
from ncs_jax.prepare.garment_checks import check_body_size, check_on_body
from ncs_jax.prepare.kept import kept
from ncs_jax.prepare.motion_import import load_motions
from ncs_jax.prepare.moving_body import check_character, moving_body
from ncs_jax.prepare.prepared import Prepared, SceneFiles, check_made_from, made_from, prepare_scene
from ncs_jax.prepare.skinning_weights import with_body_weights
from ncs_jax.scene.model import Layer, Model
from ncs_jax.scene.spec import Scene

__all__ = ["RECURRENT", "Below", "Setting", "cell_of", "read_worn", "set_up", "with_cell"]

RECURRENT = 1 / 15  # s: the shortest time step that a recurrence, whose inertia is of its own past, is safely trained at
Below = tuple[io.BodyRecord | None, Layer]  # a trained garment that is worn below, and the body that it was trained on


@dataclass(frozen=True)
class Setting:
    """A scene set up. `body` and `garment` are the records as read; `model` has neither the body's surface nor vibrations."""

    scene: Scene
    prepared: Prepared
    model: Model
    body: io.BodyRecord | None
    garment: io.GarmentRecord
    motions: dict[str, io.MotionRecord]


def set_up(
    scene: Scene,
    *,
    prepared: Prepared | None = None,
    below: Sequence[Below] = (),
    dtype=jnp.float32,
    report: Callable[[str], None] | None = None,
) -> Setting:
    """Read every file of a scene, check that they fit together, and find out what `Prepared` holds, vibrations aside.

    Args:
        scene, prepared, below, dtype, report: see `build.build`.

    Raises:
        InputError: a file is unusable or another than that of `prepared`, joint counts disagree, units are off, or the garment
            is not on the body.
    """
    say = report or (lambda words: None)
    say(f"reading {', '.join((scene.garment.file, *scene.garment.layers))} and {scene.body.file}")
    betas = _betas(scene) if prepared is None else prepared.betas
    files = _read(scene, betas, below, dtype)
    motions: dict[str, io.MotionRecord] = {}
    if prepared is not None:
        check_made_from(prepared, files)
    else:
        scene, motions = load_motions(scene, files.body, say)
        files = replace(files, scene=scene)
        say("preparing the garment")
        prepared = _prepared(files, [motions[name] for name in scene.motion.files])
        prepared = replace(prepared, betas=betas, **made_from(files))
    model = model_from(files, prepared, dtype)
    if scene.garment.layers and not (model.terms.layers or model.terms.self_contact):
        raise InputError(
            "contact expected, by which garments worn together feel each other", file=scene.source, field="garment.layers",
            value=scene.garment.layers, mend="put them on a body, with physics.collision.stiffness above 0",
        )  # fmt: skip
    automatic = scene.network.cell == "auto"
    scene = cell_of(with_cell(scene), not model.moves or model.terms.pinning or model.body is not None, automatic)
    return Setting(scene, prepared, model, files.body, files.garment, motions)


def _prepared(files: SceneFiles, motions: list[io.MotionRecord]) -> Prepared:
    """Return `prepare_scene`, kept from before; not over other garments, whose networks tell."""

    def make() -> dict[str, np.ndarray]:
        return {name: np.asarray(array) for name, array in vars(prepare_scene(files, motions)).items()}

    if files.layers:
        return prepare_scene(files, motions)
    records = [vars(record) for record in (files.garment, files.body, *motions) if record is not None]
    found = kept(tuple(f.name for f in fields(Prepared)), make, records, files.mesh, files.pins, str(files.scene.to_dict()))
    return Prepared(**required(found, "prepared"))


def with_cell(scene: Scene) -> Scene:
    """Return the scene with a cell in the place of "auto": the swing where a recurrence is at risk, else the gated one.

    That is where the time step is below `RECURRENT`, the cloth has inertia, and pins or a body hold it.
    """
    if scene.network.cell != "auto":
        return scene
    physics = scene.physics
    pinned = bool(scene.garment.pins) and physics.pinning.stiffness > 0
    held = pinned or (scene.body.file not in ("", "none") and physics.collision.stiffness > 0)
    short = 1 / scene.motion.fps < RECURRENT * (1 - 1e-6)
    swings = scene.network.method == "ncs" and physics.inertia and held and short
    return replace(scene, network=replace(scene.network, cell="swing" if swings else "gated"))


def cell_of(scene: Scene, hangs: bool, automatic: bool) -> Scene:
    """Return the scene with the gated cell in place of a swing that was chosen by itself and does not hang on anything.

    Raises:
        InputError: such a swing was asked for.
    """
    network = scene.network
    if hangs or network.method != "ncs" or network.cell != "swing" or not scene.physics.inertia:
        return scene
    if not automatic:
        raise InputError(
            "a garment that hangs on something, and swings, expected", file=scene.source, field="network.cell", value="swing",
            mend="it comes to no rest: pin it, put it on a body, or choose the gated or the linear cell",
        )  # fmt: skip
    return replace(scene, network=replace(network, cell="gated"))


def _betas(scene: Scene) -> np.ndarray:
    """Return the shape of the scene's body: its own betas, or those on which all its motions agree."""
    if not isinstance(scene.body.betas, str):
        return np.array(scene.body.betas, np.float64)
    found = {name: io.read_betas(scene.motion_file(name)[0]) for name in scene.motions}
    if not found:
        raise InputError(
            "a motion with betas expected", file=scene.source, field="body.betas", value=scene.body.betas, mend="write numbers"
        )
    first = next(iter(found))
    for name, betas in found.items():
        both = np.zeros((2, max(len(betas), len(found[first]))))
        both[0, : len(betas)], both[1, : len(found[first])] = betas, found[first]
        if np.abs(both[0] - both[1]).max(initial=0) > 1e-4:
            raise InputError(
                "motions of one person expected: their betas differ", file=scene.source, field="body.betas",
                value=f"{first} and {name}", mend="write the betas as numbers, or take motions of one person",
            )  # fmt: skip
    return np.trim_zeros(found[first], "b")


def _read(scene: Scene, betas: np.ndarray, below: Sequence[Below], dtype) -> SceneFiles:
    """Read the files of a scene but for its motions, and check that they fit together."""
    body, person, spec = None, scene.body, scene.garment
    if person.file not in ("", "none"):
        scene.there(person.file, "body.file")
    scene.there(spec.file, "garment.file")
    for i, name in enumerate(spec.layers):
        if name in ("", "none", spec.file, *spec.layers[:i]):
            raise InputError(
                "another garment expected", file=scene.source, field=f"garment.layers[{i}]", value=name,
                mend="name another file for each, or another mesh of it as FILE#MESH",
            )  # fmt: skip
        scene.there(name, f"garment.layers[{i}]")
    if scene.moves_by_itself:
        body = moving_body(scene)
    elif person.file not in ("", "none"):
        check_character(scene)
        body = io.read_body(
            scene.path(person.file),
            betas=betas.tolist(),
            shapes=person.shapes,
            part=person.meshes,
            correctives=person.correctives,
        )
    if body is not None:
        check_body_size(scene.path(scene.body.file), body)
    garment = read_worn(scene, body)
    pins, layers = _pins(scene, garment), _layers(scene, body, below, dtype)
    mesh = mesh_from(garment.vertices, garment.faces, uv=garment.uv, dtype=dtype)
    return SceneFiles(scene, body, garment, mesh, pins, layers)


def read_worn(scene: Scene, body: io.BodyRecord | None = None) -> io.GarmentRecord:
    """Return the garment of a scene, or all of those worn together as one, facing outward; with a body, on it."""
    names = scene.garment.file, *scene.garment.layers
    worn = [_read_garment(scene, place, body) for place in range(len(names))]
    return worn[0] if len(worn) == 1 else io.worn_together(names, [_outward(garment) for garment in worn])


def _outward(garment: io.GarmentRecord) -> io.GarmentRecord:
    """Return a garment whose triangles face outward."""
    if facing(garment.vertices, garment.faces) > 0:
        return garment
    uv = None if garment.uv is None else garment.uv[:, ::-1]
    note = "its triangles face inward: they were turned, as those of garments worn together all face outward"
    return replace(garment, faces=np.ascontiguousarray(garment.faces[:, ::-1]), uv=uv, notes=(*garment.notes, note))


def _read_garment(scene: Scene, place: int, body: io.BodyRecord | None) -> io.GarmentRecord:
    """Return one of the garments worn together, the first of them 0, on the body and with the weights of its joints, if any."""
    spec = scene.garment
    file, mesh, field = scene.path(spec.file), spec.meshes, "garment.mesh"
    if place:
        file, mesh, field = scene.path(spec.layers[place - 1]), (), f"garment.layers[{place - 1}]"
        if "#" in file.name and not file.exists():
            whole, _, own = str(file).rpartition("#")
            file, mesh = Path(whole), (own,)
    try:
        garment = io.read_garment(file, scale=spec.scale, up=spec.up, weld=spec.weld, mesh=mesh)
    except InputError as error:
        if not place or error.field != "garment.mesh":
            raise
        mend = (error.mend or "").replace("name ", f"write {file.name}#NAME, of ", 1)
        raise InputError(error.expected, file=file, field=field, value=error.value, mend=mend) from None
    if body is None:
        return garment
    garment = with_body_weights(garment, body)
    _check_garment(scene, file, garment, body)
    return garment


def _check_garment(scene: Scene, file: Path, garment: io.GarmentRecord, body: io.BodyRecord) -> None:
    """Raise an InputError unless the garment lies on the body, and its own weights, if any, are for the body's joints."""
    if garment.weights is not None and garment.weights.shape[1] != len(body.parents):
        raise InputError(
            f"a weight for each of the body's {len(body.parents)} joints expected", file=file, field="blend_weights",
            value=garment.weights.shape, mend="fit the garment to this body again: ncs fit",
        )  # fmt: skip
    told = {"axis_given": bool(scene.garment.up), "scale_given": bool(scene.garment.scale)}
    check_on_body(file, garment, body.vertices, **told)


def _pins(scene: Scene, garment: io.GarmentRecord) -> np.ndarray:
    """Return the numbers of the vertices in the group `garment.pins`, none where no group is named."""
    name = scene.garment.pins
    if not name:
        return np.zeros(0, np.int32)
    if name not in garment.groups:
        groups = ", ".join(garment.groups) or "none"
        raise InputError(
            "no such vertex group in the garment", file=scene.source, field="garment.pins", value=name,
            mend=f"name one of its groups: {groups}",
        )  # fmt: skip
    return np.asarray(garment.groups[name], np.int32)


def _layers(scene: Scene, body: io.BodyRecord | None, below: Sequence[Below], dtype) -> tuple[Layer, ...]:
    """Return the garments worn below, each checked against this scene."""
    found = []
    for i, (name, (other, worn)) in enumerate(zip(scene.garment.over, below, strict=True)):
        field, model = f"garment.over[{i}]", worn.model
        if body is None or other is None or not np.array_equal(other.vertices, body.vertices):
            raise InputError(
                "a garment on the same body expected", file=scene.source, field=field, value=name,
                mend="train it on the body that [body] names",
            )  # fmt: skip
        if model.fps != scene.motion.fps:
            raise InputError(
                f"a garment trained at {scene.motion.fps:g} frames per second expected", file=scene.source, field=field,
                value=model.fps, mend="give both scenes the same motion.fps",
            )  # fmt: skip
        layer = replace(worn, model=replace(model, body=None, body_blend=None, correctives=None, surface=None, under=()))
        found.append(jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, layer))
    return tuple(found)

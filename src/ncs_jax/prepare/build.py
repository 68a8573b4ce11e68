"""A scene made ready to run: read its files, check them, prepare, put the model together, choose the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax import io
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.network.methods.choose import network_from
from ncs_jax.network.methods.method import Method
from ncs_jax.network.rollout import animated
from ncs_jax.prepare.constants import model_from
from ncs_jax.prepare.garment_checks import check_on_body
from ncs_jax.prepare.mirroring import mirror_partners
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.prepared import Prepared, SceneFiles, prepare_scene
from ncs_jax.prepare.retarget import body_names
from ncs_jax.prepare.skinning_weights import with_body_weights
from ncs_jax.prepare.touchable import surface_of, touchable_faces
from ncs_jax.scene.features import MotionFeatures, mirror, motion_features
from ncs_jax.scene.model import Layer, Model, RitzModes, local_rotations
from ncs_jax.scene.spec import Scene

__all__ = ["Assembly", "build", "features_from_records"]

CELL = 8.0  # m; side of the grid from whose corners motions are measured


@dataclass(frozen=True)
class Assembly:
    """A scene made ready. `body` and `garment` are the records as read; `training_features` are what `track` gives."""

    scene: Scene
    prepared: Prepared
    model: Model
    network: Method
    body: io.BodyRecord | None
    garment: io.GarmentRecord
    training_features: MotionFeatures | None
    motions: dict[str, io.MotionRecord]

    @property
    def track(self) -> MotionFeatures:
        """Return all training motions end to end.

        Raises:
            InputError: the scene is that of a loaded run, which is made ready without them.
        """
        mend = "a loaded run has no training motions: assemble its scene, ncs_jax.assemble(run.assembly.scene)"
        return required(self.training_features, "track", mend)


def build(
    scene: Scene,
    *,
    prepared: Prepared | None = None,
    below: Sequence[tuple[Assembly, dict]] = (),
    dtype=jnp.float32,
    report: Callable[[str], None] | None = None,
) -> Assembly:
    """Read every file of a scene, check that they fit together, and precompute all that does not change.

    Args:
        scene: from `load_scene`. prepared: that of a run, which needs no training motion any more; None: it is found out here.
        below: the trained garments of `garment.over`, each with its parameters.
        dtype: of all arrays; float64 needs JAX's x64 mode. report: called with what is done next, in words.

    Raises:
        InputError: a file is unusable, joint counts disagree, units are off, or the garment is not on the body.
    """
    say = report or (lambda words: None)
    say(f"reading {scene.garment.file} and {scene.body.file}")
    betas = _betas(scene) if prepared is None else prepared.betas
    files = _read(scene, betas, below, dtype)
    motions: dict[str, io.MotionRecord] = {}
    training: list[io.MotionRecord] | None = None
    if prepared is None:
        for name in dict.fromkeys(scene.motions):
            say(f"reading {name}")
            motions[name] = load_motion(scene, name, files.body)
        say("preparing the garment")
        training = [motions[name] for name in scene.motion.files]
        prepared = replace(prepare_scene(files, training), betas=betas)
    model = model_from(files, prepared, dtype)
    track = None if training is None else _training_features(files, model, training)
    faces = None
    if model.body is not None and files.body is not None:
        faces = touchable_faces(model, files.body, prepared.part)
        model = replace(model, surface=surface_of(model, faces, track, scene.physics.collision.distance == "smooth"))
    if scene.network.method == "ncs" and scene.network.cell == "swing" and model.terms.inertia:
        if not prepared.vibrations.size:
            known = required(track, "vibrations", "train again into a new folder")
            prepared = _with_vibrations(scene, prepared, model, faces, known)
        vibrations = RitzModes(jnp.asarray(prepared.vibrations, dtype), jnp.asarray(prepared.energy, dtype))
        model = replace(model, vibrations=vibrations)
    return Assembly(scene, prepared, model, network_from(scene, model), files.body, files.garment, track, motions)


# --- read and check ---------------------------------------------------------------------------------------------------------


def _betas(scene: Scene) -> np.ndarray:
    """Return the shape of the scene's body: its own betas, or those on which all its motions agree."""
    if not isinstance(scene.body.betas, str):
        return np.array(scene.body.betas, np.float64)
    found = {name: io.read_betas(scene.path(name)) for name in scene.motions}
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


def _read(scene: Scene, betas: np.ndarray, below: Sequence[tuple[Assembly, dict]], dtype) -> SceneFiles:
    """Read the files of a scene but for its motions, and check that they fit together."""
    body, person, spec = None, scene.body, scene.garment
    if person.file not in ("", "none"):
        body = io.read_body(
            scene.path(person.file),
            betas=betas.tolist(),
            shapes=person.shapes,
            part=person.meshes,
            correctives=person.correctives,
        )
    garment = io.read_garment(scene.path(spec.file), scale=spec.scale, up=spec.up, weld=spec.weld, mesh=spec.meshes)
    if body is not None:
        garment = with_body_weights(garment, body)
    if body is not None:
        _check_body(scene.path(scene.body.file), body)
        _check_garment(scene, garment, body)
    pins, layers = _pins(scene, garment), _layers(scene, body, below, dtype)
    mesh = mesh_from(garment.vertices, garment.faces, uv=garment.uv, dtype=dtype)
    return SceneFiles(scene, body, garment, mesh, pins, layers)


def _check_body(file: Path, body: io.BodyRecord) -> None:
    """Raise an InputError unless the body has the size of a character in metres."""
    height = np.ptp(body.vertices, axis=0).max()
    if not 0.3 < height < 5:
        raise InputError(
            "a body in metres expected, 0.3 to 5 m tall", file=file, field="vertices", value=f"{height:.3g} m",
            mend="scale it to metres",
        )  # fmt: skip


def _check_garment(scene: Scene, garment: io.GarmentRecord, body: io.BodyRecord) -> None:
    """Raise an InputError unless the garment lies on the body, and its own weights, if any, are for the body's joints."""
    file = scene.path(scene.garment.file)
    if garment.weights is not None and garment.weights.shape[1] != len(body.parents):
        raise InputError(
            f"a weight for each of the body's {len(body.parents)} joints expected", file=file, field="blend_weights",
            value=garment.weights.shape, mend="fit the garment to this body again: ncs fit",
        )  # fmt: skip
    check_on_body(file, garment, body.vertices, axis_given=bool(scene.garment.up))


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


def _layers(scene: Scene, body: io.BodyRecord | None, below: Sequence[tuple[Assembly, dict]], dtype) -> tuple[Layer, ...]:
    """Return the garments worn below, each checked against this scene."""
    found = []
    for i, (name, (assembly, params)) in enumerate(zip(scene.garment.over, below, strict=True)):
        field, other, model = f"garment.over[{i}]", assembly.body, assembly.model
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
        alone = replace(model, body=None, body_blend=None, correctives=None, surface=None, under=())
        layer = Layer(alone, params, assembly.network)
        found.append(jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, layer))
    return tuple(found)


# --- what needs the motions -------------------------------------------------------------------------------------------------


def _training_features(files: SceneFiles, model: Model, motions: list[io.MotionRecord]) -> MotionFeatures:
    """Return the training motions end to end, with their mirror images if wanted; one frame at rest where there is none."""
    body = files.body
    if not motions:
        joints = 1 if body is None else len(body.parents)
        motions = [io.MotionRecord(np.zeros((1, joints, 3), np.float32), np.zeros((1, 3), np.float32), model.fps, ())]
    elif files.scene.motion.mirror and body is not None:
        try:
            partner, axis = mirror_partners(body_names(body), body.joints, body.parents)
        except InputError as error:
            raise InputError(
                error.expected, file=files.scene.source, field=error.field, value=error.value, mend=error.mend
            ) from None
        given = partner, axis, body.rest_rotations
        mirrored = [io.MotionRecord(*mirror(r.poses, r.translation, *given), r.fps, r.joint_names) for r in motions]
        motions = motions + mirrored
    return features_from_records(model, *motions)


def _with_vibrations(scene: Scene, prepared: Prepared, model: Model, faces, track: MotionFeatures) -> Prepared:
    """Add the garment's vibrations, found with smooth contact, because a simulation converges with no other."""
    from ncs_jax.simulation.ritz_modes import softest_ritz_modes

    if faces is not None:
        model = replace(model, terms=replace(model.terms, collision="smooth"), surface=surface_of(model, faces, track, True))
    found = softest_ritz_modes(model, track, scene.network.vibrations)
    if found is None:
        raise InputError(
            "a garment that hangs on something, and swings, expected", file=scene.source, field="network.cell", value="swing",
            mend="pin it, put it on a body, or choose the gated or the linear cell",
        )  # fmt: skip
    return replace(prepared, vibrations=np.asarray(found.directions), energy=np.asarray(found.energy))


def features_from_records(model: Model, *records: io.MotionRecord) -> MotionFeatures:
    """Return descriptors and transforms of motions that are at the model's frame rate, end to end.

    Each motion is measured from the corner, nearest to where it begins, of a grid of `CELL` m.
    """
    dtype = model.skeleton.joints.dtype
    lengths = [len(r.poses) for r in records]
    start = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    poses = jnp.asarray(np.concatenate([r.poses for r in records]).astype(dtype))
    origins = [CELL * np.round(r.translation[0].astype(np.float64) / CELL) for r in records]
    near = np.concatenate([r.translation - origin for r, origin in zip(records, origins, strict=True)])
    found = motion_features(
        model, local_rotations(model, poses), jnp.asarray(near.astype(dtype)), jnp.asarray(start, jnp.int32)
    )
    if model.under:
        layers = jnp.concatenate([_layer_transforms(layer, records, origins, dtype) for layer in model.under], axis=1)
        found = replace(found, matrices=jnp.concatenate([found.matrices, layers], axis=1))
    return replace(found, origin=jnp.asarray(np.repeat(origins, lengths, axis=0), dtype)) if np.any(origins) else found


def _layer_transforms(layer: Layer, records, origins, dtype) -> Float[Array, "frames verts 3 4"]:
    """Return what takes each vertex of a garment below from its rest to its place, measured from the motions' origins."""
    x = [
        animated(layer.model, layer.network, layer.params, features_from_records(layer.model, record)) - origin
        for record, origin in zip(records, origins, strict=True)
    ]
    offsets = jnp.asarray(np.concatenate(x), dtype) - layer.rest
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*offsets.shape[:2], 3, 3))
    return jnp.concatenate([eye, offsets[..., None]], axis=-1)

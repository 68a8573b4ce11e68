"""From a validated scene to the constants and motions that run: reads the files, checks that they fit, chooses what matters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax import io
from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.energies.terms import MEMBRANES, Garment, Material, Terms
from ncs_jax.errors import InputError
from ncs_jax.geometry.laplacian_modes import modal_basis
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.geometry.skinning import Skeleton, blend_from
from ncs_jax.network.methods.choose import network_from
from ncs_jax.network.methods.method import Method
from ncs_jax.network.rollout import animated
from ncs_jax.prepare.garment_checks import check_worn
from ncs_jax.prepare.motion_import import load_motion, mirror_partners
from ncs_jax.prepare.skinning_weights import smooth_weights, transfer_weights, used_joints
from ncs_jax.prepare.touchable import covered_by_layers, surface_of, touchable_faces, touchable_part
from ncs_jax.scene.features import MotionFeatures, mirror, motion_features
from ncs_jax.scene.model import Layer, Model, RitzModes, local_rotations
from ncs_jax.scene.spec import Scene

__all__ = ["Assembly", "Prepared", "build", "features_from_records"]


CELL = 8.0  # m


@dataclass(frozen=True)
class Prepared:
    """What is found out once from the files of a scene and then kept with a run.

    inputs: joints that the network reads, the root first. moves: whether the character ever moves. weights: the garment's
    skinning weights (verts, joints). part: the body vertices that the garment can touch. basis: its smooth modes, m.
    vibrations: the directions of a swing (verts, 3, modes), m, and energy: of each of them, J; none without one.
    """

    inputs: np.ndarray
    moves: np.ndarray
    weights: np.ndarray
    part: np.ndarray
    basis: np.ndarray
    vibrations: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 0), np.float32))
    energy: np.ndarray = field(default_factory=lambda: np.zeros(()))


@dataclass(frozen=True)
class Assembly:
    """A scene made ready. `body` and `garment` are the records as read; `track` holds all training motions end to end."""

    scene: Scene
    prepared: Prepared
    model: Model
    network: Method
    body: io.BodyRecord | None
    garment: io.GarmentRecord
    track: MotionFeatures | None
    motions: dict[str, io.MotionRecord]


def _check_fit(scene: Scene, garment: io.GarmentRecord, body: io.BodyRecord) -> None:
    tall = np.ptp(body.vertices, axis=0).max()
    if not 0.3 < tall < 5:
        raise InputError(
            "a body in metres expected, 0.3 to 5 m tall", file=scene.path(scene.body.file), field="vertices",
            value=f"{tall:.3g} m", mend="scale it to metres",
        )  # fmt: skip
    file = scene.path(scene.garment.file)
    if garment.weights is not None and garment.weights.shape[1] != len(body.parents):
        raise InputError(
            f"a weight for each of the body's {len(body.parents)} joints expected", file=file, field="blend_weights",
            value=garment.weights.shape, mend="fit the garment to this body again: ncs fit",
        )  # fmt: skip
    check_worn(file, garment, body.vertices, told=bool(scene.garment.up))


def _inputs(scene: Scene, body: io.BodyRecord, wanted: tuple[int, ...]) -> tuple[int, ...]:
    if not scene.body.joints:
        return wanted
    names = {n: i for i, n in enumerate(body.joint_names)}
    chosen = []
    for i, name in enumerate(scene.body.joints):
        number = names.get(name, int(name) if name.isdigit() else -1)
        if not 0 <= number < len(body.parents):
            known = ", ".join(names) if names else f"numbers 0 to {len(body.parents) - 1}"
            raise InputError(
                "no such joint", file=scene.source, field=f"body.joints[{i}]", value=name, mend=f"known here: {known}"
            )
        chosen.append(number)
    root = int(np.flatnonzero(body.parents < 0)[0])
    return (root, *sorted(set(chosen) - {root}))


def build(
    scene: Scene, *, prepared: Prepared | None = None, below: Sequence[tuple[Assembly, dict]] = (), dtype=jnp.float32
) -> Assembly:
    """Read every file of a scene, check that they fit together, and precompute all that does not change.

    Args:
        scene: from `load_scene`. prepared: of a run, which needs no training motion any more; else found out here.
        below: the trained garments of `garment.over`, each with its parameters.
        dtype: of everything; float64 needs JAX's x64 mode.

    Raises:
        InputError: a file is unusable, joint counts disagree, units are off, or the garment is not on the body.
    """
    body = None if scene.body.file in ("", "none") else io.read_body(scene.path(scene.body.file))
    worn = scene.garment
    garment = io.read_garment(scene.path(worn.file), scale=worn.scale, up=worn.up, weld=worn.weld)
    if body is not None:
        _check_fit(scene, garment, body)
    pins, under = _pins(scene, garment), _layers(scene, body, below, dtype)
    mesh = mesh_from(garment.vertices, garment.faces, uv=garment.uv, dtype=dtype)
    motions, track = {}, None
    if prepared is None:
        motions = {name: load_motion(scene, name, body) for name in (*scene.motion.files, *scene.motion.validation)}
        prepared = _prepare(scene, body, garment, mesh, pins, under, [motions[name] for name in scene.motion.files])
        model = _model(scene, prepared, body, garment, mesh, pins, under, dtype)
        track = _training_track(scene, model, body, [motions[name] for name in scene.motion.files])
    else:
        model = _model(scene, prepared, body, garment, mesh, pins, under, dtype)
    smooth = scene.physics.collision.distance == "smooth"
    faces = None if model.body is None else touchable_faces(model, body, prepared.part)
    if faces is not None:
        model = replace(model, surface=surface_of(model, faces, track, smooth))
    spec = scene.network
    if spec.method == "ncs" and spec.cell == "swing" and model.terms.inertia:
        if not prepared.vibrations.size:
            prepared = _vibrating(scene, prepared, model, faces, track)
        vibrations = RitzModes(jnp.asarray(prepared.vibrations, dtype), jnp.asarray(prepared.energy, dtype))
        model = replace(model, vibrations=vibrations)
    return Assembly(scene, prepared, model, network_from(scene, model), body, garment, track, motions)


def _layers(scene: Scene, body: io.BodyRecord | None, below: Sequence[tuple[Assembly, dict]], dtype) -> tuple[Layer, ...]:
    """The garments worn below, checked against this scene."""
    found = []
    for i, (name, (assembly, params)) in enumerate(zip(scene.garment.over, below, strict=True)):
        field = f"garment.over[{i}]"
        worn, model = assembly.body, assembly.model
        if body is None or worn is None or not np.array_equal(worn.vertices, body.vertices):
            raise InputError(
                "a garment on the same body expected", file=scene.source, field=field, value=name,
                mend="train it on the body that [body] names",
            )  # fmt: skip
        if model.fps != scene.motion.fps:
            raise InputError(
                f"a garment trained at {scene.motion.fps:g} frames per second expected", file=scene.source, field=field,
                value=model.fps, mend="give both scenes the same motion.fps",
            )  # fmt: skip
        alone = replace(model, body=None, body_blend=None, surface=None, under=())
        layer = Layer(alone, params, assembly.network)
        found.append(jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, layer))
    return tuple(found)


def _prepare(scene, body, garment, mesh, pins, under, records) -> Prepared:
    moves = any(np.any(r.poses != r.poses[:1]) or np.any(r.translation != r.translation[:1]) for r in records)
    basis = np.zeros((len(garment.vertices), 0), np.float32)
    if scene.network.modes:
        held = pins if scene.physics.pinning.stiffness > 0 else ()
        basis = modal_basis(garment.vertices, garment.faces, np.asarray(mesh.vertex_area), scene.network.modes, held=held)
    if body is None:
        weights = np.ones((len(garment.vertices), 1), np.float32)
        return Prepared(np.zeros(1, np.int64), np.asarray(moves), weights, np.zeros(0, np.int64), basis)
    weights = garment.weights
    if weights is None:
        weights = transfer_weights(garment.vertices, body.vertices, body.faces, body.weights)
        weights = smooth_weights(weights, np.asarray(mesh.edges), scene.garment.smoothing)
    part = np.zeros(0, np.int64)
    if scene.physics.collision.stiffness > 0:
        part = touchable_part(scene, body, garment, weights, records)
        if under:
            part = part[~covered_by_layers(body, under)[part]]
    wanted = used_joints(body.parents.tolist(), np.concatenate([weights, body.weights[part]]))
    if moves:  # a joint that never turns tells the network nothing
        turning = np.any([np.any(r.poses != r.poses[:1], axis=(0, 2)) for r in records], axis=0)
        wanted = tuple(j for j in wanted if turning[j] or body.parents[j] < 0)
    inputs = _inputs(scene, body, wanted)
    return Prepared(np.asarray(inputs), np.asarray(moves), weights.astype(np.float32), part, basis)


def _model(scene, prepared: Prepared, body, garment, mesh, pins, under, dtype) -> Model:
    physics = scene.physics
    parents, joints, rest_rotations, body_weights = np.array([-1]), np.zeros((1, 3)), None, np.zeros((0, 1))
    if body is not None:
        parents, joints, rest_rotations = np.asarray(body.parents), body.joints, body.rest_rotations
        body_weights = body.weights[prepared.part]
    skinning = used_joints(parents.tolist(), np.concatenate([prepared.weights, body_weights]), least=1e-4)
    kept = sorted({*skinning, *_closure(prepared.inputs.tolist(), parents)})
    place = {j: i for i, j in enumerate(kept)}
    skeleton = Skeleton(
        jnp.asarray(joints[kept], dtype), tuple(place[int(parents[j])] if parents[j] >= 0 else -1 for j in kept)
    )
    collides = len(prepared.part) > 0 and physics.collision.stiffness > 0
    body_points = body_blend = None
    if collides:
        points = body.vertices[prepared.part]
        body_blend, body_points = blend_from(body_weights[:, kept], dtype=dtype), jnp.asarray(points, dtype)
    membrane = None if physics.membrane.model == "none" else physics.membrane.model
    numbers = tuple(getattr(physics.membrane, n) for n in MEMBRANES[membrane][1]) if membrane else ()
    keeps_apart = physics.self_contact.stiffness > 0
    material = Material(
        density=jnp.asarray(physics.density, dtype),
        membrane=tuple(jnp.asarray(n, dtype) for n in numbers),
        bending=jnp.asarray(physics.bending.stiffness, dtype),
        collision=jnp.asarray(physics.collision.stiffness, dtype),
        thickness=jnp.asarray(physics.collision.thickness, dtype),
        friction=jnp.asarray(physics.collision.friction, dtype),
        pinning=jnp.asarray(physics.pinning.stiffness, dtype),
        gravity=jnp.asarray(physics.gravity, dtype),
        self_contact=jnp.asarray(physics.self_contact.stiffness, dtype) if keeps_apart else None,
        self_thickness=jnp.asarray(physics.self_contact.thickness, dtype) if keeps_apart else None,
    )
    moves = bool(prepared.moves)
    terms = Terms(
        membrane=membrane if any(numbers) else None,
        bending=physics.bending.stiffness > 0 and len(mesh.hinges) > 0,
        collision=physics.collision.distance if collides else None,
        exact=physics.collision.search == "exact",
        friction=collides and physics.inertia and moves and physics.collision.friction > 0,
        gravity=any(physics.gravity),
        inertia=physics.inertia and moves,
        pinning=len(pins) > 0 and physics.pinning.stiffness > 0,
        self_contact=keeps_apart,
    )
    return Model(
        skeleton=skeleton,
        rest_rotations=None if rest_rotations is None else jnp.asarray(rest_rotations[kept], dtype),
        garment=Garment(mesh, jnp.asarray(pins, jnp.int32), groups_from(mesh) if keeps_apart else None),
        blend=blend_from(prepared.weights[:, kept], dtype=dtype),
        material=material,
        basis=jnp.asarray(prepared.basis, dtype),
        body=body_points,
        body_blend=body_blend,
        surface=None,
        terms=terms,
        inputs=tuple(place[j] for j in prepared.inputs.tolist()),
        source_joints=tuple(kept),
        descriptor=scene.network.descriptor,
        fps=scene.motion.fps,
        moves=moves,
        under=under if collides else (),
    )


def _vibrating(scene: Scene, prepared: Prepared, model: Model, faces, track: MotionFeatures | None) -> Prepared:
    """With the garment's vibrations: found with smooth contact, as a simulation converges with no other."""
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


def _training_track(scene, model: Model, body, records: list[io.MotionRecord]) -> MotionFeatures:
    if not records:
        joints = 1 if body is None else len(body.parents)
        records = [io.MotionRecord(np.zeros((1, joints, 3), np.float32), np.zeros((1, 3), np.float32), model.fps, ())]
    elif scene.motion.mirror and body is not None:
        partner = mirror_partners(body.joint_names, body.joints)
        records = records + [io.MotionRecord(*mirror(r.poses, r.translation, partner), r.fps, r.joint_names) for r in records]
    return features_from_records(model, *records)


def features_from_records(model: Model, *records: io.MotionRecord) -> MotionFeatures:
    """Descriptors and transforms of motions that are at the model's frame rate, end to end.

    Each is measured from the nearest corner, to where it begins, of a grid of `CELL` m.
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
        moved = jnp.concatenate([_moved(layer, records, origins, dtype) for layer in model.under], axis=1)
        found = replace(found, matrices=jnp.concatenate([found.matrices, moved], axis=1))
    return replace(found, origin=jnp.asarray(np.repeat(origins, lengths, axis=0), dtype)) if np.any(origins) else found


def _moved(layer: Layer, records, origins, dtype) -> Float[Array, "frames verts 3 4"]:
    """What takes each vertex of a garment below from its rest to its place, measured from the motions' origins."""
    x = [
        animated(layer.model, layer.network, layer.params, features_from_records(layer.model, record)) - origin
        for record, origin in zip(records, origins, strict=True)
    ]
    way = jnp.asarray(np.concatenate(x), dtype) - layer.rest
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*way.shape[:2], 3, 3))
    return jnp.concatenate([eye, way[..., None]], axis=-1)


def _closure(joints, parents) -> list[int]:
    found = set(joints)
    for j in joints:
        while (j := int(parents[j])) >= 0:
            found.add(j)
    return sorted(found)


def _pins(scene: Scene, garment: io.GarmentRecord) -> np.ndarray:
    name = scene.garment.pins
    if not name:
        return np.zeros(0, np.int32)
    if name not in garment.groups:
        known = ", ".join(garment.groups) or "none"
        raise InputError(
            "no such vertex group in the garment", file=scene.source, field="garment.pins", value=name,
            mend=f"groups there: {known}",
        )  # fmt: skip
    return np.asarray(garment.groups[name], np.int32)

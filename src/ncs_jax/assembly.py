"""From a validated scene to the constants and motions that run: reads the files, checks that they fit, chooses what matters."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax import io
from ncs_jax.casting import cast
from ncs_jax.energies.collision import Surface, surface_from
from ncs_jax.energies.proximity import groups_from
from ncs_jax.errors import InputError
from ncs_jax.io.normals import vertex_normals
from ncs_jax.io.surface import boundary_loops
from ncs_jax.kinematics import Skeleton, blend, blend_from, skin
from ncs_jax.mesh import mesh_from
from ncs_jax.methods.ncs import NCS
from ncs_jax.methods.pbns import PBNS
from ncs_jax.methods.shared import Method
from ncs_jax.methods.snug import SNUG
from ncs_jax.methods.swing import Swing
from ncs_jax.model import (
    Layer,
    Model,
    Vibrations,
    local_rotations,
    pose_body,
    smooth_weights,
    touchable,
    transfer_weights,
    used_joints,
)
from ncs_jax.modes import modal_basis
from ncs_jax.motion import Track, mirror, track
from ncs_jax.networks import Decoder, DynamicEncoder, LinearEncoder, StaticEncoder, SwingEncoder
from ncs_jax.objective import MEMBRANES, Garment, Material, Terms
from ncs_jax.rollout import animated
from ncs_jax.rotations import axis_angle_to_matrix, resample
from ncs_jax.scene import Scene
from ncs_jax.worn import check_worn

__all__ = ["Assembly", "Prepared", "assemble", "load_motion", "mirror_partners", "track_of"]

CELL = 8.0  # m
COVER = 0.06  # m from the skin within which a garment below covers it,
RIM = 0.1  # m from its rim at least


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
    track: Track | None
    motions: dict[str, io.MotionRecord]


def load_motion(scene: Scene, name: str, body: io.BodyRecord | None) -> io.MotionRecord:
    """A motion at the scene's frame rate, of the body's joints, see `casting.cast`."""
    path, spec = scene.path(name), scene.motion
    chosen = (spec.frames[0], spec.frames[1] if len(spec.frames) > 1 else None) if spec.frames else None
    gravity = np.array(scene.physics.gravity)
    try:
        record = cast(io.read_motion(path, frame_range=chosen), body, spec, "z" if np.abs(gravity).argmax() == 2 else "y")
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.expected, file=path, field=error.field, value=error.value, mend=error.mend) from None
    speed = np.abs(np.diff(record.translation, axis=0)).max(initial=0) * record.fps
    if speed > 100:
        raise InputError(
            "a translation in metres expected", file=path, field="trans", value=f"{speed:.0f} m/s",
            mend="divide centimetres by 100, or say motion.scale = 0.01",
        )  # fmt: skip
    poses, translation = record.poses, record.translation
    if record.fps != scene.motion.fps:
        begin = translation[:1].astype(np.float64)
        poses, moved = resample(
            jnp.asarray(poses, jnp.float32), jnp.asarray(translation - begin, jnp.float32), float(record.fps), scene.motion.fps
        )
        translation = begin + np.asarray(moved)
    return replace(record, poses=np.asarray(poses), translation=np.asarray(translation), fps=scene.motion.fps)


def mirror_partners(names: tuple[str, ...], joints: np.ndarray) -> np.ndarray:
    """The joint on the other side of each joint: by names (left/right, L_/R_), else by mirrored rest positions (x to -x)."""
    if names:
        lower = [n.lower() for n in names]
        place = {n: i for i, n in enumerate(lower)}

        def other(n):
            for a, b in (("left", "right"), ("l_", "r_"), ("lthumb", "rthumb"), ("lhip", "rhip")):
                for x, y in ((a, b), (b, a)):
                    if n.startswith(x) or (len(x) > 2 and x in n):
                        return n.replace(x, y, 1)
            return n

        return np.array([place.get(other(n), i) for i, n in enumerate(lower)])
    mirrored = joints * [-1, 1, 1]
    return np.linalg.norm(joints[None] - mirrored[:, None], axis=-1).argmin(axis=1)


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


def assemble(scene: Scene, *, prepared: Prepared | None = None, dtype=jnp.float32) -> Assembly:
    """Read every file of a scene, check that they fit together, and precompute all that does not change.

    Args:
        scene: from `load_scene`. prepared: of a run, which needs no training motion any more; else found out here.
        dtype: of everything; float64 needs JAX's x64 mode.

    Raises:
        InputError: a file is unusable, joint counts disagree, units are off, or the garment is not on the body.
    """
    body = None if scene.body.file in ("", "none") else io.read_body(scene.path(scene.body.file))
    worn = scene.garment
    garment = io.read_garment(scene.path(worn.file), scale=worn.scale, up=worn.up, weld=worn.weld)
    if body is not None:
        _check_fit(scene, garment, body)
    pins, under = _pins(scene, garment), _layers(scene, body, dtype)
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
    faces = None if model.body is None else _touchable_faces(model, body, prepared.part)
    if faces is not None:
        model = replace(model, surface=_surface(model, faces, track, smooth))
    spec = scene.network
    if spec.method == "ncs" and spec.cell == "swing" and model.terms.inertia:
        if not prepared.vibrations.size:
            prepared = _vibrating(scene, prepared, model, faces, track)
        vibrations = Vibrations(jnp.asarray(prepared.vibrations, dtype), jnp.asarray(prepared.energy, dtype))
        model = replace(model, vibrations=vibrations)
    return Assembly(scene, prepared, model, _network(scene, model), body, garment, track, motions)


def _layers(scene: Scene, body: io.BodyRecord | None, dtype) -> tuple[Layer, ...]:
    """The garments worn below, from their run folders."""
    found = []
    for i, name in enumerate(scene.garment.over):
        from ncs_jax.runs import load_run

        run, field = load_run(scene.path(name)), f"garment.over[{i}]"
        worn, model = run.assembly.body, run.assembly.model
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
        layer = Layer(alone, run.params, run.assembly.network)
        found.append(jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, layer))
    return tuple(found)


def _touchable_faces(model: Model, body: io.BodyRecord, part: np.ndarray) -> np.ndarray:
    """Triangles of the part of the body and of the garments below, which face outward as the body does."""
    from scipy.spatial import cKDTree

    faces, count = [_submesh(body.faces, part, len(body.vertices))], len(part)
    for layer in model.under:
        own, rest = np.asarray(layer.model.garment.mesh.faces), np.asarray(layer.rest)
        _, near = cKDTree(body.vertices).query(rest)
        outward = np.sum(vertex_normals(rest, own) * vertex_normals(body.vertices, body.faces)[near])
        faces.append(count + (own if outward >= 0 else own[:, ::-1]))
        count += len(rest)
    return np.concatenate(faces)


def _covered(body: io.BodyRecord, under: tuple[Layer, ...]) -> np.ndarray:
    """Which body vertices (body,) a garment below lies over: the nearest point of it is in front of them and not at its rim.

    They are no part of what the garment above touches, as there is cloth between; with them, it would be held off by the skin
    where it is through the cloth.
    """
    from scipy.spatial import cKDTree

    hidden, normals = np.zeros(len(body.vertices), bool), vertex_normals(body.vertices, body.faces)
    for layer in under:
        rest, faces = np.asarray(layer.rest), np.asarray(layer.model.garment.mesh.faces)
        away, near = cKDTree(rest).query(body.vertices)
        gap = rest[near] - body.vertices
        rim = rest[np.concatenate([*boundary_loops(faces), np.zeros(0, int)]).astype(int)]
        inner = np.ones(len(body.vertices), bool) if not len(rim) else cKDTree(rim).query(body.vertices)[0] > RIM
        hidden |= (away < COVER) & inner & (np.sum(gap * normals, axis=1) > 0.5 * away)
    return hidden


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
        part = _part(scene, body, garment, weights, records)
        if under:
            part = part[~_covered(body, under)[part]]
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


def _vibrating(scene: Scene, prepared: Prepared, model: Model, faces, track: Track | None) -> Prepared:
    """With the garment's vibrations: found with smooth contact, as a simulation converges with no other."""
    from ncs_jax.vibration import softest

    if faces is not None:
        model = replace(model, terms=replace(model.terms, collision="smooth"), surface=_surface(model, faces, track, True))
    found = softest(model, track, scene.network.vibrations)
    if found is None:
        raise InputError(
            "a garment that hangs on something, and swings, expected", file=scene.source, field="network.cell", value="swing",
            mend="pin it, put it on a body, or choose the gated or the linear cell",
        )  # fmt: skip
    return replace(prepared, vibrations=np.asarray(found.directions), energy=np.asarray(found.energy))


def _surface(model: Model, faces, track: Track | None, smooth: bool, samples: int = 8) -> Surface:
    """The touchable body, its search prepared for what comes near what in a few poses of the motion."""

    def posed(matrices):
        return skin(blend(matrices, model.blend), model.garment.mesh.rest), pose_body(model, matrices)

    poses = []
    if track is not None:
        frames = np.unique(np.linspace(0, len(track.start) - 1, samples).astype(int))
        poses = list(zip(*map(np.asarray, jax.jit(jax.vmap(posed))(track.matrices[frames])), strict=True))
    rest, body = np.asarray(model.garment.mesh.rest), np.concatenate([model.body, *(layer.rest for layer in model.under)])
    return surface_from(rest, body, faces, smooth=smooth, posed=poses)


def _training_track(scene, model: Model, body, records: list[io.MotionRecord]) -> Track:
    if not records:
        joints = 1 if body is None else len(body.parents)
        records = [io.MotionRecord(np.zeros((1, joints, 3), np.float32), np.zeros((1, 3), np.float32), model.fps, ())]
    elif scene.motion.mirror and body is not None:
        partner = mirror_partners(body.joint_names, body.joints)
        records = records + [io.MotionRecord(*mirror(r.poses, r.translation, partner), r.fps, r.joint_names) for r in records]
    return track_of(model, *records)


def track_of(model: Model, *records: io.MotionRecord) -> Track:
    """Descriptors and transforms of motions that are at the model's frame rate, end to end.

    Each is measured from the nearest corner, to where it begins, of a grid of `CELL` m.
    """
    dtype = model.skeleton.joints.dtype
    lengths = [len(r.poses) for r in records]
    start = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    poses = jnp.asarray(np.concatenate([r.poses for r in records]).astype(dtype))
    origins = [CELL * np.round(r.translation[0].astype(np.float64) / CELL) for r in records]
    near = np.concatenate([r.translation - origin for r, origin in zip(records, origins, strict=True)])
    found = track(model, local_rotations(model, poses), jnp.asarray(near.astype(dtype)), jnp.asarray(start, jnp.int32))
    if model.under:
        moved = jnp.concatenate([_moved(layer, records, origins, dtype) for layer in model.under], axis=1)
        found = replace(found, matrices=jnp.concatenate([found.matrices, moved], axis=1))
    return replace(found, origin=jnp.asarray(np.repeat(origins, lengths, axis=0), dtype)) if np.any(origins) else found


def _moved(layer: Layer, records, origins, dtype) -> Float[Array, "frames verts 3 4"]:
    """What takes each vertex of a garment below from its rest to its place, measured from the motions' origins."""
    x = [
        animated(layer.model, layer.network, layer.params, track_of(layer.model, record)) - origin
        for record, origin in zip(records, origins, strict=True)
    ]
    way = jnp.asarray(np.concatenate(x), dtype) - layer.rest
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*way.shape[:2], 3, 3))
    return jnp.concatenate([eye, way[..., None]], axis=-1)


def _network(scene: Scene, model: Model) -> Method:
    spec, (verts, modes), dtype = scene.network, model.basis.shape, model.basis.dtype
    decoder, learned, state = Decoder(verts, spec.decoder, modes, dtype=dtype), scene.garment.learn_weights, spec.static[-1]
    if spec.method == "snug":
        return SNUG(DynamicEncoder((), spec.dynamic, state, dtype, bias=True), decoder, learned)
    static = StaticEncoder(spec.static, dtype)
    if spec.method == "pbns":
        return PBNS(static, decoder, learned)
    if model.vibrations is not None:
        modes = model.vibrations.directions.shape[-1]
        return Swing(static, SwingEncoder(spec.dynamic, state, dtype), decoder, verts, modes, spec.damping, learned)
    encoder = {"linear": LinearEncoder}.get(spec.cell, DynamicEncoder)
    return NCS(static, encoder(spec.joint, spec.dynamic, state, dtype) if model.moves else None, decoder, learned)


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


def _part(scene, body, garment, weights, records) -> np.ndarray:
    if scene.body.part == "all":
        return np.arange(len(body.vertices))
    skeleton = Skeleton(jnp.asarray(body.joints, jnp.float32), tuple(int(p) for p in body.parents))
    poses = np.concatenate([r.poses for r in records]) if records else np.zeros((0, len(body.parents), 3), np.float32)
    looked = poses[np.unique(np.linspace(0, len(poses) - 1, min(len(poses), 60)).astype(int))] if len(poses) else poses
    local = np.asarray(jax.jit(axis_angle_to_matrix)(jnp.asarray(looked)))
    if body.rest_rotations is not None:
        local = body.rest_rotations @ local @ np.swapaxes(body.rest_rotations, -1, -2)
    # A point of a triangle is at most its longest edge / sqrt(3) from a corner.
    corners = body.vertices[body.faces]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()
    near = touchable(
        skeleton,
        garment.vertices,
        blend_from(weights),
        body.vertices,
        blend_from(body.weights),
        list(local),
        scene.physics.collision.reach + edge / np.sqrt(3),
    )
    return np.unique(body.faces[near[body.faces].any(axis=1)])


def _submesh(faces: np.ndarray, kept: np.ndarray, verts: int) -> np.ndarray:
    place = np.full(verts, -1)
    place[kept] = np.arange(len(kept))
    inside = place[faces]
    return inside[(inside >= 0).all(axis=1)]

"""What is found out once from the files of a scene: skinning weights, touchable body, joints to read, smooth modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.laplacian_modes import modal_basis
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.io.records import shown_frames
from ncs_jax.prepare.contact_detail import bent_most, pieces_of, posed_skins
from ncs_jax.prepare.skinning_weights import hung_weights, smooth_weights, transfer_weights, used_joints
from ncs_jax.prepare.touchable import covered_by_layers, submesh, touchable_part
from ncs_jax.scene.model import Layer
from ncs_jax.scene.spec import Scene

__all__ = ["Prepared", "SceneFiles", "check_made_from", "made_from", "prepare_scene"]

SAMPLES = 1000  # of a body's vertices
ALIKE = 1e-4  # m


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene as read and checked against each other.

    mesh: the garment's. pins: its pinned vertices (pins,). layers: the trained garments that are worn below it.
    """

    scene: Scene
    body: io.BodyRecord | None
    garment: io.GarmentRecord
    mesh: Mesh
    pins: np.ndarray
    layers: tuple[Layer, ...]


@dataclass(frozen=True)
class Prepared:
    """What is found out once from the files of a scene and then kept with a run.

    inputs: joints that the network reads, the root first. moves: whether the character ever moves. weights: the garment's
    skinning weights (verts, joints). part: numbers of the body vertices that the garment can touch. basis: its smooth modes
    (verts, modes), m. vibrations: the directions of a swing (verts, 3, modes), m. energy: of each of them, J. slope: how much
    they turn and strain the garment (modes, modes), by_pose: how stiff it is along them in a pose, and drape: how it hangs in
    the first one (verts, 3), m, see `RitzModes`. A scene whose network does not swing has no vibrations. betas: the shape of an
    SMPL body. pieces: into how many contact cuts the edges of each triangle (faces,), see `contact_detail.pieces_of`; none
    where all are whole. rest, faces, pins, skin, skin_faces: of the files that all this is of, see `made_from`.
    """

    inputs: np.ndarray
    moves: np.ndarray
    weights: np.ndarray
    part: np.ndarray
    basis: np.ndarray
    vibrations: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 0), np.float32))
    energy: np.ndarray = field(default_factory=lambda: np.zeros(()))
    slope: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    by_pose: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    drape: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    betas: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pieces: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))
    rest: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    pins: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    skin: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    skin_faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.int32))


def made_from(files: SceneFiles) -> dict[str, np.ndarray]:
    """Return what tells whether files are the same later: the garment's vertices (verts, 3) in m, triangles and pins, and the
    body's joints with some of its vertices (J + `SAMPLES` at most, 3) in m, and its triangles."""
    garment, body = files.garment, files.body
    skin, skin_faces = np.zeros((0, 3)), np.zeros((0, 3))
    if body is not None:
        some = np.linspace(0, len(body.vertices) - 1, min(SAMPLES, len(body.vertices))).astype(int)
        skin, skin_faces = np.concatenate([body.joints, body.vertices[some]]), body.faces
    return {
        "rest": garment.vertices.astype(np.float32),
        "faces": garment.faces.astype(np.int32),
        "pins": np.asarray(files.pins),
        "skin": skin.astype(np.float32),
        "skin_faces": skin_faces.astype(np.int32),
    }


def check_made_from(prepared: Prepared, files: SceneFiles) -> None:
    """See that the files of a scene are still those that a run was trained on, to `ALIKE`.

    Raises:
        InputError: the garment, its pins or the body are others. A run of an earlier version knows less, or nothing.
    """
    if not len(prepared.rest):
        return
    scene, found = files.scene, made_from(files)
    whole = scene.path(scene.garment.file), scene.path(scene.body.file)
    garment = f"one of {', '.join((scene.garment.file, *scene.garment.layers))}" if scene.garment.layers else "garment"
    compared = [
        ("rest", whole[0], "garment.file: vertices", garment),
        ("pins", whole[0], "garment.pins", "pins"),
        ("skin", whole[1], "body.file: joints and vertices", "body"),
    ]
    if len(prepared.faces):
        compared += [
            ("faces", whole[0], "garment.file: faces", garment),
            ("skin_faces", whole[1], "body.file: faces", "body"),
        ]
    for name, file, field_, what in compared:
        kept, now = getattr(prepared, name), found[name]
        if kept.shape != now.shape:
            told = f"{len(now)} of them, for {len(kept)}"
        elif kept.dtype.kind == "f":
            far = float(np.linalg.norm(kept.astype(np.float64) - now, axis=1).max(initial=0))
            told = f"up to {1000 * far:.1f} mm elsewhere" if far > ALIKE else ""
        else:
            others = int(np.sum(np.any(kept != now, axis=-1))) if kept.ndim > 1 else int(np.sum(kept != now))
            told = f"{others} others of {len(kept)}" if others else ""
        if told:
            raise InputError(
                f"the {what} that the run was trained with expected", file=file, field=field_, value=told,
                mend="the file was changed since: put the old one back, or train anew into another folder",
            )  # fmt: skip


def prepare_scene(files: SceneFiles, motions: Sequence[io.MotionRecord]) -> Prepared:
    """Return what the files and the training motions of a scene tell, vibrations aside."""
    scene, body, garment = files.scene, files.body, files.garment
    moves = body is not None and body.frames is not None and bool(np.any(body.frames != body.frames[:1]))
    moves = moves or any(np.any(r.poses != r.poses[:1]) or np.any(r.translation != r.translation[:1]) for r in motions)
    basis = _smooth_modes(files)
    if body is None:
        alone = np.ones((len(garment.vertices), 1), np.float32)
        return Prepared(np.zeros(1, np.int64), np.asarray(moves), alone, np.zeros(0, np.int64), basis)
    weights = garment.weights
    if weights is None:
        weights = transfer_weights(garment.vertices, body.vertices, body.faces, body.weights)
        weights = hung_weights(garment, body, weights)
        weights = smooth_weights(weights, np.asarray(files.mesh.edges), scene.garment.smoothing)
    part = np.zeros(0, np.int64)
    if scene.physics.collision.stiffness > 0:
        part = touchable_part(scene, body, garment, weights, motions)
        if files.layers:
            part = part[~covered_by_layers(body, files.layers)[part]]
    wanted = used_joints(body.parents.tolist(), np.concatenate([weights, body.weights[part]]))
    if moves and motions:  # a joint that never turns tells the network nothing
        turning = np.any([np.any(r.poses != r.poses[:1], axis=(0, 2)) for r in motions], axis=0)
        wanted = tuple(j for j in wanted if turning[j] or body.parents[j] < 0)
    inputs = _input_joints(scene, body, wanted)
    pieces = _pieces(files, part, motions) if len(part) else np.zeros(0, np.int8)
    return Prepared(np.asarray(inputs), np.asarray(moves), weights.astype(np.float32), part, basis, pieces=pieces)


def _pieces(files: SceneFiles, part: np.ndarray, motions: Sequence[io.MotionRecord]) -> np.ndarray:
    """Return into how many pieces contact cuts the edges of each triangle (faces,), none where all are whole."""
    collision, body, garment = files.scene.physics.collision, required(files.body, "body"), files.garment
    if collision.points != "auto":
        pieces = np.full(len(garment.faces), 1 + int(collision.points), np.int8)
    else:
        faces = submesh(body.faces, part, len(body.vertices))
        skins = _skins(body, part, motions)
        pieces = pieces_of(garment.vertices, garment.faces, skins, faces, collision.thickness)
    return pieces if (pieces > 1).any() else pieces[:0]


def _skins(body: io.BodyRecord, part: np.ndarray, motions: Sequence[io.MotionRecord]) -> list[np.ndarray]:
    """Return a part of the body at rest, then as it is bent in the motions, (V, 3) each, m."""
    if body.frames is not None:
        return [frame[part] for frame in body.frames[shown_frames(len(body.frames))]]
    poses = [bent_most(record.poses) for record in motions]
    bent = bent_most(np.concatenate(poses)) if poses else np.zeros((0, len(body.parents), 3))
    return posed_skins(body, part, bent)


def _smooth_modes(files: SceneFiles) -> np.ndarray:
    """Return the garment's smooth modes (verts, modes), m, zero at pins that hold."""
    scene, garment = files.scene, files.garment
    if not scene.network.modes:
        return np.zeros((len(garment.vertices), 0), np.float32)
    held = files.pins if scene.physics.pinning.stiffness > 0 else ()
    area = np.asarray(files.mesh.vertex_area)
    return modal_basis(garment.vertices, garment.faces, area, scene.network.modes, held=held)


def _input_joints(scene: Scene, body: io.BodyRecord, default: tuple[int, ...]) -> tuple[int, ...]:
    """Return the joints that the network reads, the root first: those of `body.joints`, or the default where it is empty."""
    if not scene.body.joints:
        return default
    names = {n: i for i, n in enumerate(body.joint_names)}
    chosen = []
    for i, name in enumerate(scene.body.joints):
        number = names.get(name, int(name) if name.isdigit() else -1)
        if not 0 <= number < len(body.parents):
            valid = ", ".join(names) if names else f"numbers 0 to {len(body.parents) - 1}"
            raise InputError(
                "no such joint in the body", file=scene.source, field=f"body.joints[{i}]", value=name,
                mend=f"choose from {valid}",
            )  # fmt: skip
        chosen.append(number)
    root = int(np.flatnonzero(body.parents < 0)[0])
    return (root, *sorted(set(chosen) - {root}))

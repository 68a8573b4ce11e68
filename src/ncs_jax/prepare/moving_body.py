"""A moving mesh as the body of a scene: its frames chosen and resampled, its regions found, and what energies read of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError, required
from ncs_jax.io.tables.table import select
from ncs_jax.prepare.regions import find_regions
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model
from ncs_jax.scene.spec import Scene

__all__ = ["check_character", "frame_features", "moving_body", "refuse_training", "resampled"]


def check_character(scene: Scene) -> None:
    """Raise an InputError where a scene says of a character what only a moving mesh has."""
    for field in ("fps", "scale", "up", "mesh"):
        if value := getattr(scene.body, field):
            raise InputError(
                "a mesh for each frame expected for this field", file=scene.source, field=f"body.{field}", value=value,
                mend="leave it out: a character's file says it",
            )  # fmt: skip


def moving_body(scene: Scene) -> io.BodyRecord:
    """Read the mesh for each frame that a scene names as its body, at the scene's frame rate, with regions for its joints.

    At rest it is as in the first frame that the scene uses, which the garment lies on.

    Raises:
        InputError: it cannot be read, nothing says its frames per second, or the scene says what only a character has.
    """
    _check_scene(scene)
    person, path = scene.body, scene.path(scene.body.file)
    mesh = scene.path(person.mesh) if person.mesh else None
    body = io.read_moving_body(path, scale=person.scale, up=person.up, fps=person.fps, mesh=mesh)
    frames = required(body.frames, "frames")
    if scene.motion.frames:
        chosen = scene.motion.frames
        frames = frames[select(path, len(frames), (chosen[0], chosen[1] if len(chosen) > 1 else None))]
    if len(frames) > 1 and not np.isfinite(body.fps):
        raise InputError(
            "frames per second expected, as this format does not say it", file=scene.source or path, field="body.fps",
            mend="write fps = 24 below [body], or what it was exported at",
        )  # fmt: skip
    count = len(frames)
    x = resampled(frames, body.fps, scene.motion.fps) if count > 1 else frames
    notes = (*body.notes, _told(count, body.fps, x, scene.motion.fps))
    weights, carriers = find_regions(x)
    joints = weights.T @ x[0] / weights.sum(axis=0)[:, None]
    off = _misfit(x, weights, carriers)
    notes = (*notes, f"{len(joints)} regions carry the cloth, and move as the mesh does to {1000 * off:.2g} mm r.m.s.")
    return replace(
        body, vertices=x[0], joints=joints, parents=np.where(np.arange(len(joints)), 0, -1).astype(np.int32), weights=weights,
        joint_names=tuple(f"region_{k}" for k in range(len(joints))), notes=notes, frames=x, carriers=carriers,
        fps=scene.motion.fps,
    )  # fmt: skip


def _told(count: int, fps: float, x: np.ndarray, new: float) -> str:
    """Return in words how many frames there are."""
    if count == 1:
        return "a mesh of one frame stands still"
    made = "" if len(x) == count and fps == new else f", made {len(x)} at {new:g}"
    return f"a mesh of {count} frames at {fps:g} per second{made}"


def _check_scene(scene: Scene) -> None:
    """Raise an InputError where a scene says of a moving mesh what only a character has."""
    person = scene.body
    for field, value, expected, mend in (
        ("body.part", "" if person.part in ("auto", "all") else person.part, "auto or all", "leave it out: all is the body"),
        ("body.betas", person.betas, "no betas", "leave them out: the mesh has its shape"),
        ("body.shapes", person.shapes, "no shapes", "leave them out: the mesh has its shape"),
        ("body.joints", person.joints, "no joints", "leave them out: the mesh has none"),
        ("motion.files", scene.motion.files, "no motion", "write files = []: the frames of the body are its motion"),
        ("motion.validation", scene.motion.validation, "no motion", "leave it out: the frames of the body are its motion"),
        ("garment.over", scene.garment.over, "no garment below", "leave it out: trained garments need a character"),
    ):
        if value:
            raise InputError(
                f"{expected} expected, as the body is a mesh for each frame", file=scene.source, field=field, value=value,
                mend=mend,
            )  # fmt: skip


def resampled(frames: np.ndarray, fps: float, new: float) -> np.ndarray:
    """Return frames (T, V, 3) at another rate, along cubics through them; a frame at the time of one is that one.

    Catmull and Rom 1974: the velocity at a frame is that from the one before to the one after, so it never jumps.
    """
    last = len(frames) - 1
    times = np.arange(int(last * new / fps + 1e-6) + 1) * fps / new
    times = np.where(np.abs(times - np.round(times)) < 1e-6, np.round(times), times)
    if len(times) == len(frames) and np.array_equal(times, np.arange(len(frames))):
        return frames
    low = np.minimum(np.floor(times).astype(int), last)
    out = np.empty((len(times), *frames.shape[1:]), frames.dtype)
    for k, (i, s) in enumerate(zip(low, times - low, strict=True)):
        if s == 0:
            out[k] = frames[i]
            continue
        a, b = (frames[j].astype(np.float64) for j in (i, i + 1))
        before = frames[i - 1] if i > 0 else 2 * a - b
        after = frames[i + 2] if i + 2 <= last else 2 * b - a
        out[k] = a + s * (b - before + s * (2 * before - 5 * a + 4 * b - after + s * (3 * (a - b) + after - before))) / 2
    return out


def _misfit(frames: np.ndarray, weights: np.ndarray, carriers: np.ndarray) -> float:
    """Return how far regions take vertices from their places, r.m.s. over some frames, m."""
    some = np.unique(np.linspace(0, len(frames) - 1, min(8, len(frames))).round().astype(int))
    square = [
        np.einsum("vab,vb->va", (weights @ m.reshape(len(m), 12)).reshape(-1, 3, 4)[..., :3], frames[0])
        + weights @ m[..., 3] - x for x, m in zip(frames[some], carriers[some], strict=True)
    ]  # fmt: skip
    return float(np.sqrt(np.mean(np.sum(np.square(square), axis=-1))))


def frame_features(model: Model, body: io.BodyRecord, part: np.ndarray) -> MotionFeatures:
    """Return the frames of a moving mesh as energies read them: the motions of its regions, then the places of its vertices.

    No network reads them: they have no descriptors. part: numbers of the vertices that can be touched.
    """
    frames, carriers, dtype = required(body.frames, "frames"), required(body.carriers, "carriers"), model.basis.dtype
    count = len(model.source_joints)
    matrices = np.zeros((len(frames), count + (0 if model.body is None else len(part)), 3, 4), dtype)
    matrices[:, :count] = carriers[:, list(model.source_joints)]
    if model.body is not None:
        matrices[:, count:, :, :3] = np.eye(3)
        matrices[:, count:, :, 3] = frames[:, part]
    none = jax.device_put(np.zeros((len(frames), 0, 0), dtype))
    return MotionFeatures(none, none, jax.device_put(matrices), jax.device_put(np.zeros(len(frames), np.int32)))


def refuse_training(scene: Scene) -> None:
    """Raise an InputError where the body is a moving mesh: a network reads poses, and it has none."""
    if scene.moves_by_itself:
        raise InputError(
            "a skinned character expected to train on: a mesh for each frame has no pose that a network could read",
            file=scene.source, field="body.file", value=str(Path(scene.body.file)),
            mend="give the character with its skeleton and motion (.fbx, .glb, .npz); ncs simulate takes meshes as they are",
        )  # fmt: skip

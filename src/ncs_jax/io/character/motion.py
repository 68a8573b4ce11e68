"""Motions from .npz and .h5 (this package's, and AMASS's), from .bvh, and from animated characters in .glb, .gltf and .fbx."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ncs_jax.errors import InputError, required
from ncs_jax.io.character.bvh import read_bvh
from ncs_jax.io.character.fbx_character import fbx_motion
from ncs_jax.io.character.gltf_character import gltf_motion
from ncs_jax.io.character.quaternions import to_axis_angle
from ncs_jax.io.character.rig import split_clip
from ncs_jax.io.records import MotionRecord
from ncs_jax.io.tables.hdf5 import read_hdf5
from ncs_jax.io.tables.npz import read_npz
from ncs_jax.io.tables.table import Table, checked_parents, floats, select

__all__ = ["read_motion"]

FPS = ("fps", "mocap_framerate", "mocap_frame_rate")
PARTS = ("root_orient", "pose_body", "pose_jaw", "pose_eye", "pose_hand")  # of AMASS, in the order of SMPL-X's joints
FIELDS = ("poses", "quaternions", "trans", "joint_names", "joints", "parents", *PARTS, *FPS)
FORMATS = (".npz", ".h5", ".hdf5", ".bvh", ".glb", ".gltf", ".fbx")


class MotionSkeleton(NamedTuple):
    """The skeleton of a motion, as in a MotionRecord."""

    joints: np.ndarray | None
    parents: np.ndarray | None
    tips: np.ndarray | None
    rest_rotations: np.ndarray | None = None


def read_motion(
    path: str | Path, *, frame_range: tuple[int, int | None] | None = None, scale: float | int = 1.0
) -> MotionRecord:
    """Read a motion: local rotations since rest, axis times angle, and the root's translation since rest.

    .npz and .h5 hold `poses` (T, J, 3) or (T, 3 J), or `quaternions` (T, J, 4) with w first and of any length but zero; `trans`
    (T, 3); and `fps`. AMASS writes `mocap_framerate` or `mocap_frame_rate` instead of `fps`, and its world has Z up. Its poses
    may be in parts: `root_orient` (T, 3), `pose_body` (T, 63), and `pose_hand` (T, 90) with or without `pose_jaw` and
    `pose_eye`. The file may hold `joint_names` (J,), and a skeleton, `joints` (J, 3) with `parents` (J,). A .bvh has both; its
    translation is the root's position less the root's OFFSET. For .glb, .gltf and .fbx, see `gltf_motion` and `fbx_motion`.
    FILE.glb#NAME names one of several animations; without a name the first is read.

    Args:
        path: the file. frame_range: (start, stop), frames start to stop - 1; a stop of None is the end. Other frames may hold
            numbers that are not finite. scale: metres a unit of the file's lengths, for .bvh often 0.01 or 0.0254.

    Raises:
        InputError: the file cannot be read; or shapes disagree, a chosen frame has a number that is not finite or a quaternion
            of length zero, there is no frame, or the frame rate is not above 0.
    """
    name, clip = split_clip(path)
    suffix = Path(name).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"one of {', '.join(FORMATS)} expected", file=path, value=suffix or "no suffix", mend="convert it")
    if not 0 < scale < 1e6:
        raise InputError("a number above 0 expected", file=path, field="scale", value=scale)
    skeleton, up = MotionSkeleton(None, None, None), ""
    if suffix == ".bvh":
        bvh = read_bvh(path)
        file, poses, translation, fps, names = bvh.file, bvh.poses, bvh.positions - bvh.offsets[0], bvh.fps, bvh.joint_names
        joints = bvh.offsets.copy()
        for j, parent in enumerate(bvh.parents[1:], 1):
            joints[j] += joints[parent]
        skeleton = MotionSkeleton(joints * scale, bvh.parents, (joints + bvh.tips) * scale)
    elif suffix in FORMATS[4:]:
        found = (fbx_motion if suffix == ".fbx" else gltf_motion)(name, clip)
        file, poses, translation, fps, names = Path(name), found.poses, found.translation, found.fps, found.joint_names
        skeleton = MotionSkeleton(required(found.joints, "joints") * scale, found.parents, None, found.rest_rotations)
    else:
        table = (read_npz if suffix == ".npz" else read_hdf5)(path, FIELDS.__contains__)
        file, poses, translation, fps = table.file, _rotations(table), table.array("trans"), table.number(*FPS)
        names = table.joint_names(poses.shape[1])
        up = "" if "fps" in table else "z"
        if "parents" in table and "joints" in table:
            joints = table.floats("joints", (poses.shape[1], 3), ("joint",))
            parents = checked_parents(file, "parents", table.array("parents"), poses.shape[1], names)
            skeleton = MotionSkeleton(joints * joints.dtype.type(scale), parents, None)
        if translation.shape != (len(poses), 3):
            raise InputError(
                f"an array of shape ({len(poses)}, 3) expected, one row a frame", file=file, field="trans",
                value=translation.shape, mend="write as many rows as there are poses",
            )  # fmt: skip
    chosen = select(file, len(poses), frame_range)
    labels = [f" ({n})" for n in names] or [""] * poses.shape[1]
    field, shape = ("poses", "quaternions")[poses.shape[2] - 3], ("T", *poses.shape[1:])
    poses = floats(file, field, poses[chosen], shape, ("frame", "joint"), chosen.start, labels)
    if poses.shape[2] == 4:
        poses = _from_quaternions(file, poses, labels, chosen.start)
    moved = floats(file, "trans", translation[chosen], ("T", 3), ("frame",), chosen.start)
    return MotionRecord(poses, moved * moved.dtype.type(scale), fps, names, *skeleton, up)


def _rotations(table: Table) -> np.ndarray:
    """Return poses (T, J, 3) or quaternions (T, J, 4); only their shape is checked."""
    if "poses" not in table and "quaternions" not in table and "root_orient" in table:
        return _in_parts(table)
    name = table.first("poses", "quaternions")
    if name == "poses" and "quaternions" in table:
        raise InputError("either poses or quaternions expected", file=table.file, field="poses", mend="leave one out")
    array = table.array(name)
    flat = name == "poses" and array.ndim == 2 and array.shape[1] % 3 == 0
    size = 3 if name == "poses" else 4
    if flat:
        array = array.reshape(len(array), -1 if array.size else array.shape[1] // 3, 3)
    if array.ndim != 3 or array.shape[2] != size or array.shape[1] == 0:
        expected = "(T, J, 3) or (T, 3 J)" if name == "poses" else "(T, J, 4)"
        raise InputError(
            f"an array of shape {expected} expected", file=table.file, field=name, value=array.shape,
            mend="write one rotation for each frame and joint",
        )  # fmt: skip
    if len(array) == 0:
        raise InputError("at least one frame expected", file=table.file, field=name, value=array.shape, mend="write it again")
    return array


def _in_parts(table: Table) -> np.ndarray:
    """Join AMASS poses that are written in parts: SMPL-H without jaw and eyes, SMPL-X with them, or the body's 22 joints."""
    frames, face = len(table.array("root_orient")), "pose_jaw" in table or "pose_eye" in table
    width = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
    parts = [table.floats(name, (frames, width[name]), ("frame",)) for name in ("root_orient", "pose_body")]
    if face or "pose_hand" in table:
        for name in PARTS[2:] if face else PARTS[4:]:
            here = name in table
            parts.append(table.floats(name, (frames, width[name]), ("frame",)) if here else np.zeros((frames, width[name])))
    if frames == 0:
        raise InputError("at least one frame expected", file=table.file, field="root_orient", mend="write it again")
    return np.concatenate(parts, axis=1).reshape(frames, -1, 3)


def _from_quaternions(file: Path, q: np.ndarray, labels: list[str], start: int) -> np.ndarray:
    """Return axis times angle (T, J, 3) of quaternions (T, J, 4), after a check that none is zero."""
    length = np.linalg.norm(q.astype(np.float64), axis=-1)
    bad = np.argwhere(length < 1e-6)
    if len(bad):
        t, j = (int(i) for i in bad[0])
        raise InputError(
            "a quaternion that is not zero expected", file=file, field=f"quaternions, frame {t + start}, joint {j}{labels[j]}",
            value=q[t, j].tolist(), mend="write (1, 0, 0, 0) where nothing turns",
        )  # fmt: skip
    return to_axis_angle(q / length[..., None].astype(q.dtype))

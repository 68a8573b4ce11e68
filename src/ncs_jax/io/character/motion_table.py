"""Motions as named arrays, in .npz and .h5: rotations in the forms that people write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.records import MotionRecord
from ncs_jax.io.tables.table import Table, checked_parents, floats, select

__all__ = ["FIELDS", "chosen_frames", "table_motion"]

FPS = ("fps", "mocap_framerate", "mocap_frame_rate")
PARTS = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}  # of AMASS, in SMPL-X's order
FIELDS = ("poses", "quaternions", "trans", "joint_names", "joints", "parents", *PARTS, *FPS)
UNIT = 0.01  # by which the length of a unit quaternion, and a product of unit axes, may be off
TURN = 2 * np.pi  # rad; more in a tenth of all rotations are no radians
FIT = "rotations: fit SMPL to the joints' positions first (SMPLify, or the data set's own tool)"
OTHERS = {  # arrays of others that hold a motion, and how to write it here
    "smpl_poses": "poses = smpl_poses, trans = smpl_trans / smpl_scaling and fps = 60",
    "body_pose": "poses = [global_orient, body_pose] (T, 3 J), trans = transl and fps",
    "positions": FIT,
    "joints": FIT,
    "motion": "poses (T, J, 3), rotations as axis times angle, trans (T, 3) and fps",
    "arr_0": "poses (T, J, 3), rotations as axis times angle, trans (T, 3) and fps",
}
SIX = "of a 6D rotation make a matrix: its two rows or columns at right angles, their cross product the third"
CLEAR = 4  # times as many quaternions turn by less than 90 degrees in the order that is taken


def table_motion(table: Table, frame_range: tuple[int, int | None] | None) -> MotionRecord:
    """Return the chosen frames of a motion: see `read_motion`."""
    if not any(name in table for name in ("poses", "quaternions", "root_orient")):
        _refuse_others(table)
    parts = "poses" not in table and "quaternions" not in table and "root_orient" in table
    field = "root_orient" if parts else table.first("poses", "quaternions")
    file, translation, fps = table.file, table.array("trans"), table.number(*FPS)
    notes: tuple[str, ...] = ()
    if parts:
        poses, moved = _in_parts(table, translation, frame_range)
        names = table.joint_names(poses.shape[1])
    else:
        given = _rotations(table, field)
        names = table.joint_names(given.shape[1])
        chosen = _frames(table, field, len(given), translation, frame_range)
        turned, moved = chosen_frames(file, field, given, translation, names, chosen)
        poses, notes = _axis_angle(file, field, turned, names, chosen.start)
    joints = parents = None
    if "parents" in table and "joints" in table:
        joints = table.floats("joints", (poses.shape[1], 3), ("joint",))
        parents = checked_parents(file, "parents", table.array("parents"), poses.shape[1], names)
    return MotionRecord(poses, moved, fps, names, joints, parents, up="" if "fps" in table else "z", notes=notes)


def _refuse_others(table: Table) -> None:
    """Raise an InputError that says how to write here what other files call otherwise, or what holds no rotations."""
    for name, mend in OTHERS.items():
        if name in table.names:
            raise InputError(
                "poses or quaternions expected",
                file=table.file,
                field=name,
                value=", ".join(table.names)[:120],
                mend=f"write {mend}",
            )


def chosen_frames(
    file: Path, field: str, poses: np.ndarray, translation: np.ndarray, names: tuple[str, ...], chosen: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Return the chosen frames of rotations (T, J, ...) and of translations (T, 3), after a check that they are finite."""
    labels = [f" ({n})" for n in names] or [""] * poses.shape[1]
    turned = floats(file, field, poses[chosen], ("T", *poses.shape[1:]), ("frame", "joint"), chosen.start, labels)
    return turned, floats(file, "trans", translation[chosen], ("T", 3), ("frame",), chosen.start)


def _frames(table: Table, field: str, frames: int, translation: np.ndarray, frame_range) -> slice:
    """Return the chosen frames, after a check that there are some and a translation for each."""
    if frames == 0:
        raise InputError(
            "at least one frame expected", file=table.file, field=field, value=table.array(field).shape, mend="write it again"
        )
    if translation.shape != (frames, 3):
        raise InputError(
            f"an array of shape ({frames}, 3) expected, one row a frame", file=table.file, field="trans",
            value=translation.shape, mend="write as many rows as there are poses",
        )  # fmt: skip
    return select(table.file, frames, frame_range)


def _rotations(table: Table, field: str) -> np.ndarray:
    """Return `poses` (T, J, 3), (T, J, 4) or (T, J, 3, 3), or `quaternions` (T, J, 4); only their shape is checked."""
    if field == "poses" and "quaternions" in table:
        raise InputError("either poses or quaternions expected", file=table.file, field="poses", mend="leave one out")
    array = table.array(field)
    if field == "poses" and array.ndim == 2 and array.shape[1] % 3 == 0:
        array = array.reshape(len(array), -1 if array.size else array.shape[1] // 3, 3)
    shapes = ((3,), (4,), (3, 3)) if field == "poses" else ((4,),)
    if array.ndim < 3 or array.shape[2:] not in shapes or array.shape[1] == 0:
        expected = "(T, J, 3), (T, 3 J), (T, J, 4) or (T, J, 3, 3)" if field == "poses" else "(T, J, 4)"
        raise InputError(
            f"an array of shape {expected} expected", file=table.file, field=field, value=array.shape,
            mend=SIX if array.shape[2:] in ((6,), (3, 2), (2, 3)) else "write one rotation for each frame and joint",
        )  # fmt: skip
    return array


def _in_parts(table: Table, translation: np.ndarray, frame_range) -> tuple[np.ndarray, np.ndarray]:
    """Join AMASS poses that are written in parts: SMPL-H without jaw and eyes, SMPL-X with them, or the body's 22 joints."""
    file, frames = table.file, len(table.array("root_orient"))
    chosen = _frames(table, "root_orient", frames, translation, frame_range)
    face = "pose_jaw" in table or "pose_eye" in table
    wanted = [n for n in PARTS if n in ("root_orient", "pose_body") or face or (n == "pose_hand" and n in table)]
    parts = []
    for name in wanted:
        if name not in table and name not in ("root_orient", "pose_body"):
            parts.append(np.zeros((chosen.stop - chosen.start, PARTS[name])))
            continue
        array = table.array(name)
        if array.shape != (frames, PARTS[name]):
            raise InputError(
                f"an array of shape ({frames}, {PARTS[name]}) expected", file=file, field=name, value=array.shape,
                mend="write as many rows as root_orient has",
            )  # fmt: skip
        parts.append(floats(file, name, array[chosen], ("T", PARTS[name]), ("frame",), chosen.start))
    poses = np.concatenate(parts, axis=1).reshape(len(parts[0]), -1, 3)
    return poses, floats(file, "trans", translation[chosen], ("T", 3), ("frame",), chosen.start)


def _axis_angle(
    file: Path, field: str, turned: np.ndarray, names: tuple[str, ...], start: int
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return axis times angle (T, J, 3) of rotations in any form, and a note on what they were taken for."""
    if turned.shape[2:] == (3,):
        if (np.linalg.norm(turned, axis=-1) > TURN).mean() > 0.1:
            raise InputError(
                "axis times angle in radians expected", file=file, field=field,
                value=f"{np.linalg.norm(turned, axis=-1).max():.3g} at most", mend="of degrees, divide by 57.29578",
            )  # fmt: skip
        if _are_places(turned):
            raise InputError(
                "rotations expected, not the places of joints", file=file, field=field, value=turned.shape, mend=f"write {FIT}"
            )
        return turned, ()
    if turned.ndim == 4:
        products = np.swapaxes(turned, -1, -2) @ turned
        off = np.abs(products - np.eye(3)).max(axis=(-1, -2))
        _refuse(file, field, turned, names, start, (off > UNIT) | (np.linalg.det(turned) < 0), "a rotation matrix")
        poses = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(turned.shape[:3])
        return poses.astype(turned.dtype), ("its poses are rotation matrices",)
    length = np.linalg.norm(turned, axis=-1)
    w_first, notes = True, tuple[str, ...]()
    if field == "quaternions":
        _refuse(file, field, turned, names, start, length < 1e-6, "a quaternion that is not zero")
        first, last = ((np.abs(turned[..., k]) > np.sqrt(0.5) * length).mean() for k in (0, 3))
        if first < 0.1 and last > 0.9:
            raise InputError(
                "w first expected", file=file, field=field, value=f"{100 * last:.0f} % are largest in the last component",
                mend="they seem to be (x, y, z, w): write quaternions[..., [3, 0, 1, 2]]",
            )  # fmt: skip
    else:
        _refuse(file, field, turned, names, start, np.abs(length - 1) > UNIT, "axis times angle, or a unit quaternion,")
        w_first = _w_is_first(file, turned)
        notes = (f"its poses are read as quaternions ({'w, x, y, z' if w_first else 'x, y, z, w'})",)
    turns = Rotation.from_quat(turned.reshape(-1, 4), scalar_first=w_first)
    return turns.as_rotvec().reshape(*turned.shape[:2], 3).astype(turned.dtype), notes


def _are_places(turned: np.ndarray) -> bool:
    """Tell whether "rotations" (T, J, 3) are places of SMPL's joints: they move, and all bones keep their lengths to 1 %."""
    names = smpl_names(turned.shape[1])
    if len(turned) < 2 or not names or np.ptp(turned, axis=0).max() < 0.01:
        return False
    parents = smpl_parents(len(names))[1:22]
    bones = np.linalg.norm(turned[:, 1:22] - turned[:, parents], axis=-1)
    return bool((np.ptp(bones, axis=0) < 0.01 * bones.mean(axis=0)).all())


def _refuse(file: Path, field: str, turned: np.ndarray, names, start: int, bad: np.ndarray, expected: str) -> None:
    """Raise an InputError that names the first frame and joint where `bad` (T, J) holds."""
    if bad.any():
        t, j = (int(i) for i in np.argwhere(bad)[0])
        label = f" ({names[j]})" if names else ""
        raise InputError(
            f"{expected} expected", file=file, field=f"{field}, frame {t + start}, joint {j}{label}",
            value=turned[t, j].tolist(), mend="write (0, 0, 0) in poses, or (1, 0, 0, 0) in quaternions, where nothing turns",
        )  # fmt: skip


def _w_is_first(file: Path, q: np.ndarray) -> bool:
    """Tell (w, x, y, z) from (x, y, z, w): most joints of a moving body turn by less than 90 degrees, so that |w| > 0.7.

    Raises:
        InputError: fewer than half do so in either order, or not much fewer in the other.
    """
    first, last = ((np.abs(q[..., k]) > np.sqrt(0.5)).mean() for k in (0, 3))
    if max(first, last) < 0.5 or max(first, last) < CLEAR * min(first, last):
        raise InputError(
            "quaternions of which most turn by less than 90 degrees expected, to tell (w, x, y, z) from (x, y, z, w)",
            file=file, field="poses", value=f"{100 * first:.0f} % and {100 * last:.0f} %",
            mend="write them as `quaternions`, in the order w, x, y, z",
        )  # fmt: skip
    return bool(first > last)

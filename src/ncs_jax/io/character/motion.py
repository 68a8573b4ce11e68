"""Motions from .npz and .h5 (this package's, and AMASS's), from .bvh, and from animations in .glb, .gltf, .vrma and .fbx."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ncs_jax.errors import InputError
from ncs_jax.io.character.bvh import read_bvh
from ncs_jax.io.character.fbx_character import fbx_motion
from ncs_jax.io.character.gltf_character import gltf_motion
from ncs_jax.io.character.motion_table import FIELDS, chosen_frames, table_motion
from ncs_jax.io.character.moving_root import bvh_from_moving_root
from ncs_jax.io.character.rig_motion import split_clip
from ncs_jax.io.packaged import resolved
from ncs_jax.io.records import MotionRecord
from ncs_jax.io.tables.files import suffix_lacking
from ncs_jax.io.tables.hdf5 import read_hdf5
from ncs_jax.io.tables.npz import read_npz
from ncs_jax.io.tables.table import select

__all__ = ["read_motion"]

TABLES = {".npz": read_npz, ".h5": read_hdf5, ".hdf5": read_hdf5}
READERS: dict[str, Callable[[str, str], MotionRecord]] = {
    ".bvh": lambda name, root: _bvh_motion(name, root),
    ".glb": gltf_motion,
    ".gltf": gltf_motion,
    ".vrm": gltf_motion,
    ".vrma": gltf_motion,
    ".fbx": fbx_motion,
}
FORMATS = (*TABLES, *READERS)
PICKLED = (".pkl", ".pickle", ".pt", ".npy")  # they may run any code when they are read, or say not what they hold


def read_motion(
    path: str | Path, *, frame_range: tuple[int, int | None] | None = None, scale: float | int = 1.0
) -> MotionRecord:
    """Read a motion: local rotations since rest, axis times angle, and the root's translation since rest.

    .npz and .h5 hold `trans` (T, 3), `fps`, and rotations: `poses` (T, J, 3) or (T, 3 J), axis times angle, or (T, J, 3, 3),
    matrices; or `quaternions` (T, J, 4) with w first and of any length but zero. `poses` (T, J, 4) are unit quaternions; which
    component is w is told by its size, see `motion_table`. AMASS writes `mocap_framerate` or `mocap_frame_rate` instead of
    `fps`, and its world has Z up. Its poses may be in parts: `root_orient` (T, 3), `pose_body` (T, 63), and `pose_hand` (T, 90)
    with or without `pose_jaw` and `pose_eye`. The file may hold `joint_names` (J,), and a skeleton, `joints` (J, 3) with
    `parents` (J,). A .bvh has both; its translation is the root's position less the root's OFFSET. For .glb, .gltf and .fbx
    see `gltf_motion` and `fbx_motion`. FILE.glb#NAME names one of several animations, FILE.bvh#NAME one of several ROOTs; else
    the first animation that moves is read, and the largest skeleton. The record's notes say what was found and done.

    Args:
        path: the file, or ncs:NAME. frame_range: (start, stop), frames start to stop - 1; a stop of None is the end, and
            numbers below 0 count from the end. Other frames may hold numbers that are not finite. scale: metres a unit of the
            file's lengths, for .bvh often 0.01 or 0.0254.

    Raises:
        InputError: the file cannot be read; or shapes disagree, a chosen frame has a number that is not finite or something
            that is no rotation, there is no frame, or the frame rate is not above 0.
    """
    name, clip = split_clip(resolved(path))
    if (suffix := Path(name).suffix.lower()) not in FORMATS:
        mend = "load it where it was made and write an .npz of poses, trans and fps" if suffix in PICKLED else "convert it"
        mend = "name one of its files" if Path(name).is_dir() else mend
        raise InputError(f"one of {', '.join(FORMATS)} expected", file=path, value=suffix or suffix_lacking(name), mend=mend)
    if not 0 < scale < 1e6:
        raise InputError("a number above 0 expected", file=path, field="scale", value=scale)
    if suffix in TABLES:
        found = table_motion(TABLES[suffix](name, FIELDS.__contains__), frame_range)
    else:
        found = READERS[suffix](name, clip)
        chosen = select(Path(name), len(found.poses), frame_range)
        given = found.poses, found.translation, found.joint_names
        poses, translation = chosen_frames(Path(name), "poses", *given, chosen)
        found = replace(found, poses=poses, translation=translation)
    if scale == 1:
        return found
    lengths = {name: getattr(found, name) for name in ("translation", "joints", "tips")}
    return replace(found, **{name: x * x.dtype.type(scale) for name, x in lengths.items() if x is not None})


def _bvh_motion(path: str, root: str) -> MotionRecord:
    """Return the motion of a .bvh in the file's own unit."""
    bvh = bvh_from_moving_root(read_bvh(path, root))
    joints = bvh.offsets.copy()
    for j, parent in enumerate(bvh.parents[1:], 1):
        joints[j] += joints[parent]
    moved, tips = bvh.positions - bvh.offsets[0], joints + bvh.tips
    return MotionRecord(bvh.poses, moved, bvh.fps, bvh.joint_names, joints, bvh.parents, tips, notes=bvh.notes)

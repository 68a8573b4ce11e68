"""Motions for a scene's body: read, frames chosen, turned upright, joints reordered or retargeted, resampled."""

from __future__ import annotations

import difflib
import re
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError, InputWarning
from ncs_jax.geometry.rotations import resample
from ncs_jax.io import BodyRecord, MotionRecord, read_body
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.joint_names import listed
from ncs_jax.prepare.reference_pose import (
    ZERO,
    facing,
    find_reference,
    from_frame,
    is_even,
    is_person,
    leans,
    odd_parts,
    since,
)
from ncs_jax.prepare.retarget import body_names, paired, retarget, turn_note, up_rotation, with_skeleton
from ncs_jax.prepare.skeleton import rest_of, standing_axis
from ncs_jax.scene.motion_lists import LISTING
from ncs_jax.scene.motion_names import LISTS, split_frames
from ncs_jax.scene.spec import MotionSpec, Scene

Reader = Callable[[int, int | None], MotionRecord]

__all__ = ["lead_in_frames", "load_motion", "load_motions", "one_by_one", "retarget_to_body"]

FEW = 20  # motions that are named one by one as they are read
EVERY = 5.0  # s between what is said of more
NAMED = 20  # kinds of faults that are told, and files of each that are named

LOOK = 10  # first frames of a file, and last, among which a T-pose is looked for
JUMP = 3.0  # times the fastest turn of 19 in 20 frames; a first turn that is faster leaves a pose outside the motion


def retarget_to_body(
    motion: MotionRecord, body: BodyRecord | None, spec: MotionSpec, world: str = "y", read: Reader | None = None
) -> MotionRecord:
    """Return a motion as one of the body's joints, in m; its `notes` say what was done.

    A motion with another skeleton or other joints is retargeted (`retarget.retarget`). Where the motion has its own skeleton,
    frames that only lead in (`lead_in_frames`) are left out unless the scene chooses frames. SMPL's motions of 22, 24, 52 and
    55 joints drive each other's bodies joint by joint. So do motions of as many joints as the body has, matched by name.

    Args:
        motion: as read. body: None for a garment without one. spec: gives up, scale, rest and joints. world: the axis that
            points up. read: gives frames start to stop - 1 of the file, also such as the scene leaves out; None: the motion's.

    Raises:
        InputError: the motion's joints are not the body's and nothing says which is which.
    """
    notes = motion.notes
    joints = 1 if body is None else len(body.parents)
    read = read or partial(_frames, motion)
    if motion.joints is not None and not spec.frames and (first := lead_in_frames(motion)):
        motion = _frames(motion, first)
        which = "frame 0, a pose that jumps into it, is" if first == 1 else f"frames 0 to {first - 1}, which jump into it, are"
        notes = (*notes, f"{which} left out; motion.frames = [0] keeps all")
    names = () if body is None else body_names(body)
    overridden = set(spec.joints) & set(motion.joint_names or smpl_names(motion.poses.shape[1]))
    if body is not None and (overridden or not _has_joints_of(motion, body, names)):
        smpl = None if overridden else _between_smpl(motion, body)
        if smpl is None:
            motion = replace(motion, notes=notes)
            source = _since_a_person(with_skeleton(_with_packaged_skeleton(motion), joints), body, spec, read)
            found = retarget(source, body, joints=spec.joints, scale=spec.scale, world=world).motion
            return replace(found, notes=source.notes + found.notes)
        motion, notes = smpl, (*notes, *smpl.notes)
    if motion.poses.shape[1] != joints:
        raise InputError(
            f"{joints} joints expected, as the body has", field="poses", value=f"{motion.poses.shape[1]} joints",
            mend="give a motion of the body's joints",
        )  # fmt: skip
    poses, translation, axes = motion.poses, motion.translation, motion.rest_rotations
    if names and motion.joint_names and motion.joint_names != names and set(motion.joint_names) == set(names):
        order = [motion.joint_names.index(n) for n in names]
        poses, axes = poses[:, order], None if axes is None else axes[order]
    if axes is not None:
        change = axes if body is None or body.rest_rotations is None else np.swapaxes(body.rest_rotations, 1, 2) @ axes
        if np.abs(change - np.eye(3)).max() > 1e-4:  # the same joints, but their rest axes differ
            poses = np.einsum("jab,tjb->tja", change, poses)
    if spec.scale:
        translation = translation * spec.scale
        notes = (*notes, f"a unit of its path is {spec.scale:.4g} m, as the scene says")
    turn = up_rotation((motion.up or world) if spec.up == "auto" else spec.up, world)
    if turn_note(turn):
        axes = np.eye(3) if body is None or body.rest_rotations is None else body.rest_rotations[0]  # the root's own
        root = axes.T @ turn @ axes @ Rotation.from_rotvec(poses[:, 0]).as_matrix()
        poses = poses.copy()
        poses[:, 0] = Rotation.from_matrix(root).as_rotvec()
        home = np.zeros(3) if body is None else body.joints[0].astype(np.float64)
        translation = (home + translation) @ turn.T - home
        notes = (*notes, *turn_note(turn))
    return MotionRecord(poses, translation, motion.fps, names, notes=notes)


def _frames(motion: MotionRecord, start: int, stop: int | None = None) -> MotionRecord:
    """Return frames start to stop - 1 of a motion."""
    if start >= len(motion.poses):
        raise InputError(f"a frame below {len(motion.poses)} expected", field="frames", value=start)
    return replace(motion, poses=motion.poses[start:stop], translation=motion.translation[start:stop])


def _since_a_person(motion: MotionRecord, body: BodyRecord, spec: MotionSpec, read: Reader) -> MotionRecord:
    """Return a motion whose zero pose is a person's, as the scene says or as found (`reference_pose`), its up axis with it."""
    if spec.rest not in ("auto", "zero") and not spec.rest.isdecimal():
        raise InputError('"auto", "zero" or the number of a frame expected', field="motion.rest", value=spec.rest)
    motion = motion if spec.up == "auto" else replace(motion, up=spec.up)
    of = paired(motion, body, spec.joints)[0]
    person, turned = is_person(rest_of(motion)[0], of), facing(motion, of)
    bent = spec.rest == "auto" and person and leans(turned, of)
    if spec.rest == "zero":
        return motion
    if spec.rest == "auto" and person and not bent and is_even(rest_of(turned)[0], of):
        return replace(turned, uncertain={part + ZERO: by for part, by in odd_parts(turned, of).items()})
    up = motion.up or standing_axis(motion, of)
    if spec.rest == "auto":
        start = spec.frames[0] if spec.frames else 0
        try:
            first = read(0, min(start, LOOK)) if start > 0 else _frames(motion, 0, LOOK) if spec.frames else read(0, LOOK)
            last = read(-LOOK, None)
        except InputError:  # frames that the scene leaves out may be broken
            first, last = _frames(motion, 0, LOOK), _frames(motion, -LOOK)
        why = "a moment of a movement, with left and right unlike" if person else "no person"
        why = "bent, as the frames are not" if bent else why
        try:
            found = find_reference(motion, of, up, first, last)
            found = replace(found, note=f"{found.note}; the zero pose is {why}")
        except InputError:
            if person:
                return motion
            raise
    else:
        number = int(spec.rest)
        said = f"the reference pose is frame {number}, as motion.rest says"
        try:
            found = from_frame(read(number, number + 1), of, up, 0, said)
        except InputError as error:
            raise InputError(error.expected, field="motion.rest", value=spec.rest, mend="write a frame of the file") from None
    return replace(since(motion, found), up=up, notes=(*motion.notes, found.note), uncertain=found.uncertain)


def lead_in_frames(motion: MotionRecord) -> int:
    """Count the first frames that only lead in: a pose, as the T-pose of many .bvh files, and the jump from it into the motion.

    Let the usual turn be what the fastest joint turns within a frame, at most, in 19 of 20 frames. There are such frames only
    where the first turn is more than `JUMP` times the usual. They end with the first turn that is usual. A motion of fewer than
    20 frames has none.
    """
    frames, joints = motion.poses.shape[:2]
    if frames < 20:
        return 0
    turns = Rotation.from_rotvec(motion.poses.reshape(-1, 3))
    own = np.arange(frames * joints)
    angle = (turns[own[:-joints]].inv() * turns[own[joints:]]).magnitude().reshape(-1, joints).max(axis=1)
    usual = np.percentile(angle, 95)
    return int(np.argmax(angle <= usual)) if angle[0] > JUMP * usual else 0


def _has_joints_of(motion: MotionRecord, body: BodyRecord, names: tuple[str, ...]) -> bool:
    """Tell whether the motion's joints are the body's, in order or by name, with the same rest places if it has any."""
    if motion.poses.shape[1] != len(body.parents):
        return False
    order = list(range(len(body.parents)))
    if names and motion.joint_names:
        if set(names) != set(motion.joint_names):
            return False
        order = [motion.joint_names.index(n) for n in names]
    if motion.joints is None or not (names and motion.joint_names):
        return True
    ours, theirs = body.joints - body.joints[0], (motion.joints - motion.joints[0])[order]
    return bool(np.abs(ours - theirs).max() < 0.01 * np.abs(ours).max())


def _between_smpl(motion: MotionRecord, body: BodyRecord) -> MotionRecord | None:
    """Return a motion of SMPL's joints for a SMPL body with more or fewer joints; None where either is not SMPL's."""
    theirs, ours = smpl_names(motion.poses.shape[1]), smpl_names(len(body.parents))
    if not theirs or not ours or motion.joints is not None or motion.joint_names not in ((), theirs):
        return None
    if not np.array_equal(body.parents, smpl_parents(len(ours))):
        return None
    poses = np.zeros((len(motion.poses), len(ours), 3), motion.poses.dtype)
    shared = [n for n in ours if n in theirs]
    poses[:, [ours.index(n) for n in shared]] = motion.poses[:, [theirs.index(n) for n in shared]]
    still = {n: n for n in ours if n not in theirs}
    notes = [f"{len(theirs)} joints of the SMPL family drive {len(shared)} of the body's {len(ours)}"]
    notes += [f"at rest, as nothing drives them: {listed(ours, still)}"] if still else []
    return replace(motion, poses=poses, joint_names=(), notes=tuple(notes))


def _with_packaged_skeleton(motion: MotionRecord) -> MotionRecord:
    """Add the packaged body's skeleton to a motion that has none, where its joints have that body's names."""
    if motion.joints is None and motion.joint_names:
        body = read_body(packaged("body"))
        if motion.joint_names == body.joint_names:
            return replace(motion, joints=body.joints, parents=body.parents)
    return motion


def one_by_one(names: Collection[str], doing: str, say: Callable[[str], None]) -> Iterator[str]:
    """Yield the names of motions; where they are many, say now and then what is done with them, and with how many already."""
    told = time.monotonic() - EVERY
    for number, name in enumerate(names):
        if len(names) > FEW and time.monotonic() - told >= EVERY:
            told = time.monotonic()
            say(f"{doing}: {number} of {len(names)} motions")
        yield name


def load_motions(
    scene: Scene, body: io.BodyRecord | None, say: Callable[[str], None]
) -> tuple[Scene, dict[str, io.MotionRecord]]:
    """Read all motions of a scene; return it, without those that cannot be used where it says to skip them, and the motions.

    Raises:
        InputError: some cannot be used: one of them, or all that cannot, by what is wrong.
    """
    names, motions, faults = list(dict.fromkeys(scene.motions)), {}, {}
    for note in scene.motion.found:
        say(note)
    for name in one_by_one(names, "reading", say):
        if len(names) <= FEW:
            say(f"reading {name}")
        try:
            motions[name] = load_motion(scene, name, body)
        except InputError as error:
            faults[name] = error
    if not faults:
        _check_joints(scene, motions)
        return scene, motions
    none = bool(scene.motion.files) and not any(name in motions for name in scene.motion.files)
    if scene.motion.broken == "refuse" or none:
        if len(faults) == 1:
            raise next(iter(faults.values()))
        mend = 'mend them or leave them out; motion.broken = "skip" trains without them'
        raise InputError(
            "motions that can be used expected", file=scene.source, field="motion", value=f"{len(faults)} of {len(names)} not",
            mend=f"{mend}:\n{_by_kind(faults)}",
        )  # fmt: skip
    what = f"{len(faults)} of {len(names)} motions are left out"
    warnings.warn(f"{what}:\n{_by_kind(faults)}", category=InputWarning, stacklevel=4)
    files, validation = (tuple(n for n in names if n in motions) for names in (scene.motion.files, scene.motion.validation))
    return replace(scene, motion=replace(scene.motion, files=files, validation=validation)), motions


def _check_joints(scene: Scene, motions: Mapping[str, io.MotionRecord]) -> None:
    """Raise an InputError where `motion.joints` names a joint that none of the motions has which it is said of."""
    if scene.motion.lone:
        return
    said: dict[tuple, list[io.MotionRecord]] = {}
    for name, record in motions.items():
        said.setdefault(tuple(scene.motion_file(name)[1].joints.items()), []).append(record)
    for joints, records in said.items():
        for name, ours in joints:
            if all(name in record.absent for record in records):
                near = next(filter(None, (record.absent[name] for record in records)), "")
                mend = f'did you mean "{near}" = "{ours}"?' if near else "leave it out, or write a joint of the motion first"
                raise InputError(
                    "a joint of the motions expected, and none has it", file=scene.source, field="motion.joints", value=name,
                    mend=mend,
                )  # fmt: skip


def _absent(motion: io.MotionRecord, joints: Mapping[str, str]) -> dict[str, str]:
    """Return the names in `motion.joints` that are no joint of a motion as read, each with the likeliest that is one, or ""."""
    names = motion.joint_names or smpl_names(motion.poses.shape[1])
    plain = {name.rsplit(":", 1)[-1].lower(): name for name in names}
    found = {}
    for name in joints:
        if name not in names:
            near = difflib.get_close_matches(name.rsplit(":", 1)[-1].lower(), plain, n=1)
            found[name] = plain[near[0]] if near else ""
    return found


def _by_kind(faults: Mapping[str, InputError]) -> str:
    """Return lines that say what is wrong with motions: what is alike but for numbers once, with the files that have it."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for name, error in faults.items():
        kind = re.sub(r"\d+", "#", f"{error.field}: {error.expected}"), error.mend or ""
        kinds.setdefault(kind, []).append(name)
    lines = []
    for names in sorted(kinds.values(), key=len, reverse=True)[:NAMED]:
        also = names[1 : NAMED + 1]
        more = f" and {len(names) - 1 - len(also)} more" if len(names) > 1 + len(also) else ""
        lines.append(f"  {faults[names[0]].as_command}" + (f"; so too {', '.join(also)}{more}" if also else ""))
    return "\n".join(lines) + (f"\n  and {len(kinds) - NAMED} faults of other kinds" if len(kinds) > NAMED else "")


def load_motion(scene: Scene, name: str, body: io.BodyRecord | None) -> io.MotionRecord:
    """Read a motion of the scene for its body, see `retarget_to_body`, and resample it to the scene's frame rate."""
    path, spec = scene.motion_file(name)
    for key in () if scene.motion.lone else LISTS:
        if name in getattr(scene.motion, key):
            scene.there(split_frames(name)[0], f"motion.{key}")
    chosen = (spec.frames[0], spec.frames[1] if len(spec.frames) > 1 else None) if spec.frames else None
    gravity = np.array(scene.physics.gravity)
    if path.suffix.lower() in ("", *LISTING) and not path.exists():  # else its suffix would be at fault
        raise InputError("no such file or folder", file=path, mend="check the path")
    if path.suffix.lower() in LISTING:
        mend = "name one of the motions that it lists; the lists of a scene, motion.files and validation, take all of them"
        raise InputError("one motion expected", file=path, value="a list", mend=mend)
    try:
        record = io.read_motion(path, frame_range=chosen)
        read = (
            partial(_frames, record) if chosen is None else lambda start, stop: io.read_motion(path, frame_range=(start, stop))
        )
        count, absent = len(record.poses), _absent(record, spec.joints)
        record = retarget_to_body(record, body, spec, "z" if np.abs(gravity).argmax() == 2 else "y", read)
        if chosen and spec.frames is scene.motion.frames:
            said = "from {} on" if chosen[1] is None else "from {} to before {}"
            record = replace(record, notes=(*record.notes, f"frames {said.format(*chosen)}, as motion.frames says"))
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.expected, file=path, field=error.field, value=error.value, mend=error.mend) from None
    speed = np.abs(np.diff(record.translation, axis=0)).max(initial=0) * record.fps
    if speed > 100:
        raise InputError(
            "a translation in metres expected", file=path, field="trans", value=f"{speed:.0f} m/s",
            mend="divide centimetres by 100, or write motion.scale = 0.01 into the scene file",
        )  # fmt: skip
    first = (chosen[0] if chosen else 0) + count - len(record.poses)  # frames that only lead in are left out
    poses, translation = record.poses, record.translation
    if record.fps != scene.motion.fps:
        begin = translation[:1].astype(np.float64)
        given = poses.astype(np.float32), (translation - begin).astype(np.float32)
        poses, moved = resample(*given, float(record.fps), scene.motion.fps)
        translation = begin + moved
    origin, fps = (first, float(record.fps) / scene.motion.fps), scene.motion.fps
    return replace(record, poses=poses, translation=translation, fps=fps, origin=origin, absent=absent)

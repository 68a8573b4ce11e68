"""Biovision hierarchies (.bvh): a skeleton and its motion as text, as the tools write it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io.character.bvh_motion import read_values, without_comments
from ncs_jax.io.tables.files import text_of

__all__ = ["Bvh", "read_bvh"]

FEW = 20  # frames in which a person may hardly turn
CHANNELS = {f"{axis}{kind}".lower(): (kind, i) for i, axis in enumerate("XYZ") for kind in ("position", "rotation")}


@dataclass(frozen=True, eq=False)
class Bvh:
    """A skeleton and its motion, lengths in the file's own unit.

    Attributes:
        file: the path. joint_names: J names, root first; end sites are no joints. parents: (J,) int32, -1 for the root.
        offsets: (J, 3) from each joint's parent to the joint in the rest pose; the root's is its rest place.
        tips: (J, 3) from a joint to its end site; NaN where a joint has none. poses: (T, J, 3) local rotations since rest, axis
            times angle. positions: (T, 3) of the root. fps: frames per second. moved: (T, 3), what the position channels of
            another joint say, see `moving_root`. notes: where the file is not as it should be, and how it was read.
    """

    file: Path
    joint_names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    tips: np.ndarray
    poses: np.ndarray
    positions: np.ndarray
    fps: float
    moved: dict[int, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class _Joint:
    """A joint as it is written: `column` is where its channels, (kind, axis), begin in a frame; `tip` is its end site's."""

    name: str
    parent: int
    column: int
    offset: list[float] = field(default_factory=list)
    tip: list[float] = field(default_factory=lambda: [np.nan] * 3)
    channels: list[tuple[str, int]] = field(default_factory=list)


def read_bvh(path: str | Path, root: str = "") -> Bvh:
    """Read a skeleton with its motion. Channels may stand in any order: R = R_first R_second R_third.

    Of several skeletons in one file, the one with the most joints is read, or the one whose ROOT is named. A number that is not
    finite stays so: the caller checks the frames that it uses.
    """
    file, text = text_of(path)
    parts = re.split(r"^\s*MOTION\s*:?\s*?(?:(?:#|//|;).*)?$", text, maxsplit=1, flags=re.MULTILINE | re.IGNORECASE)
    if len(parts) != 2:
        raise InputError("HIERARCHY and then MOTION expected", file=file, field="MOTION", mend="export the .bvh again")
    every = _hierarchy(file, parts[0])
    labels = [f"{'XYZ'[axis]}{kind} of {joint.name}" for joint in every for kind, axis in joint.channels]
    values, fps, notes = read_values(file, parts[1], labels)
    joints, note = _one_skeleton(file, every, root)
    offsets = np.array([joint.offset for joint in joints])
    poses = np.zeros((len(values), len(joints), 3))
    largest = 0.0
    moved: dict[int, np.ndarray] = {0: np.broadcast_to(offsets[0], (len(values), 3)).copy()}
    for j, joint in enumerate(joints):
        own = values[:, joint.column : joint.column + len(joint.channels)]
        turning = [c for c, (kind, _) in enumerate(joint.channels) if kind == "rotation"]
        if turning:
            axes = "".join("XYZ"[joint.channels[c][1]] for c in turning)  # capitals: each about the axes turned before
            known = np.isfinite(own[:, turning]).all(axis=1)
            largest = max(largest, float(np.abs(own[known][:, turning]).max(initial=0)))
            turns = Rotation.from_euler(axes, np.where(known[:, None], own[:, turning], 0), degrees=True).as_rotvec()
            poses[:, j] = np.where(known[:, None], turns, np.nan)
        for (kind, axis), value in zip(joint.channels, own.T, strict=True):
            if kind == "position":
                moved.setdefault(j, np.broadcast_to(offsets[j], (len(values), 3)).copy())[:, axis] = value
    if len(values) >= FEW and 0 < largest <= np.pi:
        notes = [*notes, f"its rotations are no larger than {largest:.3g}, and are read as degrees"]
    return Bvh(
        file, tuple(joint.name for joint in joints), np.array([joint.parent for joint in joints], np.int32), offsets,
        np.array([joint.tip for joint in joints]), poses, moved.pop(0), fps, moved, (*note, *notes),
    )  # fmt: skip


def _one_skeleton(file: Path, joints: list[_Joint], root: str) -> tuple[list[_Joint], tuple[str, ...]]:
    """Return the joints of one skeleton, their parents counted among themselves, and a note where the file has several."""
    starts = [i for i, joint in enumerate(joints) if joint.parent < 0]
    names = [joints[i].name for i in starts]
    if root and root not in names:
        raise InputError(
            "no such ROOT", file=file, field="HIERARCHY", value=root, mend=f"write FILE#NAME with one of {', '.join(names)}"
        )
    sizes = np.diff([*starts, len(joints)])
    chosen = names.index(root) if root else int(np.argmax(sizes))
    first = starts[chosen]
    own = joints[first : first + int(sizes[chosen])]
    for joint in own:
        joint.parent -= first if joint.parent >= 0 else 0
    twice = next((joint.name for k, joint in enumerate(own) if joint.name in {o.name for o in own[:k]}), None)
    if twice is not None:
        raise InputError(
            "a different name for each joint expected", file=file, field="HIERARCHY", value=twice, mend="rename one"
        )
    if len(starts) == 1:
        return own, ()
    others = ", ".join(f"{n} ({s} joints)" for k, (n, s) in enumerate(zip(names, sizes, strict=True)) if k != chosen)
    return own, (f"of its skeletons {names[chosen]} ({len(own)} joints) is read; FILE#NAME reads another: {others}",)


def _hierarchy(file: Path, text: str) -> list[_Joint]:
    """Return the joints of all skeletons, each after its parent."""
    joints: list[_Joint] = []
    open_joints: list[int] = []  # -1 stands for an end site
    columns = 0
    words = _words(text)
    for line, word in words:
        key = word.lower()
        where = f"line {line}"
        inner = open_joints[-1] if open_joints else -1
        if key in ("root", "joint"):
            name = " ".join(_until_brace(words))
            if not name or (key == "root") != (not open_joints) or (key == "joint" and inner < 0):
                raise InputError(
                    "a named ROOT, and each JOINT inside another, expected", file=file, field=where, value=f"{word} {name}"
                )
            open_joints.append(len(joints))
            joints.append(_Joint(name, inner, columns))
        elif key == "end":
            _until_brace(words)
            open_joints.append(-1)
        elif key == "}" and open_joints:
            open_joints.pop()
        elif key == "offset" and open_joints:
            offset = [_number(file, *next(words)) for _ in range(3)]
            if inner >= 0:
                joints[inner].offset = offset
            elif len(open_joints) > 1 and open_joints[-2] >= 0:
                joints[open_joints[-2]].tip = offset
        elif key == "channels" and open_joints:
            count = _number(file, *next(words))
            if count not in range(7 if inner >= 0 else 1):
                most = "at most 6 channels" if inner >= 0 else "no channels of an end site"
                raise InputError(f"{most} expected", file=file, field=where, value=count)
            if count:
                joints[inner].column, columns = columns, columns + int(count)
                joints[inner].channels = [_channel(file, *next(words)) for _ in range(int(count))]
                if len(set(joints[inner].channels)) < count:
                    raise InputError("each channel once expected", file=file, field=where, value=f"of {joints[inner].name}")
        elif key == "" and joints and not open_joints:
            break
        elif key == "" or key != "hierarchy":
            raise InputError(
                "ROOT, JOINT, End Site, OFFSET, CHANNELS or a closing brace expected", file=file, field=where,
                value=word or "the end", mend="export the .bvh again",
            )  # fmt: skip
    bare = next((joint.name for joint in joints if not joint.offset), None)
    if bare is not None:
        raise InputError(
            "an OFFSET for each joint expected", file=file, field="HIERARCHY", value=bare, mend="export the .bvh again"
        )
    return joints


def _words(text: str) -> Iterator[tuple[int, str]]:
    """Yield line number and word of all words but comments, and at the end an empty word, which nothing accepts."""
    line = 0
    for line, content in enumerate(text.rstrip("\n").split("\n"), 1):
        named = content.split(None, 1)[:1] and content.split(None, 1)[0].lower() in ("root", "joint", "end")
        bare = content if named else without_comments(content)  # a # can be part of a name
        for word in bare.replace("{", " { ").replace("}", " } ").split():
            yield line, word
    yield line, ""


def _until_brace(words: Iterator[tuple[int, str]]) -> list[str]:
    """Return the words before the next opening brace, or before the end."""
    found = []
    for _, word in words:
        if word in ("{", ""):
            break
        found.append(word)
    return found


def _number(file: Path, line: int, word: str) -> float:
    try:
        value = float(word.rstrip(",").replace(",", "."))
    except ValueError:
        value = np.nan
    if not abs(value) < 1e30:
        raise InputError("a finite number expected", file=file, field=f"line {line}", value=word or "the end")
    return value


def _channel(file: Path, line: int, word: str) -> tuple[str, int]:
    if word.lower() not in CHANNELS:
        raise InputError(
            "Xposition to Zposition or Xrotation to Zrotation expected", file=file, field=f"line {line}", value=word
        )
    return CHANNELS[word.lower()]

"""Biovision hierarchies (.bvh): a skeleton and its motion as text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.quaternions import about_axis, multiply, to_axis_angle
from ncs_jax.io.tables.files import text_of

__all__ = ["Bvh", "read_bvh"]

CHANNELS = {f"{axis}{kind}".lower(): (kind, i) for i, axis in enumerate("XYZ") for kind in ("position", "rotation")}


@dataclass(frozen=True, eq=False)
class Bvh:
    """A skeleton and its motion, lengths in the file's own unit.

    Attributes:
        file: the path. joint_names: J names, root first; end sites are no joints. parents: (J,) int32, -1 for the root.
        offsets: (J, 3) from each joint's parent to the joint in the rest pose; the root's is its rest place.
        tips: (J, 3) from a joint to its end site; NaN where a joint has none. poses: (T, J, 3) local rotations since rest, axis
            times angle. positions: (T, 3) of the root. fps: frames per second.
    """

    file: Path
    joint_names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    tips: np.ndarray
    poses: np.ndarray
    positions: np.ndarray
    fps: float


def read_bvh(path: str | Path) -> Bvh:
    """Read a skeleton with its motion. Channels may stand in any order: R = R_first R_second R_third.

    A number that is not finite stays so: the caller checks the frames that it uses.
    """
    file, text = text_of(path)
    parts = re.split(r"^\s*MOTION\s*$", text, maxsplit=1, flags=re.MULTILINE | re.IGNORECASE)
    if len(parts) != 2:
        raise InputError("HIERARCHY and then MOTION expected", file=file, field="MOTION", mend="export the .bvh again")
    names, parents, offsets, tips, channels = _hierarchy(file, parts[0])
    values, fps = _motion(file, parts[1], sum(map(len, channels)))
    poses = np.zeros((len(values), len(names), 3))
    positions = np.broadcast_to(offsets[0], (len(values), 3)).copy()
    column = 0
    with np.errstate(all="ignore"):
        for j, joint in enumerate(channels):
            own = values[:, column : column + len(joint)]
            column += len(joint)
            turn = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (len(values), 4))
            for (kind, axis), value in zip(joint, own.T, strict=True):
                if kind == "rotation":
                    turn = multiply(turn, about_axis(axis, np.radians(value)))
                elif j == 0:
                    positions[:, axis] = value
                elif np.ptp(value) > 0.01 * np.linalg.norm(offsets, axis=1).max():
                    raise InputError(
                        "bones of fixed length expected", file=file, field=f"joint {names[j]}",
                        value=f"its {'XYZ'[axis]}position varies by {np.ptp(value):.3g}",
                        mend="export positions for the root only",
                    )  # fmt: skip
            poses[:, j] = to_axis_angle(turn)
    return Bvh(file, tuple(names), np.array(parents, np.int32), offsets, tips, poses, positions, fps)


def _hierarchy(file: Path, text: str) -> tuple[list[str], list[int], np.ndarray, np.ndarray, list[list[tuple[str, int]]]]:
    """Return names, parents, offsets, tips and channels of the joints."""
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    tips: list[list[float]] = []
    channels: list[list[tuple[str, int]]] = []
    open_joints: list[int] = []  # -1 stands for an end site
    words = _words(text)
    for line, word in words:
        key = word.lower()
        where = f"line {line}"
        if key in ("root", "joint"):
            name = " ".join(_until_brace(words))
            if (key == "root") != (not names) or (key == "joint" and (not open_joints or open_joints[-1] < 0)):
                raise InputError(
                    "one ROOT, and each JOINT inside another, expected", file=file, field=where, value=f"{word} {name}"
                )
            if not name or name in names:
                raise InputError(
                    "a different name for each joint expected", file=file, field=where, value=name, mend="rename one"
                )
            parents.append(open_joints[-1] if open_joints else -1)
            open_joints.append(len(names))
            names.append(name)
            offsets.append([])
            tips.append([np.nan] * 3)
            channels.append([])
        elif key == "end":
            _until_brace(words)
            open_joints.append(-1)
        elif key == "}" and open_joints:
            open_joints.pop()
        elif key == "offset" and open_joints:
            offset = [_number(file, *next(words)) for _ in range(3)]
            if open_joints[-1] >= 0:
                offsets[open_joints[-1]] = offset
            elif len(open_joints) > 1 and open_joints[-2] >= 0:
                tips[open_joints[-2]] = offset
        elif key == "channels" and open_joints and open_joints[-1] >= 0:
            count = _number(file, *next(words))
            if count not in range(7):
                raise InputError("at most 6 channels expected", file=file, field=where, value=count)
            channels[open_joints[-1]] = [_channel(file, *next(words)) for _ in range(int(count))]
        elif key == "" or key != "hierarchy":
            raise InputError(
                "ROOT, JOINT, End Site, OFFSET, CHANNELS or a closing brace expected", file=file, field=where,
                value=word or "the end", mend="export the .bvh again",
            )  # fmt: skip
        if names and not open_joints and key == "}":
            break
    _check_whole(file, names, offsets, len(open_joints), words)
    return names, parents, np.array(offsets), np.array(tips), channels


def _check_whole(file: Path, names: list[str], offsets: list[list[float]], unclosed: int, words: Iterator) -> None:
    """Raise an InputError unless a skeleton has a root, closed braces and all offsets, and no more words follow."""
    bare = next((n for n, o in zip(names, offsets, strict=True) if not o), None)
    if not names or unclosed or bare is not None:
        raise InputError(
            "a ROOT with all its braces closed, and an OFFSET for each joint, expected", file=file, field="HIERARCHY",
            value=bare or f"{len(names)} joints, {unclosed} not closed", mend="export the .bvh again",
        )  # fmt: skip
    left = next(words, (0, ""))
    if left[1]:
        raise InputError(
            "one skeleton expected", file=file, field=f"line {left[0]}", value=left[1], mend="export one character"
        )


def _words(text: str) -> Iterator[tuple[int, str]]:
    """Yield line number and word of all words, and at the end an empty word, which nothing accepts."""
    line = 0
    for line, content in enumerate(text.splitlines(), 1):
        for word in content.replace("{", " { ").replace("}", " } ").split():
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
        value = float(word)
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


def _motion(file: Path, text: str, channels: int) -> tuple[np.ndarray, float]:
    head = re.match(r"\s*Frames:\s*(\S+)\s+Frame\s+Time:\s*(\S+)", text, flags=re.IGNORECASE)
    if head is None:
        raise InputError("'Frames:' and 'Frame Time:' expected after MOTION", file=file, field="MOTION", mend="export it again")
    try:
        frames = int(head[1])
    except ValueError:
        frames = 0
    if frames < 1:
        raise InputError("at least one frame expected", file=file, field="Frames", value=head[1], mend="export it again")
    try:
        period = float(head[2])
    except ValueError:
        period = 0.0
    if not 1e-6 < period < 1e6:
        raise InputError("seconds above 0 expected", file=file, field="Frame Time", value=head[2], mend="write 1/fps")
    words = text[head.end() :].split()
    if channels == 0 or len(words) != frames * channels:
        raise InputError(
            f"{frames} frames of {channels} channels expected, {frames * channels} numbers", file=file, field="MOTION",
            value=f"{len(words)} numbers", mend="the file is cut short or its header is wrong; export it again",
        )  # fmt: skip
    try:
        values = np.array([float(w) for w in words])
    except ValueError as error:
        raise InputError(f"numbers expected: {error}", file=file, field="MOTION", mend="export it again") from None
    fps = 1 / period
    # Frame times are printed with 6 digits or so: 0.00833333 s is meant to be 120 frames per second.
    return values.reshape(frames, channels), float(round(fps)) if abs(fps - round(fps)) < 1e-4 * fps else fps

"""The MOTION part of a .bvh: how many frames, how long each lasts, and a number for each channel of each."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["read_values", "without_comments"]

RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 144, 200, 240)  # frames per second of cameras
SLOW = 0.25  # s; few motions have frames that last longer
COMMENT = re.compile(r"(?:^|(?<=\s))(?:#|//|;).*", re.MULTILINE)
HEAD = re.compile(r"\s*Frames\s*:?\s*([^\s:]+)\s+Frame\s*Time\s*:?\s*([^\s:]+)", re.IGNORECASE)
NOT_FINITE = re.compile(r"[-+]?(?:nan|inf|1[.,]#)\S*", re.IGNORECASE)  # as C and Microsoft's library print it


def without_comments(text: str) -> str:
    """Return a text without what follows #, // or ; on a line, at its start or after a blank."""
    return COMMENT.sub("", text) if any(mark in text for mark in ("#", "//", ";")) else text


def read_values(file: Path, text: str, labels: Sequence[str]) -> tuple[np.ndarray, float, list[str]]:
    """Return the numbers (T, channels) of a motion, its frames per second, and notes on what is not as it should be.

    Numbers may have decimal commas, or commas between them. One that is not finite, as nan or 1.#IND, becomes NaN. Where the
    header says fewer frames than there are, those are taken that it says, but all if it says fewer than half; where it says
    more, those are taken that are there and whole.

    Args:
        file: what an error names. text: what follows MOTION. labels: the channels of a frame, in words.

    Raises:
        InputError: the header or a number cannot be read, there is no frame, or lines and channels do not fit together.
    """
    text = without_comments(text.rstrip("\0\x1a \n"))  # old editors end a file with such bytes
    head = HEAD.match(text)
    if head is None:
        raise InputError("'Frames:' and 'Frame Time:' expected after MOTION", file=file, field="MOTION", mend="export it again")
    try:
        stated = int(head[1])
    except ValueError:
        raise InputError("a whole number expected", file=file, field="Frames", value=head[1], mend="count the frames") from None
    fps, notes = _frame_rate(file, head[2])
    data, commas = _with_points(text[head.end() :])
    words = data.split()
    frames, counted = _count_frames(file, data, len(words), stated, len(labels))
    return _floats(file, words[: frames * len(labels)], labels).reshape(frames, -1), fps, [*notes, *commas, *counted]


def _frame_rate(file: Path, word: str) -> tuple[float, list[str]]:
    """Return frames per second, of a frame time as it is printed.

    Times are rounded: 0.0083 is meant to be 120 frames per second. The rate is the one of `RATES` whose frame time would be
    printed so, if there is one only; else what the number says.
    """
    try:
        printed = Decimal(word.replace(",", "."))
        period = float(printed)
    except InvalidOperation:
        printed, period = Decimal(0), 0.0
    if not 1e-6 < period < 1e6:
        raise InputError(
            "seconds above 0 expected", file=file, field="Frame Time", value=word,
            mend="write 1/fps, 0.033333 for 30 frames per second",
        )  # fmt: skip
    fps, notes = 1 / period, []
    if period > 1:
        per_mille = [rate for rate in RATES if abs(1000 / rate - period) < 0.005 * period and period % 1]
        if not per_mille:
            raise InputError(
                "the seconds that a frame lasts expected", file=file, field="Frame Time", value=word,
                mend=f"write {1 / period:.6g} if it is frames per second, {period / 1000:.6g} if it is milliseconds",
            )  # fmt: skip
        return float(per_mille[0]), [f"its Frame Time, {word}, is read as milliseconds, {per_mille[0]} frames per second"]
    if period > SLOW:
        notes = [f"its Frame Time, {word} s, means {fps:.3g} frames per second"]
    half = 0.5 * 10.0 ** int(printed.as_tuple().exponent)
    near = [rate for rate in RATES if abs(1 / rate - period) <= half * (1 + 1e-6)]
    if abs(fps - round(fps)) < 1e-4 * fps:
        return float(round(fps)), notes
    return float(near[0]) if len(near) == 1 else fps, notes


def _with_points(text: str) -> tuple[str, list[str]]:
    """Return numbers with decimal points and blanks between them, and a note where they had decimal commas."""
    if "," not in text:
        return text, []
    if "." in text or re.search(r",\s|,[^\s,]*,", text):  # commas between the numbers
        return text.replace(",", " "), []
    return text.replace(",", "."), ["its numbers have decimal commas"]


def _count_frames(file: Path, text: str, numbers: int, stated: int, channels: int) -> tuple[int, list[str]]:
    """Return how many frames to take, and a note where it is not what the header says."""
    there, rest = divmod(numbers, channels) if channels else (0, 0)
    if channels and numbers == stated * channels and stated > 0:
        return stated, []
    wide = [len(line.split()) for line in text.split("\n")]
    wide = [w for w in wide if w]
    if there == 0 or any(w != channels for w in wide[:-1]) or wide[-1] > channels:
        width = next((w for w in wide if w != channels), 0)
        raise InputError(
            f"{max(stated, 1)} frames of {channels} channels expected, one on each line", file=file, field="MOTION",
            value=f"{numbers} numbers, a line of {width}",
            mend="the file is cut short, or its CHANNELS are not those of its frames; export it again",
        )  # fmt: skip
    cut = f"; the last, of {rest} numbers instead of {channels}, is left out" if rest else ""
    if stated >= there or 2 * stated < there:
        return there, [f"its header says {stated} frames, {there} are there and taken{cut}"]
    return stated, [f"its header says {stated} frames; {there - stated} more at the end are left out"]


def _floats(file: Path, words: list[str], labels: Sequence[str]) -> np.ndarray:
    """Return the numbers that words are, NaN where one is not finite."""
    try:
        return np.array(words, np.float64)
    except ValueError:
        found = np.empty(len(words))
    for i, word in enumerate(words):
        try:
            found[i] = float("nan" if NOT_FINITE.fullmatch(word) else word)
        except ValueError:
            frame, channel = divmod(i, len(labels))
            raise InputError(
                "numbers expected", file=file, field=f"MOTION, frame {frame}, {labels[channel]}", value=word[:40],
                mend="mend that number, or export the file again",
            ) from None  # fmt: skip
    return found

"""What a scene says of one motion alone: frames behind its name, or a table with settings of its own."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from ncs_jax.errors import InputError

__all__ = ["LISTS", "named_motions", "split_frames", "with_settings"]

LISTS = ("files", "validation")  # the fields of [motion] that list motions
SLICE = re.compile(r"(?P<file>.+)\[(?P<inner>[^\[\]]*:[^\[\]]*)\]", re.DOTALL)
# Brackets without a colon, behind what can only be a motion: elsewhere they may be a pattern's, take[1-4]/*.bvh.
KINDS = r"\.(?:npz|h5|hdf5|bvh|glb|gltf|vrm|vrma|fbx|txt|csv|tsv|lst|list)(?:#[^\[\]]*)?"
BARE = re.compile(rf"(?P<file>ncs:[^\[\]]+|.+{KINDS})\s*\[(?P<inner>[^\[\]]*)\]", re.DOTALL | re.IGNORECASE)


def split_frames(name: str) -> tuple[str, tuple[int, ...] | None]:
    """Return the file that `FILE[START:STOP]` names and its frames, (start,) or (start, stop); None where it names no frames.

    As for a slice in Python, either number may be left out, and one below 0 counts from the end.

    Raises:
        InputError: there is a colon in brackets, but no two numbers around it; or brackets without one behind a motion.
    """
    found = SLICE.fullmatch(name) or BARE.fullmatch(name)
    if found is None:
        return name, None
    numbers = re.fullmatch(r"\s*(-?\d+)?\s*:\s*(-?\d+)?\s*", found["inner"])
    if numbers is None:
        raise InputError(
            "frames as [START:STOP] expected, START: or :STOP alone too", field="motion", value=name,
            mend=f"write {found['file'].rstrip()}[{_meant(found['inner'])}]",
        )  # fmt: skip
    start, stop = numbers.groups()
    return found["file"], (int(start or 0),) if stop is None else (int(start or 0), int(stop))


def _meant(inner: str) -> str:
    """Return the frames that brackets mean where they hold one or two numbers, 1-40 or 1,40; else an example."""
    numbers = re.fullmatch(r"\D*?(-?\d+)(?:\D+(\d+))?\D*", inner)
    return "10:300" if numbers is None else f"{numbers[1]}:{numbers[2] or ''}"


def named_motions(
    motion: dict, source: str, checked: Callable[[str, Any, str], Any], known: tuple[str, ...]
) -> tuple[dict, dict[str, dict]]:
    """Return [motion] with the name of each motion in its lists, and the settings by name of those that have their own.

    An entry is a name, or a table `{ file = "walk.bvh", frames = [10, 300], scale = 0.01 }`. Frames become part of the name.

    Args:
        motion: the table as in the file. source: what an error names. checked: gives the value of a field after a check, from
            the field's name, the value and what an error calls it. known: the fields that an entry may have beside `file`.

    Raises:
        InputError: a table has no file, another key or a value that does not fit, or a name has two different settings.
    """
    own: dict[str, dict] = {}
    lists = {}
    for key in LISTS:
        entries = motion.get(key)
        if not isinstance(entries, list | tuple):
            continue
        names = []
        for i, entry in enumerate(entries):
            where = f"motion.{key}[{i}]"
            name, settings = (entry, {}) if not isinstance(entry, dict) else _entry(entry, where, source, checked, known)
            if isinstance(name, str):
                _check_slice(name, where, source)
                if own.setdefault(name, settings) != settings:
                    raise InputError(
                        "the same settings wherever a motion is named expected", file=source, field=where, value=entry,
                        mend="give it frames of its own, or leave the other entry out",
                    )  # fmt: skip
            names.append(name)
        lists[key] = names
    return {**motion, **lists}, {name: settings for name, settings in own.items() if settings}


def _entry(entry: dict, where: str, source: str, checked, known: tuple[str, ...]) -> tuple[str, dict]:
    """Return the name of a motion that is given as a table, and its settings but for frames in its name."""
    for key in entry:
        if key not in ("file", *known):
            raise InputError(
                "unknown key", file=source, field=f"{where}.{key}", value=entry[key],
                mend=f"the fields of a motion are file, {', '.join(known)}",
            )  # fmt: skip
    name = entry.get("file")
    if not isinstance(name, str) or not name:
        raise InputError(
            "the motion's file expected", file=source, field=f"{where}.file", value=name, mend='write file = "..."'
        )
    settings = {key: checked(key, value, f"{where}.{key}") for key, value in entry.items() if key != "file"}
    if len(settings.get("frames", ())) > 2:
        raise InputError("one or two numbers expected", file=source, field=f"{where}.frames", value=entry["frames"])
    if settings.get("frames"):
        _check_slice(name, f"{where}.file", source)
        if split_frames(name)[1] is not None:
            raise InputError("frames given once expected", file=source, field=f"{where}.frames", value=entry["frames"])
        name += "[" + ":".join(map(str, settings.pop("frames"))) + ("]" if len(entry["frames"]) > 1 else ":]")
    return name, settings


def _check_slice(name: str, where: str, source: str) -> None:
    """Raise an InputError that names the place in the scene where the frames behind a name cannot be read."""
    try:
        split_frames(name)
    except InputError as error:
        raise InputError(error.expected, file=source, field=where, value=name, mend=error.mend) from None


def with_settings(name: str, settings: dict) -> str | dict:
    """Return an entry of a scene file: the name of a motion, or a table where it has settings of its own."""
    return {"file": name, **settings} if settings else name

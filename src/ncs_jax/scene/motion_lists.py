"""Many motions by one name: a folder, a pattern, or a file that lists them."""

from __future__ import annotations

import csv
import glob
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ncs_jax.errors import InputError
from ncs_jax.scene.motion_names import LISTS, split_frames

__all__ = ["LISTING", "Found", "each_motion"]

LISTING = (".txt", ".csv", ".tsv", ".lst", ".list")
NAMING = ("file", "path", "filename", "file_path", "source_path", "motion", "name")  # columns of a table, the first that it has
START = ("start", "start_frame", "first", "first_frame", "begin", "from")
STOP = ("stop", "stop_frame", "end", "end_frame", "last", "to")
AMASS = re.compile(r"_(poses|stageii)\.npz$")  # motions of AMASS, which need not be opened to be told
BESIDE = re.compile(r"^(shape|.*_stagei)\.npz$")  # what AMASS keeps beside them: the shape of a person
ROTATIONS = {"poses", "quaternions", "root_orient"}
SHOWN = 5  # names of files that are told of


class Found(NamedTuple):
    """Motions one by one: those of each list, the settings of those that have some, and in words what there was."""

    files: tuple[str, ...]
    validation: tuple[str, ...]
    own: dict[str, dict[str, Any]]
    told: tuple[str, ...]


def each_motion(
    given: dict[str, tuple[str, ...]], own: dict[str, dict[str, Any]], path: Callable[[str], Path], source: str
) -> Found:
    """Return each motion of the lists `files` and `validation`, with the settings of the name that it came by.

    A folder stands for all motions in it and in its folders; `*`, `?` and `**` for what they match; a .txt or .csv for what it
    lists. Frames behind such a name, [START:STOP], are those of each motion. A motion that is also named by itself is that
    alone, and one to validate on is not among those that many were named by.

    Args:
        given: the names in a scene file. own: the settings of each name that has some. path: gives the path of a name. source:
            what an error names.

    Raises:
        InputError: there is no motion under a name, or none is left to train on.
    """
    every = [name for key in LISTS for name in given[key]]
    many = {name: under for name in every if (under := _many(name, path)) is not None}
    if not many:
        return Found(given["files"], given["validation"], own, ())
    own, notes, alone = dict(own), [], {name for name in every if name not in many}
    lists: dict[str, tuple[str, ...]] = {}
    validated: set[str] = set()

    def real(name: str) -> str:
        return os.path.realpath(path(split_frames(name)[0]))

    for key in reversed(LISTS):  # those to validate on first
        names: dict[str, None] = {}
        for name in given[key]:
            found, skipped = many.get(name, ([name], Counter()))
            if not found:
                raise _nothing(name, path(split_frames(name)[0]), skipped, f"motion.{key}", source)
            kept = found if name in alone else [m for m in dict.fromkeys(found) if m not in alone and m not in names]
            if name not in alone:
                kept = [m for m in kept if real(m) not in validated] if validated else kept
                notes.append(f"{name}: {len(kept)} motions{_left_out(skipped)}")
                own |= {m: own[name] for m in kept if name in own}
            names |= dict.fromkeys(kept)
        lists[key] = tuple(names)
        validated = {real(name) for name in names}
    if given["files"] and not lists["files"]:
        mend = "leave some of them out of motion.validation"
        raise InputError("motions to train on expected", file=source, field="motion.files", value=given["files"], mend=mend)
    own = {name: settings for name, settings in own.items() if name not in many}
    return Found(lists["files"], lists["validation"], own, tuple(reversed(notes)))


def _nothing(name: str, place: Path, skipped: Counter, field: str, source: str) -> InputError:
    kinds = ", ".join(f"{count} {kind}" for kind, count in skipped.most_common(SHOWN))
    mend = f"none of these is one: {kinds}" if kinds else "check the name, which is seen from the scene file"
    mend = (
        "none of its lines leads to one: write a motion, a folder or a pattern into each"
        if place.is_file() and not kinds
        else mend
    )
    return InputError("motions expected there", file=source, field=field, value=name, mend=mend)


def _left_out(skipped: Counter) -> str:
    if not skipped:
        return ""
    kinds = [f"{count} {kind}" for kind, count in skipped.most_common(SHOWN)]
    more = f" and {len(skipped) - SHOWN} other names" if len(skipped) > SHOWN else ""
    return f", beside {', '.join(kinds)}{more}, which are none"


def _many(name: str, path: Callable[[str], Path]) -> tuple[list[str], Counter] | None:
    """Return the motions that a name stands for, and what else was there by kind; None where it names one file."""
    if not name or name.startswith("ncs:"):
        return None
    file, frames = split_frames(os.path.expanduser(name))
    there, slices = path(file), "" if frames is None else name.removeprefix(file)
    if there.is_dir():
        found, skipped = _in_folder(there)
        return [str(Path(file, *part)) + slices for part in found], skipped
    if there.is_file():
        if there.suffix.lower() not in LISTING:
            return None
        motions, skipped = [], Counter[str]()
        for line in _lines(there):
            inner = os.path.normpath(Path(file).parent / line) if not line.startswith("ncs:") else line
            inner += slices if slices and split_frames(line)[1] is None else ""
            if _is_list(split_frames(inner)[0]):
                mend = f"write its motions into {there.name}, or name both in motion.files"
                raise InputError("a motion, a folder or a pattern expected, no other list", file=there, value=line, mend=mend)
            below = _many(inner, path)
            motions += [inner] if below is None else below[0]
            skipped += Counter() if below is None else below[1]
        return motions, skipped
    if "#" in file or not glob.has_magic(file):
        return None
    motions, skipped = [], Counter()
    base = path("x").parent
    seen: set[str] = set()
    for match in sorted(glob.glob(file, root_dir=base, recursive=True), key=lambda m: (m.count(os.sep), m)):
        real = os.path.realpath(base / match)
        if os.path.isdir(real) or real in seen:  # links that lead back give a file again and again
            continue
        seen.add(real)
        if _is_motion(base / match):
            motions.append(match + slices)
        else:
            skipped[_kind(Path(match).name)] += 1
    return motions, skipped


def _is_list(name: str) -> bool:
    return Path(name).suffix.lower() in LISTING


def _in_folder(folder: Path) -> tuple[list[tuple[str, ...]], Counter]:
    """Return the motions in a folder and in its folders, as parts of a path, sorted; and what else is there, by kind."""
    found, skipped, seen = [], Counter[str](), set()

    def refuse(error: OSError) -> None:
        raise InputError(
            f"a folder that can be read expected: {error.strerror}", file=error.filename, mend="see its permissions"
        )

    for here, folders, files in os.walk(folder, onerror=refuse, followlinks=True):
        real = os.path.realpath(here)
        if real in seen:  # a link that leads back
            folders.clear()
            continue
        seen.add(real)
        folders[:] = [f for f in folders if not f.startswith((".", "__"))]
        for name in files:
            if name.startswith("."):
                continue
            if _is_motion(Path(here, name)):
                found.append(Path(here, name).relative_to(folder).parts)
            else:
                skipped[_kind(name)] += 1
    return sorted(found), skipped


def _kind(name: str) -> str:
    """Return what files like this one are called together."""
    return name if BESIDE.match(name) or not Path(name).suffix else f"*{Path(name).suffix}"


def _is_motion(file: Path) -> bool:
    """Tell a file that may hold a motion, by its name, and of arrays by theirs; what is damaged counts as one."""
    from ncs_jax.io.character.motion import FORMATS, TABLES

    suffix = file.suffix.lower()
    if suffix not in FORMATS or BESIDE.match(file.name):
        return False
    if AMASS.search(file.name) or suffix not in TABLES:
        return True
    try:
        names = set(TABLES[suffix](file, lambda _: False).names)
    except InputError:
        return True  # reading it says what is wrong
    return bool(names & ROTATIONS) or not names & {"vertices", "faces", "betas"}


def _lines(file: Path) -> Iterator[str]:
    """Yield the motions that a file lists, each with its frames. A comment begins with #, first in a line or after a space."""
    from ncs_jax.io.tables.files import text_of

    rows = [re.split(r"(?:^|\s)#", line, maxsplit=1)[0].strip() for line in text_of(file)[1].split("\n")]
    rows = [re.sub(r"\s+(\[[-\d\s]*:[-\d\s]*\])$", r"\1", row) for row in rows if row]  # WALK.bvh [10:300]
    if file.suffix.lower() not in (".csv", ".tsv"):
        yield from rows
        return
    table = [[cell.strip() for cell in row] for row in csv.reader(rows, delimiter="\t" if "\t" in "".join(rows) else ",")]
    heads = [cell.lower() for cell in table[0]] if table else []
    at = {kind: next((heads.index(n) for n in names if n in heads), -1)
          for kind, names in (("file", NAMING), ("start", START), ("stop", STOP))}  # fmt: skip
    if at["file"] < 0:  # no heads: the file, and its frames where the next columns are numbers
        at = {"file": 0, "start": 1, "stop": 2}
    else:
        table = table[1:]
    for number, row in enumerate(table, 1):
        name, start, stop = (row[i] if 0 <= i < len(row) else "" for i in at.values())
        if not name:
            raise InputError("a motion expected", file=file, field=f"row {number}", value=",".join(row), mend="name its file")
        if any(cell and not re.fullmatch(r"-?\d+(\.0*)?", cell) for cell in (start, stop)):
            raise InputError(
                "whole numbers of frames expected", file=file, field=f"row {number}", value=f"{start}, {stop}",
                mend="write FILE,START,STOP, or name the columns in a first row: file,start,stop",
            )  # fmt: skip
        first, end = (str(int(float(cell))) if cell else "" for cell in (start, stop))
        yield f"{name}[{first}:{end}]" if (first or end) and split_frames(name)[1] is None else name

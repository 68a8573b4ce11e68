"""A folder of .obj files, one for each frame, as simulators and modellers write them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.obj import Polygons, polygons_of
from ncs_jax.io.mesh.polygons import triangulate
from ncs_jax.io.tables.files import LARGEST, text_of

__all__ = ["read_obj_folder"]

SAME = "export every frame with the same mesh: no remeshing, and no modifier that adds or orders vertices by frame"


def read_obj_folder(path: str | Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """Read a folder of .obj: the folder, positions (T, V, 3), and the triangles (F, 3) that all frames share.

    The files are taken in the order of the numbers in their names: frame2.obj comes before frame10.obj. Other files are
    ignored. Polygons are cut once, as they lie in the first frame. All objects of a file are read.

    Raises:
        InputError: there is no .obj, one cannot be read, or its vertices or polygons are not those of the first.
    """
    folder = Path(path).expanduser()
    files = sorted((f for f in folder.iterdir() if f.suffix.lower() == ".obj"), key=lambda file: _in_order(file.name))
    if not files:
        what = "a folder with an .obj for each frame, or a file expected"
        raise InputError(what, file=folder, value="no .obj", mend="check the path")
    first, lines = polygons_of(files[0]), _lines(files[0])
    if not len(first.vertices) or not len(first.counts):
        raise InputError("vertices and polygons expected", file=files[0], field="faces", value="none", mend="export the mesh")
    if len(files) * first.vertices.nbytes > LARGEST:
        raise InputError(f"at most {LARGEST} bytes expected", file=folder, value=f"{len(files)} files", mend="leave some out")
    frames = [first.vertices]
    for number, file in enumerate(files[1:], 1):
        own = _lines(file)
        x = _vertices(own[0], len(first.vertices)) if own[1] == lines[1] and own[2] else None
        frames.append(_like(first, polygons_of(file), number) if x is None else x)
    return folder, np.stack(frames), triangulate(first.file, first.vertices, first.counts, first.corners[:, 0])


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """Return what names are sorted by: numbers in them as numbers, the rest as text."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part]


def _lines(file: Path) -> tuple[list[str], list[str], bool]:
    """Return the lines of vertices and of polygons, and whether no line goes on in the next."""
    text = text_of(file)[1]
    lines = text.splitlines()
    return [n for n in lines if n.startswith("v ")], [n for n in lines if n.startswith("f ")], "\\" not in text


def _vertices(lines: list[str], count: int) -> np.ndarray | None:
    """Return the vertices (V, 3) of lines, all at once; None where they are not `count` plain ones."""
    try:
        x = np.array(" ".join(line[2:] for line in lines).split(), np.float64)
    except ValueError:
        return None
    each = x.size // count
    return x.reshape(count, each)[:, :3] if len(lines) == count and each >= 3 and x.size == each * count else None


def _like(first: Polygons, mesh: Polygons, number: int) -> np.ndarray:
    """Return a frame's vertices (V, 3), after a check that its mesh is that of the first frame."""
    size = f"{len(first.vertices)} vertices and {len(first.counts)} polygons"
    found = f"{len(mesh.vertices)} vertices and {len(mesh.counts)} polygons"
    if found == size and not np.array_equal(mesh.counts, first.counts):
        found = f"polygon {int((mesh.counts != first.counts).argmax())} of another number of corners"
    elif found == size:
        other = np.flatnonzero(mesh.corners[:, 0] != first.corners[:, 0])
        if not len(other):
            return mesh.vertices
        polygon = int(np.searchsorted(np.cumsum(first.counts), other[0], side="right"))
        found = f"polygon {polygon} of other vertices"
    raise InputError(
        f"the mesh of the first frame, {first.file.name}, expected: {size}, in the same order", file=mesh.file,
        field=f"frame {number}", value=found, mend=SAME,
    )  # fmt: skip

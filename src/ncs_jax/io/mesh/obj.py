"""Wavefront .obj. Vertices keep the file's order and number: texture seams and normals do not split them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.part import NamedMesh, chosen_meshes, one_object
from ncs_jax.io.mesh.polygons import triangle_corners
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.mesh.weld import distinct
from ncs_jax.io.tables.files import text_of

__all__ = ["Polygons", "format_obj", "obj_faces", "polygons_of", "read_obj"]

FAR = 1e30  # what is farther, or no number, is none that single precision has


class Polygons(NamedTuple):
    """What an .obj holds as it stands there, not checked: vertices (V, 3), texture coordinates (N, 2), and polygons by corner.

    counts: (P,) corners of each polygon. corners: (sum of counts, 2) vertex and texture coordinate of each, -1 for none.
    labels: of each polygon, the names of its object, groups and material.
    """

    file: Path
    vertices: np.ndarray
    coordinates: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    labels: list[tuple[str, str, str]]


def read_obj(path: str | Path, mesh: Sequence[str] = ()) -> RawGarment:
    """Read an .obj: vertices, triangles and texture coordinates.

    Polygons are cut as `triangulate` says. Negative numbers count back from the last vertex. Normals, lines and points are
    ignored. Texture coordinates are None where a corner has none.

    Args:
        path: the file. mesh: names of objects (`o`), groups (`g`) or materials (`usemtl`) to read, with their vertices alone.
            None: the file must hold one object; its groups and materials are joined.
    """
    file, x, coordinates, count, corner, labels = polygons_of(path)
    chosen = _chosen(file, mesh, labels, np.repeat(np.arange(len(count)), count), corner[:, 0])
    if not chosen.all():
        corner, count = corner[np.repeat(chosen, count)], count[chosen]
        used, corner[:, 0] = np.unique(corner[:, 0], return_inverse=True)
        x = x[used]
    vertex, coordinate = corner[triangle_corners(file, x, count, corner[:, 0])].reshape(-1, 3, 2).transpose(2, 0, 1)
    none = int((coordinate < 0).any(axis=1).sum())
    uv = coordinates[coordinate] if len(coordinates) and not none else None
    notes = (f"{none} triangles have no texture coordinates, so none are kept",) if len(coordinates) and none else ()
    return RawGarment(file, x, vertex.astype(np.int32), uv, notes=notes)


def polygons_of(path: str | Path) -> Polygons:
    """Read the lines of an .obj that are vertices, texture coordinates, polygons and names."""
    file, text = text_of(path)
    vertices: list[list[float]] = []
    coordinates: list[list[float]] = []
    counts: list[int] = []
    corners: list[tuple[int, int]] = []  # (vertex, texture coordinate)
    names = {"o": "", "g": "", "usemtl": ""}
    labels: list[tuple[str, str, str]] = []  # of each polygon
    lines: list[int] = []
    for line, words in _lines(text):
        if words[0] == "v":
            vertices.append(_numbers(file, line, words, 3))
        elif words[0] == "vt":
            coordinates.append(_numbers(file, line, words, 2))
        elif words[0] == "f":
            polygon = [_corner(file, line, word, len(vertices), len(coordinates)) for word in words[1:]]
            if len(polygon) < 3:
                raise InputError("three corners or more expected", file=file, field=f"line {line}", value=" ".join(words)[:60])
            counts.append(len(polygon))
            lines.append(line)
            corners.extend(polygon)
            labels.append((names["o"], names["g"], names["usemtl"]))
        elif words[0] in names:
            names[words[0]] = " ".join(words[1:])
    x, uv = np.array(vertices, np.float64).reshape(-1, 3), np.array(coordinates, np.float64).reshape(-1, 2)
    count, corner = np.array(counts, np.int64), np.array(corners, np.int64).reshape(-1, 2)
    for k, (what, there) in enumerate((("vertex", x), ("texture coordinate", uv))):
        beyond = np.flatnonzero(corner[:, k] >= len(there))
        if len(beyond):
            raise _no_such(
                file,
                lines[int(np.repeat(np.arange(len(count)), count)[beyond[0]])],
                what,
                len(there),
                int(corner[beyond[0], k]) + 1,
            )
    return Polygons(file, x, uv, count, corner, labels)


def _chosen(file: Path, mesh: Sequence[str], labels: list, owner: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Return which polygons (P,) are meant by the names of objects, groups or materials; owner: of each corner, its polygon."""
    different = list(dict.fromkeys(labels))
    objects = list(dict.fromkeys(o or g for o, g, _ in different))
    place = {label: i for i, label in enumerate(different)}
    number = np.array([place[label] for label in labels], np.int64)
    of_corner = number[owner]
    named = []
    for i, (o, g, material) in enumerate(different):
        others = tuple(dict.fromkeys(([g] if o and g else []) + g.split()))  # several groups may stand in one line
        named.append(NamedMesh(o or g, objects.index(o or g), len(np.unique(corner[of_corner == i])), others, material))
    chosen = chosen_meshes(file, "garment.mesh", mesh, named)
    if not mesh:
        one_object(file, "garment.mesh", [n for n, (o, _, _) in zip(named, different, strict=True) if o])
    return chosen[number] if len(number) else np.ones(0, bool)


def _lines(text: str):
    """Yield line number and words of each line that is not empty or a comment; a backslash joins a line with the next."""
    kept: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if words and words[-1].endswith("\\"):
            kept += [*words[:-1], words[-1][:-1]] if len(words[-1]) > 1 else words[:-1]
            continue
        words, kept = kept + words, []
        if words:
            yield number, words
    if kept:
        yield number, kept


def _numbers(file: Path, line: int, words: list[str], count: int) -> list[float]:
    try:
        numbers = [float(w) for w in words[1 : count + 1]]
    except ValueError:
        numbers = []
    if words[0] == "vt" and len(numbers) == 1:
        numbers.append(0.0)
    if len(numbers) != count or not all(abs(number) < FAR for number in numbers):
        raise InputError(
            f"{count} finite numbers expected", file=file, field=f"line {line}", value=" ".join(words)[:60],
            mend="mend that line, or export the mesh again",
        )  # fmt: skip
    return numbers


def _corner(file: Path, line: int, word: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Return a corner's vertex and texture coordinate, from 0 (-1: none), of `v`, `v/vt`, `v//vn` or `v/vt/vn`.

    vertices, coordinates: how many stand above it, from which negative numbers count back.
    """
    parts = word.split("/")
    try:
        vertex = int(parts[0])
        coordinate = int(parts[1]) if len(parts) > 1 and parts[1] else None
    except ValueError:
        raise InputError("v, v/vt, v//vn or v/vt/vn expected", file=file, field=f"line {line}", value=word[:60]) from None
    v = vertex - 1 if vertex > 0 else vertices + vertex
    if vertex == 0 or v < 0:
        raise _no_such(file, line, "vertex", vertices, vertex)
    if coordinate is None:
        return v, -1
    t = coordinate - 1 if coordinate > 0 else coordinates + coordinate
    if coordinate == 0 or t < 0:
        raise _no_such(file, line, "texture coordinate", coordinates, coordinate)
    return v, t


def _no_such(file: Path, line: int, what: str, count: int, found: int) -> InputError:
    """Return the error of a corner that names a vertex or a texture coordinate that the file does not have."""
    return InputError(
        f"a {what} from 1 to {count} expected, or from -{count} to -1", file=file, field=f"faces, line {line}", value=found,
        mend="counting starts at 1; export the mesh again" + ("" if what == "vertex" else ", or without texture coordinates"),
    )  # fmt: skip


def obj_faces(faces: np.ndarray, uv: np.ndarray | None) -> str:
    """Return the lines of triangles (F, 3), and of their corners' texture coordinates (F, 3, 2), if any, as text of an .obj."""
    if uv is None:
        return ("f %d %d %d\n" * len(faces)) % tuple((faces.reshape(-1) + 1).tolist())
    rows = np.asarray(uv, np.float64).reshape(-1, 2)
    kept, number = distinct(rows)
    corners = np.stack([faces.reshape(-1), number], axis=1) + 1
    lines = ("vt %.9g %.9g\n" * len(kept)) % tuple(rows[kept].reshape(-1).tolist())
    return lines + ("f %d/%d %d/%d %d/%d\n" * len(faces)) % tuple(corners.reshape(-1).tolist())


def format_obj(vertices: np.ndarray, faces: str) -> str:
    """Return one frame as the text of an .obj; `faces` is text of `obj_faces`, because it is the same in every frame."""
    flat = np.asarray(vertices, dtype=np.float64).reshape(-1)
    return ("v %.9g %.9g %.9g\n" * len(vertices)) % tuple(flat.tolist()) + faces

"""Polygon files (.ply), text or binary of either byte order. Vertices keep the file's order and number."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.polygons import triangle_corners
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.tables.files import LARGEST, readable, reading
from ncs_jax.io.tables.table import indices

__all__ = ["read_ply"]

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
TYPES |= {"float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
POLYGONS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)  # name, type, and type of a list's length or ""


def read_ply(path: str | Path) -> RawGarment:
    """Read a .ply: vertices, triangles and texture coordinates.

    Polygons are cut as `triangulate` says. Edges and whatever else the file holds are ignored.
    """
    file = readable(path)
    if file.stat().st_size > LARGEST:
        raise InputError(f"at most {LARGEST} bytes expected", file=file, value=f"{file.stat().st_size} bytes")
    with reading(file, ".ply"):
        data = file.read_bytes()
        order, elements, start = _header(file, data)
        source: _Words | _Bytes = _Words(file, data[start:].split()) if not order else _Bytes(file, data, start, order)
        columns: dict[str, dict[str, np.ndarray]] = {}
        lengths: dict[str, np.ndarray] = {}
        for e in elements:
            columns[e.name], lengths[e.name] = _element(e, source)
        points, polygons = columns.get("vertex", {}), columns.get("face", {})
        missing = [n for n in "xyz" if n not in points]
        if missing:
            raise InputError("missing", file=file, field=f"vertex.{missing[0]}", mend="export the garment's mesh")
        x = np.stack([points[n].astype(np.float64) for n in "xyz"], axis=1)
        pair = next((p for p in COORDINATES if p[0] in points and p[1] in points), None)
        uv = None if pair is None else np.stack([points[n].astype(np.float64) for n in pair], axis=1)
        name = next((n for n in POLYGONS if n in polygons), None)
        if name is None:
            return RawGarment(file, x, np.zeros((0, 3), np.int32))
        corners = polygons[name]
        if corners.dtype.kind == "f" and (np.abs(corners) < 2**31).all() and (corners == np.floor(corners)).all():
            corners = corners.astype(np.int64)  # a text file does not say that they are whole numbers
        corners = indices(file, f"face.{name}", corners, ("N",), len(x), "vertices")
        cut = triangle_corners(file, x, lengths["face"], corners)
        own = polygons.get("texcoord", np.zeros(0))  # of each polygon's corners, as MeshLab writes them
        uv = own.astype(np.float64).reshape(-1, 2) if len(own) == 2 * len(corners) > 0 else None if uv is None else uv[corners]
        return RawGarment(file, x, corners[cut].astype(np.int32), None if uv is None else uv[cut])


def _header(file: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Return the byte order ("" for text), the elements, and where the data begin."""
    end = data.find(b"end_header")
    mark = next((m for m in (b"\r\n", b"\n", b"\r") if data.startswith(b"ply" + m)), b"\n")  # ends every line of the header
    stop = data.find(mark, end) + len(mark)
    if not data.startswith(b"ply") or end < 0 or stop < end:
        raise InputError("a header from ply to end_header expected", file=file, field="header", mend="export it again")
    order, elements = None, list[_Element]()
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", kind, _] if kind in ORDERS:
                order = ORDERS[kind]
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if elements and length in TYPES and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind], ""))
            case _:
                raise InputError("a line of a .ply header expected", file=file, field="header", value=line[:60])
    if order is None:
        raise InputError(f"a format expected, one of {', '.join(ORDERS)}", file=file, field="header", mend="export it again")
    return order, elements, stop


def _element(e: _Element, source: _Words | _Bytes) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the properties of an element by name, lists end to end, and the length of every row's first list."""
    lists = [i for i, p in enumerate(e.properties) if p[2]]
    parts: list[list[np.ndarray]] = [[] for _ in e.properties]
    lengths = [np.zeros(0, np.int64)]
    done, block = 0, e.count if not lists else 1
    while done < e.count:
        # Neighbouring rows mostly have lists of the same length: such rows are read at once.
        begin, row = source.at, list[tuple[str, int]]()
        for _, kind, length in e.properties:
            size = int(source.take([(length, 1)], 1)[0][0, 0]) if length else 1
            source.take([(kind, size)], 1)
            row += [(length, 1), (kind, size)] if length else [(kind, 1)]
        width, source.at = source.at - begin, begin
        rows = min(block, e.count - done) if not lists else max(1, min(block, e.count - done, source.left() // max(width, 1)))
        columns = iter(source.take(row, rows))
        found = [(next(columns) if p[2] else None, next(columns)) for p in e.properties]
        sizes = [size[:, 0] for size, _ in found if size is not None]
        same = np.all([size == size[0] for size in sizes], axis=0) if sizes else np.ones(rows, bool)
        good = rows if same.all() else int(np.argmin(same))
        source.at = begin + good * width
        for part, (_, column) in zip(parts, found, strict=True):
            part.append(column[:good].reshape(-1))
        if lists:
            lengths.append(np.full(good, found[lists[0]][1].shape[1]))
        done, block = done + good, 2 * block if good == rows else 1
    columns_of = {p[0]: np.concatenate(v) if v else np.zeros(0) for p, v in zip(e.properties, parts, strict=True)}
    return columns_of, np.concatenate(lengths)


class _Words:
    """The numbers of a text file, taken one after the other."""

    def __init__(self, file: Path, words: list[bytes]) -> None:
        self.file, self.words, self.at = file, words, 0

    def left(self) -> int:
        """Return how many numbers are left."""
        return len(self.words) - self.at

    def take(self, row: list[tuple[str, int]], rows: int) -> list[np.ndarray]:
        """Return columns (rows, size) of the next rows; each has a type, which a text does not show, and a size."""
        sizes = [size for _, size in row]
        count = _enough(self.file, rows, sum(sizes), self.left(), "numbers")
        taken = np.fromiter(map(float, self.words[self.at : self.at + count]), np.float64, count).reshape(rows, sum(sizes))
        self.at += count
        return np.split(taken, np.cumsum(sizes)[:-1], axis=1)


class _Bytes:
    """The numbers of a binary file, taken one after the other."""

    def __init__(self, file: Path, data: bytes, at: int, order: str) -> None:
        self.file, self.data, self.at, self.order = file, data, at, order

    def left(self) -> int:
        """Return how many bytes are left."""
        return len(self.data) - self.at

    def take(self, row: list[tuple[str, int]], rows: int) -> list[np.ndarray]:
        """Return columns (rows, size) of the next rows; each has a type and a size."""
        kind = np.dtype([(f"f{i}", self.order + k, (size,)) for i, (k, size) in enumerate(row)])
        count = _enough(self.file, rows, kind.itemsize, self.left(), "bytes")
        taken = np.frombuffer(self.data, kind, rows, self.at) if count else np.zeros(rows, kind)
        self.at += count
        return [taken[f"f{i}"] for i in range(len(row))]


def _enough(file: Path, rows: int, width: int, left: int, what: str) -> int:
    """Return rows times width, after a check that so much is left."""
    if rows < 0 or width < 0 or rows * width > left:
        raise InputError(
            f"{rows * width} {what} more expected, as the header says", file=file, field="data", value=f"{left} {what}",
            mend="the file is cut short or damaged; export it again",
        )  # fmt: skip
    return rows * width

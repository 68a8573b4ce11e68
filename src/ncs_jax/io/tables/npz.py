"""NumPy's .npz, a zip of arrays. Nothing is unpickled, and no header may claim more memory than its file can fill."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import readable, reading, replacing, unpackable
from ncs_jax.io.tables.table import Table

__all__ = ["npz_shape", "read_npz", "write_npz"]

HEADER = 10_000  # bytes; NumPy's own limit
SUFFIX = ".npy"


def read_npz(path: str | Path, wanted: Callable[[str], bool]) -> Table:
    """Read the arrays whose names are wanted; the others stay unread."""
    file = readable(path)
    with reading(file, ".npz"), zipfile.ZipFile(file) as archive:
        members = {m.filename.removesuffix(SUFFIX): m for m in archive.infolist() if m.filename.endswith(SUFFIX)}
        return Table(file, {n: _array(file, n, archive, m) for n, m in members.items() if wanted(n)}, tuple(members))


def npz_shape(path: str | Path, name: str) -> tuple[int, ...]:
    """Return the shape of an array without reading it; () where the file has none of that name, or cannot be read."""
    try:
        with zipfile.ZipFile(Path(path).expanduser()) as archive, archive.open(name + SUFFIX) as stream:
            return _head(Path(path), name, stream)[0]
    except Exception:  # whoever reads it says what is wrong
        return ()


def _head(file: Path, name: str, stream) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, order and type of the array that follows in a stream."""
    major, _ = npy.read_magic(stream)
    width = 2 if major == 1 else 4
    size = int.from_bytes(stream.read(width), "little")
    if size > HEADER:
        raise InputError(f"a header of at most {HEADER} bytes expected", file=file, field=name, value=f"{size} bytes")
    head = io.BytesIO(size.to_bytes(width, "little") + stream.read(size))
    return (npy.read_array_header_1_0 if major == 1 else npy.read_array_header_2_0)(head)


def _array(file: Path, name: str, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as stream:
        shape, fortran, dtype = _head(file, name, stream)
        if dtype.kind not in "biufUS":
            raise InputError(
                "plain numbers or text expected", file=file, field=name, value=f"dtype {dtype}",
                mend="objects (pickle) are never loaded; write an array of numbers",
            )  # fmt: skip
        if min(shape, default=0) < 0:
            raise InputError("sizes of 0 and above expected", file=file, field=name, value=shape, mend="write it again")
        count = math.prod(shape) * dtype.itemsize
        unpackable(file, name, count)
        data = stream.read(count)
        if len(data) != count or stream.read(1):  # reading to the end also compares the checksum
            raise InputError(
                f"{count} bytes expected, as the header says", file=file, field=name,
                value=f"{len(data)} bytes" if len(data) < count else "more", mend="write the file again",
            )  # fmt: skip
    array = np.frombuffer(data, dtype) if count else np.empty(math.prod(shape), dtype)
    return array.reshape(shape, order="F" if fortran else "C")


def write_npz(path: str | Path, **arrays: np.ndarray) -> None:
    """Write arrays under their names; the file appears whole or not at all."""
    with replacing(path) as part, part.open("xb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)

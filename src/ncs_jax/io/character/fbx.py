"""The container of FBX 7, binary or text: a tree of named records, and typed arrays unpacked when they are asked for."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import LARGEST, readable, unpackable

__all__ = ["Fbx", "Packed", "Record", "read_fbx"]

MAGIC = b"Kaydara FBX Binary  \0"
DEEPEST = 32  # records in records
MOST = 2_000_000  # records, and values that stand by themselves
SINGLE = {b"B": "<?", b"C": "<?", b"Z": "<b", b"Y": "<h", b"I": "<i", b"F": "<f", b"D": "<d", b"L": "<q"}
ARRAYS = {b"f": "<f4", b"d": "<f8", b"l": "<i8", b"i": "<i4", b"b": "<i1", b"c": "<i1"}


@dataclass(frozen=True, eq=False)
class Packed:
    """An array as it is in the file: `count` numbers in bytes, deflated or not, or in text."""

    count: int
    dtype: str
    data: bytes | str
    deflated: bool


@dataclass(frozen=True, eq=False)
class Record:
    """A name, values (numbers, text or arrays) and the records in it."""

    name: str
    values: list
    inner: list[Record]

    def all(self, name: str) -> Iterator[Record]:
        """Return the records in this one that have a name."""
        return (r for r in self.inner if r.name == name)

    def first(self, name: str) -> Record:
        """Return the first record in this one that has a name; an empty record where there is none."""
        return next(self.all(name), Record(name, [], []))

    def value(self, index: int, kinds: type | tuple[type, ...], default):
        """Return a value if it has one of these types, else the default."""
        found = self.values[index] if index < len(self.values) else default
        return found if isinstance(found, kinds) and not isinstance(found, bool) else default


@dataclass(eq=False)
class Fbx:
    """A file's records under one root. `taken` counts the bytes of all arrays read so far, at most LARGEST."""

    file: Path
    root: Record
    taken: int = field(default=0)

    def wrong(self, expected: str, where: str, value: object = None, mend: str = "export the file again") -> InputError:
        """Return the error to raise about something in this file."""
        return InputError(expected, file=self.file, field=where, value=value, mend=mend)

    def array(self, owner: Record, name: str, where: str, whole: bool = False) -> np.ndarray:
        """Return the numbers of a record in another, int64 or finite float64; none where it is not there."""
        packed = owner.first(name).value(0, Packed, Packed(0, "<f8", b"", False))
        label = f"{where} {name}"
        size = packed.count * 8
        unpackable(self.file, label, size)
        self.taken += size
        if self.taken > LARGEST:
            raise self.wrong(f"at most {LARGEST} bytes in all arrays expected", label, self.taken, "export one character")
        if isinstance(packed.data, str):
            words = packed.data.split(",") if packed.data.strip() else []
            array = np.array([float(w) for w in words])
        else:
            dtype, data = np.dtype(packed.dtype), packed.data
            if packed.deflated:
                data = zlib.decompressobj().decompress(data, packed.count * dtype.itemsize + 1)
            if len(data) != packed.count * dtype.itemsize:
                raise self.wrong(f"{packed.count * dtype.itemsize} bytes expected", label, f"{len(data)} bytes")
            array = np.frombuffer(data, dtype)
        if len(array) != packed.count or not (np.abs(array.astype(np.float64)) < 1e30).all():
            raise self.wrong(f"{packed.count} finite numbers expected", label, f"{len(array)} numbers")
        return array.astype(np.int64 if whole else np.float64)


def read_fbx(path: str | Path) -> Fbx:
    """Read the records of an .fbx of version 7, binary or text. Nothing but this file is opened."""
    file = readable(path)
    size = file.stat().st_size
    if size > LARGEST // 4:
        raise InputError(
            f"at most {LARGEST // 4} bytes expected", file=file, value=f"{size} bytes", mend="export one character"
        )
    data = file.read_bytes()
    if data.startswith(MAGIC):
        root, version = _Binary(file, data).root()
    else:
        root = _Text(file, data.decode("utf-8-sig", errors="replace")).root()
        version = root.first("FBXHeaderExtension").first("FBXVersion").value(0, int, 0)
    if not 7000 <= version < 8000:
        raise InputError("FBX 7 expected", file=file, field="version", value=version, mend="export it as FBX 2011 or newer")
    return Fbx(file, root)


class _Binary:
    """Records of a binary file."""

    def __init__(self, file: Path, data: bytes) -> None:
        self.file, self.data, self.left = file, data, MOST

    def cut(self, place: int) -> InputError:
        """Return the error to raise where a record does not end as it says."""
        return InputError(
            "whole records expected", file=self.file, field=f"byte {place}", value=f"{len(self.data)} bytes in all",
            mend="the file is cut short or damaged; export it again",
        )  # fmt: skip

    def root(self) -> tuple[Record, int]:
        """Return all records under one, and the version."""
        if len(self.data) < 27:
            raise self.cut(len(self.data))
        version = struct.unpack_from("<I", self.data, 23)[0]
        self.head = "<QQQB" if version >= 7500 else "<IIIB"
        return Record("", [], self.records(27, len(self.data), 0)), version

    def records(self, place: int, end: int, depth: int) -> list[Record]:
        """Return the records from a place up to an empty one, or to the end."""
        found, size = [], struct.calcsize(self.head)
        while place + size <= end:
            stop, count, length, letters = struct.unpack_from(self.head, self.data, place)
            if stop == 0:
                break
            self.left -= 1 + count
            begin = place + size + letters
            if not begin + length <= stop <= end or depth > DEEPEST or self.left < 0:
                raise self.cut(place)
            name = self.data[place + size : begin].decode("utf-8", errors="replace")
            values = self.values(begin, begin + length, count)
            found.append(Record(name, values, self.records(begin + length, stop, depth + 1)))
            place = stop
        return found

    def values(self, place: int, end: int, count: int) -> list:
        """Return the values of a record: numbers, text, bytes or packed arrays."""
        found: list = []
        for _ in range(count):
            kind, place = self.data[place : place + 1], place + 1
            if kind in SINGLE and place + struct.calcsize(SINGLE[kind]) <= end:
                found.append(struct.unpack_from(SINGLE[kind], self.data, place)[0])
                place += struct.calcsize(SINGLE[kind])
            elif kind in (b"S", b"R") and place + 4 <= end:
                length = struct.unpack_from("<I", self.data, place)[0]
                text = self.data[place + 4 : place + 4 + length]
                found.append(text.decode("utf-8", errors="replace") if kind == b"S" else text)
                place += 4 + length
            elif kind in ARRAYS and place + 12 <= end:
                length, packing, size = struct.unpack_from("<III", self.data, place)
                size = size if packing else length * np.dtype(ARRAYS[kind]).itemsize
                found.append(Packed(length, ARRAYS[kind], self.data[place + 12 : place + 12 + size], bool(packing)))
                place += 12 + size
            else:
                raise self.cut(place)
            if place > end:
                raise self.cut(place)
        return found


TOKEN = re.compile(
    r"""\s+ | ;[^\n]* | "(?P<text>[^"]*)" | (?P<name>[A-Za-z_][\w|-]*)\s*: | \*(?P<count>\d+)\s*\{\s*a:(?P<array>[^}]*)\} |
        (?P<number>[-+]?[\d.][\w.+-]*) | (?P<word>[A-Za-z]+) | (?P<mark>[{},])""",
    re.VERBOSE,
)


class _Text:
    """Records of a text file."""

    def __init__(self, file: Path, text: str) -> None:
        self.file, self.text = file, text

    def wrong(self, place: int) -> InputError:
        """Return the error to raise about the text at a place."""
        line = self.text.count("\n", 0, place) + 1
        return InputError(
            "the records of an FBX expected", file=self.file, field=f"line {line}", value=self.text[place : place + 20],
            mend="the file is damaged or of another format; export it again",
        )  # fmt: skip

    def root(self) -> Record:
        """Return all records under one."""
        place, left = 0, 10 * MOST
        open_records = [Record("", [], [])]
        last = open_records[0]
        while place < len(self.text):
            token = TOKEN.match(self.text, place)
            left -= 1
            if token is None or len(open_records) > DEEPEST or left < 0:
                raise self.wrong(place)
            kind = token.lastgroup
            if kind == "array":
                last.values.append(Packed(int(token["count"]), "<f8", token["array"], False))
            elif kind == "name":
                last = Record(token["name"], [], [])
                open_records[-1].inner.append(last)
            elif kind == "mark" and token["mark"] == "{":
                open_records.append(last)
            elif kind == "mark" and token["mark"] == "}":
                if len(open_records) < 2:
                    raise self.wrong(place)
                last = open_records.pop()
            elif kind == "text":
                last.values.append(token["text"].replace("&quot;", '"'))
            elif kind == "number":
                last.values.append(self.number(token["number"], place))
            elif kind == "word":
                last.values.append(token["word"])
            place = token.end()
        if len(open_records) != 1 or not open_records[0].inner:
            raise self.wrong(len(self.text) - 1)
        return open_records[0]

    def number(self, word: str, place: int) -> int | float:
        """Return the number that a word means."""
        try:
            return int(word) if re.fullmatch(r"[-+]?\d{1,20}", word) else float(word)
        except ValueError:
            raise self.wrong(place) from None

"""The container of glTF 2.0 (.glb, .vrm, .vrma, .gltf): JSON, the buffers that it names, and the typed arrays in them."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import LARGEST, readable, reading, unpackable

__all__ = ["BINARY", "COMPONENTS", "WIDTHS", "Gltf", "read_gltf"]

MESHOPT = "export without mesh compression; gltfpack compresses only with -c or -cc"
TEXT = 128 * 2**20  # bytes of JSON, at most; parsed it takes some twenty times as many
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Extensions that a file may require, because they change neither shape nor movement. With others it would be misread.
HARMLESS = (
    "KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_", "KHR_mesh_quantization", "KHR_xmp",
    "KHR_animation_pointer", "VRM", "VRMC_", "KHR_draco_mesh_compression",
)  # fmt: skip
BINARY = (".glb", ".vrm", ".vrma")  # those of VRM are .glb under another name


@dataclass(eq=False)
class Gltf:
    """A file's JSON and binary chunk. All is checked when it is taken out; arrays are kept, at most LARGEST bytes of them."""

    file: Path
    tree: dict
    chunk: bytes | None
    buffers: dict[int, bytes] = field(default_factory=dict)
    arrays: dict[int, np.ndarray] = field(default_factory=dict)
    taken: int = 0

    def wrong(self, expected: str, where: str, value: object = None, mend: str = "export the file again") -> InputError:
        """Return the error to raise about something in this file."""
        return InputError(expected, file=self.file, field=where, value=value, mend=mend)

    def objects(self, name: str, owner: dict | None = None, where: str = "") -> list[dict]:
        """Return a list of objects, at the top of the file or in one of its objects; empty where it is not there."""
        found = (self.tree if owner is None else owner).get(name, [])
        if not isinstance(found, list) or not all(isinstance(o, dict) for o in found):
            raise self.wrong("a list of objects expected", f"{where} {name}".strip(), type(found).__name__)
        return found

    def object(self, name: str, owner: dict, where: str) -> dict:
        """Return an object in another; an empty one where it is not there."""
        found = owner.get(name, {})
        if not isinstance(found, dict):
            raise self.wrong("an object expected", f"{where} {name}", found)
        return found

    def whole(self, name: str, owner: dict, where: str, below: int, default: int | None = None) -> int:
        """Return a whole number, after a check that it is from 0 to below - 1."""
        found = owner.get(name, default)
        if not isinstance(found, int) or isinstance(found, bool) or not 0 <= found < below:
            raise self.wrong(f"a whole number from 0 to {below - 1} expected" if below else "nothing to refer to", where, found)
        return found

    def wholes(self, name: str, owner: dict, where: str, below: int) -> list[int]:
        """Return a list of different whole numbers from 0 to below - 1; empty where it is not there."""
        found = owner.get(name, [])
        if not isinstance(found, list):
            raise self.wrong("a list expected", f"{where} {name}", found)
        numbers = [self.whole("", {"": n}, f"{where} {name}", below) for n in found]
        if len(set(numbers)) != len(numbers):
            raise self.wrong("different numbers expected", f"{where} {name}", found)
        return numbers

    def numbers(self, name: str, owner: dict, where: str, default: tuple[float, ...]) -> np.ndarray:
        """Return finite numbers, as many as the default has."""
        found = owner.get(name, default)
        good = isinstance(found, list | tuple) and len(found) == len(default)
        if not good or not all(isinstance(n, int | float) and abs(n) < 1e30 for n in found):
            raise self.wrong(f"{len(default)} finite numbers expected", f"{where} {name}", found)
        return np.array(found, np.float64)

    def text(self, name: str, owner: dict, where: str) -> str:
        """Return a text; empty where it is not there."""
        found = owner.get(name, "")
        if not isinstance(found, str):
            raise self.wrong("a text expected", f"{where} {name}", found)
        return found

    def accessor(self, index: int, kinds: tuple[str, ...], where: str) -> np.ndarray:
        """Return an accessor as rows (count, width) in its own type, finite; normalized integers become float64, -1 to 1."""
        if index not in self.arrays:
            self.arrays[index] = self._accessor(index)
        array = self.arrays[index]
        kind = next(k for k, width in WIDTHS.items() if width == array.shape[1])
        if kind not in kinds:
            raise self.wrong(f"{' or '.join(kinds)} expected", f"{where}, accessor {index}", kind)
        return array

    def _accessor(self, index: int) -> np.ndarray:
        where, one = f"accessor {index}", self.objects("accessors")[index]
        kind, component = self.text("type", one, where), one.get("componentType")
        if kind not in WIDTHS or not isinstance(component, int) or component not in COMPONENTS:
            raise self.wrong(
                f"one of {', '.join(WIDTHS)} in one of the component types {', '.join(map(str, COMPONENTS))} expected", where,
                f"{kind}, {component}",
            )  # fmt: skip
        dtype, width = np.dtype(COMPONENTS[component]), WIDTHS[kind]
        count = self.whole("count", one, f"{where} count", 2**32)
        self._take(where, count * width * 8)
        if "bufferView" in one:
            array = self.rows(one, where, count, width, dtype)
        else:
            array = np.zeros((count, width), dtype)
        if "sparse" in one:
            sparse = self.object("sparse", one, where)
            changed = self.whole("count", sparse, f"{where} sparse count", count + 1)
            at = self.object("indices", sparse, f"{where} sparse")
            if (number := at.get("componentType")) not in (5121, 5123, 5125):
                raise self.wrong("unsigned whole numbers expected", f"{where} sparse indices", number)
            place = self.rows(at, f"{where} sparse indices", changed, 1, np.dtype(COMPONENTS[number]))[:, 0]
            if (place >= count).any():
                raise self.wrong(f"numbers below {count} expected", f"{where} sparse indices", int(place.max()))
            values = self.object("values", sparse, f"{where} sparse")
            array[place] = self.rows(values, f"{where} sparse values", changed, width, dtype)
        return self._checked(array, where, one.get("normalized", False) is True)

    def keep(self, index: int, array: np.ndarray, where: str, normalized: bool) -> None:
        """Take an array (count, width), unpacked elsewhere, as that of an accessor."""
        self._take(where, array.size * 8)
        self.arrays[index] = self._checked(array, where, normalized)

    def _checked(self, array: np.ndarray, where: str, normalized: bool) -> np.ndarray:
        """Return an array whose numbers are finite; normalized integers become float64, -1 to 1."""
        if normalized and array.dtype.kind in "iu":
            return np.maximum(array / float(np.iinfo(array.dtype).max), -1)
        with np.errstate(invalid="ignore"):
            if array.dtype.kind == "f" and not (np.abs(array) < 1e30).all():
                row = int(np.argmax(~(np.abs(array) < 1e30).all(axis=1)))
                raise self.wrong("finite numbers expected", f"{where}, entry {row}", array[row].tolist())
        return array

    def _take(self, where: str, size: int) -> None:
        """Count the bytes of an array before it is read, and refuse too many."""
        unpackable(self.file, where, size)
        self.taken += size
        if self.taken > LARGEST:
            raise self.wrong(f"at most {LARGEST} bytes in all accessors expected", where, self.taken, "split the file")

    def rows(self, owner: dict, where: str, count: int, width: int, dtype: np.dtype) -> np.ndarray:
        """Return a new array of the rows in a buffer view, one row every `byteStride` bytes."""
        views = self.objects("bufferViews")
        view = views[self.whole("bufferView", owner, f"{where} bufferView", len(views))]
        packed = [n for n in self.object("extensions", view, f"{where} bufferView") if n.endswith("meshopt_compression")]
        if packed:
            raise self.wrong("plain buffers expected", where, packed[0], MESHOPT)
        data = self._buffer(self.whole("buffer", view, f"{where} buffer", len(self.objects("buffers"))))
        begin = self.whole("byteOffset", view, f"{where} view's byteOffset", 2**40, 0)
        length = self.whole("byteLength", view, f"{where} view's byteLength", 2**40)
        offset = self.whole("byteOffset", owner, f"{where} byteOffset", 2**40, 0)
        row = width * dtype.itemsize
        stride = self.whole("byteStride", view, f"{where} byteStride", 2**16, row)
        needed = offset + (count - 1) * stride + row if count else 0
        if begin + length > len(data) or needed > length or stride < row:
            raise self.wrong(
                f"at most {min(length, max(len(data) - begin, 0))} bytes expected, in rows of {row} or more", where,
                f"{needed} bytes, one row every {stride}", "the file is cut short or its header is damaged; export it again",
            )  # fmt: skip
        if not count:
            return np.zeros((0, width), dtype)
        return np.array(np.ndarray((count, width), dtype, data, begin + offset, (stride, dtype.itemsize)))

    def _buffer(self, index: int) -> bytes:
        if index not in self.buffers:
            where, one = f"buffer {index}", self.objects("buffers")[index]
            length = self.whole("byteLength", one, f"{where} byteLength", 2**40)
            data = self._bytes(where, self.text("uri", one, where), index)
            if len(data) < length:
                raise self.wrong(f"{length} bytes expected, as its byteLength says", where, f"{len(data)} bytes")
            self.buffers[index] = data
        return self.buffers[index]

    def _bytes(self, where: str, uri: str, index: int) -> bytes:
        if not uri:
            if self.chunk is None or index:
                raise self.wrong("a uri, or the binary chunk of a .glb, expected", where, "neither")
            return self.chunk
        if uri.startswith("data:"):
            head, _, packed = uri.partition(",")
            try:
                if not head.endswith(";base64"):
                    raise ValueError("not base64")
                return base64.b64decode(packed, validate=True)
            except ValueError as error:  # also binascii.Error
                raise self.wrong(f"base64 expected: {error}", f"{where} uri", head[:60]) from None
        folder, name = self.file.parent.resolve(), unquote(uri)
        other = (folder / name).resolve() if "\0" not in name else folder
        if ":" in name or "\\" in name or folder not in other.parents:
            raise self.wrong(
                "a file in the same folder expected, or data", f"{where} uri", uri, "put the buffer beside the file"
            )
        other = readable(other)
        if sum(map(len, self.buffers.values())) + other.stat().st_size > LARGEST:
            raise self.wrong(f"at most {LARGEST} bytes expected", where, f"{other.stat().st_size} bytes", "split the file")
        return other.read_bytes()


def read_gltf(path: str | Path) -> Gltf:
    """Open a .glb, .vrm, .vrma or .gltf and check its header and JSON; accessors are read when they are asked for.

    Buffers may be in the file, in a data URI, or in another file of the same folder or below. Nothing else is opened. A file
    that was renamed is read as what it is: binary or text.
    """
    file = readable(path)
    binary = _is_binary(file)
    size, most = file.stat().st_size, LARGEST if binary else TEXT
    if size > most:
        raise InputError(f"at most {most} bytes expected", file=file, value=f"{size} bytes", mend="write a .glb, or split it")
    with reading(file, "glTF"):
        text, chunk = file.read_bytes(), None
        if binary:
            text, chunk = _chunks(file, text)
        tree = json.loads(text.decode("utf-8-sig"), parse_constant=_no_number)
        if not isinstance(tree, dict):
            raise InputError("an object expected", file=file, value=type(tree).__name__, mend="export the file again")
        found = Gltf(file, tree, chunk)
        version = found.text("version", found.object("asset", tree, "file"), "asset")
        if not version.startswith("2."):
            raise found.wrong("glTF 2 expected", "asset version", version or "none", "export it as glTF 2.0")
        required = tree.get("extensionsRequired", [])
        if not isinstance(required, list) or not all(isinstance(n, str) for n in required):
            raise found.wrong("a list of names expected", "extensionsRequired", required)
        foreign = [n for n in required if not n.startswith(HARMLESS)]
        if foreign:
            raise found.wrong(
                "an extension that is not read here",
                "extensionsRequired",
                foreign[0],
                MESHOPT if foreign[0].endswith("meshopt_compression") else "export without it",
            )
        return found


def _is_binary(file: Path) -> bool:
    """Tell whether a file is binary glTF: by how it begins, else by its suffix."""
    with file.open("rb") as stream:
        start = stream.read(16)
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")
    return start.startswith(b"glTF") or (file.suffix.lower() in BINARY and not text)


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


def _chunks(file: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a .glb."""
    if len(data) < 20 or data[:4] != b"glTF":
        value, mend = (
            ("a binary FBX", "name it .fbx") if data.startswith(b"Kaydara FBX") else (data[:4], "export the file again")
        )
        raise InputError("a .glb that begins with 'glTF' expected", file=file, value=value, mend=mend)
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError("glTF 2 expected", file=file, field="version", value=version, mend="export it as glTF 2.0")
    place, chunks = 12, []
    while place + 8 <= min(length, len(data)):
        size, kind = struct.unpack_from("<I4s", data, place)
        chunks.append((kind, data[place + 8 : place + 8 + size]))
        place += 8 + size
    if length > len(data) or place > length or not chunks or chunks[0][0] != b"JSON":
        raise InputError(
            f"{length} bytes in whole chunks expected, JSON first", file=file, field="header", value=f"{len(data)} bytes",
            mend="the file is cut short or damaged; export it again",
        )  # fmt: skip
    if len(chunks[0][1]) > TEXT:
        raise InputError(f"at most {TEXT} bytes of JSON expected", file=file, field="header", value=len(chunks[0][1]))
    return chunks[0][1], next((c for kind, c in chunks[1:] if kind == b"BIN\0"), None)

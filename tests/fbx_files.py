"""FBX 7.4 written from nested lists (name, values, inner), as text or binary: as much of the format as a character needs."""

from __future__ import annotations

import struct
import zlib

import numpy as np

Node = tuple  # (name, values, inner)


def text(nodes: list[Node]) -> bytes:
    lines = ["; FBX 7.4.0 project file", ""]

    def shown(value) -> str:
        if isinstance(value, np.ndarray):
            return f"*{value.size} {{\n a: {','.join(repr(v) for v in value.ravel().tolist())}\n}}"
        return f'"{value}"' if isinstance(value, str) else repr(value)

    def write(nodes) -> None:
        for name, values, inner in nodes:
            lines.append(f"{name}: " + ", ".join(map(shown, values)) + (" {" if inner is not None else ""))
            if inner is not None:
                write(inner)
                lines.append("}")

    write(nodes)
    return "\n".join(lines).encode() + b"\n"


def binary(nodes: list[Node], version: int = 7400) -> bytes:
    head = "<QQQB" if version >= 7500 else "<IIIB"

    def packed(value) -> bytes:
        if isinstance(value, np.ndarray):
            kind = {"float64": b"d", "float32": b"f", "int64": b"l", "int32": b"i"}[value.dtype.name]
            data = zlib.compress(value.tobytes())
            deflated = value.size > 4  # of both kinds, some
            data = data if deflated else value.tobytes()
            return kind + struct.pack("<III", value.size, deflated, len(data)) + data
        if isinstance(value, str):
            first, colons, last = value.partition("::")
            letters = f"{last}\0\1{first}".encode() if colons else value.encode()
            return b"S" + struct.pack("<I", len(letters)) + letters
        return (b"L" + struct.pack("<q", value)) if isinstance(value, int) else (b"D" + struct.pack("<d", value))

    def write(nodes, place: int) -> bytes:
        out = b""
        for name, values, inner in nodes:
            own = b"".join(map(packed, values))
            begin = place + len(out) + struct.calcsize(head) + len(name)
            below = b"" if not inner else write(inner, begin + len(own)) + b"\0" * struct.calcsize(head)
            end = begin + len(own) + len(below)
            out += struct.pack(head, end, len(values), len(own), len(name)) + name.encode() + own + below
        return out

    start = b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", version)
    return start + write(nodes, len(start)) + b"\0" * struct.calcsize(head) + b"\xfa" * 16


def properties(**given) -> Node:
    """Numbers or threes of numbers; a double underscore is a blank."""
    lines = []
    for name, value in given.items():
        numbers = [value] if isinstance(value, int | float) else [float(v) for v in value]
        lines.append(("P", [name.replace("__", " "), "", "", "A", *numbers], None))
    return ("Properties70", [], lines)


def link(child: int, parent: int, name: str = "") -> Node:
    return ("C", ["OP", child, parent, name] if name else ["OO", child, parent], None)


def scene(objects: list[Node], links: list[Node], **settings) -> list[Node]:
    return [
        ("FBXHeaderExtension", [], [("FBXVersion", [7400], None)]),
        ("GlobalSettings", [], [properties(**settings)]),
        ("Objects", [], objects),
        ("Connections", [], links),
    ]


def curve(key: int, times, values, flags: int = 4, slopes=(0.0, 0.0)) -> Node:
    count = len(times)
    data = np.tile(np.array([*slopes, np.array([3333 | 3333 << 16], np.uint32).view(np.float32)[0], 0], np.float32), (count, 1))
    return ("AnimationCurve", [key, "AnimCurve::", ""], [
        ("KeyTime", [np.array(np.round(np.asarray(times) * 46186158000), np.int64)], None),
        ("KeyValueFloat", [np.array(values, np.float32)], None),
        ("KeyAttrFlags", [np.array([flags], np.int32)], None),
        ("KeyAttrDataFloat", [data[0]], None),
        ("KeyAttrRefCount", [np.array([count], np.int32)], None),
    ])  # fmt: skip

"""Point caches (.pc2), which Blender's Mesh Cache modifier and 3ds Max read: positions only, no faces and no frame rate."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import readable, reading, replacing

__all__ = ["read_pc2", "write_pc2"]

HEADER = struct.Struct("<12siiffi")  # name, version, points, first frame, frames a sample, samples
NAME = b"POINTCACHE2\0"


def read_pc2(path: str | Path) -> tuple[Path, np.ndarray]:
    """Read a .pc2: the file and positions (T, V, 3) float32, not checked."""
    file = readable(path)
    size = file.stat().st_size
    with reading(file, ".pc2"), file.open("rb") as stream:
        head = stream.read(HEADER.size)
        if len(head) < HEADER.size or not head.startswith(NAME):
            raise InputError("a POINTCACHE2 header expected", file=file, field="header", value=head[:12], mend="export a .pc2")
        _, version, points, _, _, samples = HEADER.unpack(head)
        if version != 1 or points < 1 or samples < 1 or size - HEADER.size != 12 * points * samples:
            raise InputError(
                f"version 1 with {12 * max(points, 0) * max(samples, 0)} bytes of positions expected, as the header says",
                file=file, field="header",
                value=f"version {version}, {samples} samples of {points} points, {size - HEADER.size} bytes",
                mend="the file is cut short or damaged; export it again",
            )  # fmt: skip
        return file, np.frombuffer(stream.read(), "<f4").reshape(samples, points, 3)


def write_pc2(path: str | Path, vertices: np.ndarray) -> None:
    """Write positions (T, V, 3), one sample a frame from frame 0; the file appears whole or not at all."""
    with replacing(path) as part, part.open("xb") as stream:
        stream.write(HEADER.pack(NAME, 1, vertices.shape[1], 0.0, 1.0, vertices.shape[0]))
        stream.write(np.ascontiguousarray(vertices, "<f4").data)

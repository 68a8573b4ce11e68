"""Triangle meshes in .stl, read through trimesh with every vertex kept in its place."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.tables.files import LARGEST, readable, reading

__all__ = ["read_stl"]


def read_stl(path: str | Path) -> RawGarment:
    """Read the triangles of a file; each has vertices of its own."""
    import trimesh

    file = readable(path)
    if file.stat().st_size > LARGEST:
        raise InputError(f"at most {LARGEST} bytes expected", file=file, value=f"{file.stat().st_size} bytes")
    with reading(file, ".stl"), np.errstate(all="ignore"):
        loaded = trimesh.load_scene(io.BytesIO(_without_tail(file.read_bytes())), file_type="stl", process=False)
        parts = [g for g in loaded.dump() if isinstance(g, trimesh.Trimesh)]
    if not parts:
        return RawGarment(file, np.zeros((0, 3)), np.zeros((0, 3), np.int64), splits=True)
    starts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    x = np.concatenate([np.asarray(p.vertices) for p in parts])
    faces = np.concatenate([np.asarray(p.faces, np.int64).reshape(-1, 3) + s for p, s in zip(parts, starts, strict=True)])
    return RawGarment(file, x, faces, splits=True)


def _without_tail(data: bytes) -> bytes:
    """Return a binary file without what follows its triangles, as some programs write it; any other data as they are."""
    stop = 84 + 50 * int.from_bytes(data[80:84], "little")
    return data[:stop] if 84 < stop < len(data) and b"\0" in data[:stop] else data

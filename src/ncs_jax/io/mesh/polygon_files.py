"""Triangle meshes in .stl and .glb, read through trimesh with every vertex kept in its place."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import LARGEST, readable, reading

__all__ = ["read_polygons"]


def read_polygons(path: str | Path) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray | None]:
    """Read all meshes of a file as one: the file, vertices (V, 3), faces (F, 3) and texture coordinates (V, 2) or None."""
    import trimesh

    file = readable(path)
    suffix = file.suffix.lower()
    if file.stat().st_size > LARGEST:
        raise InputError(f"at most {LARGEST} bytes expected", file=file, value=f"{file.stat().st_size} bytes")
    with reading(file, suffix), np.errstate(all="ignore"):
        # From memory, so that the file cannot name others to be opened.
        loaded = trimesh.load_scene(io.BytesIO(file.read_bytes()), file_type=suffix[1:], process=False)
        parts = [g for g in loaded.dump() if isinstance(g, trimesh.Trimesh)]
    if not parts:
        return file, np.zeros((0, 3)), np.zeros((0, 3), np.int64), None
    starts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    x = np.concatenate([np.asarray(p.vertices) for p in parts])
    faces = np.concatenate([np.asarray(p.faces, np.int64).reshape(-1, 3) + s for p, s in zip(parts, starts, strict=True)])
    maps = [getattr(p.visual, "uv", None) for p in parts]
    whole = all(m is not None and np.shape(m) == (len(p.vertices), 2) for m, p in zip(maps, parts, strict=True))
    return file, x, faces, np.concatenate([np.asarray(m, np.float64) for m in maps]) if whole else None

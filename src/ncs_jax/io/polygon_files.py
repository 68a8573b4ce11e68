"""Triangle meshes in .ply, .stl and .glb, read through trimesh with every vertex kept in its place."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.files import LARGEST, readable, reading

__all__ = ["read_polygons"]

# These formats store a vertex once for each triangle (.stl) or once for each texture coordinate and normal (.glb), so that a
# mesh read as it stands would come apart: vertices at exactly one place are one there.
SPLITTING = (".stl", ".glb")


def read_polygons(path: str | Path) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray | None]:
    """The file, vertices (V, 3), faces (F, 3) and texture coordinates (V, 2) or None."""
    import trimesh

    file = readable(path)
    suffix = file.suffix.lower()
    if file.stat().st_size > LARGEST:
        raise InputError(f"at most {LARGEST} bytes expected", file=file, value=f"{file.stat().st_size} bytes")
    with reading(file, suffix), np.errstate(all="ignore"):
        # From memory, so that the file cannot name others to be opened.
        loaded = trimesh.load_scene(io.BytesIO(file.read_bytes()), file_type=suffix[1:], process=False)
        parts = [g for g in loaded.dump() if isinstance(g, trimesh.Trimesh)]
        return file, *_joined(parts, merge=suffix in SPLITTING)


def _joined(parts: list, merge: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    if not parts:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64), None
    starts = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    x = np.concatenate([np.asarray(p.vertices) for p in parts])
    faces = np.concatenate([np.asarray(p.faces, np.int64).reshape(-1, 3) + s for p, s in zip(parts, starts, strict=True)])
    maps = [getattr(p.visual, "uv", None) for p in parts]
    whole = all(m is not None and np.shape(m) == (len(p.vertices), 2) for m, p in zip(maps, parts, strict=True))
    uv = np.concatenate([np.asarray(m, np.float64) for m in maps]) if whole else None
    if not merge or len(x) == 0:
        return x, faces, uv
    _, first, number = np.unique(x, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")  # in the order in which the places first appear
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    number = rank[number.reshape(-1)]
    kept = first[order]
    if uv is not None:
        uv = uv[kept] if np.array_equal(uv[kept][number], uv) else None
    return x[kept], number[faces], uv

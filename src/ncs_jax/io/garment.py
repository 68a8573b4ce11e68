"""Garments from .npz, .obj, .ply, .stl and .glb."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.npz import read_npz
from ncs_jax.io.obj import read_obj
from ncs_jax.io.polygon_files import read_polygons
from ncs_jax.io.records import GarmentRecord
from ncs_jax.io.surface import check_surface
from ncs_jax.io.table import floats, indices

__all__ = ["read_garment"]

GROUP = "group_"
FORMATS = (".npz", ".obj", ".ply", ".stl", ".glb")


def read_garment(path: str | Path) -> GarmentRecord:
    """A garment in its rest shape on the resting body.

    .npz holds `vertices` (V, 3) in m and `faces` (F, 3), and may hold `uv` (V, 2) and vertex sets `group_NAME`. The vertices of
    .obj and .ply keep the file's order and number; in .stl and .glb, which store a vertex many times, those at exactly one
    place become one, in order of first appearance. Polygons become triangles.

    Raises:
        InputError: the file cannot be read; or the mesh is empty, has a corner that does not exist, a number that is not
            finite, a triangle with a vertex twice, an edge of more than two triangles, neighbours that face opposite sides, or
            a vertex in no triangle. Nothing is repaired.
    """
    suffix = Path(path).suffix.lower()
    groups: dict[str, np.ndarray] = {}
    if suffix == ".npz":
        table = read_npz(path, lambda n: n in ("vertices", "faces", "uv") or n.startswith(GROUP))
        file, x, faces = table.file, table.array("vertices"), table.array("faces")
        uv = table.arrays.get("uv")
        groups = {n.removeprefix(GROUP): a for n, a in table.arrays.items() if n.startswith(GROUP)}
    elif suffix == ".obj":
        file, x, faces, uv = read_obj(path)
    elif suffix in FORMATS:
        file, x, faces, uv = read_polygons(path)
    else:
        raise InputError(
            f"one of {', '.join(FORMATS)} expected",
            file=path,
            value=suffix or "no suffix",
            mend="export the garment as one of them",
        )
    x = floats(file, "vertices", x, ("V", 3), ("vertex",))
    faces = indices(file, "faces", faces, ("F", 3), len(x), "vertices")
    check_surface(file, faces, len(x))
    return GarmentRecord(
        x,
        faces,
        None if uv is None else floats(file, "uv", uv, (len(x), 2), ("vertex",)),
        {n: np.unique(indices(file, GROUP + n, a, ("N",), len(x), "vertices")) for n, a in groups.items()},
    )

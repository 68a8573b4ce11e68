"""Garments from .npz, .obj, .ply, .stl, .glb and USD."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.axes import upright
from ncs_jax.io.mesh.obj import read_obj
from ncs_jax.io.mesh.ply import read_ply
from ncs_jax.io.mesh.polygon_files import read_polygons
from ncs_jax.io.mesh.surface import check_surface
from ncs_jax.io.mesh.usd import USD, read_usd_mesh
from ncs_jax.io.mesh.weld import weld as same_places
from ncs_jax.io.records import GarmentRecord
from ncs_jax.io.tables.npz import read_npz, write_npz
from ncs_jax.io.tables.table import floats, indices, normalised_weights

__all__ = ["read_garment", "write_garment"]

GROUP = "group_"
WEIGHTS = "blend_weights"
FORMATS = (".npz", ".obj", ".ply", ".stl", ".glb", *USD)
SPLITTING = (".stl", ".glb")  # store a vertex once for each triangle, texture coordinate or normal: the cloth would come apart


def read_garment(path: str | Path, *, scale: float = 0.0, up: str = "", weld: float = 0.0) -> GarmentRecord:
    """Read a garment in its rest shape on the resting body, in metres and Y up.

    .npz holds `vertices` (V, 3) and `faces` (F, 3), and may hold `uv` (V, 2), vertex sets `group_NAME` and skinning weights
    `blend_weights` (V, J) for the body's joints. Vertices keep the file's order and number, but for .stl and .glb, which store
    a vertex many times: there, vertices at exactly one place are merged, in order of first appearance. Polygons become
    triangles that do not fold, see `triangulate`.

    Args:
        path: the file. scale: metres a unit of the file; 0: as the file says, else 1 (USD says it, .glb is in metres).
        up: the axis that is up in the file, "x", "y" or "z"; empty: as the file says, else "y". weld: vertices within this
            distance of each other are merged, m, see `weld`; 0: none are.

    Raises:
        InputError: the file cannot be read; or the mesh is empty, has a corner that does not exist, a number that is not
            finite, a triangle with a vertex twice, an edge of more than two triangles, neighbours that face opposite sides, or
            a vertex in no triangle. Nothing is repaired.
    """
    suffix = Path(path).suffix.lower()
    groups: dict[str, np.ndarray] = {}
    uv, weights, unit, axis = None, None, 1.0, "y"
    if suffix == ".npz":
        table = read_npz(path, lambda n: n in ("vertices", "faces", "uv", WEIGHTS) or n.startswith(GROUP))
        file, x, faces = table.file, table.array("vertices"), table.array("faces")
        uv, weights = table.arrays.get("uv"), table.arrays.get(WEIGHTS)
        groups = {n.removeprefix(GROUP): a for n, a in table.arrays.items() if n.startswith(GROUP)}
    elif suffix == ".obj":
        file, x, faces, uv = read_obj(path)
    elif suffix == ".ply":
        file, x, faces, uv = read_ply(path)
    elif suffix in SPLITTING:
        file, x, faces, uv = read_polygons(path)
    elif suffix in USD:
        file, mesh = read_usd_mesh(path)
        x, faces, unit, axis = mesh.vertices, mesh.faces, mesh.scale, mesh.up
    else:
        raise InputError(
            f"one of {', '.join(FORMATS)} expected",
            file=path,
            value=suffix or "no suffix",
            mend="export the garment as one of them",
        )
    x = floats(file, "vertices", x, ("V", 3), ("vertex",))
    faces = indices(file, "faces", faces, ("F", 3), len(x), "vertices")
    unit, axis, verts = scale or unit, up or axis, len(x)
    x = floats(file, "vertices", upright(x, unit, axis), ("V", 3), ("vertex",))
    kept = number = np.arange(verts)
    if (weld > 0 or suffix in SPLITTING) and verts:
        kept, number = same_places(file, x, faces, weld)
        x, faces = x[kept], number[faces].astype(np.int32)
    check_surface(file, faces, len(x))
    uv = None if uv is None else floats(file, "uv", uv, (verts, 2), ("vertex",))
    if uv is not None:
        uv = uv[kept] if np.array_equal(uv[kept][number], uv) else None
    if weights is not None:
        weights = normalised_weights(file, WEIGHTS, floats(file, WEIGHTS, weights, (verts, "J"), ("vertex", "joint")))[kept]
    sets = {n: number[indices(file, GROUP + n, a, ("N",), verts, "vertices")] for n, a in groups.items()}
    sets = {n: np.unique(a).astype(np.int32) for n, a in sets.items()}
    return GarmentRecord(x, faces, uv, sets, unit, axis, verts - len(x), weights)


def write_garment(path: str | Path, garment: GarmentRecord) -> None:
    """Write all that a record holds as .npz; the file appears whole or not at all.

    Raises:
        InputError: the file's name ends in something else.
    """
    if Path(path).suffix.lower() != ".npz":
        raise InputError("a file name that ends in .npz expected", file=path, mend="name it so")
    more = {"uv": garment.uv, WEIGHTS: garment.weights}
    groups = {GROUP + name: vertices for name, vertices in garment.groups.items()}
    arrays = {name: a for name, a in more.items() if a is not None}
    write_npz(path, vertices=garment.vertices, faces=garment.faces, **arrays, **groups)

"""Garments from .npz, .obj, .ply, .stl, glTF, FBX and USD."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.fbx_character import fbx_garment
from ncs_jax.io.character.gltf_character import gltf_garment
from ncs_jax.io.mesh.axes import upright
from ncs_jax.io.mesh.obj import read_obj
from ncs_jax.io.mesh.ply import read_ply
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.mesh.stl import read_stl
from ncs_jax.io.mesh.surface import check_surface, oriented
from ncs_jax.io.mesh.usd import USD, read_usd_mesh
from ncs_jax.io.mesh.weld import weld as same_places
from ncs_jax.io.packaged import resolved
from ncs_jax.io.records import GarmentRecord
from ncs_jax.io.tables.files import suffix_lacking
from ncs_jax.io.tables.npz import read_npz, write_npz
from ncs_jax.io.tables.table import floats, indices, normalised_weights

__all__ = ["raw_mesh", "read_garment", "write_garment"]

GROUP = "group_"
WEIGHTS = "blend_weights"
OBJECTS = {
    ".obj": read_obj, ".glb": gltf_garment, ".gltf": gltf_garment, ".vrm": gltf_garment, ".fbx": fbx_garment,
    **dict.fromkeys(USD, read_usd_mesh),
}  # fmt: skip
FORMATS = (".npz", ".ply", ".stl", *OBJECTS)


def read_garment(
    path: str | Path,
    *,
    scale: float = 0.0,
    up: str = "",
    weld: float = 0.0,
    mesh: Sequence[str] = (),
    turn_faces: bool = False,
) -> GarmentRecord:
    """Read a garment in its rest shape on the resting body, in metres and Y up.

    .npz holds `vertices` (V, 3) and `faces` (F, 3), and may hold `uv` (V, 2) of vertices or (F, 3, 2) of corners, vertex sets
    `group_NAME`, and skinning weights `blend_weights` (V, J) for the body's joints. A skinned garment of a .glb or .fbx brings
    the weights of its own joints. Vertices keep the file's order and number, but for .stl and glTF, which store a vertex many
    times: there, vertices at exactly one place are merged, in order of first appearance, and triangles that have two corners
    there are left out. Polygons become triangles that do not
    fold, see `triangulate`.

    Args:
        path: the file, or ncs:NAME. scale: metres a unit of the file; 0: as the file says, else 1 (USD and FBX say it, glTF is
            in metres). up: the axis that is up in the file, "x", "y" or "z"; empty: as the file says, else "y". weld: vertices
            within this distance of each other are merged, m, see `weld`; 0: none are. mesh: names of the objects, meshes or
            materials that are the garment, where the file holds several objects (.obj, glTF, FBX, USD). turn_faces: turn
            triangles that face the other side than their neighbours, see `oriented`, and say so in the notes.

    Raises:
        InputError: the file cannot be read, or holds several objects and none is named; or the mesh is empty, has a corner that
            does not exist, a number that is not finite, a triangle with a vertex twice, an edge of more than two triangles,
            neighbours that face opposite sides (with turn_faces: a surface of one side), or a vertex in no triangle.
    """
    raw = raw_mesh(resolved(path), (mesh,) if isinstance(mesh, str) else tuple(mesh))
    file, verts = raw.file, len(raw.vertices)
    x = floats(file, "vertices", raw.vertices, ("V", 3), ("vertex",))
    faces = corners = indices(file, "faces", raw.faces, ("F", 3), verts, "vertices")
    unit, axis = scale or raw.unit, up or raw.up
    x = floats(file, "vertices", upright(x, unit, axis), ("V", 3), ("vertex",))
    uv, notes = raw.uv, raw.notes
    if raw.splits and (point := (x[faces] == np.roll(x[faces], 1, axis=1)).all(axis=2).any(axis=1)).any():
        faces = corners = faces[~point]
        uv = uv[~point] if uv is not None and uv.ndim == 3 and len(uv) == len(point) else uv
        notes = (*notes, f"{point.sum()} triangles with two corners at one place are left out: they draw nothing")
    kept = number = np.arange(verts)
    if (weld > 0 or raw.splits) and verts:
        kept, number = same_places(file, x, faces, weld)
        x, faces = x[kept], number[faces].astype(np.int32)
    if turn_faces:
        faces, turned = oriented(file, x, faces)
        told = f"{len(turned)} of {len(faces)} triangles faced the other side than their neighbours, the first is face "
        notes = (*notes, told + f"{turned[0]}: they were turned") if len(turned) else notes
    check_surface(file, faces, len(x))
    weights = raw.weights
    if uv is not None and uv.ndim == 2:  # of the vertices
        uv = floats(file, "uv", uv, (verts, 2), ("vertex",))[corners]
    elif uv is not None:
        uv = floats(file, "uv", uv, (len(faces), 3, 2), ("face", "corner"))
    if weights is not None:
        weights = normalised_weights(file, WEIGHTS, floats(file, WEIGHTS, weights, (verts, "J"), ("vertex", "joint")))[kept]
    sets = {n: number[indices(file, GROUP + n, a, ("N",), verts, "vertices")] for n, a in raw.groups.items()}
    sets = {n: np.unique(a).astype(np.int32) for n, a in sets.items()}
    return GarmentRecord(x, faces, uv, sets, unit, axis, verts - len(x), weights, raw.joint_names, notes)


def raw_mesh(path: str | Path, mesh: tuple[str, ...]) -> RawGarment:
    """Return what the reader of a file's format finds."""
    suffix = Path(path).suffix.lower()
    if suffix in OBJECTS:
        return OBJECTS[suffix](path, mesh)
    if suffix not in FORMATS:
        raise InputError(
            f"one of {', '.join(FORMATS)} expected", file=path, value=suffix or suffix_lacking(path),
            mend="export the garment as one of them",
        )  # fmt: skip
    if mesh:
        raise InputError(
            f"a file of one of {', '.join(OBJECTS)} expected, which name their meshes", file=path, field="garment.mesh",
            value=mesh[0], mend="leave it out",
        )  # fmt: skip
    if suffix != ".npz":
        return read_ply(path) if suffix == ".ply" else read_stl(path)
    table = read_npz(path, lambda n: n in ("vertices", "faces", "uv", WEIGHTS) or n.startswith(GROUP))
    groups = {n.removeprefix(GROUP): a for n, a in table.arrays.items() if n.startswith(GROUP)}
    uv, weights = table.arrays.get("uv"), table.arrays.get(WEIGHTS)
    return RawGarment(table.file, table.array("vertices"), table.array("faces"), uv, groups=groups, weights=weights)


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

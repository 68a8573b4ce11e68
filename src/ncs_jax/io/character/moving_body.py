"""Bodies that are no characters but moving meshes: a mesh for each frame, as other simulators and modellers write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.animation.animation import read_animation
from ncs_jax.io.mesh.axes import upright
from ncs_jax.io.mesh.garment import raw_mesh
from ncs_jax.io.mesh.usd import USD
from ncs_jax.io.records import BodyRecord
from ncs_jax.io.tables.npz import npz_shape
from ncs_jax.io.tables.table import floats, indices

__all__ = ["is_moving_body", "read_moving_body"]

CACHES = (".pc2", ".mdd")  # which hold no faces
ALEMBIC = ".abc"
FILES = (*CACHES, *USD, ".h5", ".hdf5", ALEMBIC)


def is_moving_body(path: str | Path) -> bool:
    """Tell whether a body's file is a mesh for each frame: a folder, or a file that holds vertices (T, V, 3)."""
    file = Path(path).expanduser()
    if str(path).startswith("ncs:"):
        return False
    suffix = file.suffix.lower()
    return file.is_dir() or suffix in FILES or (suffix == ".npz" and len(npz_shape(file, "vertices")) == 3)


def read_moving_body(
    path: str | Path, *, scale: float = 0.0, up: str = "", fps: float = 0.0, mesh: str | Path | None = None
) -> BodyRecord:
    """Read a mesh for each frame as a body: a folder of .obj, an .npz, .h5, .pc2, .mdd, or USD with samples in time.

    An .npz or .h5 holds `vertices` (T, V, 3) and `faces` (F, 3), and may hold `fps`. The body at rest is the first frame. It
    has one joint that carries all of it, see `prepare.regions` for more.

    Args:
        path: the file or folder. scale: metres a unit, 0 for 1; up: the axis that is up, "" for y; USD says both itself.
        fps: frames per second; 0: as the file says, NaN where it does not. mesh: for a .pc2 or an .mdd, a file with
            its faces, of as many vertices in the same order.

    Raises:
        InputError: the file cannot be read, a frame has another mesh than the first, or a .pc2 or .mdd lacks its faces.
    """
    file = Path(path).expanduser()
    suffix = "" if file.is_dir() else file.suffix.lower()
    if suffix == ALEMBIC:
        raise InputError(
            "a folder of .obj, .npz, .h5, .pc2, .mdd or USD expected", file=file, field="body.file", value=ALEMBIC,
            mend="no well-kept package reads Alembic: export .usdc with the same animation, or a folder of .obj",
        )  # fmt: skip
    if suffix in USD and (scale or up):
        raise InputError(
            "no unit and no axis expected, as USD says both", file=file, field="body.scale" if scale else "body.up",
            value=scale or up, mend="leave it out",
        )  # fmt: skip
    if mesh is not None and suffix not in CACHES:
        raise InputError(
            "no mesh expected: this format holds its faces", file=file, field="body.mesh", value=str(mesh), mend="leave it out"
        )
    faces = _faces_of(file, mesh) if suffix in CACHES else None
    found = read_animation(file, faces=faces, fps=fps or np.nan)
    if faces is None and not len(found.faces):
        raise InputError("triangles expected", file=file, field="faces", value="none", mend="write the mesh's faces too")
    x = floats(file, "vertices", upright(found.vertices, scale or 1.0, up or "y"), ("T", "V", 3), ("frame", "vertex"))
    triangles, notes = found.faces, []
    if _volume(x[0], triangles) < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
        notes.append("the triangles looked inward: they were turned")
    count = x.shape[1]
    return BodyRecord(
        x[0], triangles, x[0].mean(axis=0, keepdims=True), np.array([-1], np.int32), np.ones((count, 1), np.float32), ("body",),
        notes=tuple(notes), frames=x, carriers=np.broadcast_to(np.eye(4)[:3], (len(x), 1, 3, 4)), fps=fps or found.fps,
    )  # fmt: skip


def _faces_of(file: Path, mesh: str | Path | None) -> np.ndarray:
    """Return the triangles (F, 3) of the mesh that a point cache goes onto."""
    if mesh is None:
        raise InputError(
            f"a mesh with the faces expected, as a {file.suffix} holds none", file=file, field="body.mesh",
            mend='write mesh = "body.obj" below [body]: the mesh of the same vertices, exported with their order kept',
        )  # fmt: skip
    raw = raw_mesh(mesh, ())
    faces = indices(raw.file, "faces", raw.faces, ("F", 3), len(raw.vertices), "vertices")
    found = read_animation(file).vertices.shape[1]
    if len(raw.vertices) != found:
        kept = "this format splits vertices: take .obj" if raw.splits else "export it with the vertices kept in their order"
        raise InputError(
            f"a mesh of the {found} vertices of {file.name} expected", file=raw.file, field="body.mesh",
            value=f"{len(raw.vertices)} vertices", mend=kept,
        )  # fmt: skip
    return faces


def _volume(x: np.ndarray, faces: np.ndarray) -> float:
    """Return the signed volume that triangles enclose, m^3: below 0 where they look inward."""
    a, b, c = np.moveaxis((x - x.mean(axis=0)).astype(np.float64)[faces], 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)

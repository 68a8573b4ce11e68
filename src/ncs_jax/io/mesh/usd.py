"""Universal Scene Description (.usd, .usdc, .usda, .usdz), through usd-core: meshes in, animations in and out."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh import usd_arrays
from ncs_jax.io.mesh.axes import TURNS, upright
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.objects import MovingObject
from ncs_jax.io.mesh.part import NamedMesh, chosen_meshes, one_object
from ncs_jax.io.mesh.polygons import triangle_corners
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.tables.files import LARGEST, readable, reading, replacing
from ncs_jax.io.tables.table import floats, indices

__all__ = ["USD", "check_installed", "read_usd_animation", "read_usd_mesh", "write_usd"]

USD = (".usd", ".usdc", ".usda", ".usdz")


# --- in ---------------------------------------------------------------------------------------------------------------------


def read_usd_mesh(path: str | Path, mesh: Sequence[str] = ()) -> RawGarment:
    """Read a mesh at rest (the default time), or at the first time sample where there are only samples.

    Transforms are applied and polygons become triangles. The cage of a subdivision surface is not subdivided. Vertices keep the
    file's order, mesh after mesh.

    Args:
        path: the file. mesh: paths of prims, or names in these, whose meshes are joined. None: the file must hold one mesh.
    """
    file, table = _arrays(path, "still")
    names = [str(table[f"{i}.name"]) for i in range(sum(key.endswith(".points") for key in table))]
    sizes = [table[f"{i}.points"].shape[1] for i in range(len(names))]
    named = [NamedMesh(n, i, sizes[i], tuple(n.split("/")[1:])) for i, n in enumerate(names)]
    chosen = chosen_meshes(file, "garment.mesh", mesh, named)
    if not mesh:
        one_object(file, "garment.mesh", named)
    x, faces, uv = _joined(file, table, np.flatnonzero(chosen).tolist())
    return RawGarment(file, x[0], faces, uv, unit=float(table["scale"]), up=str(table["up"]))


def read_usd_animation(path: str | Path) -> tuple[Path, np.ndarray, np.ndarray, float]:
    """Read a moving mesh: the file, positions (T, V, 3) at every time sample, m, Y up, triangles (F, 3), frames per second."""
    file, table = _arrays(path, "moving")
    steps = np.diff(table["times"])
    if not len(table["times"]) or not np.allclose(steps, steps[:1], rtol=0.01):
        raise InputError(
            "points with time samples in even steps expected", file=file, field="points", value=table["times"][:4].tolist(),
            mend="export the animation with a sample in every frame",
        )  # fmt: skip
    x, faces, _ = _joined(file, table, range(sum(key.endswith(".points") for key in table)))
    rate = float(table["rate"]) / (steps[0] if len(steps) else 1.0)
    return file, upright(x, float(table["scale"]), str(table["up"])), faces, rate


def _arrays(path: str | Path, kind: str) -> tuple[Path, dict[str, np.ndarray]]:
    """Return what the program `usd_arrays` finds; it is stopped where the file makes it take too much memory or time."""
    file = readable(path)
    check_installed(file)
    size = file.stat().st_size
    memory, seconds = min(2 * 2**30 + 64 * size, 3 * LARGEST), 60 + size // 10**6
    with reading(file, "USD"), tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "arrays.npz"
        command = [sys.executable, "-P", usd_arrays.__file__, str(file.absolute()), str(out), kind, str(memory)]
        one = os.environ | {"OPENBLAS_NUM_THREADS": "1", "PXR_WORK_THREAD_LIMIT": "1"}  # each thread reserves memory
        done = subprocess.run(command, capture_output=True, timeout=seconds, check=False, env=one)
        if done.returncode:
            lines = done.stderr.decode(errors="replace").strip().splitlines()
            raise OSError(lines[-1] if done.returncode == 1 and lines else "usd-core breaks off")
        with np.load(out, allow_pickle=False) as table:
            found = dict(table)
    if "0.points" not in found:
        raise InputError("a mesh expected", file=file, field="prims", value="no Mesh", mend="export the garment's mesh")
    for name, good, expected in (
        ("upAxis", found["up"] in tuple(TURNS), "X, Y or Z"),
        ("metersPerUnit", 0 < found["scale"] < np.inf, "a number above 0"),
        ("timeCodesPerSecond", 0 < found["rate"] < np.inf, "a number above 0"),
    ):
        if not good:
            raise InputError(f"{expected} expected", file=file, field=name, mend="mend it where the stage was made")
    return file, found


def _joined(
    file: Path, table: dict[str, np.ndarray], meshes: Iterable[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return positions (T, V, 3) in the world, triangles (F, 3) and texture coordinates (F, 3, 2), if any, of some meshes."""
    parts, faces, maps, start = [], [], [], 0
    for i in meshes:
        name, turn = str(table[f"{i}.name"]), table[f"{i}.turn"]
        x = floats(file, f"{name}.points", table[f"{i}.points"], ("T", "V", 3), ("frame", "vertex"))
        if not np.array_equal(turn, np.broadcast_to(np.eye(4), turn.shape)):
            x = np.einsum("tvi,tij->tvj", x.astype(np.float64), turn[:, :3, :3]) + turn[:, None, 3, :3]
        corners = indices(file, f"{name}.faceVertexIndices", table[f"{i}.corners"], ("N",), x.shape[1], "points")
        cut = triangle_corners(file, x[0], table[f"{i}.counts"], corners, skip=table[f"{i}.holes"])
        if table[f"{i}.left"] != (np.linalg.det(turn[0, :3, :3]) < 0):
            cut = cut[:, ::-1]
        parts.append(x)
        faces.append(corners[cut].astype(np.int32) + start)
        maps.append(table[f"{i}.uv"][cut] if len(table[f"{i}.uv"]) else None)
        start += x.shape[1]
    uv = np.concatenate([m for m in maps if m is not None]) if all(m is not None for m in maps) else None
    return np.concatenate(parts, axis=1), np.concatenate(faces), uv


def check_installed(file: Path) -> None:
    """Raise an InputError where the package for USD is not there."""
    if find_spec("pxr") is None:
        raise InputError(
            "the package usd-core is needed for USD", file=file, mend="pip install usd-core, or take another format"
        )


# --- out --------------------------------------------------------------------------------------------------------------------


def write_usd(path: str | Path, objects: Sequence[MovingObject], fps: float) -> None:
    """Write a moving mesh, /garment, or several, /garment/NAME, in metres and Y up; the file appears whole or not at all.

    `points`, `normals` and `extent` have a time sample a frame, at 0, 1, 2 ..., with fps time codes a second; the default value
    of `points` is the rest shape. .usda is text, the others are binary; .usdz is that in a package, as phones show it.

    Args:
        path: where to. objects: at least one, float32, Y up; texture coordinates become the primvar `st`. fps: of frames.
    """
    file = Path(path)
    check_installed(file)
    suffix = file.suffix.lower()
    with replacing(file) as part, _quietly(), tempfile.TemporaryDirectory(dir=part.parent, prefix=part.name) as folder:
        from pxr import Usd, UsdUtils

        inner = Path(folder) / f"{file.stem}{'.usdc' if suffix == '.usdz' else suffix}"
        stage = Usd.Stage.CreateNew(str(inner))
        _fill(stage, objects, fps)
        stage.GetRootLayer().Save()
        del stage
        if suffix == ".usdz":
            if not UsdUtils.CreateNewUsdzPackage(str(inner), str(part)):
                raise OSError("usd-core could not pack it")
        else:
            inner.replace(part)


@contextmanager
def _quietly() -> Iterator[None]:
    """Turn what usd-core raises into an OSError of one line, and keep its warnings from being printed."""
    from pxr import Tf, UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    except Tf.ErrorException as error:
        message = str(error).strip().rsplit(" : '", 1)[-1].strip("'")
        raise OSError(f"usd-core says {' '.join(message.split())[:200]}") from None
    finally:
        delegate.TakeUncoalescedDiagnostics()


def _fill(stage, objects: Sequence[MovingObject], fps: float) -> None:
    from pxr import Tf, UsdGeom

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(objects[0].vertices) - 1)
    several = len(objects) > 1
    if several:
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/garment").GetPrim())
    for each in objects:
        name = f"/garment/{Tf.MakeValidIdentifier(each.name)}" if several else "/garment"
        mesh = UsdGeom.Mesh.Define(stage, name)
        if not several:
            stage.SetDefaultPrim(mesh.GetPrim())
        _fill_mesh(mesh, each)


def _fill_mesh(mesh, given: MovingObject) -> None:
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    vertices, faces, uv = given.vertices, given.faces, given.uv
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*given.colour)])
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if uv is not None:
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv.reshape(-1, 2), np.float32)))
    points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
    for when, x in [(Usd.TimeCode.Default(), given.rest), *((Usd.TimeCode(t), x) for t, x in enumerate(vertices))]:
        x = np.ascontiguousarray(x, np.float32)
        points.Set(Vt.Vec3fArray.FromNumpy(x), when)
        normals.Set(Vt.Vec3fArray.FromNumpy(vertex_normals(x, faces)), when)
        extent.Set(Vt.Vec3fArray.FromNumpy(np.stack([x.min(axis=0), x.max(axis=0)])), when)

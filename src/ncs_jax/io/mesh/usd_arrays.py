"""Meshes of a USD file as plain arrays, read by a separate program: on a damaged file usd-core may crash or take all memory."""

from __future__ import annotations

import resource
import sys

import numpy as np

__all__ = ["arrays_of"]


def arrays_of(path: str, moving: bool) -> dict[str, np.ndarray]:
    """Return a stage's arrays by name: `scale`, `up`, `rate` and `times`, and those of each mesh i.

    These are `i.name`, `i.points` (times, V, 3), `i.turn` (times, 4, 4), which takes points, as rows, into the world,
    `i.counts`, `i.corners`, `i.holes`, `i.uv`, the corners' texture coordinates or no rows, and `i.left`, whether the mesh is
    left-handed. A stage that is read as still has one
    time: the default one, or the first time sample of a mesh that has only samples.
    """
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(path)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
    meshes = [UsdGeom.Mesh(p) for p in prims if p.IsA(UsdGeom.Mesh)]
    meshes = [m for m in meshes if UsdGeom.Imageable(m).ComputePurpose() in ("default", "render")]
    times = sorted({t for m in meshes for t in m.GetPointsAttr().GetTimeSamples()}) if moving else []
    found = {
        "scale": np.array(UsdGeom.GetStageMetersPerUnit(stage)),
        "up": np.array(str(UsdGeom.GetStageUpAxis(stage)).lower()),
        "rate": np.array(stage.GetTimeCodesPerSecond()),
        "times": np.array(times, np.float64),
    }
    for i, mesh in enumerate(meshes):
        points, name = mesh.GetPointsAttr(), str(mesh.GetPath())
        still = Usd.TimeCode.Default() if points.Get() is not None else Usd.TimeCode.EarliestTime()
        whens = [Usd.TimeCode(t) for t in times] if moving else [still]
        attributes = {"counts": mesh.GetFaceVertexCountsAttr(), "corners": mesh.GetFaceVertexIndicesAttr()}
        values = {key: attribute.Get(whens[0] if whens else still) for key, attribute in attributes.items()}
        missing = [
            key for key, value in {"points": points.Get(whens[0] if whens else still), **values}.items() if value is None
        ]
        if missing:
            raise ValueError(f"{name} has no {missing[0]}, or what it refers to is not there")
        frames = [np.asarray(points.Get(when), np.float32).reshape(-1, 3) for when in whens]
        if len({len(x) for x in frames}) > 1:
            raise ValueError(f"{name} has another number of points in another frame")
        found[f"{i}.name"] = np.array(name)
        found[f"{i}.points"] = np.stack(frames) if frames else np.zeros((0, 0, 3), np.float32)
        found[f"{i}.turn"] = np.array([np.array(mesh.ComputeLocalToWorldTransform(when)) for when in whens]).reshape(-1, 4, 4)
        found |= {f"{i}.{key}": np.asarray(value, np.int32) for key, value in values.items()}
        found[f"{i}.holes"] = np.asarray(mesh.GetHoleIndicesAttr().Get(still) or (), np.int32)
        found[f"{i}.uv"] = _corner_uv(mesh, still, found[f"{i}.corners"])
        found[f"{i}.left"] = np.array(mesh.GetOrientationAttr().Get(still) == "leftHanded")
    return found


def _corner_uv(mesh, still, corners: np.ndarray) -> np.ndarray:
    """Return the texture coordinates of corners: the primvar `st`, else the first of that role; no rows where there is none."""
    from pxr import UsdGeom

    variables = UsdGeom.PrimvarsAPI(mesh).GetPrimvarsWithValues()
    maps = [v for v in variables if str(v.GetTypeName()) in ("texCoord2f[]", "texCoord2d[]", "texCoord2h[]")]
    maps = [v for v in variables if v.GetPrimvarName() == "st"] or maps
    values = np.asarray(maps[0].ComputeFlattened(still) if maps else (), np.float64)
    if values.ndim == 2 and values.shape[1] == 2:
        kind = maps[0].GetInterpolation()
        if kind in ("vertex", "varying") and len(values) > corners.max(initial=-1) and corners.min(initial=0) >= 0:
            return values[corners]
        if kind == "faceVarying" and len(values) == len(corners):
            return values
    return np.zeros((0, 2))


def _main(path: str, out: str, moving: str, memory: str) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        np.savez(out, allow_pickle=False, **arrays_of(path, moving == "moving"))
    except Exception as error:
        message = str(error).strip().rsplit(" : '", 1)[-1].strip("'")  # usd-core's own words, without where in its source
        sys.exit(f"\n{' '.join(message.split())[:200]}")


if __name__ == "__main__":
    _main(*sys.argv[1:])

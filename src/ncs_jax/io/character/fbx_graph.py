"""The models of an FBX file: names, properties, parents, and what is connected to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.io.character.fbx import Fbx, Record
from ncs_jax.io.character.rig import MOST_NODES

__all__ = ["FbxModel", "Graph", "euler", "graph_of", "name_of", "properties_of"]

DEEPEST = 500  # models from the top to a leaf
RATES = {
    1: 120.0, 2: 100.0, 3: 60.0, 4: 50.0, 5: 48.0, 6: 30.0, 7: 30.0, 8: 30 / 1.001, 9: 30 / 1.001, 10: 25.0, 11: 24.0,
    13: 24 / 1.001, 15: 96.0, 16: 72.0, 17: 60 / 1.001, 18: 120 / 1.001,
}  # fmt: skip
NUMBERS = (int, float)
KINDS = tuple(f"{kind}::" for kind in ("Model", "AnimStack", "Geometry", "Material", "SubDeformer"))  # before names in text


@dataclass(frozen=True, eq=False)
class FbxModel:
    """A node, of a kind as LimbNode or Null. Its properties come from the node itself, else from the file's template."""

    key: int
    name: str
    kind: str
    properties: dict[str, list]

    def vector(self, name: str, default: float = 0.0) -> np.ndarray:
        """Return the three numbers of a property, each the default where the property is not there."""
        found = self.properties.get(name, [])[:3]
        return np.array(found, np.float64) if len(found) == 3 else np.full(3, default)

    def number(self, name: str) -> int:
        """Return the whole number of a property, 0 where it is not there."""
        return int(next(iter(self.properties.get(name, [])), 0))


@dataclass(frozen=True, eq=False)
class Graph:
    """All models, parents before children, and the connections: `below[key]` lists (object, property) under an object.

    `to_metres` (4, 4) leads from the file's axes and unit to metres and Y up. `fps`: frames per second; 0 where the
    file does not say.
    """

    fbx: Fbx
    models: list[FbxModel]
    parents: np.ndarray
    objects: dict[int, Record]
    below: dict[int, list[tuple[int, str]]]
    to_metres: np.ndarray
    fps: float

    def under(self, key: int, name: str, kind: str = "") -> list[tuple[int, Record, str]]:
        """Return the objects under one that have a name and, if given, a kind: (key, record, property)."""
        found = [(k, self.objects[k], p) for k, p in self.below.get(key, ()) if k in self.objects]
        return [(k, r, p) for k, r, p in found if r.name == name and kind in ("", r.value(2, str, ""))]


def graph_of(fbx: Fbx) -> Graph:
    """Return the models of a file, sorted by depth, with what is connected to them."""
    objects = {r.value(0, int, 0): r for r in fbx.root.first("Objects").inner}
    below: dict[int, list[tuple[int, str]]] = {}
    for line in fbx.root.first("Connections").all("C"):
        if line.value(0, str, "") in ("OO", "OP"):
            below.setdefault(line.value(2, int, 0), []).append((line.value(1, int, 0), line.value(3, str, "")))
    template: dict[str, list] = {}
    for defined in fbx.root.first("Definitions").all("ObjectType"):
        if defined.value(0, str, "") == "Model":
            template = properties_of(defined.first("PropertyTemplate"))
    keys = [k for k, r in objects.items() if r.name == "Model"]
    if not 0 < len(keys) <= MOST_NODES:
        raise fbx.wrong(f"1 to {MOST_NODES} models expected", "Objects", len(keys), "export one character")
    place = {k: i for i, k in enumerate(keys)}
    parents = np.full(len(keys), -1, np.int32)
    for above, inner in below.items():
        for key, name in inner:
            if above in place and key in place and not name:
                parents[place[key]] = place[above]
    depth = np.zeros(len(keys), int)
    for i in range(len(keys)):
        above = i
        while (above := int(parents[above])) >= 0:
            if (steps := int(depth[i]) + 1) > DEEPEST:
                raise fbx.wrong(f"a tree at most {DEEPEST} models deep expected", "Connections", "deeper, or a circle")
            depth[i] = steps
    order = np.argsort(depth, kind="stable")
    rank = np.argsort(order)
    models = [
        FbxModel(k, name_of(objects[k]), objects[k].value(2, str, ""), template | properties_of(objects[k]))
        for k in (keys[i] for i in order)
    ]
    parents = np.array([rank[parents[i]] if parents[i] >= 0 else -1 for i in order], np.int32)
    return Graph(fbx, models, parents, objects, below, *_settings(fbx))


def name_of(record: Record) -> str:
    """Return the name of an object: `Hips` for a binary file's `Hips\\0\\1Model` and for a text file's `Model::Hips`."""
    name = record.value(1, str, "").split("\0", 1)[0]
    return name.split("::", 1)[1] if name.startswith(KINDS) else name


def properties_of(record: Record) -> dict[str, list]:
    """Return the numbers of each property in a record's Properties70."""
    lines = record.first("Properties70").all("P")
    return {line.value(0, str, ""): [v for v in line.values[4:] if isinstance(v, NUMBERS) and abs(v) < 1e30] for line in lines}


def _settings(fbx: Fbx) -> tuple[np.ndarray, float]:
    """Return the matrix (4, 4) from the file's axes and unit to metres and Y up, and the frames per second, 0 for none."""
    given = properties_of(fbx.root.first("GlobalSettings"))

    def number(name: str, default: float) -> float:
        return float(next(iter(given.get(name, [])), default))

    out = np.zeros((4, 4))
    for row, (axis, usual) in enumerate((("CoordAxis", 0), ("UpAxis", 1), ("FrontAxis", 2))):
        which, sign = number(axis, usual), number(f"{axis}Sign", 1)
        if which not in (0, 1, 2) or sign not in (-1, 1):
            raise fbx.wrong("an axis 0, 1 or 2 with sign 1 or -1 expected", f"GlobalSettings {axis}", (which, sign))
        out[row, int(which)] = sign
    unit = number("UnitScaleFactor", 1.0)
    if abs(np.linalg.det(out[:3, :3])) != 1 or not 1e-6 < unit < 1e6:
        raise fbx.wrong("three different axes, and a unit above 0, expected", "GlobalSettings", unit)
    out[:3] *= unit / 100  # the unit is in centimetres
    out[3, 3] = 1
    mode = int(number("TimeMode", 0))
    fps = RATES.get(mode, number("CustomFrameRate", 0.0) if mode == 14 else 0.0)
    return out, fps if 10 <= fps <= 240 else 0.0


def euler(degrees: np.ndarray, order: str = "XYZ") -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of angles about X, Y and Z (..., 3), degrees; the axis named first turns first."""
    angles = degrees[..., ["XYZ".index(axis) for axis in order]].reshape(-1, 3)
    return Rotation.from_euler(order.lower(), angles, degrees=True).as_matrix().reshape(*degrees.shape, 3)

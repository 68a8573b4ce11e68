"""Characters and animations in FBX: models with their pivots and inherited scales, skins, and curves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.io.character.fbx import Fbx, Record, read_fbx
from ncs_jax.io.character.fbx_curve import Curve, curve_from
from ncs_jax.io.character.rig import MOST_NODES, Piece, body_of, clip_named, first_that_moves, motion_of, rig_from
from ncs_jax.io.mesh.polygons import triangulate
from ncs_jax.io.records import BodyRecord, MotionRecord
from ncs_jax.io.tables.files import reading

__all__ = ["fbx_body", "fbx_motion"]

DEEPEST = 500  # models from the top to a leaf
TICK = 46_186_158_000  # a second
RATES = {
    1: 120.0, 2: 100.0, 3: 60.0, 4: 50.0, 5: 48.0, 6: 30.0, 7: 30.0, 8: 30 / 1.001, 9: 30 / 1.001, 10: 25.0, 11: 24.0,
    13: 24 / 1.001, 15: 96.0, 16: 72.0, 17: 60 / 1.001, 18: 120 / 1.001,
}  # fmt: skip
ORDERS = ("XYZ", "XZY", "YZX", "YXZ", "ZXY", "ZYX")  # the axis named first turns first
NUMBERS = (int, float)
LCL = ("Lcl Translation", "Lcl Rotation", "Lcl Scaling")


@dataclass(frozen=True, eq=False)
class FbxModel:
    """A node. Its properties come from the node itself, else from the file's template."""

    key: int
    name: str
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

    `to_metres` (4, 4) leads from the file's axes and unit to metres and Y up. `fps`: frames per second.
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


def fbx_body(path: str | Path) -> BodyRecord:
    """Read the skinned character of an .fbx in the pose in which it was bound, m, Y up: see `rig_from`.

    Units and axes are those that the file states. All skinned meshes are joined, and polygons become triangles. Meshes without
    a skin, shapes and materials are ignored.
    """
    with reading(Path(path), "FBX"):
        graph = _graph(read_fbx(path))
        pieces = _pieces(graph)
        if not pieces:
            raise graph.fbx.wrong("a skinned mesh expected", "skins", "none", "export the character with its skin")
        return body_of(rig_from(graph.fbx.file, [m.name for m in graph.models], graph.parents, _worlds(graph), pieces))


def fbx_motion(path: str | Path, name: str = "") -> MotionRecord:
    """Read an animation of an .fbx since the pose of `fbx_body`, at the file's frame rate; the first that moves, or the named.

    Joints without curves keep their model's place. In a file without a skin (Mixamo's "Without Skin"), the rest pose is the one
    in which the models stand.
    """
    with reading(Path(path), "FBX"):
        graph = _graph(read_fbx(path))
        begin, end, curves, notes = _animation(graph, name)
        pieces = _pieces(graph)
        turning = [m for (m, p, _), c in curves.items() if p == "Lcl Rotation" and np.ptp(c.values) > 0.01]
        rig = rig_from(
            graph.fbx.file, [m.name for m in graph.models], graph.parents, _worlds(graph), pieces, sorted(set(turning))
        )
        wanted = rig.nodes.tolist()
        found = motion_of(rig, (begin, end, graph.fps), lambda times: _worlds(graph, wanted, curves, times))
        return replace(found, notes=notes)


def _graph(fbx: Fbx) -> Graph:
    """Return the models of a file, sorted by depth, with what is connected to them."""
    objects = {r.value(0, int, 0): r for r in fbx.root.first("Objects").inner}
    below: dict[int, list[tuple[int, str]]] = {}
    for line in fbx.root.first("Connections").all("C"):
        if line.value(0, str, "") in ("OO", "OP"):
            below.setdefault(line.value(2, int, 0), []).append((line.value(1, int, 0), line.value(3, str, "")))
    template: dict[str, list] = {}
    for defined in fbx.root.first("Definitions").all("ObjectType"):
        if defined.value(0, str, "") == "Model":
            template = _properties(defined.first("PropertyTemplate"))
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
    models = [FbxModel(keys[i], _name(objects[keys[i]]), template | _properties(objects[keys[i]])) for i in order]
    parents = np.array([rank[parents[i]] if parents[i] >= 0 else -1 for i in order], np.int32)
    return Graph(fbx, models, parents, objects, below, *_settings(fbx))


def _name(record: Record) -> str:
    """Return the name of an object: `Hips` for a binary file's `Hips\\0\\1Model` and for a text file's `Model::Hips`."""
    name = record.value(1, str, "").split("\0", 1)[0]
    return name.split("::", 1)[1] if name.startswith(("Model::", "AnimStack::")) else name


def _properties(record: Record) -> dict[str, list]:
    """Return the numbers of each property in a record's Properties70."""
    lines = record.first("Properties70").all("P")
    return {line.value(0, str, ""): [v for v in line.values[4:] if isinstance(v, NUMBERS) and abs(v) < 1e30] for line in lines}


def _settings(fbx: Fbx) -> tuple[np.ndarray, float]:
    """Return the matrix (4, 4) from the file's axes and unit to metres and Y up, and the frames per second."""
    given = _properties(fbx.root.first("GlobalSettings"))

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
    mode = int(number("TimeMode", 6))
    fps = RATES.get(mode, number("CustomFrameRate", 30.0) if mode == 14 else 30.0)
    return out, fps if 10 <= fps <= 240 else 30.0


def _euler(degrees: np.ndarray, order: str = "XYZ") -> np.ndarray:
    """Return rotation matrices (..., 3, 3) of angles about X, Y and Z (..., 3), degrees; the axis named first turns first."""
    angles = degrees[..., ["XYZ".index(axis) for axis in order]].reshape(-1, 3)
    return Rotation.from_euler(order.lower(), angles, degrees=True).as_matrix().reshape(*degrees.shape, 3)


def _local(model: FbxModel, moved: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return translation (..., 3), rotation (..., 3, 3) and scale (..., 3) of a model, with its pivots.

    M = T Roff Rp Rpre R Rpost^-1 Rp^-1 Soff Sp S Sp^-1.
    """
    place, turn, scale = (
        moved.get(f"Lcl {name}", model.vector(f"Lcl {name}", default))
        for name, default in (("Translation", 0.0), ("Rotation", 0.0), ("Scaling", 1.0))
    )
    order = model.number("RotationOrder")
    before, after = _euler(model.vector("PreRotation")), _euler(model.vector("PostRotation"))
    rotation = before @ _euler(turn, ORDERS[order] if 0 <= order < 6 else "XYZ") @ after.T
    pivot, scaled = model.vector("RotationPivot"), model.vector("ScalingPivot")
    inner = model.vector("ScalingOffset") + scaled - scale * scaled - pivot
    shift = place + model.vector("RotationOffset") + pivot + np.einsum("...ab,...b->...a", rotation, inner)
    return shift, rotation, scale


def _worlds(
    graph: Graph, wanted: Sequence[int] = (), curves: dict | None = None, times: np.ndarray | None = None
) -> np.ndarray:
    """Return model to world: (N, 4, 4) of all models as they stand, or (times, n, 4, 4) of those wanted.

    Scales are inherited as InheritType says: 0 after the model's own rotation, 1 before it, 2 without the parent's own.
    """
    count = () if times is None else (len(times),)
    needed = set(range(len(graph.models)) if times is None else ())
    for node in wanted:
        while node >= 0 and node not in needed:
            needed.add(node)
            node = int(graph.parents[node])
    turns, shears, owns, places = {}, {}, {}, {}
    for i in sorted(needed):  # parents stand before their children
        model, above = graph.models[i], int(graph.parents[i])
        moved = {} if curves is None or times is None else _moved(model, i, curves, times)
        place, turn, scale = _local(model, moved)
        own = np.eye(3) * scale[..., None, :]
        if above < 0:
            turns[i], shears[i], owns[i], places[i] = turn, own, own, place
            continue
        linear = turns[above] @ shears[above]
        inherit = model.number("InheritType")
        turns[i] = turns[above] @ turn
        if inherit == 1:
            shears[i] = np.swapaxes(turn, -1, -2) @ shears[above] @ turn @ own
        elif inherit == 2:
            shears[i] = shears[above] @ np.linalg.pinv(owns[above]) @ own
        else:
            shears[i] = shears[above] @ own
        owns[i] = own
        places[i] = np.einsum("...ab,...b->...a", linear, place) + places[above]
    chosen = range(len(graph.models)) if times is None else wanted
    out = np.zeros((*count, len(chosen), 4, 4))
    for n, i in enumerate(chosen):
        out[..., n, :3, :3], out[..., n, :3, 3], out[..., n, 3, 3] = turns[i] @ shears[i], places[i], 1
    return graph.to_metres @ out


def _moved(model: FbxModel, number: int, curves: dict, times: np.ndarray) -> dict[str, np.ndarray]:
    """Return those of a model's translation, rotation and scaling (times, 3) that curves move."""
    found = {}
    for name, usual in (("Lcl Translation", 0.0), ("Lcl Rotation", 0.0), ("Lcl Scaling", 1.0)):
        own = [curves.get((number, name, axis)) for axis in range(3)]
        if any(c is not None for c in own):
            still = model.vector(name, usual)
            columns = [c.at(times) if c is not None else np.full(len(times), s) for c, s in zip(own, still, strict=True)]
            found[name] = np.stack(columns, axis=-1)
    return found


def _animation(graph: Graph, name: str) -> tuple[float, float, dict[tuple[int, str, int], Curve], tuple[str, ...]]:
    """Return begin and end of an animation, s, its curves by (model, property, axis), and notes on which one it is.

    Without a name it is the first that moves a model: what Mixamo writes begins with an empty take.
    """
    stacks = [(k, r) for k, r in graph.objects.items() if r.name == "AnimationStack"]
    names = [_name(r) for _, r in stacks]
    place = {m.key: i for i, m in enumerate(graph.models)}
    above: dict[int, list[tuple[int, str]]] = {}
    for owner, inner in graph.below.items():
        if owner in place:
            for k, p in inner:
                above.setdefault(k, []).append((place[owner], p))
    named = clip_named(graph.fbx.file, names, name)
    full = [n for n, (key, _) in enumerate(stacks) if any(_curve_nodes(graph, key, above))]
    number, curves, notes = first_that_moves(
        names, [named] if name else full, lambda n: _curves(graph, stacks[n][0], above),
        lambda found: any(np.ptp(c.values) > 1e-6 for c in found.values()), full,
    )  # fmt: skip
    if not curves:
        raise graph.fbx.wrong("curves of some joint expected", "AnimationStack", names, "write FILE#NAME with another of these")
    key, stack = stacks[number]
    layers = list(dict.fromkeys(layer for layer, _, _, _ in _curve_nodes(graph, key, above)))
    if len(layers) > 1:
        called = ", ".join(_name(graph.objects[layer]) for layer in layers)
        notes = (*notes, f"of its layers ({called}) the first that moves a joint counts; bake them to have all")
    times = _properties(stack)
    begin, end = (next(iter(times.get(n, [])), 0) / TICK for n in ("LocalStart", "LocalStop"))
    if not end > begin:
        begin, end = min(c.times[0] for c in curves.values()), max(c.times[-1] for c in curves.values())
    return float(begin), float(end), curves, notes


def _curve_nodes(graph: Graph, stack: int, above: dict) -> Iterator[tuple[int, Record, list, tuple[int, str]]]:
    """Yield layer, node, curves and (model, property) of all in an animation that moves a model by curves."""
    for layer, _, _ in graph.under(stack, "AnimationLayer"):
        for node, record, _ in graph.under(layer, "AnimationCurveNode"):
            curves = [(r, channel) for _, r, channel in graph.under(node, "AnimationCurve")]
            yield from ((layer, record, curves, (m, kind)) for m, kind in above.get(node, []) if curves and kind in LCL)


def _curves(graph: Graph, stack: int, above: dict) -> dict[tuple[int, str, int], Curve]:
    """Return the curves of an animation by (model, property, axis); where several layers move one, the first counts."""
    curves: dict[tuple[int, str, int], Curve] = {}
    layer_of: dict[tuple[int, str], int] = {}
    for layer, record, lines, (model, kind) in _curve_nodes(graph, stack, above):
        if layer_of.setdefault((model, kind), layer) != layer:
            continue
        label = f"{kind} of {graph.models[model].name}"
        for line, channel in lines:
            where = (model, kind, "XYZ".find(channel[-1:]))
            if where[2] < 0 or where in curves:
                raise graph.fbx.wrong("one curve for each of X, Y and Z expected", label, channel, "bake the animation")
            curves[where] = curve_from(graph.fbx, line, label, TICK)
        _still(record, model, kind, curves)
    return curves


def _still(record: Record, model: int, kind: str, curves: dict) -> None:
    """Add constant curves, where the curve node gives a value, for axes that have no curve."""
    given = _properties(record)
    for axis, letter in enumerate("XYZ"):
        value = given.get(f"d|{letter}", [])
        if value and (model, kind, axis) not in curves:
            curves[model, kind, axis] = Curve(np.zeros(1), np.array(value[:1], np.float64), np.zeros((1, 2)), np.zeros(1, int))


def _pieces(graph: Graph) -> list[Piece]:
    """Return the triangles under each skin."""
    found = []
    for number, model in enumerate(graph.models):
        for key, mesh, _ in graph.under(model.key, "Geometry", "Mesh"):
            for skin, _, _ in graph.under(key, "Deformer", "Skin")[:1]:
                found.append(_piece(graph, number, mesh, skin))
    return found


def _piece(graph: Graph, number: int, mesh: Record, skin: int) -> Piece:
    """Return the triangles of one mesh with the joints and weights of its skin."""
    fbx, model = graph.fbx, graph.models[number]
    where, place = f"mesh of {model.name}", {m.key: i for i, m in enumerate(graph.models)}
    x = fbx.array(mesh, "Vertices", where)
    corners = fbx.array(mesh, "PolygonVertexIndex", where, whole=True)
    if not len(x) or len(x) % 3 or not len(corners):
        raise fbx.wrong("vertices and polygons expected", where, f"{len(x)} numbers, {len(corners)} corners")
    x = x.reshape(-1, 3)
    last = corners < 0
    corners = np.where(last, -1 - corners, corners)
    if corners.max() >= len(x) or not last[-1]:
        raise fbx.wrong(f"whole polygons of the {len(x)} vertices expected", where, int(corners.max()))
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    nodes, binds, bounds = [], [], []
    for key, cluster, _ in graph.under(skin, "Deformer", "Cluster"):
        bones = [place[k] for k, _, _ in graph.under(key, "Model")]
        own = fbx.array(cluster, "Indexes", where, whole=True), fbx.array(cluster, "Weights", where)
        to_bone, to_world = fbx.array(cluster, "Transform", where), fbx.array(cluster, "TransformLink", where)
        if (
            len(bones) != 1
            or not len(to_bone) == len(to_world) == 16
            or len(own[0]) != len(own[1])
            or (own[0].size and own[0].max() >= len(x))
        ):
            raise fbx.wrong("a joint, its place, and weights of vertices that are there expected", where, _name(cluster))
        rows.append(own)
        nodes.append(bones[0])
        binds.append(to_bone.reshape(4, 4).T)
        bounds.append(graph.to_metres @ to_world.reshape(4, 4).T @ binds[-1])
    if not nodes or min((r[0].min() for r in rows if r[0].size), default=-1) < 0:
        raise fbx.wrong("vertices that joints move expected", where, f"{len(nodes)} joints")
    vertex, weight = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
    owner = np.repeat(np.arange(len(rows)), [len(r[0]) for r in rows])
    order = np.argsort(vertex, kind="stable")
    vertex, weight, owner = vertex[order], weight[order], owner[order]
    slot = np.arange(len(vertex)) - np.searchsorted(vertex, vertex)
    owners = np.zeros((len(x), int(slot.max()) + 1), np.int64)
    weights = np.zeros(owners.shape)
    owners[vertex, slot], weights[vertex, slot] = owner, np.maximum(weight, 0)
    sums = weights.sum(axis=1, keepdims=True)
    weights /= np.where(sums > 1e-6, sums, 1)  # a skin of FBX divides by the sum
    scale = model.vector("GeometricScaling", 1.0)
    x = (x * scale) @ _euler(model.vector("GeometricRotation")).T + model.vector("GeometricTranslation")
    counts = np.diff(np.flatnonzero(last), prepend=-1)
    whole = np.repeat(counts > 2, counts)  # what has two corners is an edge
    faces = triangulate(fbx.file, x, counts[counts > 2], corners[whole])
    faces = faces if scale.prod() > 0 else faces[:, ::-1]
    return Piece(x, faces, owners, weights, np.array(nodes), np.array(binds), bounds[0])

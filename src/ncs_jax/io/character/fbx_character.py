"""Characters and animations in FBX: models with their pivots and inherited scales, skins, and curves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ncs_jax.io.character.fbx import Record, read_fbx
from ncs_jax.io.character.fbx_bind import carriers
from ncs_jax.io.character.fbx_curve import Curve, curve_from
from ncs_jax.io.character.fbx_graph import FbxModel, Graph, euler, graph_of, name_of, properties_of
from ncs_jax.io.character.fbx_mesh import fbx_meshes, fbx_pieces, fbx_texture_coordinates, fbx_triangles
from ncs_jax.io.character.rig import body_of, rig_from, together
from ncs_jax.io.character.rig_motion import clip_named, first_that_moves, motion_of
from ncs_jax.io.character.spline import key_rate
from ncs_jax.io.mesh.part import chosen_meshes, one_object
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.records import BodyRecord, MotionRecord
from ncs_jax.io.tables.files import reading

__all__ = ["fbx_body", "fbx_garment", "fbx_motion"]

TICK = 46_186_158_000  # a second
ORDERS = ("XYZ", "XZY", "YZX", "YXZ", "ZXY", "ZYX")  # the axis named first turns first
LCL = ("Lcl Translation", "Lcl Rotation", "Lcl Scaling")


def fbx_body(path: str | Path, part: Sequence[str] = (), shapes: Mapping[str, float] | None = None) -> BodyRecord:
    """Read the skinned character of an .fbx in the pose in which it was bound, m, Y up: see `rig_from`.

    Units and axes are those that the file states. All skinned meshes are joined, or those that `part` names by model, mesh or
    material. Blend shapes have the file's weights, or those of `shapes`. Polygons become triangles, see `triangulate`. Meshes
    without a skin are ignored.
    """
    with reading(Path(path), "FBX"):
        graph = graph_of(read_fbx(path))
        worlds = _worlds(graph)
        pieces = fbx_pieces(graph, worlds, part, shapes)
        if not pieces:
            raise graph.fbx.wrong("a skinned mesh expected", "skins", "none", "export the character with its skin")
        return body_of(rig_from(graph.fbx.file, [m.name for m in graph.models], graph.parents, worlds, pieces))


def fbx_garment(path: str | Path, mesh: Sequence[str] = ()) -> RawGarment:
    """Read a mesh of an .fbx as it stands, or as it was bound if it has a skin, m, Y up.

    Args:
        path: the file. mesh: names of models, meshes or materials, which are joined. None: the file must hold one mesh.
    """
    with reading(Path(path), "FBX"):
        graph = graph_of(read_fbx(path))
        file, drawn = graph.fbx.file, fbx_meshes(graph)
        named = [d.named for d in drawn]
        chosen = chosen_meshes(file, "garment.mesh", mesh, named)
        if not mesh:
            one_object(file, "garment.mesh", named)
        worn = [d for d, wanted in zip(drawn, chosen, strict=True) if wanted]
        if not worn:
            raise graph.fbx.wrong("a mesh expected", "Objects", "none", "export the garment's mesh")
        worlds = _worlds(graph)
        if all(d.skin is not None for d in worn):
            names = [m.name for m in graph.models]
            rig = rig_from(file, names, graph.parents, worlds, fbx_pieces(graph, worlds, worn=worn))
            return RawGarment(
                file, rig.vertices, rig.faces, rig.uv, weights=rig.weights, joint_names=rig.names, notes=rig.notes
            )
        parts, start = [], 0
        for d in worn:
            (x, faces), matrix, uv = fbx_triangles(graph, d, {}), worlds[d.model], fbx_texture_coordinates(graph, d)
            step = 1 if np.linalg.det(matrix[:3, :3]) > 0 else -1
            placed = x @ matrix[:3, :3].T + matrix[:3, 3]
            parts.append((placed, faces[:, ::step] + start, None if uv is None else uv[:, ::step]))
            start += len(x)
        x, faces = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
        return RawGarment(file, x, faces, together([p[2] for p in parts]))


def fbx_motion(path: str | Path, name: str = "") -> MotionRecord:
    """Read an animation of an .fbx since the pose of `fbx_body`, at the file's frame rate; the first that moves, or the named.

    The rate is the one that the file states, else that of its keys, as in glTF.
    Joints without curves keep their model's place. In a file without a skin (Mixamo's "Without Skin"), the rest pose is the one
    in which the models stand; where that is a frame, the root's way aside in it belongs to the path.
    """
    with reading(Path(path), "FBX"):
        graph = graph_of(read_fbx(path))
        begin, end, curves, notes = _animation(graph, name)
        worlds = _worlds(graph)
        pieces = fbx_pieces(graph, worlds)
        turning = [m for (m, p, _), c in curves.items() if p == "Lcl Rotation" and np.ptp(c.values) > 0.01]
        names = [m.name for m in graph.models]
        rig = rig_from(graph.fbx.file, names, graph.parents, worlds, pieces, sorted(set(turning)))
        wanted = rig.nodes.tolist()
        if not pieces:
            above = carriers(graph, wanted[:1])
            rig = replace(rig, carrier=worlds[above[0], :3, 3] if above else np.zeros(3))
        fps = graph.fps or key_rate(c.times for c in curves.values())
        found = motion_of(rig, (begin, end, fps), lambda times: _worlds(graph, wanted, curves, times))
        return replace(found, notes=(*notes, *found.notes))


def _local(model: FbxModel, moved: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return translation (..., 3), rotation (..., 3, 3) and scale (..., 3) of a model, with its pivots.

    M = T Roff Rp Rpre R Rpost^-1 Rp^-1 Soff Sp S Sp^-1.
    """
    place, turn, scale = (
        moved.get(f"Lcl {name}", model.vector(f"Lcl {name}", default))
        for name, default in (("Translation", 0.0), ("Rotation", 0.0), ("Scaling", 1.0))
    )
    order = model.number("RotationOrder")
    before, after = euler(model.vector("PreRotation")), euler(model.vector("PostRotation"))
    rotation = before @ euler(turn, ORDERS[order] if 0 <= order < 6 else "XYZ") @ after.T
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
    names = [name_of(r) for _, r in stacks]
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
        called = ", ".join(name_of(graph.objects[layer]) for layer in layers)
        notes = (*notes, f"of its layers ({called}) the first that moves a joint counts; bake them to have all")
    times = properties_of(stack)
    begin, end = (next(iter(times.get(n, [])), 0) / TICK for n in ("LocalStart", "LocalStop"))
    if not end > begin:
        keyed = [c.times for c in curves.values() if len(c.times) > 1] or [np.zeros(1)]
        begin, end = min(t[0] for t in keyed), max(t[-1] for t in keyed)
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
    given = properties_of(record)
    for axis, letter in enumerate("XYZ"):
        value = given.get(f"d|{letter}", [])
        if value and (model, kind, axis) not in curves:
            curves[model, kind, axis] = Curve(np.zeros(1), np.array(value[:1], np.float64), np.zeros((1, 2)), np.zeros(1, int))

"""Meshes in FBX: polygons under models, with blend shapes and skins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ncs_jax.io.character.fbx import Record
from ncs_jax.io.character.fbx_bind import bind_pose, bound_now
from ncs_jax.io.character.fbx_graph import Graph, euler, name_of, properties_of
from ncs_jax.io.character.rig import Piece
from ncs_jax.io.mesh.part import NamedMesh, chosen_meshes
from ncs_jax.io.mesh.polygons import triangle_corners

__all__ = ["FbxMesh", "fbx_meshes", "fbx_pieces", "fbx_texture_coordinates", "fbx_triangles"]


@dataclass(frozen=True, eq=False)
class FbxMesh:
    """A mesh under a model: the model's number, the mesh's key and record, the key of its skin or None, and its names."""

    model: int
    key: int
    record: Record
    skin: int | None
    named: NamedMesh


def fbx_meshes(graph: Graph) -> list[FbxMesh]:
    """Return every mesh under a model, with the first skin that deforms it."""
    found = []
    for number, model in enumerate(graph.models):
        for key, mesh, _ in graph.under(model.key, "Geometry", "Mesh"):
            skin = next((k for k, _, _ in graph.under(key, "Deformer", "Skin")), None)
            materials = [name_of(r) for _, r, _ in graph.under(model.key, "Material")]
            count = graph.fbx.array(mesh, "Vertices", f"mesh of {model.name}").size // 3
            others = tuple(n for n in (name_of(mesh), *(materials if len(materials) == 1 else ())) if n)
            found.append(FbxMesh(number, key, mesh, skin, NamedMesh(model.name, number, count, others)))
    return found


def fbx_pieces(
    graph: Graph,
    worlds: np.ndarray,
    part: Sequence[str] = (),
    shapes: Mapping[str, float] | None = None,
    worn: Sequence[FbxMesh] = (),
) -> list[Piece]:
    """Return the triangles under each skin, chosen by `part` or `worn`; the others are there too: they tell of the joints.

    `worlds`: (N, 4, 4) of all models as they stand, m.
    """
    drawn = [d for d in fbx_meshes(graph) if d.skin is not None]
    chosen = chosen_meshes(graph.fbx.file, "body.part", part, [d.named for d in drawn])
    if worn:
        chosen = np.isin([d.key for d in drawn], [d.key for d in worn])
    known = dict.fromkeys(n for d, c in zip(drawn, chosen, strict=True) if c for n in _blend_shapes(graph, d))
    for name in shapes or {}:
        if name not in known:
            raise graph.fbx.wrong("no such shape", "body.shapes", name, f"the file has {', '.join(known)[:600] or 'none'}")
    stand = worlds, bind_pose(graph) if drawn else {}
    pieces = [replace(_piece(graph, stand, d, shapes or {}), chosen=c) for d, c in zip(drawn, chosen.tolist(), strict=True)]
    maps = [fbx_texture_coordinates(graph, d) if worn and c else None for d, c in zip(drawn, chosen.tolist(), strict=True)]
    return [replace(piece, uv=uv) for piece, uv in zip(pieces, maps, strict=True)]


def _blend_shapes(graph: Graph, mesh: FbxMesh) -> dict[str, tuple[float, Record]]:
    """Return the blend shapes of a mesh by name: the share that the file gives each, and its offsets.

    Of a channel with shapes in between, the last is taken: the one of full weight.
    """
    found = {}
    for deformer, _, _ in graph.under(mesh.key, "Deformer", "BlendShape"):
        for key, channel, _ in graph.under(deformer, "Deformer", "BlendShapeChannel"):
            given = properties_of(channel).get("DeformPercent") or [channel.first("DeformPercent").value(0, (int, float), 0.0)]
            shapes = [record for _, record, _ in graph.under(key, "Geometry", "Shape")]
            if shapes:
                found[name_of(channel)] = (float(given[0]) / 100, shapes[-1])
    return found


def fbx_triangles(graph: Graph, mesh: FbxMesh, shapes: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3), moved by blend shapes, and triangles (F, 3) of a mesh, in its model's space."""
    x, corners, cut = _cut(graph, mesh, shapes)
    return x, corners[cut].astype(np.int32)


def _cut(graph: Graph, mesh: FbxMesh, shapes: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices (V, 3), the polygons' corners (N,), and triangles (F, 3) of places in these; see `fbx_triangles`."""
    fbx, model = graph.fbx, graph.models[mesh.model]
    where = f"mesh of {model.name}"
    x = fbx.array(mesh.record, "Vertices", where)
    corners = fbx.array(mesh.record, "PolygonVertexIndex", where, whole=True)
    if not len(x) or len(x) % 3 or not len(corners):
        raise fbx.wrong("vertices and polygons expected", where, f"{len(x)} numbers, {len(corners)} corners")
    x = x.reshape(-1, 3)
    last = corners < 0
    corners = np.where(last, -1 - corners, corners)
    if corners.max() >= len(x) or not last[-1]:
        raise fbx.wrong(f"whole polygons of the {len(x)} vertices expected", where, int(corners.max()))
    for name, (usual, shape) in _blend_shapes(graph, mesh).items():
        if weight := shapes.get(name, usual):
            at, moved = fbx.array(shape, "Indexes", where, whole=True), fbx.array(shape, "Vertices", where).reshape(-1, 3)
            if len(at) != len(moved) or (len(at) and not 0 <= at.min() <= at.max() < len(x)):
                raise fbx.wrong(f"offsets of some of the {len(x)} vertices expected", f"{where}, shape {name}", len(at))
            x = x.copy()
            np.add.at(x, at, weight * moved)
    scale = model.vector("GeometricScaling", 1.0)
    x = (x * scale) @ euler(model.vector("GeometricRotation")).T + model.vector("GeometricTranslation")
    counts = np.diff(np.flatnonzero(last), prepend=-1)
    area = np.repeat(counts > 2, counts)  # edges that stand by themselves are polygons of two corners
    cut = np.flatnonzero(area)[triangle_corners(fbx.file, x, counts[counts > 2], corners[area])]
    return x, corners, cut if scale.prod() > 0 else cut[:, ::-1]


def fbx_texture_coordinates(graph: Graph, mesh: FbxMesh) -> np.ndarray | None:
    """Return the first texture coordinates (F, 3, 2) of a mesh's triangles, with the file's blend shapes, or None."""
    _, corners, cut = _cut(graph, mesh, {})
    layer, where = mesh.record.first("LayerElementUV"), f"mesh of {graph.models[mesh.model].name} LayerElementUV"
    mapping = layer.first("MappingInformationType").value(0, str, "")
    by_corner, by_vertex = mapping == "ByPolygonVertex", mapping in ("ByVertice", "ByVertex")
    if not (by_corner or by_vertex):
        return None
    table = graph.fbx.array(layer, "UV", where)
    number = np.arange(len(corners)) if by_corner else corners
    if layer.first("ReferenceInformationType").value(0, str, "") in ("IndexToDirect", "Index"):
        index = graph.fbx.array(layer, "UVIndex", where, whole=True)
        if number.max() >= len(index):
            raise graph.fbx.wrong(f"{number.max() + 1} numbers expected", f"{where} UVIndex", len(index))
        number = index[number]
    if len(table) % 2 or number.max() >= len(table) // 2:
        raise graph.fbx.wrong(f"{number.max() + 1} pairs expected", f"{where} UV", f"{len(table)} numbers")
    return None if number.min() < 0 else table.reshape(-1, 2)[number[cut]]  # -1: the corner has none


def _piece(graph: Graph, stand: tuple[np.ndarray, dict[int, np.ndarray]], mesh: FbxMesh, shapes: Mapping[str, float]) -> Piece:
    """Return the triangles of one mesh with the joints and weights of its skin; `stand`: models to the world, now and bound."""
    fbx, model = graph.fbx, graph.models[mesh.model]
    where, place = f"mesh of {model.name}", {m.key: i for i, m in enumerate(graph.models)}
    x, faces = fbx_triangles(graph, mesh, shapes)
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    nodes, binds, links = [], [], []
    for key, cluster, _ in graph.under(mesh.skin or 0, "Deformer", "Cluster"):
        bones = [place[k] for k, _, _ in graph.under(key, "Model")]
        own = fbx.array(cluster, "Indexes", where, whole=True), fbx.array(cluster, "Weights", where)
        to_bone, to_world = fbx.array(cluster, "Transform", where), fbx.array(cluster, "TransformLink", where)
        if (
            len(bones) != 1
            or not len(to_bone) == len(to_world) == 16
            or len(own[0]) != len(own[1])
            or (own[0].size and own[0].max() >= len(x))
        ):
            raise fbx.wrong("a joint, its place, and weights of vertices that are there expected", where, name_of(cluster))
        rows.append(own)
        nodes.append(bones[0])
        binds.append(to_bone.reshape(4, 4).T)
        links.append(graph.to_metres @ to_world.reshape(4, 4).T)
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
    bound = links[0] @ binds[0]
    moving = np.argsort([not r[1].any() for r in rows], kind="stable")  # those that move a vertex come first
    carried = bound_now(graph, *stand, [nodes[k] for k in moving], np.array(links)[moving])
    rests = None if carried is None else carried @ bound
    return Piece(x, faces, owners, weights, np.array(nodes), np.array(binds), bound, rests)

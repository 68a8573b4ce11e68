"""Characters and animations in glTF 2.0: nodes, skinned meshes and key frames, by the equations of the specification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ncs_jax.io.character.gltf import Gltf, read_gltf
from ncs_jax.io.character.gltf_mesh import (
    Drawn,
    check_shapes,
    drawn_triangles,
    floats_of,
    oriented,
    skinned_piece,
    texture_coordinates,
    triangles_of,
)
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.character.rig import MOST_NODES, Piece, body_of, rig_from, together, unique_names
from ncs_jax.io.character.rig_motion import clip_named, first_that_moves, motion_of
from ncs_jax.io.character.spline import hermite, key_rate, onto_keys
from ncs_jax.io.character.vrm import humanoid_bones
from ncs_jax.io.mesh.part import chosen_meshes, one_object
from ncs_jax.io.mesh.raw import RawGarment
from ncs_jax.io.records import BodyRecord, MotionRecord
from ncs_jax.io.tables.files import reading

__all__ = ["gltf_body", "gltf_garment", "gltf_motion"]

DEEPEST = 500  # nodes from the top to a leaf
PATHS = {"translation": 3, "rotation": 4, "scale": 3}


@dataclass(frozen=True, eq=False)
class Nodes:
    """All nodes (N): names, parents, local translation, rotation (w last) and scale, and `fixed` matrices, NaN elsewhere."""

    names: tuple[str, ...]
    parents: np.ndarray
    translation: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    fixed: np.ndarray


@dataclass(frozen=True, eq=False)
class Channel:
    """Keys of one property of one node: times (K,), s, strictly rising; values (K, width), or (3 K, width) for CUBICSPLINE."""

    node: int
    path: str
    times: np.ndarray
    values: np.ndarray
    mode: str


def gltf_body(path: str | Path, part: Sequence[str] = (), shapes: Mapping[str, float] | None = None) -> BodyRecord:
    """Read the skinned character of a .glb, .vrm or .gltf in the pose in which it was bound, m, Y up: see `rig_from`.

    All meshes under a skin are joined, or those that `part` names by object, mesh or material. Morph targets have the file's
    weights, or those of `shapes`. Vertices that differ only in texture coordinates and normals are merged. Meshes without a
    skin are ignored. The format does not say where a skin was bound: a character whose nodes were all moved together by a pose
    of the hips stands where that pose has it.
    """
    gltf = read_gltf(path)
    with reading(gltf.file, "glTF"):
        nodes = _nodes(gltf)
        pieces = _pieces(gltf, part, shapes)
        if not pieces:
            raise gltf.wrong("a skinned mesh expected", "skins", "none", "export the character with its skin")
        rig = rig_from(gltf.file, nodes.names, nodes.parents, _worlds(nodes, range(len(nodes.names))), pieces)
        return replace(body_of(rig), bones=humanoid_bones(gltf, rig, rig.names))


def gltf_garment(path: str | Path, mesh: Sequence[str] = ()) -> RawGarment:
    """Read a mesh of a .glb, .vrm or .gltf as it stands in the file's scene, m, Y up; a skinned one as it was bound.

    Args:
        path: the file. mesh: names of objects, meshes or materials, which are joined. None: the file must hold one object.
    """
    gltf = read_gltf(path)
    with reading(gltf.file, "glTF"):
        nodes = _nodes(gltf)
        drawn = drawn_triangles(gltf, _in_scene(gltf, nodes))
        named = [d.named for d in drawn]
        chosen = chosen_meshes(gltf.file, "garment.mesh", mesh, named)
        if not mesh:
            one_object(gltf.file, "garment.mesh", named)
        worn = [d for d, wanted in zip(drawn, chosen, strict=True) if wanted]
        if not worn:
            raise gltf.wrong("a mesh expected", "meshes", "none", "export the garment's mesh")
        worlds = _worlds(nodes, range(len(nodes.names)))
        if all(d.skin >= 0 for d in worn):
            rig = rig_from(gltf.file, nodes.names, nodes.parents, worlds, _pieces(gltf, worn=worn))
            return RawGarment(
                gltf.file,
                rig.vertices,
                rig.faces,
                rig.uv,
                splits=True,
                weights=rig.weights,
                joint_names=rig.names,
                notes=rig.notes,
            )
        parts, start = [], 0
        for d in worn:
            x, faces = triangles_of(gltf, d, {})
            faces = oriented(faces, worlds[d.node])
            placed = x @ worlds[d.node, :3, :3].T + worlds[d.node, :3, 3]
            parts.append((placed, faces + start, texture_coordinates(gltf, d, faces, len(x))))
            start += len(x)
        x, faces = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
        return RawGarment(gltf.file, x, faces, together([p[2] for p in parts]), splits=True)


def _in_scene(gltf: Gltf, nodes: Nodes) -> list[int]:
    """Return the nodes of the scene that is shown, in their order; all where the file has no scene."""
    scenes = gltf.objects("scenes")
    if not scenes:
        return list(range(len(nodes.names)))
    shown = gltf.whole("scene", gltf.tree, "scene", len(scenes), 0)
    roots = set(gltf.wholes("nodes", scenes[shown], f"scene {shown}", len(nodes.names)))
    return [n for n in range(len(nodes.names)) if roots & set(path_to_root(nodes.parents, n))]


def gltf_motion(path: str | Path, name: str = "") -> MotionRecord:
    """Read an animation of a .glb, .vrm, .vrma or .gltf since the pose of `gltf_body`; the first that moves, or the named.

    The frames are the keys, if they have a constant rate of 10 to 240 a second; else there are 30 a second, from the first key
    to the last. Joints without keys keep their node's place. In a file without a skin, the rest pose is the one in which the
    nodes stand; where that is a frame, the root's way aside in it belongs to the path.
    """
    gltf = read_gltf(path)
    with reading(gltf.file, "glTF"):
        nodes = _nodes(gltf)
        tracks, notes = _animation(gltf, nodes, name)
        pieces = _pieces(gltf)
        turning = sorted({t.node for t in tracks if t.path == "rotation" and _range(t) > 1e-4})
        rest = _worlds(nodes, range(len(nodes.names)))
        rig = rig_from(gltf.file, nodes.names, nodes.parents, rest, pieces, turning)
        begin, end = min(float(t.times[0]) for t in tracks), max(float(t.times[-1]) for t in tracks)
        fps = key_rate(t.times for t in tracks)
        found = motion_of(rig, (begin, end, fps), lambda times: _worlds(nodes, rig.nodes.tolist(), tracks, times))
        bones = humanoid_bones(gltf, rig, found.joint_names)
        return replace(found, bones=bones, notes=(*notes, *found.notes))


def _nodes(gltf: Gltf) -> Nodes:
    """Return all nodes, after a check that they form trees."""
    given = gltf.objects("nodes")
    count = len(given)
    if not 0 < count <= MOST_NODES:
        raise gltf.wrong(f"1 to {MOST_NODES} nodes expected", "nodes", count, "export one character only")
    parents = np.full(count, -1, np.int32)
    for i, node in enumerate(given):
        for child in gltf.wholes("children", node, f"node {i}", count):
            if parents[child] >= 0:
                raise gltf.wrong("one parent for each node expected", f"node {child}", [int(parents[child]), i])
            parents[child] = i
    for i in range(count):
        steps, above = 0, i
        while (above := int(parents[above])) >= 0:
            if (steps := steps + 1) > DEEPEST:
                raise gltf.wrong(f"a tree at most {DEEPEST} nodes deep expected", f"node {i}", "deeper, or a circle")
    fixed = np.full((count, 4, 4), np.nan)
    translation, rotation, scale = np.zeros((count, 3)), np.zeros((count, 4)), np.ones((count, 3))
    for i, node in enumerate(given):
        translation[i] = gltf.numbers("translation", node, f"node {i}", (0.0, 0.0, 0.0))
        scale[i] = gltf.numbers("scale", node, f"node {i}", (1.0, 1.0, 1.0))
        rotation[i] = gltf.numbers("rotation", node, f"node {i}", (0.0, 0.0, 0.0, 1.0))
        if "matrix" in node:
            fixed[i] = gltf.numbers("matrix", node, f"node {i}", (0.0,) * 16).reshape(4, 4).T
    names = unique_names([gltf.text("name", node, f"node {i}") for i, node in enumerate(given)])
    return Nodes(names, parents, translation, _unit(gltf, rotation, "nodes, rotation"), scale, fixed)


def _unit(gltf: Gltf, q: np.ndarray, where: str) -> np.ndarray:
    """Return quaternions (..., 4) divided by their lengths."""
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if (length < 1e-6).any():
        raise gltf.wrong("quaternions that are not zero expected", where, q[int(np.argmin(length))].tolist())
    return q / length


def _worlds(nodes: Nodes, wanted: Sequence[int], tracks: Sequence[Channel] = (), times: np.ndarray | None = None) -> np.ndarray:
    """Return node to world, M = M_parent T R S, of the wanted nodes: (n, 4, 4) as they stand, or (times, n, 4, 4)."""
    line: list[int] = []
    for node in wanted:  # each after its parents
        above = []
        while node >= 0 and node not in line:
            above.append(node)
            node = int(nodes.parents[node])
        line += reversed(above)
    moved = {} if times is None else {(t.node, t.path): _sampled(t, times) for t in tracks if t.node in line}
    world: dict[int, np.ndarray] = {}
    for node in line:
        own = nodes.fixed[node]
        if np.isnan(own[0, 0]):
            turn = Rotation.from_quat(moved.get((node, "rotation"), nodes.rotation[node])).as_matrix()
            linear = turn * moved.get((node, "scale"), nodes.scale[node])[..., None, :]
            place = moved.get((node, "translation"), nodes.translation[node])
            own = np.zeros((*np.broadcast_shapes(linear.shape[:-2], place.shape[:-1]), 4, 4))
            own[..., :3, :3], own[..., :3, 3], own[..., 3, 3] = linear, place, 1
        parent = int(nodes.parents[node])
        world[node] = own if parent < 0 else world[parent] @ own
    if times is None:
        return np.array([world[n] for n in wanted])
    return np.stack([np.broadcast_to(world[n], (len(times), 4, 4)) for n in wanted], axis=1)


def _pieces(
    gltf: Gltf,
    part: Sequence[str] = (),
    shapes: Mapping[str, float] | None = None,
    worn: Sequence[Drawn] = (),
) -> list[Piece]:
    """Return the triangles under each skin, chosen by `part` or `worn`; the others are there too: they tell of the joints."""
    drawn = [d for d in drawn_triangles(gltf, range(len(gltf.objects("nodes")))) if d.skin >= 0]
    chosen = chosen_meshes(gltf.file, "body.part", part, [d.named for d in drawn])
    if worn:
        places = {(d.node, d.where) for d in worn}
        chosen = np.array([(d.node, d.where) in places for d in drawn])
    check_shapes(gltf, shapes or {}, [d for d, wanted in zip(drawn, chosen, strict=True) if wanted])
    found: dict[tuple[int, bool], list[Drawn]] = {}
    for one, wanted in zip(drawn, chosen.tolist(), strict=True):
        found.setdefault((one.skin, wanted), []).append(one)
    pieces = [skinned_piece(gltf, skin, some, shapes or {}, wanted) for (skin, wanted), some in found.items()]
    maps = [_mapped(gltf, some) if worn and wanted else None for (_, wanted), some in found.items()]
    return [replace(piece, uv=uv) for piece, uv in zip(pieces, maps, strict=True)]


def _mapped(gltf: Gltf, drawn: Sequence[Drawn]) -> np.ndarray | None:
    """Return the texture coordinates (F, 3, 2) of primitives, None where one has none."""
    triangles = [triangles_of(gltf, d, {}) for d in drawn]
    return together([texture_coordinates(gltf, d, faces, len(x)) for d, (x, faces) in zip(drawn, triangles, strict=True)])


def _animation(gltf: Gltf, nodes: Nodes, name: str) -> tuple[list[Channel], tuple[str, ...]]:
    """Return the key frames of the named animation, or of the first that moves a node, and a note on the others."""
    animations = gltf.objects("animations")
    names = [gltf.text("name", a, f"animation {i}") for i, a in enumerate(animations)]
    named = clip_named(gltf.file, names, name)
    every = range(len(names))
    _, found, notes = first_that_moves(
        names, [named] if name else every, lambda n: _tracks(gltf, nodes, n),
        lambda tracks: any(_range(t) > 1e-6 for t in tracks), every,
    )  # fmt: skip
    if not found:
        raise gltf.wrong(
            "keys of some joint expected", "animations", "none", f"write FILE#NAME with one of {', '.join(names)[:400]}"
        )
    return found, notes


def _tracks(gltf: Gltf, nodes: Nodes, number: int) -> list[Channel]:
    """Return the key frames of one animation; those of morph targets and of other properties are ignored."""
    one, where = gltf.objects("animations")[number], f"animation {number}"
    samplers = gltf.objects("samplers", one, where)
    found: dict[tuple[int, str], Channel] = {}
    for c, channel in enumerate(gltf.objects("channels", one, where)):
        target = gltf.object("target", channel, f"{where}, channel {c}")
        path = gltf.text("path", target, f"{where}, channel {c}")
        if path not in PATHS or "node" not in target:
            continue
        node = gltf.whole("node", target, f"{where}, channel {c} node", len(nodes.names))
        label = f"{where}, {path} of {nodes.names[node]}"
        if (node, path) in found or not np.isnan(nodes.fixed[node, 0, 0]):
            raise gltf.wrong("keys once, and of a node without a matrix, expected", label)
        sampler = samplers[gltf.whole("sampler", channel, f"{label}, sampler", len(samplers))]
        found[node, path] = _track(gltf, sampler, node, path, label)
    return list(found.values())


def _track(gltf: Gltf, sampler: dict, node: int, path: str, label: str) -> Channel:
    """Return the key frames of one property of one node."""
    mode = gltf.text("interpolation", sampler, label) or "LINEAR"
    if mode not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise gltf.wrong("LINEAR, STEP or CUBICSPLINE expected", label, mode)
    times = floats_of(gltf, sampler, "input", label, ("SCALAR",))[:, 0]
    values = floats_of(gltf, sampler, "output", label, (f"VEC{PATHS[path]}",))
    if not len(times) or len(values) != len(times) * (3 if mode == "CUBICSPLINE" else 1):
        raise gltf.wrong("as many values as times expected (CUBICSPLINE: three)", label, f"{len(values)} for {len(times)}")
    if times[0] < 0 or (np.diff(times) <= 0).any():
        raise gltf.wrong("rising times from 0 s expected", label, times[max(int(np.argmin(np.diff(times, prepend=-1))), 0)])
    if path == "rotation" and mode != "CUBICSPLINE":
        values = _unit(gltf, values, label)
    return Channel(node, path, times, values, mode)


def _range(track: Channel) -> float:
    """Return by how much a property changes from key to key, at most; a quaternion and its negative are one rotation."""
    values = track.values[1::3] if track.mode == "CUBICSPLINE" else track.values
    if track.path == "rotation":
        values = np.where(values @ values[:1].T < 0, -values, values)
    return float(np.ptp(values, axis=0).max())


def _sampled(track: Channel, times: np.ndarray) -> np.ndarray:
    """Return a property (times, width) at times (s); constant before the first key and after the last."""
    keys, last = track.times, len(track.times) - 1
    times = onto_keys(np.clip(times, keys[0], keys[-1]), keys)
    low = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, last)
    if track.mode == "STEP" or last == 0:
        values = track.values[1::3] if track.mode == "CUBICSPLINE" else track.values
        found = values[low]
    else:
        low = np.minimum(low, last - 1)
        span = keys[low + 1] - keys[low]
        t = (times - keys[low]) / span
        if track.mode == "LINEAR" and track.path == "rotation":
            return Slerp(keys, Rotation.from_quat(track.values))(times).as_quat()
        t, span = t[:, None], span[:, None]
        if track.mode == "LINEAR":
            return track.values[low] * (1 - t) + track.values[low + 1] * t
        arriving, values, leaving = track.values[::3], track.values[1::3], track.values[2::3]
        found = hermite(t, span, values[low], values[low + 1], leaving[low], arriving[low + 1])
    if track.path == "rotation":
        found = found / np.maximum(np.linalg.norm(found, axis=-1, keepdims=True), 1e-12)
    return found

"""Meshes in glTF 2.0: triangles under nodes, with morph targets, skins and Draco, as the specification draws them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ncs_jax.io.character.draco import unpack_draco
from ncs_jax.io.character.gltf import Gltf
from ncs_jax.io.character.rig import Piece
from ncs_jax.io.mesh.part import NamedMesh

__all__ = [
    "Drawn",
    "check_shapes",
    "drawn_triangles",
    "floats_of",
    "oriented",
    "skinned_piece",
    "texture_coordinates",
    "triangles_of",
]

TRIANGLES = 4  # the first of the modes that draw triangles; below are points and lines


@dataclass(frozen=True, eq=False)
class Drawn:
    """A primitive that a node draws.

    Attributes:
        where: for errors. node, mesh: numbers of the file. skin: number, -1 for none. tree: the primitive's JSON. named: what
            it is called. targets: names of its morph targets. weights: of these, where nothing is said.
    """

    where: str
    node: int
    mesh: int
    skin: int
    tree: dict
    named: NamedMesh
    targets: tuple[str, ...]
    weights: np.ndarray


def drawn_triangles(gltf: Gltf, nodes: Iterable[int]) -> list[Drawn]:
    """Return all primitives with triangles that some nodes draw."""
    meshes, skins, materials = (gltf.objects(name) for name in ("meshes", "skins", "materials"))
    given, found = gltf.objects("nodes"), []
    for i in nodes:
        node = given[i]
        if "mesh" not in node:
            continue
        number = gltf.whole("mesh", node, f"node {i} mesh", len(meshes))
        skin = gltf.whole("skin", node, f"node {i} skin", len(skins)) if "skin" in node else -1
        mesh, mesh_name = meshes[number], gltf.text("name", meshes[number], f"mesh {number}")
        name = gltf.text("name", node, f"node {i}") or mesh_name
        for p, primitive in enumerate(gltf.objects("primitives", mesh, f"mesh {number}")):
            where = f"mesh {number}, primitive {p}"
            if gltf.whole("mode", primitive, f"{where} mode", 7, TRIANGLES) < TRIANGLES:
                continue
            material = ""
            if "material" in primitive:
                own = gltf.whole("material", primitive, f"{where} material", len(materials))
                material = gltf.text("name", materials[own], f"material {own}")
            attributes = gltf.object("attributes", primitive, where)
            place = gltf.whole("POSITION", attributes, f"{where} POSITION", len(gltf.objects("accessors")))
            count = gltf.whole("count", gltf.objects("accessors")[place], f"accessor {place} count", 2**32)
            targets = _target_names(gltf, mesh, primitive, where)
            weights = node if "weights" in node else mesh
            default = gltf.numbers("weights", weights, where, (0.0,) * len(targets)) if targets else np.zeros(0)
            named = NamedMesh(name, i, count, (mesh_name or f"mesh_{number}",), material)
            found.append(Drawn(where, i, number, skin, primitive, named, targets, default))
    return found


def _target_names(gltf: Gltf, mesh: dict, primitive: dict, where: str) -> tuple[str, ...]:
    """Return the names of a primitive's morph targets: `extras.targetNames`, of the mesh or the primitive, else numbers."""
    count = len(gltf.objects("targets", primitive, where))
    extras = [owner["extras"] for owner in (mesh, primitive) if isinstance(owner.get("extras"), dict)]
    names = next((e["targetNames"] for e in extras if "targetNames" in e), None)
    good = isinstance(names, list) and len(names) == count and all(isinstance(n, str) for n in names)
    return tuple(names) if good and isinstance(names, list) else tuple(map(str, range(count)))


def check_shapes(gltf: Gltf, shapes: Mapping[str, float], drawn: Sequence[Drawn]) -> None:
    """Raise an InputError where a shape has a name or number that is no morph target of what is drawn."""
    known = dict.fromkeys(n for d in drawn for n in d.targets)
    most = max((len(d.targets) for d in drawn), default=0)
    for name in shapes:
        if name not in known and not (name.isdigit() and int(name) < most):
            raise gltf.wrong(
                "no such shape",
                "body.shapes",
                name,
                f"the file has {', '.join(known)[:600] or 'none'}",
            )


def triangles_of(gltf: Gltf, drawn: Drawn, shapes: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3), moved by morph targets, and faces (F, 3) of a primitive, in its own space."""
    where, one = drawn.where, drawn.tree
    unpack_draco(gltf, one, where)
    x = floats_of(gltf, gltf.object("attributes", one, where), "POSITION", where, ("VEC3",))
    for k, (target, usual) in enumerate(zip(gltf.objects("targets", one, where), drawn.weights.tolist(), strict=True)):
        weight = shapes.get(drawn.targets[k], shapes.get(str(k), usual))
        if weight and "POSITION" in target:
            moved = floats_of(gltf, target, "POSITION", f"{where}, target {drawn.targets[k]}", ("VEC3",))
            if len(moved) != len(x):
                raise gltf.wrong(f"{len(x)} rows expected", f"{where}, target {drawn.targets[k]}", len(moved))
            x = x + weight * moved
    return x, _faces(gltf, one, where, len(x))


def _faces(gltf: Gltf, one: dict, where: str, count: int) -> np.ndarray:
    """Return the triangles (F, 3) of a list, a strip or a fan."""
    if "indices" in one:
        corners = _array(gltf, one, "indices", where, ("SCALAR",))[:, 0]
        if corners.dtype.kind != "u" or (corners >= count).any():
            raise gltf.wrong(f"numbers from 0 to {count - 1} expected", f"{where} indices", corners.max(initial=0).item())
        corners = corners.astype(np.int64)
    else:
        corners = np.arange(count)
    if len(corners) < 3:
        raise gltf.wrong("triangles expected", where, f"{len(corners)} corners")
    mode = one.get("mode", TRIANGLES)
    if mode == TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode == TRIANGLES + 1:  # a strip: every other triangle is turned around
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        a, b, c = faces.T
        return faces[(a != b) & (b != c) & (c != a)]  # such join strips, and draw nothing
    return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)


def oriented(faces: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return faces (F, 3) that face outward after a matrix (4, 4), which may mirror."""
    return faces if np.linalg.det(matrix[:3, :3]) > 0 else faces[:, ::-1]


def texture_coordinates(gltf: Gltf, drawn: Drawn, faces: np.ndarray, count: int) -> np.ndarray | None:
    """Return the first texture coordinates of the corners of faces (F, 3), (F, 3, 2), v upward, or None."""
    attributes = gltf.object("attributes", drawn.tree, drawn.where)
    if "TEXCOORD_0" not in attributes:
        return None
    uv = floats_of(gltf, attributes, "TEXCOORD_0", drawn.where, ("VEC2",))
    return (uv * [1, -1] + [0, 1])[faces] if len(uv) == count else None


def skinned_piece(gltf: Gltf, skin: int, drawn: Sequence[Drawn], shapes: Mapping[str, float], chosen: bool) -> Piece:
    """Return the triangles of primitives under one skin, with its joints and inverse bind matrices, the identity by default."""
    one, where = gltf.objects("skins")[skin], f"skin {skin}"
    joints = np.array(gltf.wholes("joints", one, where, len(gltf.objects("nodes"))), np.int64)
    if not len(joints):
        raise gltf.wrong("joints expected", where, "none")
    inverse = np.tile(np.eye(4).reshape(16), (len(joints), 1))
    if "inverseBindMatrices" in one:
        inverse = floats_of(gltf, one, "inverseBindMatrices", where, ("MAT4",))
    if len(inverse) < len(joints):
        raise gltf.wrong(f"{len(joints)} matrices expected, one a joint", f"{where} inverseBindMatrices", len(inverse))
    inverse = inverse[: len(joints)].reshape(-1, 4, 4).swapaxes(1, 2)
    if np.abs(inverse[:, 3] - [0, 0, 0, 1]).max() > 1e-4:
        raise gltf.wrong("matrices with (0, 0, 0, 1) below expected", f"{where} inverseBindMatrices")
    parts, start = [], 0
    for d in drawn:
        x, faces = triangles_of(gltf, d, shapes)
        owners, weights = _influences(gltf, d, len(x), len(joints))
        parts.append((x, faces + start, owners, weights))
        start += len(x)
    width = max(p[2].shape[1] for p in parts)
    owners, weights = (np.concatenate([np.pad(p[k], ((0, 0), (0, width - p[k].shape[1]))) for p in parts]) for k in (2, 3))
    x, faces = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
    return Piece(x, faces, owners, weights, joints, inverse, chosen=chosen)


def _influences(gltf: Gltf, drawn: Drawn, count: int, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each vertex the joints that move it, and their weights (V, 4, 8, ...)."""
    where, attributes = drawn.where, gltf.object("attributes", drawn.tree, drawn.where)
    owners, weights = [], []
    for number in range(8):
        if number and f"JOINTS_{number}" not in attributes:
            break
        owner = _array(gltf, attributes, f"JOINTS_{number}", where, ("VEC4",))
        weight = floats_of(gltf, attributes, f"WEIGHTS_{number}", where, ("VEC4",))
        if owner.dtype.kind != "u" or not len(owner) == len(weight) == count:
            raise gltf.wrong(
                f"whole numbers and weights for each of the {count} vertices expected", f"{where} JOINTS_{number}",
                f"{owner.dtype}, {len(owner)} and {len(weight)}",
            )  # fmt: skip
        owner = np.where(weight > 0, owner, 0)
        if (owner >= joints).any():
            raise gltf.wrong(f"joints from 0 to {joints - 1} expected", f"{where} JOINTS_{number}", int(owner.max()))
        owners.append(owner.astype(np.int64))
        weights.append(np.maximum(weight, 0))
    return np.concatenate(owners, axis=1), np.concatenate(weights, axis=1)


def _array(gltf: Gltf, owner: dict, name: str, where: str, kinds: tuple[str, ...]) -> np.ndarray:
    return gltf.accessor(gltf.whole(name, owner, f"{where} {name}", len(gltf.objects("accessors"))), kinds, f"{where} {name}")


def floats_of(gltf: Gltf, owner: dict, name: str, where: str, kinds: tuple[str, ...]) -> np.ndarray:
    """Return the accessor that an object names, as rows of float64."""
    return _array(gltf, owner, name, where, kinds).astype(np.float64)

"""Animations as binary glTF 2.0 (.glb): a morph target for each frame, and if wanted the body with its skeleton."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.objects import MovingObject
from ncs_jax.io.mesh.weld import distinct
from ncs_jax.io.records import AnimationRecord, BodyRecord, MotionRecord
from ncs_jax.io.tables.files import replacing

__all__ = ["write_glb", "write_glb_body"]

FLOAT, SHORT, INT = 5126, 5123, 5125  # glTF's codes for types of numbers
VERTICES, INDICES = 34962, 34963  # glTF's codes for the use of a buffer view
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
LARGEST = 2**32 - 1  # bytes that the header can count
DESCRIPTION = 1000  # bytes; the JSON of a frame or a joint takes less
MOST = 8  # joints that move a vertex, as in the package's own skinning
SKIN = 0.78, 0.74, 0.7


def write_glb(
    path: str | Path,
    objects: Sequence[MovingObject],
    fps: float,
    *,
    worn_by: tuple[BodyRecord, MotionRecord] | AnimationRecord | None = None,
    body: str = "body",
) -> None:
    """Write moving meshes that play in any viewer of glTF; the file appears whole or not at all.

    Each is a mesh of its own, which stands as in the first frame. Morph target k takes it to frame k, with its normals, in
    float32. At the time of frame k the weight of target k is 1 and every other is 0, linear between (sampler LINEAR), so that
    vertices move in straight lines between two frames. A frame takes 24 bytes a vertex, and the weights of a mesh take 4 bytes
    times the frames squared: 32 MB and 0.4 MB for 300 frames of 4,500 vertices. The sum that a viewer makes equals the frame to
    rounding of float32.

    glTF holds one texture coordinate a vertex: at seams a vertex is written several times, with its one normal.

    A body is a skinned mesh on joints that the same animation turns, without pose correctives. The 8 largest weights of a
    vertex are kept, the largest first, because some viewers know only the first 4.

    Args:
        path: the file to write. objects: at least one, float32, Y up, v of texture coordinates upward. fps: frames per second.
        worn_by: the body and its motion of T frames; or a body that is a moving mesh, which is written as the garments are.
        body: its name, as a modeller lists it.

    Raises:
        InputError: the file would be larger than 4 GiB, which the format cannot count, or it cannot be written.
    """
    moving, frames, size = list(objects), len(objects[0].vertices), 0
    if isinstance(worn_by, AnimationRecord):
        moving.append(MovingObject(body, SKIN, worn_by.vertices, worn_by.vertices[0], worn_by.faces, None))
    elif worn_by is not None:
        skin, motion = worn_by
        size += 88 * len(skin.vertices) + 4 * skin.faces.size + 16 * motion.poses.size + DESCRIPTION * len(skin.joints)
    parts = [(each, _split(each.vertices.shape[1], each.faces, each.uv)) for each in moving]
    for each, split in parts:
        size += 24 * frames * len(split.vertex) + 4 * frames * frames + 4 * each.faces.size + DESCRIPTION * frames
    if size > LARGEST:
        raise InputError(
            f"at most {LARGEST} bytes expected", file=path, field="vertices", value=f"{size} bytes",
            mend="write .usdc, .npz or .pc2, or fewer frames",
        )  # fmt: skip
    document = _Document()
    keys = None if frames == 1 else document.array((np.arange(frames) / fps).astype("<f4")[:, None], bounded=True)
    for each, split in parts:
        _moving(document, each, split, keys)
    if isinstance(worn_by, tuple):
        _body(document, body, *worn_by, keys)
    _write(path, document)


def write_glb_body(path: str | Path, body: BodyRecord) -> None:
    """Write a body at rest, as a skinned mesh on its joints; the file appears whole or not at all."""
    document, still = _Document(), np.zeros((1, len(body.joints), 3))
    _body(document, "body", body, MotionRecord(still, still[:, 0], 1.0), None)
    _write(path, document)


def _write(path: str | Path, document: _Document) -> None:
    """Write the JSON and the blocks of a document."""
    text = json.dumps(document.finished(), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with replacing(path) as new, new.open("xb") as stream:
        stream.write(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + 8 + document.length, len(text), b"JSON"))
        stream.write(text)
        stream.write(struct.pack("<I4s", document.length, b"BIN\0"))
        for length, arrays in document.blocks:
            for array in arrays():
                stream.write(np.ascontiguousarray(array).data)
            stream.write(b"\0" * (-length % 4))


class _Document:
    """The JSON of a file as it grows, and the blocks that its one buffer is to hold."""

    def __init__(self) -> None:
        self.nodes: list[dict] = []
        self.meshes: list[dict] = []
        self.materials: list[dict] = []
        self.skins: list[dict] = []
        self.roots: list[int] = []
        self.animation: dict = {"name": "garment", "samplers": [], "channels": []}
        self.accessors: list[dict] = []
        self.views: list[dict] = []
        self.blocks: list[tuple[int, Callable[[], Iterable[np.ndarray]]]] = []
        self.length = 0

    def view(self, length: int, arrays: Callable[[], Iterable[np.ndarray]], **more: int) -> int:
        """Add a block to the buffer, at a multiple of 4 bytes; return its number."""
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": length, **more})
        self.blocks.append((length, arrays))
        self.length += length + -length % 4
        return len(self.views) - 1

    def accessor(self, view: int, offset: int, kind: int, count: int, shape: str, ends: np.ndarray | None = None) -> int:
        """Add an accessor of a block; return its number. `ends` are its least and largest values."""
        given = {"bufferView": view, "byteOffset": offset, "componentType": kind, "count": count, "type": shape}
        self.accessors.append(given if ends is None else given | {"min": ends[0].tolist(), "max": ends[1].tolist()})
        return len(self.accessors) - 1

    def array(self, rows: np.ndarray, *, bounded: bool = False, **more: int) -> int:
        """Add an accessor of rows (N, components) in a block of their own; return its number."""
        kind = {"f4": FLOAT, "u2": SHORT, "u4": INT}[rows.dtype.str[1:]]
        view = self.view(rows.nbytes, lambda: [rows], **more)
        ends = np.stack([rows.min(axis=0), rows.max(axis=0)]) if bounded else None
        return self.accessor(view, 0, kind, len(rows), SHAPES[rows.shape[1]], ends)

    def corners(self, faces: np.ndarray, count: int) -> int:
        """Add an accessor of the corners of faces among `count` vertices; return its number."""
        return self.array(faces.astype("<u2" if count < 2**16 else "<u4").reshape(-1, 1), target=INDICES)

    def mesh(self, name: str, primitive: dict, color: tuple[float, ...], **more) -> dict:
        """Add a mesh of one primitive, and a root node that it hangs on; return the mesh."""
        metal = {"baseColorFactor": (*color, 1.0), "metallicFactor": 0, "roughnessFactor": 0.9}
        self.materials.append({"name": name, "doubleSided": True, "pbrMetallicRoughness": metal})
        mesh = {"name": name, "primitives": [primitive | {"mode": 4, "material": len(self.materials) - 1}]}
        self.meshes.append(mesh)
        self.roots.append(len(self.nodes))
        self.nodes.append({"name": name, "mesh": len(self.meshes) - 1, **more})
        return mesh

    def moved(self, node: int, path: str, keys: int, values: int) -> None:
        """Add a channel that moves a node's property linearly through values."""
        self.animation["channels"].append({"sampler": len(self.animation["samplers"]), "target": {"node": node, "path": path}})
        self.animation["samplers"].append({"input": keys, "output": values, "interpolation": "LINEAR"})

    def finished(self) -> dict:
        """Return the whole JSON; lists that stayed empty are left out."""
        own = {
            "nodes": self.nodes,
            "meshes": self.meshes,
            "materials": self.materials,
            "skins": self.skins,
            "animations": [self.animation] if self.animation["channels"] else [],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }
        head = {"asset": {"version": "2.0", "generator": "ncs-jax"}, "scene": 0, "scenes": [{"nodes": self.roots}]}
        return head | {name: things for name, things in own.items() if things}


class _Split(NamedTuple):
    """Vertices as glTF holds them: which of the mesh each is (N,), its texture coordinate (N, 2) or None, and the faces."""

    vertex: np.ndarray
    uv: np.ndarray | None
    faces: np.ndarray


def _split(count: int, faces: np.ndarray, uv: np.ndarray | None) -> _Split:
    """Return the vertices, one for each of their texture coordinates: the first in the mesh's order, the others after all."""
    if uv is None:
        return _Split(np.arange(count), None, faces)
    maps = uv.reshape(-1, 2) * [1, -1] + [0, 1]
    rows = np.concatenate([faces.reshape(-1, 1), maps], axis=1)
    kept, number = distinct(rows)
    vertex = rows[kept, 0].astype(np.int64)
    again = np.ones(len(kept), bool)
    again[np.unique(vertex, return_index=True)[1]] = False
    place = np.where(again, count + np.cumsum(again) - 1, vertex)
    source, own = np.arange(count + int(again.sum())), np.zeros((count + int(again.sum()), 2), np.float32)
    source[place], own[place] = vertex, maps[kept]
    return _Split(source, own, place[number].reshape(-1, 3))


def _moving(document: _Document, mesh: MovingObject, split: _Split, keys: int | None) -> None:
    """Add a moving mesh: its shape, a morph target for each later frame, and their weights over time."""
    vertices, faces = mesh.vertices, mesh.faces
    frames, count = len(vertices), len(split.vertex)

    def shapes() -> Iterator[np.ndarray]:
        first = vertices[0], vertex_normals(vertices[0], faces)
        for t, x in enumerate(vertices):
            for now, then in zip((x, vertex_normals(x, faces)), first, strict=True):
                yield (now - then if t else now).astype("<f4")[split.vertex]

    def weights() -> Iterator[np.ndarray]:
        return ((np.arange(1, frames) == t).astype("<f4") for t in range(frames))

    view = document.view(24 * frames * count, shapes, byteStride=12, target=VERTICES)
    attributes = []
    for t, x in enumerate(vertices):
        moved = x if t == 0 else x - vertices[0]
        place = 24 * count * t
        attributes.append(
            {
                "POSITION": document.accessor(
                    view, place, FLOAT, count, "VEC3", np.stack([moved.min(axis=0), moved.max(axis=0)])
                ),
                "NORMAL": document.accessor(view, place + 12 * count, FLOAT, count, "VEC3"),
            }
        )
    if split.uv is not None:
        attributes[0]["TEXCOORD_0"] = document.array(split.uv.astype("<f4"), target=VERTICES)
    primitive = {"attributes": attributes[0], "indices": document.corners(split.faces, count)}
    if keys is None:
        document.mesh(mesh.name, primitive, mesh.colour)
        return
    shown = document.mesh(mesh.name, primitive | {"targets": attributes[1:]}, mesh.colour)
    shown["extras"] = {"targetNames": [f"frame_{t:04}" for t in range(1, frames)]}
    number = frames * (frames - 1)
    weighed = document.accessor(document.view(4 * number, weights), 0, FLOAT, number, "SCALAR")
    document.moved(document.roots[-1], "weights", keys, weighed)


def _body(document: _Document, name: str, body: BodyRecord, motion: MotionRecord, keys: int | None) -> None:
    """Add the body: its skin, joints and their movement. The joints' axes are the world's at rest, as in `skinning.forward`."""
    count, joints = body.weights.shape
    poses = motion.poses if body.rest_rotations is None else np.einsum("jab,tjb->tja", body.rest_rotations, motion.poses)
    turns = Rotation.from_rotvec(poses.reshape(-1, 3)).as_quat().reshape(*poses.shape[:2], 4).astype("<f4")  # x y z w
    bones = body.joints - np.where(body.parents[:, None] >= 0, body.joints[body.parents], 0)
    path = (bones[0] + motion.translation).astype("<f4")

    order = np.argsort(-body.weights, axis=1, kind="stable")[:, :MOST]
    shares = np.take_along_axis(body.weights, order, axis=1)
    used = max(1, int((shares > 0).sum(axis=1).max()))
    width = -(-used // 4) * 4
    shares = np.pad(shares, ((0, 0), (0, max(0, width - shares.shape[1]))))[:, :width]
    order = np.pad(order, ((0, 0), (0, max(0, width - order.shape[1]))))[:, :width] * (shares > 0)
    shares = shares / shares.sum(axis=1, keepdims=True)
    attributes = {
        "POSITION": document.array(body.vertices.astype("<f4"), bounded=True, target=VERTICES),
        "NORMAL": document.array(vertex_normals(body.vertices, body.faces).astype("<f4"), target=VERTICES),
    }
    for k in range(0, width, 4):
        attributes[f"JOINTS_{k // 4}"] = document.array(order[:, k : k + 4].astype("<u2"), target=VERTICES)
        attributes[f"WEIGHTS_{k // 4}"] = document.array(shares[:, k : k + 4].astype("<f4"), target=VERTICES)
    primitive = {"attributes": attributes, "indices": document.corners(body.faces, count)}
    document.mesh(name, primitive, SKIN, skin=0)

    first = len(document.nodes)
    inverse = np.tile(np.eye(4), (joints, 1, 1))
    inverse[:, :3, 3] = -body.joints
    columns = inverse.swapaxes(1, 2).reshape(joints, 16).astype("<f4")
    document.skins.append({"joints": [*range(first, first + joints)], "inverseBindMatrices": document.array(columns)})
    document.roots.append(first)
    for j in range(joints):
        joint = body.joint_names[j] if body.joint_names else f"joint_{j}"
        place = path[0] if j == 0 else bones[j]
        node = {"name": joint, "translation": place.tolist(), "rotation": turns[0, j].tolist()}
        below = (first + np.flatnonzero(body.parents == j)).tolist()
        document.nodes.append(node | ({"children": below} if below else {}))
        if keys is not None and np.ptp(turns[:, j], axis=0).any():
            document.moved(first + j, "rotation", keys, document.array(turns[:, j]))
    if keys is not None and np.ptp(path, axis=0).any():
        document.moved(first, "translation", keys, document.array(path))

"""Animations as binary glTF 2.0 (.glb): one mesh, a morph target for each frame, and an animation of their weights."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.files import replacing
from ncs_jax.io.normals import vertex_normals

__all__ = ["write_glb"]

FLOAT, SHORT, INT = 5126, 5123, 5125  # numbers of glTF for types of numbers
VERTICES, INDICES = 34962, 34963  # and for what a part of the file is for
LARGEST = 2**32 - 1  # bytes that the header can count
DESCRIPTION = 1000  # bytes; what the text says of a frame is less


def write_glb(path: str | Path, vertices: np.ndarray, faces: np.ndarray, fps: float) -> None:
    """Write a moving mesh that plays in any viewer of glTF; the file appears whole or not at all.

    The mesh stands as in the first frame. Target k takes it to frame k, with its normals, in float32; at the time of frame k
    the weight of target k is 1 and every other is 0, linear between (sampler LINEAR), so that between two frames the vertices
    move in straight lines. A frame takes 24 bytes a vertex, and the weights 4 bytes times the frames squared: 32 MB and 0.4 MB
    for 300 frames of 4,500 vertices. What a viewer adds up is a frame to rounding of float32.

    Args:
        path: where to. vertices: (T, V, 3) m, float32, Y up. faces: (F, 3) int32. fps: frames per second.

    Raises:
        InputError: it takes more than 4 GiB, which the format cannot count, or the place cannot be written to.
    """
    frames, count = vertices.shape[:2]
    index = np.dtype("<u2" if count < 2**16 else "<u4")
    sizes = [24 * frames * count, 4 * frames * frames if frames > 1 else 0, faces.size * index.itemsize]
    starts = [0, sizes[0], sum(sizes[:2])]
    length = -(-sum(sizes) // 4) * 4
    if sum(sizes) + DESCRIPTION * frames > LARGEST:
        raise InputError(
            f"at most {LARGEST} bytes expected", file=path, field="vertices", value=f"{sum(sizes)} bytes",
            mend="write .usdc, .npz or .pc2, or fewer frames",
        )  # fmt: skip
    text = json.dumps(_document(vertices, faces, fps, starts, sizes), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + length
    with replacing(path) as new, new.open("xb") as stream:
        stream.write(struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON"))
        stream.write(text)
        stream.write(struct.pack("<I4s", length, b"BIN\0"))
        first = vertices[0], vertex_normals(vertices[0], faces)
        for t, x in enumerate(vertices):
            for now, then in zip((x, vertex_normals(x, faces)), first, strict=True):
                stream.write((now - then if t else now).astype("<f4").data)
        if frames > 1:
            stream.write((np.arange(frames) / fps).astype("<f4").data)
            for t in range(frames):
                stream.write((np.arange(1, frames) == t).astype("<f4").data)
        stream.write(faces.astype(index).data)
        stream.write(b"\0" * (length - sum(sizes)))


def _document(vertices: np.ndarray, faces: np.ndarray, fps: float, starts: list[int], sizes: list[int]) -> dict:
    frames, count = vertices.shape[:2]
    accessors: list[dict] = []

    def accessor(view: int, offset: int, kind: int, number: int, shape: str, ends: np.ndarray | None = None) -> int:
        given = {"bufferView": view, "byteOffset": offset, "componentType": kind, "count": number, "type": shape}
        accessors.append(given if ends is None else given | {"min": ends[0].tolist(), "max": ends[1].tolist()})
        return len(accessors) - 1

    attributes = []
    for t, x in enumerate(vertices):
        moved = x if t == 0 else x - vertices[0]
        place = 24 * count * t
        attributes.append(
            {
                "POSITION": accessor(0, place, FLOAT, count, "VEC3", np.stack([moved.min(axis=0), moved.max(axis=0)])),
                "NORMAL": accessor(0, place + 12 * count, FLOAT, count, "VEC3"),
            }
        )
    views = [{"buffer": 0, "byteOffset": starts[0], "byteLength": sizes[0], "byteStride": 12, "target": VERTICES}]
    primitive: dict = {"attributes": attributes[0], "mode": 4, "material": 0}
    mesh: dict = {"name": "garment", "primitives": [primitive]}
    document = {
        "asset": {"version": "2.0", "generator": "ncs-jax"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "garment", "mesh": 0}],
        "meshes": [mesh],
        "materials": [
            {
                "name": "cloth",
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorFactor": [0.32, 0.47, 0.65, 1], "metallicFactor": 0, "roughnessFactor": 0.9},
            }
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": -(-sum(sizes) // 4) * 4}],
    }
    if frames > 1:
        primitive["targets"] = attributes[1:]
        mesh["extras"] = {"targetNames": [f"frame_{t:04}" for t in range(1, frames)]}
        ends = (np.array([[0], [frames - 1]]) / fps).astype(np.float32)
        keys = accessor(1, 0, FLOAT, frames, "SCALAR", ends)
        weights = accessor(1, 4 * frames, FLOAT, frames * (frames - 1), "SCALAR")
        views.append({"buffer": 0, "byteOffset": starts[1], "byteLength": sizes[1]})
        document["animations"] = [
            {
                "name": "garment",
                "samplers": [{"input": keys, "output": weights, "interpolation": "LINEAR"}],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
            }
        ]
    primitive["indices"] = accessor(len(views), 0, SHORT if count < 2**16 else INT, faces.size, "SCALAR")
    views.append({"buffer": 0, "byteOffset": starts[2], "byteLength": sizes[2], "target": INDICES})
    return document

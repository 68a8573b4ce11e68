"""A small person in .glb under nodes that turn, scale or move it, written by hand; and its skin, computed in the world."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

FRAMES, FPS = 16, 30.0
SIDE = (("Shoulder", "Spine2", 0.04, 1.44, 0), ("Arm", "Shoulder", 0.18, 1.44, 0), ("ForeArm", "Arm", 0.45, 1.44, 0),
        ("Hand", "ForeArm", 0.7, 1.44, 0), ("UpLeg", "Hips", 0.09, 0.95, 0), ("Leg", "UpLeg", 0.09, 0.52, 0.005),
        ("Foot", "Leg", 0.09, 0.09, -0.01), ("ToeBase", "Foot", 0.09, 0.02, 0.12))  # fmt: skip
TRUNK = (("Hips", "", 0, 1.0, 0), ("Spine", "Hips", 0, 1.1, 0), ("Spine1", "Spine", 0, 1.2, 0),
         ("Spine2", "Spine1", 0, 1.32, 0), ("Neck", "Spine2", 0, 1.5, 0), ("Head", "Neck", 0, 1.6, 0.01))  # fmt: skip
LIMBS = tuple(
    (side + name, parent if parent in ("Spine2", "Hips") else side + parent, sign * x, y, z)
    for side, sign in (("Left", 1), ("Right", -1))
    for name, parent, x, y, z in SIDE
)
NAMES = tuple(j[0] for j in TRUNK + LIMBS)
PARENTS = tuple(NAMES.index(j[1]) if j[1] else -1 for j in TRUNK + LIMBS)
JOINTS = np.array([j[2:] for j in TRUNK + LIMBS], float)
SWINGS = {  # axis and angle, rad, by half of which a joint swings about the other half
    "LeftUpLeg": (0.6, 0, 0), "RightUpLeg": (-0.6, 0, 0), "LeftLeg": (0.5, 0, 0), "RightLeg": (0.3, 0, 0),
    "LeftArm": (0.4, 0, -1.2), "RightArm": (-0.4, 0, 1.2), "RightForeArm": (0, 0.6, 0), "Spine1": (0, 0.3, 0),
    "Head": (0.2, 0.4, 0),
}  # fmt: skip


def matrix(turn: Rotation | None = None, place=(0.0, 0, 0), scale=1.0) -> np.ndarray:
    """A matrix (4, 4) that scales along its own axes, turns and moves."""
    out = np.eye(4)
    out[:3, :3] = (turn or Rotation.identity()).as_matrix() * np.asarray(scale, float)
    out[:3, 3] = place
    return out


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


def transformed(matrices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Points (n, 3) by a matrix (..., 4, 4)."""
    return np.einsum("...ab,nb->...na", matrices[..., :3, :3], x) + matrices[..., None, :3, 3]


@dataclass(frozen=True, eq=False)
class Setup:
    """What stands around the joints.

    Attributes:
        above: names and local matrices of the nodes above the hips, from the top. stand: matrices in which these nodes stand,
            where keys move them from there to `above`. moves: (FRAMES, 4, 4) the first node's movement in the world.
        spaces: from a mesh's space to the world at rest, for each mesh. node: of all meshes, which says nothing. on: whether it
            hangs on the last node above. root: a root bone's local matrix. sizes: of the joints' own matrices. posed: whether
            joints stand as in a frame. between: whether a node that holds the place stands before each joint. given: as skin
            or not. prop: writes more joints.
    """

    above: tuple[tuple[str, np.ndarray], ...] = ()
    stand: tuple[np.ndarray, ...] = ()
    moves: np.ndarray | None = None
    spaces: tuple[np.ndarray, ...] = (np.eye(4),)
    node: np.ndarray = field(default_factory=lambda: np.eye(4))
    on: bool = False
    root: np.ndarray | None = None
    sizes: float = 1.0
    posed: bool = False
    between: bool = False
    skin: bool = True
    prop: Callable | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """Vertices (V, 3) at rest and (FRAMES, V, 3), faces, weights (V, J); all in the world, m."""

    rest: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    moved: np.ndarray


def person() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An octahedron for each bone: vertices, faces, weights."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]) * 0.05
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    x, f, w = [], [], []
    for j, parent in enumerate(PARENTS):
        x.append(JOINTS[j] + corners * (1 + 0.01 * j))
        f.append(np.array(faces) + 6 * j)
        own = np.zeros((6, len(NAMES)))
        own[:, j] = 1
        if parent >= 0:
            own[::2, [j, parent]] = 0.5
        w.append(own)
    return np.concatenate(x), np.concatenate(f), np.concatenate(w)


def walk() -> np.ndarray:
    """Matrices (FRAMES, J, 4, 4) that take the person from rest into each frame, in the world."""
    t = np.arange(FRAMES) / FPS
    out = np.zeros((FRAMES, len(NAMES), 4, 4))
    for j, (name, parent) in enumerate(zip(NAMES, PARENTS, strict=True)):
        swing = np.outer((1 + np.sin(7 * t)) / 2, SWINGS.get(name, (0, 0.1, 0)))
        for k, turn in enumerate(Rotation.from_rotvec(swing)):
            path = JOINTS[0] + [0.1 * np.sin(t[k]), -0.02 * t[k], 0.9 * t[k]] if parent < 0 else JOINTS[j]
            here = matrix(turn, path) @ matrix(place=-JOINTS[j])
            out[k, j] = here if parent < 0 else out[k, parent] @ here
    return out


def chain(matrices) -> np.ndarray:
    out = np.eye(4)
    for one in matrices:
        out = out @ one
    return out


class File:
    """The JSON and the bytes of a .glb."""

    def __init__(self) -> None:
        self.tree: dict = {"asset": {"version": "2.0"}, "scene": 0}
        self.data = b""
        self.clip: dict = {"name": "walk", "samplers": [], "channels": []}
        self.clock = self.array(np.arange(FRAMES)[:, None] / FPS, "SCALAR")

    def add(self, kind: str, one: dict) -> int:
        self.tree.setdefault(kind, []).append(one)
        return len(self.tree[kind]) - 1

    def array(self, rows: np.ndarray, shape: str, dtype=np.float32) -> int:
        rows = np.ascontiguousarray(rows, dtype)
        view = self.add("bufferViews", {"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes})
        self.data += rows.tobytes() + b"\0" * (-rows.nbytes % 4)
        code = {"float32": 5126, "uint16": 5123, "uint32": 5125}[np.dtype(dtype).name]
        return self.add("accessors", {"bufferView": view, "componentType": code, "count": len(rows), "type": shape})

    def node(self, name: str, matrix: np.ndarray, parent: int = -1, **more: int) -> int:
        place, turn, scale = parts_of(matrix)
        own = {"translation": place.tolist(), "rotation": turn.tolist(), "scale": scale.tolist()}
        index = self.add("nodes", {"name": name, **own, **more})
        if parent >= 0:
            self.tree["nodes"][parent].setdefault("children", []).append(index)
        return index

    def key(self, node: int, path: str, rows: np.ndarray) -> None:
        rows = np.broadcast_to(rows, (FRAMES, rows.shape[-1]))
        output = self.array(rows, f"VEC{rows.shape[1]}")
        self.clip["samplers"].append({"input": self.clock, "output": output})
        sampler = len(self.clip["samplers"]) - 1
        self.clip["channels"].append({"sampler": sampler, "target": {"node": node, "path": path}})

    def skin(self, name: str, x, faces, owners, weights, joints: dict[int, np.ndarray], node: np.ndarray, on: int = -1) -> None:
        """A mesh under a skin of its own; `joints` gives the inverse bind matrix of each node."""
        binds = self.array(np.array(list(joints.values())).swapaxes(1, 2).reshape(-1, 16), "MAT4")
        skin = self.add("skins", {"joints": list(joints), "inverseBindMatrices": binds, "skeleton": next(iter(joints))})
        attributes = {"POSITION": self.array(x, "VEC3"), "JOINTS_0": self.array(owners, "VEC4", np.uint16),
                      "WEIGHTS_0": self.array(weights, "VEC4")}  # fmt: skip
        indices = self.array(np.reshape(faces, (-1, 1)), "SCALAR", np.uint32)
        mesh = self.add("meshes", {"name": name, "primitives": [{"attributes": attributes, "indices": indices}]})
        self.node(f"{name}Object", node, on, mesh=mesh, skin=skin)

    def save(self, path: Path) -> None:
        self.add("animations", self.clip)
        below = {c for n in self.tree["nodes"] for c in n.get("children", [])}
        self.add("scenes", {"nodes": [i for i in range(len(self.tree["nodes"])) if i not in below]})
        self.add("buffers", {"byteLength": len(self.data)})
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(self.data))
        parts = (head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(self.data), b"BIN\0"), self.data)
        path.write_bytes(b"".join(parts))


def parts_of(own: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Translation, quaternion and scale of matrices (..., 4, 4)."""
    scale = np.linalg.norm(own[..., :3, :3], axis=-2)
    scale[..., 0] *= np.sign(np.linalg.det(own[..., :3, :3]))
    turns = (own[..., :3, :3] / scale[..., None, :]).reshape(-1, 3, 3)
    return own[..., :3, 3], Rotation.from_matrix(turns).as_quat().reshape(*own.shape[:-2], 4), scale


def write(path: Path, setup: Setup) -> Truth:
    """Write the person, and return what the file means: sum over joints of weight x movement since rest x vertex."""
    file, moved = File(), walk()
    nodes, rest, last = _joints(file, setup, moved)
    if setup.prop is not None:
        setup.prop(file, dict(zip(NAMES, nodes, strict=True)), dict(zip(NAMES, rest, strict=True)), last)
    x, faces, weights = person()
    if setup.skin:
        root = {} if setup.root is None else {last: chain(m for _, m in setup.above) @ setup.root}
        bound = {**root, **dict(zip(nodes, rest, strict=True))}
        for k, (some, space) in enumerate(zip(np.array_split(faces, len(setup.spaces)), setup.spaces, strict=True)):
            used, corners = np.unique(some, return_inverse=True)
            corners = corners.reshape(-1, 3)[:, :: 1 if np.linalg.det(space) > 0 else -1]
            owners = np.argsort(-weights[used], axis=1)[:, :4]
            shares = np.take_along_axis(weights[used], owners, 1)
            inverse = {n: np.linalg.inv(b) @ space for n, b in bound.items()}
            own = transformed(np.linalg.inv(space), x[used])
            file.skin(f"Body{k}", own, corners, owners + len(root), shares, inverse, setup.node, last if setup.on else -1)
    file.save(path)
    drift = np.eye(4) if setup.moves is None else setup.moves[:, None]
    skinned = np.einsum("vj,tjab,vb->tva", weights, drift @ moved, np.pad(x, ((0, 0), (0, 1)), constant_values=1))
    return Truth(x, faces, weights, skinned[..., :3])


def _joints(file: File, setup: Setup, moved: np.ndarray) -> tuple[list[int], np.ndarray, int]:
    """Write all nodes but the meshes'; return the joints' numbers, their matrices at rest, and what they hang on."""
    last, base = -1, chain(m for _, m in setup.above)
    for k, (name, own) in enumerate(setup.above):
        last = file.node(name, setup.stand[k] if setup.stand else own, last)
        frames = own if setup.moves is None or k else setup.moves @ own
        if setup.stand or frames.ndim > 2:
            for path, rows in zip(("translation", "rotation", "scale"), parts_of(frames), strict=True):
                file.key(last, path, rows)
    if setup.root is not None:
        last, base = file.node("root", setup.root, last), base @ setup.root
    size, turns = np.cbrt(np.linalg.det(base[:3, :3])), Rotation.random(len(NAMES), random_state=3)
    flip = np.array([np.sign(size), 1, 1])
    rest = np.array([matrix(q, x, flip * abs(size) * setup.sizes) for q, x in zip(turns, JOINTS, strict=True)])
    worlds, nodes = moved @ rest, list[int]()
    for j, (name, parent) in enumerate(zip(NAMES, PARENTS, strict=True)):
        own = np.linalg.inv(base if parent < 0 else rest[parent]) @ rest[j]
        keys = np.linalg.inv(base if parent < 0 else worlds[:, parent]) @ worlds[:, j]
        stand, on = keys[5] if setup.posed else own, last if parent < 0 else nodes[parent]
        if setup.between:
            on, stand = file.node(f"{name}_$AssimpFbx$_Translation", matrix(place=stand[:3, 3]), on), stand.copy()
            stand[:3, 3] = 0
        nodes.append(file.node(name, stand, on))
        place, turn, _ = parts_of(keys)
        file.key(nodes[-1], "rotation", turn)
        if parent < 0:
            file.key(on if setup.between else nodes[-1], "translation", place)
    return nodes, rest, last

"""A small skinned and animated character, written as glTF by pygltflib, and its skinning as the specification has it."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pygltflib as gl
from scipy.spatial.transform import Rotation, Slerp

from ncs_jax import io
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import Skeleton, forward, to_rest_axes, transforms
from tests.scenes import post

NAMES = ("Hips", "Spine", "Head")
PARENTS = (-1, 0, 1)
JOINTS = np.array([[0, 0.1, 0], [0, 0.5, 0], [0, 0.8, 0.02]])
TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CLIPS = ("walk", "still")


def rigid(place=(0.0, 0, 0), turn: Rotation | None = None, scale=1.0) -> np.ndarray:
    """A matrix (4, 4) that scales, turns and moves."""
    out = np.eye(4)
    out[:3, :3] = (turn or Rotation.identity()).as_matrix() * scale
    out[:3, 3] = place
    return out


def posed(body: io.BodyRecord, motion: io.MotionRecord) -> np.ndarray:
    """The skin (frames, verts, 3) by the package's kinematics, m."""
    local = to_rest_axes(axis_angle_to_matrix(jnp.asarray(motion.poses)), jnp.asarray(body.rest_rotations))
    skeleton = Skeleton(jnp.asarray(body.joints), tuple(body.parents.tolist()))
    matrices = transforms(skeleton, forward(skeleton, local, jnp.asarray(motion.translation)))
    x = np.pad(body.vertices, ((0, 0), (0, 1)), constant_values=1)
    return np.einsum("vj,tjab,vb->tva", body.weights, np.asarray(matrices), x)


def figure() -> dict:
    """A post of three joints that stands at (0, 0, 0), m, Y up: vertices, faces and weights (verts, 3)."""
    body = post()
    height = body["vertices"][:, 1]
    low, high = np.clip((height - 0.3) / 0.2, 0, 1), np.clip((height - 0.65) / 0.2, 0, 1)
    return {"vertices": body["vertices"], "faces": body["faces"], "weights": np.stack([1 - low, low - high, high], axis=1)}


class Writer:
    """Arrays into one buffer of a glTF file."""

    def __init__(self) -> None:
        self.gltf, self.data = gl.GLTF2(), b""

    def view(self, array: np.ndarray) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.gltf.bufferViews.append(gl.BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes))
        self.data += array.tobytes()
        return len(self.gltf.bufferViews) - 1

    def accessor(self, array, normalized=False, sparse=()) -> int:
        """An accessor of an array; the rows in `sparse` are written as replacements of others."""
        array = np.ascontiguousarray(array)
        rows = array.reshape(len(array), -1)
        base = rows.copy()
        base[list(sparse)] = 0
        found = gl.Accessor(
            bufferView=self.view(base), componentType=TYPES[array.dtype.name], count=len(rows), type=SHAPES[rows.shape[1]],
            normalized=normalized,
        )  # fmt: skip
        if len(sparse):
            found.sparse = gl.Sparse(
                count=len(sparse),
                indices=gl.AccessorSparseIndices(bufferView=self.view(np.array(sparse, np.uint16)), componentType=5123),
                values=gl.AccessorSparseValues(bufferView=self.view(rows[list(sparse)])),
            )
        self.gltf.accessors.append(found)
        return len(self.gltf.accessors) - 1

    def save(self, path: Path) -> Path:
        self.gltf.buffers = [gl.Buffer(byteLength=len(self.data))]
        if path.suffix == ".glb":
            self.gltf.set_binary_blob(self.data)
        else:
            self.gltf.buffers[0].uri = path.with_suffix(".bin").name
            path.with_suffix(".bin").write_bytes(self.data)
        self.gltf.save(str(path))
        return path


def placed(node: gl.Node, matrix: np.ndarray) -> gl.Node:
    """A node with a rigid and uniformly scaled matrix, mirrored along x or not, as translation, rotation and scale."""
    size = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    scale = np.abs(size) * np.array([np.sign(size), 1, 1])
    node.translation = matrix[:3, 3].tolist()
    node.rotation = Rotation.from_matrix(matrix[:3, :3] / scale).as_quat().tolist()
    node.scale = scale.tolist()
    return node


def binds(size: float) -> np.ndarray:
    """Joint to world (3, 4, 4) in the bind pose; the joints have axes of their own, and the scale of what is above them."""
    turns = Rotation.from_rotvec([[0.2, -1, 0.4], [1.5, 0.3, 0], [0, 0, -2.5]])
    return np.array([rigid(x, turn, size) for x, turn in zip(JOINTS, turns, strict=True)])


def write_glb(
    path: Path,
    *,
    armature: np.ndarray | None = None,
    mode: str = "LINEAR",
    joints=np.uint8,
    weights=np.float32,
    posed: bool = False,
    sparse: bool = False,
    pieces: int = 1,
    times=None,
    root: bool = False,
    stretch: float = 0.0,
    scale: bool = False,
) -> Path:
    """Write the character.

    Args:
        path: .glb, or .gltf with .bin. armature: node above the joints; Mixamo's if None. mode: of interpolation. joints,
            weights: component types. posed: the nodes stand in some frame and not in the bind pose. sparse: positions and keys
            are sparse accessors. pieces: primitives. times: of the keys, s. root: with a root bone that does not move, and a
            control beside the pelvis. stretch: m that a bone lengthens. scale: with keys of scale, all one.
    """
    rng = np.random.default_rng(5)
    armature = rigid((0.3, 0, 0.2), Rotation.from_euler("X", -90, degrees=True), 0.01) if armature is None else armature
    size = float(np.cbrt(np.linalg.det(armature[:3, :3])))
    world, body, out = binds(size), figure(), Writer()
    gltf = out.gltf
    local = [np.linalg.inv(armature if p < 0 else world[p]) @ world[j] for j, p in enumerate(PARENTS)]
    gltf.nodes = [placed(gl.Node(name="Armature", children=[1, 4]), armature)]
    for j, name in enumerate(NAMES):
        gltf.nodes.append(placed(gl.Node(name=name, children=[j + 2] if j < 2 else []), local[j]))
    gltf.nodes.append(gl.Node(name="Mesh", mesh=0, skin=0, translation=[9, 9, 9]))  # which the specification says to ignore
    if root:
        gltf.nodes += [gl.Node(name="Root", children=[1, 6]), gl.Node(name="Control")]
        gltf.nodes[0].children = [5, 4]
    gltf.scenes, gltf.scene = [gl.Scene(nodes=[0])], 0

    inside = np.linalg.inv(armature)
    x = (body["vertices"] @ inside[:3, :3].T + inside[:3, 3]).astype(np.float32)
    facing = body["faces"] if size > 0 else body["faces"][:, ::-1]  # outward in the mesh's own space
    corners = facing.reshape(-1)  # a vertex for each corner, as texture seams everywhere would make
    faces = np.arange(len(corners)).reshape(-1, 3)
    share, owner = body["weights"][corners], np.tile(np.arange(3), (len(corners), 1))
    share, owner = np.pad(share, ((0, 0), (0, 1))), np.pad(owner, ((0, 0), (0, 1)))
    if root:
        owner[:, :3] += 1
    kinds = np.dtype(weights)
    if kinds.kind == "u":
        share = np.round(share * np.iinfo(kinds).max)
        share[:, 0] += np.iinfo(kinds).max - share.sum(axis=1)
    primitives = []
    for part in np.array_split(faces, pieces):
        used = part.reshape(-1)
        order = np.argsort(owner[used] % 2, axis=1, kind="stable")  # the second set holds some of the joints
        o, s = np.take_along_axis(owner[used], order, 1), np.take_along_axis(share[used], order, 1)
        split = pieces > 1
        attributes = gl.Attributes(
            POSITION=out.accessor(x[corners[used]], sparse=(0, 3, 7) if sparse else ()),
            JOINTS_0=out.accessor((np.where([1, 1, 0, 0], o, 0) if split else o).astype(joints)),
            WEIGHTS_0=out.accessor((s * [1, 1, 0, 0] if split else s).astype(kinds), normalized=kinds.kind == "u"),
        )
        if split:
            attributes.JOINTS_1 = out.accessor(np.where([0, 0, 1, 1], o, 0).astype(joints))
            attributes.WEIGHTS_1 = out.accessor((s * [0, 0, 1, 1]).astype(kinds), normalized=kinds.kind == "u")
        indices = out.accessor(np.arange(len(used)).astype(np.uint32)) if split else None
        primitives.append(gl.Primitive(attributes=attributes, indices=indices))
    gltf.meshes = [gl.Mesh(primitives=primitives)]
    inverse = [np.linalg.inv(world[j]) @ armature for j in range(3)]
    listed = [1, 2, 3]
    if root:
        listed, inverse = [5, 1, 2, 3, 6], [np.eye(4), *inverse, np.eye(4)]
    gltf.skins = [gl.Skin(joints=listed, inverseBindMatrices=out.accessor(np.array(inverse, np.float32).swapaxes(1, 2)))]

    t = np.linspace(0, 1, 13).astype(np.float32) if times is None else np.asarray(times, np.float32)
    for name in CLIPS:
        clip = gl.Animation(name=name)
        moving = 0.0 if name == "still" else 1.0
        for j in range(3):
            turns = Rotation.from_matrix(local[j][:3, :3] / np.cbrt(np.linalg.det(local[j][:3, :3])))
            spin = moving * np.sin(2 * t + j)[:, None] * rng.normal(scale=0.5, size=3)
            q = (turns * Rotation.from_rotvec(spin)).as_quat()
            q[1::2] *= -1  # the same rotations: the shorter way must be taken
            keyed(clip, out, t, q, j + 1, "rotation", mode, sparse)
        path_of = local[0][:3, 3] + moving * np.stack([0.3 * t, 0.1 * t * t, np.sin(t)], axis=1) / size
        keyed(clip, out, t, path_of, 1, "translation", mode, sparse)
        if stretch:
            longer = local[1][:3, 3] * (1 + stretch / size / np.linalg.norm(local[1][:3, 3]) * t[:, None])
            keyed(clip, out, t, longer, 2, "translation", mode, sparse)
        if scale:
            keyed(clip, out, t, np.ones((len(t), 3)), 2, "scale", mode, sparse)
        gltf.animations.append(clip)
    if posed:
        for j in range(3):
            turn = Rotation.from_quat(gltf.nodes[j + 1].rotation) * Rotation.from_rotvec(rng.normal(scale=0.4, size=3))
            gltf.nodes[j + 1].rotation = turn.as_quat().tolist()
    return out.save(path)


def keyed(clip: gl.Animation, out: Writer, t, values, node: int, path: str, mode: str, sparse: bool) -> None:
    rows = np.asarray(values, np.float32)
    if mode == "CUBICSPLINE":
        rng = np.random.default_rng(node)
        tangent = rng.normal(scale=0.2 * np.abs(rows).max(), size=(2, *rows.shape)).astype(np.float32)
        tangent = tangent if path == "rotation" or node == 1 else 0 * tangent
        if path == "rotation":
            rows = rows * np.where(np.arange(len(rows)) % 2, -1, 1)[:, None].astype(np.float32)
        rows = np.stack([tangent[0], rows, tangent[1]], axis=1).reshape(-1, rows.shape[1])
    output = out.accessor(rows, sparse=(1, 2) if sparse else ())
    clip.samplers.append(gl.AnimationSampler(input=out.accessor(t), output=output, interpolation=mode))
    target = gl.AnimationChannelTarget(node=node, path=path)
    clip.channels.append(gl.AnimationChannel(sampler=len(clip.samplers) - 1, target=target))


# --- what the specification says, without the package ------------------------------------------------------------------------


def rows_of(gltf: gl.GLTF2, blob: bytes, index: int) -> np.ndarray:
    """An accessor as rows of float64, by the specification's 3.6.2."""
    one = gltf.accessors[index]
    dtype = np.dtype({v: k for k, v in TYPES.items()}[one.componentType])
    width = {v: k for k, v in SHAPES.items()}[one.type]

    def cut(view, count, dtype, width, offset=0):
        begin = gltf.bufferViews[view].byteOffset + (offset or 0)
        return np.frombuffer(blob[begin : begin + count * width * dtype.itemsize], dtype).reshape(count, width)

    rows = cut(one.bufferView, one.count, dtype, width, one.byteOffset).copy()
    if one.sparse:
        kind = np.dtype({v: k for k, v in TYPES.items()}[one.sparse.indices.componentType])
        place = cut(one.sparse.indices.bufferView, one.sparse.count, kind, 1)[:, 0]
        rows[place] = cut(one.sparse.values.bufferView, one.sparse.count, dtype, width)
    return rows / np.iinfo(dtype).max if one.normalized else rows.astype(np.float64)


def value(gltf: gl.GLTF2, blob: bytes, clip: gl.Animation, node: int, path: str, time: float, still) -> np.ndarray:
    """A property of a node at a time, by the specification's appendix C."""
    for channel in clip.channels:
        if (channel.target.node, channel.target.path) == (node, path):
            sampler = clip.samplers[channel.sampler]
            t, rows = rows_of(gltf, blob, sampler.input)[:, 0], rows_of(gltf, blob, sampler.output)
            time = min(max(time, t[0]), t[-1])
            k = min(max(int(np.searchsorted(t, time, side="right")) - 1, 0), len(t) - 2)
            td = t[k + 1] - t[k]
            s = (time - t[k]) / td
            if sampler.interpolation == "STEP":
                return rows[k + 1] if s >= 1 else rows[k]
            if sampler.interpolation == "CUBICSPLINE":
                a, v, b = rows[::3], rows[1::3], rows[2::3]
                out = (2 * s**3 - 3 * s**2 + 1) * v[k] + td * (s**3 - 2 * s**2 + s) * b[k]
                return out + (-2 * s**3 + 3 * s**2) * v[k + 1] + td * (s**3 - s**2) * a[k + 1]
            if path == "rotation":
                return Slerp([0, 1], Rotation.from_quat(rows[k : k + 2]))(s).as_quat()
            return rows[k] * (1 - s) + rows[k + 1] * s
    return np.array(still)


def skinned(path: Path, times, clip: int = 0) -> np.ndarray:
    """Positions (times, verts, 3) of all primitives' vertices: sum over joints of weight x global x inverse bind x position."""
    gltf = gl.GLTF2().load(str(path))
    blob = gltf.binary_blob() if path.suffix == ".glb" else path.with_suffix(".bin").read_bytes()
    parent = {c: i for i, n in enumerate(gltf.nodes) for c in n.children or []}
    skin = gltf.skins[0]
    inverse = rows_of(gltf, blob, skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    parts = []
    for primitive in gltf.meshes[next(node.mesh for node in gltf.nodes if node.skin is not None)].primitives:
        a = primitive.attributes
        x = rows_of(gltf, blob, a.POSITION)
        sets = [(a.JOINTS_0, a.WEIGHTS_0)] + ([(a.JOINTS_1, a.WEIGHTS_1)] if getattr(a, "JOINTS_1", None) is not None else [])
        parts.append(
            (
                np.pad(x, ((0, 0), (0, 1)), constant_values=1),
                [(rows_of(gltf, blob, j), rows_of(gltf, blob, w)) for j, w in sets],
            )
        )

    def world(node: int, time: float) -> np.ndarray:
        n, moving = gltf.nodes[node], gltf.animations[clip]
        t, q, s = (
            value(gltf, blob, moving, node, name, time, still)
            for name, still in (
                ("translation", n.translation or [0, 0, 0]),
                ("rotation", n.rotation or [0, 0, 0, 1]),
                ("scale", n.scale or [1, 1, 1]),
            )
        )
        own = np.eye(4)
        own[:3, :3] = Rotation.from_quat(q).as_matrix() * s
        own[:3, 3] = t
        return world(parent[node], time) @ own if node in parent else own

    frames = []
    for time in times:
        matrices = np.array([world(j, time) @ inverse[k] for k, j in enumerate(skin.joints)])
        found = []
        for x, sets in parts:
            blended = sum(np.einsum("vk,vkab->vab", w, matrices[j.astype(int)]) for j, w in sets)
            found.append(np.einsum("vab,vb->va", blended, x)[:, :3])
        frames.append(np.concatenate(found))
    return np.array(frames)

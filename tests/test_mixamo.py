"""Characters as Mixamo and Blender write them: bone axes, units, rates and roots that move, against forward kinematics here."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib as gl
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.io import BodyRecord, MotionRecord
from tests import fbx_files as fbx
from tests.characters import Writer, keyed, placed, rigid
from tests.test_reference_pose import apart, body, driven, walk  # noqa: F401 (body is a fixture)

COUNT = 10  # frames


def clip(fps: float) -> MotionRecord:
    motion = walk()
    return replace(motion, poses=motion.poses[:COUNT], translation=motion.translation[:COUNT], fps=fps)


def bone_axes(joints: np.ndarray, parents: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Axes of the joints (J, 3, 3), +Y along the bone to the middle child and a roll of their own, as in Blender and Mixamo."""
    out = np.zeros((len(names), 3, 3))
    for j, name in enumerate(names):
        below = [k for k in range(len(names)) if parents[k] == j]
        below.sort(key=lambda k: ("Left" in names[k]) + ("Right" in names[k]))
        along = joints[below[0]] - joints[j] if below else joints[j] - joints[parents[j]]
        y = along / np.linalg.norm(along)
        turn = Rotation.align_vectors(y[None], np.eye(3)[1:2])[0]
        out[j] = (turn * Rotation.from_rotvec([0, 0.3 * len(name), 0])).as_matrix()
    return out


def worlds_of(motion: MotionRecord, axes: np.ndarray, pose: bool = True) -> np.ndarray:
    """Matrices (T, J, 4, 4) of joints to the world, m: forward kinematics in plain loops."""
    joints, parents = np.asarray(motion.joints), np.asarray(motion.parents)
    out = np.tile(np.eye(4), (len(motion.poses), len(parents), 1, 1))
    for t in range(len(motion.poses)):
        for j, parent in enumerate(parents):
            turn = Rotation.from_rotvec(motion.poses[t, j] if pose else np.zeros(3)).as_matrix()
            above = np.eye(3) if parent < 0 else out[t, parent, :3, :3]
            out[t, j, :3, :3] = above @ turn
            shift = motion.translation[t] if pose else np.zeros(3)
            out[t, j, :3, 3] = joints[0] + shift if parent < 0 else out[t, parent, :3, 3] + above @ (joints[j] - joints[parent])
    out[..., :3, :3] = out[..., :3, :3] @ axes
    return out


def places_of(record: MotionRecord) -> dict[str, np.ndarray]:
    """Places (T, 3) of a record's joints by name, as its docstring says how they turn."""
    joints, parents = np.asarray(record.joints), np.asarray(record.parents)
    axes = np.tile(np.eye(3), (len(parents), 1, 1)) if record.rest_rotations is None else record.rest_rotations
    found, turns = {}, {}
    for j, parent in enumerate(parents):
        own = axes[j] @ Rotation.from_rotvec(record.poses[:, j]).as_matrix() @ axes[j].T
        if parent < 0:
            turns[j], found[j] = own, joints[j] + record.translation
        else:
            turns[j] = turns[parent] @ own
            found[j] = found[parent] + np.einsum("tab,b->ta", turns[parent], joints[j] - joints[parent])
    return {name: found[j] for j, name in enumerate(record.joint_names)}


def roots(where: str, motion: MotionRecord, size: float) -> np.ndarray:
    """Armature to world (T, 4, 4): scaled, lying on its back as Blender's does in Y up, and carrying what `where` says."""
    out = np.tile(rigid((0, 0, 0), Rotation.from_euler("x", -90, degrees=True), size), (len(motion.poses), 1, 1))
    share = {"hips": 0.0, "armature": 1.0, "both": 0.6, "turning": 0.6}[where]
    out[:, :3, 3] = share * motion.translation
    if where == "turning":
        turn = Rotation.from_rotvec(np.linspace(0, 1, len(out))[:, None] * [0, 1.0, 0]).as_matrix()
        out[:, :3, :3] = turn @ out[:, :3, :3]
    return out


def locals_of(worlds: np.ndarray, root: np.ndarray, parents: np.ndarray) -> np.ndarray:
    above = np.stack([root if p < 0 else worlds[:, p] for p in parents], axis=1)
    return np.linalg.inv(above) @ worlds


def skin_of(worlds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A vertex beside each joint at rest, and triangles of neighbours."""
    count = len(worlds)
    x = worlds[:, :3, 3] + 0.02 * np.random.default_rng(3).normal(size=(count, 3))
    return x, np.stack([np.arange(count - 2), np.arange(1, count - 1), np.arange(2, count)], axis=1)


def write_fbx(path: Path, motion: MotionRecord, *, where: str, size: float, unit: float, skin: bool, pre: bool) -> Path:
    """Write an .fbx: rest axes as PreRotation or in Lcl Rotation, and an armature of a scale, in a unit (m) of the file."""
    joints, parents, names = np.asarray(motion.joints), np.asarray(motion.parents), motion.joint_names
    axes = bone_axes(joints, parents, names)
    root = roots(where, motion, size)
    rest, now = worlds_of(motion, axes, pose=False)[:1], worlds_of(motion, axes)
    still = roots("hips", motion, size)[:1]
    into = rigid(scale=1 / unit)
    root, still, rest, now = (into @ x for x in (root, still, rest, now))
    scaled = float(np.cbrt(np.linalg.det(still[0, :3, :3])))
    rest[..., :3, :3] *= scaled * unit
    now[..., :3, :3] *= scaled * unit
    at_rest, moved = locals_of(rest, still, parents)[0], locals_of(now, root, parents)
    before = np.array([m[:3, :3] for m in at_rest]) if pre else np.tile(np.eye(3), (len(names), 1, 1))
    angles = Rotation.from_matrix((np.swapaxes(before, -1, -2) @ moved[..., :3, :3]).reshape(-1, 3, 3)).as_euler("xyz")
    angles = np.degrees(np.unwrap(angles.reshape(len(moved), len(names), 3), axis=0))
    stand = Rotation.from_matrix(np.swapaxes(before, -1, -2) @ at_rest[:, :3, :3]).as_euler("xyz", degrees=True)
    if skin:  # the models stand as in some frame: the rest pose is the skin's
        stand = angles[5]

    def lcl(matrix: np.ndarray) -> dict:
        turn = Rotation.from_matrix(matrix[:3, :3] / scaled).as_euler("xyz", degrees=True)
        return {"Lcl Translation": matrix[:3, 3], "Lcl Rotation": turn}

    first = lcl(still[0])
    objects: list = [("Model", [10, "Model::Armature", "Null"], [fbx.properties(
        **{k.replace(" ", "__"): v for k, v in first.items()}, Lcl__Scaling=(scaled,) * 3, InheritType=1,
    )])]  # fmt: skip
    links = [fbx.link(10, 0)]
    for j, name in enumerate(names):
        given = {"PreRotation": Rotation.from_matrix(before[j]).as_euler("xyz", degrees=True)} if pre else {}
        objects.append(("Model", [20 + j, f"Model::{name}", "LimbNode"], [fbx.properties(
            **given, RotationActive=1, InheritType=1, Lcl__Translation=at_rest[j, :3, 3], Lcl__Rotation=stand[j],
        )]))  # fmt: skip
        links.append(fbx.link(20 + j, 20 + int(parents[j]) if parents[j] >= 0 else 10))
    if skin:
        x, faces = skin_of(rest[0])
        corners = faces.astype(np.int32)
        corners[:, 2] = -1 - corners[:, 2]
        objects += [("Model", [300, "Model::Skin", "Mesh"], [fbx.properties()]), ("Geometry", [301, "Geometry::Skin", "Mesh"], [
            ("Vertices", [x.ravel()], None), ("PolygonVertexIndex", [corners.ravel()], None)]),
            ("Deformer", [302, "Deformer::", "Skin"], [])]  # fmt: skip
        links += [fbx.link(300, 0), fbx.link(301, 300), fbx.link(302, 301)]
        for j in range(len(names)):
            objects.append(("Deformer", [400 + j, "SubDeformer::", "Cluster"], [
                ("Indexes", [np.array([j], np.int32)], None), ("Weights", [np.ones(1)], None),
                ("Transform", [np.linalg.inv(rest[0, j]).T.ravel().copy()], None),
                ("TransformLink", [rest[0, j].T.ravel().copy()], None),
            ]))  # fmt: skip
            links += [fbx.link(400 + j, 302), fbx.link(20 + j, 400 + j)]
    objects += [("AnimationStack", [50, "AnimStack::mixamo.com", ""], []), ("AnimationLayer", [51, "AnimLayer::Base", ""], [])]
    links.append(fbx.link(51, 50))
    tracks = [(20 + j, "Lcl Rotation", angles[:, j]) for j in range(len(names))]
    tracks.append((20, "Lcl Translation", moved[:, 0, :3, 3]))
    if where != "hips":
        own = [lcl(m) for m in root]
        tracks.append((10, "Lcl Translation", np.array([o["Lcl Translation"] for o in own])))
        if where == "turning":
            turned = np.unwrap(np.radians([o["Lcl Rotation"] for o in own]), axis=0)
            tracks.append((10, "Lcl Rotation", np.degrees(turned)))
    for n, (key, name, values) in enumerate(tracks):
        node = 1000 + 10 * n
        objects.append(("AnimationCurveNode", [node, "AnimCurveNode::T", ""], []))
        links += [fbx.link(node, 51), fbx.link(node, key, name)]
        for axis in range(3):
            objects.append(fbx.curve(node + 1 + axis, np.arange(len(values)) / motion.fps, values[:, axis]))
            links.append(fbx.link(node + 1 + axis, node, f"d|{'XYZ'[axis]}"))
    path.write_bytes(fbx.binary(fbx.scene(objects, links, UnitScaleFactor=100 * unit)))
    return path


def write_glb(path: Path, motion: MotionRecord, *, where: str, size: float, skin: bool) -> Path:
    """Write a .glb as Blender exports an imported character: an armature of a scale, bones along Y, a rest that is turned."""
    joints, parents, names = np.asarray(motion.joints), np.asarray(motion.parents), motion.joint_names
    axes = bone_axes(joints, parents, names)
    root, still = roots(where, motion, size), roots("hips", motion, size)[:1]
    rest, now = worlds_of(motion, axes, pose=False)[:1], worlds_of(motion, axes)
    rest[..., :3, :3] *= size
    now[..., :3, :3] *= size
    at_rest, moved = locals_of(rest, still, parents)[0], locals_of(now, root, parents)
    out = Writer()
    gltf, count = out.gltf, len(names)
    gltf.nodes = [placed(gl.Node(name="Armature", children=[1]), still[0])]
    for j, name in enumerate(names):
        below = [1 + k for k in range(count) if parents[k] == j]
        gltf.nodes.append(placed(gl.Node(name=name, children=below), moved[5, j] if skin else at_rest[j]))
    gltf.scenes, gltf.scene = [gl.Scene(nodes=[0])], 0
    if skin:
        x, faces = skin_of(rest[0])
        owner, weight = np.zeros((count, 4), np.uint8), np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
        owner[:, 0] = np.arange(count)
        gltf.nodes.append(gl.Node(name="Mesh", mesh=0, skin=0))
        gltf.nodes[0].children.append(1 + count)
        primitive = gl.Primitive(
            attributes=gl.Attributes(
                POSITION=out.accessor(x.astype(np.float32)), JOINTS_0=out.accessor(owner), WEIGHTS_0=out.accessor(weight)
            ),
            indices=out.accessor(faces.ravel().astype(np.uint32)),
        )
        gltf.meshes = [gl.Mesh(primitives=[primitive])]
        inverse = np.linalg.inv(rest[0]).astype(np.float32).swapaxes(1, 2)
        gltf.skins = [gl.Skin(joints=list(range(1, 1 + count)), inverseBindMatrices=out.accessor(inverse))]
    t, take = (np.arange(len(now)) / motion.fps).astype(np.float32), gl.Animation(name="walk")
    for j in range(count):
        keyed(take, out, t, Rotation.from_matrix(moved[:, j, :3, :3]).as_quat(), 1 + j, "rotation", "LINEAR", False)
    keyed(take, out, t, moved[:, 0, :3, 3], 1, "translation", "LINEAR", False)
    if where != "hips":
        keyed(take, out, t, root[:, :3, 3], 0, "translation", "LINEAR", False)
        if where == "turning":
            keyed(take, out, t, Rotation.from_matrix(root[:, :3, :3] / size).as_quat(), 0, "rotation", "LINEAR", False)
    gltf.animations = [take]
    return out.save(path)


def agrees(path: Path, motion: MotionRecord, body: BodyRecord) -> MotionRecord:  # noqa: F811
    """Hold the places of the file's joints to 0.01 mm, and those of the packaged body that it drives to 0.1 mm.

    Where the body is at the beginning of the path does not count: a skinned character is at rest where its nodes stand.
    """
    record = io.read_motion(path)
    assert record.fps == pytest.approx(motion.fps) and len(record.poses) == len(motion.poses)
    truth, found = worlds_of(motion, np.eye(3)), places_of(record)
    for j, name in enumerate(motion.joint_names):
        np.testing.assert_allclose(found[name], truth[:, j, :3, 3], atol=1e-5, err_msg=name)
    ours, theirs = driven(motion, body, frames=(0,)), driven(record, body, frames=(0,))
    apart_by = theirs[1] - ours[1]
    assert apart(ours, theirs)[0].max() < 0.1 and np.abs(apart_by - apart_by[0, 0] * (1, 0, 1)).max() < 1e-4
    return record


@pytest.mark.parametrize("skin", [True, False], ids=["with skin", "without skin"])
@pytest.mark.parametrize(("fps", "size", "unit"), [(24, 0.01, 0.01), (30, 1.0, 0.01), (60, 1.0, 1.0)])
@pytest.mark.parametrize("pre", [True, False], ids=["PreRotation", "Lcl Rotation"])
def test_fbx_whose_bones_have_axes_of_their_own(tmp_path, body, skin, fps, size, unit, pre):  # noqa: F811
    """Rest turns in PreRotation, as Mixamo writes them, or in the models themselves, as Blender does."""
    motion = clip(fps)
    path = write_fbx(tmp_path / "walk.fbx", motion, where="hips", size=size, unit=unit, skin=skin, pre=pre)
    agrees(path, motion, body)


@pytest.mark.parametrize("skin", [True, False], ids=["with skin", "without skin"])
@pytest.mark.parametrize(("fps", "size"), [(24, 0.01), (30, 1.0), (60, 100.0)])
def test_gltf_whose_bones_have_axes_of_their_own(tmp_path, body, skin, fps, size):  # noqa: F811
    motion = clip(fps)
    agrees(write_glb(tmp_path / "walk.glb", motion, where="hips", size=size, skin=skin), motion, body)


@pytest.mark.parametrize("where", ["armature", "both", "turning"])
@pytest.mark.parametrize("skin", [True, False], ids=["with skin", "without skin"])
@pytest.mark.parametrize(("suffix", "size"), [("fbx", 1.0), ("fbx", 100.0), ("glb", 0.01), ("glb", 100.0)])
def test_roots_that_move_above_the_hips(tmp_path, body, suffix, size, skin, where):  # noqa: F811
    """The path may be on the armature, or a part of it on the hips, and the armature may turn and have a scale of 100."""
    motion = clip(30)
    path = tmp_path / f"walk.{suffix}"
    if suffix == "fbx":
        write_fbx(path, motion, where=where, size=size, unit=0.01, skin=skin, pre=True)
    else:
        write_glb(path, motion, where=where, size=size, skin=skin)
    record = agrees(path, motion, body)
    assert np.ptp(record.translation, axis=0).max() > 0.2

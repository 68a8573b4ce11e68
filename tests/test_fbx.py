"""Characters in FBX: pivots, orders and curves as their formulas say, and files that Blender wrote as Blender moves them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io.character.fbx import Fbx, Packed, Record, read_fbx
from ncs_jax.io.character.fbx_character import _worlds
from ncs_jax.io.character.fbx_curve import Curve, curve_from
from ncs_jax.io.character.fbx_graph import graph_of
from tests import fbx_files as fbx
from tests.characters import JOINTS, NAMES, figure, posed, rigid
from tests.scenes import grid

ASSETS = Path(io.__file__).parents[1] / "assets"
BLENDER = os.environ.get("NCS_BLENDER")
FRAMES = 16  # at 30 a second
Z_UP = {"UpAxis": 2, "UpAxisSign": 1, "FrontAxis": 1, "FrontAxisSign": -1, "CoordAxis": 0, "CoordAxisSign": 1}
AXES = {
    "Y up, cm": ({"UnitScaleFactor": 1.0}, np.eye(3), 0.01),
    "Z up, inches": ({**Z_UP, "UnitScaleFactor": 2.54}, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), 0.0254),
}
PRE = np.array([[20.0, -50, 10], [5, 0, 80], [0, 30, -140]])
POST = np.array([[0.0, 0, 0], [10, 20, 30], [0, 0, 0]])
ORDERS = ("xyz", "zxy", "xyz")  # of which the first named turns first


def euler(degrees, order="xyz") -> Rotation:
    return Rotation.from_euler(order, [degrees["xyz".index(a)] for a in order], degrees=True)


def lcl(frame: float) -> np.ndarray:
    """Angles (3, 3) of the joints in a frame, degrees."""
    t = frame / 30
    return np.array([[40 * t, 10 * t, 0], [0, 60 * t, 20 * np.sin(5 * t)], [-30 * t, 0, 50 * t]])


class Hero:
    """Three joints, bound with angles of 0, under an armature that is turned and scaled, in a file's own axes and unit."""

    def __init__(self, axes: str) -> None:
        self.settings, turn, unit = AXES[axes]
        self.to_world = rigid((0, 0, 0), Rotation.from_matrix(turn), unit)
        self.armature = rigid((4, 0, 3), Rotation.from_euler("x", 15, degrees=True), 2.0)
        native = (np.linalg.inv(self.to_world) @ np.pad(JOINTS, ((0, 0), (0, 1)), constant_values=1).T).T
        self.place = np.zeros((3, 3))
        above = self.armature
        for j in range(3):  # Lcl Translation that brings each joint to its place
            self.place[j] = (np.linalg.inv(above) @ native[j])[:3]
            above = above @ rigid(self.place[j], self.turn(j, np.zeros(3)))

    def turn(self, joint: int, angles: np.ndarray) -> Rotation:
        return euler(PRE[joint]) * euler(angles, ORDERS[joint]) * euler(POST[joint]).inv()

    def globals(self, angles: np.ndarray, shift=(0.0, 0, 0)) -> np.ndarray:
        """Joint to the file's world (3, 4, 4)."""
        above, found = self.armature, []
        for j in range(3):
            above = above @ rigid(self.place[j] + (shift if j == 0 else 0), self.turn(j, angles[j]))
            found.append(above)
        return np.array(found)

    def shift(self, frame: float) -> np.ndarray:
        return np.array([frame, 0.5 * frame, -0.2 * frame])

    def truth(self, frames=FRAMES) -> np.ndarray:
        """The skin in every frame (frames, verts, 3), m, Y up."""
        body, rest = figure(), self.globals(np.zeros((3, 3)))
        x = np.pad(body["vertices"], ((0, 0), (0, 1)), constant_values=1)
        found = []
        for frame in range(frames):
            now = self.globals(lcl(frame), self.shift(frame))
            moved = self.to_world @ now @ np.linalg.inv(rest) @ np.linalg.inv(self.to_world)
            found.append(np.einsum("vj,jab,vb->va", body["weights"], moved, x)[:, :3])
        return np.array(found)

    def tree(self, stretch: float = 0.0, skin: bool = True, layers: int = 1) -> list:
        body, rest = figure(), self.globals(np.zeros((3, 3)))
        mesh = rigid((0, 0, 9), Rotation.from_euler("y", 40, degrees=True), 3.0)  # where the mesh was when it was bound
        geometric = rigid((1, 2, 3))
        x = np.pad(body["vertices"], ((0, 0), (0, 1)), constant_values=1)
        x = (np.linalg.inv(self.to_world @ mesh @ geometric) @ x.T).T[:, :3]
        corners = np.array(body["faces"], np.int32)
        corners[:, 2] = -1 - corners[:, 2]
        angles = lcl(5)  # in which the models stand
        objects: list = [
            ("Model", [10, "Model::Armature", "Null"], [
                fbx.properties(Lcl__Translation=(4, 0, 3), Lcl__Rotation=(15, 0, 0), Lcl__Scaling=(2, 2, 2), InheritType=1),
            ]),
        ]  # fmt: skip
        links = [fbx.link(10, 0)]
        for j, name in enumerate(NAMES):
            objects.append(("Model", [20 + j, f"Model::{name}", "LimbNode"], [fbx.properties(
                RotationActive=1, InheritType=1, RotationOrder=4 if j == 1 else 0, PreRotation=PRE[j], PostRotation=POST[j],
                Lcl__Translation=self.place[j], Lcl__Rotation=angles[j],
            )]))  # fmt: skip
            links.append(fbx.link(20 + j, 19 + j if j else 10))
        if skin:
            objects += [
                ("Model", [30, "Model::Skin", "Mesh"], [fbx.properties(GeometricTranslation=(1, 2, 3))]),
                ("Geometry", [31, "Geometry::Skin", "Mesh"], [
                    ("Vertices", [x.ravel()], None), ("PolygonVertexIndex", [corners.ravel()], None),
                ]),
                ("Deformer", [32, "Deformer::", "Skin"], []),
            ]  # fmt: skip
            links += [fbx.link(30, 0), fbx.link(31, 30), fbx.link(32, 31)]
            for j in range(3):
                chosen = np.flatnonzero(body["weights"][:, j])
                to_bone = np.linalg.inv(rest[j]) @ mesh
                objects.append(("Deformer", [40 + j, "SubDeformer::", "Cluster"], [
                    ("Indexes", [chosen.astype(np.int32)], None), ("Weights", [1.3 * body["weights"][chosen, j]], None),
                    ("Transform", [to_bone.T.ravel().copy()], None), ("TransformLink", [rest[j].T.ravel().copy()], None),
                ]))  # fmt: skip
                links += [fbx.link(40 + j, 32), fbx.link(20 + j, 40 + j)]
        objects.append(("AnimationStack", [50, "AnimStack::Take 1", ""], []))
        times, key = np.arange(FRAMES) / 30, 100
        for layer in range(layers):
            objects.append(("AnimationLayer", [51 + layer, "AnimLayer::Base", ""], []))
            links.append(fbx.link(51 + layer, 50))
            tracks = [(j, "Lcl Rotation", np.array([lcl(f)[j] for f in range(FRAMES)])) for j in range(3)]
            tracks.append((0, "Lcl Translation", self.place[0] + [self.shift(f) for f in range(FRAMES)]))
            if stretch:
                tracks.append((2, "Lcl Translation", self.place[2] * (1 + stretch * times[:, None])))
            for j, name, values in tracks:
                key += 10
                objects.append(("AnimationCurveNode", [key, "AnimCurveNode::T", ""], []))
                links += [fbx.link(key, 51 + layer), fbx.link(key, 20 + j, name)]
                for axis in range(3):
                    objects.append(fbx.curve(key + 1 + axis, times, values[:, axis]))
                    links.append(fbx.link(key + 1 + axis, key, f"d|{'XYZ'[axis]}"))
        return fbx.scene(objects, links, **self.settings, TimeMode=6)


WRITERS = {"text": fbx.text, "binary": fbx.binary, "binary 7.5": lambda tree: fbx.binary(tree, 7500)}


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("writer", WRITERS)
def test_skinning_is_the_formulas_own(tmp_path, axes, writer):
    hero = Hero(axes)
    (tmp_path / "hero.fbx").write_bytes(WRITERS[writer](hero.tree()))
    body, motion = io.read_body(tmp_path / "hero.fbx"), io.read_motion(f"{tmp_path}/hero.fbx#Take 1")
    assert body.joint_names == motion.joint_names == NAMES and motion.fps == 30 and len(motion.poses) == FRAMES
    expected = figure()
    far, order = cKDTree(body.vertices).query(expected["vertices"])  # in metres, Y up, where it was bound
    assert far.max() < 1e-6 and len(body.vertices) == len(expected["vertices"])
    np.testing.assert_allclose(body.joints, JOINTS, atol=1e-6)
    np.testing.assert_allclose(body.weights[order], expected["weights"], atol=1e-9)
    assert np.linalg.det(body.vertices[body.faces]).sum() / 6 > 0.01
    assert np.abs(posed(body, motion)[:, order] - hero.truth()).max() < 1e-5


def test_a_skeleton_without_a_skin_rests_as_it_stands(tmp_path):
    """Of the sixth frame, in which the models stand: there the motion has no rotation."""
    (tmp_path / "idle.fbx").write_bytes(fbx.binary(Hero("Y up, cm").tree(skin=False)))
    motion = io.read_motion(tmp_path / "idle.fbx")
    assert motion.joint_names == NAMES
    assert np.abs(motion.poses[5]).max() < 1e-5 and np.abs(motion.poses[15]).max() > 0.1
    with pytest.raises(InputError, match="skins: a skinned mesh expected"):
        io.read_body(tmp_path / "idle.fbx")


def test_pivots_orders_and_inherited_scales(tmp_path):
    """M = T Roff Rp Rpre R Rpost^-1 Rp^-1 Soff Sp S Sp^-1, and how a child takes its parent's scale."""
    rng = np.random.default_rng(3)
    given = [{n: rng.normal(size=3) * 30 for n in ("PreRotation", "PostRotation", "Lcl__Rotation")} for _ in range(4)]
    for one in given:
        one |= {n: rng.normal(size=3) for n in ("RotationOffset", "RotationPivot", "ScalingOffset", "ScalingPivot")}
        one |= {"Lcl__Translation": rng.normal(size=3), "Lcl__Scaling": np.full(3, rng.uniform(0.5, 2))}
    orders, inherit = ("xyz", "xzy", "zyx", "yzx"), (1, 1, 0, 2)
    numbers = {"xyz": 0, "xzy": 1, "yzx": 2, "zyx": 5}
    tree = fbx.scene(
        [
            ("Model", [10 + j, f"Model::J{j}", "LimbNode"],
             [fbx.properties(RotationOrder=numbers[orders[j]], InheritType=inherit[j], **one)])
            for j, one in enumerate(given)
        ],
        [fbx.link(10 + j, 9 + j if j else 0) for j in range(4)],
        UnitScaleFactor=100.0,
    )  # fmt: skip
    (tmp_path / "models.fbx").write_bytes(fbx.binary(tree))
    found = _worlds(graph_of(read_fbx(tmp_path / "models.fbx")))
    expected = []
    for j, one in enumerate(given):
        turn = euler(one["PreRotation"]) * euler(one["Lcl__Rotation"], orders[j]) * euler(one["PostRotation"]).inv()
        scaled = np.diag([*one["Lcl__Scaling"], 1])
        own = rigid(one["Lcl__Translation"] + one["RotationOffset"]) @ rigid(one["RotationPivot"]) @ rigid(turn=turn)
        own = own @ rigid(-one["RotationPivot"]) @ rigid(one["ScalingOffset"]) @ rigid(one["ScalingPivot"]) @ scaled
        above = expected[-1] if j else np.eye(4)
        world = above @ own @ rigid(-one["ScalingPivot"])
        if inherit[j] == 2:  # without the scale of the parent itself
            world[:3, :3] /= given[j - 1]["Lcl__Scaling"][0]
        expected.append(world)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_bones_that_stretch_are_refused(tmp_path):
    (tmp_path / "hero.fbx").write_bytes(fbx.binary(Hero("Y up, cm").tree(stretch=2.0)))
    with pytest.raises(InputError, match="joint Head: bones of fixed length") as caught:
        io.read_motion(tmp_path / "hero.fbx")
    assert str(tmp_path / "hero.fbx") in str(caught.value)


def take(name: str, number: int, values: list[float], *, empty: bool = False) -> tuple[list, list]:
    """A take that turns the first joint about x, and its links; with `empty`, a layer without curves."""
    stack, layer, node, curve = (1000 * number + k for k in range(4))
    objects: list = [
        ("AnimationStack", [stack, f"AnimStack::{name}", ""], []),
        ("AnimationLayer", [layer, "AnimLayer::Base", ""], []),
    ]
    links = [fbx.link(layer, stack)]
    if not empty:
        objects += [
            ("AnimationCurveNode", [node, "AnimCurveNode::R", ""], []),
            fbx.curve(curve, np.arange(len(values)) / 30, np.array(values)),
        ]
        links += [fbx.link(node, layer), fbx.link(node, 20, "Lcl Rotation"), fbx.link(curve, node, "d|X")]
    return objects, links


TAKES = {  # takes before the hero's own, which is called Take 1; the take that is read, and the others that could be
    "Mixamo": ([("Take 001", [], True)], "Take 1", None),
    "two empty ones": ([("Take 001", [], True), ("mixamo.com", [], True)], "Take 1", None),
    "one that stands still": ([("T-Pose", [30.0, 30.0, 30.0], False)], "Take 1", "T-Pose"),
    "Blender": ([("Armature|Action", [0.0, 40.0, 80.0], False)], "Armature|Action", "Take 1"),
    "Japanese": ([("歩く", [0.0, 40.0, 80.0], False), ("Take 001", [], True)], "歩く", "Take 1"),
}


@pytest.mark.parametrize("case", TAKES)
@pytest.mark.parametrize("writer", ["text", "binary"])
def test_the_first_take_that_moves_is_read(tmp_path, case, writer):
    before, chosen, others = TAKES[case]
    tree = Hero("Y up, cm").tree()
    parts = {record[0]: record for record in tree}
    for number, (name, values, empty) in enumerate(before, 1):
        objects, links = take(name, number, values, empty=empty)
        parts["Objects"][2][:0] = objects
        parts["Connections"][2][:0] = links
    path = tmp_path / "hero.fbx"
    path.write_bytes(WRITERS[writer](tree))
    found = io.read_motion(path)
    np.testing.assert_array_equal(found.poses, io.read_motion(f"{path}#{chosen}").poses)
    assert len(found.poses) == (FRAMES if chosen == "Take 1" else 3)
    note = f"its animation {chosen} is read; FILE#NAME reads another: {others}"
    assert found.notes == ((note,) if others else ())
    with pytest.raises(InputError, match=r"no such animation .found 'run'.; .*Take 1"):
        io.read_motion(f"{path}#run")
    if before[0][2]:
        with pytest.raises(InputError, match="curves of some joint expected"):
            io.read_motion(f"{path}#{before[0][0]}")


def test_of_several_layers_the_first_counts_and_is_told(tmp_path):
    (tmp_path / "one.fbx").write_bytes(fbx.binary(Hero("Y up, cm").tree()))
    (tmp_path / "two.fbx").write_bytes(fbx.binary(Hero("Y up, cm").tree(layers=2)))
    found = io.read_motion(tmp_path / "two.fbx")
    np.testing.assert_array_equal(found.poses, io.read_motion(tmp_path / "one.fbx").poses)
    assert found.notes == ("of its layers (Base, Base) the first that moves a joint counts; bake them to have all",)


def test_polygons_are_cut_as_in_every_mesh(tmp_path):
    """A quad that is not convex is cut along its inner diagonal, and an edge of two corners is no polygon."""
    tree = Hero("Y up, cm").tree()
    objects = next(inner for name, _, inner in tree if name == "Objects")
    mesh = next(inner for name, _, inner in objects if name == "Geometry")
    cluster = next(inner for name, values, inner in objects if name == "Deformer" and values[2] == "Cluster")
    count, faces = len(mesh[0][1][0]) // 3, len(mesh[1][1][0]) // 3
    dart = np.array([[4.0, 0, 0], [1, 1, 0], [0, 4, 0], [0, 0, 0]])
    mesh[0][1][0] = np.concatenate([mesh[0][1][0], dart.ravel()])
    corners = np.array([count, count + 1, count + 2, -1 - (count + 3), 0, -2], np.int32)
    mesh[1][1][0] = np.concatenate([mesh[1][1][0], corners])
    cluster[0][1][0] = np.concatenate([cluster[0][1][0], np.arange(count, count + 4, dtype=np.int32)])
    cluster[1][1][0] = np.concatenate([cluster[1][1][0], np.ones(4)])
    (tmp_path / "hero.fbx").write_bytes(fbx.binary(tree))
    body = io.read_body(tmp_path / "hero.fbx")
    assert len(body.faces) == faces + 2
    p = body.vertices[body.faces[-2:]]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    np.testing.assert_allclose(area[0], area[1], rtol=1e-9)  # cut along the outer diagonal they would be 4 and 8


TEXT = fbx.text(Hero("Y up, cm").tree()).decode()
BINARY = fbx.binary(Hero("Y up, cm").tree())
DAMAGED = {
    "empty": (b"", "an empty file"),
    "words": (b"hello", "line 1: the records of an FBX expected"),
    "old": (TEXT.replace("FBXVersion: 7400", "FBXVersion: 6100").encode(), "FBX 7 expected"),
    "old binary": (BINARY[:23] + b"\xd4\x17\0\0" + BINARY[27:], "FBX 7 expected"),
    "brace": (TEXT.replace("Objects:  {", "Objects:").encode(), "the records of an FBX expected"),
    "cut text": (TEXT[:3000].encode(), "the records of an FBX expected"),
    "cut binary": (BINARY[:3000], "whole records expected"),
    "count": (TEXT.replace("Vertices: *", "Vertices: *9", 1).encode(), "finite numbers expected|can hold"),
    "huge": (TEXT.replace("Vertices: *", "Vertices: *99999999", 1).encode(), "at most|can hold"),
    "nan": (TEXT.replace("a: ", "a: nan,", 1).replace("Vertices: *", "Vertices: *", 1).encode(), "finite numbers"),
    "axis": (
        TEXT.replace('"UnitScaleFactor", "", "", "A", 1.0', '"UnitScaleFactor", "", "", "A", 0.0').encode(),
        "a unit above 0",
    ),
    "circle": (TEXT.replace('C: "OO", 10, 0', 'C: "OO", 10, 22').encode(), "a circle"),
    "no bone": (TEXT.replace('C: "OO", 21, 41', 'C: "OO", 99, 41').encode(), "a joint, its place, and weights"),
    "no take": (TEXT.replace("AnimationStack", "AnimationStock").encode(), "an animation expected"),
    "no curves": (TEXT.replace('C: "OO", 51, 50', 'C: "OO", 51, 99').encode(), "curves of some joint"),
    "times": (TEXT.replace("KeyTime: *16 {\n a: 0,", "KeyTime: *16 {\n a: 46186158000,").encode(), "rising times"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_what_is_wrong_is_named(tmp_path, case):
    data, message = DAMAGED[case]
    (tmp_path / "hero.fbx").write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        io.read_body(tmp_path / "hero.fbx")
        io.read_motion(tmp_path / "hero.fbx")
    assert "hero.fbx" in str(caught.value) and "\n" not in str(caught.value)


def test_curves_between_their_keys():
    """Constant, linear, given slopes (a cubic with them), and automatic ones (a parabola's are its own)."""

    def of(values, flags, slopes=(0.0, 0.0)) -> Curve:
        name, _, inner = fbx.curve(1, np.arange(len(values)) / 2, values, flags, slopes)
        rows = [Record(n, [Packed(v[0].size, v[0].dtype.str, v[0].tobytes(), False)], []) for n, v, _ in inner]
        return curve_from(Fbx(Path(__file__), Record("", [], [])), Record(name, [], rows), "here", 46186158000)

    t = np.array([-1, 0, 0.1, 0.25, 0.5, 0.7, 1, 3])
    low, high = t < 0.5, t >= 1
    np.testing.assert_allclose(of([1, 3, 9], 2).at(t), np.where(low, 1, np.where(high, 9, 3)))
    np.testing.assert_allclose(of([1, 3, 9], 2 | 0x100).at(t)[[1, 2, 4, 5]], [1, 3, 3, 9])
    np.testing.assert_allclose(of([1, 3, 9], 4).at(t), np.interp(t, [0, 0.5, 1], [1, 3, 9]))
    s = t[2] / 0.5
    cubic = (
        (2 * s**3 - 3 * s**2 + 1) * 1 + 0.5 * (s**3 - 2 * s**2 + s) * 4 + (3 * s**2 - 2 * s**3) * 3 + 0.5 * (s**3 - s**2) * -2
    )
    np.testing.assert_allclose(of([1, 3, 9], 8 | 0x400, (4, -2)).at(t)[2], cubic, atol=1e-6)
    square = np.arange(6) ** 2 / 4.0
    inner = np.linspace(0.5, 2, 20)
    np.testing.assert_allclose(of(square, 8).at(inner), inner**2, atol=1e-12)
    assert of([7], 8).at(t).tolist() == [7] * 8


@pytest.mark.slow
@pytest.mark.skipif(not BLENDER, reason="NCS_BLENDER names no Python with bpy, which needs a NumPy older than ours")
def test_what_blender_writes_moves_as_in_blender(tmp_path):
    """The packaged body as .glb, .gltf and .fbx: 31 joints, in centimetres, lying down, nodes in the seventh frame's pose."""
    script = Path(__file__).with_name("blender.py")
    record = io.read_body(ASSETS / "body.npz")
    subprocess.run([BLENDER, str(script), str(tmp_path), str(ASSETS / "body.npz")], check=True, stdout=subprocess.DEVNULL)
    with np.load(tmp_path / "truth.npz") as truth:
        rest, expected = truth["rest"], truth["posed"]
    for name in ("hero.glb", "hero.gltf", "hero.fbx"):
        body, motion = io.read_body(tmp_path / name), io.read_motion(tmp_path / name)
        far, order = cKDTree(body.vertices).query(rest)
        assert far.max() < 1e-5 and len(body.vertices) == len(record.vertices)
        assert set(body.joint_names) == set(record.joint_names) and motion.fps == 24 and len(motion.poses) == 25
        assert np.abs(posed(body, motion)[:, order] - expected).max() < 1e-5
    alone = io.read_motion(tmp_path / "idle.fbx")
    assert set(alone.joint_names) >= set(record.joint_names)


# --- meshes by name, blend shapes, garments -----------------------------------------------------------------------------------


def wardrobe(path: Path, writer, *, percent: float = 0.0) -> Path:
    """The character, with a blend shape on its skin, beside a skirt of quads that has no skin, in centimetres, mirrored."""
    tree = Hero("Y up, cm").tree()
    objects, links = tree[2][2], tree[3][2]
    x, _ = grid(4, 3)
    corner = (np.arange(3)[:, None] * 3 + np.arange(2)).reshape(-1)
    quads = np.stack([corner, corner + 1, corner + 4, -1 - (corner + 3)], axis=1).astype(np.int32)
    edge = np.array([0, -2], np.int32)  # one that stands by itself
    place = fbx.properties(Lcl__Translation=(10, 0, 0), Lcl__Scaling=(-100, 100, 100))
    ends = np.concatenate([quads.ravel(), edge])
    uv = x[np.where(ends < 0, -1 - ends, ends), :2] + 10 * (np.arange(len(ends)) // 4)[:, None]  # a seam around each quad
    order = np.random.default_rng(0).permutation(len(ends)).astype(np.int32)
    objects += [
        ("Model", [70, "Model::Skirt", "Mesh"], [place]),
        ("Geometry", [71, "Geometry::Skirt_mesh", "Mesh"], [
            ("Vertices", [x.ravel()], None), ("PolygonVertexIndex", [ends], None),
            ("LayerElementUV", [0], [
                ("MappingInformationType", ["ByPolygonVertex"], None), ("ReferenceInformationType", ["IndexToDirect"], None),
                ("UV", [uv[np.argsort(order)].ravel()], None), ("UVIndex", [order], None),
            ]),
        ]),
        ("Deformer", [80, "Deformer::", "BlendShape"], []),
        ("Deformer", [81, "SubDeformer::tall", "BlendShapeChannel"], [fbx.properties(DeformPercent=percent)]),
        ("Geometry", [82, "Geometry::tall", "Shape"], [
            ("Indexes", [np.array([0, 3, 4], np.int32)], None), ("Vertices", [np.tile([0.0, 1.0, 0.0], 3)], None),
        ]),
    ]  # fmt: skip
    links += [fbx.link(70, 0), fbx.link(71, 70), fbx.link(80, 31), fbx.link(81, 80), fbx.link(82, 81)]
    path.write_bytes(WRITERS[writer](tree))
    return path


@pytest.mark.parametrize("writer", ["text", "binary"])
def test_meshes_blend_shapes_and_garments(tmp_path, writer):
    path = wardrobe(tmp_path / "hero.fbx", writer)
    with pytest.raises(InputError, match=r"garment\.mesh: one object.*Skin \(\d+ vertices\), Skirt \(12 vertices\)"):
        io.read_garment(path)
    for name in ("Skirt", "Skirt_mesh"):
        skirt = io.read_garment(path, mesh=[name])
        np.testing.assert_allclose(skirt.vertices, grid(4, 3)[0] * [-1, 1, 1] + [0.1, 0, 0], atol=1e-9)
        a, b, c = (skirt.vertices[skirt.faces[:, k]] for k in range(3))
        seams = skirt.uv - 10 * (np.arange(12) // 2)[:, None, None]
        np.testing.assert_allclose(seams, grid(4, 3)[0][skirt.faces, :2], atol=1e-12)
        assert len(skirt.faces) == 12 and (np.cross(b - a, c - a)[:, 2] > 0).all()
    body, tall = io.read_body(path), io.read_body(path, part=["Skin"], shapes={"tall": 0.5})
    moved = tall.vertices - body.vertices
    assert (np.abs(moved).max(axis=1) > 1e-4).sum() == 3
    half = io.read_body(wardrobe(tmp_path / "half.fbx", writer, percent=50.0))
    np.testing.assert_allclose(half.vertices, tall.vertices, atol=1e-9)
    np.testing.assert_allclose(io.read_garment(path, mesh=["Skin"]).vertices, body.vertices, atol=1e-6)
    with pytest.raises(InputError, match=r"body\.shapes: no such shape.*'wide'.*tall"):
        io.read_body(path, shapes={"wide": 1.0})
    with pytest.raises(InputError, match=r"body\.part: no such mesh.*'Skirt'.*Skin \("):  # it has no skin
        io.read_body(path, part=["Skirt"])


def retimed(tree: list, fps: float, flags: int = 4, start: float = 0.0, **settings) -> list:
    """A tree with other GlobalSettings and all its keys at another rate."""

    def change(node):
        name, values, inner = node
        if name == "KeyTime":
            return (name, [np.array(np.round((start + np.arange(FRAMES) / fps) * 46186158000), np.int64)], inner)
        if name == "KeyAttrFlags":
            return (name, [np.array([flags], np.int32)], inner)
        if name == "GlobalSettings":
            return (name, values, [fbx.properties(**settings)])
        return (name, values, None if inner is None else [change(n) for n in inner])

    return [change(node) for node in tree]


@pytest.mark.parametrize(
    ("settings", "fps"),
    [
        ({"TimeMode": 0}, 60),
        ({}, 24),
        ({"TimeMode": 12}, 50),
        ({"TimeMode": 14, "CustomFrameRate": -1.0}, 120),
        ({"TimeMode": 3}, 60),
    ],
)
def test_the_rate_is_the_keys_where_the_file_states_none(tmp_path, settings, fps):
    """TimeMode 0 is the program's default, 12 a thousand a second, 14 another one, -1 none."""
    hero = Hero("Y up, cm")
    (tmp_path / "hero.fbx").write_bytes(fbx.binary(retimed(hero.tree(), fps, **settings)))
    motion = io.read_motion(tmp_path / "hero.fbx")
    assert motion.fps == fps and len(motion.poses) == FRAMES
    (tmp_path / "plain.fbx").write_bytes(fbx.binary(hero.tree()))
    np.testing.assert_allclose(motion.poses, io.read_motion(tmp_path / "plain.fbx").poses, atol=1e-6)


@pytest.mark.parametrize("flags", [2, 2 | 0x100])
def test_held_keys_are_met_at_rates_that_are_no_whole_numbers(tmp_path, flags):
    hero = Hero("Y up, cm")
    ntsc = retimed(hero.tree(), 30 / 1.001, flags, start=7.0, TimeMode=9)
    (tmp_path / "hero.fbx").write_bytes(fbx.binary(ntsc))
    (tmp_path / "plain.fbx").write_bytes(fbx.binary(hero.tree()))
    held, plain = (io.read_motion(tmp_path / f"{name}.fbx") for name in ("hero", "plain"))
    np.testing.assert_allclose(held.poses, plain.poses, atol=1e-6)


def test_a_text_with_a_byte_order_mark_and_a_camera_that_turns(tmp_path):
    tree = Hero("Y up, cm").tree(skin=False)
    objects, links = tree[2][2], tree[3][2]
    objects += [("Model", [900, "Model::Camera", "Camera"], [fbx.properties(Lcl__Rotation=(0, 0, 0))]),
                ("AnimationCurveNode", [901, "AnimCurveNode::R", ""], []), fbx.curve(902, [0, 1], [0, 90])]  # fmt: skip
    links += [fbx.link(900, 0), fbx.link(901, 51), fbx.link(901, 900, "Lcl Rotation"), fbx.link(902, 901, "d|Y")]
    (tmp_path / "hero.fbx").write_bytes(b"\xef\xbb\xbf" + fbx.text(tree))
    assert io.read_motion(tmp_path / "hero.fbx").joint_names == NAMES

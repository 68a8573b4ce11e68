"""Characters in glTF: the record skinned by the package's own kinematics is what the file's specification says."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pygltflib as gl
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.cli import main
from ncs_jax.errors import InputError
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.retarget import paired
from ncs_jax.scene.spec import scene_from
from ncs_jax.view.live import view
from tests import fbx_files
from tests.characters import JOINTS, NAMES, figure, posed, rigid, skinned, write_glb
from tests.scenes import FREE
from tests.test_fbx import Hero


def agree(path: Path, clip: str = "", number: int = 0) -> tuple[io.BodyRecord, io.MotionRecord]:
    """Read a character, and hold its movement against the specification's to 1e-5 m in every frame."""
    body, motion = io.read_body(path), io.read_motion(f"{path}#{clip}" if clip else path)
    assert body.joint_names == motion.joint_names
    ours = posed(body, motion)
    theirs = skinned(path, (np.arange(len(motion.poses)) / motion.fps).astype(np.float32), number)  # as keys are
    _, same = cKDTree(ours[0]).query(theirs[0])  # vertices that were split are one here
    assert len(np.unique(same)) == len(body.vertices)
    assert np.abs(ours[:, same] - theirs).max() < 1e-5
    return body, motion


CASES = {
    "mixamo": {},
    "plain": {"armature": np.eye(4)},
    "far, turned and large": {"armature": rigid((2, 0, 1), Rotation.from_rotvec([0, 2.0, 0]), 2.5)},
    "step": {"mode": "STEP"},
    "cubic": {"mode": "CUBICSPLINE"},
    "cubic between keys": {"mode": "CUBICSPLINE", "times": [0, 0.21, 0.3, 0.4]},
    "mirrored": {"armature": rigid((1, 0, 0)) @ np.diag([-0.01, 0.01, 0.01, 1])},
    "sparse": {"sparse": True},
    "sparse cubic": {"sparse": True, "mode": "CUBICSPLINE"},
    "bytes": {"weights": np.uint8},
    "shorts": {"joints": np.uint16, "weights": np.uint16},
    "two sets, three primitives": {"pieces": 3},
    "nodes in another pose": {"posed": True},
    "a root bone above": {"root": True},
    "keys of scale that are one": {"scale": True},
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_skinning_is_the_files_own(tmp_path, case, suffix):
    body, motion = agree(write_glb(tmp_path / f"hero{suffix}", **CASES[case]))
    assert body.joint_names == NAMES and body.parents.tolist() == [-1, 0, 1]
    assert len(body.vertices) == len(figure()["vertices"]) and body.faces.shape == figure()["faces"].shape
    assert (motion.fps, len(motion.poses)) == ((30, 13) if "times" in CASES[case] else (12, 13))
    assert np.ptp(motion.poses, axis=0).max() > 0.1 and np.ptp(motion.translation, axis=0).max() > 0.1
    np.testing.assert_allclose(np.linalg.norm(body.joints[1] - body.joints[0]), 0.4, atol=1e-6)


@pytest.mark.parametrize("case", ["mixamo", "nodes in another pose", "a root bone above", "mirrored"])
def test_the_body_stands_in_metres_with_y_up(tmp_path, case):
    """The armature of the file is a hundred times too small and lies on its back; where it stands is kept."""
    body = io.read_body(write_glb(tmp_path / "hero.glb", **CASES[case]))
    expected = figure()
    order = cKDTree(body.vertices - body.vertices.mean(0)).query(expected["vertices"] - expected["vertices"].mean(0))[1]
    shift = body.vertices[order] - expected["vertices"]
    assert np.ptp(shift, axis=0).max() < 1e-6
    np.testing.assert_allclose(body.weights[order], expected["weights"], atol=1e-6)
    np.testing.assert_allclose(body.joints - shift[0], JOINTS, atol=1e-6)
    corners = body.vertices[body.faces] - body.vertices.mean(0)
    assert np.linalg.det(corners).sum() / 6 > 0.01  # m^3: it faces outward


def test_rest_is_no_rotation(tmp_path):
    """The animation that stands still in the bind pose has no rotation and no translation."""
    _, motion = agree(write_glb(tmp_path / "hero.glb"), "still", 1)
    assert np.abs(motion.poses).max() < 1e-6 and np.abs(motion.translation).max() < 1e-6


def test_names_choose_an_animation_and_the_first_is_taken_without(tmp_path):
    path = write_glb(tmp_path / "hero.glb")
    np.testing.assert_array_equal(io.read_motion(path).poses, io.read_motion(f"{path}#walk").poses)
    assert np.abs(io.read_motion(f"{path}#still").poses - io.read_motion(path).poses).max() > 0.1
    assert io.read_motion(path).notes == ("its animation walk is read; FILE#NAME reads another: still",)
    empty = changed(path, tmp_path / "empty.gltf", at("animations", 0, "channels", value=[]))
    np.testing.assert_array_equal(io.read_motion(empty).poses, io.read_motion(f"{path}#still").poses)
    with pytest.raises(InputError, match=r"hero\.glb: animations: no such animation .found 'run'.; .*walk, still"):
        io.read_motion(f"{path}#run")


@pytest.mark.parametrize("mode", ["LINEAR", "CUBICSPLINE"])
def test_a_clip_that_stands_still_is_not_taken_for_one_that_moves(tmp_path, mode):
    """Keys that alternate between a quaternion and its negative turn nothing, nor do the slopes of cubic keys move."""
    path = write_glb(tmp_path / "hero.glb", mode=mode)
    swapped = changed(path, tmp_path / "swapped.gltf", lambda tree: tree["animations"].reverse())
    np.testing.assert_array_equal(io.read_motion(swapped).poses, io.read_motion(f"{path}#walk").poses)


def test_what_turns_beside_the_skeleton_is_not_taken_for_it(tmp_path):
    path = write_glb(tmp_path / "hero.glb")

    def camera(tree: dict) -> None:
        tree["skins"], tree["meshes"] = [], []
        del tree["nodes"][4]["skin"], tree["nodes"][4]["mesh"]
        tree["nodes"].append({"name": "Camera"})
        tree["scenes"][0]["nodes"].append(5)
        tree["animations"][0]["channels"].append({"sampler": 0, "target": {"node": 5, "path": "rotation"}})

    found = io.read_motion(changed(path, tmp_path / "scene.gltf", camera))
    assert found.joint_names == NAMES
    assert np.abs(found.poses).max() > 0.1


@pytest.mark.parametrize(
    ("times", "fps", "frames"),
    [
        (np.arange(25) / 24, 24, 25),
        (np.arange(61) / 60, 60, 61),
        ([0, 1.0], 30, 31),  # a key a second is no frame rate
        ([0, 0.1, 0.15, 0.8], 30, 25),
        (0.5 + np.arange(31) / 30, 30, 31),  # it begins with its first key
        ([0.25], 30, 1),
    ],
)
def test_frame_rates(tmp_path, times, fps, frames):
    motion = io.read_motion(write_glb(tmp_path / "hero.glb", times=times))
    assert motion.fps == fps and len(motion.poses) == frames


def test_uneven_keys_are_sampled_between(tmp_path):
    path = write_glb(tmp_path / "hero.glb", times=[0, 0.21, 0.3, 1.0])
    agree(path)


def test_a_part_of_a_motion(tmp_path):
    path = write_glb(tmp_path / "hero.glb")
    whole, part = io.read_motion(path), io.read_motion(path, frame_range=(3, 9))
    np.testing.assert_array_equal(part.poses, whole.poses[3:9])


def test_a_skeleton_without_a_skin(tmp_path):
    """The nodes' own pose is at rest, which here is the bind pose: the motion is that of the file with its skin."""
    path = write_glb(tmp_path / "hero.glb")
    expected = io.read_motion(path)
    gltf = gl.GLTF2().load(str(path))
    gltf.skins, gltf.meshes = [], []
    gltf.nodes[4].skin = gltf.nodes[4].mesh = None
    gltf.save(str(tmp_path / "bones.glb"))
    motion = io.read_motion(tmp_path / "bones.glb")
    assert motion.joint_names == NAMES
    np.testing.assert_allclose(motion.poses, expected.poses, atol=1e-6)
    np.testing.assert_allclose(motion.translation, expected.translation, atol=1e-6)
    with pytest.raises(InputError, match="skins: a skinned mesh expected"):
        io.read_body(tmp_path / "bones.glb")


def test_strips_and_fans(tmp_path):
    """A fan or strip of five vertices is three triangles that all face one side."""
    for mode, expected in ((5, [[0, 1, 2], [2, 1, 3], [2, 3, 4]]), (6, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])):
        path = write_glb(tmp_path / "hero.glb")
        gltf = gl.GLTF2().load(str(path))
        primitive = gltf.meshes[0].primitives[0]
        primitive.mode = mode
        x = np.arange(15, dtype=np.float32).reshape(5, 3) ** 2
        begin = gltf.bufferViews[gltf.accessors[primitive.attributes.POSITION].bufferView].byteOffset
        blob = bytearray(gltf.binary_blob())
        blob[begin : begin + 60] = x.tobytes()
        gltf.set_binary_blob(bytes(blob))
        for index in (primitive.attributes.POSITION, primitive.attributes.JOINTS_0, primitive.attributes.WEIGHTS_0):
            gltf.accessors[index].count = 5
        gltf.save(str(path))
        assert sorted(sorted(f) for f in io.read_body(path).faces.tolist()) == sorted(sorted(f) for f in expected)
        first = {tuple(np.roll(f, -int(np.argmin(f)))) for f in io.read_body(path).faces.tolist()}
        assert first == {tuple(np.roll(f, -int(np.argmin(f)))) for f in expected}


@pytest.mark.parametrize("change", [{"stretch": 0.05}, {"stretch": 0.05, "mode": "CUBICSPLINE"}])
def test_bones_that_stretch(tmp_path, change):
    with pytest.raises(InputError, match=r"joint Spine: bones of fixed length expected.* from its place, on a bone of"):
        io.read_motion(write_glb(tmp_path / "hero.glb", **change))
    assert len(io.read_body(tmp_path / "hero.glb").joints) == 3


def changed(path: Path, out: Path, change) -> Path:
    """The same file with its JSON changed, as text with its buffer in a data URI."""
    gltf = gl.GLTF2().load(str(path))
    tree = json.loads(gltf.to_json())
    tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(gltf.binary_blob()).decode()
    change(tree)
    out.write_text(json.dumps(tree))
    return out


def test_buffers_in_the_text(tmp_path):
    path = write_glb(tmp_path / "hero.glb")
    text = changed(path, tmp_path / "text.gltf", lambda tree: None)
    np.testing.assert_array_equal(io.read_motion(text).poses, io.read_motion(path).poses)


def at(*keys, value):
    """A change of one place in a tree of JSON; a value of None takes it out."""

    def change(tree):
        for key in keys[:-1]:
            tree = tree[key]
        if value is None:
            del tree[keys[-1]]
        else:
            tree[keys[-1]] = value

    return change


POSITION = ("meshes", 0, "primitives", 0, "attributes")
BROKEN = {
    "draco": (at(*POSITION[:-1], "extensions", value={"KHR_draco_mesh_compression": {"bufferView": 99}}), "draco"),
    "meshopt": (at("extensionsRequired", value=["EXT_meshopt_compression"]), "found 'EXT_meshopt_compression'"),
    "meshopt view": (at("bufferViews", 0, "extensions", value={"EXT_meshopt_compression": {}}), "plain buffers expected"),
    "version": (at("asset", "version", value="1.0"), "glTF 2 expected"),
    "folder above": (at("buffers", 0, "uri", value="../hero.bin"), "a file in the same folder"),
    "absolute": (at("buffers", 0, "uri", value="/etc/passwd"), "a file in the same folder"),
    "percent": (at("buffers", 0, "uri", value="%2e%2e%2fhero.bin"), "a file in the same folder"),
    "network": (at("buffers", 0, "uri", value="https://example.org/hero.bin"), "a file in the same folder"),
    "file": (at("buffers", 0, "uri", value="file:///etc/passwd"), "a file in the same folder"),
    "missing": (at("buffers", 0, "uri", value="none.bin"), r"none\.bin: no such file"),
    "not base64": (at("buffers", 0, "uri", value="data:;base64,####"), "base64 expected"),
    "no buffer": (at("buffers", 0, "uri", value=None), "a uri, or the binary chunk"),
    "short": (at("buffers", 0, "byteLength", value=10**7), "10000000 bytes expected"),
    "view": (at("bufferViews", 0, "byteLength", value=10), "at most 10 bytes expected"),
    "view outside": (at("bufferViews", 0, "byteOffset", value=10**9), "at most 0 bytes expected"),
    "count": (at("accessors", 0, "count", value=10**9), "at most 4294967296 bytes|more than a file"),
    "negative": (at("accessors", 0, "count", value=-1), "accessor 0 count: a whole number"),
    "text": (at("accessors", 0, "count", value="12"), "accessor 0 count: a whole number"),
    "type": (at("accessors", 0, "type", value="VEC5"), "one of SCALAR"),
    "component": (at("accessors", 0, "componentType", value=5124), "5121, 5122"),
    "kind": (at("accessors", 0, "type", value="VEC4"), "VEC3 expected|bytes expected"),
    "no accessor": (at(*POSITION, "POSITION", value=99), "POSITION: a whole number from 0"),
    "no weights": (at(*POSITION, "WEIGHTS_0", value=None), "WEIGHTS_0: a whole number"),
    "joints as floats": (at(*POSITION, "JOINTS_0", value=2), "whole numbers and weights"),
    "few joints": (at("skins", 0, "joints", value=[1, 2]), "joints from 0 to 1 expected"),
    "a joint twice": (at("skins", 0, "joints", value=[1, 2, 2]), "different numbers"),
    "few binds": (at("skins", 0, "inverseBindMatrices", value=0), "VEC3|MAT4 expected"),
    "no skin": (at("nodes", 4, "skin", value=None), "a skinned mesh expected"),
    "circle": (at("nodes", 3, "children", value=[1]), "one parent for each node|a circle"),
    "itself": (at("nodes", 0, "children", value=[0, 1, 4]), "a circle"),
    "child": (at("nodes", 0, "children", value=[1, 77]), "from 0 to 4 expected"),
    "no quaternion": (at("nodes", 1, "rotation", value=[0, 0, 0, 0]), "quaternions that are not zero"),
    "three": (at("nodes", 1, "translation", value=[0, 0]), "3 finite numbers"),
    "huge": (at("nodes", 1, "translation", value=[0, 0, 1e38]), "3 finite numbers"),
    "name": (at("nodes", 1, "name", value=7), "a text expected"),
    "nodes": (at("nodes", value={}), "a list of objects"),
    "no nodes": (at("nodes", value=[]), "1 to 20000 nodes"),
    "mode": (at("animations", 0, "samplers", 0, "interpolation", value="QUADRATIC"), "LINEAR, STEP or CUBICSPLINE"),
    "sampler": (at("animations", 0, "channels", 0, "sampler", value=99), "a whole number from 0 to 3"),
    "values": (at("animations", 0, "samplers", 0, "interpolation", value="CUBICSPLINE"), "as many values as times"),
    "same key twice": (at("animations", 0, "channels", 1, "target", value={"node": 1, "path": "rotation"}), "keys once"),
    "matrix": (at("nodes", 1, "matrix", value=list(map(float, np.eye(4).ravel()))), "of a node without a matrix"),
    "no animation": (at("animations", value=[]), "an animation expected"),
    "other keys": (lambda tree: [a.update(channels=[]) for a in tree["animations"]], "keys of some joint"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_wrong_is_named(tmp_path, case):
    change, message = BROKEN[case]
    path = changed(write_glb(tmp_path / "hero.glb"), tmp_path / "broken.gltf", change)
    with pytest.raises(InputError, match=message) as caught:
        io.read_body(path)
        io.read_motion(path)
    assert "\n" not in str(caught.value) and (str(path) in str(caught.value) or case == "missing")


def test_a_link_out_of_the_folder_is_not_followed(tmp_path):
    (tmp_path / "in").mkdir()
    path = write_glb(tmp_path / "in" / "hero.gltf")
    (tmp_path / "in" / "hero.bin").rename(tmp_path / "hero.bin")
    (tmp_path / "in" / "hero.bin").symlink_to(tmp_path / "hero.bin")
    with pytest.raises(InputError, match="a file in the same folder"):
        io.read_body(path)


GLB = struct.Struct("<4sIII4s")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "an empty file"),
        (b"hello", "begins with 'glTF'"),
        (GLB.pack(b"glTF", 1, 20, 0, b"JSON"), "glTF 2 expected"),
        (GLB.pack(b"glTF", 2, 2**32 - 1, 0, b"JSON"), "whole chunks"),
        (GLB.pack(b"glTF", 2, 20, 2**32 - 1, b"JSON"), "whole chunks"),
        (GLB.pack(b"glTF", 2, 20, 0, b"BIN\0"), "JSON first"),
        (GLB.pack(b"glTF", 2, 22, 2, b"JSON") + b"[]", "an object expected"),
        (GLB.pack(b"glTF", 2, 24, 4, b"JSON") + b"null", "an object expected"),
        (GLB.pack(b"glTF", 2, 23, 3, b"JSON") + b"NaN", "NaN is no number"),
        (GLB.pack(b"glTF", 2, 20 + 200_000, 200_000, b"JSON") + b"[" * 200_000, "not a readable glTF"),
    ],
)
def test_frames_that_are_damaged(tmp_path, data, message):
    (tmp_path / "hero.glb").write_bytes(data)
    for read in (io.read_body, io.read_motion):
        with pytest.raises(InputError, match=message) as caught:
            read(tmp_path / "hero.glb")
        assert "hero.glb" in str(caught.value)


def sleeve(rings=6, around=16, radius=0.095, low=0.35, height=0.25) -> tuple[np.ndarray, np.ndarray]:
    """An open tube around the figure, facing outward, m."""
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack([radius * np.cos(angle), np.zeros(around), radius * np.sin(angle)], axis=1)
    x = np.concatenate([ring + [0, low + height * i / (rings - 1), 0] for i in range(rings)])
    i, j = np.meshgrid(np.arange(rings - 1) * around, np.arange(around), indexing="ij")
    a, b = (i + j).ravel(), (i + (j + 1) % around).ravel()
    return x, np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])


@pytest.mark.parametrize("name", ["hero.glb", pytest.param("hero.fbx", marks=pytest.mark.slow)])
def test_a_scene_whose_body_and_motion_are_one_file(tmp_path, plain_jax, name):
    """From the file to an animated garment without a hand edit, by the commands."""
    if name == "hero.glb":
        write_glb(tmp_path / name, armature=rigid((0, 0, 0), Rotation.from_euler("X", -90, degrees=True), 0.01))
    else:
        (tmp_path / name).write_bytes(fbx_files.binary(Hero("Z up, inches").tree()))
    x, faces = sleeve()
    np.savez(tmp_path / "sleeve.npz", vertices=x, faces=faces, group_pins=np.flatnonzero(x[:, 1] > 0.59))
    scene = tmp_path / "scene.toml"
    motion = "hero.glb#walk" if name == "hero.glb" else name
    scene.write_text(FREE.replace("body.npz", name).replace("swing.npz", motion).replace("cloth.npz", "sleeve.npz"))
    assert main(["check", str(scene)]) == 0
    assert main(["train", str(scene), "--out", str(tmp_path / "run"), "--steps", "20"]) == 0
    assert main(["animate", str(tmp_path / "run"), "--motion", str(tmp_path / name), "--out", str(tmp_path / "out.npz")]) == 0
    made = io.read_animation(tmp_path / "out.npz")
    whole = posed_in_float32(tmp_path / name, len(made.vertices))
    spine = whole[:, np.abs(whole[0, :, 1] - 0.5).argmin()]  # the sleeve stays where the figure's middle goes
    assert np.linalg.norm(made.vertices.mean(axis=1) - spine, axis=1).max() < 0.25
    assert np.linalg.norm(np.ptp(made.vertices.mean(axis=1), axis=0)) > 0.1
    window = view(str(tmp_path / "run"), port=0)
    window.close()
    np.testing.assert_allclose(window.vertices, made.vertices, atol=1e-5)


def posed_in_float32(path: Path, frames: int) -> np.ndarray:
    """The skin at 30 frames a second, (frames, verts, 3)."""
    motion = load_motion(scene_from({"body": {"file": str(path)}, "motion": {"files": []}}), str(path), io.read_body(path))
    assert len(motion.poses) == frames
    return posed(io.read_body(path), motion)


HUMANOID = {"hips": 1, "spine": 2, "head": 3}
EXTENSIONS = {
    "VRM 0": ("hero.vrm", "VRM", [{"bone": b, "node": n} for b, n in HUMANOID.items()] + [{"bone": "jaw", "node": -1}]),
    "VRM 1": ("hero.vrm", "VRMC_vrm", {b: {"node": n} for b, n in HUMANOID.items()}),
    "an animation": ("hero.vrma", "VRMC_vrm_animation", {b: {"node": n} for b, n in HUMANOID.items()}),
    "a draft of one": ("hero.vrma", "VRMC_vrm_animation", HUMANOID),
}


@pytest.mark.parametrize("case", EXTENSIONS)
def test_the_bones_of_a_vrm_are_those_it_says_whatever_its_nodes_are_called(tmp_path, case):
    name, extension, bones = EXTENSIONS[case]
    path = write_glb(tmp_path / "hero.glb")
    plain, gltf = io.read_motion(path), gl.GLTF2().load(str(path))
    gltf.extensions = {extension: {"humanoid": {"humanBones": bones}}}
    for j in range(3):
        gltf.nodes[j + 1].name = f"Bone.{7 - j:03d}"
    gltf.save(str(tmp_path / "named.glb"))
    path = (tmp_path / "named.glb").rename(tmp_path / name)
    motion = io.read_motion(f"{path}#walk")
    assert motion.bones == tuple(HUMANOID) and motion.joint_names == ("Bone.007", "Bone.006", "Bone.005")
    np.testing.assert_array_equal(motion.poses, plain.poses)
    if name.endswith(".vrm"):
        body = io.read_body(path)
        assert body.bones == motion.bones and io.read_body(tmp_path / "hero.glb").bones == ()
        source, target, pairs = paired(motion, body, {})
        assert pairs == {0: 0, 1: 1, 2: 2} and source.roles["head"] == target.roles["head"] == 2

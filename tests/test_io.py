"""Files: what is written comes back, and whatever is wrong with a file becomes one InputError that says how to mend it."""

from __future__ import annotations

import ast
import io as bytes_io
import os
import pickle
import random
import signal
import struct
import subprocess
import sys
import tempfile
import textwrap
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io.character.bvh import read_bvh
from ncs_jax.scene.spec import load_scene, template
from tests import fbx_files
from tests.characters import write_glb
from tests.conftest import THOROUGH
from tests.test_fbx import Hero
from tests.test_gltf import changed

DATA = Path(__file__).parents[2] / "shared" / "data"
ASSETS = Path(io.__file__).parents[1] / "assets"
real = pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data, which is not part of the project")

# A tetrahedron facing outward, and a strip of two triangles.
TETRA = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32),
)
STRIP = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float64), np.array([[0, 1, 2], [2, 1, 3]], np.int32)


def body(**changes) -> dict:
    fields = {
        "vertices": TETRA[0],
        "faces": TETRA[1],
        "joints": np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0.0]]),
        "parents": np.array([-1, 0, 1]),
        "blend_weights": np.array([[1, 0, 0], [0.5, 0.5, 0], [0, 0.25, 0.75], [0, 0, 1.0]]),
        "joint_names": np.array(["hips", "spine", "head"]),
    }
    return {k: v for k, v in (fields | changes).items() if v is not None}


def garment(**changes) -> dict:
    return {"vertices": STRIP[0], "faces": STRIP[1], "uv": STRIP[0][:, :2], "group_pins": np.array([3, 1, 1])} | changes


def motion(**changes) -> dict:
    rng = np.random.default_rng(0)
    fields = {
        "poses": rng.normal(size=(5, 3, 3)),
        "trans": rng.normal(size=(5, 3)),
        "fps": np.float64(30),
        "joint_names": np.array(["hips", "spine", "head"]),
    }
    return {k: v for k, v in (fields | changes).items() if v is not None}


def animation(**changes) -> dict:
    return {
        "vertices": np.stack([STRIP[0], STRIP[0] + 1]).astype(np.float32),
        "faces": STRIP[1],
        "fps": np.float64(25),
    } | changes


def save(path: Path, fields: dict) -> Path:
    if path.suffix == ".h5":
        import h5py

        with h5py.File(path, "w") as file:
            for name, value in fields.items():
                file[name] = np.asarray(value).astype("S") if np.asarray(value).dtype.kind == "U" else value
    else:
        np.savez(path, **fields)
    return path


OBJ = """\
# a quad, a triangle by negative numbers, and things to pass over
mtllib none.mtl
o shirt
v 0 0 0 1.0
v 1 0 0 0.5 0.5 0.5
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
usemtl cloth
s off
f 1/1/1 2/2/1 \\
  3/3/1 4/4/1
v 0.5 2 0
vt 0.5 2
f -2/-2 -3/-3/1 -1/5
l 1 2
"""

BVH = """\
HIERARCHY
ROOT Hips
{
  OFFSET 0 90 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Left Arm
  {
    OFFSET 10 50 0
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 30 0 0
    }
  }
  JOINT Head { OFFSET 0 60 0 CHANNELS 1 Xrotation
    End Site { OFFSET 0 20 0 } }
}
MOTION
Frames: 2
Frame Time: 0.00833333
0 90 0  0 0 0  0 0 0  0
5 95 10  10 20 30  40 50 60  70
"""


# --- what is written comes back ---------------------------------------------------------------------------------------------


def test_body_dense_and_sparse_weights_agree(tmp_path):
    dense = io.read_body(save(tmp_path / "dense.npz", body()))
    pairs = {
        "weight_joints": np.array([[0, 0], [0, 1], [1, 2], [2, 2]], np.uint8),
        "weights": [[1, 0], [0.5, 0.5], [0.25, 0.75], [0.4, 0.6]],
    }
    sparse = io.read_body(save(tmp_path / "sparse.npz", body(blend_weights=None, **pairs)))
    np.testing.assert_allclose(dense.weights, body()["blend_weights"])
    np.testing.assert_allclose(sparse.weights, dense.weights)
    assert dense.joint_names == ("hips", "spine", "head") and dense.rest_rotations is None
    assert dense.faces.dtype == dense.parents.dtype == np.int32


@pytest.mark.parametrize(
    "parents",
    [
        np.array([-1, 0, 0]),
        np.array([0, 0, 0]),
        np.array([2**32 - 1, 0, 0]),
        np.array([2**32 - 1, 0, 0], np.uint32),
        np.array([255, 0, 0], np.uint8),
    ],
)
def test_every_spelling_of_the_root(tmp_path, parents):
    assert io.read_body(save(tmp_path / "b.npz", body(parents=parents))).parents.tolist() == [-1, 0, 0]


def test_body_keeps_single_precision_and_normalises_weights(tmp_path):
    weights = body()["blend_weights"].astype(np.float32) * np.float32(1.0005)
    turns = Rotation.random(3, rng=np.random.default_rng(0)).as_matrix()
    record = io.read_body(
        save(tmp_path / "b.npz", body(blend_weights=weights, rest_rotations=turns, rest_pose=np.zeros((3, 3))))
    )
    assert record.weights.dtype == np.float32
    np.testing.assert_allclose(record.weights.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(record.rest_rotations, turns)


def test_garment_npz(tmp_path):
    record = io.read_garment(save(tmp_path / "g.npz", garment()))
    np.testing.assert_array_equal(record.vertices, STRIP[0])
    np.testing.assert_array_equal(record.faces, STRIP[1])
    np.testing.assert_array_equal(record.uv, STRIP[0][STRIP[1], :2])
    assert {k: v.tolist() for k, v in record.groups.items()} == {"pins": [1, 3]}


def test_garment_obj_keeps_order_fans_polygons_and_reads_uv(tmp_path):
    (tmp_path / "g.obj").write_text(OBJ)
    record = io.read_garment(tmp_path / "g.obj")
    np.testing.assert_array_equal(record.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]])
    assert record.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]
    np.testing.assert_array_equal(record.uv, np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 2]])[record.faces])


def test_garment_obj_with_a_texture_seam_is_not_split(tmp_path):
    (tmp_path / "g.obj").write_text(OBJ.replace("f -2/-2 -3/-3/1", "f -2/1 -3/-3/1"))
    record = io.read_garment(tmp_path / "g.obj")
    assert record.vertices.shape == (5, 3)
    np.testing.assert_array_equal(record.uv[2], [[0, 0], [1, 1], [0.5, 2]])  # face 1 has (0, 1) at the same vertex
    (tmp_path / "g.obj").write_text(OBJ.replace("f -2/-2 -3/-3/1 -1/5", "f -2 -3 -1"))
    record = io.read_garment(tmp_path / "g.obj")
    assert record.uv is None and "1 triangles have no texture coordinates" in record.notes[0]


def test_garment_obj_whose_faces_stand_above_their_vertices(tmp_path):
    lines = OBJ.replace("\\\n", "").splitlines()
    (tmp_path / "g.obj").write_text(OBJ)
    first = [line for line in lines if line.startswith("f 1")] + ["f 4/4 3/3 5/5"]
    (tmp_path / "above.obj").write_text("\n".join([*first, *(line for line in lines if not line.startswith("f"))]))
    found, expected = (io.read_garment(tmp_path / name) for name in ("above.obj", "g.obj"))
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    np.testing.assert_array_equal(found.faces, expected.faces)
    np.testing.assert_array_equal(found.uv, expected.uv)


@pytest.mark.parametrize("name", ["a", "a.glb", "a.usdc"])
def test_texture_seams_are_written_and_read_again(tmp_path, name):
    if name.endswith("usdc"):
        pytest.importorskip("pxr")
    x, faces = STRIP
    uv = np.random.default_rng(0).random((len(faces), 3, 2)).round(3)
    uv[0] = x[faces[0], :2]
    moving = np.stack([x, x + [0, 0, 0.5]]).astype(np.float32)
    io.write_animation(tmp_path / name, moving, faces, 25, uv=uv)
    record = io.read_garment(tmp_path / name / "frame_0000.obj" if name == "a" else tmp_path / name)
    np.testing.assert_array_equal(record.vertices[record.faces], x[faces])
    np.testing.assert_allclose(record.uv, uv, atol=1e-6)
    io.write_garment(tmp_path / "g.npz", record)
    np.testing.assert_array_equal(io.read_garment(tmp_path / "g.npz").uv, record.uv)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb"])
def test_garment_through_trimesh(tmp_path, suffix):
    import trimesh

    path = tmp_path / f"g{suffix}"
    trimesh.Trimesh(*STRIP, process=False).export(path)
    record = io.read_garment(path)
    order = [0, 1, 2, 3]
    np.testing.assert_allclose(record.vertices[order], STRIP[0])
    assert record.faces.tolist() == STRIP[1].tolist()


def test_garment_ply_polygons_are_cut(tmp_path):
    corners = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 2 0\n"
    head = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "g.ply").write_text(
        f"{head}element face 2\nproperty list uchar int vertex_indices\nend_header\n{corners}4 0 1 2 3\n3 3 2 4\n"
    )
    record = io.read_garment(tmp_path / "g.ply")
    assert len(record.faces) == 3
    np.testing.assert_allclose(record.vertices[4], [0.5, 2, 0])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_garment_ply_whose_header_has_lines_of_any_system(tmp_path, end):
    """The data begin with the byte of a newline."""
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    x = np.array([[np.frombuffer(b"\n\0\0\0", ">f4")[0], 0, 0], [1, 0, 0], [0, 1, 0]], ">f4")
    (tmp_path / "g.ply").write_bytes(head.replace("\n", end).encode() + x.tobytes() + struct.pack(">Biii", 3, 0, 1, 2))
    np.testing.assert_array_equal(io.read_garment(tmp_path / "g.ply").vertices, x)


def test_garment_stl_with_more_bytes_behind_its_triangles(tmp_path):
    import trimesh

    trimesh.Trimesh(*STRIP, process=False).export(tmp_path / "g.stl")
    data = (tmp_path / "g.stl").read_bytes()
    (tmp_path / "g.stl").write_bytes(data + b"\0\0")
    record = io.read_garment(tmp_path / "g.stl")
    np.testing.assert_allclose(record.vertices, STRIP[0])
    np.testing.assert_array_equal(record.faces, STRIP[1])


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_motion_round_trip(tmp_path, suffix):
    given = motion()
    record = io.read_motion(save(tmp_path / f"m{suffix}", given))
    np.testing.assert_array_equal(record.poses, given["poses"])
    np.testing.assert_array_equal(record.translation, given["trans"])
    assert record.fps == 30 and record.joint_names == ("hips", "spine", "head")


def test_motion_as_amass_has_it(tmp_path):
    given = motion()
    amass = {
        "poses": given["poses"].reshape(5, 9),
        "trans": given["trans"],
        "mocap_framerate": np.array(120.0),
        "gender": np.array("female"),
    }
    record = io.read_motion(save(tmp_path / "m.npz", amass | {"betas": np.array([{}], object)}), frame_range=(1, 4), scale=0.01)
    np.testing.assert_array_equal(record.poses, given["poses"][1:4])
    np.testing.assert_allclose(record.translation, given["trans"][1:4] / 100)
    assert record.fps == 120 and record.joint_names == ()


def test_motion_from_quaternions_of_either_sign_and_any_length(tmp_path):
    rng = np.random.default_rng(1)
    turns = Rotation.random(15, rng=rng)
    q = turns.as_quat(scalar_first=True).reshape(5, 3, 4) * rng.choice([-3.0, -1, 1, 0.1], (5, 3, 1))
    q[0, 0], q[0, 1] = [1, 0, 0, 0], [-1, 0, 0, 0]
    poses = io.read_motion(save(tmp_path / "m.npz", motion(poses=None, quaternions=q))).poses
    expected = Rotation.from_quat(q.reshape(-1, 4), scalar_first=True)
    np.testing.assert_allclose(poses.reshape(-1, 3), expected.as_rotvec(), atol=1e-12)
    assert (poses[0, :2] == 0).all() and np.linalg.norm(poses, axis=-1).max() <= np.pi + 1e-12
    single = io.read_motion(save(tmp_path / "s.npz", motion(poses=None, quaternions=q.astype(np.float32)))).poses
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, poses, atol=2e-6)


def test_a_broken_frame_outside_the_range_does_not_matter(tmp_path):
    poses = motion()["poses"]
    poses[3, 1, 2] = np.nan
    path = save(tmp_path / "m.npz", motion(poses=poses))
    assert len(io.read_motion(path, frame_range=(0, 3)).poses) == 3
    with pytest.raises(InputError, match=r"poses, frame 3, joint 1 \(spine\).*nan"):
        io.read_motion(path, frame_range=(2, None))


def test_bvh_channels_in_any_order(tmp_path):
    (tmp_path / "m.bvh").write_text(BVH)
    record = io.read_motion(tmp_path / "m.bvh", scale=0.01)
    assert record.joint_names == ("Hips", "Left Arm", "Head") and record.fps == 120
    np.testing.assert_allclose(record.translation, [[0, 0, 0], [0.05, 0.05, 0.1]], atol=1e-12)
    assert np.abs(record.poses[0]).max() == 0
    for joint, order, angles in ((0, "ZYX", [10, 20, 30]), (1, "YZX", [40, 50, 60]), (2, "X", [70])):
        expected = Rotation.from_euler(
            order, angles, degrees=True
        ).as_rotvec()  # capitals: about the turned axes, in file order
        np.testing.assert_allclose(record.poses[1, joint], np.ravel(expected), atol=1e-12)
    skeleton = read_bvh(tmp_path / "m.bvh")
    assert skeleton.parents.tolist() == [-1, 0, 0] and skeleton.offsets.tolist() == [[0, 90, 0], [10, 50, 0], [0, 60, 0]]


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".pc2", ".mdd", ".usdc"])
def test_animation_round_trip(tmp_path, suffix):
    given, path = animation(), tmp_path / "new" / "folder" / f"a{suffix}"
    io.write_animation(path, given["vertices"], given["faces"], 25)
    io.write_animation(path, given["vertices"], given["faces"], 25)  # takes the place of the first
    record = io.read_animation(path)
    np.testing.assert_array_equal(record.vertices, given["vertices"])
    assert record.vertices.dtype == np.float32 and record.faces.dtype == np.int32
    if suffix in (".pc2", ".mdd"):
        assert record.faces.shape == (0, 3) and (suffix == ".mdd" or np.isnan(record.fps))
        record = io.read_animation(path, faces=given["faces"], fps=25)
    np.testing.assert_array_equal(record.faces, given["faces"])
    assert record.fps == 25
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_pc2_bytes(tmp_path):
    io.write_animation(tmp_path / "a.pc2", animation()["vertices"], STRIP[1], 25)
    data = (tmp_path / "a.pc2").read_bytes()
    assert data[:32] == b"POINTCACHE2\0" + struct.pack("<iiffi", 1, 4, 0.0, 1.0, 2)
    np.testing.assert_array_equal(np.frombuffer(data[32:], "<f4"), animation()["vertices"].ravel())


@pytest.mark.parametrize("name", ["frames", "v1.5/"])
def test_animation_as_a_folder_of_obj(tmp_path, name):
    given = animation()
    for frames in (2, 1):  # the second time with fewer: none of the first may stay
        io.write_animation(f"{tmp_path}/{name}", given["vertices"][:frames], given["faces"], 25)
        files = sorted(p.name for p in (tmp_path / name).iterdir())
        assert files == ["frame_0000.obj", "frame_0001.obj"][:frames]
    record = io.read_garment(tmp_path / name / "frame_0000.obj")
    np.testing.assert_array_equal(record.vertices.astype(np.float32), given["vertices"][0])
    np.testing.assert_array_equal(record.faces, given["faces"])
    assert len(list(tmp_path.iterdir())) == 1


def test_a_folder_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "thesis.txt").write_text("years")
    with pytest.raises(InputError, match=r"thesis\.txt"):
        io.write_animation(tmp_path / "frames", animation()["vertices"], STRIP[1], 25)
    assert (tmp_path / "frames" / "thesis.txt").read_text() == "years"


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".pc2", ".mdd", ".glb", ".usda", ".usdz"])
def test_a_failed_write_leaves_the_old_file(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"a{suffix}"
    path.write_text("old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="No space left"):
        io.write_animation(path, animation()["vertices"], STRIP[1], 25)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_a_kill_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.npz"
    path.write_text("old")
    code = f"""
    import os, signal, numpy as np
    from ncs_jax import io
    from ncs_jax.io.tables import npz
    save = np.savez
    def half(stream, **arrays):
        save(stream, vertices=arrays["vertices"])
        stream.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    npz.np.savez = half
    io.write_animation({str(path)!r}, np.zeros((2, 3, 3)), np.zeros((0, 3), int), 30)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_text() == "old"


# --- what is broken is refused ----------------------------------------------------------------------------------------------


def nan(array, where):
    out = np.array(array, np.float64)
    out[where] = np.nan
    return out


BROKEN = {
    "body: face out of range": (io.read_body, body(faces=np.array([[0, 1, 4]])), r"faces, entry \[0, 2\].*0 to 3.*found 4"),
    "body: negative face": (io.read_body, body(faces=np.array([[0, -1, 2]])), "found -1"),
    "body: faces as floats": (io.read_body, body(faces=TETRA[1] * 1.0), "faces: whole numbers expected.*float64"),
    "body: no faces": (io.read_body, body(faces=np.zeros((0, 3), int)), "faces: at least one"),
    "body: no vertices": (io.read_body, body(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), int)), "vertices: at least one"),
    "body: nan": (io.read_body, body(vertices=nan(TETRA[0], (2, 1))), "vertices, vertex 2: finite numbers"),
    "body: infinite joint": (io.read_body, body(joints=np.full((3, 3), 1e39)), "joints, joint 0: finite"),
    "body: text": (io.read_body, body(vertices=np.full((4, 3), "a")), "vertices: an array of numbers"),
    "body: complex": (io.read_body, body(vertices=TETRA[0] * 1j), "plain numbers"),
    "body: objects": (io.read_body, body(vertices=TETRA[0].astype(object)), "pickle"),
    "body: missing": (io.read_body, body(joints=None), "joints: missing; add it; the file holds vertices"),
    "body: weights missing": (io.read_body, body(blend_weights=None), "blend_weights: missing"),
    "body: weights sum": (
        io.read_body,
        body(blend_weights=body()["blend_weights"] * 1.01),
        "blend_weights, vertex 0: .*sum to 1",
    ),
    "body: weights negative": (
        io.read_body,
        body(blend_weights=[[1, 0, 0], [1.5, -0.5, 0], [0, 0, 1], [0, 0, 1]]),
        "vertex 1: .*0 and above",
    ),
    "body: weights shape": (io.read_body, body(blend_weights=np.ones((4, 2)) / 2), r"blend_weights: .*\(4, 3\)"),
    "body: weight joint": (
        io.read_body,
        body(blend_weights=None, weight_joints=np.full((4, 1), 3), weights=np.ones((4, 1))),
        "weight_joints.*of the 3 joints",
    ),
    "body: two roots": (io.read_body, body(parents=np.array([-1, -1, 0])), "parents, joint 1 spine: one root"),
    "body: no root": (io.read_body, body(parents=np.array([1, 0, 0])), "one root"),
    "body: parent after child": (io.read_body, body(parents=np.array([-1, 2, 0])), "joint 1 spine.*found 2"),
    "body: own parent": (io.read_body, body(parents=np.array([-1, 1, 0])), "joint 1 spine.*found 1"),
    "body: parent below -1": (io.read_body, body(parents=np.array([-1, -2, 0])), "joint 1.*found -2"),
    "body: parents count": (io.read_body, body(parents=np.array([-1, 0])), r"parents: .*\(3,\)"),
    "body: names count": (io.read_body, body(joint_names=np.array(["a", "b"])), "joint_names"),
    "body: a name twice": (io.read_body, body(joint_names=np.array(["a", "b", "a"])), "joint_names.*'a'"),
    "body: posed": (io.read_body, body(rest_pose=np.ones((3, 3))), "rest_pose: a rest pose of zeros"),
    "body: rest rotations": (io.read_body, body(rest_rotations=np.full((3, 3, 3), 0.5)), "rest_rotations, joint 0: rotation"),
    "garment: empty": (
        io.read_garment,
        garment(vertices=np.zeros((0, 3)), faces=np.zeros((0, 3), int)),
        "a mesh with vertices",
    ),
    "garment: no faces": (io.read_garment, garment(faces=np.zeros((0, 3), int)), "faces: a mesh with"),
    "garment: non-manifold": (
        io.read_garment,
        garment(vertices=np.eye(5)[:, :3], faces=np.array([[0, 1, 2], [1, 0, 3], [1, 0, 4]])),
        "vertices 0 and 1 join 3 .*faces 0, 1, 2",
    ),
    "garment: orientation": (
        io.read_garment,
        garment(faces=np.array([[0, 1, 2], [1, 2, 3]])),
        "both run from vertex 1 to 2.*faces 0 and 1.*recalculate normals",
    ),
    "garment: face out of range": (io.read_garment, garment(faces=np.array([[0, 1, 9]])), "faces, entry.*found 9"),
    "garment: a corner twice": (
        io.read_garment,
        garment(faces=np.array([[0, 1, 2], [2, 1, 1]])),
        "faces, face 1: three different",
    ),
    "garment: loose vertices": (io.read_garment, garment(vertices=np.eye(7)[:, :3]), "3 loose, first: 4, 5, 6"),
    "garment: nan": (io.read_garment, garment(vertices=nan(STRIP[0], (3, 0))), "vertices, vertex 3"),
    "garment: group": (io.read_garment, garment(group_pins=np.array([4])), "group_pins, entry.*found 4"),
    "garment: uv": (io.read_garment, garment(uv=np.zeros((3, 2))), r"uv: .*\(4, 2\)"),
    "motion: nan": (
        io.read_motion,
        motion(poses=nan(motion()["poses"], (2, 1, 0))),
        r"poses, frame 2, joint 1 \(spine\): finite",
    ),
    "motion: nan translation": (io.read_motion, motion(trans=nan(motion()["trans"], (4, 0))), "trans, frame 4: finite"),
    "motion: joint count": (io.read_motion, motion(joint_names=np.array(["a", "b"])), "joint_names: .*(3,)"),
    "motion: columns": (io.read_motion, motion(poses=np.zeros((5, 10))), r"poses: .*\(T, 3 J\).* expected.*\(5, 10\)"),
    "motion: no joints": (io.read_motion, motion(poses=np.zeros((5, 0, 3))), r"poses: .*\(T, 3 J\).* expected.*\(5, 0, 3\)"),
    "motion: no columns": (io.read_motion, motion(poses=np.zeros((5, 0))), r"poses: .*\(T, 3 J\).* expected.*\(5, 0, 3\)"),
    "motion: no frames": (io.read_motion, motion(poses=np.zeros((0, 3, 3)), trans=np.zeros((0, 3))), "at least one frame"),
    "motion: no flat frames": (io.read_motion, motion(poses=np.zeros((0, 9)), trans=np.zeros((0, 3))), "at least one frame"),
    "motion: frames differ": (io.read_motion, motion(trans=np.zeros((4, 3))), r"trans: .*\(5, 3\)"),
    "motion: no translation": (io.read_motion, motion(trans=None), "trans: missing"),
    "motion: no rate": (io.read_motion, motion(fps=None), "fps: missing .or mocap_framerate"),
    "motion: zero rate": (io.read_motion, motion(fps=0), "fps: one number above 0.*found 0"),
    "motion: nan rate": (io.read_motion, motion(fps=np.nan), "fps: one number above 0.*nan"),
    "motion: many rates": (io.read_motion, motion(fps=np.ones(5)), "fps: one number"),
    "motion: rate as text": (io.read_motion, motion(fps="30"), "fps: one number"),
    "motion: zero quaternion": (
        io.read_motion,
        motion(poses=None, quaternions=np.eye(4)[np.zeros((5, 3), int)] * (np.arange(15).reshape(5, 3, 1) != 7)),
        r"quaternions, frame 2, joint 1 \(spine\): a quaternion that is not zero",
    ),
    "motion: nan quaternion": (
        io.read_motion,
        motion(poses=None, quaternions=np.full((5, 3, 4), np.nan)),
        "quaternions, frame 0, joint 0",
    ),
    "motion: both": (io.read_motion, motion(quaternions=np.ones((5, 3, 4))), "either poses or quaternions"),
    "motion: objects": (io.read_motion, motion(poses=np.array([None, {}], object)), "pickle"),
    "animation: nan": (io.read_animation, animation(vertices=nan(animation()["vertices"], (1, 2, 0))), "frame 1, vertex 2"),
    "animation: face": (io.read_animation, animation(faces=np.array([[0, 1, 4]])), "faces, entry"),
    "animation: shape": (io.read_animation, animation(vertices=STRIP[0]), r"vertices: .*\(T, V, 3\)"),
    "animation: empty": (io.read_animation, animation(vertices=np.zeros((0, 4, 3))), "at least one frame"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_fields(tmp_path, case):
    read, fields, message = BROKEN[case]
    path = save(tmp_path / "file.npz", fields)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("case", [c for c in BROKEN if c.startswith(("motion", "animation")) and "objects" not in c])
def test_broken_fields_in_hdf5(tmp_path, case):
    read, fields, message = BROKEN[case]
    with pytest.raises(InputError, match=message):
        read(save(tmp_path / "file.h5", fields))


def test_hdf5_with_a_foreign_name(tmp_path):
    import h5py

    with h5py.File(tmp_path / "m.h5", "w") as file:
        file[b"\xff"] = 1
    with pytest.raises(InputError, match="poses: missing"):
        io.read_motion(tmp_path / "m.h5")


def npy(header: str, data: bytes = b"", *, version: int = 1, size: int | None = None) -> bytes:
    text = header.encode()
    width = "<H" if version == 1 else "<I"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(width, len(text) if size is None else size) + text + data


def zipped(**members: bytes) -> bytes:
    out = bytes_io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return out.getvalue()


def npz_bytes(fields: dict) -> bytes:
    out = bytes_io.BytesIO()
    np.savez(out, **fields)
    return out.getvalue()


class Trap:
    """Unpickling this would end the test run."""

    def __reduce__(self):
        return os._exit, (3,)


HEAD = "{'descr': '%s', 'fortran_order': False, 'shape': %s, }"
DAMAGED = {
    "truncated.npz": (npz_bytes(motion())[:-200], "not a readable .npz"),
    "middle.npz": (npz_bytes(motion())[:300] + npz_bytes(motion())[420:], "not a readable .npz"),
    "not_a_zip.npz": (b"poses", "not a readable .npz"),
    "empty.npz": (b"", "an empty file"),
    "no_arrays.npz": (zipped(), "poses: missing .or quaternions.; add it; the file holds nothing"),
    "pickle.npz": (pickle.dumps({"poses": 1}), "not a readable .npz"),
    "trap.npz": (zipped(poses=pickle.dumps(Trap())), "not a readable .npz"),
    "trap_object.npz": (zipped(poses=npy(HEAD % ("|O", "(1,)"), pickle.dumps(Trap()))), "pickle"),
    "huge_shape.npz": (zipped(poses=npy(HEAD % ("<f8", "(1000000000000, 3, 3)"))), "at most 4294967296 bytes expected"),
    "large_shape.npz": (zipped(poses=npy(HEAD % ("<f8", "(10000000, 3, 3)"))), "more than a file of"),
    "short_data.npz": (zipped(poses=npy(HEAD % ("<f8", "(5, 3, 3)"), b"1234")), "360 bytes expected.*found '4 bytes'"),
    "long_data.npz": (zipped(poses=npy(HEAD % ("<f8", "(1, 1, 3)"), b"1" * 25)), "24 bytes expected"),
    "negative_shape.npz": (zipped(poses=npy(HEAD % ("<f8", "(-1, 3, 3)"))), "sizes of 0 and above"),
    "zero_of_huge.npz": (zipped(poses=npy(HEAD % ("<f8", f"(0, {10**30}, 3)"))), "not a readable .npz"),
    "huge_header.npz": (zipped(poses=npy(" " * 60000)), "a header of at most 10000 bytes"),
    "huge_header_2.npz": (zipped(poses=npy("", version=2, size=2**32 - 1)), "a header of at most 10000 bytes"),
    "code_header.npz": (zipped(poses=npy("__import__('os')._exit(3)")), "not a readable .npz"),
    "records.npz": (
        zipped(poses=npy("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }", b"1" * 8)),
        "plain numbers",
    ),
    "not_hdf5.h5": (b"poses", "not a readable HDF5"),
    "truncated.h5": (b"\x89HDF\r\n\x1a\n" + b"\0" * 100, "not a readable HDF5"),
    "empty.h5": (b"", "an empty file"),
    "m.xyz": (b"1", "one of .npz, .h5, .hdf5, .bvh, .glb, .gltf, .vrm, .vrma, .fbx expected"),
    "m": (b"1", "found 'no suffix'"),
    "words.bvh": (b"hello", "HIERARCHY and then MOTION"),
    "binary.bvh": (bytes(range(256)) * 4, "HIERARCHY and then MOTION"),
    "open_brace.bvh": (BVH.replace("}\nMOTION", "MOTION").encode(), "line 16: .*a closing brace expected .found 'the end'."),
    "extra.bvh": (BVH.replace("}\nMOTION", "} }\nMOTION").encode(), "line 17: .*found '}'"),
    "channel.bvh": (BVH.replace("Yrotation Zrotation", "Yrotation Wrotation").encode(), "line 9: .*found 'Wrotation'"),
    "channels.bvh": (BVH.replace("CHANNELS 3", "CHANNELS 2000000000").encode(), "line 9: at most 6 channels"),
    "offset.bvh": (BVH.replace("OFFSET 10 50", "OFFSET 10 fifty").encode(), "line 8: a finite number expected"),
    "no_offset.bvh": (BVH.replace("    OFFSET 10 50 0\n", "").encode(), "an OFFSET for each joint.*Left Arm"),
    "twice.bvh": (BVH.replace("Head", "Hips").encode(), "a different name for each joint"),
    "short.bvh": (BVH[: BVH.rindex("0 90 0")].encode(), "2 frames of 10 channels expected, one on each line.*found '0 numbers"),
    "wide.bvh": (BVH.replace("0 90 0  0", "0 90 0 0  0").encode(), "2 frames of 10 channels expected.*a line of 11"),
    "frames.bvh": (BVH.replace("Frames: 2", "Frames: two").encode(), "Frames: a whole number expected"),
    "time.bvh": (BVH.replace("0.00833333", "0").encode(), "Frame Time: seconds above 0"),
    "time_nan.bvh": (BVH.replace("0.00833333", "nan").encode(), "Frame Time: seconds above 0"),
    "word.bvh": (BVH.replace(" 70", " x70").encode(), "MOTION, frame 1, Xrotation of Head: numbers expected"),
    "nan.bvh": (BVH.replace(" 70", " nan").encode(), r"poses, frame 1, joint 2 \(Head\): finite"),
    "inf_position.bvh": (BVH.replace("5 95 10", "5 inf 10").encode(), "trans, frame 1: finite"),
    "stretch.bvh": (BVH.replace("1 Xrotation", "1 Yposition").encode(), "joint Head: bones of fixed length"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_motions(tmp_path, name):
    data, message = DAMAGED[name]
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        io.read_motion(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


PLY = b"""ply
format ascii 1.0
element vertex 5
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 0
0 1 0
0.5 2 0
4 0 1 2 3
3 3 2 4
"""
USDA = b"""#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Y"
)
def Mesh "m"
{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 3, 2]
}
"""
GARMENTS = {
    "empty.obj": (b"", "an empty file"),
    "no_mesh.obj": (b"# nothing\n", "a mesh with vertices and triangles"),
    "corner.obj": (OBJ.replace("1/1/1 2/2/1", "1/1/1 9/2/1").encode(), "faces, line 16: a vertex from 1 to 5 .*found 9"),
    "zero.obj": (OBJ.replace("1/1/1 2/2/1", "0/1/1 2/2/1").encode(), "faces, line 16: .*found 0"),
    "before.obj": (OBJ.replace("f -2/-2", "f -9/-2").encode(), "faces, line 19: .*found -9"),
    "texture.obj": (OBJ.replace("1/1/1 2/2/1", "1/1/1 2/8/1").encode(), "a texture coordinate from 1 to 5"),
    "word.obj": (OBJ.replace("1/1/1 2/2/1", "1/1/1 two").encode(), "v/vt/vn expected.*two"),
    "number.obj": (OBJ.replace("v 1 1 0", "v 1 l 0").encode(), "line 6: 3 finite numbers expected"),
    "two.obj": (OBJ.replace("v 1 1 0", "v 1 1").encode(), "line 6: 3 finite numbers expected"),
    "line.obj": (OBJ.replace("f -2/-2 -3/-3/1 -1/5", "f 1 2").encode(), "line 19: three corners"),
    "nan.obj": (OBJ.replace("v 1 1 0", "v 1 nan 0").encode(), "line 6: 3 finite numbers expected .found 'v 1 nan 0'"),
    "huge.obj": (OBJ.replace("v 1 1 0", "v 1 1e40 0").encode(), "line 6: 3 finite"),
    "nan_vt.obj": (OBJ.replace("vt ", "vt nan ", 1).encode(), "line 8: 2 finite numbers expected"),
    "words.ply": (b"hello", "a header from ply to end_header"),
    "words.glb": (b"hello", "that begins with .glTF. expected"),
    "empty.stl": (b"", "an empty file"),
    "words.stl": (b"hello", "vertices: a mesh with vertices and triangles"),
    "g.dae": (b"hello", "one of .npz, .ply, .stl, .obj, .glb, .gltf, .vrm, .fbx, .usd, .usdc, .usda, .usdz expected"),
    "count.ply": (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n"
        b"property float x\nproperty float y\nproperty float z\n"
        b"element face 4000000000\nproperty list uchar int vertex_indices\nend_header\n" + b"1" * 64,
        "48000000000 bytes more expected, as the header says .found '64 bytes'",
    ),
    "line.ply": (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "a line of a .ply header.*vertex many"),
    "format.ply": (b"ply\nelement vertex 0\nend_header\n", "header: a format expected"),
    "cut.ply": (PLY[:-4], "face, row 1: 3 numbers more|3 numbers more expected"),
    "fraction.ply": (PLY.replace(b"3 3 2 4", b"3 3 2 3.5"), "face.vertex_indices: whole numbers"),
    "corner.ply": (PLY.replace(b"3 3 2 4", b"3 3 2 5"), "face.vertex_indices, entry .6.: numbers from 0 to 4.*found 5"),
    "two.ply": (PLY.replace(b"3 3 2 4", b"2 3 2"), "faces, face 1: polygons of three corners or more.*'2 corners'"),
    "no_z.ply": (PLY.replace(b"property float z", b"property float w"), "vertex.z: missing"),
    "word.ply": (PLY.replace(b"0.5 2 0", b"0.5 two 0"), "not a readable .ply"),
    "nan.ply": (PLY.replace(b"0.5 2 0", b"0.5 nan 0"), "vertices, vertex 4: finite"),
    "crossing.obj": (b"v 0 0 0\nv 3 0 0\nv 0 1 0\nv 2 1 0\nf 1 2 3 4\n", "faces, face 0: a polygon that does not cross itself"),
    "words.usda": (b"hello", "not a readable USD file"),
    "words.usdc": (b"PXR-USDC hello", "not a readable USD file"),
    "words.usdz": (b"hello", "not a readable USD file"),
    "empty.usd": (b"", "an empty file"),
    "nothing.usda": (b"#usda 1.0\n", "prims: a mesh expected"),
    "no_points.usda": (b'#usda 1.0\ndef Mesh "m" {}\n', "/m has no points"),
    "corner.usda": (USDA.replace(b"0, 1, 3, 2]", b"0, 1, 3, 4]"), "/m.faceVertexIndices, entry .3.: numbers from 0 to 3"),
    "counts.usda": (USDA.replace(b"[4]", b"[5]"), "4 corners in all .found '5 corners'"),
    "axis.usda": (USDA.replace(b'"Y"', b'"Q"'), "upAxis: X, Y or Z expected"),
    "unit.usda": (USDA.replace(b"Unit = 1", b"Unit = 0"), "metersPerUnit: a number above 0"),
    "large.usda": (USDA.replace(b"Unit = 1", b"Unit = 1e300"), "vertices, vertex 0: finite"),
    "nan.usda": (USDA.replace(b"(1, 1, 0)", b"(1, nan, 0)"), "/m.points, frame 0, vertex 3: finite"),
    "count.stl": (b" " * 80 + struct.pack("<I", 2**32 - 1) + b"1" * 50, "vertices: a mesh with vertices and triangles"),
}


@pytest.mark.parametrize("name", GARMENTS)
def test_damaged_garments(tmp_path, name):
    data, message = GARMENTS[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message):
        io.read_garment(tmp_path / name)


PC2 = b"POINTCACHE2\0" + struct.pack("<iiffi", 1, 4, 0.0, 1.0, 2) + animation()["vertices"].tobytes()


MDD = struct.pack(">ii2f24f", 2, 4, 0.0, 0.04, *animation()["vertices"].ravel())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (MDD[:6], "header"),
        (MDD[:-4], "2 frames of 4 points, 108 bytes"),
        (MDD + b"more", "2 frames of 4 points"),
        (struct.pack(">ii", 2**31 - 1, 2**31 - 1) + MDD[8:], "2147483647 frames"),
        (struct.pack(">ii", -2, -4) + MDD[8:], "-2 frames"),
        (MDD[:12] + struct.pack(">f", -1) + MDD[16:], "times that rise in even steps"),
        (MDD[:12] + struct.pack(">f", np.nan) + MDD[16:], "times"),
        (MDD[:-4] + struct.pack(">f", np.inf), "frame 1, vertex 3"),
    ],
)
def test_damaged_mdd(tmp_path, data, message):
    (tmp_path / "a.mdd").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.mdd: .*{message}"):
        io.read_animation(tmp_path / "a.mdd")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"POINT", "header: a POINTCACHE2 header"),
        (b"POINTCACHE3\0" + PC2[12:], "header: a POINTCACHE2 header"),
        (PC2[:-4], "header: version 1 with 96 bytes .* 92 bytes"),
        (PC2 + b"more", "header: version 1 with 96 bytes .* 100 bytes"),
        (PC2[:12] + struct.pack("<iiffi", 1, 2**31 - 1, 0.0, 1.0, 2**31 - 1) + PC2[32:], "header: .*2147483647 samples"),
        (PC2[:12] + struct.pack("<iiffi", 1, -4, 0.0, 1.0, -2) + PC2[32:], "header: .*-2 samples of -4 points"),
        (PC2[:-4] + struct.pack("<f", np.nan), "vertices, frame 1, vertex 3: finite"),
    ],
)
def test_damaged_pc2(tmp_path, data, message):
    (tmp_path / "a.pc2").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.pc2: {message}"):
        io.read_animation(tmp_path / "a.pc2")


@pytest.mark.parametrize("read", [io.read_body, io.read_garment, io.read_motion, io.read_animation])
def test_missing_files_and_folders(tmp_path, read):
    for path, message in (
        (tmp_path / "none.npz", "no such file"),
        (tmp_path, "a file expected|found .a folder"),
        (tmp_path / "a\0b.npz", "no such file"),
    ):
        with pytest.raises(InputError, match=message):
            read(path)
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(InputError, match=r"folder\.npz: a file expected"):
        read(str(tmp_path / "folder.npz"))


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.stl", "a.glb", "a.fbx", "a.npz"])
def test_a_picture_by_another_name(tmp_path, name):
    Image.new("RGB", (20, 20)).save(tmp_path / name, "PNG")
    with pytest.raises(InputError, match=rf"{name}: a \.\w+ expected, by what is in it \(found 'a PNG picture'\)"):
        io.read_garment(tmp_path / name)


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.pc2", "a.mdd", "a.glb", "a.usdc", "a", "deep/a.npz"])
def test_unwritable_places(tmp_path, name):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(InputError, match="cannot be written"):
        io.write_animation(tmp_path / "file" / name, animation()["vertices"], STRIP[1], 25)
    assert (tmp_path / "file").read_text() == "not a folder"


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("a.mp4", {}, "one of .npz, .h5, .hdf5, .pc2, .mdd, .usd, .* or a folder, expected"),
        ("a.npz", {"vertices": STRIP[0]}, r"\(T, V, 3\)"),
        ("a.npz", {"vertices": nan(animation()["vertices"], (1, 3, 2))}, "frame 1, vertex 3"),
        ("a.npz", {"vertices": np.zeros((0, 4, 3))}, "at least one frame"),
        ("a.npz", {"faces": np.array([[0, 1, 4]])}, "faces, entry"),
        ("a.npz", {"fps": 0}, "fps"),
        ("a\0.npz", {}, "a file name"),
    ],
)
def test_unwritable_arrays(tmp_path, name, changes, message):
    with pytest.raises(InputError, match=message):
        io.write_animation(tmp_path / name, **animation(**changes))
    assert not list(tmp_path.iterdir())


def test_a_folder_does_not_become_a_file_nor_a_file_a_folder(tmp_path):
    (tmp_path / "a.npz").mkdir()
    (tmp_path / "frames").write_text("mine")
    for name, message in (("a.npz", r"a\.npz: a file expected .*a folder"), ("frames", "frames: a folder expected .*a file")):
        with pytest.raises(InputError, match=message):
            io.write_animation(tmp_path / name, **animation())
    assert (tmp_path / "a.npz").is_dir() and (tmp_path / "frames").read_text() == "mine"


@pytest.mark.parametrize("given", [(0, 6), (2, 2), (-1, 3), (5, None)])
def test_frame_ranges_that_do_not_fit(tmp_path, given):
    with pytest.raises(InputError, match="frames: 0 <= start"):
        io.read_motion(save(tmp_path / "m.npz", motion()), frame_range=given)


def flipped(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice([1, 2, 8])):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out if rng.random() < 0.8 else out[: rng.randrange(len(out))])


def flipped_inside(fields: dict, rng: random.Random) -> bytes:
    """A sound zip of one damaged array among sound ones: a flip in the zip itself seldom passes its checksum."""
    members = {}
    for name, value in fields.items():
        out = bytes_io.BytesIO()
        np.save(out, value)
        members[name] = out.getvalue()
    chosen = rng.choice(sorted(members))
    return zipped(**members | {chosen: flipped(members[chosen], rng)})


def meshes(suffix: str) -> bytes:
    import trimesh

    data = trimesh.Trimesh(*STRIP, process=False).export(file_type=suffix)
    return data if isinstance(data, bytes) else str(data).encode()


def written(suffix: str, fields: dict) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        io.write_animation(Path(folder) / f"a.{suffix}", **fields)
        return (Path(folder) / f"a.{suffix}").read_bytes()


def hdf5_bytes(fields: dict) -> bytes:
    import h5py

    out = bytes_io.BytesIO()
    with h5py.File(out, "w") as file:
        for name, value in fields.items():
            file[name] = np.asarray(value).astype("S") if np.asarray(value).dtype.kind == "U" else value
    return out.getvalue()


def glb_bytes() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return write_glb(Path(folder) / "hero.glb").read_bytes()


def gltf_bytes() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = write_glb(Path(folder) / "hero.glb")
        return changed(path, Path(folder) / "text.gltf", lambda tree: None).read_bytes()


# kind: reader, suffix, and a sound file's bytes; None: an .npz of which one array is damaged
READERS = {
    "zip": (io.read_motion, "npz", lambda: npz_bytes(motion())),
    "body": (io.read_body, "npz", None),
    "garment": (io.read_garment, "npz", None),
    "motion": (io.read_motion, "npz", None),
    "animation": (io.read_animation, "npz", None),
    "hdf5 motion": (io.read_motion, "h5", lambda: hdf5_bytes(motion())),
    "hdf5 animation": (io.read_animation, "h5", lambda: hdf5_bytes(animation())),
    "obj": (io.read_garment, "obj", lambda: OBJ.encode()),
    "ply": (io.read_garment, "ply", lambda: meshes("ply")),
    "ply text": (io.read_garment, "ply", lambda: PLY),
    "usda": (io.read_garment, "usda", lambda: USDA),
    "usdc": (io.read_animation, "usdc", lambda: written("usdc", animation())),
    "mdd": (io.read_animation, "mdd", lambda: written("mdd", animation())),
    "stl": (io.read_garment, "stl", lambda: meshes("stl")),
    "glb": (io.read_garment, "glb", lambda: meshes("glb")),
    "bvh": (io.read_motion, "bvh", lambda: BVH.encode()),
    "pc2": (io.read_animation, "pc2", lambda: PC2),
    "glb body": (io.read_body, "glb", lambda: glb_bytes()),
    "glb motion": (io.read_motion, "glb", lambda: glb_bytes()),
    "gltf": (io.read_motion, "gltf", lambda: gltf_bytes()),
    "fbx body": (io.read_body, "fbx", lambda: fbx_files.binary(Hero("Y up, cm").tree())),
    "fbx motion": (io.read_motion, "fbx", lambda: fbx_files.binary(Hero("Z up, inches").tree())),
    "fbx text": (io.read_motion, "fbx", lambda: fbx_files.text(Hero("Z up, inches").tree())),
    "scene": (load_scene, "toml", lambda: template().encode()),
}
FIELDS = {"body": body, "garment": garment, "motion": motion, "animation": animation}


@pytest.mark.parametrize("kind", READERS)
def test_random_damage_is_read_or_refused(tmp_path, kind):
    rng, (read, suffix, sound) = random.Random(kind), READERS[kind]
    # USD is read by a program of its own, which takes a third of a second.
    refused, whole = 0, None if sound is None else sound()
    tracemalloc.start()
    for case in range((1000 if THOROUGH else 50) if "usd" not in kind else 200 if THOROUGH else 20):
        path = tmp_path / f"{case}.{suffix}"
        path.write_bytes(flipped_inside(FIELDS[kind](), rng) if whole is None else flipped(whole, rng))
        before, began = path.read_bytes(), time.monotonic()
        try:
            read(path)
        except InputError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
        assert time.monotonic() - began < 10 and path.read_bytes() == before
        path.unlink()
    assert refused > 5 and tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()


# --- real files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(ASSETS.glob("*.npz")), ids=lambda p: p.stem)
def test_packaged_files(path):
    if path.stem == "body":
        assert len(io.read_body(path).joint_names) == 31
    elif path.stem.startswith(("tshirt", "skirt", "dress")):
        assert ("pins" in io.read_garment(path).groups) == path.stem.startswith("skirt")
    else:
        assert io.read_motion(path).poses.shape[1:] == (31, 3)


@real
def test_smpl_files():
    folder = DATA / "smpl_research_only"
    record = io.read_body(folder / "body.npz")
    assert record.vertices.shape == (6890, 3) and record.weights.shape == (6890, 24) and record.parents[0] == -1
    shirt = io.read_garment(folder / "tshirt.obj")
    assert shirt.vertices.shape == (4424, 3) and shirt.faces.shape == (8710, 3) and shirt.uv is None
    walk = io.read_motion(folder / "01_01.npz", frame_range=(0, 200))
    assert walk.poses.shape == (200, 24, 3) and walk.fps == 30


def joints_of(path: Path, frame: int) -> dict[str, np.ndarray]:
    """Where the joints of a .bvh stand: forward kinematics written out, from what the motion reader returns."""
    skeleton, record = read_bvh(path), io.read_motion(path)
    turns = Rotation.from_rotvec(record.poses[frame]).as_matrix()
    world, place = turns.copy(), np.zeros_like(skeleton.offsets)
    place[0] = skeleton.offsets[0] + record.translation[frame]
    for j, p in enumerate(skeleton.parents[1:], 1):
        world[j] = world[p] @ turns[j]
        place[j] = place[p] + world[p] @ skeleton.offsets[j]
    return {n.lower(): x for n, x in zip(record.joint_names, place, strict=True)}


@real
@pytest.mark.parametrize(("name", "metres"), [("02_02", 0.01), ("03_03", 0.01), ("10_01", 0.0254)])
def test_cmu_bvh_stands_upright(name, metres):
    path = DATA / "cmu_bvh" / f"{name}.bvh"
    at = joints_of(path, 1)
    hips, head = at["hip" if "hip" in at else "hips"], at["head"]
    feet = [at[n] for n in ("lfoot", "rfoot", "leftankle", "rightankle") if n in at]
    shoulders = [at[n] for n in ("lshldr", "rshldr", "leftshoulder", "rightshoulder") if n in at]
    assert len(feet) == len(shoulders) == 2
    ankle = min(f[1] for f in feet)
    assert 1.2 < (head[1] - ankle) * metres < 1.8  # m
    assert 0.6 < (hips[1] - ankle) * metres < 1.1
    assert all(hips[1] < s[1] < head[1] + 0.1 / metres for s in shoulders)
    assert np.linalg.norm((head - hips)[[0, 2]]) < 0.35 * (head - hips)[1]  # the trunk leans by less than 20 degrees
    assert 0.2 < np.linalg.norm(shoulders[0] - shoulders[1]) * metres < 0.5
    assert -0.1 < ankle * metres < 0.3  # it walks on the ground
    record = io.read_motion(path, frame_range=(1, None), scale=metres)
    speed = np.linalg.norm(np.diff(record.translation, axis=0), axis=1) * record.fps
    assert 0.5 < speed.max() < 5  # m/s


def test_only_numpy_and_below():
    """Nothing in io imports the rest of the package but errors, nor trimesh, h5py, pxr and scipy outside a function."""
    for path in Path(io.__file__).parent.glob("*.py"):
        for node in ast.parse(path.read_text()).body:
            names = [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in getattr(node, "names", [])]
            for name in filter(None, names):
                assert name.split(".")[0] not in ("trimesh", "h5py", "jax", "pxr", "scipy"), path.name
                assert not name.startswith("ncs_jax") or name.startswith(("ncs_jax.io", "ncs_jax.errors")), path.name

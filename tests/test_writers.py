"""Animations for other programs: what is written is read back by a reader that knows the format and not the writer."""

from __future__ import annotations

import json
import struct
import tracemalloc
from dataclasses import replace

import h5py
import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io.animation.glb import write_glb
from ncs_jax.io.mesh import usd
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.objects import objects_of

from . import characters
from .shapes import tube

USD = ["usd", "usdc", "usda", "usdz"]


def walk(frames=31, around=40, rings=12):
    """A tube that wobbles while it walks 8 m: (T, V, 3) float32, faces and its rest shape."""
    rest, faces = tube(around, rings, radius=0.3, height=0.6)
    rest = rest + [0, 0.8, 0]
    t = np.linspace(0, 1, frames)[:, None, None]
    x = rest + 0.1 * np.sin(9 * t + 7 * rest) * np.minimum(5 * t, 1) + t * [1.0, 0.3, 8.0]
    return x.astype(np.float32), faces, rest.astype(np.float32)


# --- point caches, from the description of their bytes ----------------------------------------------------------------------


def pc2(data: bytes):
    """Positions (T, V, 3): char[12] name, int32 version, points, float32 start, rate, int32 samples, then float32 x y z."""
    signature, version, points, start, rate, samples = struct.unpack_from("<12siiffi", data)
    assert (signature, version, start, rate) == (b"POINTCACHE2\0", 1, 0.0, 1.0)
    numbers = struct.unpack_from(f"<{3 * points * samples}f", data, 32)
    assert len(data) == 32 + 12 * points * samples
    return np.array(numbers).reshape(samples, points, 3)


def mdd(data: bytes):
    """Times (T,) and positions (T, V, 3): int32 frames, points, float32 times, then float32 x y z, all big-endian."""
    frames, points = struct.unpack_from(">ii", data)
    times = struct.unpack_from(f">{frames}f", data, 8)
    numbers = struct.unpack_from(f">{3 * points * frames}f", data, 8 + 4 * frames)
    assert len(data) == 8 + 4 * frames + 12 * points * frames
    return np.array(times), np.array(numbers).reshape(frames, points, 3)


def test_point_caches_are_exact(tmp_path):
    x, faces, rest = walk()
    for name in ("a.pc2", "a.mdd"):
        io.write_animation(tmp_path / name, x, faces, 24, rest=rest)
    np.testing.assert_array_equal(pc2((tmp_path / "a.pc2").read_bytes()), x)
    times, positions = mdd((tmp_path / "a.mdd").read_bytes())
    np.testing.assert_array_equal(positions, x)
    np.testing.assert_allclose(times, np.arange(31) / 24, rtol=1e-6)


@pytest.mark.parametrize("fps", [1, 23.976, 29.97, 30, 120])
def test_mdd_tells_the_frame_rate(tmp_path, fps):
    x, faces, _ = walk(frames=241, around=5, rings=2)
    io.write_animation(tmp_path / "a.mdd", x, faces, fps)
    assert io.read_animation(tmp_path / "a.mdd").fps == fps
    io.write_animation(tmp_path / "a.mdd", x[:1], faces, fps)
    assert np.isnan(io.read_animation(tmp_path / "a.mdd").fps)


@pytest.mark.parametrize("suffix", ["obj", "ply", "usda"])
def test_a_cache_fits_the_file_that_the_garment_came_from(tmp_path, suffix):
    """Blender pairs a cache with a mesh by vertex number: that of the user's file, whatever its faces and seams."""
    rng, n = np.random.default_rng(0), 7
    y, x = np.mgrid[:n, :n] * 0.1
    sheet, order = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), rng.permutation(n * n)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.argsort(order)[np.stack([a, a + 1, a + n + 1, a + n], axis=1)]
    quads = rng.permutation(quads)  # faces name vertices in no order
    path, places = tmp_path / f"user.{suffix}", sheet[order]
    if suffix == "obj":
        lines = ["v {:.6f} {:.6f} {:.6f}".format(*p) for p in places] + ["vt 0 0", "vt 1 0"]
        lines += ["f " + " ".join(f"{c + 1}/{1 + i % 2}" for i, c in enumerate(q)) for q in quads.tolist()]  # seams everywhere
        path.write_text("\n".join(lines) + "\n")
    elif suffix == "ply":
        head = ["ply", "format ascii 1.0", f"element vertex {n * n}", *(f"property float {c}" for c in "xyz")]
        head += [f"element face {len(quads)}", "property list uchar int vertex_indices", "end_header"]
        rows = [" ".join(map(str, p)) for p in places.tolist()] + ["4 " + " ".join(map(str, q)) for q in quads.tolist()]
        path.write_text("\n".join(head + rows) + "\n")
    else:
        usd_mesh(path, places, [4] * len(quads), quads.ravel())
    garment = io.read_garment(path)
    io.write_animation(tmp_path / "a.pc2", garment.vertices[None] + [[[0, 0, 1.0]]], garment.faces, 30)
    io.write_animation(tmp_path / "a.mdd", garment.vertices[None] + [[[0, 0, 1.0]]], garment.faces, 30)
    for positions in (pc2((tmp_path / "a.pc2").read_bytes()), mdd((tmp_path / "a.mdd").read_bytes())[1]):
        np.testing.assert_allclose(positions[0], places + [0, 0, 1], atol=1e-6)


# --- glTF, from its specification -------------------------------------------------------------------------------------------


class Gltf:
    """A .glb of one mesh with one animation: what section 3 of the specification says of accessors, samplers and morphing."""

    def __init__(self, data: bytes) -> None:
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.json = json.loads(data[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", data, 20 + size)
        self.bytes = data[28 + size :]
        assert kind == b"BIN\0" and rest == len(self.bytes) == self.json["buffers"][0]["byteLength"]
        (self.mesh,) = self.json["meshes"]
        (self.primitive,) = self.mesh["primitives"]

    def accessor(self, number: int) -> np.ndarray:
        a = self.json["accessors"][number]
        view = self.json["bufferViews"][a["bufferView"]]
        kind = np.dtype({5123: "<u2", 5125: "<u4", 5126: "<f4"}[a["componentType"]])
        width = {"SCALAR": 1, "VEC3": 3}[a["type"]]
        step, offset = view.get("byteStride", kind.itemsize * width), a.get("byteOffset", 0)
        assert (view["byteOffset"] + offset) % kind.itemsize == 0
        assert offset + step * (a["count"] - 1) + width * kind.itemsize <= view["byteLength"]
        table = np.ndarray((a["count"], width), kind, self.bytes, view["byteOffset"] + offset, (step, kind.itemsize))
        if "min" in a:
            assert a["min"] == table.min(axis=0).tolist() and a["max"] == table.max(axis=0).tolist()
        return table

    def weights(self, time: float) -> np.ndarray:
        (animation,) = self.json["animations"]
        (channel,), (sampler,) = animation["channels"], animation["samplers"]
        assert channel == {"sampler": 0, "target": {"node": 0, "path": "weights"}} and sampler["interpolation"] == "LINEAR"
        keys = self.accessor(sampler["input"])[:, 0].astype(float)
        values = self.accessor(sampler["output"]).reshape(len(keys), -1).astype(float)
        assert values.shape[1] == len(self.primitive["targets"])
        return np.array([np.interp(time, keys, column) for column in values.T])

    def at(self, time: float, attribute: str) -> np.ndarray:
        base = self.accessor(self.primitive["attributes"][attribute]).astype(float)
        moved = [
            w * self.accessor(t[attribute]) for w, t in zip(self.weights(time), self.primitive["targets"], strict=True) if w
        ]
        return base + sum(moved)


def test_glb_plays_every_frame(tmp_path):
    x, faces, _ = walk()
    io.write_animation(tmp_path / "a.glb", x, faces, 24)
    glb = Gltf((tmp_path / "a.glb").read_bytes())
    np.testing.assert_array_equal(glb.accessor(glb.primitive["indices"]).reshape(-1, 3), faces)
    keys = glb.accessor(glb.json["animations"][0]["samplers"][0]["input"])
    np.testing.assert_array_equal(keys[:, 0], (np.arange(len(x)) / 24).astype(np.float32))
    for t in range(len(x)):
        assert np.abs(glb.at(t / 24, "POSITION") - x[t]).max() < 1e-6
        np.testing.assert_allclose(glb.at(t / 24, "NORMAL"), vertex_normals(x[t], faces), atol=1e-6)
    between = glb.at(7.25 / 24, "POSITION")
    np.testing.assert_allclose(between, 0.75 * x[7] + 0.25 * x[8], atol=1e-5)
    assert glb.json["materials"][0]["doubleSided"]


def test_glb_is_no_larger_than_it_says(tmp_path):
    x, faces, _ = walk(frames=60)
    io.write_animation(tmp_path / "a.glb", x, faces, 24)
    data = 24 * x.shape[0] * x.shape[1] + 4 * len(x) ** 2 + 2 * faces.size
    assert data < (tmp_path / "a.glb").stat().st_size < data + 600 * len(x) + 2000


def test_glb_through_trimesh(tmp_path):
    """Whose reader ignores the morphing: the mesh as it stands is the first frame."""
    import trimesh

    x, faces, _ = walk(frames=3)
    io.write_animation(tmp_path / "a.glb", x, faces, 24)
    (mesh,) = trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()
    np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), x[0])
    np.testing.assert_array_equal(mesh.faces, faces)


def test_glb_of_one_frame_and_of_many_vertices(tmp_path):
    x, faces, _ = walk(frames=1, around=300, rings=220)
    io.write_animation(tmp_path / "a.glb", x, faces, 24)
    glb = Gltf((tmp_path / "a.glb").read_bytes())
    assert "targets" not in glb.primitive and "animations" not in glb.json and x.shape[1] > 2**16
    np.testing.assert_array_equal(glb.accessor(glb.primitive["attributes"]["POSITION"]), x[0])
    np.testing.assert_array_equal(glb.accessor(glb.primitive["indices"]).reshape(-1, 3), faces)


@pytest.mark.parametrize("rest_axes", [True, False])
def test_glb_with_the_body_that_wears_it(tmp_path, rest_axes):
    """As the specification skins it, and as the reader of characters takes it up again."""
    hero = characters.write_glb(tmp_path / "hero.glb")
    body, motion = io.read_body(hero), io.read_motion(hero)
    if not rest_axes:
        body = replace(body, rest_rotations=np.tile(np.eye(3), (3, 1, 1)), joint_names=())
    x, faces, _ = walk(frames=len(motion.poses))
    shown = body if rest_axes else replace(body, rest_rotations=None)
    io.write_animation(tmp_path / "a.glb", x, faces, motion.fps, worn_by=(shown, motion))
    ours = characters.posed(body, motion)
    theirs = characters.skinned(tmp_path / "a.glb", np.arange(len(x)) / motion.fps)
    assert np.ptp(ours, axis=0).max() > 0.1 and np.abs(ours - theirs).max() < 2e-6
    again, moved = io.read_body(tmp_path / "a.glb"), io.read_motion(tmp_path / "a.glb")
    assert again.joint_names == (body.joint_names or ("joint_0", "joint_1", "joint_2"))
    np.testing.assert_allclose(characters.posed(again, moved)[:, :, 1].max(axis=1), ours[:, :, 1].max(axis=1), atol=1e-5)


def test_a_body_of_many_joints_keeps_the_eight_that_count_most(tmp_path, rng):
    rest, faces = tube(8, 4)
    weights = rng.random((len(rest), 12)) ** 4
    weights /= weights.sum(axis=1, keepdims=True)
    joints = np.stack([np.zeros(12), np.linspace(0, 1, 12), np.zeros(12)], axis=1)
    body = io.BodyRecord(rest, faces, joints, np.arange(-1, 11), weights)
    motion = io.MotionRecord(0.2 * rng.standard_normal((2, 12, 3)), np.zeros((2, 3)), 30.0)
    io.write_animation(tmp_path / "a.glb", np.zeros((2, 3, 3)), [[0, 1, 2]], 30, worn_by=(body, motion))
    theirs = characters.skinned(tmp_path / "a.glb", [0, 1 / 30])
    least = np.sort(weights, axis=1)[:, -8, None]
    kept = np.where(weights >= least, weights, 0)
    kept /= kept.sum(axis=1, keepdims=True)
    ours = characters.posed(replace(body, weights=kept, rest_rotations=np.tile(np.eye(3), (12, 1, 1))), motion)
    assert np.abs(ours - theirs).max() < 2e-6


def test_no_other_format_holds_a_body(tmp_path):
    hero = characters.write_glb(tmp_path / "hero.glb")
    worn_by = io.read_body(hero), io.read_motion(hero)
    with pytest.raises(InputError, match=r"a\.npz: \.glb expected"):
        io.write_animation(tmp_path / "a.npz", np.zeros((13, 3, 3)), [[0, 1, 2]], 30, worn_by=worn_by)
    assert not (tmp_path / "a.npz").exists()


def test_a_glb_that_its_format_cannot_hold(tmp_path):
    huge = np.broadcast_to(np.float32(0), (50_000, 4_000, 3))
    with pytest.raises(InputError, match=r"a\.glb: vertices: at most 4294967295 bytes.*\.usdc"):
        write_glb(tmp_path / "a.glb", objects_of(["shirt"], (), huge, huge[0], np.array([[0, 1, 2]], np.int32), None), 30)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["mdd", "glb", "pc2"])
def test_writing_takes_the_memory_of_a_frame(tmp_path, suffix):
    x, faces, _ = walk(frames=200)
    io.write_animation(tmp_path / f"a.{suffix}", x[:2], faces, 24)
    tracemalloc.start()
    io.write_animation(tmp_path / f"a.{suffix}", x, faces, 24)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3.1 * x.nbytes  # the checks make a copy and look at it in double precision


# --- USD, through usd-core --------------------------------------------------------------------------------------------------


def usd_mesh(path, points, counts, corners, name="/cloth", stage=None):
    """A stage with a mesh, saved: the stage, which must be kept, and the mesh."""
    from pxr import Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(path)) if stage is None else stage
    mesh = UsdGeom.Mesh.Define(stage, name)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(points, np.float32)))
    mesh.CreateFaceVertexCountsAttr([int(c) for c in counts])
    mesh.CreateFaceVertexIndicesAttr([int(c) for c in corners])
    stage.GetRootLayer().Save()
    return stage, mesh


@pytest.mark.parametrize("suffix", USD)
def test_usd_as_usd_core_sees_it(tmp_path, suffix):
    from pxr import Usd, UsdGeom

    x, faces, rest = walk()
    io.write_animation(tmp_path / f"a.{suffix}", x, faces, 24, rest=rest)
    stage = Usd.Stage.Open(str(tmp_path / f"a.{suffix}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 30)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3} and mesh.GetSubdivisionSchemeAttr().Get() == "none"
    np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), faces)
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), rest)
    assert mesh.GetPointsAttr().GetTimeSamples() == list(range(31)) and mesh.GetNormalsInterpolation() == "vertex"
    for t in range(31):
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(t), x[t])
        np.testing.assert_array_equal(mesh.GetExtentAttr().Get(t), [x[t].min(axis=0), x[t].max(axis=0)])
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(t), vertex_normals(x[t], faces), atol=1e-6)
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(7.25), 0.75 * x[7] + 0.25 * x[8], atol=1e-5)
    assert [p.name for p in tmp_path.iterdir()] == [f"a.{suffix}"]


@pytest.mark.parametrize("suffix", USD)
def test_usd_comes_back(tmp_path, suffix):
    x, faces, rest = walk(frames=5)
    io.write_animation(tmp_path / f"a.{suffix}", x, faces, 24, rest=rest)
    record = io.read_animation(tmp_path / f"a.{suffix}")
    np.testing.assert_array_equal(record.vertices, x)
    np.testing.assert_array_equal(record.faces, faces)
    assert record.fps == 24
    np.testing.assert_array_equal(io.read_garment(tmp_path / f"a.{suffix}").vertices, rest)


def test_usd_of_another_program(tmp_path):
    """Centimetres, Z up, a sample in every second time code, a transform that moves, and quads."""
    from pxr import Gf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    square = np.array([[0, 0, 0], [100, 0, 0], [100, 0, 100], [0, 0, 100]], np.float32)
    _, mesh = usd_mesh(None, square, [4], range(4), stage=stage)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(48)
    move = UsdGeom.Xformable(mesh).AddTranslateOp()
    for t in range(3):
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(square * (1 + t)), 10 + 2 * t)
        move.Set(Gf.Vec3d(0, 0, 50 * t), 10 + 2 * t)
    stage.GetRootLayer().Save()
    record = io.read_animation(tmp_path / "a.usda")
    assert record.fps == 24 and record.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    for t in range(3):
        expected = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * (1 + t) + [0, 0.5 * t, 0]
        np.testing.assert_allclose(record.vertices[t], expected, atol=1e-6)


def test_usd_without_its_package(tmp_path, monkeypatch):
    monkeypatch.setattr(usd, "find_spec", lambda name: None)
    x, faces, _ = walk(frames=2)
    with pytest.raises(InputError, match=r"a\.usdc: the package usd-core.*pip install usd-core"):
        io.write_animation(tmp_path / "a.usdc", x, faces, 30)
    (tmp_path / "a.usdc").write_bytes(b"PXR-USDC")
    for read in (io.read_animation, io.read_garment):
        with pytest.raises(InputError, match="pip install"):
            read(tmp_path / "a.usdc")


def test_a_glb_is_not_read_as_an_animation(tmp_path):
    x, faces, _ = walk(frames=2)
    io.write_animation(tmp_path / "a.glb", x, faces, 30)
    with pytest.raises(InputError, match=r"a\.glb: one of \.npz, .*\.mdd, \.usd, .* expected"):
        io.read_animation(tmp_path / "a.glb")


@pytest.mark.parametrize(("times", "points"), [((0, 1, 5), 4), ((), 4), ((0, 1), 3)])
def test_usd_that_is_no_animation(tmp_path, times, points):
    from pxr import Vt

    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    stage, mesh = usd_mesh(tmp_path / "a.usda", x, [3, 3], [0, 1, 2, 2, 1, 3])
    for t in times:
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(x[: points if t else 4]), t)
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=r"a\.usda: .*(even steps|number of points)"):
        io.read_animation(tmp_path / "a.usda")


# --- normals ----------------------------------------------------------------------------------------------------------------


def test_normals_of_a_tube_point_outward_and_those_of_nothing_up():
    rest, faces = tube(around=64, rings=8)
    n = vertex_normals(rest, faces)
    radial = rest * [1, 0, 1] / np.linalg.norm(rest * [1, 0, 1], axis=1, keepdims=True)
    assert (np.sum(n * radial, axis=1) > 0.99).all()
    np.testing.assert_array_equal(vertex_normals(np.zeros((3, 3)), np.array([[0, 1, 2]])), [[0, 1, 0]] * 3)


@pytest.mark.parametrize("suffix", [".glb", ".usdc", ".usda"])
def test_garments_worn_together_are_objects_with_names(suffix, tmp_path):
    """Blender lists each; the whole read back is the animation, vertex by vertex."""
    x, faces, uv = together()
    names = ("shirt", "coat 2", "hero")
    (file,) = io.write_animation(tmp_path / f"a{suffix}", x, faces, 24, uv=uv, names=names, layers=(3,))
    assert file == tmp_path / f"a{suffix}"
    if suffix == ".glb":
        data = file.read_bytes()
        document = json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])
        assert [mesh["name"] for mesh in document["meshes"]] == ["shirt", "coat 2"]
        assert len({str(m["pbrMetallicRoughness"]["baseColorFactor"]) for m in document["materials"]}) == 2
        counts = [document["accessors"][m["primitives"][0]["attributes"]["POSITION"]]["count"] for m in document["meshes"]]
        assert counts == [3, 4]
    else:
        found = io.read_animation(file)
        np.testing.assert_allclose(found.vertices, x)
        np.testing.assert_array_equal(found.faces, faces)
        np.testing.assert_allclose(io.read_garment(file, mesh=["coat_2"]).vertices, x[0, 3:])


@pytest.mark.parametrize("suffix", [".pc2", ".mdd"])
def test_a_cache_of_each_garment(suffix, tmp_path):
    x, faces, _ = together()
    files = io.write_animation(tmp_path / f"a{suffix}", x, faces, 24, names=("shirt", "coat 2", "hero"), layers=(3,))
    assert [file.name for file in files] == [f"a_shirt{suffix}", f"a_coat_2{suffix}"]
    assert sorted(tmp_path.iterdir()) == sorted(files)
    for file, own in zip(files, (x[:, :3], x[:, 3:]), strict=True):
        np.testing.assert_allclose(io.read_animation(file).vertices, own)


def test_frames_of_garments_worn_together(tmp_path):
    x, faces, uv = together()
    io.write_animation(tmp_path / "frames", x, faces, 24, uv=uv, names=("shirt", "coat", "hero"), layers=(3,))
    lines = (tmp_path / "frames" / "frame_0001.obj").read_text().splitlines()
    assert [line[:6] for line in lines if line[0] in "of"] == ["o shir", "f 1/1 ", "o coat", *(["f 4/4 ", "f 4/4 "])]
    found = io.read_animation(tmp_path / "frames", fps=24)
    np.testing.assert_allclose(found.vertices, x, rtol=1e-6)
    np.testing.assert_array_equal(found.faces, faces)


def test_arrays_tell_where_each_garment_begins(tmp_path):
    x, faces, _ = together()
    for name in ("a.npz", "a.h5"):
        io.write_animation(tmp_path / name, x, faces, 24, names=("shirt", "coat", "hero"), layers=(3,))
        np.testing.assert_allclose(io.read_animation(tmp_path / name).vertices, x)
    assert np.load(tmp_path / "a.npz")["layers"].tolist() == [3]
    with pytest.raises(InputError, match=r"b\.pc2: names: names of 2 garments and the body expected"):
        io.write_animation(tmp_path / "b.pc2", x, faces, 24, layers=(3,))
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["layers"][()].tolist() == [3]


def together():
    """A triangle and a square over it, moving apart in three frames, with texture coordinates."""
    still = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], np.float32)
    x = still + np.linspace(0, 1, 3, dtype=np.float32)[:, None, None] * (still[:, 2:] + 1)
    faces = np.array([[0, 1, 2], [3, 4, 5], [3, 5, 6]], np.int32)
    return x, faces, still[faces][..., :2] + still[faces][..., 2:]

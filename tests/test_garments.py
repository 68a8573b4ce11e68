"""Garments from other programs: polygons, units, axes and doubled vertices, read as they are meant or refused with the mend."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.cli import main
from ncs_jax.errors import InputError
from ncs_jax.io.mesh.axes import upright
from ncs_jax.io.mesh.polygons import triangulate
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.garment_checks import check_on_body, doubled, fine_folds, summarise_surface
from ncs_jax.scene.spec import BendingSpec, PhysicsSpec, SelfContactSpec

from .scenes import grid, post, write_scene
from .shapes import ball, rotation, sheet, tube

# Outlines, counter-clockwise, that a fan from the first corner folds, or that have corners on a line.
OUTLINES = {
    "dart": [[0, 0], [2, 1], [0, 2], [0.5, 1]],
    "L": [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]],
    "U": [[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]],
    "star": [[np.cos(a) * r, np.sin(a) * r] for k in range(10) for a, r in [(np.pi * k / 5, 1 if k % 2 else 0.3)]],
    "comb": [[0, 0], [9, 0], [9, 3], [7.5, 1], [6, 3], [4.5, 1], [3, 3], [1.5, 1], [0, 3]],
    "on a line": [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]],
    "around a hole": [[0, 0], [3, 0], [3, 3], [0, 3], [0, 0], [1, 1], [1, 2], [2, 2], [2, 1], [1, 1]],
}


def twice_area(x, faces, normal):
    """Twice the area of triangles as seen from a normal; below 0 for one that is folded back."""
    a, b, c = (x[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a) @ normal


def outline(name, turned=0, matrix=None):
    flat = np.roll(np.pad(np.array(OUTLINES[name], float), ((0, 0), (0, 1))), -turned, axis=0)
    area = np.cross(flat, np.roll(flat, -1, axis=0)).sum(axis=0)[2]
    return flat if matrix is None else flat @ matrix.T, area


@pytest.mark.parametrize("name", OUTLINES)
def test_polygons_do_not_fold(name):
    """From whichever corner they begin and however they lie: no triangle is turned over or flat, and they cover the polygon."""
    matrix = rotation([1, 2, -1], 2.0)
    for turned in range(len(OUTLINES[name])):
        x, area = outline(name, turned, matrix)
        faces = triangulate(Path("a"), x, np.array([len(x)]), np.arange(len(x)))
        sizes = twice_area(x, faces, matrix[:, 2])
        assert len(faces) == len(x) - 2 and (sizes > 1e-6).all() and sizes.sum() == pytest.approx(area)


def test_random_polygons_do_not_fold(rng):
    for _ in range(200):
        n = int(rng.integers(4, 25))
        angle, radius = np.sort(rng.uniform(0, 2 * np.pi, n)), rng.uniform(0.1, 1, n)
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
        if np.diff(angle, append=angle[0] + 2 * np.pi).max() > 3:  # then the middle is outside
            continue
        faces = triangulate(Path("a"), flat, np.array([n]), np.arange(n))
        sizes, area = twice_area(flat, faces, [0, 0, 1.0]), np.cross(flat, np.roll(flat, -1, axis=0))[:, 2].sum()
        assert sizes.min() > -1e-9 and sizes.sum() == pytest.approx(area)


def test_many_polygons_keep_their_order_and_convex_ones_are_fans():
    x = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0], [2, 0, 0], [1.2, 0.5, 0], [2, 1, 0]], float)
    corners = [0, 1, 2, 3, 3, 2, 4, 1, 5, 6, 7, 2]
    faces = triangulate(Path("a"), x, np.array([4, 3, 5]), np.array(corners))
    assert faces[:3].tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]] and set(faces[3:].ravel().tolist()) == {1, 5, 6, 7, 2}
    assert (twice_area(x, faces, [0, 0, 1.0]) > 0).all()
    assert triangulate(Path("a"), x, np.array([4, 3, 5]), np.array(corners), skip=[0, 7]).tolist() == faces[2:].tolist()


def test_a_polygon_of_no_area_is_left_to_the_checks():
    x = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]], float)
    assert triangulate(Path("a"), x, np.array([5]), np.arange(5)).tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    with pytest.raises(InputError, match=r"g\.obj: faces, face 2: a polygon that does not cross itself.*triangulate it"):
        places = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [2, 1, 0]], float)
        triangulate(Path("g.obj"), places, np.array([3, 3, 4]), np.array([0, 1, 2, 0, 1, 2, 0, 1, 2, 3]))


# --- .ply -------------------------------------------------------------------------------------------------------------------


def ply(kind, places, polygons, uv=None):
    """A .ply as programs write them: colours, flags before and after the list, and edges."""
    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    head = ["ply", f"format {kind} 1.0", "comment by hand", f"element vertex {len(places)}"]
    head += ["property double x", "property double y", "property double z", "property uchar red"]
    head += [] if uv is None else ["property float s", "property float t"]
    head += [f"element face {len(polygons)}", "property short part", "property list uchar uint vertex_index"]
    head += ["property float quality", "element edge 1", "property int vertex1", "property int vertex2", "end_header\n"]
    rows = [("dddB" + "ff" * (uv is not None), [*p, 7, *(() if uv is None else uv[i])]) for i, p in enumerate(places)]
    rows += [(f"hB{len(p)}If", [0, len(p), *p, 0.5]) for p in polygons] + [("ii", [0, 1])]
    if order is None:
        return "\n".join(head).encode() + "".join(" ".join(map(repr, r)) + "\n" for _, r in rows).encode()
    return "\n".join(head).encode() + b"".join(struct.pack(order + kinds, *r) for kinds, r in rows)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("with_uv", [False, True])
def test_ply_of_any_kind(tmp_path, kind, with_uv):
    x = [[0.1, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0], [2, 0, 0], [1.2, 0.5, 0], [2, 1, 0]]
    polygons = [[0, 1, 2, 3], [3, 2, 4], [1, 5, 6, 7, 2]]
    uv = np.linspace(0, 1, 16).reshape(8, 2).astype(np.float32).tolist() if with_uv else None
    (tmp_path / "g.ply").write_bytes(ply(kind, x, polygons, uv))
    record = io.read_garment(tmp_path / "g.ply")
    np.testing.assert_array_equal(record.vertices, x)
    counts, corners = np.array([len(p) for p in polygons]), np.concatenate(polygons)
    np.testing.assert_array_equal(record.faces, triangulate(Path("a"), np.array(x), counts, corners))
    assert (record.uv is None) != with_uv and (uv is None or np.allclose(record.uv, np.array(uv)[record.faces]))


def test_a_large_ply_agrees_with_trimesh(tmp_path):
    import trimesh

    x, faces = ball(4)
    trimesh.Trimesh(x, faces, process=False).export(tmp_path / "g.ply")
    record = io.read_garment(tmp_path / "g.ply")
    np.testing.assert_allclose(record.vertices, x, atol=1e-7)
    np.testing.assert_array_equal(record.faces, faces)


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_a_concave_polygon_in_a_file(tmp_path, suffix):
    x, area = outline("U", 3)
    if suffix == "obj":
        lines = [f"v {a} {b} {c}" for a, b, c in x] + ["f " + " ".join(str(i + 1) for i in range(len(x)))]
        (tmp_path / "g.obj").write_text("\n".join(lines))
    else:
        (tmp_path / "g.ply").write_bytes(ply("ascii", x.tolist(), [list(range(len(x)))]))
    record = io.read_garment(tmp_path / f"g.{suffix}")
    sizes = twice_area(record.vertices, record.faces, [0, 0, 1.0])
    assert (sizes > 0).all() and sizes.sum() == pytest.approx(area)
    np.testing.assert_allclose(record.vertices, x)


# --- USD --------------------------------------------------------------------------------------------------------------------


def stage_of(path, meters=1.0, up="Y"):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, meters)
    UsdGeom.SetStageUpAxis(stage, up)
    return stage


def add(stage, name, x, polygons, when=None):
    from pxr import Usd, UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, name)
    points = Vt.Vec3fArray.FromNumpy(np.asarray(x, np.float32))
    mesh.CreatePointsAttr().Set(points, Usd.TimeCode.Default() if when is None else when)
    mesh.CreateFaceVertexCountsAttr([len(p) for p in polygons])
    mesh.CreateFaceVertexIndicesAttr([int(i) for p in polygons for i in p])
    return mesh


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)


@pytest.mark.parametrize("suffix", ["usd", "usda", "usdc", "usdz"])
def test_usd_in_centimetres_and_z_up_under_a_transform(tmp_path, suffix):
    from pxr import Gf, UsdGeom, UsdUtils

    inner = tmp_path / "inner.usdc" if suffix == "usdz" else tmp_path / f"g.{suffix}"
    stage = stage_of(inner, 0.01, "Z")
    root = UsdGeom.Xform.Define(stage, "/worn")
    root.AddTranslateOp().Set(Gf.Vec3d(10, 20, 30))
    root.AddRotateZOp().Set(90)
    add(stage, "/worn/cloth", 100 * SQUARE, [[0, 1, 2, 3]])  # its subdivision scheme is Catmull-Clark, as no other is said
    stage.GetRootLayer().Save()
    if suffix == "usdz":
        assert UsdUtils.CreateNewUsdzPackage(str(inner), str(tmp_path / "g.usdz"))
    record = io.read_garment(tmp_path / f"g.{suffix}")
    world = 100 * SQUARE @ rotation([0, 0, 1], np.pi / 2).T + [10, 20, 30]
    np.testing.assert_allclose(record.vertices, 0.01 * world[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    assert record.faces.tolist() == [[0, 1, 2], [0, 2, 3]] and (record.scale, record.up) == (0.01, "z")
    kept = io.read_garment(tmp_path / f"g.{suffix}", scale=1.0, up="y")
    np.testing.assert_allclose(kept.vertices, world, atol=1e-5)


def test_usd_meshes_that_face_the_other_way(tmp_path):
    """Left-handed, mirrored, both, with a hole, and some that are no garment."""
    from pxr import Gf, UsdGeom

    stage = stage_of(tmp_path / "g.usda")
    x = np.concatenate([SQUARE, SQUARE + [2, 0, 0]])
    polygons = [[0, 1, 2, 3], [4, 5, 6, 7], [1, 4, 7, 2]]
    add(stage, "/a", x, polygons).CreateHoleIndicesAttr([2])
    add(stage, "/b", x, [[3, 2, 1, 0], [7, 6, 5, 4]]).CreateOrientationAttr("leftHanded")
    mirrored = add(stage, "/c", x, [[0, 1, 2, 3], [4, 5, 6, 7]])
    UsdGeom.Xformable(mirrored).AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    add(stage, "/guide", x, polygons).CreatePurposeAttr("guide")
    add(stage, "/off", x, polygons).GetPrim().SetActive(False)
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=r"garment\.mesh: one object.*/a \(8 vertices\)"):
        io.read_garment(tmp_path / "g.usda")
    assert len(io.read_garment(tmp_path / "g.usda", mesh=["b"]).vertices) == 8
    record = io.read_garment(tmp_path / "g.usda", mesh=["a", "b", "/c"])
    assert record.vertices.shape == (24, 3) and record.faces.shape == (12, 3)
    sizes = twice_area(record.vertices, record.faces, [0, 0, 1.0])
    np.testing.assert_allclose(sizes, 1)  # what is outside stays outside, also in a mirror


def test_usd_that_only_moves_and_one_that_refers_to_another(tmp_path):
    stage = stage_of(tmp_path / "moves.usdc")
    add(stage, "/cloth", SQUARE, [[0, 1, 2, 3]], when=5.0)
    stage.SetDefaultPrim(stage.GetPrimAtPath("/cloth"))
    stage.GetRootLayer().Save()
    np.testing.assert_array_equal(io.read_garment(tmp_path / "moves.usdc").vertices, SQUARE)
    other = stage_of(tmp_path / "refers.usda")
    other.DefinePrim("/here").GetReferences().AddReference("./moves.usdc")
    other.GetRootLayer().Save()
    np.testing.assert_array_equal(io.read_garment(tmp_path / "refers.usda").vertices, SQUARE)
    (tmp_path / "moves.usdc").unlink()
    with pytest.raises(InputError, match=r"refers\.usda: prims: a mesh expected"):
        io.read_garment(tmp_path / "refers.usda")


# --- doubled vertices -------------------------------------------------------------------------------------------------------


def pieces(x, faces):
    """Every triangle with vertices of its own, those of the last moved by 0.1 mm."""
    apart = np.array(x[faces]).reshape(-1, 3)
    apart[-3:] += 1e-4
    return apart, np.arange(len(apart)).reshape(-1, 3)


@pytest.mark.parametrize("suffix", ["npz", "obj", "ply"])
def test_vertices_are_welded_only_when_asked(tmp_path, suffix):
    x, faces = sheet(spacing=0.1)
    apart, own = pieces(x, faces)
    path = tmp_path / f"g.{suffix}"
    if suffix == "npz":
        np.savez(path, vertices=apart, faces=own, uv=apart[:, :2], group_hem=np.arange(6))
    elif suffix == "obj":
        text = [f"v {a!r} {b!r} {c!r}" for a, b, c in apart.tolist()] + [f"f {a} {b} {c}" for a, b, c in own + 1]
        path.write_text("\n".join(text))
    else:
        path.write_bytes(ply("binary_little_endian", apart.tolist(), own.tolist()))
    record = io.read_garment(path)
    np.testing.assert_array_equal(record.vertices, apart)
    assert record.welded == 0 and summarise_surface(record.vertices, record.faces).components == len(faces)
    partly = io.read_garment(path, weld=1e-6)
    assert summarise_surface(partly.vertices, partly.faces).components == 2
    whole = io.read_garment(path, weld=5e-4)
    assert whole.welded == len(apart) - len(x) and summarise_surface(whole.vertices, whole.faces).components == 1
    places = list(dict.fromkeys(faces.ravel().tolist()))  # each where it first stands in the file
    np.testing.assert_allclose(whole.vertices, x[places], atol=2e-4)
    np.testing.assert_array_equal(np.array(places)[whole.faces], faces)
    if suffix == "npz":
        assert whole.groups["hem"].tolist() == sorted({places.index(v) for v in faces.ravel()[:6].tolist()})
        np.testing.assert_array_equal(whole.uv, apart[own, :2])  # where vertices become one, corners keep what they had
    with pytest.raises(InputError, match=rf"g\.{suffix}: garment.weld: a tolerance smaller than every edge.*0.11 m"):
        io.read_garment(path, weld=0.11)


@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_formats_that_split_vertices_are_welded_where_they_are_at_one_place(tmp_path, suffix):
    import trimesh

    x, faces = sheet(spacing=0.1)
    trimesh.Trimesh(*pieces(x, faces), process=False).export(tmp_path / f"g.{suffix}")
    record = io.read_garment(tmp_path / f"g.{suffix}")
    assert record.welded == 3 * len(faces) - len(x) - 3 + sum(np.sum(faces == v) == 1 for v in faces[-1])
    assert summarise_surface(record.vertices, record.faces).components == 2
    assert io.read_garment(tmp_path / f"g.{suffix}", weld=5e-4).vertices.shape == x.shape


@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_triangles_that_draw_nothing_are_left_out_where_a_format_splits_vertices(tmp_path, suffix):
    import trimesh

    x, faces = sheet(spacing=0.1)
    line = np.array([[0, 1, 2]]) + len(x[faces].reshape(-1, 3))  # with two corners where one vertex is
    split = np.concatenate([x[faces].reshape(-1, 3), x[[faces[3, 0], faces[3, 0], faces[3, 1]]]])
    corners = np.concatenate([line, np.arange(3 * len(faces)).reshape(-1, 3)])
    trimesh.Trimesh(split, corners, process=False).export(tmp_path / f"g.{suffix}")
    record = io.read_garment(tmp_path / f"g.{suffix}", weld=1e-6)
    assert record.vertices.shape == x.shape and record.notes[0].startswith("1 triangles with two corners at one place")
    np.testing.assert_allclose(record.vertices[record.faces], x[faces], atol=1e-6)


def test_vertices_that_rounding_has_split_are_counted():
    x, faces = sheet(spacing=0.1)
    apart = x[faces].reshape(-1, 3)
    soup = np.arange(len(apart)).reshape(-1, 3)
    assert doubled(x, faces) == 0
    for noise in (0, 1e-7):
        noisy = apart + noise * np.random.default_rng(0).uniform(-1, 1, apart.shape)
        assert doubled(noisy, soup) == len(apart) - len(x)
    near = x.copy()
    near[faces[0, 1]] = near[faces[0, 0]] + [1e-7, 0, 0]  # joined by an edge: nothing comes apart
    assert doubled(near, faces) == 0


# --- what a surface is made of ----------------------------------------------------------------------------------------------


def test_anatomy():
    x, faces = tube()
    found = summarise_surface(x, faces)
    assert (found.components, len(found.openings), found.degenerate) == (1, 2, 0)
    x, faces = ball(1)
    assert not summarise_surface(x, faces).openings
    pinched = faces[~(faces == 0).any(axis=1)]  # a hole where a vertex was
    assert len(summarise_surface(x, pinched).openings) == 1
    x, faces = sheet(2, 3)
    both = np.concatenate([faces, faces + len(x)])
    assert summarise_surface(np.concatenate([x, x + 1]), both).components == 2
    # Two triangles that meet in a vertex alone: one piece, two borders that touch.
    assert len(summarise_surface(np.eye(5)[:, :3], np.array([[0, 1, 2], [2, 3, 4]])).openings) == 2
    flat = np.array([[0, 0, 0], [1, 0, 0], [2, 1e-7, 0], [1, 1, 0]], float)
    assert summarise_surface(flat, np.array([[0, 1, 2], [0, 2, 3]])).degenerate == 1


# --- units and axes ---------------------------------------------------------------------------------------------------------


def garment(x, scale=1.0, up="y"):
    return io.GarmentRecord(x, grid()[1], scale=scale, up=up)


TURNED = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}


@pytest.mark.parametrize("up", "yzx")
@pytest.mark.parametrize("unit", [1, 100, 1000, 1 / 0.0254, 1 / 0.3048])
def test_units_and_axes_are_recognised_and_the_mend_holds(tmp_path, unit, up):
    """The error says exactly what to write into the scene, and with it the garment is read as it was."""
    (x, faces), body = grid(), post()["vertices"]
    np.savez(tmp_path / "g.npz", vertices=unit * x @ np.array(TURNED[up]), faces=faces)
    fields = [f"scale = {1 / unit:.4g}"] * (unit != 1) + [f'up = "{up}"'] * (up != "y")
    if fields:
        with pytest.raises(InputError) as caught:
            check_on_body(tmp_path / "g.npz", io.read_garment(tmp_path / "g.npz"), body, axis_given=False)
        assert f"write {' and '.join(fields)} below [garment]" in str(caught.value) and "\n" not in str(caught.value)
    read = io.read_garment(tmp_path / "g.npz", scale=0.0 if unit == 1 else 1 / unit, up="" if up == "y" else up)
    np.testing.assert_allclose(read.vertices, x, atol=1e-12)
    check_on_body(tmp_path / "g.npz", read, body, axis_given=False)


@pytest.mark.parametrize("told", [0.0, 1.0, 0.3048])
def test_every_unit_that_would_suit_is_offered_the_likeliest_first(tmp_path, told):
    """In inches a T-shirt lies where it is worn; in centimetres it would hang at the knees, and its box cannot tell."""
    shirt, body = io.read_garment(packaged("tshirt")), io.read_body(packaged("body")).vertices
    np.savez(tmp_path / "g.npz", vertices=shirt.vertices / 0.0254, faces=shirt.faces)
    read = io.read_garment(tmp_path / "g.npz", scale=told)
    with pytest.raises(InputError, match=r"suit inches or centimetres: whichever it is, write scale = 0.0254 or 0.01 below"):
        check_on_body(tmp_path / "g.npz", read, body, axis_given=False, scale_given=bool(told))


def test_the_command_tells_the_mend_and_then_what_was_applied(tmp_path, capsys):
    scene = write_scene(tmp_path)
    x, faces = grid()
    np.savez(tmp_path / "cloth.npz", vertices=100 * x @ np.array(TURNED["z"]), faces=faces)
    assert main(["check", str(scene)]) == 2
    assert 'write scale = 0.01 and up = "z" below [garment] in the scene file' in capsys.readouterr().err
    scene.write_text(scene.read_text().replace("smoothing = 2", 'smoothing = 2\nscale = 0.01\nup = "z"'))
    assert main(["check", str(scene)]) == 0
    assert "0.01 m a unit, Z up; vertices in the file's number and order" in capsys.readouterr().out


def test_a_garment_across_the_body_is_refused_unless_the_scene_says_so():
    """A body about the origin, which a garment that lies down still touches: there the axis that is up must be told."""
    body = post()["vertices"] - [0, 0.5, 0]
    x = grid(rows=9, spacing=0.05)[0] - [0, 0.5, 0]
    check_on_body(Path("g.npz"), garment(x), body, axis_given=False)
    lies = x @ np.array(TURNED["z"])
    with pytest.raises(InputError, match=r'g\.npz: .*it would with Z up .found .Y up.*write up = "z" .* or up = "y"'):
        check_on_body(Path("g.npz"), garment(lies), body, axis_given=False)
    check_on_body(Path("g.npz"), garment(lies), body, axis_given=True)
    with pytest.raises(InputError, match="with Y up"):  # a file of USD that says Z up and is not
        check_on_body(Path("g.npz"), garment(upright(x, 1.0, "z"), up="z"), body, axis_given=False)


def test_a_garment_of_the_right_but_unusual_unit_that_lies_down_is_told_its_axis():
    x = grid()[0] @ np.array(TURNED["z"])
    with pytest.raises(InputError, match=r'let ncs fit find .*suit Z up: if it is so, write up = "z" below'):
        check_on_body(Path("g.npz"), garment(x, scale=0.1), post()["vertices"], axis_given=False)


def test_a_garment_that_nothing_brings_onto_the_body():
    body = post()["vertices"]
    with pytest.raises(InputError, match=r"2\.41 m apart.*move it into the body's coordinates"):
        check_on_body(Path("g.npz"), garment(grid(origin=(2.5, 0.3, 0.0))[0] + [0.09, 0, 0]), body, axis_given=False)
    with pytest.raises(InputError, match=r"about the size of the body .*2\.5e\+04 m.*garment\.scale"):
        check_on_body(Path("g.npz"), garment(grid()[0] * 1e5), body, axis_given=False)


@pytest.mark.parametrize(("given", "words"), [
    ({"scale_given": True, "axis_given": True}, "move it into the body's coordinates, or mend garment.up"),
    ({"scale_given": True, "axis_given": False}, 'if its axes are others, write up = "x" below'),
    ({"scale_given": False, "axis_given": True}, "would suit centimetres: if it is so, write scale = 0.01 below"),
])  # fmt: skip
def test_what_the_scene_states_is_not_guessed_at(given, words):
    """A sheet in inches that is 0.3 m above the body, where one in cm would be on it; and one that X up would bring."""
    x = grid()[0] @ np.array(TURNED["x"]) if 'up = "x"' in words else grid(rows=9)[0] + [0, 1.0, 0]
    with pytest.raises(InputError) as caught:
        check_on_body(Path("g.npz"), garment(x, scale=0.0254), post()["vertices"], **given)
    told = str(caught.value)
    assert words in told and "ncs fit" in told
    assert not (given["scale_given"] and "scale =" in told) and not (given["axis_given"] and "up =" in told)


def test_a_small_hole_is_told_from_openings():
    """A quad that is missing, 16 cm around, between openings of 2.2 m; a wrist of as many edges is no hole beside them."""
    x, faces = tube(36, 12, 0.35, 0.4)
    around = np.linalg.norm(x[0] - x[1]) * 2 + 0.8 / 11
    ends = summarise_surface(x, np.delete(faces, [400, 401], axis=0)).openings
    assert [o.small for o in ends] == [False, True, False] and ends[1].edges == 4
    assert ends[1].length == pytest.approx(around) and ends[0].length == pytest.approx(36 * np.linalg.norm(x[0] - x[1]))
    assert not any(o.small for o in summarise_surface(*tube(6, 3, 0.03, 0.2)).openings)
    assert all(o.small for o in summarise_surface(*tube(30, 3, 0.01, 0.2)).openings)


def turned_round(faces, which):
    return np.where(which[:, None], faces[:, [0, 2, 1]], faces)


@pytest.mark.parametrize("share", [0.02, 0.45, 0.6, 1.0])
def test_triangles_that_face_the_other_side_are_turned(tmp_path, rng, share):
    """To where most look, or outward where about half do; what agrees stays, inward too; another component is left alone."""
    x, faces = tube(20, 8, 0.2, 0.6)
    wrong = rng.random(len(faces)) < share
    both = np.concatenate([turned_round(faces, wrong), faces + len(x)])
    np.savez(tmp_path / "g.npz", vertices=np.concatenate([x, x + [1, 0, 0]]), faces=both)
    if share < 1:
        with pytest.raises(InputError, match=r"facing the same side expected.*`ncs fit` turn them"):
            io.read_garment(tmp_path / "g.npz")
    read = io.read_garment(tmp_path / "g.npz", turn_faces=True)
    np.testing.assert_array_equal(read.faces, np.concatenate([faces if share < 1 else both[: len(faces)], faces + len(x)]))
    told = f"{wrong.sum()} of {len(both)} triangles faced the other side than their neighbours, the first is face "
    assert [n.startswith(told + str(np.flatnonzero(wrong)[0])) for n in read.notes] == [True] * (share < 1)


def test_a_surface_of_one_side_is_refused(tmp_path):
    x, faces = tube(12, 2)
    pairs = {0: 12, 12: 0}
    cut = [[pairs.get(v, v) for v in f] if f in faces[-2:].tolist() else f for f in faces.tolist()]  # joined with a half turn
    np.savez(tmp_path / "g.npz", vertices=x, faces=cut)
    with pytest.raises(InputError, match=r"faces: a surface with two sides.*Moebius.*24 triangles.*the first is face 0.*cut"):
        io.read_garment(tmp_path / "g.npz", turn_faces=True)


def test_only_npz_is_written(tmp_path):
    with pytest.raises(InputError, match=r"shirt\.obj: a file name that ends in \.npz expected"):
        io.write_garment(tmp_path / "shirt.obj", garment(grid()[0]))
    assert not list(tmp_path.iterdir())


def test_check_says_what_a_garment_is_made_of(tmp_path, capsys):
    scene = write_scene(tmp_path)
    assert main(["check", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "30 vertices, 40 triangles" in text
    assert "connected components 1, openings 1, small holes 0, degenerate triangles 0" in text
    assert "1 m a unit, Y up; vertices in the file's number and order" in text
    np.savez(tmp_path / "cloth.npz", **dict(zip(("vertices", "faces"), pieces(*grid()), strict=True)))
    assert main(["check", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "components 40, openings 40, small holes 0" in text and "garment.weld" in text
    scene.write_text(scene.read_text().replace("smoothing = 2", "smoothing = 2\nweld = 0.001"))
    assert main(["check", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "connected components 1, openings 1" in text and "90 vertices welded to others" in text


def test_a_loose_garment_is_told_when_its_folds_are_finer_than_its_triangles():
    """A sheet with edges of 5 cm, 10 cm off the skin; stiffer; mostly nearer; of 2 cm; kept apart; in free fall."""
    x, faces = grid(11, 11, 0.05)
    away, physics = np.full(len(x), 0.1), PhysicsSpec()
    found = fine_folds(x, faces, away, physics)
    assert found is not None and 0.018 < found.length < 0.02 and np.isclose(found.edge, 0.05)
    assert fine_folds(x, faces, away, replace(physics, bending=BendingSpec(found.stiffness))) is None
    assert fine_folds(x, faces, np.where(np.arange(len(x)) % 6, 0.01, away), physics) is None
    assert fine_folds(0.4 * x, faces, away, physics) is None
    assert fine_folds(x, faces, away, replace(physics, self_contact=SelfContactSpec(20.0))) is None
    assert fine_folds(x, faces, away, replace(physics, gravity=(0.0, 0.0, 0.0))) is None

"""Meshes as other tools write them: chosen by name, quantised, packed, morphed, skinned without care."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pygltflib as gl
import pytest

from ncs_jax import io
from ncs_jax.cli.parser import main
from ncs_jax.errors import InputError
from ncs_jax.io.mesh.polygons import triangulate
from ncs_jax.prepare.skinning_weights import with_body_weights
from ncs_jax.scene.spec import load_scene

from .characters import NAMES, Writer, rigid, write_glb
from .scenes import grid
from .shapes import rotation

TURN = rotation([0.3, 1, 0.2], 0.8)


def plain(path: Path, parts: dict, **options) -> Path:
    """Meshes (vertices, faces) by name, each under a node of its own."""
    out = Writer()
    for i, (name, (x, faces)) in enumerate(parts.items()):
        attributes = gl.Attributes(POSITION=out.accessor(x, **options))
        corners = out.accessor(faces.astype(np.uint16).reshape(-1))
        out.gltf.materials.append(gl.Material(name=f"{name}_cloth"))
        primitive = gl.Primitive(attributes=attributes, indices=corners, material=i)
        out.gltf.meshes.append(gl.Mesh(name=f"{name}_mesh", primitives=[primitive]))
        out.gltf.nodes.append(gl.Node(name=name, mesh=i))
    out.gltf.scenes, out.gltf.scene = [gl.Scene(nodes=list(range(len(parts))))], 0
    return out.save(path)


def edited(path: Path, change) -> Path:
    """A .glb with its JSON changed."""
    gltf = gl.GLTF2().load(str(path))
    tree, blob = json.loads(gltf.to_json()), gltf.binary_blob()
    change(tree)
    new = gl.GLTF2.from_dict(tree)
    new.set_binary_blob(blob)
    new.save(str(path))
    return path


# --- garments in glTF -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["float", "sparse", "int16 normalised", "uint16 normalised", "uint16", "int8"])
def test_a_garment_in_every_encoding(tmp_path, kind):
    x, faces = grid()
    low, size, options = x.min(axis=0), 0.5, {}
    if kind in ("float", "sparse"):
        rows, scale, options = x.astype(np.float32), 1.0, {"sparse": (0, 4, 7)} if kind == "sparse" else {}
    else:
        dtype = np.dtype(kind.split()[0])
        most = np.iinfo(dtype).max
        rows, options = np.round((x - low) / size * most).astype(dtype), {"normalized": "normalised" in kind}
        scale = size if options["normalized"] else size / most
    matrix = rigid((0.1, 0.2, 0.3))
    matrix[:3, :3] = TURN * scale

    def move(tree):
        tree["nodes"][0]["matrix"] = matrix.T.reshape(-1).tolist()

    found = io.read_garment(edited(plain(tmp_path / "g.glb", {"Dress": (rows, faces)}, **options), move))
    right = (x if scale == 1.0 else x - low) @ TURN.T + [0.1, 0.2, 0.3]
    np.testing.assert_allclose(found.vertices, right, atol=3e-3 if kind == "int8" else 1e-5)
    assert found.faces.tolist() == faces.tolist()


def test_strips_that_triangles_without_area_join(tmp_path):
    """Two rows of a strip are one, joined by corners that are named twice."""
    x = np.array([[i, k, 0.1 * i * i] for k in range(3) for i in range(4)], np.float32)
    rows = [[c for i in range(4) for c in (4 * k + i, 4 * k + 4 + i)] for k in range(2)]
    strip = np.array([*rows[0], rows[0][-1], rows[1][0], *rows[1]])
    path = plain(tmp_path / "strip.glb", {"cloth": (x, strip)})
    edited(path, lambda tree: tree["meshes"][0]["primitives"][0].update(mode=5))
    found = io.read_garment(path)
    assert len(found.faces) == 12
    a, b, c = np.moveaxis(found.vertices[found.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] < 0).all()
    assert np.abs(normals[:, 2]).sum() / 2 == pytest.approx(6)


def test_a_mirrored_node_keeps_the_outside_outside(tmp_path):
    x, faces = grid()
    path = plain(tmp_path / "g.glb", {"Dress": (x.astype(np.float32), faces)})
    edited(path, lambda tree: tree["nodes"][0].update(scale=[-1, 1, 1]))
    found = io.read_garment(path)
    a, b, c = (found.vertices[found.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_a_garment_among_others_is_asked_for(tmp_path):
    (x, faces), (y, other) = grid(), grid(3, 3, origin=(0.0, 0.3, 0.2))
    parts = {"Dress": (x.astype(np.float32), faces), "Belt": (y.astype(np.float32), other)}
    path = plain(tmp_path / "avatar.glb", parts).rename(tmp_path / "avatar.vrm")
    with pytest.raises(InputError, match=r"garment\.mesh: one object.*Dress \(30 vertices\), Belt \(9 vertices\)"):
        io.read_garment(path)
    for name in ("Belt", "Belt_mesh", "Belt_cloth"):
        assert len(io.read_garment(path, mesh=[name]).vertices) == 9
    assert len(io.read_garment(path, mesh=("Dress", "Belt")).faces) == len(faces) + len(other)
    with pytest.raises(InputError, match=r"garment\.mesh: no such mesh.*'Skirt'.*Dress"):
        io.read_garment(path, mesh=["Skirt"])
    path = plain(tmp_path / "again.glb", parts)
    edited(path, lambda tree: tree["scenes"][0].update(nodes=[1]))  # what is not in the scene is not there
    assert len(io.read_garment(path).vertices) == 9


def test_draco_is_unpacked_or_refused_by_name(tmp_path, monkeypatch):
    draco = pytest.importorskip("DracoPy", reason="needs pip install 'ncs-jax[draco]'")
    x, faces = grid()
    out, corners = Writer(), faces.astype(np.uint32)
    packed = draco.encode(x.astype(np.float32), corners, quantization_bits=16, preserve_order=True)
    number = next(a["unique_id"] for a in draco.decode(packed).attributes if a["attribute_type"] == 0)
    view = out.view(np.frombuffer(packed, np.uint8))
    out.gltf.accessors = [
        gl.Accessor(componentType=5126, count=len(x), type="VEC3"),
        gl.Accessor(componentType=5123, count=faces.size, type="SCALAR"),
    ]
    extension = {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": number}}}
    primitive = gl.Primitive(attributes=gl.Attributes(POSITION=0), indices=1, extensions=extension)
    out.gltf.meshes, out.gltf.nodes = [gl.Mesh(primitives=[primitive])], [gl.Node(name="Dress", mesh=0)]
    out.gltf.extensionsRequired = ["KHR_draco_mesh_compression"]
    path = out.save(tmp_path / "g.glb")
    found = io.read_garment(path)
    np.testing.assert_allclose(found.vertices, x, atol=1e-5)
    assert found.faces.tolist() == faces.tolist()
    monkeypatch.setattr("ncs_jax.io.character.draco.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"KHR_draco_mesh_compression.*ncs-jax\[draco\]"):
        io.read_garment(path)
    monkeypatch.undo()
    path.write_bytes(path.read_bytes().replace(b"DRACO", b"OCARD"))
    with pytest.raises(InputError, match="data of KHR_draco_mesh_compression expected"):
        io.read_garment(path)


def test_a_skinned_garment_brings_its_weights(tmp_path):
    """Of the same file as its body, and of one whose joints have other names."""
    path = write_glb(tmp_path / "hero.glb")
    body = io.read_body(path)
    garment = with_body_weights(io.read_garment(path), body)
    np.testing.assert_allclose(garment.vertices, body.vertices, atol=1e-6)
    np.testing.assert_allclose(garment.weights, body.weights, atol=1e-6)
    edited(path, lambda tree: [n.update(name=f"other {n['name']}") for n in tree["nodes"]])
    other = with_body_weights(io.read_garment(path), body)
    assert other.weights is None and "no joint other" in other.notes[0]


# --- bodies in glTF ---------------------------------------------------------------------------------------------------------


def with_pieces(path: Path) -> Path:
    """The character in three objects: its body, its hair, and a shirt of two materials."""
    write_glb(path, pieces=4)

    def change(tree):
        primitives = tree["meshes"][0]["primitives"]
        tree["materials"] = [{"name": n} for n in ("Skin", "Cotton", "Buttons")]
        for primitive, material in zip(primitives, (0, 0, 1, 2), strict=True):
            primitive["material"] = material
        tree["meshes"] = [
            {"name": "Body_mesh", "primitives": primitives[:1]},
            {"name": "Hair_mesh", "primitives": primitives[1:2]},
            {"name": "Shirt_mesh", "primitives": primitives[2:]},
        ]
        node = tree["nodes"][4]
        tree["nodes"][4] = node | {"name": "Body", "mesh": 0}
        tree["nodes"] += [node | {"name": "Hair", "mesh": 1}, node | {"name": "Shirt", "mesh": 2}]
        tree["scenes"][0]["nodes"] = [0, 5, 6]

    return edited(path, change)


def test_meshes_of_a_character_are_chosen_by_name(tmp_path):
    path = with_pieces(tmp_path / "avatar.glb")
    whole, motion = io.read_body(path), io.read_motion(path)
    parts = {name: io.read_body(path, part=[name]) for name in ("Body", "Hair", "Shirt_mesh", "Skin", "Buttons")}
    assert len(parts["Body"].faces) + len(parts["Hair"].faces) + len(parts["Shirt_mesh"].faces) == len(whole.faces)
    assert len(parts["Skin"].faces) == len(parts["Body"].faces) + len(parts["Hair"].faces)
    assert 0 < len(parts["Buttons"].faces) < len(parts["Shirt_mesh"].faces)
    for record in parts.values():  # the same joints at the same places, so that the file's motion drives each
        assert record.joint_names == whole.joint_names == motion.joint_names
        np.testing.assert_allclose(record.joints, whole.joints, atol=1e-9)
    listed = r"body\.part: no such mesh.*'Trousers'.*Body \(\d+ .*Shirt \(\d+ vertices; materials Cotton, Buttons"
    with pytest.raises(InputError, match=listed):
        io.read_body(path, part=["Trousers"])
    shirt = io.read_garment(path, mesh=["Shirt"])
    np.testing.assert_allclose(np.sort(shirt.vertices, axis=0), np.sort(parts["Shirt_mesh"].vertices, axis=0), atol=1e-6)


PARTS = {'"auto"': (), '"all"': (), '"Body"': ("Body",), '["Body", "all"]': ("Body", "all")}


@pytest.mark.parametrize(("part", "meshes"), PARTS.items())
def test_a_part_is_a_word_or_names(tmp_path, part, meshes):
    (tmp_path / "s.toml").write_text(f"[body]\npart = {part}\n[garment]\nmesh = {json.dumps('Dress')}\n")
    scene = load_scene(tmp_path / "s.toml")
    assert scene.body.meshes == meshes and scene.garment.meshes == ("Dress",)


def spoiled(path: Path, rows: dict[int, float]) -> Path:
    """A character in which some vertices have their weights multiplied."""
    gltf = gl.GLTF2().load(str(path))
    blob = bytearray(gltf.binary_blob())
    accessor = gltf.accessors[gltf.meshes[0].primitives[0].attributes.WEIGHTS_0]
    start = gltf.bufferViews[accessor.bufferView].byteOffset + (accessor.byteOffset or 0)
    weights = np.frombuffer(blob, "<f4", 4 * accessor.count, start).reshape(-1, 4).copy()
    for row, factor in rows.items():
        weights[row] *= factor
    blob[start : start + weights.nbytes] = weights.tobytes()
    gltf.set_binary_blob(bytes(blob))
    gltf.save(str(path))
    return path


def test_weights_are_divided_by_their_sum_and_found_where_there_are_none(tmp_path):
    right = io.read_body(write_glb(tmp_path / "right.glb"))
    factors = dict.fromkeys(range(0, 300, 2), 1.11) | dict.fromkeys(range(1, 300, 2), 0.4)
    body = io.read_body(spoiled(write_glb(tmp_path / "sums.glb"), factors))
    np.testing.assert_allclose(body.weights, right.weights, atol=1e-6)
    assert "divided by their sum" in body.notes[0]
    none = io.read_body(spoiled(write_glb(tmp_path / "none.glb"), dict.fromkeys(range(3), 0.0)))
    np.testing.assert_allclose(none.weights, right.weights, atol=1e-6)  # another corner at the same place has some
    assert none.notes == ("3 vertices without skinning weights follow the nearest that have some",)


def test_a_skin_without_inverse_bind_matrices_is_drawn_as_the_specification_says(tmp_path):
    """Vertices in the space of their joint, as the identity asks for, and where a viewer's sum takes them."""
    path = write_glb(tmp_path / "hero.glb", armature=np.eye(4))
    right, gltf = io.read_body(path), gl.GLTF2().load(str(path))
    blob = bytearray(gltf.binary_blob())
    attributes, skin = gltf.meshes[0].primitives[0].attributes, gltf.skins[0]

    def rows(index, dtype, width):
        one = gltf.accessors[index]
        start = gltf.bufferViews[one.bufferView].byteOffset
        return start, np.frombuffer(blob, dtype, one.count * width, start).reshape(-1, width).copy()

    start, x = rows(attributes.POSITION, "<f4", 3)
    owners, weights = rows(attributes.JOINTS_0, "u1", 4)[1], rows(attributes.WEIGHTS_0, "<f4", 4)[1]
    inverse = rows(skin.inverseBindMatrices, "<f4", 16)[1].reshape(-1, 4, 4).swapaxes(1, 2)
    most = inverse[np.take_along_axis(owners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]]
    own = np.einsum("vab,vb->va", most[:, :3, :3], x) + most[:, :3, 3]
    blob[start : start + x.nbytes] = own.astype("<f4").tobytes()
    skin.inverseBindMatrices = None
    gltf.set_binary_blob(bytes(blob))
    gltf.save(str(path))
    body, worlds = io.read_body(path), np.linalg.inv(inverse.astype(float))
    np.testing.assert_allclose(body.joints, right.joints, atol=1e-6)
    places = [np.einsum("vab,vb->va", worlds[j][:, :3, :3], own) + worlds[j][:, :3, 3] for j in owners.T]
    drawn = np.einsum("kv,kva->va", weights.T, places)
    away = np.linalg.norm(drawn[:, None] - body.vertices, axis=2)
    assert away.min(axis=1).max() < 1e-5 and away.min(axis=0).max() < 1e-5


def test_blend_shapes_have_the_files_weights_or_those_asked_for(tmp_path):
    path = write_glb(tmp_path / "hero.glb", armature=np.eye(4))
    right, gltf = io.read_body(path), gl.GLTF2().load(str(path))
    count = gltf.accessors[gltf.meshes[0].primitives[0].attributes.POSITION].count
    more = np.stack([np.tile(np.array(by, np.float32), (count, 1)) for by in ([0, 0.01, 0], [0.02, 0, 0])])
    uri = "data:application/octet-stream;base64," + base64.b64encode(more.tobytes()).decode()

    def change(tree):
        tree["buffers"].append({"byteLength": more.nbytes, "uri": uri})
        for k in range(2):
            tree["bufferViews"].append({"buffer": 1, "byteOffset": k * more[0].nbytes, "byteLength": more[0].nbytes})
            view = len(tree["bufferViews"]) - 1
            tree["accessors"].append({"bufferView": view, "componentType": 5126, "count": count, "type": "VEC3"})
        last = len(tree["accessors"])
        tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": last - 2}, {"POSITION": last - 1}]
        tree["meshes"][0] |= {"weights": [0.0, 0.5], "extras": {"targetNames": ["tall", "wide"]}}

    edited(path, change)
    moved = lambda **shapes: (io.read_body(path, shapes=shapes).vertices - right.vertices).mean(axis=0)  # noqa: E731
    np.testing.assert_allclose(moved(), [0.01, 0, 0], atol=1e-6)
    np.testing.assert_allclose(moved(tall=2.0), [0.01, 0.02, 0], atol=1e-6)
    np.testing.assert_allclose(moved(**{"1": 0.0, "0": 1.0}), [0, 0.01, 0], atol=1e-6)
    with pytest.raises(InputError, match=r"body\.shapes: no such shape.*'thin'.*tall, wide"):
        moved(thin=1.0)


def test_a_body_under_another_suffix(tmp_path):
    path = write_glb(tmp_path / "hero.glb")
    path.rename(tmp_path / "hero.VRM")
    body, motion = io.read_body(tmp_path / "hero.VRM"), io.read_motion(f"{tmp_path}/hero.VRM#walk")
    assert body.joint_names == motion.joint_names == NAMES
    alone = "a mesh alone has none"
    for suffix, words in {".obj": alone, ".usdz": alone, ".blend": "convert it", "": "convert it"}.items():
        (tmp_path / f"body{suffix}").write_text("x")
        with pytest.raises(InputError, match=rf"body.file: .*weights expected, \.npz, \.glb, \.vrm, \.gltf, \.fbx.*{words}"):
            io.read_body(tmp_path / f"body{suffix}")


@pytest.mark.parametrize("suffix", [".glb", ".vrm"])
def test_gltf_that_was_renamed_is_read_as_what_it_is(tmp_path, suffix):
    right = io.read_body(write_glb(tmp_path / "hero.glb"))
    binary = (tmp_path / "hero.glb").read_bytes()
    gltf = gl.GLTF2().load(str(tmp_path / "hero.glb"))
    gltf.convert_buffers(gl.BufferFormat.DATAURI)
    gltf.save_json(str(tmp_path / "text.gltf"))
    (tmp_path / "binary.gltf").write_bytes(binary)
    (tmp_path / f"text{suffix}").write_bytes(b"\xef\xbb\xbf " + (tmp_path / "text.gltf").read_bytes())
    for name in ("text.gltf", "binary.gltf", f"text{suffix}"):
        np.testing.assert_array_equal(io.read_body(tmp_path / name).vertices, right.vertices)
    (tmp_path / f"page{suffix}").write_bytes(b"<!DOCTYPE html><html></html>")
    with pytest.raises(InputError, match="found 'a web page'"):
        io.read_body(tmp_path / f"page{suffix}")
    (tmp_path / f"other{suffix}").write_bytes(b"else")
    with pytest.raises(InputError, match="begins with 'glTF' expected"):
        io.read_body(tmp_path / f"other{suffix}")


def test_packaged_files_have_their_short_names():
    assert len(io.read_body("ncs:body").vertices) == 6067
    assert len(io.read_garment("ncs:tshirt").vertices) and len(io.read_motion("ncs:walk").poses)
    with pytest.raises(InputError, match="ncs:xyz: no such packaged file; use one of ncs:body, "):
        io.read_body("ncs:xyz")
    with pytest.raises(InputError, match=r"ncs:danse: no such packaged file; did you mean ncs:dance\?"):
        io.read_motion("ncs:danse")


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_the_command_writes_a_body_to_model_on(tmp_path, capsys, suffix):
    source, out = write_glb(tmp_path / "hero.glb"), tmp_path / f"out.{suffix}"
    assert main(["body", "--body", str(source), "--out", str(out)]) == 0
    assert "3 joints" in capsys.readouterr().out
    right = io.read_body(source)
    if suffix == "glb":
        again = io.read_body(out)
        np.testing.assert_allclose(again.joints, right.joints, atol=1e-6)
        np.testing.assert_allclose(again.weights, right.weights, atol=1e-6)
        assert again.joint_names == right.joint_names
    else:
        again = io.read_garment(out)
        assert again.faces.tolist() == right.faces.tolist()
    np.testing.assert_allclose(again.vertices, right.vertices, atol=1e-6)
    assert main(["body", "--body", str(source), "--out", str(tmp_path / "out.fbx")]) == 2


# --- .obj -------------------------------------------------------------------------------------------------------------------

OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 5 0 0\nv 6 0 0\nv 6 1 0\n"


def test_objects_of_an_obj_are_asked_for_and_its_groups_are_joined(tmp_path):
    text = OBJ + "o Body\nusemtl skin\nf 1 2 3\nf 1 3 4\no Dress one\ng hem front\nusemtl cotton\nf 5 6 7\n"
    (tmp_path / "g.obj").write_text(text)
    with pytest.raises(InputError, match=r"garment\.mesh: one object.*2 objects.*Body \(4 vert.*, Dress one \(3 vert"):
        io.read_garment(tmp_path / "g.obj")
    for name in ("Dress one", "hem", "hem front", "cotton"):
        found = io.read_garment(tmp_path / "g.obj", mesh=[name])
        assert found.vertices[:, 0].tolist() == [5, 6, 6] and found.faces.tolist() == [[0, 1, 2]]
    (tmp_path / "g.obj").write_text(text.replace("o ", "g "))
    assert len(io.read_garment(tmp_path / "g.obj").faces) == 3
    assert len(io.read_garment(tmp_path / "g.obj", mesh=["Body"]).faces) == 2
    np.savez(tmp_path / "g.npz", vertices=np.eye(3), faces=[[0, 1, 2]])
    with pytest.raises(InputError, match=r"garment\.mesh: a file of one of \.obj, \.glb"):
        io.read_garment(tmp_path / "g.npz", mesh=["Body"])


SQUASHED = {  # corners of a polygon, of which some nearly coincide, repeat, or cross a little
    "swapped": [[0, 0], [0.0003, 0.0002], [-0.02, 0.02], [0.02, 0.021]],
    "swapped, 1 mm": [[0, 0], [0.001, -0.0002], [0.019, 0.02], [0.02, 0.02]][::-1],
    "needle": [[0, 0], [0.02, 0.0001], [0.04, 0], [0.02, -0.0001]],
    "coincide": [[0, 0], [0, 0], [0.02, 0.02], [0, 0.02]],
    "line": [[0, 0], [0.01, 0], [0.02, 0], [0.02, 0.02]],
    "five": [[0, 0], [0.02, 0], [0.0203, 0.0001], [0.02, 0.0002], [0, 0.02]],
    "spike": [[0, 0], [0.02, 0], [0.02, 0.02], [0.0201, 0.03], [0.02, 0.02], [0, 0.02]],
}


@pytest.mark.parametrize("name", SQUASHED)
@pytest.mark.parametrize("turned", range(6))
def test_a_squashed_polygon_is_cut_so_that_little_is_folded(name, turned):
    flat = np.roll(np.array(SQUASHED[name]), turned, axis=0)
    x = np.pad(flat, ((0, 0), (0, 1))) @ TURN.T
    faces = triangulate(Path("f"), x, np.array([len(x)]), np.arange(len(x)))
    a, b, c = (flat[faces[:, k]] for k in range(3))
    areas = ((b - a)[:, 0] * (c - b)[:, 1] - (b - a)[:, 1] * (c - b)[:, 0]) / 2
    whole = 0.5 * sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(flat, np.roll(flat, -1, axis=0), strict=True))
    sign = np.sign(whole) or 1
    assert len(faces) == len(x) - 2 and areas.sum() == pytest.approx(whole, abs=1e-12)
    assert -(sign * areas).clip(max=0).sum() <= max(0.05 * abs(whole), 0.015 * (np.ptp(flat, axis=0) ** 2).sum())


def test_repeated_corners_are_left_out_and_large_crossings_refused():
    x = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    counts, corners = np.array([5, 4, 4]), np.array([0, 0, 1, 2, 3, 0, 1, 2, 2, 3, 0, 0, 3])
    assert triangulate(Path("f"), x, counts, corners).tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    crossed = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0.0, 0.7, 0]])
    with pytest.raises(InputError, match="does not cross itself"):
        triangulate(Path("f"), crossed, np.array([4]), np.arange(4))

"""Garments that are worn together, as one model in which each feels the others."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax import InputError, assemble, load_run, load_scene, measure, simulate, train
from ncs_jax.cli import main
from ncs_jax.energies.contact.layers import Upper, layer_blocks, layer_product, layers, rim_ways
from ncs_jax.energies.contact.outside import put_outside
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.io import GarmentRecord, read_animation, worn_together
from ncs_jax.runs.outside import outside_body
from ncs_jax.view.character import animation_of
from ncs_jax.view.pictures import CLOTH, OVER, _stage

from .scenes import SCENE, write_scene
from .shapes import sheet, tube


def two_sheets(gap, shift=(0.0, 0.0)):
    """A sheet of 0.2 m in z = 0, facing +z, and a smaller one above its middle: all positions, and the upper one."""
    below, faces = sheet(11, 11, 0.02)
    above, _ = sheet(3, 3, 0.01)
    above = above + [0.0913 + shift[0], 0.0927 + shift[1], gap]
    upper = Upper(surface_from(above, below, faces), len(below), len(below) + len(above))
    return jnp.asarray(np.concatenate([below, above])), (upper,)


def energy_of(uppers):
    """The energy of positions, J: 4 mm thick, 10 J/m^2."""
    return jax.jit(lambda x: layers(x, uppers, 0.004, 10.0))


def test_energy_is_that_of_contact_with_what_lies_below():
    """9 vertices 1 mm above a plane, of a cloth 4 mm thick: 9 k (3 mm)^2; farther off than the thickness it is zero."""
    x, uppers = two_sheets(0.001)
    energy = energy_of(uppers)
    assert float(energy(x)) == pytest.approx(9 * 10 * 0.003**2, rel=1e-6)
    value, slope = jax.jit(jax.value_and_grad(energy))(two_sheets(0.0041)[0])
    assert value == 0 and not np.any(slope)
    both = jnp.stack([x, two_sheets(-0.001)[0]], axis=-1)  # beside each other as each by itself
    np.testing.assert_allclose(energy(both), [energy(both[..., k]) for k in range(2)], rtol=1e-9)


def test_force_meets_counterforce_and_differences(rng):
    """Of a wavy sheet below: no force and no moment in all, and the gradient is that of finite differences."""
    x, uppers = two_sheets(-0.001)
    x = np.array(x)
    x[:, 2] += 0.002 * np.sin(40 * x[:, 0]) * np.cos(30 * x[:, 1])
    energy = energy_of(uppers)
    slope = np.asarray(jax.jit(jax.grad(energy))(x))
    below, above = np.split(slope, [uppers[0].first])
    assert np.all(above[:, 2] < 0) and below[:, 2].sum() == pytest.approx(-above[:, 2].sum(), rel=1e-9)
    size = np.abs(slope).sum(axis=0).max()
    np.testing.assert_allclose(slope.sum(axis=0), 0, atol=1e-9 * size)
    np.testing.assert_allclose(np.cross(x, slope).sum(axis=0), 0, atol=1e-9 * size)
    way, h = rng.normal(size=x.shape), 1e-7
    assert (energy(x + h * way) - energy(x - h * way)) / (2 * h) == pytest.approx(np.sum(slope * way), rel=1e-5)


def test_each_of_three_feels_those_below_it_and_above(rng):
    """A wavy sheet, one over it and a third over both, in three poses: as each upper one by itself, and by differences."""
    x, (second,) = two_sheets(-0.001)
    x, faces = np.asarray(x), np.concatenate([np.asarray(second.below.faces), second.first + sheet(3, 3, 0.01)[1]])
    x = np.concatenate([x, x[second.first :] + [0.011, 0.002, 0.002]])
    third = Upper(surface_from(x[second.stop :], x[: second.stop], faces), second.stop, len(x))
    x = x[..., None] + 0.001 * rng.normal(size=(*x.shape, 3))
    energy, *each = (energy_of(uppers) for uppers in ((second, third), (second,), (third,)))
    parts, slope = [alone(x) for alone in each], np.asarray(jax.jit(jax.grad(lambda x: energy(x).sum()))(x))
    assert np.min(parts) > 0
    np.testing.assert_allclose(energy(x), sum(parts), rtol=1e-9)
    way, h = rng.normal(size=x.shape), 1e-7
    found = (energy(x + h * way) - energy(x - h * way)) / (2 * h)
    np.testing.assert_allclose(found, np.sum(slope * way, axis=(0, 1)), rtol=1e-5)


def test_cloth_beyond_a_rim_touches_nothing():
    """Half of the upper sheet hangs past the edge of the lower one, and below its plane."""
    x, uppers = two_sheets(-0.003, (0.09, 0.0))
    slope = np.asarray(jax.jit(jax.grad(energy_of(uppers)))(x))[uppers[0].first :]
    beyond = np.asarray(x)[uppers[0].first :, 0] > 0.2
    assert beyond.any() and not beyond.all()
    assert not slope[beyond].any() and np.all(slope[~beyond, 2])  # also where the nearest vertex is on the rim


def test_cloth_at_a_rim_is_put_outside_and_beyond_it_is_left():
    """As contact touches it: the sheet below is whole where the upper one is over its last row."""
    x, (upper,) = two_sheets(-0.003, (0.09, 0.0))
    lower, own = x[: upper.first], x[upper.first :]
    found = put_outside(own, lower, upper.below, jnp.ones(len(lower)), 0.003, rim_ways(lower, upper.below))
    beyond = np.asarray(own)[:, 0] > 0.2
    np.testing.assert_array_equal(found[beyond], own[beyond])
    np.testing.assert_allclose(found[~beyond], np.asarray(own)[~beyond] + [0, 0, 0.006], atol=1e-9)
    assert np.any(np.asarray(own)[~beyond, 0] > 0.19)


def test_nothing_jumps_past_a_rim(rng):
    """By triangles: energy and force over the rim of a wavy sheet, and their agreement, go on; a thickness past it is none."""
    x, uppers = two_sheets(-0.001, (0.09, 0.0))
    x = np.array(x)
    x[:, 2] += 0.002 * np.sin(40 * x[:, 0]) * np.cos(30 * x[:, 1])
    x, own = jnp.asarray(x), np.s_[uppers[0].first :]
    energy = jax.jit(lambda x: layers(x, uppers, 0.004, 10.0, planes=False))
    slope = jax.jit(jax.grad(lambda x: layers(x, uppers, 0.004, 10.0, planes=False)))
    found = np.asarray(slope(x))
    size = np.abs(found).sum(axis=0).max()
    np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-9 * size)
    np.testing.assert_allclose(np.cross(x, found).sum(axis=0), 0, atol=1e-7 * size)
    for _ in range(3):
        way, h = rng.normal(size=x.shape), 1e-8
        assert (energy(x + h * way) - energy(x - h * way)) / (2 * h) == pytest.approx(np.sum(found * way), rel=1e-4)
    heights = np.array([float(energy(x.at[own, 0].add(s))) for s in np.linspace(0, 0.0167, 200)])
    assert np.abs(np.diff(heights)).max() < 0.03 * heights[0] and heights[-1] < 0.7 * heights[0]
    alone = x.at[own].set(np.array([0.2041, 0.1, -0.001]) + 1e-4 * np.asarray(x)[own])
    assert float(energy(alone)) == 0


def test_blocks_are_no_less_than_the_second_derivative(rng):
    """Along the planes' normals, where the sheet below moves as a whole: its planes do not turn."""
    x, uppers = two_sheets(0.001)
    blocks = np.asarray(layer_blocks(x, uppers, 0.004, 10.0))
    energy = energy_of(uppers)
    curvature = np.asarray(jax.jit(jax.hessian(lambda height: energy(x.at[:, 2].set(height))))(x[:, 2]))
    found = []
    for way in rng.normal(size=(20, len(x))):
        flat = np.where(np.arange(len(x)) < uppers[0].first, way[0], way)
        found.append((flat @ curvature @ flat) / np.einsum("v,v,v", flat, blocks[:, 2, 2], flat))
    assert 0.05 < max(found) <= 1 + 1e-9


def test_product_is_that_of_the_second_derivative(rng):
    """Of fields along the normal, where the sheet below moves as a whole: its planes do not turn."""
    x, uppers = two_sheets(0.001)
    product = layer_product(x, uppers, 0.004, 10.0)
    slope = jax.jit(jax.grad(lambda x: layers(x, uppers, 0.004, 10.0, planes=False)))
    for _ in range(3):
        height = rng.normal(size=len(x))
        height[: uppers[0].first] = height[0]
        way = jnp.asarray(height[:, None] * [0, 0, 1])
        small = 1e-7 * way
        expected = (slope(x + small) - slope(x - small)) / 2e-7
        np.testing.assert_allclose(product(way)[:, 2], expected[:, 2], atol=1e-4 * float(jnp.abs(expected).max()))


def record(count, **more):
    x, faces = sheet(3, count)
    return GarmentRecord(x.astype(np.float32), faces, **more)


def test_records_are_joined_from_the_skin_outwards():
    first = record(3, groups={"pins": np.array([1, 2], np.int32)}, uv=np.zeros((8, 3, 2)), notes=("a",))
    second = record(4, groups={"pins": np.array([0], np.int32)}, weights=np.ones((12, 1)), notes=("b",))
    found = worn_together(("a/shirt.obj", "shirt.npz"), (first, second))
    assert found.layers == (9,) and found.vertices.shape == (21, 3) and found.faces.max() == 20
    np.testing.assert_array_equal(found.faces[len(first.faces) :], second.faces + 9)
    np.testing.assert_array_equal(found.groups["pins"], [1, 2, 9])
    np.testing.assert_array_equal(found.groups["shirt"], np.arange(9))
    np.testing.assert_array_equal(found.groups["shirt 2"], np.arange(9, 21))
    assert found.uv is None and found.weights is None
    assert found.notes[:2] == ("a", "b") and "not all of them" in found.notes[2] and "shirt.npz has none" in found.notes[3]


LAYERED = SCENE.replace('"cloth.npz"\n', '"inner.npz"\nlayers = ["outer.npz"]\npins = "pins"\n')


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sleeve around the upper half of the post, and another one of which the lower half is within it at rest."""
    folder = tmp_path_factory.mktemp("together")
    write_scene(folder)
    for name, radius, narrow in (("inner", 0.1, 0.0), ("outer", 0.115, 0.02)):
        x, faces = tube(24, 14, radius, 0.5)
        x[:, [0, 2]] *= 1 - narrow / radius * (x[:, 1:2] < 0.25)
        faces = faces[:, ::-1] if name == "inner" else faces  # which way triangles face does not matter: see below
        np.savez(folder / f"{name}.npz", vertices=x + [0, 0.35, 0], faces=faces, group_pins=np.arange(13 * 24, 14 * 24))
    (folder / "layered.toml").write_text(LAYERED)
    return folder


@pytest.fixture(scope="module")
def worn(folder):
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return assemble(load_scene(folder / "layered.toml"))


def test_the_model_knows_who_is_over_whom(worn):
    (upper,) = worn.model.garment.uppers
    assert worn.model.terms.layers == "plane" and not worn.model.terms.self_contact
    assert (upper.first, upper.stop) == (336, 672) and worn.garment.layers == (336,)
    assert len(worn.model.garment.pins) == 48
    around = np.asarray(worn.model.garment.mesh.rest)[:336] * [1, 0, 1]
    a, b, c = (around[np.asarray(upper.below.faces)[:, k]] + [0, 1, 0] for k in range(3))
    rest = np.asarray(worn.model.garment.mesh.rest)
    a, b, c = (rest[np.asarray(upper.below.faces)[:, k]] for k in range(3))
    assert np.all(np.sum(np.cross(b - a, c - a) * [1, 0, 1] * a, axis=1) > 0)


def test_which_way_a_garment_faces_does_not_matter(folder, worn, tmp_path):
    """All is found as if it faced outward: skinning weights, skin that is touched, and which of it is beside the garments."""
    for name in ("inner", "outer"):
        with np.load(folder / f"{name}.npz") as file:
            arrays = dict(file)
        outward = arrays["faces"][:, ::-1] if name == "inner" else arrays["faces"]
        np.savez(tmp_path / f"{name}.npz", **{**arrays, "faces": outward})
    for name in ("body.npz", "swing.npz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "scene.toml").write_text(LAYERED)
    given = assemble(load_scene(tmp_path / "scene.toml"))
    for name in ("weights", "part", "basis"):
        np.testing.assert_array_equal(getattr(given.prepared, name), getattr(worn.prepared, name), err_msg=name)
    np.testing.assert_array_equal(given.garment.faces, worn.garment.faces)
    assert any("face inward: they were turned" in note for note in worn.garment.notes) and not given.garment.notes


def test_a_coarse_garment_touches_between_its_vertices_too(folder, tmp_path):
    """A tube of six sides whose corners are outside a round one, and whose sides are inside it."""
    for name in ("body.npz", "swing.npz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    for name, (around, rings, radius) in {"inner": (36, 14, 0.1), "outer": (6, 5, 0.107)}.items():
        x, faces = tube(around, rings, radius, 0.4)
        np.savez(tmp_path / f"{name}.npz", vertices=x + [0, 0.4, 0], faces=faces)
    found = {}
    for points in ("0", "2"):
        text = LAYERED.replace('pins = "pins"\n', "").replace(
            "[network]", f'[physics.collision]\npoints = "{points}"\n[network]'
        )
        (tmp_path / "scene.toml").write_text(text)
        given = assemble(load_scene(tmp_path / "scene.toml"))
        rest = np.asarray(given.model.garment.mesh.rest)[None]
        rows = measure(given.model, rest, given.track, exact=False, self_contact=True)
        found[points] = rows["layers"][0], rows["layer_depth_max"][0], rows["self_intersecting"][0]
    assert found["0"][0] == found["0"][1] == 0 and found["0"][2] > 10
    assert found["2"][0] > 0 and found["2"][1] > 5


def test_both_give_way_while_they_are_trained(folder, worn, plain_jax):
    """After some steps nothing is deep in the other, and both have moved; without contact between them they stay so."""
    motion = str(folder / "swing.npz")
    run = train(worn.scene, folder / "run", steps=300, report=None)
    model, track = run.assembly.model, run.track(motion)
    depth = measure(model, run.animate(motion), track)["layer_depth_max"]
    rest = np.repeat(np.asarray(model.garment.mesh.rest)[None], 1, axis=0)
    before = measure(model, rest, track)["layer_depth_max"]
    assert before[0] > 4 and depth.max() < 1.5
    parts = run.evaluate(motion)
    assert np.all(parts["layers"] >= 0) and parts["layer_penetrating"].shape == (24,)
    np.testing.assert_array_equal(load_run(folder / "run").animate(motion), run.animate(motion))
    on = train(worn.scene, folder / "on", start=folder / "run", steps=1, report=None)
    assert on.steps == 1
    assert main(["animate", str(folder / "run"), "--as-trained", "--out", str(folder / "swing.pc2")]) == 0
    for name, own in (("inner", np.s_[:, :336]), ("outer", np.s_[:, 336:])):
        np.testing.assert_array_equal(read_animation(folder / f"swing_{name}.pc2").vertices, run.animate(motion)[own])
    run.export(folder / "step.onnx")
    inner, outer = json.loads((folder / "step.onnx.json").read_text())["garments"]
    assert inner == {"name": "inner", "first": 0, "vertices": 336} and outer["first"] == outer["vertices"] == 336
    one = dataclasses.replace(worn.scene, garment=dataclasses.replace(worn.scene.garment, layers=()))
    with pytest.raises(InputError, match=r"inner.npz, .*outer.npz with 1248 triangles, which .*found 'inner.npz, 624"):
        train(one, folder / "one", start=folder / "run", steps=1)


def test_what_is_animated_is_put_outside_of_what_lies_below(worn, plain_jax):
    """The lower half of the outer sleeve is 5 mm in the inner one at rest; it comes to 3 mm outside, the inner one stays."""
    model, track, rest = worn.model, worn.track, np.asarray(worn.model.garment.mesh.rest)
    x = outside_body(model, track, rest[None])
    before, after = (measure(model, each, track, exact=False)["layer_depth_max"][0] for each in (rest[None], x))
    assert before > 4 and after == 0
    bare = dataclasses.replace(model, garment=dataclasses.replace(model.garment, uppers=()))
    np.testing.assert_array_equal(x[0, :336], outside_body(bare, track, rest[None])[0, :336])
    moved = np.linalg.norm(x[0, 336:] - rest[336:], axis=1)
    assert 0.006 < moved.max() < 0.012 and moved[rest[336:, 1] > 0.62].max() == 0


@pytest.mark.slow
def test_both_give_way_in_a_simulation(worn, folder, plain_jax):
    """With contact that converges: the inner one is pressed in, and the outer one is not in it."""
    collision = dataclasses.replace(worn.scene.physics.collision, distance="smooth")
    physics = dataclasses.replace(worn.scene.physics, collision=collision)
    motion = dataclasses.replace(worn.scene.motion, frames=(0, 2))
    found = simulate(dataclasses.replace(worn.scene, physics=physics, motion=motion), "swing.npz")
    assert found.assembly.model.terms.layers == "triangle" and found.status[0] == 0
    x = found.vertices.astype(np.float32)
    assert measure(worn.model, x, worn.track)["layer_depth_max"].max() < 0.5
    radius = np.linalg.norm(x[0][:, [0, 2]], axis=1)
    low = np.asarray(worn.model.garment.mesh.rest)[:, 1] < 0.5
    first = np.arange(672) < 336
    assert radius[low & first].mean() < 0.097 < 0.1 < radius[~low & ~first].mean()


def test_self_contact_sees_layers_by_itself(worn):
    physics = dataclasses.replace(
        worn.scene.physics, self_contact=dataclasses.replace(worn.scene.physics.self_contact, stiffness=20.0)
    )
    model = assemble(dataclasses.replace(worn.scene, physics=physics)).model
    assert model.terms.self_contact and not model.terms.layers and len(model.garment.uppers) == 1  # who is over whom is known


def test_garments_of_one_file(folder, worn):
    """As an outfit is exported: a mesh of its own for each; the model is that of two files."""
    lines, count = [], 1
    for name in ("inner", "outer"):
        with np.load(folder / f"{name}.npz") as table:
            arrays = dict(table)
        lines += [f"o {name}", *("v {:.9g} {:.9g} {:.9g}".format(*v) for v in arrays["vertices"])]
        lines += ["f {} {} {}".format(*(f + count)) for f in arrays["faces"]]
        count += len(arrays["vertices"])
    (folder / "outfit.obj").write_text("\n".join(lines))
    text = LAYERED.replace('"inner.npz"', '"outfit.obj"\nmesh = "inner"').replace("outer.npz", "outfit.obj#outer")
    text = text.replace('pins = "pins"\n', "")
    (folder / "outfit.toml").write_text(text)
    found = assemble(load_scene(folder / "outfit.toml"))
    np.testing.assert_allclose(found.garment.vertices, worn.garment.vertices, atol=1e-8)
    np.testing.assert_array_equal(found.garment.faces, worn.garment.faces)
    assert found.garment.layers == (336,) and "outer" in found.garment.groups
    for name, said in (
        ("outfit.obj#coat", r"layers\[0\]: no such mesh in the file.*'coat'.*write outfit\.obj#NAME, of .*outer"),
        ("outfit.obj", r"layers\[0\]: another garment expected.*FILE#MESH"),
        ("./outfit.obj", r"layers\[0\]: one object expected.*write outfit\.obj#NAME, of .*outer"),
    ):
        (folder / "outfit.toml").write_text(text.replace("outfit.obj#outer", name))
        with pytest.raises(InputError, match=said):
            assemble(load_scene(folder / "outfit.toml"))


def test_each_is_drawn_in_a_colour_of_its_own(worn, folder):
    (motion,) = worn.motions.values()
    x = np.repeat(worn.garment.vertices[None], len(motion.poses), axis=0)
    cloth = _stage(animation_of(worn, motion, x)).meshes(0)[0]
    np.testing.assert_array_equal(cloth.colour[[0, 335, 336, 671]], [CLOTH, CLOTH, OVER[0], OVER[0]])


def test_what_cannot_be_worn_together_is_refused(folder, worn, capsys):
    for old, new, said in (
        ('"outer.npz"', '"gone.npz"', "garment.layers[0]"),
        ('"outer.npz"', '"inner.npz"', "garment.layers[0]: another garment expected"),
        ("[motion]", "[physics.collision]\nstiffness = 0\n[motion]", "contact expected, by which garments worn together"),
    ):
        (folder / "bad.toml").write_text(LAYERED.replace(old, new))
        with pytest.raises(InputError) as error:
            assemble(load_scene(folder / "bad.toml"))
        assert said in str(error.value)
    assert main(["check", str(folder / "layered.toml"), "--out", str(folder / "check.png")]) == 0
    out = capsys.readouterr().out
    assert "layers" in out and "outer.npz: 336 vertices, from 336 on" in out

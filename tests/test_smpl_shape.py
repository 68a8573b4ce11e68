"""Shape and pose correctives of SMPL's models: the body in a scene is where the model's own formula puts it."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.geometry.skinning import Skeleton, corrected, correctives_from, forward, transforms
from ncs_jax.io.character.smpl import smpl_parents
from ncs_jax.prepare.build import build
from ncs_jax.scene.model import pose_body
from ncs_jax.scene.spec import load_scene, scene_from
from ncs_jax.view.character import body_vertices
from tools.check_smpl import formula, packages

from .scenes import grid, post

LAYOUTS = {  # joints, components, of them shape
    "SMPL of 10": (24, 10, 10),
    "SMPL of 300": (24, 300, 300),
    "SMPL-H of 16": (52, 16, 16),
    "SMPL-X of 400": (55, 400, 300),
    "SMPL-X of 20": (55, 20, 10),
}


def model_file(rng, joints=24, components=10, flat="") -> dict:
    """A post with the tree of a model, each vertex moved by its nearest four joints, as a model file's arrays."""
    body, parents = post(), smpl_parents(joints)
    x = body["vertices"]
    place = np.stack([0.02 * rng.normal(size=joints), np.linspace(0.1, 0.9, joints), 0.02 * rng.normal(size=joints)], axis=1)
    near = np.argsort(np.linalg.norm(x[:, None] - place, axis=2), axis=1)[:, :4]
    weights = np.zeros((len(x), joints))
    np.put_along_axis(weights, near, rng.dirichlet(np.ones(4), len(x)), axis=1)
    regressor = rng.dirichlet(np.ones(len(x)), joints) * 0.2 + 0.8 * (near[:, :1] == np.arange(joints)).T / len(x)
    posedirs = rng.normal(scale=1e-3, size=(len(x), 3, 9 * (joints - 1)))
    flats = {"": posedirs, "rows": posedirs.reshape(3 * len(x), -1), "columns": posedirs.reshape(3 * len(x), -1).T}
    return {
        "v_template": x, "f": body["faces"], "weights": weights, "J_regressor": regressor,
        "kintree_table": np.stack([np.array([2**32 - 1, *parents[1:]]), np.arange(joints)]),
        "shapedirs": rng.normal(scale=1e-3, size=(len(x), 3, components)), "posedirs": flats[flat],
    }  # fmt: skip


def write(folder, fields, betas=None, body="", frames=5, rng=None):
    """A scene with a model file and motions of AMASS's kind."""
    rng = rng or np.random.default_rng(3)
    joints = fields["weights"].shape[1]
    vertices, faces = grid()
    np.savez(folder / "cloth.npz", vertices=vertices, faces=faces)
    np.savez(folder / "model.npz", **fields)
    for name, own in (("a", betas), ("b", betas)):
        given = {} if own is None else {"betas": np.asarray(own)}
        poses = 0.3 * rng.normal(size=(frames, joints, 3))
        np.savez(folder / f"{name}.npz", poses=poses, trans=0.1 * rng.normal(size=(frames, 3)), fps=30.0, **given)
    text = f'[body]\nfile = "model.npz"\npart = "all"\n{body}\n[garment]\nfile = "cloth.npz"\n'
    (folder / "s.toml").write_text(text + '[motion]\nfiles = ["a.npz", "b.npz"]\n[network]\nmodes = 0\n')
    return load_scene(folder / "s.toml")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_shape_is_the_models(tmp_path, rng, layout):
    joints, components, shape = LAYOUTS[layout]
    fields = model_file(rng, joints, components, "columns")
    np.savez(tmp_path / "m.npz", **fields)
    betas = rng.normal(size=shape)
    body = io.read_body(tmp_path / "m.npz", betas=betas)
    right = fields["v_template"] + np.einsum("vab,b->va", fields["shapedirs"][:, :, :shape], betas)
    np.testing.assert_allclose(body.vertices, right, atol=1e-12)
    np.testing.assert_allclose(body.joints, fields["J_regressor"] @ right, atol=1e-12)
    assert body.posedirs is not None and body.posedirs.shape == (len(right), 3, 9 * (joints - 1))
    with pytest.raises(InputError, match=f"body.betas: at most {shape} numbers"):
        io.read_body(tmp_path / "m.npz", betas=np.ones(shape + 1))


@pytest.mark.parametrize(("joints", "flat"), [(24, ""), (24, "rows"), (52, "columns")])
def test_the_posed_body_is_the_formulas(tmp_path, rng, joints, flat):
    """Of a scene's touchable part, one frame and several beside each other, and of the whole body in pictures."""
    fields, betas = model_file(rng, joints, 10, flat), [0.7, -1.2, 0.4]
    scene = write(tmp_path, fields, body=f"betas = {betas}")
    assembly = build(scene, dtype=jnp.float64)
    model, track, motion = assembly.model, assembly.track, assembly.motions["a.npz"]
    frames = len(motion.poses)
    right = np.array([formula(fields, betas, p, t) for p, t in zip(motion.poses, motion.translation, strict=True)])
    matrices = track.matrices[:frames]
    lanes = np.moveaxis(np.asarray(pose_body(model, jnp.moveaxis(matrices, 0, -1))), -1, 0)
    np.testing.assert_allclose(lanes, right, rtol=0, atol=1e-6)
    np.testing.assert_allclose(pose_body(model, matrices[2]), right[2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(body_vertices(assembly.body, motion), right, atol=1e-4)  # single precision
    tool = packages(io.read_body(tmp_path / "model.npz", betas=betas), motion.poses[1], motion.translation[1])
    np.testing.assert_allclose(tool, right[1], rtol=0, atol=1e-6)
    without = np.asarray(pose_body(replace(model, correctives=None), matrices[2]))
    assert np.abs(without - right[2]).max() > 1e-3  # the correctives are what makes the difference


def test_correctives_of_joints_that_do_not_correct_are_left_out(rng):
    posedirs = np.zeros((7, 3, 9 * 23))
    posedirs[:, :, 9 * 4 : 9 * 5], posedirs[0, 0, 9 * 17] = rng.normal(size=(7, 3, 9)), 1e-3
    found = correctives_from(posedirs, dtype=jnp.float64)
    assert found.joints == (5, 18) and found.directions.shape == (7, 3, 18)
    turns = Rotation.from_rotvec(rng.normal(size=(24, 3))).as_matrix()
    skeleton = Skeleton(jnp.asarray(rng.normal(size=(24, 3))), tuple(smpl_parents(24).tolist()))
    matrices = transforms(skeleton, forward(skeleton, jnp.asarray(turns), jnp.zeros(3)))
    right = posedirs @ (turns[1:] - np.eye(3)).reshape(-1)
    np.testing.assert_allclose(corrected(jnp.zeros((7, 3)), found, matrices, skeleton.parents), right, atol=1e-12)


def test_a_body_without_correctives_has_none_in_its_model(tmp_path, rng):
    fields = model_file(rng)
    for change in ({"body": "correctives = false"}, {}):
        if not change:
            del fields["posedirs"]
        assembly = build(write(tmp_path, fields, **change))
        assert assembly.body.posedirs is None and assembly.model.correctives is None


def test_betas_of_the_motions(tmp_path, rng):
    fields, betas = model_file(rng, 52, 16), np.array([0.5, -0.25, *np.zeros(14)])
    scene = write(tmp_path, fields, betas, 'betas = "motion"')
    assembly = build(scene)
    np.testing.assert_array_equal(assembly.body.vertices, io.read_body(tmp_path / "model.npz", betas=betas[:2]).vertices)
    assert assembly.prepared.betas.tolist() == [0.5, -0.25]
    (tmp_path / "a.npz").unlink(), (tmp_path / "b.npz").unlink()
    again = build(scene_from(scene.to_dict(), source=scene.source), prepared=assembly.prepared)  # a run needs no motion
    np.testing.assert_array_equal(again.body.vertices, assembly.body.vertices)
    write(tmp_path, fields, betas, 'betas = "motion"')
    with np.load(tmp_path / "b.npz") as file:
        np.savez(tmp_path / "b.npz", **{**file, "betas": betas + 1})
    with pytest.raises(InputError, match=r"body.betas: motions of one person expected.*a\.npz and b\.npz"):
        build(scene)
    write(tmp_path, fields, None)
    with pytest.raises(InputError, match=r"a\.npz: betas: a motion with betas expected"):
        build(scene)


@pytest.mark.parametrize(
    ("changes", "betas", "words"),
    [
        ({"shapedirs": None}, [1.0], "body.betas: shapedirs expected in the file"),
        ({"shapedirs": np.zeros((5, 3, 10))}, [1.0], r"shapedirs: an array of shape \(194, 3, B\)"),
        ({"posedirs": np.zeros((194, 3, 9))}, [], r"posedirs: an array of shape \(194, 3, 207\)"),
        ({"posedirs": np.full((194, 3, 207), np.inf)}, [], "posedirs, vertex 0, axis 0: finite"),
        ({"v_template": None}, [1.0], "body.betas: an SMPL model with shapedirs expected"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, rng, changes, betas, words):
    fields = {k: v for k, v in (model_file(rng) | changes).items() if v is not None}
    np.savez(tmp_path / "m.npz", **fields)
    with pytest.raises(InputError, match=words):
        io.read_body(tmp_path / "m.npz", betas=betas)


@pytest.mark.parametrize(
    ("text", "words"), [('betas = "mean"', "one of motion"), ("betas = 3", "a list"), ('betas = ["a"]', "a number")]
)
def test_betas_in_a_scene_file_are_numbers_or_one_word(tmp_path, text, words):
    (tmp_path / "s.toml").write_text(f"[body]\n{text}\n")
    with pytest.raises(InputError, match=f"body.betas.*{words}"):
        load_scene(tmp_path / "s.toml")

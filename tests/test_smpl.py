"""SMPL, SMPL-H, SMPL-X and AMASS: model files as distributed, motions for one another's bodies, and Z up."""

from __future__ import annotations

import pickle
import re
import shlex
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.motion_import import load_motion, retarget_to_body
from ncs_jax.prepare.retarget import with_skeleton
from ncs_jax.scene.spec import MotionSpec, scene_from
from tests.test_retarget import body_of, directions, forward

UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from Z up to Y up


def model(rng, joints=24, vertices=40) -> dict:
    """The arrays of a model file, some that are not asked for among them."""
    regressor = rng.random((joints, vertices)) * (rng.random((joints, vertices)) < 0.3)
    regressor[:, 0] += 0.1
    weights = rng.random((vertices, joints))
    root = np.array([2**32 - 1, *smpl_parents(joints)[1:]], np.uint32)
    return {
        "v_template": rng.normal(size=(vertices, 3)),
        "f": rng.integers(vertices, size=(9, 3)).astype(np.uint32),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([root, np.arange(joints, dtype=np.uint32)]),
        "posedirs": rng.normal(scale=0.01, size=(vertices, 3, 9 * (joints - 1))),
        "joint2num": np.array([{}], object),
        "J": rng.normal(size=(joints, 3)),
    }


def sparse(fields: dict, kind) -> dict:
    matrix = kind(fields["J_regressor"])
    parts = {f"J_regressor_{n}": getattr(matrix, n) for n in ("data", "indices", "indptr")}
    return {k: v for k, v in fields.items() if k != "J_regressor"} | parts


def motion(rng, joints: int, **changes) -> dict:
    fields = {"poses": rng.normal(size=(6, 3 * joints)), "trans": rng.normal(size=(6, 3)), "fps": 30.0}
    return {k: v for k, v in (fields | changes).items() if v is not None}


def amass(rng, joints: int, **changes) -> dict:
    return motion(rng, joints, fps=None, mocap_framerate=120.0, betas=np.zeros(16), gender="male", **changes)


def save(path, fields):
    np.savez(path, **fields)
    return path


def body(rng, joints: int) -> io.BodyRecord:
    fields = model(rng, joints)
    parents = smpl_parents(joints)
    return io.BodyRecord(fields["v_template"], np.array([[0, 1, 2]]), fields["J"], parents, fields["weights"])


@pytest.mark.parametrize("joints", [22, 24, 52, 55])
def test_the_tree(joints):
    names, parents = smpl_names(joints), smpl_parents(joints)
    assert len(names) == len(set(names)) == len(parents) == joints and parents[0] == -1
    assert np.all(parents[1:] < np.arange(1, joints))
    above = {n: names[p] for n, p in zip(names, parents, strict=True)}
    assert above["left_wrist"] == "left_elbow" and above["neck"] == above["right_collar"] == "spine3"
    if joints >= 52:
        assert above["left_index1"] == "left_wrist" and above["right_thumb3"] == "right_thumb2"
        assert parents[joints - 30 :: 3].tolist() == [20] * 5 + [21] * 5
    if joints == 55:
        assert above["jaw"] == above["left_eye_smplhf"] == "head" and names[22:26] == (*names[22:25], "left_index1")
    assert smpl_names(31) == ()


@pytest.mark.parametrize("joints", [24, 52, 55])
def test_a_model_file_is_a_body(tmp_path, rng, joints):
    fields = model(rng, joints)
    record = io.read_body(save(tmp_path / "m.npz", fields))
    np.testing.assert_allclose(record.joints, fields["J_regressor"] @ fields["v_template"], atol=1e-12)
    assert np.array_equal(record.vertices, fields["v_template"]) and np.array_equal(record.faces, fields["f"])
    np.testing.assert_allclose(record.weights, fields["weights"])
    assert record.parents.tolist() == smpl_parents(joints).tolist() and record.joint_names == smpl_names(joints)
    for kind in (scipy.sparse.csr_matrix, scipy.sparse.csc_matrix):
        other = io.read_body(save(tmp_path / "s.npz", sparse(fields, kind)))
        np.testing.assert_allclose(other.joints, record.joints, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kintree_table": np.arange(24)}, r"kintree_table: shape \(2, J\)"),
        ({"kintree_table": np.array([[0, 2, 1], [0, 1, 2]])}, "kintree_table, joint 1: one root"),
        ({"J_regressor": np.ones((23, 40))}, r"J_regressor: .*\(24, 40\)"),
        ({"J_regressor": np.array([{}], object)}, "J_regressor: plain numbers.*pickle"),
        ({"v_template": np.full((40, 3), np.nan)}, "v_template, vertex 0: finite"),
        ({"weights": np.ones((40, 24))}, "blend_weights, vertex 0: weights that sum to 1"),
        ({"f": np.array([[0, 1, 40]])}, "faces.*0 to 39"),
        ({"J_regressor": None}, "J_regressor: missing"),
        ({"kintree_table": None}, "kintree_table: missing"),
    ],
)
def test_broken_model_files(tmp_path, rng, changes, words):
    fields = {k: v for k, v in (model(rng) | changes).items() if v is not None}
    with pytest.raises(InputError, match=words):
        io.read_body(save(tmp_path / "m.npz", fields))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("indptr", np.arange(7), "one more than joints or vertices"), ("indices", np.array([99]), "J_regressor_indices"),
     ("indptr", np.arange(25)[::-1], "rise from 0"), ("data", None, "J_regressor: missing")],
)  # fmt: skip
def test_broken_sparse_regressors(tmp_path, rng, name, value, words):
    fields = sparse(model(rng), scipy.sparse.csr_matrix)
    if name == "indices":
        value = np.concatenate([value, fields["J_regressor_indices"][1:]])
    fields = {k: v for k, v in (fields | {f"J_regressor_{name}": value}).items() if v is not None}
    with pytest.raises(InputError, match=words):
        io.read_body(save(tmp_path / "m.npz", fields))


class Trap:
    """What runs when it is unpickled."""

    def __reduce__(self):
        return exec, ("raise SystemExit('unpickled')",)


def test_a_pickle_is_refused_and_its_conversion_works(tmp_path, rng):
    path = tmp_path / "basic model.pkl"
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(InputError, match=r"basic model.pkl: an .npz expected: a pickle may run any code") as caught:
        io.read_body(path)
    fields = model(rng) | {"J_regressor": scipy.sparse.csc_matrix(model(rng)["J_regressor"])}
    path.write_bytes(pickle.dumps(fields, protocol=2))
    message = str(caught.value)
    assert "\n" not in message
    command = shlex.split(re.search(r"python -c .*$", message)[0])
    assert command[0] == "python"
    subprocess.run([sys.executable, *command[1:]], check=True, cwd=tmp_path, timeout=120)
    record = io.read_body(tmp_path / "basic model.npz")
    np.testing.assert_allclose(record.joints, fields["J_regressor"] @ fields["v_template"])


@pytest.mark.parametrize("theirs", [22, 24, 52, 55])
@pytest.mark.parametrize("ours", [22, 24, 52, 55])
def test_motions_drive_each_others_bodies(tmp_path, rng, ours, theirs):
    fields = motion(rng, theirs)
    record = io.read_motion(save(tmp_path / "m.npz", fields))
    moved = retarget_to_body(record, body(rng, ours), MotionSpec())
    given, a, b = fields["poses"].reshape(6, theirs, 3), smpl_names(ours), smpl_names(theirs)
    for j, name in enumerate(a):
        assert np.array_equal(moved.poses[:, j], given[:, b.index(name)] if name in b else np.zeros((6, 3))), name
    assert np.array_equal(moved.translation, fields["trans"])
    assert bool(moved.notes) == (ours != theirs)
    if ours != theirs:
        assert moved.notes[0] == f"{theirs} joints of the SMPL family drive {len(set(a) & set(b))} of the body's {ours}"


def test_other_counts_are_refused_by_a_body_without_names(tmp_path, rng):
    record = io.read_motion(save(tmp_path / "m.npz", motion(rng, 23)))
    with pytest.raises(InputError, match=r"poses: the body's 24 joints expected.*23 joints"):
        retarget_to_body(record, body(rng, 24), MotionSpec())
    foreign = replace(body(rng, 24), parents=np.arange(-1, 23, dtype=np.int32))
    with pytest.raises(InputError, match="joint_names: a body with joint names"):
        retarget_to_body(io.read_motion(save(tmp_path / "n.npz", motion(rng, 52))), foreign, MotionSpec())


@pytest.mark.parametrize("joints", [24, 52])
@pytest.mark.parametrize("rate", ["mocap_framerate", "mocap_frame_rate"])
def test_amass_is_turned_from_z_up(tmp_path, rng, joints, rate):
    """Every joint of the body stands where the file has it, its world turned."""
    fields = motion(rng, joints, fps=None) | {rate: 120.0}
    record = io.read_motion(save(tmp_path / "m.npz", fields))
    assert record.up == "z" and record.fps == 120
    owner = body(rng, 24)
    moved = retarget_to_body(record, owner, MotionSpec())
    stays = retarget_to_body(record, owner, MotionSpec(up="y"))
    assert moved.notes[-1:] == ("turned from Z up to Y up",) and "turned from Z up to Y up" not in stays.notes
    turns, places = forward(owner.joints, owner.parents, moved)
    theirs, there = forward(owner.joints, owner.parents, stays)
    np.testing.assert_allclose(places, there @ UP.T, atol=1e-9)
    np.testing.assert_allclose(turns, UP @ theirs, atol=1e-9)
    assert np.array_equal(
        retarget_to_body(record, owner, MotionSpec(), "z").translation, stays.translation
    )  # gravity along z: nothing to do
    plain = io.read_motion(save(tmp_path / "n.npz", motion(rng, joints)))
    assert plain.up == "" and np.array_equal(retarget_to_body(plain, owner, MotionSpec()).translation, plain.translation)
    both = retarget_to_body(plain, owner, MotionSpec(up="z"))
    assert both.notes[-1] == "turned from Z up to Y up"


def test_gravity_says_which_way_the_world_is(tmp_path, rng):
    save(tmp_path / "m.npz", amass(rng, 24) | {"trans": np.zeros((6, 3))})
    tables = {"motion": {"files": ["m.npz"], "fps": 120}}
    down = tables | {"physics": {"gravity": [0, 0, -9.81]}}
    owner = body(rng, 24)
    y, z = (load_motion(scene_from(t, str(tmp_path / "s.toml")), "m.npz", owner) for t in (tables, down))
    assert y.notes == ("turned from Z up to Y up",) and z.notes == ()


def test_amass_in_parts(tmp_path, rng):
    whole = rng.normal(size=(6, 165))
    cuts = {"root_orient": (0, 3), "pose_body": (3, 66), "pose_jaw": (66, 69), "pose_eye": (69, 75), "pose_hand": (75, 165)}
    parts = {k: whole[:, a:b] for k, (a, b) in cuts.items()}
    common = {"trans": np.zeros((6, 3)), "mocap_frame_rate": 30.0, "surface_model_type": "smplx"}
    read = lambda fields: io.read_motion(save(tmp_path / "m.npz", common | fields)).poses.reshape(6, -1)  # noqa: E731
    assert np.array_equal(read(parts), whole)
    assert np.array_equal(read(parts | {"poses": 2 * whole}), 2 * whole)
    assert np.array_equal(read({k: parts[k] for k in ("root_orient", "pose_body")}), whole[:, :66])
    without = {k: parts[k] for k in ("root_orient", "pose_body", "pose_hand")}
    assert np.array_equal(read(without), np.concatenate([whole[:, :66], whole[:, 75:]], axis=1))
    np.testing.assert_array_equal(read(without | {"pose_jaw": parts["pose_jaw"]})[:, 69:75], 0)
    with pytest.raises(InputError, match=r"pose_body: .*\(6, 63\)"):
        read(parts | {"pose_body": whole[:, :60]})
    with pytest.raises(InputError, match="pose_body: missing"):
        read({"root_orient": parts["root_orient"]})


def test_a_motion_without_a_skeleton_is_a_persons_in_t_pose(tmp_path, rng):
    """AMASS on another rig: its limbs point as SMPL's, from a T-pose, would."""
    record = io.read_motion(save(tmp_path / "m.npz", amass(rng, 52)))
    record.poses[:, 0] = 0
    record = replace(record, up="y")
    own = with_skeleton(record, 7)
    assert own.joint_names == smpl_names(52)
    height = dict(zip(own.joint_names, own.joints[:, 1], strict=True))
    assert height["head"] > height["left_wrist"] == height["left_shoulder"] > height["pelvis"] > height["left_knee"]
    np.testing.assert_allclose(own.joints[own.joint_names.index("left_knee")] * (-1, 1, 1), own.joints[5])
    owner = body_of("mixamo", droop=0.8)
    moved = retarget_to_body(record, owner, MotionSpec())
    part = {"arm": 16, "forearm": 18, "hand": 20, "thigh": 1, "shin": 4, "foot": 7}
    _, places = forward(own.joints, own.parents, own)
    pairs = [("arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot")]
    bones = np.stack([places[:, part[b] + s] - places[:, part[a] + s] for s in (0, 1) for a, b in pairs], axis=1)
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    np.testing.assert_allclose(directions("mixamo", owner.joints, owner.parents, moved), bones, atol=1e-9)
    assert any("left_elbow" in n for n in moved.notes)


def test_a_recorded_walk_drives_the_packaged_body_and_the_models(data, tmp_path, rng):
    file = data / "smpl_research_only" / "01_01.npz"
    walk = io.read_motion(file)
    smpl = io.read_body(data / "smpl_research_only" / "body.npz")
    same = retarget_to_body(walk, smpl, MotionSpec())
    assert np.array_equal(same.poses, walk.poses) and np.array_equal(same.translation, walk.translation) and not same.notes
    rig = io.read_body(packaged("body"))
    moved = load_motion(scene_from({"motion": {"files": [str(file)]}}, ""), str(file), rig)
    _, places = forward(rig.joints, rig.parents, moved)
    at = {n: places[:, j] for j, n in enumerate(rig.joint_names)}
    feet = np.minimum(at["LeftFoot"], at["RightFoot"])[:, 1]
    assert np.percentile(feet, 5) == pytest.approx(rig.joints[24, 1], abs=0.03) and np.all(at["Head"][:, 1] > 1)
    # The same as Z up, as AMASS has it, is the same motion.
    root = Rotation.from_matrix(UP.T @ Rotation.from_rotvec(walk.poses[:, 0]).as_matrix()).as_rotvec()
    poses = np.concatenate([root[:, None], walk.poses[:, 1:]], axis=1).reshape(len(root), -1)
    trans = (smpl.joints[0] + walk.translation) @ UP - smpl.joints[0]
    path = save(tmp_path / "z.npz", {"poses": poses, "trans": trans, "mocap_framerate": 30.0})
    back = load_motion(scene_from({"motion": {"files": [str(path)]}}, ""), str(path), smpl)
    np.testing.assert_allclose(back.translation, walk.translation, atol=1e-6)
    away = Rotation.from_rotvec(back.poses[:, 0]).inv() * Rotation.from_rotvec(walk.poses[:, 0])
    assert away.magnitude().max() < 1e-6

"""Motions looked up frame by frame: laid end to end, and in a mirror."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import Skeleton, blend, blend_from, forward, skin, transforms
from ncs_jax.io import MotionRecord
from ncs_jax.metrics.motion import measure_motion
from ncs_jax.metrics.quality import measure
from ncs_jax.network.methods.method import initial_parameters
from ncs_jax.network.rollout import animate
from ncs_jax.prepare import build
from ncs_jax.prepare.build import features_from_records
from ncs_jax.prepare.mirroring import mirror_partners
from ncs_jax.runs.run import assemble
from ncs_jax.scene.features import MotionFeatures, input_joints, mirror, motion_features
from ncs_jax.scene.spec import load_scene
from ncs_jax.simulation.implicit_euler import simulate, simulator_from

from .scenes import write_scene

# hips, left leg, right leg, spine, left arm, right arm, left hand, right hand
PARENTS = (-1, 0, 0, 0, 3, 3, 4, 5)
PARTNER = np.array([0, 2, 1, 3, 5, 4, 7, 6])
RIGHT = np.array([[0, 0.9, 0.02], [-0.1, 0.8, 0], [0, 1.3, -0.03], [-0.2, 1.4, 0], [-0.7, 1.3, 0.1]])
JOINTS = np.stack([RIGHT[0], RIGHT[1] * [-1, 1, 1], RIGHT[1], RIGHT[2], RIGHT[3] * [-1, 1, 1], RIGHT[3],
                   RIGHT[4] * [-1, 1, 1], RIGHT[4]])  # fmt: skip
run = jax.jit(forward)


def recorded(rng, frames=6, joints=8):
    return 0.8 * rng.normal(size=(frames, joints, 3)), rng.normal(size=(frames, 3))


def posed(poses, translation, joints=JOINTS):
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    return run(Skeleton(jnp.asarray(joints), PARENTS), jnp.asarray(local), jnp.asarray(translation))


# --- mirror -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_mirrors_show_the_motion_itself(rng, axis):
    poses, translation = recorded(rng)
    kept = poses.copy(), translation.copy()
    once = mirror(poses, translation, PARTNER, axis)
    assert np.abs(once[0] - poses).max() > 0.1 and np.abs(once[1] - translation).max() > 0.1
    twice = mirror(*once, PARTNER, axis)
    np.testing.assert_array_equal(twice[0], poses)
    np.testing.assert_array_equal(twice[1], translation)
    # the given motion is left as it is, and what is returned shares nothing with it
    once[0][:], once[1][:] = 0, 0
    np.testing.assert_array_equal(poses, kept[0])
    np.testing.assert_array_equal(translation, kept[1])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mirrored_motion_is_the_mirror_image(rng, axis):
    """Of every joint's place, and of every joint's turning: R becomes S R S on the other side."""
    joints = np.roll(JOINTS, axis, axis=1)  # left and right along that axis
    poses, translation = recorded(rng)
    here, there = posed(poses, translation, joints), posed(*mirror(poses, translation, PARTNER, axis), joints)
    reflect = np.ones(3)
    reflect[axis] = -1
    np.testing.assert_allclose(there.positions, np.asarray(here.positions)[:, PARTNER] * reflect, atol=1e-13)
    turned = np.asarray(here.rotations)[:, PARTNER] * reflect[:, None] * reflect
    np.testing.assert_allclose(there.rotations, turned, atol=1e-13)
    assert np.abs(np.asarray(there.positions) - np.asarray(here.positions)).max() > 0.1


def test_a_track_prints_in_a_line_which_frames_are_which_motion():
    def shown(*lengths):
        start = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths).astype(np.int32)
        frames = len(start)
        numbers = np.zeros((frames, 2, 9)), np.zeros((frames, 2, 12)), np.zeros((frames, 3, 3, 4))
        return MotionFeatures(*map(jnp.asarray, (*numbers, start)))

    assert repr(shown(4, 3)) == "MotionFeatures(7 frames, 3 joints, 2 motions: frames 0 to 3, 4 to 6)"
    assert len(repr(shown(*[2] * 50))) < 120 and repr(shown(*[2] * 50)).endswith("..., 98 to 99)")
    inside = []
    jax.make_jaxpr(lambda track: inside.append(repr(track)) or track.start)(shown(2))
    assert inside[0].startswith("MotionFeatures(start=")  # traced: no numbers to tell


def test_the_middle_frame_is_no_raised_leg_wherever_it_stands():
    """Forward: the mean of all frames, by hand."""
    poses = np.random.default_rng(0).normal(0, 0.2, (9, 3, 6)).astype(np.float32)
    poses[0] += 2  # a pose like no other, with which the motion begins
    zeros, start = jnp.zeros((9, 3, 4)), jnp.zeros(9, int)
    found = MotionFeatures(jnp.asarray(poses), zeros, jnp.zeros((9, 4, 3, 4)), start).middle()
    assert found == np.linalg.norm((poses - poses.mean(axis=0)).reshape(9, -1), axis=1).argmin() != 0
    assert MotionFeatures(jnp.asarray(poses[::-1]), zeros, jnp.zeros((9, 4, 3, 4)), start).middle() == 8 - found
    assert MotionFeatures(zeros[:, :0], zeros[:, :0], jnp.zeros((9, 4, 3, 4)), start).middle() == 0  # no joint is read


def test_the_mirrored_character_wears_its_skin_mirrored(rng):
    """Skinned points too, whose weights are each other's image."""
    x = rng.normal(size=(20, 3))
    weights = rng.dirichlet(np.ones(8), 20)
    poses, translation = recorded(rng, frames=1)
    s = Skeleton(jnp.asarray(JOINTS), PARENTS)
    here, there = posed(poses, translation), posed(*mirror(poses, translation, PARTNER))

    def skinned(pose, x, weights):
        m = transforms(s, jax.tree.map(lambda a: a[0], pose))
        return np.asarray(skin(blend(m, blend_from(weights, dtype=jnp.float64)), jnp.asarray(x)))

    image = skinned(there, x * [-1, 1, 1], weights[:, PARTNER])
    np.testing.assert_allclose(image, skinned(here, x, weights) * [-1, 1, 1], atol=1e-12)


def test_a_pose_in_axes_of_its_joint_is_mirrored_in_the_world(rng):
    """A glTF or FBX body writes each joint's turn in the joint's own axes at rest, Q: the world's pose a is Q^T a there."""
    poses, translation = recorded(rng)
    axes = Rotation.random(poses.shape[1], random_state=rng).as_matrix()

    def own(world):
        return np.einsum("jba,tjb->tja", axes, world)

    found = mirror(own(poses), translation, PARTNER, axes=axes)
    expected = mirror(poses, translation, PARTNER)
    np.testing.assert_allclose(found[0], own(expected[0]), atol=1e-14)
    np.testing.assert_array_equal(found[1], expected[1])
    assert np.abs(mirror(own(poses), translation, PARTNER)[0] - found[0]).max() > 0.1


SIDES = {  # names of the skeleton above, as tools write them
    "SMPL": ("pelvis", "left_hip", "right_hip", "spine1", "left_shoulder", "right_shoulder", "left_wrist", "right_wrist"),
    "SMPL's other": ("Pelvis", "L_Hip", "R_Hip", "Spine1", "L_Shoulder", "R_Shoulder", "L_Hand", "R_Hand"),
    "CMU": ("Hips", "lHip", "rHip", "Spine", "lShldr", "rShldr", "lHand", "rHand"),
    "Mixamo": tuple(f"mixamorig:{n}" for n in
                    ("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftArm", "RightArm", "LeftHand", "RightHand")),
    "Unreal": ("pelvis", "thigh_l", "thigh_r", "spine_01", "upperarm_l", "upperarm_r", "hand_l", "hand_r"),
    "Blender": ("Hips", "UpLeg.L", "UpLeg.R", "Spine", "Arm.L", "Arm.R", "Hand.L", "Hand.R"),
    "Blender, one side copied": ("Hips", "UpLeg.L", "UpLeg.R.001", "Spine", "Arm.L", "Arm.R.001", "Hand.L", "Hand.R.001"),
    "Biped": tuple(f"Bip01 {n}" for n in
                   ("Pelvis", "L Thigh", "R Thigh", "Spine", "L UpperArm", "R UpperArm", "L Hand", "R Hand")),
    "MMD in Blender": ("センター", "足.L", "足.R", "上半身", "腕.L", "腕.R", "手首.L", "手首.R"),
    "MMD": ("センター", "左足", "右足", "上半身", "左腕", "右腕", "左手首", "右手首"),
    "a mark in what all share": tuple(f"Char_L01_{n}" for n in
                                      ("Hips", "Leg_L", "Leg_R", "Spine", "Arm_L", "Arm_R", "Hand_L", "Hand_R")),
    "one pair told": ("root", "lf_leg", "rt_leg", "spine", "lf_arm", "rt_arm", "thumb_L", "thumb_R"),
    "three alike in the middle": ("Spine", "leg_l", "leg_r", "spine_", "arm_l", "arm_r", "hand_l", "hand_r"),
    "numbers": tuple(f"bone_{i}" for i in range(8)),
    "none": (),
}  # fmt: skip


@pytest.mark.parametrize("names", SIDES)
@pytest.mark.parametrize(("turn", "axis"), [(0, 0), (90, 2), (180, 0)])
def test_partners_of_a_body_that_stands_anywhere(names, turn, axis):
    """By the names of many tools or by places alone, beside the origin, and facing another way."""
    joints = Rotation.from_euler("y", turn, degrees=True).apply(JOINTS) + [0.7, 0, -0.4]
    partner, across = mirror_partners(SIDES[names], joints, PARENTS)
    np.testing.assert_array_equal(partner, PARTNER)
    assert across == axis


def test_limbs_that_begin_at_one_place_are_told_apart_by_what_hangs_on_them():
    """As in CMU's skeletons, whose hip joints lie in the hips, and in rigs that hold every bone twice."""
    parents = (-1, 0, 0, 0, 1, 2, 3, 4, 5)
    x = np.array([0, 0, 0, 0, 0.1, -0.1, 0, 0.1, -0.1])
    joints = np.stack([x, [1, 1, 1, 1, 0.9, 0.9, 1.2, 0.5, 0.5], 0 * x], axis=1)
    partner, _ = mirror_partners((), joints, parents)
    np.testing.assert_array_equal(partner, [0, 2, 1, 3, 5, 4, 6, 8, 7])
    twice = (-1, 0, 0, 0, 0)
    names = ("hips", "ORG-thigh.L", "ORG-thigh.R", "DEF-thigh.L", "DEF-thigh.R")
    joints = np.array([[0, 1, 0], [0.1, 0.9, 0], [-0.1, 0.9, 0], [0.1, 0.9, 0], [-0.1, 0.9, 0]])
    np.testing.assert_array_equal(mirror_partners(names, joints, twice)[0], [0, 2, 1, 4, 3])


def test_a_skeleton_without_two_sides_is_refused():
    joints = np.array([[0, 1, 0], [0.3, 0.9, 0.2], [0.1, 0.5, -0.3], [-0.4, 1.5, 0.1]])
    with pytest.raises(InputError, match=r"motion\.mirror: a skeleton that is the same on both sides expected .found .joint"):
        mirror_partners(("r", "a", "b", "c"), joints, (-1, 0, 1, 0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_mirror_keeps_the_type(rng, dtype):
    poses, translation = (a.astype(dtype) for a in recorded(rng))
    result = mirror(poses, translation, PARTNER)
    assert result[0].dtype == result[1].dtype == dtype


# --- track --------------------------------------------------------------------------------------------------------------


def ready(folder):
    return assemble(load_scene(write_scene(folder)), dtype=jnp.float64).model


def wander(rng, frames):
    t = np.arange(frames)[:, None, None] / 30
    poses = rng.normal(size=(1, 2, 3)) * np.sin(4 * t + rng.normal(size=(1, 2, 3)))
    return MotionRecord(poses, np.cumsum(0.03 * rng.normal(size=(frames, 3)), axis=0), 30.0, ())


def test_two_motions_end_to_end_are_two_tracks(tmp_path, rng, monkeypatch):
    model = ready(tmp_path)
    records = [wander(rng, n) for n in (6, 6)]
    together, alone = features_from_records(model, *records), [features_from_records(model, r) for r in records]
    np.testing.assert_array_equal(together.start, np.repeat([0, 6], 6))
    assert together.start.dtype == jnp.int32
    for name in ("static", "dynamic", "matrices"):
        parts = np.concatenate([getattr(a, name) for a in alone])
        np.testing.assert_allclose(getattr(together, name), parts, rtol=0, atol=1e-12)
    monkeypatch.setattr(build, "LONG", 5)
    in_parts = features_from_records(model, *records)
    for whole, part in zip(jax.tree.leaves(together), jax.tree.leaves(in_parts), strict=True):
        np.testing.assert_allclose(part, whole, rtol=0, atol=1e-12)
    # though the second begins far from where the first ended, nothing is seen of the jump
    for first in (0, 6):
        np.testing.assert_array_equal(together.dynamic[first], 0)
    assert np.abs(np.asarray(together.dynamic[1:6])).max(axis=(1, 2)).min() > 1e-3
    joined = [np.concatenate([getattr(r, n) for r in records]) for n in ("poses", "translation")]
    as_one = features_from_records(model, MotionRecord(*joined,
                                          30.0, ()))  # fmt: skip
    assert np.abs(np.asarray(as_one.dynamic - together.dynamic))[6].max() > 1e-2


def test_a_character_stood_still_before_its_first_frame(tmp_path, rng):
    model = ready(tmp_path)
    record = wander(rng, 6)
    rested = MotionRecord(
        np.concatenate([np.repeat(record.poses[:1], 6, axis=0), record.poses]),
        np.concatenate([np.repeat(record.translation[:1], 6, axis=0), record.translation]), 30.0, (),
    )  # fmt: skip
    plain, after = features_from_records(model, record), features_from_records(model, rested)
    np.testing.assert_allclose(after.dynamic[6:], plain.dynamic, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(after.dynamic[:6], 0)


def test_a_frame_is_described_by_itself_and_the_two_before(tmp_path, rng):
    model = ready(tmp_path)
    record = wander(rng, 12)
    whole = features_from_records(model, record)
    piece = features_from_records(model, MotionRecord(record.poses[4:10], record.translation[4:10], 30.0, ()))
    np.testing.assert_allclose(piece.static, whole.static[4:10], rtol=0, atol=1e-13)
    np.testing.assert_allclose(piece.matrices, whole.matrices[4:10], rtol=0, atol=1e-13)
    np.testing.assert_allclose(piece.dynamic[2:], whole.dynamic[6:10], rtol=0, atol=1e-12)
    assert np.abs(np.asarray(piece.dynamic[1] - whole.dynamic[5])).max() > 1e-3  # of the acceleration it knows too little


def test_matrices_carry_rest_points_to_the_pose(tmp_path, rng):
    model = ready(tmp_path)
    record = wander(rng, 6)
    matrices = np.asarray(features_from_records(model, record).matrices)
    local = axis_angle_to_matrix(jnp.asarray(record.poses))
    pose = forward(model.skeleton, local, jnp.asarray(record.translation))
    joints = np.asarray(model.skeleton.joints)
    carried = np.einsum("fjab,jb->fja", matrices[..., :3], joints) + matrices[..., 3]
    np.testing.assert_allclose(carried, pose.positions, atol=1e-13)
    np.testing.assert_allclose(matrices[..., :3], pose.rotations, atol=1e-14)


@pytest.mark.parametrize("inputs", [(0,), (1, 0)])
def test_the_network_reads_its_input_joints_in_order(tmp_path, rng, inputs):
    model = dataclasses.replace(ready(tmp_path), inputs=inputs)
    record = wander(rng, 3)
    local = axis_angle_to_matrix(jnp.asarray(record.poses))
    pose = forward(model.skeleton, local, jnp.asarray(record.translation))
    one = jax.tree.map(lambda a: a[2], pose)
    joints = input_joints(model, local[2], one)
    for name, source in (("local", local[2]), ("world", one.rotations), ("positions", one.positions)):
        np.testing.assert_array_equal(getattr(joints, name), np.asarray(source)[list(inputs)])
    start = jnp.zeros(3, jnp.int32)
    assert motion_features(model, local, jnp.asarray(record.translation), start).static.shape == (3, len(inputs), 9)


# --- far from the origin ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wearer(tmp_path_factory):
    folder = tmp_path_factory.mktemp("far")
    a = assemble(load_scene(write_scene(folder)))
    record = a.motions[a.scene.motion.files[0]]
    return a, dataclasses.replace(record, translation=record.translation.astype(np.float64))


def elsewhere(record, way):
    return dataclasses.replace(record, translation=record.translation + np.asarray(way))


def test_near_the_origin_nothing_is_shifted(wearer):
    a, record = wearer
    assert features_from_records(a.model, record).origin is None


@pytest.mark.parametrize("way", [(1e4, 0.0, 0.0), (-6e3, 2e3, 7e3)])
def test_far_from_the_origin_is_as_fine_as_near(wearer, way):
    a, record = wearer
    here, there = features_from_records(a.model, record), features_from_records(a.model, elsewhere(record, way))
    for name in ("static", "dynamic", "matrices"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(there.origin, np.tile(way, (len(record.poses), 1)))


def test_what_is_far_is_animated_measured_and_simulated_there(wearer):
    a, record = wearer
    way = np.array([8e3, 0.0, -1.6e3])
    here, there = features_from_records(a.model, record), features_from_records(a.model, elsewhere(record, way))
    here = dataclasses.replace(here, origin=jnp.zeros_like(there.origin))  # one program for both
    params = initial_parameters(a.network, jax.random.PRNGKey(0), a.model)
    shown = jax.jit(lambda track: animate(a.model, a.network, params, track))
    x, far = (np.asarray(shown(t), np.float64) for t in (here, there))
    np.testing.assert_allclose(far - way, x, rtol=0, atol=1e-3)  # what float32 tells apart 8 km away
    rows, others = measure(a.model, x.astype(np.float32), here), measure(a.model, x + way, there)
    for name, values in rows.items():
        np.testing.assert_allclose(others[name], values, rtol=1e-3, atol=1e-6)
    moving = [measure_motion(a.model, v, t) for v, t in ((x, here), (x + way, there))]
    for name, value in moving[0].items():
        assert moving[1][name] == pytest.approx(value, rel=1e-3, abs=1e-3)
    short = [jax.tree.map(lambda v: v[:3], t) for t in (here, there)]
    simulator = simulator_from(a.model)
    follow = jax.jit(lambda track: simulate(simulator, track)[0])
    near, away = (np.asarray(follow(t), np.float64) for t in short)
    np.testing.assert_allclose(away - way, near, rtol=0, atol=1e-3)

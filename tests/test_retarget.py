"""Retargeting: which joint is which by its name, bones that point where the source's point, feet on the ground."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.cli import main
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.skinning import to_rest_axes
from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.joint_names import anatomy, pair
from ncs_jax.prepare.motion_import import lead_in_frames, load_motion, retarget_to_body
from ncs_jax.prepare.retarget import body_names, retarget, with_skeleton
from ncs_jax.scene.spec import MotionSpec, load_scene, scene_from
from ncs_jax.view.character import body_vertices

CLIPS = ("10_01", "02_02", "03_03")

# How conventions call the same joints: trunk from the hips up, then arm and leg; "-" where one has none. {S} is Left, {L} L.
PARTS = [
    "hips",
    "spine",
    "spine2",
    "chest",
    "neck",
    "head",
    "clavicle",
    "arm",
    "forearm",
    "hand",
    "thigh",
    "shin",
    "foot",
    "toe",
]
TRUNK = PARTS[:6]
CONVENTIONS = {
    "mixamo": ["mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2 mixamorig:Neck mixamorig:Head",
               "mixamorig:{S}Shoulder mixamorig:{S}Arm mixamorig:{S}ForeArm mixamorig:{S}Hand",
               "mixamorig:{S}UpLeg mixamorig:{S}Leg mixamorig:{S}Foot mixamorig:{S}ToeBase"],
    "smpl": ["pelvis spine1 spine2 spine3 neck head", "{s}_collar {s}_shoulder {s}_elbow {s}_wrist",
             "{s}_hip {s}_knee {s}_ankle {s}_foot"],
    "cmu": ["Hips LowerBack - CS_BVH Neck Head", "{S}Collar {S}Shoulder {S}Elbow {S}Wrist", "{S}Hip {S}Knee {S}Ankle -"],
    "poser": ["hip abdomen - chest neck head", "{x}Collar {x}Shldr {x}ForeArm {x}Hand", "{x}Thigh {x}Shin {x}Foot -"],
    "unreal": ["pelvis spine_01 spine_02 spine_03 neck_01 head", "clavicle_{x} upperarm_{x} lowerarm_{x} hand_{x}",
               "thigh_{x} calf_{x} foot_{x} ball_{x}"],
    "blender": ["spine spine.001 spine.002 spine.003 spine.004 spine.006", "shoulder.{L} upper_arm.{L} forearm.{L} hand.{L}",
                "thigh.{L} shin.{L} foot.{L} toe.{L}"],
    "biped": ["Bip01_Pelvis Bip01_Spine Bip01_Spine1 Bip01_Spine2 Bip01_Neck Bip01_Head",
              "Bip01_{L}_Clavicle Bip01_{L}_UpperArm Bip01_{L}_Forearm Bip01_{L}_Hand",
              "Bip01_{L}_Thigh Bip01_{L}_Calf Bip01_{L}_Foot Bip01_{L}_Toe0"],
    "unity": ["Hips Spine Chest UpperChest Neck Head", "{S}Shoulder {S}UpperArm {S}LowerArm {S}Hand",
              "{S}UpperLeg {S}LowerLeg {S}Foot {S}Toes"],
}  # fmt: skip
ABOVE = {PARTS[i]: PARTS[i - 1] for i in range(1, len(PARTS))} | {"clavicle": "chest", "thigh": "hips"}
LIMBS = [("arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot")]


def names_in(convention: str) -> dict[tuple[str, str], str]:
    """Name by (side, part); the trunk has no side."""
    found = {}
    for part, name in zip(PARTS, " ".join(CONVENTIONS[convention]).split(), strict=True):
        for side in ("",) if part in TRUNK else ("left", "right"):
            if name != "-":
                found[side, part] = name.format(s=side, S=side.title(), x=side[:1], L=side[:1].upper())
    return found


def figure(convention: str, *, droop: float = 0.0, size=1.0, thigh=0.42, arm=0.3, turn=None):
    """A figure that faces +Z, its arms `droop` rad below the horizontal: names, parents and rest joints, by (side, part)."""
    names = names_in(convention)
    keys = sorted(names, key=lambda k: (PARTS.index(k[1]), k[0]))
    down = np.array([np.cos(droop), -np.sin(droop), 0])
    place = {("", "hips"): np.array([0, 0.95, 0.0]), ("", "spine"): np.array([0, 1.05, -0.02])}
    place |= {("", "spine2"): np.array([0, 1.15, 0]), ("", "chest"): np.array([0, 1.27, 0.0])}
    place |= {("", "neck"): np.array([0, 1.43, -0.01]), ("", "head"): np.array([0, 1.52, 0.01])}
    for side, sign in (("left", 1), ("right", -1)):
        mirror = np.array([sign, 1, 1])
        shoulder, hip = np.array([0.19, 1.38, -0.01]), np.array([0.09, 0.9, 0])
        place[side, "clavicle"] = np.array([0.05, 1.37, 0]) * mirror
        place[side, "arm"], place[side, "forearm"] = shoulder * mirror, (shoulder + arm * down) * mirror
        place[side, "hand"] = (shoulder + (arm + 0.26) * down + [0, 0, 0.05]) * mirror
        knee, ankle = hip - [0, thigh, 0], hip - [0, thigh + 0.4, 0.02]
        place[side, "thigh"], place[side, "shin"], place[side, "foot"] = hip * mirror, knee * mirror, ankle * mirror
        place[side, "toe"] = (ankle + [0.02, -0.06, 0.14]) * mirror
    joints = size * np.array([place[k] for k in keys]) @ (np.eye(3) if turn is None else turn).T
    parents = []
    for side, part in keys:
        above = ABOVE.get(part)
        while above is not None and (side, above) not in keys and ("", above) not in keys:
            above = ABOVE[above]
        parents.append(-1 if above is None else keys.index((side, above) if (side, above) in keys else ("", above)))
    return tuple(names[k] for k in keys), np.array(parents, np.int32), joints, keys


def body_of(convention: str, **options) -> BodyRecord:
    """A body whose vertices are a point at each joint and a sole under each foot, each of its own joint alone."""
    names, parents, joints, keys = figure(convention, **options)
    feet = [j for j, (_, part) in enumerate(keys) if part == "foot"]
    soles = np.array([[0.02, -0.08, 0.1], [-0.02, -0.08, 0.1], [0, -0.08, -0.05]]) * options.get("size", 1.0)
    vertices = np.concatenate([joints, *(joints[f] + soles for f in feet)])
    owner = [*range(len(joints)), *np.repeat(feet, 3)]
    weights = np.eye(len(joints))[owner]
    return BodyRecord(vertices, np.array([[0, 1, 2]], np.int32), joints, parents, weights, names)


def motion_of(convention: str, rng, frames=12, still=(), amount=0.4, **options) -> MotionRecord:
    names, parents, joints, keys = figure(convention, **options)
    poses = rng.normal(size=(frames, len(names), 3)) * amount
    poses[:, [j for j, (_, part) in enumerate(keys) if part in still]] = 0
    walk = np.linspace(0, 1, frames)[:, None] * [0.3, 0, 0.8] * options.get("size", 1.0)
    return MotionRecord(poses, walk, 30.0, names, joints, parents)


def forward(joints, parents, motion: MotionRecord):
    """World rotations and positions: forward kinematics written out."""
    turns = Rotation.from_rotvec(motion.poses.reshape(-1, 3)).as_matrix().reshape(*motion.poses.shape, 3)
    places = np.zeros(motion.poses.shape)
    places[:, 0] = joints[0] + motion.translation
    for j, p in enumerate(parents[1:], 1):
        turns[:, j] = turns[:, p] @ turns[:, j]
        places[:, j] = places[:, p] + turns[:, p] @ (joints[j] - joints[p])
    return turns, places


def directions(convention: str, joints, parents, motion: MotionRecord) -> np.ndarray:
    """Unit vectors (frames, bones, 3) along the limbs."""
    keys = figure(convention)[3]
    _, places = forward(joints, parents, motion)
    at = {k: places[:, j] for j, k in enumerate(keys)}
    bones = np.stack([at[s, b] - at[s, a] for s in ("left", "right") for a, b in LIMBS], axis=1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


@pytest.mark.parametrize("theirs", CONVENTIONS)
@pytest.mark.parametrize("ours", CONVENTIONS)
def test_joints_are_paired_by_what_they_are(ours, theirs):
    (a, pa, _, ka), (b, pb, _, kb) = figure(ours), figure(theirs)
    found = {ka[j]: kb[i] for j, i in pair(anatomy(b, pb), anatomy(a, pa)).items()}
    shared = [k for k in ka if k in kb]
    spines = {("", p) for p in ("spine", "spine2", "chest")}
    assert {k: found.get(k) for k in shared if k not in spines} == {k: k for k in shared if k not in spines}
    assert set(found) - spines == set(shared) - spines
    both = [k for k in ka if k in spines and found.get(k)]
    assert found["", "chest"] == ("", "chest") and len(both) == min(len(spines & set(ka)), len(spines & set(kb)))


def test_shoulder_hip_hand_and_foot_are_what_their_side_makes_of_them():
    at = anatomy(smpl_names(24), smpl_parents(24)).roles
    assert [at[f"left {r}"] for r in ("thigh", "shin", "foot", "toe")] == [1, 4, 7, 10]
    assert [at[f"right {r}"] for r in ("clavicle", "arm", "forearm", "hand", "palm")] == [14, 17, 19, 21, 23]
    rig = io.read_body(packaged("body"))
    at = {role: rig.joint_names[j] for role, j in anatomy(rig.joint_names, rig.parents).roles.items()}
    assert at["left clavicle"] == "LeftShoulder" and at["left hip joint"] == "LHipJoint" and at["left hand"] == "LeftHand"
    assert at["left index 1"] == "LeftHandFinger1" and at["right thumb 1"] == "RThumb" and at["left foot"] == "LeftFoot"
    recorded = [n.replace("Finger1", "Index1") for n in rig.joint_names]  # as CMU's .bvh files call them
    assert pair(anatomy(recorded, rig.parents), anatomy(rig.joint_names, rig.parents)) == {j: j for j in range(31)}


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_same_skeleton_is_the_identity(rng, convention):
    body = body_of(convention, droop=0.7)
    motion = motion_of(convention, rng, still=("hips", "thigh", "shin", "foot", "toe"), droop=0.7)
    moved = retarget(motion, body).motion
    np.testing.assert_allclose(moved.poses, motion.poses, atol=1e-9)
    np.testing.assert_allclose(moved.translation, motion.translation, atol=1e-9)
    wild = motion_of(convention, rng, droop=0.7)  # whose height is not known before it is put on the ground
    moved = retarget(wild, body).motion
    np.testing.assert_allclose(moved.poses, wild.poses, atol=1e-9)
    np.testing.assert_allclose(np.diff(moved.translation, axis=0), np.diff(wild.translation, axis=0), atol=1e-9)


def test_the_packaged_body_and_motions_are_the_identity():
    body, walk = io.read_body(packaged("body")), io.read_motion(packaged("walk"))
    moved = retarget(replace(walk, joints=body.joints, parents=body.parents), body)
    turned = Rotation.from_rotvec(moved.motion.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(walk.poses.reshape(-1, 3))
    assert turned.magnitude().max() < 1e-6 and not moved.still and not moved.unused and abs(moved.scale - 1) < 1e-6
    np.testing.assert_allclose(np.diff(moved.motion.translation - walk.translation, axis=0), 0, atol=1e-6)
    assert np.abs(moved.motion.translation - walk.translation).max() < 0.02
    same = retarget_to_body(walk, body, MotionSpec())
    assert same.poses is walk.poses and same.translation is walk.translation and not same.notes


QUARTER = Rotation.from_euler("y", 90, degrees=True).as_matrix()
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
X_UP = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize("turn", [None, QUARTER, Z_UP], ids=["as ours", "faces +X", "Z up"])
@pytest.mark.parametrize(("theirs", "droop"), [("cmu", np.pi / 2), ("mixamo", 0.0), ("unreal", 0.9)])
def test_bones_point_where_the_sources_point(rng, theirs, droop, turn):
    """Whatever the rest pose, the proportions, the number of joints and the axes."""
    motion = motion_of(theirs, rng, still=("hips",), droop=droop, thigh=0.5, arm=0.35, size=40.0, turn=turn)
    if turn is not None:
        motion = replace(motion, translation=motion.translation @ turn.T)
    body = body_of("smpl", droop=0.3)
    moved = retarget(motion, body)
    # All that the axes change is by the one turn of the source's world: Z up becomes Y up, a heading stays what it is.
    upright = turn.T if turn is Z_UP else np.eye(3)
    expected = directions(theirs, motion.joints, motion.parents, motion) @ upright.T
    np.testing.assert_allclose(directions("smpl", body.joints, body.parents, moved.motion), expected, atol=1e-9)
    assert moved.motion.notes[-1:] == (("turned from Z up to Y up",) if turn is Z_UP else moved.motion.notes[-1:])
    ours, path = (0.42 + np.hypot(0.4, 0.02)) / (0.5 + np.hypot(0.4, 0.02)), motion.translation @ upright.T
    assert moved.scale == pytest.approx(ours / 40)
    np.testing.assert_allclose(np.diff(moved.motion.translation, axis=0), moved.scale * np.diff(path, axis=0), atol=1e-9)


@pytest.mark.parametrize("world", ["y", "z"])
@pytest.mark.parametrize("rest", ["zero", "2"])
@pytest.mark.parametrize("stands", [True, False])
def test_a_motion_that_stands_along_x_drives_as_the_one_along_y(rng, world, rest, stands):
    """At rest too, or turned there by its root alone; also where a frame is its reference pose."""
    body, plain = body_of("smpl", droop=0.3), motion_of("cmu", rng, droop=0.9, amount=0.1)
    poses, joints, root = plain.poses @ X_UP.T, plain.joints @ X_UP.T, Rotation.from_rotvec(plain.poses[:, 0])
    if not stands:
        poses, joints = plain.poses.copy(), plain.joints
        poses[:, 0] = (Rotation.from_matrix(X_UP) * root).as_rotvec()
    tipped = replace(plain, poses=poses, joints=joints, translation=plain.translation @ X_UP.T)
    found, expected = (
        retarget_to_body(m, body, replace(MotionSpec(), up=up, rest=rest), world) for m, up in ((tipped, "x"), (plain, "y"))
    )
    assert f"turned from X up to {world.upper()} up" in found.notes
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(np.diff(found.translation, axis=0), np.diff(expected.translation, axis=0), atol=1e-9)


@pytest.mark.parametrize("turn", [QUARTER, QUARTER @ QUARTER, Z_UP, Z_UP @ QUARTER], ids=["+X", "-Z", "Z up", "Z up, +X"])
def test_a_source_that_faces_elsewhere_at_rest_takes_the_body_there(rng, turn):
    """Trunk, hands and feet too, and no bone is twisted: at rest every joint of the body turns as the source's axes do."""
    motion = motion_of("mixamo", rng, amount=0, droop=0.4, turn=turn)
    body = body_of("smpl", droop=0.4)
    turns, _ = forward(body.joints, body.parents, retarget(motion, body).motion)
    expected = turn if turn[1, 1] else Z_UP.T @ turn
    np.testing.assert_allclose(turns, np.broadcast_to(expected, turns.shape), atol=1e-9)


def test_a_rest_pose_is_that_of_the_source(rng):
    """A source that stands still with hanging arms: the T-posed body hangs its arms, turned about the forward axis only."""
    body, motion = body_of("smpl"), motion_of("mixamo", rng, amount=0, droop=np.pi / 2)
    turns, _ = forward(body.joints, body.parents, retarget(motion, body).motion)
    at = dict(zip(figure("smpl")[3], turns[0], strict=True))
    np.testing.assert_allclose(at["left", "arm"] @ [0, 1, 0], [1, 0, 0], atol=1e-9)  # the thumb's side stays forward
    np.testing.assert_allclose(at["left", "arm"] @ [0, 0, 1], [0, 0, 1], atol=1e-9)
    for part in ("hips", "spine", "chest", "neck", "head", "thigh", "foot"):
        np.testing.assert_allclose(at["" if part in ("hips", "spine", "chest", "neck", "head") else "right", part], np.eye(3))


def test_feet_stay_flat_whatever_the_source_says_of_them(rng):
    """An end site straight below the ankle says where the sole is, one ahead where the toes are: both stand flat."""
    body, motion = body_of("smpl"), motion_of("cmu", rng, amount=0)
    foot = [j for j, (_, part) in enumerate(figure("cmu")[3]) if part == "foot"]
    for end, heading in (((0, -0.08, 0), 0.0), ((0, -0.03, 0.13), None), ((0.05, -0.03, 0.13), None)):
        tips = np.full_like(motion.joints, np.nan)
        tips[foot] = motion.joints[foot] + end
        moved = retarget(replace(motion, tips=tips), body).motion
        turns, _ = forward(body.joints, body.parents, moved)
        at = dict(zip(figure("smpl")[3], turns[0], strict=True))["left", "foot"]
        np.testing.assert_allclose(at @ [0, 1, 0], [0, 1, 0], atol=1e-9)
        ahead = at @ ([0, 0, 1] if heading == 0.0 else [0.02, 0, 0.14])
        assert np.arctan2(ahead[0], ahead[2]) == pytest.approx(np.arctan2(end[0], end[2]) if heading is None else 0)


def test_what_nothing_drives_is_exactly_still_and_what_lies_between_is_composed(rng):
    motion = motion_of("mixamo", rng)  # of three joints in its spine
    body = body_of("cmu")  # of two
    keys, theirs = figure("cmu")[3], figure("mixamo")[3]
    moved = retarget(motion, body)
    turns, _ = forward(body.joints, body.parents, moved.motion)
    source, _ = forward(motion.joints, motion.parents, motion)
    for key in (("", "spine"), ("", "chest"), ("", "head"), ("left", "clavicle")):
        np.testing.assert_allclose(turns[:, keys.index(key)], source[:, theirs.index(key)], atol=1e-9)
    back = retarget(motion_of("cmu", rng), body_of("mixamo"))
    still = [j for j, n in enumerate(figure("mixamo")[0]) if n in back.still]
    assert {theirs[j][1] for j in still} == {"spine2", "toe"} and np.all(back.motion.poses[:, still] == 0)
    assert moved.unused == ("mixamorig:Spine1", "mixamorig:LeftToeBase", "mixamorig:RightToeBase")
    quiet = motion_of("mixamo", rng, still=("forearm",))
    quiet = retarget(quiet, body_of("mixamo", droop=0.5)).motion  # a joint that does not turn, does not: it is no input
    still = [j for j, k in enumerate(theirs) if k[1] == "forearm"]
    assert np.all(quiet.poses[:, still] == quiet.poses[:1, still]) and np.abs(quiet.poses[:, still]).max() < 0.2


def test_a_file_in_inches_and_one_in_metres_are_one_motion(rng):
    body, motion = body_of("smpl"), motion_of("poser", rng, still=("thigh", "foot"))
    inches = replace(motion, joints=motion.joints / 0.0254, translation=motion.translation / 0.0254 + [0, 40, 0])
    a, b = retarget(motion, body), retarget(inches, body)
    np.testing.assert_allclose(a.motion.translation, b.motion.translation, atol=1e-9)
    assert b.scale == pytest.approx(0.0254 * a.scale) and any("seems to be in inch" in n for n in b.motion.notes)
    assert not any("seems to be" in n for n in a.motion.notes)
    half = retarget(motion, body, scale=0.5)
    np.testing.assert_allclose(
        np.diff(half.motion.translation, axis=0)[:, ::2], 0.5 * np.diff(motion.translation, axis=0)[:, ::2]
    )
    assert half.scale == 0.5 and any("as the scene says" in n for n in half.motion.notes)


def test_the_lowest_sole_is_where_soles_are_at_rest(rng):
    body, motion = body_of("unreal", size=0.9), motion_of("mixamo", rng, frames=200, amount=0.3, thigh=0.5)
    moved = retarget(motion, body).motion
    turns, places = forward(body.joints, body.parents, moved)
    owner = body.weights.argmax(axis=1)
    x = places[:, owner] + np.einsum("tvab,vb->tva", turns[:, owner], body.vertices - body.joints[owner])
    soles = [v for v, j in enumerate(owner) if figure("unreal")[3][j][1] in ("foot", "toe")]
    low = x[:, soles, 1].min(axis=1)
    assert np.percentile(low, 5) == pytest.approx(body.vertices[soles, 1].min(), abs=1e-9)


def test_a_body_with_rest_rotations(rng):
    body, motion = body_of("smpl"), motion_of("mixamo", rng)
    axes = Rotation.random(len(body.parents), rng=rng).as_matrix()
    plain, own = retarget(motion, body).motion, retarget(motion, replace(body, rest_rotations=axes)).motion
    turns = Rotation.from_rotvec(own.poses.reshape(-1, 3)).as_matrix().reshape(*own.poses.shape, 3)
    expected = Rotation.from_rotvec(plain.poses.reshape(-1, 3)).as_matrix().reshape(*own.poses.shape, 3)
    np.testing.assert_allclose(to_rest_axes(jnp.asarray(turns), jnp.asarray(axes)), expected, atol=1e-9)


def test_poses_along_the_joints_own_axes_are_the_same_motion(rng):
    """As .glb and .fbx have them: R = Q^T (rotation along the world's axes) Q."""
    body, motion = body_of("smpl", droop=0.4), motion_of("mixamo", rng)
    own = Rotation.random(motion.poses.shape[1], random_state=np.random.RandomState(3)).as_matrix()
    along = replace(motion, poses=np.einsum("jba,tjb->tja", own, motion.poses), rest_rotations=own)
    plain = retarget(motion, body).motion
    np.testing.assert_allclose(retarget(along, body).motion.poses, plain.poses, atol=1e-9)
    np.testing.assert_allclose(retarget(along, body).motion.translation, plain.translation, atol=1e-9)
    # the same skeleton needs no retargeting, but its axes may be others
    twin = body_of("mixamo")
    np.testing.assert_allclose(retarget_to_body(along, twin, MotionSpec()).poses, motion.poses, atol=1e-9)
    turned = replace(twin, rest_rotations=own)
    np.testing.assert_allclose(retarget_to_body(along, turned, MotionSpec()).poses, along.poses, atol=1e-12)


def test_another_creature_is_refused_in_few_words(rng):
    motion = motion_of("mixamo", rng)
    names = ("Body", *(f"Segment{j}" for j in range(59)))
    chain = np.stack([np.zeros(60), np.zeros(60), 0.1 * np.arange(60)], axis=1)
    poses = np.zeros((len(motion.poses), 60, 3))
    fish = replace(motion, poses=poses, joint_names=names, joints=chain, parents=np.arange(-1, 59), bones=())
    with pytest.raises(InputError, match=r"found '60 joints, Body, Segment0, Segment1, Segment2, ...'\)") as told:
        retarget(fish, body_of("mixamo"))
    assert len(str(told.value)) < 800 and 'joints = { "Body" = ' in str(told.value)


def test_a_creature_with_a_trunk_and_no_limbs_of_a_person_is_refused(rng):
    """Its hips, spine, neck and head have names that are a person's, and none of its legs has."""
    motion = motion_of("mixamo", rng)
    keys = figure("mixamo")[3]
    legs = {"left": "hind_a", "right": "hind_b"}
    names = [
        f"{legs[side]}_{j}" if side in legs else n
        for j, (n, (side, _)) in enumerate(zip(motion.joint_names, keys, strict=True))
    ]
    places = np.array(motion.joints)
    sides = np.array([side in legs for side, _ in keys])
    places[sides] = 0.3 * rng.normal(size=(sides.sum(), 3))
    horse = replace(motion, joint_names=tuple(names), joints=places, bones=())
    with pytest.raises(InputError, match="hips, head and limbs are not found"):
        retarget(horse, body_of("mixamo"))


def test_joints_that_names_do_not_tell_are_told_by_the_scene(rng):
    motion = motion_of("poser", rng)  # without toes nothing says what is ahead, and so which side is which
    foreign = replace(motion, joint_names=tuple(f"bone {j}" for j in range(len(motion.joint_names))))
    keys = figure("mixamo")[3]
    body = body_of("poser", droop=0.6)
    with pytest.raises(InputError, match=r"^motion.joints: joints that are a body's .*bone 3, \.\.\..*hip.*below \[motion\]$"):
        retarget(foreign, body)
    told = dict(zip(foreign.joint_names, body.joint_names, strict=True))
    expected = retarget(motion, body).motion
    found = retarget(foreign, body, joints=told).motion
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-9)
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-9)
    motion, body, number = motion_of("mixamo", rng), body_of("mixamo", droop=0.6), str(keys.index(("left", "hand")))
    swapped = retarget(motion, body, joints={"mixamorig:RightHand": number, "mixamorig:Head": ""})
    assert swapped.pairs["mixamorig:LeftHand"] == "mixamorig:RightHand"
    assert set(swapped.still) == {"mixamorig:RightHand", "mixamorig:Head"}
    with pytest.raises(InputError, match=r"motion.joints.mixamorig:Head.*nose.*it has"):
        retarget(motion, body, joints={"mixamorig:Head": "nose"})
    other = retarget(motion, body, joints={"nose": "mixamorig:Head"})  # of another motion of the scene, or a slip
    assert other.pairs == {n: n for n in body.joint_names} and any("does not have: nose" in n for n in other.motion.notes)
    own = retarget_to_body(motion, body_of("mixamo"), MotionSpec(joints={"nose": "mixamorig:Head"}))
    assert np.array_equal(own.poses, motion.poses)


def test_what_cannot_be_retargeted_says_why(rng):
    body, motion = body_of("smpl"), motion_of("mixamo", rng)
    with pytest.raises(InputError, match=r"body with joint names.*joint_names \(J,\)"):
        retarget(motion, replace(body, joint_names=()))
    assert body_names(replace(body, joint_names=())) == ()
    with pytest.raises(
        InputError, match=r"poses: the body's 7 joints expected, or names and a skeleton.*called mixamorig:Hips.*bvh"
    ):
        with_skeleton(replace(motion, joints=None, parents=None), 7)
    for lacking in ({"joints": None}, {"parents": None}):
        with pytest.raises(InputError, match=f"^{next(iter(lacking))}: missing.*with_skeleton"):
            retarget(replace(motion, **lacking), body)
    with pytest.raises(InputError, match="2 joints"):
        retarget_to_body(MotionRecord(np.zeros((3, 2, 3)), np.zeros((3, 3)), 30.0), body, MotionSpec())


def test_what_leads_into_a_motion_is_left_out(rng):
    motion = motion_of("cmu", rng, frames=100, amount=0)
    motion.poses[:, :, 0] = np.sin(np.arange(100) / 10)[:, None]
    assert lead_in_frames(motion) == 0
    for leap in (1, 4):
        poses = motion.poses.copy()
        poses[:leap, 5, 2] = np.linspace(1.5, 0.4, leap)
        led = replace(motion, poses=poses)
        assert lead_in_frames(led) == leap and lead_in_frames(replace(led, poses=poses[:15])) == 0
        body = body_of("smpl")
        fitted = retarget_to_body(led, body, MotionSpec())
        assert len(fitted.poses) == 100 - leap and "left out" in fitted.notes[0]
        assert len(retarget_to_body(led, body, MotionSpec(frames=(0,))).poses) == 100
    assert all(lead_in_frames(io.read_motion(packaged(n))) == 0 for n in ("walk", "jump", "dance", "mixed", "twist"))


def bvh(motion: MotionRecord, tips: float = 0.1) -> str:
    """The text of a .bvh file."""
    joints, parents = required(motion.joints, "joints"), required(motion.parents, "parents")
    children: dict[int, list[int]] = {}
    for j, p in enumerate(parents.tolist()):
        children.setdefault(p, []).append(j)
    order: list[int] = []

    def lines(j: int):
        order.append(j)
        offset = joints[j] - (joints[parents[j]] if parents[j] >= 0 else 0)
        yield f"{'JOINT' if parents[j] >= 0 else 'ROOT'} {motion.joint_names[j]}"
        places = "" if parents[j] >= 0 else "Xposition Yposition Zposition "
        yield "{ OFFSET " + " ".join(f"{v:.6f}" for v in offset)
        yield f"CHANNELS {6 if places else 3} {places}Zrotation Xrotation Yrotation"
        for child in children.get(j, []):
            yield from lines(child)
        yield f"End Site {{ OFFSET 0 {tips} 0 }} }}" if j not in children else "}"

    head = "\n".join(["HIERARCHY", *lines(0)])
    angles = np.stack([Rotation.from_rotvec(motion.poses[:, j]).as_euler("ZXY", degrees=True) for j in order], axis=1)
    rows = np.concatenate([motion.translation + joints[0], angles.reshape(len(angles), -1)], axis=1)
    numbers = "\n".join(" ".join(f"{v:.6f}" for v in row) for row in rows)
    return f"{head}\nMOTION\nFrames: {len(angles)}\nFrame Time: {1 / motion.fps:.7f}\n{numbers}\n"


def test_a_bvh_drives_the_packaged_body_and_check_says_how(tmp_path, rng, capsys):
    t = np.arange(40)[:, None]
    motion = motion_of("poser", rng, frames=40, amount=0, size=100.0)
    motion.poses[:, :, 0] = 0.3 * np.sin(t / 6 + np.arange(len(motion.parents)))
    (tmp_path / "run.bvh").write_text(bvh(motion))
    ends = io.read_motion(tmp_path / "run.bvh", scale=0.01)
    leaves = [ends.joint_names.index(n) for n in ("head", "lHand", "rFoot")]
    np.testing.assert_allclose(ends.tips[leaves], ends.joints[leaves] + [0, 0.001, 0], atol=1e-8)
    assert np.isnan(ends.tips[ends.joint_names.index("lShin")]).all()
    order = [ends.joint_names.index(n) for n in motion.joint_names]
    np.testing.assert_allclose(ends.joints[order], motion.joints / 100, atol=1e-7)
    (tmp_path / "scene.toml").write_text('[motion]\nfiles = ["run.bvh"]\nframes = [10, 40]\njoints = { rHand = "" }\n')
    assert main(["check", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "check.png")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "run.bvh: 30 frames at 30 per second retargeted by joint names, 18 of the body's 31 joints are driven, of these by one "
        "of another name: Hips by hip" in said
    )
    assert "LeftLeg by lShin" in said and "LeftFoot by lFoot" in said and "RightHand by" not in said
    assert "it seems to be in cm" in said and "drive nothing: rHand" in said and "lowest sole" in said
    scene = scene_from({"motion": {"files": ["run.bvh"]}}, str(tmp_path / "scene.toml"))
    moved, body = load_motion(scene, "run.bvh", io.read_body(packaged("body"))), io.read_body(packaged("body"))
    turns, _ = forward(body.joints, body.parents, moved)
    source, _ = forward(motion.joints, motion.parents, motion)
    theirs, ours = motion.joint_names.index("lShin"), body.joint_names.index("LeftLeg")
    bone = (motion.joints[motion.joint_names.index("lFoot")] - motion.joints[theirs]) / 40
    leg = body.joints[body.joint_names.index("LeftFoot")] - body.joints[ours]
    a, b = source[:, theirs] @ bone, turns[:, ours] @ leg
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b)]
    np.testing.assert_allclose(unit[0], unit[1], atol=1e-5)
    (tmp_path / "scene.toml").write_text('[motion]\nfiles = ["run.bvh"]\njoints = { lHand = "nose" }\n')
    assert main(["check", str(tmp_path / "scene.toml")]) == 2
    assert f"{tmp_path / 'run.bvh'}: motion.joints.lHand: a joint of the body expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("motion", "words"),
    [("frames = [1, 2, 3]", "motion.frames"), ("frames = [-1]", "motion.frames"), ('up = "w"', "motion.up"),
     ("joints = 3", "motion.joints: a table"), ("joints = { a = 1.5 }", "motion.joints.a"), ("scale = -1", "motion.scale")],
)  # fmt: skip
def test_fields_of_a_scene_that_are_wrong(tmp_path, motion, words):
    (tmp_path / "scene.toml").write_text(f"[motion]\n{motion}\n")
    with pytest.raises(InputError, match=words):
        load_scene(tmp_path / "scene.toml")


def check_upright(body: BodyRecord, moved: MotionRecord, names) -> None:
    """It walks as people do: on its soles, upright, knees and elbows bending the one way they can, left on the left."""
    role = anatomy(names, body.parents.tolist()).roles
    turns, places = forward(body.joints, body.parents, moved)
    at = {word: places[:, j] for word, j in role.items()}
    tall = np.ptp(body.vertices[:, 1])
    ground = body.vertices[:, 1].min()
    trunk = at["head"] - at["hips"]
    assert np.all(trunk[:, 1] > 0.8 * np.linalg.norm(trunk, axis=1)) and np.all(at["hips"][:, 1] - ground > 0.4 * tall)
    low = body_vertices(body, moved)[..., 1].min(axis=1) - ground
    assert np.percentile(low, 5) == pytest.approx(0, abs=0.01) and low.min() > -0.03 and np.percentile(low, 95) < 0.1
    left = at["left thigh"] - at["right thigh"]
    forward_ = np.cross(left, [0, 1, 0])
    moving = np.gradient(moved.translation, axis=0)
    fast = np.linalg.norm(moving, axis=1) * moved.fps > 1
    assert np.mean(np.sum(moving * forward_, axis=1)[fast] > 0) > 0.9  # it goes where it faces
    for side in ("left", "right"):
        thigh, shin = at[f"{side} shin"] - at[f"{side} thigh"], at[f"{side} foot"] - at[f"{side} shin"]
        knee = np.sum(np.cross(thigh, shin) * left, axis=1) / np.linalg.norm(left, axis=1)
        length = np.linalg.norm(thigh, axis=1) * np.linalg.norm(shin, axis=1)
        assert (knee / length).min() > -0.2 and (knee / length).max() > 0.5  # sine of its bend about the axis to the left
        arm, fore = at[f"{side} forearm"] - at[f"{side} arm"], at[f"{side} hand"] - at[f"{side} forearm"]
        chest = turns[:, role["left clavicle"]] @ [0, 0, 1]
        bend = fore / np.linalg.norm(fore, axis=1)[:, None] - arm / np.linalg.norm(arm, axis=1)[:, None]
        assert np.mean(np.sum(bend * chest, axis=1) > -0.1) > 0.9  # forearms come forward
        own = (at[f"{side} forearm"] - at["hips"]) @ np.eye(3)
        beside = np.sum(own * left, axis=1) * (1 if side == "left" else -1)
        assert np.median(beside) > 0
    foot = [turns[:, role[f"{s} foot"]] @ [0, 1, 0] for s in ("left", "right")]
    low = np.stack([at[f"{s} foot"][:, 1] for s in ("left", "right")]).argmin(axis=0)
    standing = np.where(low[:, None] == 0, *foot)
    assert np.median(standing[:, 1]) > 0.9  # soles are flat on the ground


@pytest.mark.parametrize("clip", CLIPS)
@pytest.mark.parametrize("character", ["packaged", "smpl"])
def test_recorded_clips_drive_other_bodies(data, clip, character, plain_jax):
    folder = data / "cmu_bvh"
    file = packaged("body") if character == "packaged" else data / "smpl_research_only" / "body.npz"
    body = io.read_body(file)
    scene = scene_from({"motion": {"files": [str(folder / f"{clip}.bvh")]}}, "")
    moved = load_motion(scene, str(folder / f"{clip}.bvh"), body)
    assert any("left out" in n for n in moved.notes) and moved.fps == 30 and moved.poses.shape[1] == len(body.parents)
    assert any(("inch" if clip == "10_01" else "in cm") in n for n in moved.notes)
    check_upright(body, moved, body_names(body))


@pytest.mark.parametrize("name", ["walk", "dance"])
def test_packaged_motions_drive_smpl(data, name):
    body = io.read_body(data / "smpl_research_only" / "body.npz")
    moved = load_motion(scene_from({}, ""), f"ncs:{name}", body)
    assert any("LeftUpLeg" in n for n in moved.notes)
    role = anatomy(body_names(body), body.parents).roles
    _, places = forward(body.joints, body.parents, moved)
    assert np.all(places[0, role["left hand"]][1] < places[0, role["left arm"]][1] - 0.2)  # its arms hang: no T-pose
    low = np.minimum(places[:, role["left foot"], 1], places[:, role["right foot"], 1]).min()
    assert low == pytest.approx(body.joints[role["left foot"], 1], abs=0.05)

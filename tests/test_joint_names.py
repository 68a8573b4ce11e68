"""Joints told by their names, in the conventions of some 70 tools."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.io import read_body
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.joint_names import Limbs, anatomy, listed, pair, propose, undriven
from ncs_jax.prepare.mirroring import mirror_partners
from ncs_jax.prepare.retarget import retarget
from tests.skeletons import ROLES, SKELETONS, skeleton
from tests.test_retarget import CONVENTIONS, body_of, figure, motion_of


def limbs(found: Limbs) -> dict[str, list[int]]:
    """The joints of limbs, trunk and head by role; without extras."""
    told = {role: [j] for role, j in found.roles.items() if role.removeprefix("left ").removeprefix("right ") in ROLES.values()}
    return {role: joints for role, joints in (told | {"spine": [*found.spine], "neck": [*found.neck]}).items() if joints}


@pytest.mark.parametrize("tool", SKELETONS)
def test_every_role_is_found_and_nothing_else_takes_one(tool):
    names, parents, expected = skeleton(SKELETONS[tool])
    found = limbs(anatomy(names, parents))
    assert {r: [names[j] for j in js] for r, js in found.items()} == {r: [names[j] for j in js] for r, js in expected.items()}
    assert len({j for joints in found.values() for j in joints}) == sum(len(joints) for joints in found.values())


RENAMED = {
    **{f"{front}...": lambda names, front=front: [front + n for n in names]
       for front in ("Hero_", "Armature|", "rig:", "npc01_", "my.char.", "Hand_", "L_", "left ", "Toe", "m", "hero", "人")},
    **{f"...{back}": lambda names, back=back: [n + back for n in names]
       for back in ("_jnt", "_BIND", ".001", "Joint", "_Hero", " (copy)", "_01", "_end", "_L", "_IK", "_rig_v2")},
    "_001 and on": lambda names: [f"{n}_{i:03d}" for i, n in enumerate(names)],
    "_01 and on": lambda names: [f"{n}_0{i}" for i, n in enumerate(names)],
    ".001 and on": lambda names: [f"{n}.{i:03d}" for i, n in enumerate(names)],
    "01_ and on": lambda names: [f"{i:02d}_{n}" for i, n in enumerate(names)],
    "wide letters": lambda names: [re.sub("[A-Za-z]", lambda one: chr(ord(one[0]) + 0xFEE0), n) for n in names],
    "small": lambda names: [n.lower() for n in names],
    "large": lambda names: [n.upper() for n in names],
}  # fmt: skip


@pytest.mark.parametrize("how", RENAMED)
def test_what_all_names_share_numbering_and_case_do_not_matter(how):
    for tool, text in SKELETONS.items():
        names, parents, expected = skeleton(text)
        renamed = RENAMED[how](names)
        assert limbs(anatomy(renamed, parents)) == expected, (tool, renamed)


@pytest.mark.parametrize("droop", [0.0, 0.7, 1.5], ids=["T-pose", "A-pose", "arms down"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_names_that_say_nothing_leave_it_to_the_shape(convention, droop):
    """However the skeleton is turned. Where it has no toes, nothing says which side is left, unless the names do."""
    for turn in (None, Rotation.random(random_state=3).as_matrix()):
        names, parents, joints, keys = figure(convention, droop=droop, turn=turn, size=70.0)
        expected, dumb = limbs(anatomy(names, parents)), [f"bone_{j:02d}" for j in range(len(names))]
        assert len(limbs(anatomy(dumb, parents))) < 3  # without places
        toes = any(part == "toe" for _, part in keys)
        found = anatomy(dumb, parents, joints)
        assert limbs(found) == expected if toes else not found.shaped
        sided = [f"bone_{j:02d}_{side[:1]}" for j, (side, _) in enumerate(keys)]
        assert limbs(anatomy(sided, parents, joints)) == expected
        mixed = [
            n if side == "" or part in ("thigh", "arm") else d for n, d, (side, part) in zip(names, dumb, keys, strict=True)
        ]
        assert limbs(anatomy(mixed, parents, joints)) == (expected if toes else limbs(anatomy(mixed, parents)))


def test_a_large_head_is_no_limb():
    names, parents, joints, keys = figure("mixamo", droop=0.3)
    top = joints[keys.index(("", "head"))] + [0, 0.45, 0]
    more = [*parents, keys.index(("", "head"))], np.concatenate([joints, [top]])
    found = anatomy([f"b{j}" for j in range(len(names) + 1)], *more)
    expected = limbs(anatomy(names, parents))
    assert limbs(found) == expected | {"head": [len(names)], "neck": [*expected["neck"], *expected["head"]]}


def along_an_axis(joints: np.ndarray, parents) -> np.ndarray:
    """Rest places as LAFAN1 has them: every bone along the x axis."""
    along = np.zeros_like(joints)
    for j, p in enumerate(parents[1:], 1):
        along[j] = along[p] + [np.linalg.norm(joints[j] - joints[p]), 0, 0]
    return along


def test_a_shape_that_is_no_person_or_contradicts_a_name_tells_nothing():
    names, parents, joints, keys = figure("mixamo")
    dumb = [f"bone_{j:02d}" for j in range(len(names))]
    assert anatomy(dumb, parents, joints).shaped
    along = along_an_axis(joints, parents)
    lame = joints.copy()
    lame[keys.index(("left", "foot"))] += [0, 0.3, 0]
    handstand = joints * [1, -1, 1] + [[0, 3 * (part in ("thigh", "shin", "foot", "toe")), 0] for _, part in keys]
    beast = joints.copy()  # on all fours: the trunk is level
    trunk = [j for j, (side, part) in enumerate(keys) if part not in ("thigh", "shin", "foot", "toe")]
    beast[trunk] = (joints[trunk] - joints[0]) @ Rotation.from_euler("x", 90, degrees=True).as_matrix().T + joints[0]
    for other in (along, lame, handstand, beast, joints * 0):
        assert not anatomy(dumb, parents, other).shaped
    flat = [0 if keys[p][1] in ("spine", "spine2", "chest") else p for p in parents]  # a torso of one joint
    assert not anatomy(dumb, flat, joints).shaped
    halved, places = list(parents), [*joints]  # each long bone in two, as by twists: then nothing says where a knee is
    for j, (_, part) in enumerate(keys):
        if part in ("forearm", "hand", "shin", "foot"):
            places.append((joints[j] + joints[parents[j]]) / 2)
            halved.append(parents[j])
            halved[j] = len(halved) - 1
    order = sorted(range(len(halved)), key=lambda j: len(path_to_root(halved, j)))
    tree = [-1 if halved[j] < 0 else order.index(halved[j]) for j in order]
    sided = [f"b{j}_{'l' if places[j][0] > 0.01 else 'r' if places[j][0] < -0.01 else 'x'}" for j in order]
    assert not anatomy(sided, tree, np.array(places)[order]).shaped
    named = list(dumb)
    named[keys.index(("left", "forearm"))] = "LeftUpLeg"
    assert not anatomy(named, parents, joints).shaped
    whole = anatomy(names, parents, along)
    assert not whole.shaped and limbs(whole) == limbs(anatomy(names, parents))  # names that tell all need no shape


def test_a_motion_whose_names_say_nothing_drives_as_one_whose_names_do(rng):
    motion, body = motion_of("mixamo", rng), body_of("smpl", droop=0.6)
    dumb = replace(motion, joint_names=tuple(f"j{j}" for j in range(len(motion.joint_names))))
    found, expected = retarget(dumb, body), retarget(motion, body)
    np.testing.assert_array_equal(found.motion.poses, expected.motion.poses)
    assert any("told by the shape" in note and "left forearm" in note for note in found.motion.notes)
    assert not any("told by the shape" in note for note in expected.motion.notes) and not found.motion.undriven


def test_the_numbers_of_a_tools_actors_do_not_matter():
    names, parents, expected = skeleton(SKELETONS["Poser"])
    assert limbs(anatomy([f"{name}:{1 + j % 3}" for j, name in enumerate(names)], parents)) == expected


def test_the_end_of_a_limb_may_be_called_anything():
    """What alone hangs on a shin is the foot; of two neither is, nor is a helper."""
    names, parents, _, keys = figure("poser")
    foot, shin = (keys.index(("left", part)) for part in ("foot", "shin"))
    called = [*names]
    called[foot] = "lLeg3"
    assert anatomy(called, parents.tolist()).roles["left foot"] == foot
    assert "left foot" not in anatomy([*called, "lFlap"], [*parents.tolist(), shin]).roles
    assert anatomy([*called, "lShinTwist"], [*parents.tolist(), shin]).roles["left foot"] == foot
    called[foot] = "lShinTip"
    assert "left foot" not in anatomy(called, parents.tolist()).roles


@pytest.mark.parametrize("part", ["arm", "forearm", "thigh", "shin"])
def test_a_limb_that_nothing_drives_is_told_with_the_likeliest_joint(rng, part):
    motion, body, keys = motion_of("poser", rng), body_of("unreal"), figure("poser")[3]
    motion = replace(motion, joints=along_an_axis(motion.joints, motion.parents))  # so that no shape tells it
    lost = keys.index(("left", part))
    names = [f"{n}Qx" if j == lost else n for j, n in enumerate(motion.joint_names)]
    found = retarget(replace(motion, joint_names=tuple(names)), body).motion
    ours = {"arm": "upperarm_l", "forearm": "lowerarm_l", "thigh": "thigh_l", "shin": "calf_l"}[part]
    bone = "upper arm" if part == "arm" else part
    assert found.undriven == {f"left {bone}": f'motion.joints = {{ "{names[lost]}" = "{ours}" }}'}
    mended = retarget(replace(motion, joint_names=tuple(names)), body, joints={names[lost]: ours}).motion
    assert not mended.undriven
    np.testing.assert_allclose(mended.poses, retarget(motion, body).motion.poses, atol=1e-9)


def test_spine_and_head_that_nothing_drives_are_told():
    body = anatomy(*figure("unreal")[:2])
    every = set(pair(body, body))
    assert undriven(body, every) == {}
    assert undriven(body, every - {body.spine[0]}) == {}  # the others bend it
    assert undriven(body, every - set(body.spine)) == {"spine": body.spine[0]}
    assert undriven(body, every - {body.roles["head"]}) == {}  # it follows the neck
    assert undriven(body, every - {body.roles["head"], *body.neck}) == {"head": body.roles["head"]}
    assert propose("head", "head", ["hips", "crest", "lFoot"], [-1, 0, 0], {0}) == "crest"
    assert propose("left foot", "foot_l", ["hips", "lSoleA", "rSoleA"], [-1, 0, 0], {0}) == "lSoleA"
    assert propose("left foot", "foot_l", ["hips", "rSoleA"], [-1, 0], {0}) == ""


def test_fingers_face_and_helpers_are_counted_and_not_listed():
    names, _, _ = skeleton(SKELETONS["Character Creator, iClone, AccuRIG"])
    text = listed(names, {n: n for n in names if any(part in n for part in ("Spine", "Mid1", "armTwist", "Eye", "Tongue"))})
    assert text == "CC_Base_Spine01, CC_Base_Spine02 and 9 finger, face or helper joints"
    assert (
        listed(names, {"CC_Base_L_Eye": "x"}) == "1 finger, face or helper joint" and listed(names, {"CC_Base_Hip": "h"}) == "h"
    )


def test_partners_in_the_mirror_are_told_in_every_convention():
    rng = np.random.default_rng(0)
    for tool, text in SKELETONS.items():
        names, parents, roles = skeleton(text)
        joints = np.zeros((len(names), 3))
        sides = [(j, roles[f"right {role[5:]}"][0]) for role, (j, *_) in roles.items() if role.startswith("left ")]
        for left, right in sides:
            joints[left] = 1.0, *rng.normal(size=2)
            joints[right] = joints[left] * [-1, 1, 1]
        partner = mirror_partners(names, joints, parents)[0]
        assert all(partner[a] == b and partner[b] == a for a, b in sides), tool


def test_the_packaged_body_has_every_limb():
    body = read_body(packaged("body"))
    assert not undriven(anatomy(body.joint_names, body.parents.tolist()), range(len(body.parents)))
    assert (
        sum(
            role.endswith(("arm", "hand", "thigh", "shin", "foot", "toe"))
            for role in anatomy(body.joint_names, body.parents).roles
        )
        == 14
    )

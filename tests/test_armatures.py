"""Characters in .glb under nodes that turn, scale and move them, as modellers and converters write them, and sliding props."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io.character.rig import quarter_turns
from ncs_jax.io.character.rig_motion import carries_limb
from ncs_jax.prepare.motion_import import retarget_to_body
from ncs_jax.scene.spec import MotionSpec
from tests.armatures import FPS, FRAMES, JOINTS, NAMES, Setup, about, matrix, transformed, write
from tests.characters import posed

ARMATURE = matrix(about("x", -90), scale=0.01)  # Blender's and Mixamo's: centimetres, lying on its back
NONSENSE = matrix(Rotation.from_rotvec([1, 2, 0.3]), (7, -3, 2), 13.0)  # of a skinned mesh's node, which says nothing
TURNS = np.array([matrix(about("y", 3 * k), (0.01 * k, 0, 0.02 * k)) for k in range(FRAMES)])

SETUPS = {
    "plain": Setup(),
    "Blender, centimetres": Setup((("Armature", ARMATURE),), spaces=(ARMATURE,), node=NONSENSE),
    "Blender, metres, the mesh scaled inversely": Setup((("Armature", ARMATURE),), node=np.linalg.inv(ARMATURE), on=True),
    "a root node of a hundred": Setup(
        (("RootNode", matrix(scale=100.0)), ("Armature", matrix(about("x", -90), scale=1e-4))), spaces=(matrix(scale=0.01),)
    ),
    "Unreal, a root bone": Setup(
        (("RootNode", np.eye(4)), ("Armature", ARMATURE)), root=matrix(about("x", 90)), spaces=(matrix(about("x", -90)),)
    ),
    "3ds Max, inches": Setup(
        (("Scene", matrix(about("x", -90))), ("Biped", matrix(about("z", 35), (3, 20, 0), 0.0254))),
        spaces=(matrix(about("x", -90), scale=0.0254),), node=NONSENSE,
    ),
    "mirrored": Setup((("Armature", matrix(about("x", -90), scale=(-0.01, 0.01, 0.01))),), spaces=(matrix(scale=(-1, 1, 1)),)),
    "the armature moves": Setup((("Armature", ARMATURE),), moves=TURNS, spaces=(ARMATURE,)),
    "the root node moves": Setup((("RootNode", np.eye(4)), ("Armature", ARMATURE)), moves=TURNS, spaces=(ARMATURE,)),
    "joints in some frame": Setup((("Armature", ARMATURE),), posed=True, spaces=(ARMATURE,), node=NONSENSE),
    "nodes between": Setup((("RootNode", matrix(scale=0.01)), ("Armature", matrix(about("x", -90)))), between=True),
    "joints of a hundred": Setup((("Armature", ARMATURE),), sizes=100.0),
    "two meshes in two units": Setup((("Armature", ARMATURE),), spaces=(np.eye(4), ARMATURE), node=NONSENSE),
    "keys stand it up": Setup((("Armature", ARMATURE),), stand=(matrix(scale=0.01),), spaces=(ARMATURE,)),
}  # fmt: skip


@pytest.fixture(scope="module")
def woman() -> io.BodyRecord:
    """The packaged body in double precision."""
    body = io.read_body("ncs:body")
    x, joints, weights = (np.asarray(a, np.float64) for a in (body.vertices, body.joints, body.weights))
    axes = np.tile(np.eye(3), (len(joints), 1, 1))
    return replace(body, vertices=x, joints=joints, weights=weights, rest_rotations=axes)


def driven(body: io.BodyRecord, motion: io.MotionRecord) -> np.ndarray:
    """The skin (frames, verts, 3) under a motion that was brought onto a body, less its mean place."""
    x = posed(body, retarget_to_body(motion, body, MotionSpec()))
    return x - x.mean(axis=(0, 1))


@pytest.mark.parametrize("name", SETUPS)
def test_skin_and_motion_are_the_files_own(tmp_path, name, woman):
    """Rest shape, joints, weights and every frame agree with the skin computed in the world, and so does what it drives."""
    truth = write(tmp_path / "hero.glb", SETUPS[name])
    body, motion = io.read_body(tmp_path / "hero.glb"), io.read_motion(tmp_path / "hero.glb")
    at = body.joints[[body.joint_names.index(n) for n in NAMES]]
    turn, _ = Rotation.align_vectors(at - at.mean(0), JOINTS - JOINTS.mean(0))
    stood = name == "keys stand it up"  # its nodes, and so its body at rest, lie
    assert turn.magnitude() == pytest.approx(np.pi / 2 if stood else 0, abs=1e-5)
    elsewhere = stood or name == "joints in some frame"  # it rests where that frame is
    assert elsewhere or np.abs(at[0] - JOINTS[0]).max() < 1e-5
    back = (body.vertices - at.mean(0)) @ turn.as_matrix() + JOINTS.mean(0)
    off, order = cKDTree(back).query(truth.rest)
    assert off.max() < 1e-5 and len(np.unique(order)) == len(truth.rest) == len(body.vertices)
    np.testing.assert_allclose((at - at.mean(0)) @ turn.as_matrix() + JOINTS.mean(0), JOINTS, atol=1e-5)
    columns = [body.joint_names.index(n) for n in NAMES]
    np.testing.assert_allclose(body.weights[order][:, columns], truth.weights, atol=1e-6)
    corners = body.vertices[body.faces] - body.vertices.mean(0)
    assert np.linalg.det(corners).sum() > 0  # it faces outward
    assert (motion.fps, len(motion.poses)) == (FPS, FRAMES)
    np.testing.assert_allclose(posed(body, motion)[:, order], truth.moved, atol=1e-5)
    moves = SETUPS[name].moves
    write(tmp_path / "plain.glb", Setup((("Armature", np.eye(4)),), moves=moves))
    plain = io.read_motion(tmp_path / "plain.glb")
    np.testing.assert_allclose(driven(woman, motion), driven(woman, plain), atol=1e-4)


@pytest.mark.parametrize("name", ["Blender, centimetres", "joints in some frame", "keys stand it up", "Unreal, a root bone"])
def test_another_motion_drives_it_as_it_drives_the_plain_one(tmp_path, name):
    truth, plain = write(tmp_path / "hero.glb", SETUPS[name]), write(tmp_path / "plain.glb", Setup())
    walk = io.read_motion("ncs:walk", frame_range=(20, 35))
    found = []
    for file, x in ((tmp_path / "hero.glb", truth.rest), (tmp_path / "plain.glb", plain.rest)):
        body = io.read_body(file)
        at = body.joints[[body.joint_names.index(n) for n in NAMES]]
        turn, _ = Rotation.align_vectors(at - at.mean(0), JOINTS - JOINTS.mean(0))
        order = cKDTree((body.vertices - at.mean(0)) @ turn.as_matrix() + JOINTS.mean(0)).query(x)[1]
        found.append(driven(body, walk)[:, order])
    assert np.ptp(found[1], axis=0).max() > 0.2
    np.testing.assert_allclose(*found, atol=1e-4)


def test_an_animation_without_a_skin(tmp_path, woman):
    write(tmp_path / "clip.glb", Setup((("RootNode", matrix(scale=100.0)), ("Armature", 0.01 * ARMATURE)), skin=False))
    write(tmp_path / "plain.glb", Setup())
    found, expected = (driven(woman, io.read_motion(tmp_path / f"{n}.glb")) for n in ("clip", "plain"))
    np.testing.assert_allclose(found, expected, atol=1e-4)


# --- a sword that slides ------------------------------------------------------------------------------------------------------


def sword(on: str = "RightHand", mesh: bool = True, scales: bool = False, called: str = "Sword"):
    """A joint that slides along y by 0.3 m, with a mesh and a skin of its own or without, on a joint or beside the hips."""

    def write_it(file, nodes: dict, rest: dict, last: int) -> None:
        parent, above = (nodes[on], rest[on]) if on else (last, ARMATURE)
        size = np.cbrt(np.linalg.det(above[:3, :3]))
        place = matrix(place=(-0.8, 1.44, 0.05), scale=size)
        own = np.linalg.inv(above) @ place
        node = file.node(called, own, parent)
        up = 0.3 * np.linspace(0, 1, FRAMES)[:, None] / size
        file.key(node, "translation", own[:3, 3] + up * [0, 1, 0])
        if scales:
            file.key(node, "scale", np.where(np.arange(FRAMES)[:, None] < 4, 0.0, 1.0) * np.ones(3))
        if mesh:
            corners = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.5, 0], [0, 0, 0.02]])
            x, faces = transformed(place, corners / size), [[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]]
            owners, weights = np.zeros((4, 4)), np.tile([1.0, 0, 0, 0], (4, 1))
            file.skin("Sword", x, faces, owners, weights, {node: np.linalg.inv(place)}, NONSENSE)

    return write_it


def armed(prop, **more) -> Setup:
    return Setup((("Armature", ARMATURE),), spaces=(ARMATURE,), prop=prop, **more)


@pytest.mark.parametrize("case", ["no mesh", "with a mesh", "which also vanishes"])
def test_a_prop_that_slides_in_a_hand_leaves_the_body_as_it_is(tmp_path, case):
    """It keeps its place on the hand, and that is told where it carries skin."""
    truth = write(tmp_path / "hero.glb", armed(sword(mesh=case != "no mesh", scales=case == "which also vanishes")))
    body, motion = io.read_body(tmp_path / "hero.glb"), io.read_motion(tmp_path / "hero.glb")
    found = posed(body, retarget_to_body(motion, body, MotionSpec()))
    order = cKDTree(body.vertices).query(truth.rest)[1]
    np.testing.assert_allclose(found[:, order], truth.moved, atol=1e-5)
    told = "as joints only turn: Sword, by up to 0.15 m" in " ".join(motion.notes)
    assert told == (case != "no mesh")
    vanishes = "that change their size keep that at rest, as joints only turn: Sword" in " ".join(motion.notes)
    assert vanishes == (case == "which also vanishes")
    if told:
        blade = np.setdiff1d(np.arange(len(body.vertices)), order)
        hand = order[truth.weights[:, NAMES.index("RightHand")] == 1][0]
        apart = np.linalg.norm(found[:, blade] - found[:, hand : hand + 1], axis=-1)
        np.testing.assert_allclose(apart, apart[:1].repeat(FRAMES, axis=0), atol=1e-5)


@pytest.mark.parametrize("on", ["RightHand", ""])
@pytest.mark.parametrize("skin", [True, False])
def test_a_prop_that_slides_does_not_change_what_the_motion_drives(tmp_path, woman, on, skin):
    """Beside the hips too, where it does not make them a joint that slides."""
    write(tmp_path / "hero.glb", armed(sword(on, mesh=skin), skin=skin))
    write(tmp_path / "plain.glb", Setup())
    found, expected = (driven(woman, io.read_motion(tmp_path / f"{n}.glb")) for n in ("hero", "plain"))
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_limb_that_slides_is_refused(tmp_path):
    write(tmp_path / "hero.glb", armed(sword("RightArm", called="Claw_Hand")))
    with pytest.raises(InputError, match="joint Claw_Hand: bones of fixed length expected"):
        io.read_motion(tmp_path / "hero.glb")


def test_which_joints_carry_a_limb():
    names = ("Hips", "Spine", "Hand_L", "Finger", "Ball", "Leg", "ball_l", "Sword")
    parents = np.array([-1, 0, 1, 2, 0, 0, 5, 1])
    expected = [True, True, True, False, False, True, True, False]
    assert carries_limb(names, parents).tolist() == expected
    assert carries_limb(("a", "b"), np.array([-1, 0])).tolist() == [True, True]  # names that tell nothing


def test_the_quarter_turns_are_all_rotations_of_a_cube_the_identity_first():
    found = quarter_turns()
    np.testing.assert_array_equal(found[0], np.eye(3))
    cube = np.round(Rotation.create_group("O").as_matrix())
    assert sorted(found.reshape(24, 9).tolist()) == sorted(cube.reshape(24, 9).tolist())

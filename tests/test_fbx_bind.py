"""Where a character in FBX rests whose nodes stand elsewhere: its bones posed together, or what carries them moved, or both."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ncs_jax import io
from tests import fbx_files as fbx
from tests.characters import JOINTS, figure, posed, rigid
from tests.test_fbx import AXES, Hero, lcl

AT_BIND = {"Lcl__Translation": (4, 0, 3), "Lcl__Rotation": (15, 0, 0), "Lcl__Scaling": (2, 2, 2)}
MOVED = {"Lcl__Translation": (-60, 20, 9), "Lcl__Rotation": (70, 20, -40), "Lcl__Scaling": (2, 2, 2)}
SCALED = {"Lcl__Translation": (4, 0, 3), "Lcl__Rotation": (15, 0, 0), "Lcl__Scaling": (0.02, 0.02, 0.02)}
LYING = {"Lcl__Translation": (4, 0, 3), "Lcl__Rotation": (105, 0, 0), "Lcl__Scaling": (2, 2, 2)}
AS_BOUND = ((0.0, 0, 0), (0.0, 0, 0))
ASIDE, TURNED = ((25.0, -10, 8), (0.0, 0, 0)), ((25.0, -10, 8), (10.0, 50, -20))  # of the hips, in the armature's units


def matrix(given: dict) -> np.ndarray:
    turn = Rotation.from_euler("xyz", given["Lcl__Rotation"], degrees=True)
    return rigid(given["Lcl__Translation"], turn, given["Lcl__Scaling"][0])


def bind_pose(hero: Hero, at: np.ndarray | None = None) -> fbx.Node:
    """The matrices of armature and bones when they were bound, or of another time, when all of them were elsewhere."""
    bones = {20 + j: m for j, m in enumerate(hero.globals(np.zeros((3, 3))))}
    lines: list = [
        ("PoseNode", [], [("Node", [key], None), ("Matrix", [((np.eye(4) if at is None else at) @ m).T.ravel().copy()], None)])
        for key, m in ({10: hero.armature} | bones).items()
    ]
    return ("Pose", [60, "Pose::Bind", "BindPose"], lines)


def standing(path, hero: Hero, hips=AS_BOUND, armature=AT_BIND, pose=None, kind="Null", frame=None):
    """Write the character, its nodes at bind but for hips and armature; or its skeleton alone, with the angles of a frame."""
    tree = hero.tree(skin=frame is None)
    objects = tree[2][2]
    for n, (name, values, inner) in enumerate(objects):
        if name == "Model" and values[0] == 10:
            objects[n] = (name, [10, "Model::Armature", kind], [fbx.properties(InheritType=1, **armature)])
        elif name == "Model" and values[0] in (20, 21, 22):
            j = values[0] - 20
            angles = np.zeros(3) if frame is None else lcl(frame)[j]
            place, turn = hips if j == 0 else AS_BOUND
            given = {"Lcl__Rotation": angles + turn, "Lcl__Translation": hero.place[j] + place}
            kept = [p for p in inner[0][2] if p[1][0] not in ("Lcl Rotation", "Lcl Translation")]
            objects[n] = (name, values, [("Properties70", [], kept + fbx.properties(**given)[2])])
    if pose is not None:
        objects.append(pose)
    path.write_bytes(fbx.binary(tree))
    return path


def rests(path, hero: Hero, moved: np.ndarray, after: dict = AT_BIND) -> None:
    """Hold the body of a file to the bind pose, moved in the file's world, and what it draws to the nodes', to 0.01 mm."""

    def placed(x: np.ndarray, by: np.ndarray) -> np.ndarray:
        world = hero.to_world @ by @ np.linalg.inv(hero.to_world)
        return x @ world[:3, :3].T + world[:3, 3]

    body, motion = io.read_body(path), io.read_motion(path)
    far, order = cKDTree(body.vertices).query(placed(figure()["vertices"], moved))
    assert far.max() < 1e-5 and len(set(order.tolist())) == len(body.vertices)
    np.testing.assert_allclose(body.joints, placed(JOINTS, moved), atol=1e-5)
    truth = placed(hero.truth(), matrix(after) @ np.linalg.inv(hero.armature))
    assert np.abs(posed(body, motion)[:, order] - truth).max() < 1e-5


@pytest.mark.parametrize("hips", [ASIDE, TURNED], ids=["aside", "turned"])
@pytest.mark.parametrize("axes", AXES)
def test_bones_that_are_posed_together_rest_as_they_were_bound(tmp_path, axes, hips):
    """All nodes agree with the bind pose up to one movement, which is the pose of the highest bone."""
    hero = Hero(axes)
    rests(standing(tmp_path / "hero.fbx", hero, hips, pose=bind_pose(hero)), hero, np.eye(4))


@pytest.mark.parametrize("hips", [AS_BOUND, TURNED], ids=["at bind", "turned"])
@pytest.mark.parametrize("after", [MOVED, SCALED, LYING], ids=["moved", "scaled", "lying"])
def test_what_carries_the_bones_takes_them_along(tmp_path, after, hips):
    """An armature that was moved, turned or scaled after binding, with and without a pose of the hips."""
    hero = Hero("Y up, cm")
    moved = matrix(after) @ np.linalg.inv(hero.armature)
    path = standing(tmp_path / "hero.fbx", hero, hips, after, bind_pose(hero))
    rests(path, hero, moved, after)


@pytest.mark.parametrize("after", [MOVED, SCALED, LYING], ids=["moved", "scaled", "lying"])
@pytest.mark.parametrize("said", ["nothing", "another time", "no numbers"])
def test_nodes_count_where_the_file_does_not_say_how_they_were_carried(tmp_path, after, said):
    """Without a bind pose of the armature, or with one that contradicts the skin's, the character is where its nodes are."""
    hero = Hero("Y up, cm")
    pose = None if said == "nothing" else bind_pose(hero, rigid((50 if said == "another time" else np.nan, 0, 0)))
    path = standing(tmp_path / "hero.fbx", hero, armature=after, pose=pose)
    rests(path, hero, matrix(after) @ np.linalg.inv(hero.armature), after)


@pytest.mark.parametrize("after", [MOVED, SCALED, LYING], ids=["moved", "scaled", "lying"])
def test_bones_that_nothing_carries_are_posed_but_for_scale_and_quarter_turns(tmp_path, after):
    """The highest bone is at the top of the file: a bind pose of another scale or with other axes is in another space."""
    hero = Hero("Y up, cm")
    path = standing(tmp_path / "hero.fbx", hero, armature=after, kind="LimbNode")
    rests(path, hero, np.eye(4) if after is MOVED else matrix(after) @ np.linalg.inv(hero.armature), after)


def test_a_skeleton_without_a_skin_keeps_its_way_aside(tmp_path):
    """Its nodes stand in some frame: which one that is does not change the path; the same as with the skin."""
    hero, far = Hero("Y up, cm"), np.array((25.0, 0, -10))
    hero.place[0] += far  # of the frames too
    found = {}
    for frame in (0, 9):
        path = standing(tmp_path / f"{frame}.fbx", hero, (hero.shift(frame), (0, 0, 0)), frame=frame)
        found[frame] = io.read_motion(path)
        (note,) = found[frame].notes
        assert f"rests as in its frame {frame}, where Hips stands 0." in note and "the path keeps that" in note
    first, ninth = (m.translation[:, [0, 2]] for m in found.values())
    np.testing.assert_allclose(first, ninth, atol=1e-6)
    world = np.array([hero.globals(lcl(f), hero.shift(f))[0, :3, 3] for f in range(16)])
    np.testing.assert_allclose(first, 0.01 * (world - hero.armature[:3, 3])[:, [0, 2]], atol=1e-6)


def test_a_skeleton_that_stands_in_no_frame_says_what_the_path_is_since(tmp_path):
    hero = Hero("Y up, cm")
    path = standing(tmp_path / "idle.fbx", hero, ((40.0, 0, 0), (30.0, 0, 0)), frame=5)
    motion = io.read_motion(path)
    assert "rests as its nodes stand, where Hips stands 0.76 m" in motion.notes[0] and "told since there" in motion.notes[0]
    assert motion.translation[0, 0] < -0.5
    hero.place[0][0] = 0  # above the armature
    assert io.read_motion(standing(tmp_path / "above.fbx", hero, frame=5)).notes == ()

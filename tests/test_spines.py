"""Spines and necks of other counts: trunk and head of the body look where the recorded ones look, whatever is between them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.prepare.motion_import import retarget_to_body
from ncs_jax.scene.spec import MotionSpec
from tests.test_mixamo import write_fbx, write_glb
from tests.test_reference_pose import FRAMES, bvh_text
from tests.test_retarget import body_of, figure, forward

TRUNK = ("spine", "spine2", "chest", "neck", "head")
# Joints of spine and neck of the motion and of the body, and the format of the motion.
COUNTS = [
    ((2, 1), (5, 2), "bvh"), ((5, 2), (2, 1), "fbx"), ((3, 1), (4, 3), "glb"), ((4, 3), (3, 1), "bvh"), ((1, 1), (5, 1), "fbx"),
    ((5, 1), (1, 2), "glb"), ((3, 0), (3, 2), "bvh"), ((4, 2), (2, 0), "glb"),
]  # fmt: skip


def spined(spine: int, neck: int) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The figure with so many joints in its spine and neck: names, parents and rest joints."""
    names, parents, joints, keys = figure("mixamo")
    numbers = ["", *range(1, 9)]
    trunk = (
        [f"mixamorig:Spine{n}" for n in numbers[:spine]] + [f"mixamorig:Neck{n}" for n in numbers[:neck]] + ["mixamorig:Head"]
    )
    places = np.zeros((len(trunk), 3))
    places[:, 1] = [*np.linspace(1.05, 1.27, spine + 1)[1:], *np.linspace(1.43, 1.5, neck), 1.55]
    limbs = [j for j, (_, part) in enumerate(keys) if part not in TRUNK]  # the hips are the first
    new = {j: n if n == 0 else n + len(trunk) for n, j in enumerate(limbs)}
    above = [spine if keys[p][1] in TRUNK else new[p] for p in parents[limbs[1:]]]
    return (
        (names[0], *trunk, *(names[j] for j in limbs[1:])),
        np.array([-1, *range(len(trunk)), *above], np.int32),
        np.concatenate([joints[:1], places, joints[limbs[1:]]]),
    )


@pytest.mark.parametrize(("theirs", "ours", "kind"), COUNTS)
def test_trunk_and_head_look_where_the_recorded_ones_look(tmp_path, rng, theirs, ours, kind):
    names, parents, joints = spined(*theirs)
    frames = FRAMES if kind == "bvh" else 8
    poses = 0.25 * rng.normal(size=(frames, len(names), 3))
    motion = MotionRecord(poses, np.linspace(0, 1, frames)[:, None] * [0.2, 0, 0.7], 30.0, names, joints, parents)
    path = tmp_path / f"clip.{kind}"
    if kind == "bvh":
        path.write_text(bvh_text(motion, {names[0]: joints[0] + motion.translation}))
    elif kind == "fbx":
        write_fbx(path, motion, where="hips", size=1.0, unit=0.01, skin=False, pre=True)
    else:
        write_glb(path, motion, where="hips", size=0.01, skin=False)
    own, above, rest = spined(*ours)
    plain = body_of("mixamo")
    body = BodyRecord(rest, plain.faces, rest, above, np.eye(len(rest)), own)
    moved = retarget_to_body(io.read_motion(path), body, MotionSpec(frames=(0,)))
    there, here = forward(joints, parents, motion)[0], forward(rest, above, moved)[0]
    pairs = {"mixamorig:Hips": "mixamorig:Hips", names[theirs[0]]: own[ours[0]], "mixamorig:Head": "mixamorig:Head"}
    for source, target in pairs.items():
        off = np.swapaxes(there[:, names.index(source)], -1, -2) @ here[:, own.index(target)]
        assert np.degrees(Rotation.from_matrix(off).magnitude()).max() < 0.1, (source, target)
    assert not moved.undriven

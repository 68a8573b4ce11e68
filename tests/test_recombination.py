"""Poses put together of the motions' limbs: what they are made of, what they keep apart, and how training sees them."""

import shutil
from dataclasses import replace

import jax
import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.io.packaged import packaged
from ncs_jax.io.records import MotionRecord
from ncs_jax.prepare import recombination
from ncs_jax.prepare.recombination import CLOSER, FARTHER, recombination_of, recombined, segment_distances
from ncs_jax.runs.adapt import _scene_on
from ncs_jax.runs.placed_scene import POOL, PlacedScene
from ncs_jax.runs.run import assemble, load_run
from ncs_jax.runs.train import train
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.loss import with_bodies

from .scenes import FREE, SCENE, write_scene


@pytest.fixture(scope="module")
def woman():
    """The packaged body and two of its motions."""
    return io.read_body(packaged("body")), [io.read_motion(packaged(name)) for name in ("walk", "dance")]


def test_segments_are_as_far_apart_as_their_nearest_points(rng):
    p, u, q, v = rng.normal(size=(4, 100, 3))
    u[0] = v[0]  # in parallel
    t = np.linspace(0, 1, 101)
    apart = (p[:, None] + t[:, None] * u[:, None])[:, :, None] - (q[:, None] + t[:, None] * v[:, None])[:, None]
    seen = np.linalg.norm(apart, axis=-1).min(axis=(1, 2))
    found = segment_distances(p, u, q, v)
    assert np.all(found <= seen + 1e-12) and np.abs(found - seen).max() < 0.02  # half a step of the grid


def test_limbs_begin_where_a_skeleton_branches(woman):
    body, motions = woman
    limbs = recombination_of(body, motions)
    number = dict(zip(body.joint_names, limbs.limb.tolist(), strict=True))
    assert number["LeftArm"] == number["LeftHand"] != number["RightArm"]
    assert number["LeftUpLeg"] == number["LeftToeBase"] != number["RightUpLeg"]
    assert number["LowerBack"] == number["Spine1"] != number["Hips"] == 0


def test_each_limb_is_that_of_a_frame_turned_farther_or_less_far(woman):
    body, motions = woman
    limbs = recombination_of(body, motions)
    poses = recombined(limbs, 50, [0, 1])
    np.testing.assert_array_equal(poses, recombined(limbs, 50, [0, 1]))
    assert np.any(poses != recombined(limbs, 50, [0, 2]))
    frames = []
    for pose in poses:
        of = []
        for limb in range(limbs.limb.max() + 1):
            some = limbs.limb == limb
            those, this = limbs.poses[:, some].reshape(len(limbs.poses), -1), pose[some].ravel()
            factor = np.clip(those @ this / np.maximum(np.sum(those**2, axis=1), 1e-12), *((1, 1) if limb == 0 else FARTHER))
            left = np.linalg.norm(this - factor[:, None] * those, axis=1)
            of.append(int(left.argmin()))
            assert left.min() < 1e-5
        frames.append(of)
    assert all(len(set(of)) > 3 for of in frames)


def test_bones_keep_the_distance_that_they_have_in_the_motions(woman, monkeypatch):
    body, motions = woman
    limbs = recombination_of(body, motions)

    def nearest(poses):  # hips are one place
        apart = limbs.closest > 0
        return recombination._distances(body, poses, limbs.pairs)[:, apart] / limbs.closest[apart]

    assert nearest(recombined(limbs, 200, [0])).min() >= CLOSER
    monkeypatch.setattr(recombination, "CLOSER", 0)
    assert nearest(recombined(limbs, 200, [0])).min() < CLOSER / 2  # arms in the trunk


def test_where_nothing_fits_together_the_frames_themselves_are_taken(woman, monkeypatch):
    body, motions = woman
    limbs = recombination_of(body, motions)
    monkeypatch.setattr(recombination, "CLOSER", 1e3)
    poses = recombined(limbs, 20, [0])
    assert len(poses) == 20 and all(np.any(np.all(limbs.poses == pose, axis=(1, 2))) for pose in poses)


def test_a_body_of_one_joint_stands_as_in_a_frame(woman):
    body, _ = woman
    alone = replace(
        body, joints=body.joints[:1], parents=body.parents[:1], joint_names=body.joint_names[:1], rest_rotations=None
    )
    motion = MotionRecord(np.arange(6.0).reshape(2, 1, 3), np.zeros((2, 3)), 30.0)
    assert {tuple(pose.ravel()) for pose in recombined(recombination_of(alone, [motion]), 30, [0])} == {(0, 1, 2), (3, 4, 5)}


def test_they_stand_behind_the_motions_and_change_after_a_checkpoint(tmp_path, plain_jax):
    text = SCENE.replace("[training]", "[training]\nrecombined = 0.5")
    a = assemble(load_scene(write_scene(tmp_path, text)))
    placed, frames, batch = PlacedScene(a, 0), len(a.track.start), a.scene.training.batch
    first = placed.features
    assert len(first.start) == frames + POOL
    np.testing.assert_array_equal(first.start[frames:], frames + np.arange(POOL))
    assert not np.any(first.dynamic[frames:]) and np.any(first.static[frames:] != first.static[0])
    ends = placed._ends(0, 10)
    assert np.all(np.sum(ends >= frames, axis=1) == batch // 2)
    params = placed.initial_state().params
    placed._placed()  # so that the bodies of the motions are there already
    placed.refresh(params, 10)
    assert np.any(placed.features.static[frames:] != first.static[frames:])
    np.testing.assert_array_equal(placed.features.static[:frames], first.static[:frames])
    assert len(a.track.start) == frames
    anew = with_bodies(a.model, placed.features, batch).bodies
    np.testing.assert_allclose(placed._placed()[1].bodies, anew, atol=1e-6)


@pytest.mark.parametrize("text", [SCENE, FREE], ids=["pinned", "free"])
def test_a_run_that_trains_on_them_is_resumed_bit_for_bit(tmp_path, plain_jax, text):
    text = text.replace("[training]", "[training]\nrecombined = 0.5")
    scene, out = write_scene(tmp_path, text), tmp_path / "run"
    run = train(scene, out, steps=30)
    whole = jax.tree.leaves(load_run(out).params)
    shutil.rmtree(out / "checkpoints" / "30")
    train(scene, out, resume=True)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(load_run(out).params), whole)
    plain = train(write_scene(tmp_path, text.replace("recombined = 0.5", "recombined = 0.0")), tmp_path / "plain", steps=30)
    assert any(not np.array_equal(a, b) for a, b in zip(whole, jax.tree.leaves(plain.params), strict=True))
    assert _scene_on(run, str(tmp_path / "swing.npz"))[0].training.recombined == 0  # a motion is adapted to, not others

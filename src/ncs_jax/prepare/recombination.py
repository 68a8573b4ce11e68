"""Poses that no motion has: each limb as it is in a frame of its own, and turned farther or less far than there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ncs_jax.io.records import BodyRecord, MotionRecord
from ncs_jax.prepare.posing import joint_places, world_axes, world_turns

__all__ = ["Recombination", "recombination_of", "recombined"]

FARTHER = 0.8, 1.6  # times the angles of a frame, that a limb's joints are turned by
CLOSER = 0.9  # times the least distance of two bones in the motions, that they keep at least
SAMPLE = 2048  # frames that tell the least distances, at most
BONE = 0.03  # of a skeleton's size: a shorter one, as of fingers, is in nobody's way
ROUNDS = 20  # of drawing, at most


@dataclass(frozen=True)
class Recombination:
    """What poses are put together from: the frames of motions, and how the skeleton falls into limbs.

    poses: (frames, joints, 3) axis-angle. limb: (joints,) the limb of each joint, 0 that of the root. pairs: (2, pairs) joints
    at the ends of two bones of different limbs that do not meet, closest: (pairs,) how near they come in the motions, m.
    """

    body: BodyRecord
    poses: np.ndarray
    limb: np.ndarray
    pairs: np.ndarray
    closest: np.ndarray


def recombination_of(body: BodyRecord, motions: Sequence[MotionRecord]) -> Recombination:
    """Return the limbs of a skeleton, and how they move. A limb begins at every child of a joint that has several."""
    parents = np.asarray(body.parents)
    children = np.bincount(parents[parents >= 0], minlength=len(parents))
    limb = np.zeros(len(parents), int)
    for j, parent in enumerate(parents):  # parents come first
        if parent >= 0:
            limb[j] = limb.max() + 1 if children[parent] > 1 else limb[parent]
    length = np.linalg.norm(body.joints - body.joints[np.maximum(parents, 0)], axis=1)
    bones = np.flatnonzero((parents >= 0) & (length > BONE * np.ptp(body.joints, axis=0).max()))
    apart = [(a, b) for i, a in enumerate(bones) for b in bones[i + 1 :] if limb[a] != limb[b]]
    pairs = np.array([(a, b) for a, b in apart if len({a, b, parents[a], parents[b]}) == 4], int).reshape(-1, 2).T
    poses = np.concatenate([motion.poses for motion in motions])
    some = poses[np.unique(np.linspace(0, len(poses) - 1, SAMPLE).astype(int))]
    return Recombination(body, poses, limb, pairs, _distances(body, some, pairs).min(axis=0, initial=np.inf))


def recombined(given: Recombination, count: int, seed: Sequence[int]) -> np.ndarray:
    """Return so many poses (count, joints, 3), axis-angle: a pure function of its arguments.

    Each limb is as in a frame drawn for it alone, its joints' angles times a factor of `FARTHER`; the root is as in a frame. In
    no pose are two bones nearer to each other than they come in the motions, to `CLOSER`: arms pass through no trunk. Where
    hardly any such pose is found, frames as they are fill the rest.
    """
    rng, limb = np.random.default_rng(seed), given.limb
    found: list[np.ndarray] = []
    for _ in range(ROUNDS):
        if sum(map(len, found)) >= count:
            break
        frame = rng.integers(len(given.poses), size=(count, limb.max() + 1))
        factor = rng.uniform(*FARTHER, frame.shape)
        factor[:, 0] = 1
        poses = given.poses[frame[:, limb], np.arange(len(limb))] * factor[:, limb, None]
        poses = poses.astype(given.poses.dtype)
        found.append(poses[np.all(_distances(given.body, poses, given.pairs) >= CLOSER * given.closest, axis=1)])
    return np.concatenate([*found, given.poses[rng.integers(len(given.poses), size=count)]])[:count]


def _distances(body: BodyRecord, poses: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return how far pairs of bones, each from a joint to its parent, are apart in poses (poses, pairs), m."""
    turns = world_turns(world_axes(poses, body.rest_rotations), body.parents)
    places = joint_places(turns, body.joints, body.parents, np.zeros((len(poses), 3))).astype(np.float32)
    (first, second), parents = pairs, np.asarray(body.parents)
    p, q = places[:, parents[first]], places[:, parents[second]]
    return segment_distances(p, places[:, first] - p, q, places[:, second] - q)


def segment_distances(p: np.ndarray, u: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the least distance |p + s u - q - t v|, 0 <= s, t <= 1, of segments (..., 3), none of length 0.

    Source: Ericson 2004, Real-Time Collision Detection, section 5.1.9.
    """
    dot = "...a,...a->..."
    r = p - q
    uu, vv, uv, ur, vr = (np.einsum(dot, a, b) for a, b in ((u, u), (v, v), (u, v), (u, r), (v, r)))
    across = uu * vv - uv * uv
    s = np.where(across > 1e-6 * uu * vv, (uv * vr - ur * vv) / np.maximum(across, 1e-12), 0).clip(0, 1)
    t = ((uv * s + vr) / vv).clip(0, 1)
    s = ((uv * t - ur) / uu).clip(0, 1)
    return np.linalg.norm(r + s[..., None] * u - t[..., None] * v, axis=-1)

"""Skeletons in motion and at rest: forward kinematics, a person's axes, bones, and the least turn between directions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import required
from ncs_jax.io import MotionRecord
from ncs_jax.io.character.rig import quarter_turns
from ncs_jax.prepare.joint_names import Limbs
from ncs_jax.prepare.posing import joint_places, world_axes, world_turns

__all__ = [
    "LIMBS",
    "angle",
    "body_axes",
    "bone",
    "forward",
    "joint_turns",
    "least_turn",
    "person_axes",
    "rest_of",
    "sampled",
    "side_vector",
    "standing_axis",
    "top",
    "trunk_of",
    "up_axis",
]

# The bones that are aligned at rest, from the trunk outward: the role at either end.
LIMBS = {"arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}
SAMPLES = 600  # frames that tell about a motion as a whole


def rest_of(motion: MotionRecord) -> tuple[np.ndarray, np.ndarray]:
    """Return a motion's joints at rest and their parents."""
    mend = "give it a skeleton: see with_skeleton"
    return required(motion.joints, "joints", mend), required(motion.parents, "parents", mend)


def joint_turns(motion: MotionRecord) -> np.ndarray:
    """Return each joint's rotation since rest (T, J, 3, 3), seen from its parent, in the world's axes."""
    return world_axes(motion.poses, motion.rest_rotations)


def forward(motion: MotionRecord, turns: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return world rotations since rest (T, J, 3, 3) and positions (T, J, 3) of the joints; rotations may be given."""
    joints, parents = rest_of(motion)
    turns = world_turns(joint_turns(motion), parents) if turns is None else turns
    return turns, joint_places(turns, joints, parents, joints[0] + motion.translation)


def sampled(motion: MotionRecord) -> MotionRecord:
    """Return at most `SAMPLES` frames of a motion, evenly spread."""
    every = slice(None, None, -(-len(motion.poses) // SAMPLES))
    return replace(motion, poses=motion.poses[every], translation=motion.translation[every])


def side_vector(places: np.ndarray, of: Limbs) -> np.ndarray:
    """Return the sum (..., 3) of the vectors from right to left, between the hips and between the shoulders."""
    out = np.zeros((*places.shape[:-2], 3))
    for part in ("thigh", "arm"):
        if f"left {part}" in of.roles and f"right {part}" in of.roles:
            out = out + places[..., of.roles[f"left {part}"], :] - places[..., of.roles[f"right {part}"], :]
    return out


def body_axes(joints: np.ndarray, of: Limbs) -> np.ndarray:
    """Return columns that point left, up and forward of a skeleton at rest, each along the nearest axis of coordinates."""
    left, up = side_vector(joints, of), joints[top(of)] - joints[of.roles["hips"]]
    ahead = np.cross(left, up)
    if not np.linalg.norm(ahead) > 0:  # no two sides, or no height
        return np.eye(3)
    left, ahead = left / np.linalg.norm(left), ahead / np.linalg.norm(ahead)
    found = np.stack([left, np.cross(ahead, left), ahead], axis=1)
    return min(quarter_turns(), key=lambda q: -np.trace(q.T @ found))


def top(of: Limbs) -> int:
    """Return the highest joint of the trunk: the head, else the last of the neck, of the spine, or the hips."""
    return of.roles["head"] if "head" in of.roles else (of.neck or of.spine or (of.roles["hips"],))[-1]


def standing_axis(motion: MotionRecord, of: Limbs) -> str:
    """Return the axis of the world, y or z, along which hips to head point in a motion on average."""
    places = forward(sampled(motion))[1]
    mean = (places[:, top(of)] - places[:, of.roles["hips"]]).mean(axis=0)
    return "z" if mean[2] > 2 * np.abs(mean[:2]).max() else "y"


def up_axis(places: np.ndarray, joints: np.ndarray, of: Limbs) -> str:
    """Return the axis of the world that points up, y or z.

    It is z where hips to head lie along it on average, and at rest as well. Where they are upright along y at rest, people who
    lie would look like people who stand along z, so more is asked: in every frame hips to head are within 45 degrees of z, and
    either the path goes across z, by half a leg and more than twice as far as along it, or the feet stay at z = 0.
    """
    hips, legs = places[:, of.roles["hips"]], [of.roles[r] for r in ("left foot", "right foot") if r in of.roles]
    trunk, rest = places[:, top(of)] - hips, joints[top(of)] - joints[of.roles["hips"]]
    mean = trunk.mean(axis=0)
    if mean[2] <= 2 * np.abs(mean[:2]).max():
        return "y"
    if rest[2] > 2 * np.abs(rest[:2]).max():
        return "z"
    if not legs or (trunk[:, 2] < np.linalg.norm(trunk[:, :2], axis=1)).any():
        return "y"
    leg = float(np.linalg.norm(np.diff(joints[[of.roles["hips"], legs[0]]], axis=0)))
    across, along = np.linalg.norm(np.ptp(hips[:, :2], axis=0)), np.ptp(hips[:, 2])
    low = places[:, legs, 2].min(axis=1)
    grounded = bool(np.abs(np.median(low)) < 0.25 * leg and (hips[:, 2] > 0.6 * leg).all())
    return "z" if (across > 0.5 * leg and across > 2 * along) or grounded else "y"


def least_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the least rotation that takes direction a to b; half a turn where they are opposite."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), a @ b
    if cosine < -1 + 1e-9:
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix()
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def bone(of: Limbs, end: str, joints: np.ndarray, tips: np.ndarray | None, j: int) -> np.ndarray | None:
    """Return the vector from a joint to its bone's end: the joint of that role, or the tip; None where neither is known."""
    place = joints[of.roles[end]] if of.roles.get(end, j) != j else joints[j] if tips is None else tips[j]
    vector = (place - joints[j]).astype(np.float64)
    return vector if np.linalg.norm(vector) > 0 else None


def trunk_of(of: Limbs) -> list[int]:
    """Return the joints from the hips to the head."""
    return [of.roles["hips"], *of.spine, *of.neck, *([of.roles["head"]] if "head" in of.roles else [])]


def angle(a: np.ndarray, b: np.ndarray) -> Any:
    """Return the angle in degrees between vectors (..., 3)."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def person_axes(places: np.ndarray, of: Limbs, up: str) -> np.ndarray:
    """Return columns (..., 3, 3) that point left, up and ahead of a person who stands: the heading, and the world's up."""
    vertical = np.eye(3)["xyz".index(up)]
    left = side_vector(places, of)
    left = left - (left @ vertical)[..., None] * vertical
    left = left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-30)
    return np.stack([left, np.broadcast_to(vertical, left.shape), np.cross(left, vertical)], axis=-1)

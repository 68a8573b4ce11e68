"""The packaged recordings: cuts of CMU's motion capture, retargeted to the packaged body.

The clips are BVH files of one skeleton at 30 frames per second, whose zero pose is a T-pose. In some of them a foot is turned
by a constant, so that it stands on its edge throughout: that mean turn is taken out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.io import BodyRecord
from ncs_jax.prepare.setting import load_motion
from ncs_jax.scene.spec import MotionSpec, Scene

POSE_BITS, PATH_BITS = 15, 16  # rounded to 2^-15 rad and 2^-16 m: together below 0.1 mm
CROOKED = 45.0  # degrees by which a foot is turned on average, from which on that is not the dancer's
# Name: file, first frame, and the one after the last: without joints that jump within a frame or limbs inside the trunk.
CUTS = {
    "cmu_walk": ("005_01", 0, 149),
    "cmu_walk_fast": ("007_10", 0, 75),
    "cmu_run": ("002_03", 0, 43),
    "cmu_dance": ("005_07", 60, 180),
    "cmu_spin": ("005_08", 74, 180),
    "cmu_turn": ("005_13", 96, 178),
    "cmu_ball": ("006_10", 0, 145),
    "cmu_stand": ("002_05", 0, 200),
}


def make_recordings(body: BodyRecord, folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """All recordings by file name, from the folder of the BVH files."""
    return {name: make_recording(body, folder / f"{clip}.bvh", cut) for name, (clip, *cut) in CUTS.items()}


def make_recording(body: BodyRecord, file: Path, cut: list[int]) -> dict[str, np.ndarray]:
    """One recording as a motion of the body's joints that begins above the origin."""
    name = f"{file.resolve()}[{cut[0]}:{cut[1]}]"
    motion = load_motion(Scene(motion=MotionSpec(files=(name,), rest="zero")), name, body)
    poses = motion.poses.astype(float)
    for foot in ("LeftFoot", "RightFoot"):
        turns = Rotation.from_rotvec(poses[:, j := body.joint_names.index(foot)])
        mean = turns.mean()
        if np.degrees(mean.magnitude()) > CROOKED:
            poses[:, j] = (turns * mean.inv()).as_rotvec()
    path = motion.translation - motion.translation[0] * (1, 0, 1)
    return {
        "poses": _rounded(poses, POSE_BITS),
        "trans": _rounded(path, PATH_BITS),
        "fps": np.array(motion.fps, np.float32),
        "joint_names": np.array(body.joint_names),
    }


def _rounded(x: np.ndarray, bits: int) -> np.ndarray:
    return (np.round(x * 2.0**bits) / 2.0**bits).astype(np.float32)

"""The joints of SMPL, SMPL-H and SMPL-X, names and tree; the number of joints tells which model it is."""

from __future__ import annotations

import numpy as np

__all__ = ["smpl_names", "smpl_parents"]

TRUNK = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3",
    "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
TREE = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
FINGERS = tuple(f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3))
HANDS = {
    22: (),
    24: ("left_hand", "right_hand"),
    52: (*(f"left_{f}" for f in FINGERS), *(f"right_{f}" for f in FINGERS)),
}
HANDS[55] = ("jaw", "left_eye_smplhf", "right_eye_smplhf", *HANDS[52])  # the names of the model's own files


def smpl_names(joints: int) -> tuple[str, ...]:
    """Return the names of 22 (the body alone), 24 (SMPL), 52 (SMPL-H) or 55 (SMPL-X) joints; none for other numbers."""
    return (*TRUNK, *HANDS[joints]) if joints in HANDS else ()


def smpl_parents(joints: int) -> np.ndarray:
    """Return the parents (joints,) int32 of 22, 24, 52 or 55 joints.

    Each finger's first joint hangs on the wrist, jaw and eyes on the head.
    """
    names = smpl_names(joints)
    parents = list(TREE)
    for j, name in enumerate(names[len(TREE) :], len(TREE)):
        side, _, part = name.partition("_")
        wrist = names.index(f"{side}_wrist") if side != "jaw" and not part.startswith("eye") else names.index("head")
        parents.append(j - 1 if part[-1:] in ("2", "3") else wrist)
    return np.array(parents, np.int32)

"""Which joint is on the other side of which, so that a motion can be shown in a mirror."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from ncs_jax.errors import InputError
from ncs_jax.prepare.joint_names import side_and_rest

__all__ = ["mirror_partners"]

FAR = 0.1  # of a skeleton's size: no joint is farther from the image of its partner, where both sides are the same


def mirror_partners(names: Sequence[str], joints: np.ndarray, parents: Sequence[int] | np.ndarray) -> tuple[np.ndarray, int]:
    """Return each joint's partner on the other side (joints,), itself in the middle, and the axis from left to right.

    Names tell the sides; a joint whose partner they do not tell goes by the rest places of what hangs on it, beside its
    parent's partner. The axis is the one across which the skeleton is nearest to its own image.

    Args:
        names: of the joints, or none. joints: (joints, 3) places at rest, m. parents: before their children, -1 at the root.

    Raises:
        InputError: across no axis is the skeleton the same on both sides.
    """
    told, size = _told(names), float(np.ptp(joints, axis=0).max())
    found = []
    for axis in range(3):
        image = joints.astype(np.float64)
        image[:, axis] = 2 * image[0, axis] - image[:, axis]
        partner = _partners(told, joints, image, parents)
        apart = np.linalg.norm(image - joints[partner], axis=1)
        apart[partner[partner] != np.arange(len(joints))] = np.inf
        found.append((float(apart.max()), axis, partner, int(apart.argmax())))
    far, axis, partner, worst = min(found, key=lambda one: one[:2])
    if far > FAR * size:
        joint = f"joint {worst}" + (f" {names[worst]}" if len(names) else "")
        raise InputError(
            "a skeleton that is the same on both sides expected", field="motion.mirror", value=joint,
            mend="leave motion.mirror out, or name the joints with left and right",
        )  # fmt: skip
    return partner, axis


def _told(names: Sequence[str]) -> dict[int, int]:
    """Return the partners that names tell: of joints with a side, those of equal rest; of equal names each with its like."""
    plain = side_and_rest(names)
    seen: Counter = Counter()
    place = {}
    for i, one in enumerate(plain):
        place[(*one, seen[one])] = i
        seen[one] += 1
    other = {"left": "right", "right": "left"}
    pairs = {i: place.get((other[key[0]], *key[1:])) for key, i in place.items() if key[0] and key[1]}
    return {i: j for i, j in pairs.items() if j is not None}


def _partners(told: dict[int, int], joints, image, parents: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return every joint's partner: told, else the child of its parent's partner whose image it is, itself in the middle."""
    count = len(joints)
    below = np.eye(count)  # of a joint, itself and all that hangs on it
    for j in range(count - 1, 0, -1):
        below[parents[j]] += below[j]
    below /= below.sum(axis=1, keepdims=True)
    here, there = below @ joints, below @ image  # limbs, not joints, are told apart: a hip joint may lie in the hips
    partner = np.full(count, -1)
    partner[list(told)] = list(told.values())
    partner[0] = 0
    for p in range(count):
        q = partner[p] if partner[p] >= 0 else p
        ours, theirs = ([j for j in range(1, count) if parents[j] == at and partner[j] < 0] for at in (p, q))
        cost = np.linalg.norm(there[ours][:, None] - here[theirs][None], axis=-1) + 1e-9 * (np.array(ours)[:, None] != theirs)
        for a, b in zip(*linear_sum_assignment(cost), strict=True):
            partner[ours[a]], partner[theirs[b]] = theirs[b], ours[a]
    alone = np.flatnonzero(partner < 0)
    partner[alone] = alone
    return partner

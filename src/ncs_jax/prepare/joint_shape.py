"""Limbs of a skeleton whose names say nothing, told by its shape at rest: four long chains, two and two alike, and toes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ncs_jax.io.character.hierarchy import lowest_common, path_to_root

__all__ = ["limbs_by_shape"]

LONG = 0.25  # of the skeleton's size: a chain that may be an arm or a leg
ALIKE = 0.1  # of its size: how far a limb may be from the image of its partner
DOWN = 0.7  # cosine between a leg and the trunk's way down, at least
MOST = 0.5  # of a limb's length are its two long bones, at least


@dataclass(frozen=True)
class _Limb:
    """A chain that hangs on the trunk: its joints, and where among them the first of its two long bones begins and ends."""

    joints: list[int]
    first: int

    def at(self, k: int) -> int:
        """Return the joint k places behind the beginning of the first long bone; -1 where there is none."""
        return self.joints[self.first + k] if 0 <= self.first + k < len(self.joints) else -1


def limbs_by_shape(parents: Sequence[int], joints: np.ndarray, sides: Mapping[int, str]) -> dict[str, int]:
    """Return the joint of each role of arms and legs, such as "left thigh"; none where the skeleton has no person's shape.

    The ends of four chains longer than `LONG` are hands and feet; a fifth may be a large head. The pair that meets nearer to
    the root are the legs. The two longest neighbouring bones of a chain are upper arm and forearm, or thigh and shin. Feet
    point ahead, which tells left from right, unless the names tell the sides. Nothing is told where a skeleton is not the same
    on both sides, where a limb has more than two long bones, or where legs do not point away from the trunk, as where all
    bones lie along one axis at rest.

    Args:
        parents: before their children, -1 at the root. joints: (J, 3) places at rest, in any unit. sides: "left" or "right"
            of the joints whose names say so.
    """
    x, size = joints.astype(np.float64), float(np.ptp(joints, axis=0).max())
    tips = _long_tips(parents, x, LONG * size)
    if len(tips) not in (4, 5):
        return {}
    legs, arms = _pairs(parents, x, tips)
    hips, chest = lowest_common(parents, [*legs, *arms]), lowest_common(parents, arms)
    if not np.linalg.norm(x[chest] - x[hips]) > 0:
        return {}
    meets = lowest_common(parents, legs), chest
    chains = [[_limb(parents, x, tip, meet) for tip in pair] for pair, meet in zip((legs, arms), meets, strict=True)]
    limbs = [[limb for limb in pair if limb is not None] for pair in chains]
    if limbs != chains:
        return {}
    up = (x[chest] - x[hips]) / np.linalg.norm(x[chest] - x[hips])
    bones = [x[limb.at(2)] - x[limb.at(0)] for limb in limbs[0]]
    if any(bone @ -up < DOWN * np.linalg.norm(bone) for bone in bones):
        return {}
    left = _left(x, limbs[0], up, size, sides)
    if left is None or not _alike(x, limbs, left, size):
        return {}
    names = (("hip joint", "thigh", "shin", "foot", "toe"), ("clavicle", "arm", "forearm", "hand"))
    found: dict[str, int] = {}
    for pair, roles in zip(limbs, names, strict=True):
        ordered = sorted(pair, key=lambda limb: -float(x[limb.at(1)] @ left))
        for side, limb in zip(("left", "right"), ordered, strict=True):
            found |= {f"{side} {role}": j for k, role in enumerate(roles, -1) if (j := limb.at(k)) >= 0}
    return found


def _long_tips(parents, x: np.ndarray, least: float) -> list[int]:
    """Return the ends of the chains that are longer than this, each from where a longer one goes on."""
    length, end = np.zeros(len(x)), np.arange(len(x))
    tips = []
    for j in range(len(x) - 1, -1, -1):  # children come after their parents
        below = [c for c in range(j + 1, len(x)) if parents[c] == j]
        reach = {c: float(length[c] + np.linalg.norm(x[c] - x[j])) for c in below}
        if not reach:
            continue
        best = max(reach, key=lambda c: reach[c])
        length[j], end[j] = reach[best], end[best]
        tips += [int(end[c]) for c in below if c != best and reach[c] > least]
    return [*tips, int(end[0])]


def _pairs(parents, x: np.ndarray, tips: list[int]) -> tuple[list[int], list[int]]:
    """Return the ends of the legs and of the arms: two and two whose chains from the root are of one length."""

    def length(tip: int) -> float:
        path = path_to_root(parents, tip)
        return float(np.linalg.norm(np.diff(x[path], axis=0), axis=1).sum())

    splits = [([a, b], [c, d]) for four in combinations(tips, 4) for a, b, c, d in _halved(four)]
    one, two = min(splits, key=lambda pairs: sum(abs(length(a) - length(b)) for a, b in pairs))
    depth = [len(path_to_root(parents, lowest_common(parents, pair))) for pair in (one, two)]
    reach = [length(pair[0]) for pair in (one, two)]
    return (one, two) if depth[0] < depth[1] or (depth[0] == depth[1] and reach[0] > reach[1]) else (two, one)


def _halved(four: tuple[int, ...]) -> list[tuple[int, int, int, int]]:
    """Return the ways to take four as two and two."""
    a, b, c, d = four
    return [(a, b, c, d), (a, c, b, d), (a, d, b, c)]


def _limb(parents, x: np.ndarray, tip: int, meet: int) -> _Limb | None:
    """Return the chain from below a joint to a tip, with its two longest neighbouring bones; None where it has not three."""
    path = path_to_root(parents, tip)
    chain = path[: path.index(meet)][::-1]
    bones = np.linalg.norm(np.diff(x[chain], axis=0), axis=1)
    if len(bones) < 2:
        return None
    first = int((bones[:-1] + bones[1:]).argmax())
    return _Limb(chain, first) if bones[first : first + 2].sum() > MOST * bones.sum() else None


def _left(x: np.ndarray, legs: list[_Limb], up: np.ndarray, size: float, sides: Mapping[int, str]) -> np.ndarray | None:
    """Return the direction to the left, by the names of the feet or by where the toes are; None where neither tells."""
    knees = [limb.at(1) for limb in legs]
    across = x[knees[0]] - x[knees[1]]
    across -= (across @ up) * up
    if not np.linalg.norm(across) > 0:
        return None
    across /= np.linalg.norm(across)
    named = [sides.get(knee, "") for knee in knees]
    if set(named) == {"left", "right"}:
        return across if named[0] == "left" else -across
    toes = [(limb.at(2), limb.at(3)) for limb in legs]
    ahead = sum((x[toe] - x[foot] for foot, toe in toes if toe >= 0), np.zeros(3))
    ahead = ahead - (ahead @ up) * up - (ahead @ across) * across
    if np.linalg.norm(ahead) < 0.02 * size:
        return None
    return across if np.cross(up, ahead) @ across > 0 else -across


def _alike(x: np.ndarray, limbs: list[list[_Limb]], left: np.ndarray, size: float) -> bool:
    """Tell whether arms and legs are the images of each other across the plane between left and right."""
    pairs = [(a.at(k), b.at(k)) for a, b in limbs for k in range(3)]
    middle = np.mean([(x[a] + x[b]) @ left / 2 for a, b in pairs])
    images = [x[a] + 2 * (middle - x[a] @ left) * left - x[b] for a, b in pairs]
    return float(np.linalg.norm(images, axis=1).max()) < ALIKE * size and all((x[a] - x[b]) @ left != 0 for a, b in pairs)

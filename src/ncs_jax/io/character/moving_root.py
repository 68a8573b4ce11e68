"""Joints that leave their places on their parents: one carries the path and is the root; bones that slide keep their mean."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io.character.bvh import Bvh
from ncs_jax.io.character.hierarchy import nearest_parents, path_to_root

__all__ = ["LIMB", "SLIDE", "SPARE", "bvh_from_moving_root", "check_slides", "moving_root"]

SLIDE = 0.05  # of a bone by which its end may leave its mean place; exporters that fit a motion to other bones leave some
LIMB = re.compile(  # the end of a limb, in small letters; a ball is one of a foot only where it has a side
    r"((hand|wrist|palm|head|neck|foot|ankle|toe|toes|toebase)[^a-z]*(l|r|left|right)?"
    r"|(left|right|(?<![a-z])[lr][^a-z]*)ball|ball[^a-z]*(l|r|left|right))\d*$"
)
SPARE = 3  # joints that turn and may be left out, above the joint that carries the path or beside it; two legs are more


def moving_root(parents: np.ndarray, moves: np.ndarray, counts: np.ndarray, spare: int) -> list[int]:
    """Return the joint that carries the path and all joints that hang on it, in the order they have.

    It is the lowest joint that moves against its parent, carries more than half of the joints that count and leaves out no more
    than `spare` of them; else the root. What is above it may be still, or carry a part of the path. What hangs beside it, as
    targets of inverse kinematics, is left out.

    Args:
        parents: (J,). moves, counts: (J,) whether a joint leaves its place on its parent, and whether it counts.
    """
    paths = [set(path_to_root(parents, j)) for j in range(len(parents))]
    best = 0
    for j in np.flatnonzero(moves).tolist():
        inside = sum(counts[k] for k, path in enumerate(paths) if j in path)
        if inside > counts.sum() / 2 and counts.sum() - inside <= spare and best in paths[j]:
            best = j
    return [j for j, path in enumerate(paths) if best in path]


def check_slides(file: Path, names: Sequence[str], off: np.ndarray, bones: np.ndarray, wrong: np.ndarray) -> tuple[str, ...]:
    """Return a note on bones that slide; raise an InputError where one changes too much.

    Args:
        file: for the error. names: of J joints. off: (J,) how far each joint leaves its mean place on its parent. bones: (J,)
            how long its bone is, in the same unit. wrong: (J,) whether that is too much.
    """
    if wrong.any():
        j = int(np.argmax(np.where(wrong, off, -1)))
        raise InputError(
            "bones of fixed length expected", file=file, field=f"joint {names[j]}",
            value=f"{off[j]:.3g} from its place, on a bone of {bones[j]:.3g}",
            mend="export rotations, and positions for the root only",
        )  # fmt: skip
    share = off / np.where(bones > 0, bones, np.inf)
    if share.max(initial=0) < 0.01:
        return ()
    worst = int(share.argmax())
    count = int((share >= 0.01).sum())
    return (f"{count} bones slide, {names[worst]} by up to {100 * share[worst]:.0f} % of its length; they keep their mean",)


def bvh_from_moving_root(bvh: Bvh) -> Bvh:
    """Return the motion from the joint on that carries the path, with bones of constant length: see `moving_root`.

    A joint's positions are places on its parent that stand for its OFFSET. Positions that do not change are the OFFSET, unless
    that is zero; positions that along the OFFSET are nearer to none of it than to all are added to it. A joint that slides and
    carries nothing, as a prop on a hand, is left out, unless it is called the end of a limb.
    """
    if not bvh.moved:
        return bvh
    offsets, places = bvh.offsets.copy(), {0: bvh.positions}
    off = np.zeros(len(offsets))
    for j, given in bvh.moved.items():
        use = given[np.isfinite(given).all(axis=1)]
        mean = use.mean(axis=0) if len(use) else offsets[j]
        off[j] = np.linalg.norm(use - mean, axis=1).max(initial=0)
        size = offsets[j] @ offsets[j]  # a path goes far along a short OFFSET, which then tells nothing
        added = bool(size) and -size < mean @ offsets[j] < 0.5 * size
        places[j] = given + offsets[j] if added else given
        if not offsets[j].any() or (off[j] > 1e-3 * np.linalg.norm(offsets[j]) and not added):
            offsets[j] = mean
    bones = np.linalg.norm(offsets, axis=1)
    moves = off > np.maximum(SLIDE * bones, 0.01 * np.linalg.norm(bvh.offsets, axis=1).max())
    finite = bvh.poses[np.isfinite(bvh.poses).all(axis=(1, 2))]
    turns = (np.abs(finite - finite[:1]) > 0.01).any(axis=(0, 2))
    kept = moving_root(bvh.parents, moves, turns & ~moves, SPARE)
    props = [j for j in kept[1:] if moves[j] and j not in bvh.parents and not LIMB.search(bvh.joint_names[j].lower())]
    kept = [j for j in kept if j not in props]
    root, others = kept[0], kept[1:]
    notes = check_slides(bvh.file, [bvh.joint_names[j] for j in others], off[others], bones[others], moves[others])
    if props:
        notes = (f"left out, as they slide and carry nothing: {', '.join(bvh.joint_names[j] for j in props[:8])}", *notes)
    chain = path_to_root(bvh.parents, root)[::-1]
    turn, place, rest = Rotation.identity(len(bvh.poses)), np.zeros((len(bvh.poses), 3)), np.zeros(3)
    for j in chain:
        place = place + turn.apply(places.get(j, np.tile(offsets[j], (len(place), 1))))
        turn, rest = turn * Rotation.from_rotvec(bvh.poses[:, j]), rest + bvh.offsets[j]
    names = tuple(bvh.joint_names[j] for j in kept)
    poses = bvh.poses[:, kept]
    if root:
        offsets[root] = rest
        poses[:, 0] = turn.as_rotvec()
        gone = [n for j, n in enumerate(bvh.joint_names) if n not in names and j not in props]
        notes = (f"{names[0]} carries the path, so it is the root; left out: {', '.join(gone[:8])}", *notes)
    parents = nearest_parents(bvh.parents, kept)
    return replace(
        bvh, joint_names=names, parents=parents, offsets=offsets[kept], tips=bvh.tips[kept], poses=poses, positions=place,
        moved={}, notes=(*bvh.notes, *notes),
    )  # fmt: skip

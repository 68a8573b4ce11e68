"""The animation of a rig: which one of a file, and the local rotations of its joints since the pose of their skin."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar
from unicodedata import normalize

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io.character.hierarchy import nearest_parents
from ncs_jax.io.character.moving_root import LIMB, SLIDE, SPARE, check_slides, moving_root
from ncs_jax.io.character.rig import Rig, rest_rotations
from ncs_jax.io.records import MotionRecord
from ncs_jax.io.tables.files import LARGEST

__all__ = ["clip_named", "first_that_moves", "motion_of", "split_clip"]

ASIDE = 0.05  # of a skeleton's size: roots that rest within that of its origin are taken to rest where they stand
GIVE = 0.01  # m by which a bone may change, and share by which a joint may scale; more is an error, less is ignored
HOUR = 3600.0  # s; the longest animation
BLOCK = 256  # frames evaluated at once

Found = TypeVar("Found")


def split_clip(path: str | Path) -> tuple[str, str]:
    """Return the file and the animation, or the ROOT, that `FILE.glb#NAME` names; the name is empty where none is given."""
    found = re.match(r"(.+?\.(?:bvh|glb|vrma|vrm|gltf|fbx))(?:#(.*))?$", str(path), re.IGNORECASE | re.DOTALL)
    return (found[1], found[2] or "") if found else (str(path), "")


def clip_named(file: Path, names: Sequence[str], wanted: str) -> int:
    """Return the number of the animation that has a name; the first where none is given.

    Letters with accents are the same whether they are written as one character or as two.
    """
    names, wanted = [normalize("NFC", n) for n in names], normalize("NFC", wanted)
    if not names:
        raise InputError("an animation expected", file=file, field="animations", value="none", mend="export it with animation")
    if wanted and wanted not in names:
        raise InputError(
            "no such animation", file=file, field="animations", value=wanted,
            mend=f"write FILE#NAME with one of {', '.join(names)[:400]}",
        )  # fmt: skip
    return names.index(wanted) if wanted else 0


def first_that_moves(
    names: Sequence[str],
    candidates: Sequence[int],
    read: Callable[[int], Found],
    moves: Callable[[Found], bool],
    full: Sequence[int],
) -> tuple[int, Found, tuple[str, ...]]:
    """Return the number of the first animation among candidates that moves, what was read of it, and a note on the others.

    Where none moves, the first that is not empty. `full` are those that could be chosen by name; `read` gives something
    empty for the others.
    """
    found = {}
    for number in candidates:
        found[number] = read(number)
        if moves(found[number]):
            break
    else:
        number = next((n for n in candidates if found[n]), candidates[0] if candidates else 0)
    others = ", ".join(names[n] for n in full if n != number)
    note = (f"its animation {names[number]} is read; FILE#NAME reads another: {others[:400]}",) if others else ()
    return number, found[number] if found else read(number), note


def motion_of(rig: Rig, times: tuple[float, float, float], worlds: Callable[[np.ndarray], np.ndarray]) -> MotionRecord:
    """Return the motion of joints that move as a file says: local rotations since rest, in the joints' own rest frames.

    Since rest a joint has turned in the world by G_j = A_j B_j^-1, its matrix now times the inverse of its bind matrix. In its
    own frame, seen from its parent, that is R_j = Q_j^T G_parent^T G_j Q_j, where Q_j is its rest rotation. A root above the
    hips may stand still or carry a part of the path, and bones may slide a little about their mean, see `moving_root`.

    Args:
        rig: the joints. times: begin and end, s, and frames per second. worlds: gives, for times (n,) in s, the matrices
            (n, J, 4, 4) joint to world.

    Raises:
        InputError: the motion lasts an hour or more, a joint scales by more than 1 %, or a joint leaves its mean place on its
            parent by more than 1 cm and a twentieth of the bone. Joints that move no vertex may do both. So may props: they
            keep their place and size, see `carries_limb`.
    """
    begin, end, fps = times
    count = int(np.floor((end - begin) * fps + 1e-3)) + 1 if end - begin < HOUR else 0
    if count < 1 or count * len(rig.names) * 24 > LARGEST:
        raise InputError(
            "an animation of less than an hour expected", file=rig.file, field="animations", value=f"{end - begin:.6g} s",
            mend="cut it into several",
        )  # fmt: skip
    back, turned, placed = np.linalg.pinv(rig.binds), [], []
    props = rig.used & ~carries_limb(rig.names, rig.parents)
    resized = np.zeros_like(props)
    for first in range(0, count, BLOCK):
        at = worlds(begin + np.arange(first, min(first + BLOCK, count)) / fps)
        turns, scaled = _rotations(rig, props, (at @ back)[..., :3, :3], first)
        turned.append(turns)
        placed.append(at[..., :3, 3])
        resized |= scaled
    world, place = np.concatenate(turned), np.concatenate(placed)
    joints, kept, notes = _settled(rig, props, world, place)
    shift, said = _aside(rig, kept, world, place)
    joints, notes = joints - shift, (*notes, *said)
    if held := [rig.names[j] for j in kept if resized[j]]:
        notes = (*notes, f"props that change their size keep that at rest, as joints only turn: {', '.join(held[:8])}")
    rest, parents = rest_rotations(rig)[kept], nearest_parents(rig.parents, kept)
    local = world[:, kept]
    local[:, 1:] = np.swapaxes(local[:, parents[1:]], -1, -2) @ local[:, 1:]
    own = np.swapaxes(rest, -1, -2) @ local @ rest
    poses = Rotation.from_matrix(own.reshape(-1, 3, 3)).as_rotvec().reshape(own.shape[:3])
    names = tuple(rig.names[j] for j in kept)
    return MotionRecord(poses, place[:, kept[0]] - joints[0], fps, names, joints, parents, rest_rotations=rest, notes=notes)


def _settled(
    rig: Rig, props: np.ndarray, world: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, list[int], tuple[str, ...]]:
    """Return rest joints whose bones are as long as they are on average, the numbers of the joints that are kept, and notes.

    A bone keeps its place in the bind pose where it is within `GIVE` of it, and where it is a prop that slides.
    """
    joints, parents = rig.binds[:, :3, 3].copy(), rig.parents
    seen = np.einsum("tjba,tjb->tja", world[:, parents[1:]], place[:, 1:] - place[:, parents[1:]])
    if not np.isfinite(place).all():
        t, j = (int(i) for i in np.argwhere(~np.isfinite(place).all(axis=-1))[0])
        where = f"animation, frame {t}, joint {rig.names[j]}"
        raise InputError("finite numbers expected", file=rig.file, field=where, mend="export it again")
    bones, bind = seen.mean(axis=0), joints[1:] - joints[parents[1:]]
    off = np.concatenate([[0.0], np.linalg.norm(seen - bones, axis=-1).max(axis=0)])
    length = np.concatenate([[0.0], np.linalg.norm(bones, axis=-1)])
    wrong = rig.used & (off > np.maximum(GIVE, SLIDE * length))
    held, wrong = wrong & props, wrong & ~props
    own = np.asarray(rig.weights.any(axis=0))
    if not len(rig.weights):
        own = (np.abs(world - world[:1]) > 0.01).any(axis=(0, 2, 3)) & ~wrong
    kept = moving_root(parents, wrong, own & ~props, 0 if len(rig.weights) else SPARE)
    others = kept[1:]
    slides = np.where(rig.used & (off > GIVE) & ~held, off, 0)
    notes = check_slides(rig.file, [rig.names[j] for j in others], slides[others], length[others], wrong[others])
    near = np.linalg.norm(bones - bind, axis=-1) <= GIVE
    changed = [j for j in others if rig.used[j] and not near[j - 1] and not held[j]]
    for j in others:
        joints[j] = joints[parents[j]] + (bones[j - 1] if j in changed else bind[j - 1])
    if changed:
        notes = (*notes, f"{len(changed)} bones are longer or shorter than in the bind pose, as {rig.names[changed[0]]}")
    if still := [j for j in others if held[j]]:
        named = ", ".join(rig.names[j] for j in still[:8])
        what = f"props that slide keep their place at rest, as joints only turn: {named}, by up to {off[still].max():.2f} m"
        notes = (*notes, what)
    if kept[0]:
        gone = ", ".join(n for j, n in enumerate(rig.names) if j not in kept)
        notes = (f"{rig.names[kept[0]]} carries the path, so it is the root; left out: {gone[:200]}", *notes)
    return joints[kept], kept, notes


def _aside(rig: Rig, kept: list[int], world: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return how far aside a skeleton without a skin stands in the frame in which it was written, (3,) m, and notes.

    Such a file has no rest pose but the one in which its nodes stand. Where that is a frame of the motion, the root's way aside
    is a part of the path, as it is for a character with its skin: at rest the root is above what carries the skeleton.
    """
    none, own = np.zeros(3), rig.binds[kept, :3, 3]
    aside = none if rig.carrier is None else (own[0] - rig.carrier) * (1, 0, 1)
    far = float(np.linalg.norm(aside))
    if far <= ASIDE * np.ptp(own, axis=0).max():
        return none, ()
    still = np.abs(world[:, kept] - np.eye(3)).max(axis=(1, 2, 3)) < 0.01
    still &= np.linalg.norm(place[:, kept[0]] - own[0], axis=-1) < GIVE
    where = f"{rig.names[kept[0]]} stands {far:.2f} m to the side of the skeleton's origin"
    if not still.any() or np.ptp(own[:, 2]) > np.ptp(own[:, 1]):
        return none, (f"without a skin it rests as its nodes stand, where {where}; the path is told since there",)
    return aside, (f"without a skin it rests as in its frame {int(still.argmax())}, where {where}; the path keeps that",)


def carries_limb(names: Sequence[str], parents: np.ndarray) -> np.ndarray:
    """Tell of each joint (J,) whether the end of a limb, as a hand or the head, is at it or below; the others are props.

    Where no name tells a limb, all joints may be limbs.
    """
    ends = [bool(LIMB.search(n.lower())) for n in names]
    out = np.array(ends)
    for j in range(len(names) - 1, 0, -1):  # children come after their parents
        out[parents[j]] |= out[j]
    return out if any(ends) else np.ones(len(names), bool)


def _rotations(rig: Rig, props: np.ndarray, linear: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations in matrices (T, J, 3, 3), and which props (J,) change their size.

    The matrix of a used joint must be one but for rounding. For other joints what is none becomes the identity, and for a prop,
    which may have any size or none, the turn of its parent.
    """
    with np.errstate(all="ignore"):
        scale = np.cbrt(np.linalg.det(linear))
        turns = linear / scale[..., None, None]
        square = np.swapaxes(turns, -1, -2) @ turns
        sheared = ~(np.abs(square - np.eye(3)).max(axis=(-1, -2)) < 2 * GIVE)
        bad = sheared | ~(np.abs(scale - 1) < GIVE)
        for _ in range(3):  # to the nearest rotation (Higham 1986, Newton-Schulz)
            turns = turns @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(turns, -1, -2) @ turns)
    if (wrong := bad & rig.used & ~props).any():
        t, j = (int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            "rotations without scale expected", file=rig.file, field=f"animation, frame {t + first}, joint {rig.names[j]}",
            value=f"scaled by {float(scale[t, j]):.4g}, or sheared", mend="apply scale, and animate rotations only",
        )  # fmt: skip
    turns = np.where((bad & ~props)[..., None, None], np.eye(3), turns)
    for j in np.flatnonzero(props & sheared.any(axis=0)).tolist():  # children come after their parents
        turns[:, j] = np.where(sheared[:, j, None, None], turns[:, rig.parents[j]], turns[:, j])
    return turns, bad.any(axis=0) & props

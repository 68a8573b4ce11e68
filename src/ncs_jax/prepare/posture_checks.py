"""What a person's posture is not in most frames of a motion: the sign of a wrong rest pose, axis, pair of joints or scale.

Each limit lies between what working motions do (the packaged ones, 47 recordings of CMU, AMASS: the numbers in brackets) and
what files do that were understood wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.prepare.joint_names import Limbs, anatomy
from ncs_jax.prepare.retarget import body_names, called, sole_heights
from ncs_jax.prepare.skeleton import body_axes, forward, sampled, top

__all__ = ["posture_faults"]

MOST = 60.0  # percent of the frames in which a joint is beyond its limit
LYING = 60.0, 0.95  # degrees by which hips to head lean in someone who lies, and share of the frames (0.16)
AIR = 0.12, 1.0, 0.7  # m above the lowest sole and s, higher and longer than jumps; share of the frames (0.48, on a ladder)
INSIDE = 0.25  # share of the frames in which an elbow or a wrist is in the trunk (0.03)
TRUNK = 0.6, 0.35  # half the width and half the depth of the trunk, of half the distance between the shoulders
# Degrees by which a joint has turned since rest, as seen from another, that nobody holds: chest (54), head (34), collar (19).
SPINE, COLLAR = 75.0, 27.0
SIDES = "left", "right"
# Degrees by which both feet are tipped in frames in which they are low and slow (7), and one of them (a dancer's, 56).
TIPPED, ALONE = 20.0, 59.0
KNEE = 30.0, 10.0  # degrees by which a shin points ahead of its thigh (2), percent of the frames: only bent knees tell


@dataclass(frozen=True, eq=False)
class _Figure:
    """A body in motion: limbs, world rotations (T, J, 3, 3), places (T, J, 3), soles (T,), m, axes at rest, up (3,), frames/s.

    `shoulders` is the distance between the upper arms' joints at rest, m; 0 where there are none.
    """

    of: Limbs
    turns: np.ndarray
    places: np.ndarray
    soles: np.ndarray
    axes: np.ndarray
    up: np.ndarray
    fps: float
    shoulders: float


def posture_faults(record: MotionRecord, body: BodyRecord, world: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield what is wrong, how much, what that does, and the field that mends it, for a motion of a body that is a person.

    Args:
        record: a motion of the body's joints. body: with names of joints, or SMPL's joints; others are not judged. world: the
            axis that points up.
    """
    names = body_names(body)
    if not names:
        return
    of, few = anatomy(called(names, body.bones), body.parents.tolist(), body.joints), sampled(record)
    if "head" not in of.roles or not of.spine:
        return
    told = replace(few, joints=body.joints, parents=body.parents, rest_rotations=body.rest_rotations, joint_names=names)
    turns, places = forward(told)
    axes, height = body_axes(body.joints, of), "xyz".index(world)
    soles = sole_heights(body, of, turns, places, height, axes[:, 1])
    every = len(record.poses) / len(few.poses)
    arms = [body.joints[j] for side in SIDES if (j := of.roles.get(f"{side} arm")) is not None]
    shoulders = float(np.linalg.norm(arms[0] - arms[1])) if len(arms) == 2 else 0.0
    figure = _Figure(of, turns, places, soles, axes, np.eye(3)[height], record.fps / every, shoulders)
    yield from _lies(figure)
    yield from _floats(figure)
    yield from _arms_inside(figure)
    yield from _bends(figure)
    yield from _tipped(figure)


def _lies(f: _Figure) -> Iterator[tuple[str, str, str, str]]:
    trunk = f.places[:, top(f.of)] - f.places[:, f.of.roles["hips"]]
    lean = np.degrees(np.arctan2(np.linalg.norm(np.cross(trunk, f.up), axis=1), trunk @ f.up))
    share = float((lean > LYING[0]).mean())
    if share >= LYING[1]:
        value = f"hips to head lean by {np.median(lean):.0f} degrees, in {100 * share:.0f} % of the frames"
        yield (
            "the character lies down",
            value,
            "the garment falls the wrong way",
            'motion.up = "z", "y" or "x", if it should stand',
        )


def _floats(f: _Figure) -> Iterator[tuple[str, str, str, str]]:
    height = f.soles - np.percentile(f.soles, 5)
    air = np.concatenate([[False], height > AIR[0], [False]])
    begins, ends = np.flatnonzero(air[1:] & ~air[:-1]), np.flatnonzero(air[:-1] & ~air[1:])
    share = float((ends - begins)[ends - begins > AIR[1] * f.fps].sum() / len(height))
    if share > AIR[2]:
        value = f"the lower sole is {np.median(height):.2f} m above its lowest place, in {100 * share:.0f} % of the frames"
        yield "feet that float or sink", value, "the path does not fit the legs", "motion.up, motion.scale, or motion.rest"


def _arms_inside(f: _Figure) -> Iterator[tuple[str, str, str, str]]:
    hips, neck = f.places[:, f.of.roles["hips"]], f.places[:, f.of.neck[0] if f.of.neck else f.of.roles["head"]]
    length = np.linalg.norm(neck - hips, axis=1, keepdims=True)
    arms = [f.of.roles.get(f"{side} arm") for side in SIDES]
    if None in arms or not (length > 0).all() or not f.shoulders > 0:
        return
    along, left = (neck - hips) / length, f.places[:, arms[0]] - f.places[:, arms[1]]
    left = left - (left * along).sum(1, keepdims=True) * along
    left = left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    width, depth = (share * f.shoulders / 2 for share in TRUNK)
    ahead = np.cross(left, along)
    inside = np.zeros(len(hips), bool)
    for joint in (j for side in SIDES for part in ("forearm", "hand") if (j := f.of.roles.get(f"{side} {part}"))):
        away = f.places[:, joint] - hips
        up, out, before = (np.einsum("ta,ta->t", away, d) for d in (along, left, ahead))
        inside |= ((out / width) ** 2 + (before / depth) ** 2 < 1) & (up > 0.1 * length[:, 0]) & (up < length[:, 0])
    share = float(inside.mean())
    if share > INSIDE:
        value = f"an elbow or a wrist, in {100 * share:.0f} % of the frames"
        yield "arms inside the trunk", value, "cloth is caught between them", "motion.rest, or motion.joints"


def _bends(f: _Figure) -> Iterator[tuple[str, str, str, str]]:
    """Yield a fault for each joint that is bent, in most frames, as nobody's is."""
    chest, roles = f.of.spine[-1], f.of.roles
    pairs = [("the spine bends", roles["hips"], chest), ("the neck bends", chest, roles["head"])]
    pairs += [(f"the {side} collar bone turns", chest, roles[r]) for side in SIDES if (r := f"{side} clavicle") in roles]
    for what, above, joint in pairs:
        turn = np.swapaxes(f.turns[:, above], 1, 2) @ f.turns[:, joint]
        angle = float(np.percentile(np.degrees(Rotation.from_matrix(turn).magnitude()), 100 - MOST))
        if angle > (COLLAR if "collar" in what else SPINE):
            value = f"by more than {angle:.0f} degrees since rest, in {MOST:.0f} % of the frames"
            yield f"{what} too far", value, "the zero pose was not understood", "motion.rest, or motion.joints"
    for side in SIDES:
        leg = [roles.get(f"{side} {part}") for part in ("thigh", "shin", "foot")]
        if None in leg:
            continue
        shin = np.einsum("tba,tb->ta", f.turns[:, leg[0]], f.places[:, leg[2]] - f.places[:, leg[1]])
        ahead = np.degrees(np.arctan2(shin @ f.axes[:, 2], np.linalg.norm(np.cross(shin, f.axes[:, 2]), axis=1)))
        if (angle := float(np.percentile(ahead, 100 - KNEE[1]))) > KNEE[0]:
            value = f"by more than {angle:.0f} degrees, in {KNEE[1]:.0f} % of the frames"
            why = "the zero pose was not understood, or the rotations are inverse, as matrices of another convention"
            yield f"the {side} knee bends forward", value, why, "motion.rest, or motion.joints"


def _tipped(f: _Figure) -> Iterator[tuple[str, str, str, str]]:
    """Yield a fault where feet, when they should be flat on the ground, are not as at rest."""
    feet, tilts = [f.of.roles.get(f"{side} foot") for side in SIDES], list[float]()
    if None in feet or len(f.places) < 2:
        return
    for foot in feet:
        height, speed = f.places[:, foot] @ f.up, np.linalg.norm(np.gradient(f.places[:, foot], axis=0), axis=1)
        low = height <= np.percentile(height, 33)
        upward = f.turns[low & (speed <= np.percentile(speed[low], 50)), foot] @ f.axes[:, 1]
        tilt = np.degrees(np.arctan2(np.linalg.norm(np.cross(upward, f.up), axis=1), upward @ f.up))
        tilts.append(float(np.percentile(tilt, 100 - MOST)))
    if min(tilts) > TIPPED or max(tilts) > ALONE:
        both = min(tilts) > TIPPED
        value = f"by more than {min(tilts) if both else max(tilts):.0f} degrees, where low and slow"
        which = "both feet are" if both else f"the {SIDES[int(np.argmax(tilts))]} foot is"
        yield f"{which} tipped", value, "the zero pose was not understood", "motion.rest, or motion.joints"

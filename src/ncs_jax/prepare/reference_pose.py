"""The pose of a skeleton in which it is a person who stands: its zero pose, one of its frames, or one built from all frames.

A motion says how its joints turn since the pose of zero rotation. Retargeting needs to know what that pose is in a person. In
many files it is a T-pose, an A-pose or arms that hang down, and nothing is to be done. Others lay every bone along one axis of
its joint, or turn the joints' axes as they like: zero rotation then is no person. Such a motion is told anew since a
**reference pose**. With C_j the world rotation of joint j in that pose, p its parent, and L_j its rotation in the file as seen
from p,

    L_j -> C_p L_j C_j^T,

and the rest joints are where C puts them: a person who looks along +Z, the left at +X, up at +Y.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io import MotionRecord
from ncs_jax.io.mesh.axes import TURNS
from ncs_jax.prepare.built_pose import FEWEST, UPRIGHT, build_pose
from ncs_jax.prepare.joint_names import Limbs
from ncs_jax.prepare.skeleton import (
    LIMBS,
    angle,
    body_axes,
    forward,
    joint_turns,
    person_axes,
    rest_of,
    sampled,
    side_vector,
    standing_axis,
    top,
    trunk_of,
)

__all__ = ["ZERO", "Reference", "facing", "find_reference", "from_frame", "is_even", "is_person", "leans", "odd_parts", "since"]

SURE = 1.0  # degrees; a part of a built pose that is surer than that is not told
EVEN = 15.0  # degrees by which limbs of a skeleton at rest may differ from their images in the mirror
LEAN = 12.0  # degrees by which hips to head lean in a zero pose that is bent (3)
# Degrees by which neck, head and collars pitch or rise at rest, at least and at most, in skeletons that are not bent there; and
# by which these lie outside what 18 of 20 upright frames do, where the zero pose is bent alone.
BUILT = {"neck": (3.0, 45.0), "head": (-25.0, 25.0), "collars": (-18.0, 18.0)}
ODD = {"neck": 20.0, "head": 20.0, "collars": 15.0}
ASIDE, ALONG = 2.0, 5.0  # degrees by which a zero pose may look aside of an axis, and lean as a whole, before it is turned
ZERO = " of the zero pose"  # ends the name of such a part
BACKWARD = 0.8  # share of the frames in which feet point back where sides are exchanged (0)
UP, LEFT, AHEAD = np.eye(3)[[1, 0, 2]]


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference pose.

    turns: the world rotation C (J, 3, 3) of each joint. note: where the pose is from. root: the root's place (3,) in it; None:
    that of the zero pose. uncertain: parts of a person that may be wrong, and by how many degrees in nine of ten recordings.
    """

    turns: np.ndarray
    note: str
    root: np.ndarray | None = None
    uncertain: dict[str, float] = field(default_factory=dict)


def find_reference(motion: MotionRecord, of: Limbs, up: str, first: MotionRecord, last: MotionRecord) -> Reference:
    """Return a pose in which a motion's skeleton is a person, where the zero pose is none.

    It is a T-pose or an A-pose among the first frames, or one of hanging arms where left and right are alike to 2 degrees; else
    a T-pose among the last; else it is built, see `built_pose`.

    Args:
        motion: with a skeleton. of: its limbs. up: axis of the motion's world that points up. first, last: the
            file's first and last frames.

    Raises:
        InputError: no frame is such a pose, nor are there upright ones to build it from; or left and right are exchanged.
    """
    _check_sides(motion, of, up)
    found = _among(first, of, up) or _at_end(last, of, up) or _built(motion, of, up)
    if found is None:
        raise InputError(
            "a skeleton whose zero pose is a person, or upright frames to find one from, expected", field="motion.rest",
            value="auto", mend='write the number of a frame in T-pose or A-pose, or "zero" to take the zero pose as it is',
        )  # fmt: skip
    return found


def since(motion: MotionRecord, reference: Reference) -> MotionRecord:
    """Return the same motion, its rotations told since a reference pose, its skeleton at rest in that pose."""
    joints, parents = rest_of(motion)
    local, places, turns = joint_turns(motion), joints.astype(np.float64), reference.turns
    places[0] = joints[0] if reference.root is None else reference.root
    tips = None if motion.tips is None else motion.tips.astype(np.float64)
    for j, parent in enumerate(parents):
        if parent >= 0:
            local[:, j] = turns[parent] @ local[:, j]
            places[j] = places[parent] + turns[parent] @ (joints[j] - joints[parent])
        local[:, j] = local[:, j] @ turns[j].T
        if tips is not None and motion.tips is not None:
            tips[j] = places[j] + turns[j] @ (motion.tips[j] - joints[j])
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(motion.poses.shape)
    moved = motion.translation + joints[0] - places[0]
    return replace(motion, poses=poses, translation=moved, joints=places, tips=tips, rest_rotations=None)


def is_person(places: np.ndarray, of: Limbs) -> bool:
    """Tell whether joints (J, 3) are where some person's may be who stands, walks, climbs or crouches: by directions alone.

    No bone of the trunk leans by more than 65 degrees from hips to head. From hip to ankle it goes down, to 75 degrees. Left is
    left at hips and shoulders, to 45, and to 50 between these. Arms do not go straight up, nor do toes point up or back. What
    is not there is not asked.
    """
    up, left = places[top(of)] - places[of.roles["hips"]], side_vector(places, of)
    if not (np.linalg.norm(up) > 0 and np.linalg.norm(left) > 0):
        return True
    bones = np.diff(places[trunk_of(of)], axis=0)
    if any(angle(b, up) > 65 for b in bones if np.linalg.norm(b) > 0.05 * np.linalg.norm(up)) or abs(angle(left, up) - 90) > 45:
        return False
    for part in ("thigh", "arm"):
        across = _between(places, of, f"right {part}", f"left {part}")
        if across is not None and angle(across, left) > 45:
            return False
    ahead = np.cross(left, up)
    for side in ("left", "right"):
        leg, foot = (_between(places, of, f"{side} {a}", f"{side} {b}") for a, b in (("thigh", "foot"), ("foot", "toe")))
        arms = [_between(places, of, f"{side} {part}", f"{side} {LIMBS[part]}") for part in ("arm", "forearm")]
        if leg is not None and angle(leg, -up) > 75:
            return False
        if all(a is not None and angle(a, up) < 35 for a in arms):
            return False
        if foot is not None and (angle(foot, up) < 35 or angle(foot, -ahead) < 35):
            return False
    hips, shoulders = (_between(places, of, f"right {part}", f"left {part}") for part in ("thigh", "arm"))
    return hips is None or shoulders is None or angle(hips, shoulders) < 50


def is_even(places: np.ndarray, of: Limbs) -> bool:
    """Tell whether joints (J, 3) are where a person's are who stands as skeletons rest: straight, or both sides alike.

    Recorders without such a pose write the first frame of the motion as the zero pose: a moment of a step or a dance, in
    which trunk and feet are as they happen to be.
    """
    own = places @ body_axes(places, of)
    return _asymmetry(own, of) < EVEN or _bend(own, of) < EVEN


def facing(motion: MotionRecord, of: Limbs) -> MotionRecord:
    """Return a motion whose zero pose stands along axes of coordinates, where it is off by more than `ASIDE` or `ALONG`.

    A character that was turned before it was exported, or a recorder whose first pose looks anywhere, has such a zero pose. It
    leans as a whole where trunk and legs lean, and by the same.
    """
    rest, axes = rest_of(motion)[0], body_axes(rest_of(motion)[0], of)
    left, up = side_vector(rest, of), axes[:, 1]
    thighs, feet = ([of.roles[r] for side in ("left", "right") if (r := f"{side} {p}") in of.roles] for p in ("thigh", "foot"))
    if len(thighs) == len(feet) == 2:
        trunk, legs = rest[top(of)] - rest[thighs].mean(axis=0), (rest[thighs] - rest[feet]).mean(axis=0)
        if min(angle(trunk, up), angle(legs, up)) > ALONG > angle(trunk, legs):
            up = rest[top(of)] - rest[feet].mean(axis=0)
    left = left - (left @ up) * up / (up @ up)
    if not np.linalg.norm(left) > 0:
        return motion
    own = np.stack([v / np.linalg.norm(v) for v in (left, up, np.cross(left, up))], axis=1)
    turn = axes @ own.T
    off = float(np.degrees(Rotation.from_matrix(turn).magnitude()))
    if off <= ASIDE:
        return motion
    note = f"its zero pose is {off:.0f} degrees off the axes, and is turned to them"
    whole = Reference(np.broadcast_to(turn, (len(rest), 3, 3)), note)
    return replace(since(motion, whole), notes=(*motion.notes, note))


def leans(motion: MotionRecord, of: Limbs) -> bool:
    """Tell whether the zero pose is bent where the frames are not: a crouch, a bow, or a stance to fight in.

    Hips to head lean by more than `LEAN`, and in a third of the frames by less than half of that. Those who are bent by nature
    are so in their frames too.
    """
    rest, ends = rest_of(motion)[0], [of.roles["hips"], top(of)]
    bent = angle(rest[ends[1]] - rest[ends[0]], body_axes(rest, of)[:, 1])
    if bent < LEAN:
        return False
    places, up = forward(sampled(motion))[1], np.eye(3)["xyz".index(motion.up or standing_axis(motion, of))]
    moving = angle(places[:, ends[1]] - places[:, ends[0]], up)
    return bool(np.percentile(moving, 33) < bent / 2)


def odd_parts(motion: MotionRecord, of: Limbs) -> dict[str, float]:
    """Return neck, head or collars that are bent in the zero pose as in none of the frames, and by how many degrees.

    A raised collar bone or a head that looks down in an otherwise good T-pose is an error of every frame that nothing else
    shows. How far neck and head pitch ahead and both collars rise, the latter as seen from the chest, is compared with the
    upright frames. What skeletons are like at rest is no error: people may look down all the time.
    """
    rest, axes = rest_of(motion)[0], body_axes(rest_of(motion)[0], of)
    few, up = sampled(motion), motion.up or standing_axis(motion, of)
    turns, places = forward(few)
    upright = angle(places[:, top(of)] - places[:, of.roles["hips"]], np.eye(3)["xyz".index(up)]) < UPRIGHT
    if upright.sum() < FEWEST or "head" not in of.roles or not of.spine:
        return {}
    turns, places, chest, head = turns[upright], places[upright], of.spine[-1], of.roles["head"]
    ahead, low = person_axes(places, of, up), of.neck[0] if of.neck else chest
    found = [("neck", _pitch((rest[head] - rest[low]) @ axes), _pitch(_seen(places[:, head] - places[:, low], ahead)))]
    if motion.tips is not None and np.linalg.norm(tip := motion.tips[head] - rest[head]) > 0:
        found += [("head", _pitch(tip @ axes), _pitch(_seen(turns[:, head] @ tip, ahead)))]
    for side in ("left", "right"):
        if (bone := _between(rest, of, f"{side} clavicle", f"{side} arm")) is not None:
            moved = places[:, of.roles[f"{side} arm"]] - places[:, of.roles[f"{side} clavicle"]]
            found += [(f"{side} collars", _rise(bone @ axes), _rise(_seen(moved, turns[:, chest] @ axes)))]
    off = {}
    for part, own, moving in found:
        kind, (least, most) = part.split()[-1], np.percentile(moving, (5, 95))
        beyond = float(own - np.clip(own, least, most))
        if not BUILT[kind][0] <= own <= BUILT[kind][1] and abs(beyond) > ODD[kind]:
            off[part] = beyond
    sides = [off.pop(f"{side} collars", 0.0) for side in ("left", "right")]
    off |= {"collars": min(sides, key=abs)} if sides[0] * sides[1] > 0 else {}
    return {part: abs(beyond) for part, beyond in off.items()}


def _seen(vectors: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return vectors (T, 3) along axes that are the columns of (T, 3, 3)."""
    return np.einsum("tab,ta->tb", axes, vectors)


def _pitch(own: np.ndarray) -> np.ndarray:
    """Return the degrees by which vectors (..., 3) along left, up, ahead pitch ahead from up."""
    return np.degrees(np.arctan2(own[..., 2], own[..., 1]))


def _rise(own: np.ndarray) -> np.ndarray:
    """Return the degrees by which vectors (..., 3) along left, up, ahead rise above the horizontal."""
    return np.degrees(np.arctan2(own[..., 1], np.hypot(own[..., 0], own[..., 2])))


def _check_sides(motion: MotionRecord, of: Limbs, up: str) -> None:
    """Raise an InputError where both feet of an upright person point back: left is called right, or axes are left-handed."""
    places, vertical = forward(sampled(motion))[1], np.eye(3)["xyz".index(up)]
    places = places[angle(places[:, top(of)] - places[:, of.roles["hips"]], vertical) < UPRIGHT]
    ahead, share = person_axes(places, of, up)[..., 2], []
    for side in ("left", "right"):
        foot, toe = (of.roles.get(f"{side} {part}") for part in ("foot", "toe"))
        if foot is None or toe is None:
            return
        flat = places[:, toe] - places[:, foot]
        flat = flat - (flat @ vertical)[:, None] * vertical
        share.append(float((angle(flat, -ahead) < 60).mean()) if len(flat) >= FEWEST else 0.0)
    if min(share) > BACKWARD:
        raise InputError(
            "a person whose feet point ahead expected", field="joint_names",
            value=f"feet that point back, in {100 * min(share):.0f} % of the frames",
            mend="left and right are exchanged: export it with right-handed axes, or, if only the names are exchanged, "
            "pair the joints of each side with the body's other one by motion.joints",
        )  # fmt: skip


def _between(places: np.ndarray, of: Limbs, start: str, end: str) -> np.ndarray | None:
    """Return the vector from the joint of one role to another's; None where one is missing or they are at one place."""
    if start not in of.roles or end not in of.roles:
        return None
    vector = places[of.roles[end]] - places[of.roles[start]]
    return vector if np.linalg.norm(vector) > 0 else None


def from_frame(motion: MotionRecord, of: Limbs, up: str, frame: int, note: str) -> Reference:
    """Return the pose of a frame as the reference, turned about the vertical to look ahead."""
    one = replace(motion, poses=motion.poses[frame : frame + 1], translation=motion.translation[frame : frame + 1])
    turns, places = forward(one)
    return Reference(person_axes(places[0], of, up).T @ turns[0], note, places[0, 0] @ TURNS[up])


def _at_end(last: MotionRecord, of: Limbs, up: str) -> Reference | None:
    """Return a T-pose of the last frames; None where there is none. Whoever only stands there holds no pose."""
    found = _among(last, of, up, arms=70)
    return None if found is None else replace(found, note="the reference pose is a T-pose at the end")


def _among(motion: MotionRecord, of: Limbs, up: str, arms: float = 0) -> Reference | None:
    """Return a T-, A- or N-pose of some frames, the one whose halves are most alike; None where there is none.

    Arms hang down with 0 degrees; poses with fewer than `arms` do not count.
    """
    count = min(len(motion.poses), 10)
    first = replace(motion, poses=motion.poses[:count], translation=motion.translation[:count])
    places = forward(first)[1]
    best: tuple[float, int, str] | None = None
    for frame in range(count):
        axes = person_axes(places[frame], of, up)
        own = places[frame] @ axes  # left, up, ahead
        off, spread = _asymmetry(own, of), _spread(own, of)
        straight = spread >= arms and is_person(own, of) and _bend(own, of) < 25
        if straight and off < (12 if 25 < spread < 110 else 2) and (best is None or off < best[0]):
            kind = "T-pose" if spread > 70 else "A-pose" if spread > 25 else "pose with hanging arms"
            best = off, frame, kind
    if best is None:
        return None
    return from_frame(first, of, up, best[1], f"the reference pose is frame {best[1]}, a {best[2]}")


def _spread(own: np.ndarray, of: Limbs) -> float:
    """Return the mean angle in degrees between hanging down and the straight line from shoulder to hand."""
    found = []
    for side in ("left", "right"):
        ends = [of.roles.get(f"{side} {part}") for part in ("arm", "hand")]
        if None not in ends:
            found.append(angle(own[ends[1]] - own[ends[0]], -UP))
    return float(np.mean(found)) if found else 0.0


def _bend(own: np.ndarray, of: Limbs) -> float:
    """Return the largest angle in degrees by which legs lean, elbows bend, and hips to head lean twice."""
    found = [2 * angle(own[top(of)] - own[of.roles["hips"]], UP)]
    for side in ("left", "right"):
        bones = [_between(own, of, f"{side} {a}", f"{side} {b}") for a, b in LIMBS.items()]
        found += [angle(b, -UP) for b in bones[2:] if b is not None]
        if bones[0] is not None and bones[1] is not None:
            found.append(angle(bones[0], bones[1]))
    return float(max(found))


def _asymmetry(own: np.ndarray, of: Limbs) -> float:
    """Return the largest angle in degrees between a limb's bone and the mirror image of the other side's; 180 without limbs."""
    worst = []
    for a, b in LIMBS.items():
        at = [[of.roles.get(f"{side} {part}") for part in (a, b)] for side in ("left", "right")]
        if None not in (*at[0], *at[1]):
            left, right = (own[j] - own[i] for i, j in at)
            worst.append(angle(left, right * (-1, 1, 1)))
    return float(max(worst, default=180.0))


def _built(motion: MotionRecord, of: Limbs, up: str) -> Reference | None:
    """Return a pose built from all frames, see `build_pose`; None where too few are upright."""
    found = build_pose(motion, of, up, is_person(rest_of(motion)[0], of))
    if found is None:
        return None
    note = "the reference pose is built from the bones' directions in the frames"
    doubts = {part: error for part, error in found[1].items() if error >= SURE}
    if doubts:
        about = ", ".join(f"{part} {error:.0f}" for part, error in doubts.items())
        note += f", in nine of ten recordings right to {about} degrees; motion.rest names a better one, as a frame in T-pose"
    return Reference(found[0], note, uncertain=doubts)

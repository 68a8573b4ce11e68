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

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io import MotionRecord
from ncs_jax.io.character.rig import quarter_turns
from ncs_jax.prepare.joint_names import Limbs
from ncs_jax.prepare.skeleton import LIMBS, forward, joint_turns, least_turn, rest_of, sampled, side_vector, top

__all__ = ["Reference", "find_reference", "from_frame", "is_even", "is_person", "since"]

UPRIGHT = 35.0  # degrees by which hips to head may lean in a frame that tells about standing
FEWEST = 3  # such frames
POSTURE = 8.0  # degrees by which people who stand and walk lean and bend a joint of the trunk, on average
NEAR = 15.0  # degrees within which a joint's axes are a standing person's, where they tell
EVEN = 15.0  # degrees by which limbs of a skeleton at rest may differ from their images in the mirror
STRAIGHT = 15.0  # degrees by which a leg that is straight is bent
UP, LEFT, AHEAD = np.eye(3)[[1, 0, 2]]


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference pose.

    turns: the world rotation C (J, 3, 3) of each joint. note: where the pose is from. root: the root's place (3,) in it; None:
    that of the zero pose.
    """

    turns: np.ndarray
    note: str
    root: np.ndarray | None = None


def find_reference(motion: MotionRecord, of: Limbs, up: str, first: MotionRecord, last: MotionRecord) -> Reference:
    """Return a pose in which a motion's skeleton is a person, where the zero pose is none.

    It is a T-pose or an A-pose among the first frames, or one of hanging arms where left and right are alike to 2 degrees; else
    a T-pose among the last; else it is built, see `_built`.

    Args:
        motion: with a skeleton. of: its limbs. up: axis of the motion's world that points up. first, last: the
            file's first and last frames.

    Raises:
        InputError: no frame is such a pose, nor are there upright ones to build it from.
    """
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
    bones = np.diff(places[_trunk(of)], axis=0)
    if (
        any(_angle(b, up) > 65 for b in bones if np.linalg.norm(b) > 0.05 * np.linalg.norm(up))
        or abs(_angle(left, up) - 90) > 45
    ):
        return False
    for part in ("thigh", "arm"):
        across = _between(places, of, f"right {part}", f"left {part}")
        if across is not None and _angle(across, left) > 45:
            return False
    ahead = np.cross(left, up)
    for side in ("left", "right"):
        leg, foot = (_between(places, of, f"{side} {a}", f"{side} {b}") for a, b in (("thigh", "foot"), ("foot", "toe")))
        arms = [_between(places, of, f"{side} {part}", f"{side} {LIMBS[part]}") for part in ("arm", "forearm")]
        if leg is not None and _angle(leg, -up) > 75:
            return False
        if all(a is not None and _angle(a, up) < 35 for a in arms):
            return False
        if foot is not None and (_angle(foot, up) < 35 or _angle(foot, -ahead) < 35):
            return False
    hips, shoulders = (_between(places, of, f"right {part}", f"left {part}") for part in ("thigh", "arm"))
    return hips is None or shoulders is None or _angle(hips, shoulders) < 50


def is_even(places: np.ndarray, of: Limbs) -> bool:
    """Tell whether joints (J, 3) are where a person's are who stands as skeletons rest: straight, or both sides alike.

    Recorders without such a pose write the first frame of the motion as the zero pose: a moment of a step or a dance, in
    which trunk and feet are as they happen to be.
    """
    own = places @ _person_axes(places, of, "y")
    return _asymmetry(own, of) < EVEN or _bend(own, of) < EVEN


def _trunk(of: Limbs) -> list[int]:
    """Return the joints from the hips to the head."""
    return [of.roles["hips"], *of.spine, *of.neck, *([of.roles["head"]] if "head" in of.roles else [])]


def _between(places: np.ndarray, of: Limbs, start: str, end: str) -> np.ndarray | None:
    """Return the vector from the joint of one role to another's; None where one is missing or they are at one place."""
    if start not in of.roles or end not in of.roles:
        return None
    vector = places[of.roles[end]] - places[of.roles[start]]
    return vector if np.linalg.norm(vector) > 0 else None


def _angle(a: np.ndarray, b: np.ndarray) -> Any:
    """Return the angle in degrees between vectors (..., 3)."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def _person_axes(places: np.ndarray, of: Limbs, up: str) -> np.ndarray:
    """Return columns (..., 3, 3) that point left, up and ahead of a person who stands: the heading, and the world's up."""
    vertical = np.eye(3)["xyz".index(up)]
    left = side_vector(places, of)
    left = left - (left @ vertical)[..., None] * vertical
    left = left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-30)
    return np.stack([left, np.broadcast_to(vertical, left.shape), np.cross(left, vertical)], axis=-1)


def from_frame(motion: MotionRecord, of: Limbs, up: str, frame: int, note: str) -> Reference:
    """Return the pose of a frame as the reference, turned about the vertical to look ahead."""
    one = replace(motion, poses=motion.poses[frame : frame + 1], translation=motion.translation[frame : frame + 1])
    turns, places = forward(one)
    return Reference(
        _person_axes(places[0], of, up).T @ turns[0], note, places[0, 0] if up == "y" else places[0, 0, [0, 2, 1]] * (1, 1, -1)
    )


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
        axes = _person_axes(places[frame], of, up)
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
            found.append(_angle(own[ends[1]] - own[ends[0]], -UP))
    return float(np.mean(found)) if found else 0.0


def _bend(own: np.ndarray, of: Limbs) -> float:
    """Return the largest angle in degrees by which legs lean, elbows bend, and hips to head lean twice."""
    found = [2 * _angle(own[top(of)] - own[of.roles["hips"]], UP)]
    for side in ("left", "right"):
        bones = [_between(own, of, f"{side} {a}", f"{side} {b}") for a, b in LIMBS.items()]
        found += [_angle(b, -UP) for b in bones[2:] if b is not None]
        if bones[0] is not None and bones[1] is not None:
            found.append(_angle(bones[0], bones[1]))
    return float(max(found))


def _asymmetry(own: np.ndarray, of: Limbs) -> float:
    """Return the largest angle in degrees between a limb's bone and the mirror image of the other side's; 180 without limbs."""
    worst = []
    for a, b in LIMBS.items():
        at = [[of.roles.get(f"{side} {part}") for part in (a, b)] for side in ("left", "right")]
        if None not in (*at[0], *at[1]):
            left, right = (own[j] - own[i] for i, j in at)
            worst.append(_angle(left, right * (-1, 1, 1)))
    return float(max(worst, default=180.0))


def _built(motion: MotionRecord, of: Limbs, up: str) -> Reference | None:
    """Build a reference pose from the frames in which a person is upright; None where there are fewer than `FEWEST`.

    - Trunk and head stand as they do on average in the third of the frames that is straightest, as seen by someone who turns
      with hips and shoulders; the hips' left is along the line of the hip joints, the chest's along that of the collar bones.
      Where that is within `NEAR` degrees of the joint's own axes, and these tell more than the bone's direction, they stand as
      the axes do, unless the zero pose is a moment of a movement. Where all bones from hips to neck are within `POSTURE`
      degrees of the vertical on average, they are vertical.
    - A thigh points down, an arm to its side, a forearm along the arm. The shin is to the thigh as in the frame that bends the
      knee least, if it is straight there.
    - The twist about a bone lets elbows bend forward and knees backward, where they bend; else it is least on average.
    - A foot stands as it does on average while it is flat on the ground, or is to the shin as always where the ankle is stiff.
    - Every other joint is to its parent as on average.
    """
    turns, places = forward(sampled(motion))
    trunk = places[:, top(of)] - places[:, of.roles["hips"]]
    upright = _angle(trunk, np.eye(3)["xyz".index(up)]) < UPRIGHT
    if upright.sum() < FEWEST:
        return None
    axes = _person_axes(places, of, up)
    moment = is_person(rest_of(motion)[0], of)
    build = _Builder(
        turns[upright], places[upright], axes[upright], of, near=0 if moment else NEAR, alike=0 if moment else POSTURE
    )
    note = (
        "the reference pose is built from the bones' directions in the frames: trunk, head, collars and feet to about "
        f"{build.spread():.0f} degrees; motion.rest names a better one, as a frame in T-pose"
    )
    return Reference(build.pose(rest_of(motion)[1]), note)


@dataclass(frozen=True, eq=False)
class _Builder:
    """Frames of an upright person: world rotations (T, J, 3, 3), places (T, J, 3), the person's axes (T, 3, 3), limbs.

    near, alike: degrees within which a joint's axes are taken for a standing person's, where they tell, and where they do not.
    """

    turns: np.ndarray
    places: np.ndarray
    axes: np.ndarray
    of: Limbs
    near: float
    alike: float

    def pose(self, parents: np.ndarray) -> np.ndarray:
        """Return C (J, 3, 3), parents before children."""
        roles = {j: role for role, j in self.of.roles.items()}
        trunk = _trunk(self.of)
        out = np.broadcast_to(np.eye(3), (len(parents), 3, 3)).copy()
        for j, parent in enumerate(parents):
            side, _, part = roles.get(j, "").partition(" ")
            if j in trunk:
                above = trunk[trunk.index(j) + 1 :]
                out[j] = self._upright(j, above[0] if above else None).T
            elif parent < 0 or (part == "foot" and not self._stiff(j, parent)):
                out[j] = (self._standing(j) if part == "foot" else self._mean(j, self.axes, self.straightest)).T
            else:
                out[j] = out[parent] @ self._mean(parent, self.turns[:, j])
                if part in LIMBS and (end := self.of.roles.get(f"{side} {LIMBS[part]}")) is not None:
                    out[j] = self._limb(j, int(parent), out, side, part, end)
        return out

    @cached_property
    def straight(self) -> bool:
        """Whether all bones from the hips to the neck may be vertical in a person who stands: they are nearly so on average."""
        chain = [self.of.roles["hips"], *self.of.spine, *self.of.neck[:1]]
        seen = [(self._mean(a, self.axes, self.straightest)[:, 1], self._direction(a, b)) for a, b in pairwise(chain)]
        return all(_angle(up, bone) < POSTURE for up, bone in seen)

    @cached_property
    def straightest(self) -> np.ndarray:
        """The third of the frames (T,) in which hips to head lean least and knees bend least, the latter for a quarter."""
        lean = _angle(self.places[:, top(self.of)] - self.places[:, self.of.roles["hips"]], self.axes[:, :, 1])
        for side in ("left", "right"):
            leg = [self.of.roles.get(f"{side} {part}") for part in ("thigh", "shin", "foot")]
            if None not in leg:
                hip, knee, ankle = (self.places[:, j] for j in leg)
                lean = lean + _angle(knee - hip, ankle - knee) / 8
        return lean <= np.percentile(lean, 33)

    def spread(self) -> float:
        """Return by how many degrees (r.m.s.) hips, spine and head turn about their means: so uncertain is what is straight."""
        means = {j: self._mean(j, self.axes, self.straightest) for j in _trunk(self.of)}
        off = [[_turn(mean, seen) for seen in np.swapaxes(self.turns[:, j], 1, 2) @ self.axes] for j, mean in means.items()]
        return float(np.sqrt(np.square(off).mean(axis=1).max()))

    def _mean(self, j: int, of: np.ndarray, frames=slice(None)) -> np.ndarray:
        """Return the mean rotation (3, 3) of frames (T, 3, 3) as seen from joint j."""
        left, _, right = np.linalg.svd((np.swapaxes(self.turns[frames, j], 1, 2) @ of[frames]).mean(axis=0))
        return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right

    def _direction(self, j: int, end: int) -> np.ndarray:
        """Return the mean direction (3,) from joint j to another, as seen from joint j."""
        seen = np.einsum("tba,tb->ta", self.turns[:, j], self.places[:, end] - self.places[:, j]).mean(axis=0)
        return seen / max(float(np.linalg.norm(seen)), 1e-30)

    def _upright(self, j: int, above: int | None) -> np.ndarray:
        """Return columns that point left, up and ahead as seen from a joint of the trunk, see `_built`."""
        mean = self._mean(j, self.axes, self.straightest)
        left = self._left(j)
        if left is not None and _angle(left, mean[:, 0]) < NEAR:
            mean = least_turn(mean[:, 0], left) @ mean
        own = max(quarter_turns(), key=lambda q: np.trace(q.T @ mean))
        bone = None if above is None else self._direction(j, above)
        if bone is None or not bone.any():
            return own if _turn(own, mean) < self.near else mean
        tells = 0.5 < _angle(bone, own[:, 1]) < 45 and abs(bone @ own[:, 0]) < 0.01
        if tells and _turn(own, mean) < self.near:
            return own
        if self.straight:
            mean = least_turn(mean[:, 1], bone) @ mean
            return own if _turn(own, mean) < self.alike and _angle(bone, own[:, 1]) < 0.5 else mean
        return mean

    def _left(self, j: int) -> np.ndarray | None:
        """Return the direction from right to left as seen from the hips or the chest: between the joints that hang on them."""
        parts = ("thigh",) if j == self.of.roles["hips"] else ("clavicle", "arm") if j in self.of.spine[-1:] else ()
        for part in parts:
            ends = [self.of.roles.get(f"{side} {part}") for side in ("right", "left")]
            if None not in ends:
                seen = np.einsum("tba,tb->ta", self.turns[:, j], self.places[:, ends[1]] - self.places[:, ends[0]]).mean(axis=0)
                return seen / max(float(np.linalg.norm(seen)), 1e-30)
        return None

    def _stiff(self, j: int, parent: int) -> bool:
        """Tell whether a joint turns by less than 2 degrees about its mean."""
        seen = np.swapaxes(self.turns[:, parent], 1, 2) @ self.turns[:, j]
        return bool(np.max([_turn(s, self._mean(parent, self.turns[:, j])) for s in seen]) < 2)

    def _standing(self, j: int) -> np.ndarray:
        """Return columns that point left, up and ahead as seen from a foot flat on the ground: low, and of those frames slow.

        A foot that tips over its toes or hangs in the air has its ankle higher.
        """
        place = self.places[:, j]
        height = np.einsum("ta,ta->t", place, self.axes[:, :, 1])
        speed = np.linalg.norm(np.gradient(place, axis=0), axis=1) if len(place) > 1 else np.zeros(1)
        low = height <= np.percentile(height, 33)
        return self._mean(j, self.axes, low & (speed <= np.percentile(speed[low], 50)))

    def _limb(self, j: int, parent: int, out: np.ndarray, side: str, part: str, end: int) -> np.ndarray:
        """Return C (3, 3) of a joint of arm or leg, see `_built`."""
        outward = LEFT if side == "left" else -LEFT
        along, bone = -UP if part in ("thigh", "shin") else outward, self._direction(j, end)
        if part == "shin":
            seen = np.swapaxes(self.turns[:, parent], 1, 2) @ self.turns[:, j]
            bend = _angle(np.einsum("ab,tbc,c->ta", out[parent], seen, bone), along)
            if bend.min() < STRAIGHT:
                return out[parent] @ seen[int(bend.argmin())]
        base = least_turn(bone, along)
        hinge = self._hinge(j, end, side, part)
        if hinge is not None:
            axis, meant = base @ hinge, LEFT if part == "thigh" else np.cross(outward, AHEAD)
            return Rotation.from_rotvec(along * np.arctan2(along @ np.cross(axis, meant), axis @ meant)).as_matrix() @ base
        moved = out[parent] @ np.swapaxes(self.turns[:, parent], 1, 2) @ self.turns[:, j] @ base.T
        x, y, z, w = Rotation.from_matrix(moved).as_quat().T
        twist = 2 * np.arctan2(np.stack([x, y, z], axis=1) @ along, w)
        return Rotation.from_rotvec(along * np.arctan2(np.sin(twist).mean(), np.cos(twist).mean())).as_matrix() @ base

    def _hinge(self, j: int, end: int, side: str, part: str) -> np.ndarray | None:
        """Return the axis (3,) about which knee or elbow bend, at right angles to the bone, as seen from the joint above.

        None where they bend little, or about no axis in particular.
        """
        last = self.of.roles.get(f"{side} {LIMBS[LIMBS[part]]}") if LIMBS[part] in LIMBS else None
        if last is None:
            return None
        bones = [self.places[:, b] - self.places[:, a] for a, b in ((j, end), (end, last))]
        first, second = (b / np.maximum(np.linalg.norm(b, axis=1, keepdims=True), 1e-30) for b in bones)
        bends = np.einsum("tba,tb->ta", self.turns[:, j], np.cross(first, second))
        mean, size = bends.mean(axis=0), np.linalg.norm(bends, axis=1).mean()
        if size < np.sin(np.radians(5)) or np.linalg.norm(mean) < 0.8 * size:
            return None
        bone = self._direction(j, end)
        mean = mean - (mean @ bone) * bone
        return mean / np.linalg.norm(mean)


def _turn(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle in degrees of the rotation between two."""
    return float(np.degrees(Rotation.from_matrix(a.T @ b).magnitude()))

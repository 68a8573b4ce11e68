"""A pose built from all frames of a motion: how a person stands, where neither a frame nor the zero pose tells.

Trunk and head stand as they do on average while the person is straightest. People who dance, carry or bend are not straight on
average. That is weighed against how skeletons are built: at rest the hip joints, the chest and the head lie above one another,
and no foot points up. With theta_j the pitch of joint j against its mean, and tau_k(theta) that of a chain of bones,

    min sum_j (theta_j / s_j)^2 + sum_k (d(tau_k(theta), [a_k, b_k]) / s)^2

is the most likely pose, d being the distance from an interval. The second derivatives tell what remains uncertain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ncs_jax.io import MotionRecord
from ncs_jax.io.character.rig import quarter_turns
from ncs_jax.prepare.joint_names import Limbs
from ncs_jax.prepare.skeleton import LIMBS, angle, bone, forward, least_turn, person_axes, rest_of, sampled, top, trunk_of

__all__ = ["FEWEST", "UPRIGHT", "build_pose"]

UPRIGHT = 35.0  # degrees by which hips to head may lean in a frame that tells about standing
FEWEST = 3  # such frames
POSTURE = 8.0  # degrees by which people who stand and walk lean and bend a joint of the trunk, on average
LOOK, NOD = 15.0, 10.0  # degrees by which people look down or up on average, by the head and by the neck
UNSAID = 4.0  # degrees by which a bone of the trunk that stands vertically on average may lean at rest
HANDS = {"forearms": 17.0, "hands": 25.0}  # degrees by which these are twisted on average, which nothing tells
TOLD = 2.0  # standard deviations that are told: nine of ten recordings are closer
NEAR = 15.0  # degrees within which a joint's axes are a standing person's, where they tell
STRAIGHT = 15.0  # degrees by which a leg that is straight is bent
UP, LEFT, AHEAD = np.eye(3)[[1, 0, 2]]
# Degrees by which chains of bones pitch ahead at rest, at least and at most, as skeletons differ (CMU's of 22 and of 31 joints,
# SMPL's, Mixamo's, the packaged body's): from between the hip joints to the chest and to the head, of the neck, of a foot down.
CHEST, HEAD, NECK, FOOT = (-1.0, 3.0), (-1.5, 2.5), (9.0, 39.0), (10.0, 33.0)
CROWN = (-3.0, 9.0)  # and from the head to the end of its bone, where a file has it
APART = 0.08  # of the height from hips to head by which joints of the trunk stand ahead of each other
LEVEL, ALIKE = 6.0, 4.0  # degrees by which feet on the ground pitch on average, and one more than the other
BEYOND = 2.0  # degrees by which a skeleton may leave these bounds


def build_pose(motion: MotionRecord, of: Limbs, up: str, moment: bool) -> tuple[np.ndarray, dict[str, float]] | None:
    """Build a reference pose from the frames in which a person is upright; None where there are fewer than `FEWEST`.

    - Trunk and head stand as they do on average in the third of the frames that is straightest, as seen by someone who turns
      with hips and shoulders; the hips' left is along the line of the hip joints, the chest's along that of the collar bones,
      and no other bone of the trunk leans aside. Where that is within `NEAR` degrees of the joint's own axes, and these tell
      more than the bone's direction, they stand as the axes do, unless the zero pose is a moment of a movement. Where all bones
      from hips to neck are within `POSTURE` degrees of the vertical on average, they are vertical. What is settled by neither
      pitches as is most likely, see above. The end of the head's bone is above it, unless the zero pose is a moment.
    - A thigh points down, an arm to its side, a forearm along the arm. The shin is to the thigh as in the frame that bends the
      knee least, if it is straight there.
    - The twist about a bone lets elbows bend forward and knees backward, where they bend; else it is least on average.
    - A foot stands as it does on average while it is flat on the ground, or is to the shin as always where the ankle is stiff.
      Both feet pitch alike.
    - Every other joint is to its parent as on average.

    Args:
        motion: with a skeleton. of: its limbs. up: axis of the motion's world that points up. moment: whether the zero pose is
            a moment of a movement.

    Returns:
        C (J, 3, 3), the world rotation of each joint, and for hips, spine, chest, neck, head, collars, feet, forearms and hands
        the degrees to which they are right in nine of ten recordings.
    """
    turns, places = forward(sampled(motion))
    trunk = places[:, top(of)] - places[:, of.roles["hips"]]
    upright = angle(trunk, np.eye(3)["xyz".index(up)]) < UPRIGHT
    if upright.sum() < FEWEST:
        return None
    axes = person_axes(places, of, up)
    near, alike = (0, 0) if moment else (NEAR, POSTURE)
    crown = None if moment or "head" not in of.roles else bone(of, "", rest_of(motion)[0], motion.tips, of.roles["head"])
    crown = None if crown is None else crown / np.linalg.norm(crown)
    build = _Builder(turns[upright], places[upright], axes[upright], of, near, alike, crown)
    return build.pose(rest_of(motion)[1]), build.deviations()


@dataclass(frozen=True, eq=False)
class _Builder:
    """Frames of an upright person: world rotations (T, J, 3, 3), places (T, J, 3), the person's axes (T, 3, 3), limbs.

    near, alike: degrees within which a joint's axes are taken for a standing person's, where they tell, and where they do not.
    crown: the direction (3,) from the head to the end of its bone, as seen from the head; None where that is not known.
    """

    turns: np.ndarray
    places: np.ndarray
    axes: np.ndarray
    of: Limbs
    near: float
    alike: float
    crown: np.ndarray | None

    def pose(self, parents: np.ndarray) -> np.ndarray:
        """Return C (J, 3, 3), parents before children."""
        roles, trunk, feet = {j: role for role, j in self.of.roles.items()}, self.trunk[0], self.feet[0]
        out = np.broadcast_to(np.eye(3), (len(parents), 3, 3)).copy()
        for j, parent in enumerate(parents):
            side, _, part = roles.get(j, "").partition(" ")
            if j in trunk:
                out[j] = trunk[j]
            elif j in feet and not self._stiff(j, parent):
                out[j] = feet[j]
            elif parent < 0:
                out[j] = self._mean(j, self.axes, self.straightest).T
            else:
                out[j] = out[parent] @ self._mean(parent, self.turns[:, j])
                if part in LIMBS and (end := self.of.roles.get(f"{side} {LIMBS[part]}")) is not None:
                    out[j] = self._limb(j, int(parent), out, side, part, end)
        return out

    def deviations(self) -> dict[str, float]:
        """Return the degrees to which parts are right in nine of ten recordings."""
        parts = {"hips": [self.of.roles["hips"]], "spine": self.of.spine[:-1], "chest": self.of.spine[-1:]}
        parts |= {"neck": self.of.neck, "head": [self.of.roles[r] for r in ("head",) if r in self.of.roles]}
        found = {part: max(self.trunk[1][j] for j in joints) for part, joints in parts.items() if len(joints)}
        if "chest" in found and "left clavicle" in self.of.roles:
            found["collars"] = float(np.hypot(found["chest"], POSTURE))
        found |= {"feet": max(self.feet[1].values())} if self.feet[1] else {}
        found |= {part: by for part, by in HANDS.items() if "left hand" in self.of.roles}
        return {part: TOLD * by for part, by in found.items()}

    @cached_property
    def trunk(self) -> tuple[dict[int, np.ndarray], dict[int, float]]:
        """C (3, 3) of the joints from hips to head, and the standard deviations of their errors, degrees."""
        joints = trunk_of(self.of)
        found = [self._upright(j, above) for j, above in zip(joints, [*joints[1:], None], strict=True)]
        turns, unsaid = [columns.T for columns, _ in found], np.array([doubt for _, doubt in found])
        bones = np.array([c @ self._bone(a, b) for c, (a, b) in zip(turns[:-1], pairwise(joints), strict=True)])
        if not len(bones):  # legs alone
            return dict(zip(joints, turns, strict=True)), dict.fromkeys(joints, POSTURE)
        thighs = [j for side in ("left", "right") if (j := self.of.roles.get(f"{side} thigh")) is not None]
        if len(thighs) == 2:
            bones[0] -= turns[0] @ np.mean([self._bone(joints[0], j) for j in thighs], axis=0)
        size, chest, last = np.linalg.norm(bones.sum(axis=0)), len(self.of.spine), len(bones)
        ahead = np.degrees(np.arctan(APART * size / np.maximum(np.linalg.norm(bones, axis=1), 1e-9 * size)))
        chains = [(0, last, HEAD), (0, chest, CHEST), (chest + 1, last, NECK)]
        chains += [(k, k + 1, (-ahead[k], ahead[k])) for k in range(min(chest + 1, last))]
        chains = [chain for chain in chains if chain[0] < chain[1]]
        if self.crown is not None:
            bones, chains = np.vstack([bones, turns[-1] @ self.crown]), [*chains, (last, last + 1, CROWN)]
        prior = [POSTURE if k <= chest else LOOK if j == self.of.roles.get("head") else NOD for k, j in enumerate(joints)]
        given = np.where(np.isfinite(unsaid), 1e-2, prior)

        def misfit(theta: np.ndarray) -> np.ndarray:
            now = Rotation.from_rotvec(theta[: len(bones), None] * LEFT, degrees=True).apply(bones)
            sums = np.array([now[first:end].sum(axis=0) for first, end, _ in chains]).reshape(-1, 3)
            return np.append(theta / given, _beyond(np.degrees(np.arctan2(sums[:, 2], sums[:, 1])), [c[2] for c in chains]))

        theta, deviation = _most_likely(misfit, len(joints), [chain[2] for chain in chains])
        deviation = np.hypot(deviation, np.where(np.isfinite(unsaid), unsaid, 0))
        turned = [Rotation.from_rotvec(t * LEFT, degrees=True).as_matrix() @ c for t, c in zip(theta, turns, strict=True)]
        return dict(zip(joints, turned, strict=True)), dict(zip(joints, deviation.tolist(), strict=True))

    @cached_property
    def feet(self) -> tuple[dict[int, np.ndarray], dict[int, float]]:
        """C (3, 3) of the feet flat on the ground, and the standard deviations of their errors, degrees."""
        feet = {side: j for side in ("left", "right") if (j := self.of.roles.get(f"{side} foot")) is not None}
        turns = {j: self._standing(j, self.of.roles.get(f"{side} toe")).T for side, j in feet.items()}
        bones = [turns[j] @ self._bone(j, t) for s, j in feet.items() if (t := self.of.roles.get(f"{s} toe")) is not None]
        if len(bones) < 2 or not all(np.linalg.norm(b[[0, 2]]) > 0.2 * np.linalg.norm(b) for b in bones):
            return turns, dict.fromkeys(turns, POSTURE)
        down = np.degrees([np.arctan2(-b[1], np.linalg.norm(b[[0, 2]])) for b in bones])
        theta, deviation = _most_likely(
            lambda t: np.concatenate([t / LEVEL, [np.diff(down + t)[0] / ALIKE], _beyond(down + t, [FOOT, FOOT])]),
            2,
            [FOOT, FOOT],
        )
        for (j, c), t, b in zip(list(turns.items()), theta, bones, strict=True):
            axis = np.cross(UP, b * (1, 0, 1))
            turns[j] = Rotation.from_rotvec(t * axis / np.linalg.norm(axis), degrees=True).as_matrix() @ c
        return turns, dict(zip(turns, deviation.tolist(), strict=True))

    @cached_property
    def straight(self) -> bool:
        """Whether all bones from the hips to the neck may be vertical in a person who stands: they are nearly so on average."""
        return all(self._vertical(a, b) for a, b in pairwise([self.of.roles["hips"], *self.of.spine, *self.of.neck[:1]]))

    def _vertical(self, j: int, end: int) -> bool:
        """Tell whether a bone is nearly vertical on average."""
        return bool(angle(self._mean(j, self.axes, self.straightest)[:, 1], self._direction(j, end)) < POSTURE)

    @cached_property
    def straightest(self) -> np.ndarray:
        """The third of the frames (T,) in which hips to head lean least and knees bend least, the latter for a quarter."""
        lean = angle(self.places[:, top(self.of)] - self.places[:, self.of.roles["hips"]], self.axes[:, :, 1])
        for side in ("left", "right"):
            leg = [self.of.roles.get(f"{side} {part}") for part in ("thigh", "shin", "foot")]
            if None not in leg:
                hip, knee, ankle = (self.places[:, j] for j in leg)
                lean = lean + angle(knee - hip, ankle - knee) / 8
        return lean <= np.percentile(lean, 33)

    def _mean(self, j: int, of: np.ndarray, frames=slice(None)) -> np.ndarray:
        """Return the mean rotation (3, 3) of frames (T, 3, 3) as seen from joint j."""
        left, _, right = np.linalg.svd((np.swapaxes(self.turns[frames, j], 1, 2) @ of[frames]).mean(axis=0))
        return left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right

    def _bone(self, j: int, end: int) -> np.ndarray:
        """Return the mean vector (3,) from joint j to another, as seen from joint j."""
        return np.einsum("tba,tb->ta", self.turns[:, j], self.places[:, end] - self.places[:, j]).mean(axis=0)

    def _direction(self, j: int, end: int) -> np.ndarray:
        """Return the mean direction (3,) from joint j to another, as seen from joint j."""
        seen = self._bone(j, end)
        return seen / max(float(np.linalg.norm(seen)), 1e-30)

    def _upright(self, j: int, above: int | None) -> tuple[np.ndarray, float]:
        """Return columns that point left, up and ahead as seen from a joint of the trunk, and the deviation of its pitch:
        0 where the axes tell, infinity where nothing does."""
        mean, left = self._mean(j, self.axes, self.straightest), self._left(j)
        bone = None if above is None else self._direction(j, above)
        middle = self.crown if bone is None else bone
        if left is None and middle is not None:
            left = mean[:, 0] - (mean[:, 0] @ middle) * middle
        if left is not None and angle(left, mean[:, 0]) < NEAR:
            mean = least_turn(mean[:, 0], left) @ mean
        own = _own(mean)
        if above is None or bone is None or not bone.any():
            return (own, 0) if _turn(own, mean) < self.near and self.along_axes else (mean, np.inf)
        tells = 0.5 < angle(bone, own[:, 1]) < 45 and abs(bone @ own[:, 0]) < 0.01
        if tells and _turn(own, mean) < self.near:
            return own, 0
        if self.straight and (j not in self.of.neck or self._vertical(j, above)):
            mean = least_turn(mean[:, 1], bone) @ mean
            along = _turn(own, mean) < self.alike and angle(bone, own[:, 1]) < 0.5
            return (own, 0) if along else (mean, UNSAID)
        return mean, np.inf

    @cached_property
    def along_axes(self) -> bool:
        """Whether half of the joints from hips to neck have axes that are nearly a standing person's: so may the head's be."""
        means = [self._mean(j, self.axes, self.straightest) for j in trunk_of(self.of)[:-1]]
        return sum(_turn(_own(mean), mean) < self.near for mean in means) * 2 >= len(means)

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

    def _standing(self, j: int, toe: int | None) -> np.ndarray:
        """Return columns that point left, up and ahead as seen from a foot flat on the ground: low, and of those frames slow.

        A foot that tips over its toes or hangs in the air has its ankle higher. On the ground the toes are below the ankle.
        """
        place = self.places[:, j]
        height = np.einsum("ta,ta->t", place, self.axes[:, :, 1])
        speed = np.linalg.norm(np.gradient(place, axis=0), axis=1) if len(place) > 1 else np.zeros(1)
        flat = np.ones(len(place), bool)
        if toe is not None:
            bone = self.places[:, toe] - place
            down = angle(bone, self.axes[:, :, 1]) - 90
            flat = np.abs(down - np.mean(FOOT)) < np.ptp(FOOT)
            flat = flat if flat.sum() >= FEWEST else ~np.zeros(len(place), bool)
        low = flat & (height <= np.percentile(height[flat], 33))
        return self._mean(j, self.axes, low & (speed <= np.percentile(speed[low], 50)))

    def _limb(self, j: int, parent: int, out: np.ndarray, side: str, part: str, end: int) -> np.ndarray:
        """Return C (3, 3) of a joint of arm or leg, see `_built`."""
        outward = LEFT if side == "left" else -LEFT
        along, bone = -UP if part in ("thigh", "shin") else outward, self._direction(j, end)
        if part == "shin":
            seen = np.swapaxes(self.turns[:, parent], 1, 2) @ self.turns[:, j]
            bend = angle(np.einsum("ab,tbc,c->ta", out[parent], seen, bone), along)
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


def _own(turn: np.ndarray) -> np.ndarray:
    """Return the quarter turn (3, 3) that is nearest to a rotation."""
    return max(quarter_turns(), key=lambda q: np.trace(q.T @ turn))


def _turn(a: np.ndarray, b: np.ndarray) -> float:
    """Return the angle in degrees of the rotation between two."""
    return float(np.degrees(Rotation.from_matrix(a.T @ b).magnitude()))


def _beyond(pitch: np.ndarray, bounds: Sequence[tuple[float, float]]) -> np.ndarray:
    """Return by how many times `BEYOND` pitches (n,) lie outside of their bounds, 0 within."""
    low, high = np.transpose(bounds).reshape(2, -1)
    return (pitch - np.clip(pitch, low, high)) / BEYOND


def _most_likely(
    misfit: Callable[[np.ndarray], np.ndarray], count: int, bounds: Sequence[tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles (count,) for which the squares of a misfit have the least sum, and their deviations (count,).

    The last of the misfit are those of `bounds`. One that is in force says that an angle is at its end or farther in, so for
    the deviations it counts with half its width. An angle that had to go far is in doubt by half of its way.
    """
    found = least_squares(misfit, np.zeros(count))
    shares = found.jac.copy()
    shares[len(shares) - len(bounds) :] *= (2 * BEYOND / np.ptp(np.reshape(bounds, (-1, 2)), axis=1))[:, None]
    return found.x, np.hypot(np.sqrt(np.diag(np.linalg.inv(shares.T @ shares))), found.x / 2)

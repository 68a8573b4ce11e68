"""A motion of one skeleton drives a body of another: joints paired by name, bones aligned at rest, paths scaled by the legs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.mesh.axes import TURNS
from ncs_jax.io.records import SkeletonPoses, shown_frames
from ncs_jax.prepare.joint_names import BONES, Limbs, anatomy, listed, pair, propose, undriven
from ncs_jax.prepare.skeleton import LIMBS, body_axes, bone, forward, least_turn, rest_of, top, up_axis

__all__ = [
    "Retargeted", "body_names", "called", "paired", "retarget", "sole_heights", "turn_note", "up_rotation", "with_skeleton",
]  # fmt: skip

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
LEG = 0.5, 1.1  # m from hip to ankle of a grown person, to tell units apart
SAMPLES = 2000  # frames; a longer motion has its soles measured in this many at least

# SMPL's joints of a person of 1.7 m in T-pose, facing +Z, the left at +X, by the segment lengths of Drillis and Contini (1966):
# for motions that come without a skeleton. Fingers, jaw and eyes are where they hang.
PERSON = {
    "pelvis": (0, 0.95, 0), "hip": (0.09, 0.9, 0), "knee": (0.09, 0.484, 0), "ankle": (0.09, 0.066, 0), "foot": (0.09, 0, 0.13),
    "spine1": (0, 1.06, 0), "spine2": (0, 1.17, 0), "spine3": (0, 1.28, 0), "neck": (0, 1.45, 0), "head": (0, 1.52, 0),
    "collar": (0.06, 1.38, 0), "shoulder": (0.2, 1.39, 0), "elbow": (0.516, 1.39, 0), "wrist": (0.764, 1.39, 0),
    "hand": (0.85, 1.39, 0),
}  # fmt: skip

ENDS = ("thigh", "shin", "foot", "arm", "forearm", "hand")
PAIRED = ("hips", "head", *(f"{side} {part}" for part in ENDS for side in ("left", "right")))  # that an error names


@dataclass(frozen=True, eq=False)
class Retargeted:
    """A motion that drives a body, and how it came about.

    motion: of the body's joints, its translation in m. pairs: the motion's joint of each body joint that is driven. still: body
    joints that stay at rest. unused: joints of the motion that drive nothing. scale: m for each unit of the motion's lengths.
    """

    motion: MotionRecord
    pairs: dict[str, str]
    still: tuple[str, ...]
    unused: tuple[str, ...]
    scale: float


def body_names(body: BodyRecord) -> tuple[str, ...]:
    """Return the joints' names: the body's own, or SMPL's where it has none and its joints form SMPL's tree; else none."""
    if body.joint_names:
        return body.joint_names
    names = smpl_names(len(body.parents))
    return names if names and np.array_equal(body.parents, smpl_parents(len(names))) else ()


def called(names: tuple[str, ...], bones: tuple[str, ...]) -> tuple[str, ...]:
    """Return what joints are called: the bone's name where the file's format says which joints are a person's bones."""
    return tuple(bone or name for name, bone in zip(names, bones, strict=True)) if bones else names


def with_skeleton(motion: MotionRecord, wanted: int) -> MotionRecord:
    """Add names and rest joints to a motion without them, where it has SMPL's joints: those of a person in SMPL's T-pose.

    A motion that has both stays as it is. `wanted` is how many joints the body has, for the error.

    Raises:
        InputError: the motion has no skeleton, and its joints are not SMPL's.
    """
    if motion.joints is not None and motion.joint_names:
        return motion
    count = motion.poses.shape[1]
    names = smpl_names(count)
    if not names or (motion.joint_names and motion.joint_names != names):
        called = f", called {', '.join(motion.joint_names[:3])}" if motion.joint_names else ""
        raise InputError(
            f"the body's {wanted} joints expected, or names and a skeleton to retarget by", field="poses",
            value=f"{count} joints{called}", mend="write joint_names (J,), joints (J, 3) and parents (J,), or give a .bvh",
        )  # fmt: skip
    parents = smpl_parents(count)
    joints = np.zeros((count, 3))
    for j, name in enumerate(names):
        side, _, part = name.rpartition("_")
        place = PERSON.get(part)
        joints[j] = joints[parents[j]] if place is None else np.array(place) * ((-1 if side == "right" else 1), 1, 1)
    return replace(motion, joint_names=names, joints=joints, parents=parents)


def retarget(
    motion: MotionRecord,
    body: BodyRecord,
    *,
    joints: Mapping[str, str] | None = None,
    scale: float = 0.0,
    up: str = "",
    world: str = "y",
) -> Retargeted:
    """Drive a body by a motion of another skeleton.

    Joints are paired by name, see `joint_names`. A body joint without a partner stays at rest. What the motion's joints between
    two paired ones turn is part of the next pair's turn. With R_s the world rotation of a source joint since its rest,

        R_t = U R_s A.

    A takes the body's rest pose to the source's. For the trunk it is the quarter turns between the axes of both. Upper arm,
    forearm, thigh and shin add the least rotation that lays one bone at rest along the other, so that the bone's direction is
    the source's in every frame. A foot adds a turn about the vertical only, as both stand on the ground, unless the two feet
    point 45 degrees apart. U turns the source's up to the world's. The path of the hips is scaled by the ratio of the legs, hip
    to ankle, and moved up or down until the lowest sole, in 19 of 20 frames, is no lower than the soles are at rest.

    Args:
        motion: with names and skeleton, see `with_skeleton`; lengths in any unit. body: with names, or SMPL's joints.
        joints: the body's joint, by name or number, for a joint of the motion, "" for none; it overrides the pairs by name.
        scale: m for each unit of the motion's lengths; 0: found from the legs. up: axis of the motion's world, "y" or "z"; "":
            the motion's own, else z where its skeleton stands along z, at rest and moving. world: the axis that points up here.

    Raises:
        InputError: no names, names that do not match, or overrides that name no joint of the body.
    """
    joints, names, rest = joints or {}, body_names(body), rest_of(motion)[0]
    source, target, pairs = paired(motion, body, joints)
    turns, places = forward(motion)
    axes = body_axes(body.joints, target)
    quarter = body_axes(rest, source) @ axes.T
    upright = up_rotation(up or motion.up or up_axis(places, rest, source), world)
    align = _alignment(motion, body, source, target, pairs, quarter, axes)
    world_turns, local = _driven(turns, body, pairs, upright, align)
    legs = _leg_length(source, rest)
    scaled_by = "as the scene says" if scale else "by the legs" if legs > 0 else "by the trunk"
    scale = scale or _leg_ratio(rest, body, source, target)
    hips_s, hips_t = _middle(source, rest_of(motion)[1]), target.roles["hips"]
    home = body.joints[hips_t] - scale * quarter.T @ rest[hips_s]
    bodily = replace(motion, poses=local, translation=np.zeros((len(turns), 3)), joints=body.joints, parents=body.parents)
    offsets = forward(bodily, world_turns)[1]  # with the root at its rest place
    translation = home + scale * places[:, hips_s] @ upright.T - offsets[:, hips_t]
    height = "xyz".index(world)
    low = np.percentile(soles := sole_heights(body, target, world_turns, offsets + translation[:, None], height, axes[:, 1]), 5)
    translation[:, height] -= low
    driven = {names[j]: motion.joint_names[i] for j, i in pairs.items()}
    used = set(driven.values())
    still, unused = tuple(n for n in names if n not in driven), tuple(n for n in motion.joint_names if n not in used)
    lacking, shown = _lacking(motion, names, target, pairs), _shown(motion, scale * places @ upright.T)
    moved = MotionRecord(local, translation, motion.fps, names, source=shown, undriven=lacking, driven=driven)
    result = Retargeted(moved, driven, still, unused, scale)
    notes = [*_notes(result, motion.joint_names, source.shaped, legs, scaled_by, float(soles.max() - low))]
    if absent := [n for n in joints if n not in motion.joint_names]:
        notes.append(f"motion.joints names joints that this motion does not have: {', '.join(absent)}")
    return replace(result, motion=replace(result.motion, notes=(*notes, *turn_note(upright)), uncertain=motion.uncertain))


def paired(motion: MotionRecord, body: BodyRecord, joints: Mapping[str, str]) -> tuple[Limbs, Limbs, dict[int, int]]:
    """Return the limbs of the motion's skeleton and of the body, and the motion's joint of each body joint that is driven.

    A joint of the motion that an override pairs with the body's takes that joint's role.
    """
    names = body_names(body)
    if not names:
        raise InputError(
            "a body with joint names expected, as the motion has another skeleton", field="joint_names", value="none",
            mend="write joint_names (J,) into the body's file",
        )  # fmt: skip
    rest, parents = rest_of(motion)
    source = anatomy(called(motion.joint_names, motion.bones), parents.tolist(), rest)
    target = anatomy(called(names, body.bones), body.parents.tolist(), body.joints)
    pairs = _overridden(pair(source, target), motion.joint_names, names, joints)
    source = replace(source, roles=source.roles | {word: pairs[j] for word, j in target.roles.items() if j in pairs})
    limbs = {j for role, j in target.roles.items() if role.split()[-1] in BONES}
    if target.roles["hips"] not in pairs or len(pairs) < min(3, len(names)) or (limbs and limbs.isdisjoint(pairs)):
        ours = [names[target.roles[word]] for word in PAIRED if word in target.roles]
        raise InputError(
            "joints that are a body's by name or shape expected: hips, head and limbs are not found", field="motion.joints",
            value=f"{len(motion.joint_names)} joints, {', '.join(motion.joint_names[:4])}, ...",
            mend=f"another creature cannot drive this body; else pair its joints with the body's {', '.join(ours)}: "
            f'joints = {{ "{motion.joint_names[0]}" = "{ours[0]}", ... }} below [motion]',
        )  # fmt: skip
    return source, target, pairs


def _middle(source: Limbs, parents: np.ndarray) -> int:
    """Return the joint whose place is that of the hips: of a pelvis beside the spine, the one that carries both."""
    hips = source.roles["hips"]
    if hips != source.pelvis or not source.spine:
        return hips
    trunk = path_to_root(parents, source.spine[0])
    return next(j for j in path_to_root(parents, hips) if j in trunk)


def _lacking(motion: MotionRecord, names: tuple[str, ...], target: Limbs, pairs: dict[int, int]) -> dict[str, str]:
    """Return what of the body nothing drives, and the line of the scene file that mends it with the likeliest joint."""
    found, used = {}, set(pairs.values())
    for limb, j in undriven(target, pairs).items():
        likely = propose(limb, names[j], motion.joint_names, rest_of(motion)[1].tolist(), used)
        used |= {motion.joint_names.index(likely)} if likely else set()
        found[limb] = f'motion.joints = {{ "{likely}" = "{names[j]}" }}' if likely else "a motion that has it"
    return found


def _driven(turns: np.ndarray, body: BodyRecord, pairs: dict[int, int], upright, align) -> tuple[np.ndarray, np.ndarray]:
    """Return the body's world rotations (T, J, 3, 3), and its local ones (T, J, 3) as axis times angle in the joints' axes."""
    frames, count = len(turns), len(body.parents)
    world_turns, local = np.zeros((frames, count, 3, 3)), np.zeros((frames, count, 3))
    for j, parent in enumerate(body.parents):
        above = world_turns[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (frames, 3, 3))
        world_turns[:, j] = upright @ turns[:, pairs[j]] @ align[j] if j in pairs else above
        if j in pairs:  # the others stay exactly zero: a joint that never turns tells the network nothing
            own = np.swapaxes(above, 1, 2) @ world_turns[:, j]
            if body.rest_rotations is not None:
                own = body.rest_rotations[j].T @ own @ body.rest_rotations[j]
            local[:, j] = Rotation.from_matrix(own).as_rotvec()
            if np.ptp(local[:, j], axis=0).max() < 1e-7:
                local[:, j] = np.where(np.abs(local[0, j]) < 1e-7, 0, local[0, j])
    return world_turns, local


def up_rotation(up: str, world: str) -> np.ndarray:
    """Return the quarter turn from one axis that points up to another: Z up to Y up takes (x, y, z) to (x, z, -y).

    X up to Y up takes (x, y, z) to (-y, x, z).
    """
    return (TURNS[world] @ TURNS[up].T).astype(np.float64)


def turn_note(turn: np.ndarray) -> tuple[str, ...]:
    """Describe a turn of `up_rotation` in a note; none where nothing turns."""
    ways = [(up, world) for up in "xyz" for world in "yz" if up != world and np.array_equal(turn, up_rotation(up, world))]
    return tuple(f"turned from {up.upper()} up to {world.upper()} up" for up, world in ways)


def _overridden(pairs: dict[int, int], source: tuple[str, ...], target: tuple[str, ...], joints: Mapping[str, str]) -> dict:
    """Return the pairs after the user's overrides: a joint that they name drives what they say and nothing else."""
    for theirs, ours in joints.items():
        number = target.index(ours) if ours in target else int(ours) if ours.isdigit() else -1
        if ours and not 0 <= number < len(target):
            raise InputError(
                "a joint of the body expected", field=f"motion.joints.{theirs}", value=ours, mend=f"it has {', '.join(target)}"
            )
        if theirs in source:
            pairs = {j: i for j, i in pairs.items() if i != source.index(theirs) and j != number}
            pairs |= {number: source.index(theirs)} if ours else {}
    return dict(sorted(pairs.items()))


def _shown(motion: MotionRecord, places: np.ndarray) -> SkeletonPoses:
    """Return a motion's own skeleton, with joints at places (T, J, 3), in the frames that pictures show."""
    return SkeletonPoses(places[shown_frames(len(places))], rest_of(motion)[1], called(motion.joint_names, motion.bones))


def _alignment(motion, body, source: Limbs, target: Limbs, pairs: dict[int, int], quarter, axes) -> np.ndarray:
    """Return A of each body joint (J, 3, 3), from its rest to that of its partner, see `retarget`."""
    role = {j: word for word, j in target.roles.items()}
    align = np.broadcast_to(quarter, (len(body.parents), 3, 3)).copy()
    for j, parent in enumerate(body.parents):
        side, _, part = role.get(j, "").partition(" ")
        if parent >= 0:
            align[j] = align[parent]
        if j not in pairs or part not in {*LIMBS, "foot"}:
            continue
        end = f"{side} {LIMBS.get(part, 'toe')}"
        ours, theirs = bone(target, end, body.joints, None, j), bone(source, end, motion.joints, motion.tips, pairs[j])
        if part == "foot":
            align[j] = quarter
            if ours is not None and theirs is not None:
                align[j] = quarter @ axes @ _foot_rotation(axes.T @ ours, axes.T @ quarter.T @ theirs) @ axes.T
        elif ours is not None and theirs is not None:
            align[j] = least_turn(align[j] @ ours, theirs) @ align[j]
    return align


def _foot_rotation(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the rotation from the body's foot at rest to the source's; both directions are given as left, up, forward."""
    flat, other = ours * (1, 0, 1), theirs * (1, 0, 1)
    if np.linalg.norm(other) < 0.2 * np.linalg.norm(theirs) or np.linalg.norm(flat) == 0:
        return np.eye(3)  # straight down: the bone ends in the sole, and does not tell where the toes are
    turn = least_turn(flat, other)
    apart = least_turn(turn @ ours, theirs)
    return apart @ turn if np.trace(apart) < 1 + 2 * np.cos(np.pi / 4) else turn


def _leg_length(of: Limbs, joints: np.ndarray) -> float:
    """Return the length from hip to ankle along the bones, the mean of both sides; NaN without legs."""
    lengths = []
    for side in ("left", "right"):
        chain = [of.roles[role] for part in ("thigh", "shin", "foot") if (role := f"{side} {part}") in of.roles]
        if len(chain) == 3:
            lengths.append(np.linalg.norm(np.diff(joints[chain], axis=0), axis=1).sum())
    return float(np.mean(lengths)) if lengths else float("nan")


def _leg_ratio(rest: np.ndarray, body: BodyRecord, source: Limbs, target: Limbs) -> float:
    """Return metres on the body for a unit of the source, with joints at `rest`: by the legs, else by hips to head."""
    ours, theirs = _leg_length(target, body.joints), _leg_length(source, rest)
    if not (np.isfinite(ours) and theirs > 0):
        ours, theirs = (
            float(np.linalg.norm(x[top(a)] - x[a.roles["hips"]]))
            for x, a in ((body.joints, target), (rest, source))
        )  # fmt: skip
    if not (ours > 0 and theirs > 0):
        raise InputError("legs or a trunk to tell the unit by expected", field="motion.scale", value=0, mend="give the scale")
    return ours / theirs


def sole_heights(body: BodyRecord, target: Limbs, turns: np.ndarray, places: np.ndarray, axis: int, up) -> np.ndarray:
    """Return how high (m) the lowest sole is above where soles are at rest, frame by frame; every few frames of a long motion.

    Heights are along the world's `axis` in motion and along the body's `up` at rest.
    """
    every = slice(None, None, 1 + len(turns) // SAMPLES)
    feet = {target.roles[f"{side} foot"] for side in ("left", "right") if f"{side} foot" in target.roles}
    for j, parent in enumerate(body.parents):
        feet |= {j} if parent in feet else set()
    soles = np.flatnonzero(body.weights[:, sorted(feet)].sum(axis=1) > 0.5)
    if not len(soles):
        low = sorted(feet) or slice(None)
        return places[every, low, axis].min(axis=1) - (body.joints[low] @ up).min()
    points, heights = body.vertices[soles].astype(np.float64), np.zeros((len(turns[every]), len(soles)))
    for j in np.flatnonzero(body.weights[soles].max(axis=0) > 0).tolist():
        own = turns[every, j, axis] @ (points - body.joints[j]).T + places[every, j, axis, None]
        heights += own * body.weights[soles, j]
    return heights.min(axis=1) - (points @ up).min()


def _plain(name: str) -> str:
    """Return a joint's name without its prefix (mixamorig:), capital letters and signs."""
    return re.sub(r"[\W_]", "", name.rsplit(":", 1)[-1].lower())


def _notes(
    result: Retargeted, theirs: tuple[str, ...], shaped: tuple[str, ...], leg: float, scaled_by: str, rise: float
) -> tuple[str, ...]:
    """Describe what was done: `theirs` are the motion's joints, `shaped` the roles that only its shape tells, `leg` the
    length of its legs in its own unit, `rise` in m.
    """
    ours = result.motion.joint_names
    unlike = {o: f"{o} by {t}" for o, t in result.pairs.items() if _plain(o) != _plain(t)}
    told = f", of these by one of another name: {listed(ours, unlike)}" if unlike else ", each by the one of its name"
    notes = [f"retargeted by joint names, {len(result.pairs)} of the body's {len(ours)} joints are driven{told}"]
    if shaped:
        notes.append(f"told by the shape of the motion's skeleton, as its names do not tell them: {', '.join(shaped)}")
    if result.still:
        notes.append(f"at rest, as nothing drives them: {listed(ours, {n: n for n in result.still})}")
    if result.unused:
        notes.append(f"joints of the motion that drive nothing: {listed(theirs, {n: n for n in result.unused})}")
    unit = min(UNITS, key=lambda u: abs(np.log(leg * UNITS[u] / 0.8))) if leg > 0 else "m"
    plausible = LEG[0] < leg * UNITS[unit] < LEG[1]
    guess = f" (it seems to be in {unit})" if plausible and unit != "m" else ""
    legs = f", {scaled_by}; hip to ankle is {leg:.4g} units{guess}" if leg > 0 else f", {scaled_by}"
    notes.append(f"a unit of its lengths is {result.scale:.4g} m here{legs}")
    notes.append(f"the lowest sole is as high as at rest; in other frames the lower foot is up to {rise:.2f} m higher")
    return tuple(notes)

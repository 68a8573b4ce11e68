"""The packaged motions, made in code: footsteps on the ground, a root path, a few posture channels, and leg kinematics.

A motion is planned on a fine clock: a path with a heading, footsteps whose feet stay where they are put (heel strike
rolls about the heel, push-off about the ball, toes flat), and keyed channels for trunk and arms. Hip height follows from what
the legs can reach; hip sway, counter-rotation of the chest and swinging arms follow from the feet; thigh and shin
follow from hip and ankle. Flights are ballistic.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from make_body import ORDER
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

FPS = 30
FINE = 240  # Hz, the clock that motions are planned on
GRAVITY = 9.81  # m/s^2
REACH = 0.9955  # of the straight leg, while standing and walking
FOOT_APART = 0.08  # m, half the distance between the ankles
HANG = 18.0  # degrees between a hanging upper arm and the vertical

Keys = list[tuple[float, float]]


@dataclass
class Step:
    """One foot leaves the ground and lands."""

    side: int  # +1 left, -1 right
    off: float  # s
    on: float  # s
    lift: float = 0.05  # m, clearance at the middle of the swing
    flight: bool = False  # both feet leave together and follow a ballistic arc
    pitch: tuple[float, float] | None = None  # degrees at leaving (negative: heel up) and at landing


@dataclass
class Plan:
    """What a motion is made from; every channel is a list of keys (s, value), eased with zero speed and acceleration."""

    seconds: float
    steps: list[Step] = field(default_factory=list)
    speed: Keys = field(default_factory=lambda: [(0.0, 0.0)])  # m/s along the heading
    heading: Keys = field(default_factory=lambda: [(0.0, 0.0)])  # degrees, positive to the left
    height: list[tuple[float, float, float, float]] = field(default_factory=list)  # s, m over standing, m/s, m/s^2
    channels: dict[str, Keys] = field(default_factory=dict)  # degrees; see CHANNELS
    waves: dict[str, list[tuple[float, float, float, float]]] = field(default_factory=dict)  # start, end, degrees, Hz
    swing: float = 1.0  # how much the arms answer the feet


TRUNK = ["lean", "side", "twist", "hips_side", "hips_twist", "nod", "look"]
CHANNELS = TRUNK + [f"{move}_{key}" for move in ("abduct", "flex", "elbow", "turn") for key in ("left", "right")]


def ease(t: np.ndarray, keys: Keys) -> np.ndarray:
    """Minimum-jerk interpolation of keys; constant outside."""
    times, values = np.array(keys).T
    i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0))
    if len(times) == 1:
        return np.full_like(t, values[0])
    s = np.clip((t - times[i]) / (times[i + 1] - times[i]), 0, 1)
    return values[i] + (values[i + 1] - values[i]) * s**3 * (10 - 15 * s + 6 * s * s)


def quintic(t: np.ndarray, keys: list[tuple[float, float, float, float]]) -> np.ndarray:
    """Interpolation of (time, value, speed, acceleration): C2."""
    out = np.full_like(t, keys[0][1])
    for (t0, p0, v0, a0), (t1, p1, v1, a1) in itertools.pairwise(keys):
        h = t1 - t0
        s = np.clip((t - t0) / h, 0, 1)
        rest = np.array([p1 - p0 - v0 * h - a0 * h * h / 2, (v1 - v0 - a0 * h) * h, (a1 - a0) * h * h])
        c3, c4, c5 = np.array([[10, -4, 0.5], [-15, 7, -1], [6, -3, 0.5]]) @ rest
        out = np.where(t >= t0, p0 + v0 * h * s + a0 * h * h / 2 * s**2 + c3 * s**3 + c4 * s**4 + c5 * s**5, out)
    return out


def _smooth(x: np.ndarray, seconds: float) -> np.ndarray:
    return gaussian_filter1d(x, seconds * FINE, axis=0, mode="nearest", truncate=4)


def _rot(axis: str, degrees: np.ndarray) -> np.ndarray:
    return Rotation.from_euler(axis, np.atleast_1d(degrees)[:, None], degrees=True).as_matrix()


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def _frame(along: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Orthonormal frames (..., 3, 3) with the first column exactly `along` and the second towards `side`."""
    a = _unit(along)
    b = _unit(side - (side * a).sum(-1, keepdims=True) * a)
    return np.stack([a, b, np.cross(a, b)], -1)


class Rig:
    """The skeleton, and the foot's shape for ground contact."""

    def __init__(self, body: dict[str, np.ndarray]) -> None:
        self.joints = body["joints"].astype(float)
        self.parents = body["parents"]
        self.foot, self.toe_share, self.heel = {}, {}, {}
        for side, name in ((1, "Left"), (-1, "Right")):
            foot, toe = ORDER.index(f"{name}Foot"), ORDER.index(f"{name}ToeBase")
            weight = lambda j: (body["weights"] * (body["weight_joints"] == j)).sum(1)  # noqa: E731
            mine = (weight(foot) + weight(toe) > 0.9) & (body["vertices"][:, 1] < 0.09)
            self.foot[side] = body["vertices"][mine].astype(float)
            self.toe_share[side] = weight(toe)[mine]
            low = self.foot[side][self.foot[side][:, 1] < 0.012]
            self.heel[side] = low[np.argmin(low[:, 2])] * [1, 0, 1] + [0, 0, 0.012]

    def joint(self, name: str) -> np.ndarray:
        """Rest position."""
        return self.joints[ORDER.index(name)]

    def leg(self, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rest hip, knee, ankle and ball."""
        name = "Left" if side > 0 else "Right"
        return tuple(self.joint(name + part) for part in ("UpLeg", "Leg", "Foot", "ToeBase"))

    def foot_bottom(self, side: int, foot: np.ndarray, toe: np.ndarray) -> np.ndarray:
        """Height (T,) of the lowest point of the foot under the ankle, for foot and toe rotations (T, 3, 3)."""
        _, _, ankle, ball = self.leg(side)
        v, share = self.foot[side], self.toe_share[side][:, None]
        rigid = np.einsum("tij,vj->tvi", foot, v - ankle)
        bent = np.einsum("tij,vj->tvi", toe, v - ball) + np.einsum("tij,j->ti", foot, ball - ankle)[:, None]
        return (rigid * (1 - share) + bent * share)[..., 1].min(1)


def make_motion(plan: Plan, rig: Rig) -> dict[str, np.ndarray]:
    """Turn a plan into local rotations and root translation."""
    count = round(plan.seconds * FPS) + 1
    t = np.arange((count - 1) * (FINE // FPS) + 1) / FINE
    c = {name: ease(t, plan.channels.get(name, [(0.0, 0.0)])) for name in CHANNELS}
    for name, waves in plan.waves.items():
        for start, end, size, rate in waves:
            fade = min(0.35, (end - start) / 3)
            window = ease(t, [(start, 0), (start + fade, 1), (end - fade, 1), (end, 0)])
            c[name] = c[name] + size * window * np.sin(2 * np.pi * rate * (t - start))

    heading = ease(t, plan.heading)
    speed = ease(t, plan.speed)
    course = np.stack([np.sin(np.radians(heading)), np.zeros_like(t), np.cos(np.radians(heading))], 1)
    path = np.cumsum(speed[:, None] * course, 0) / FINE
    path -= path[0]
    across = np.stack([course[:, 2], 0 * t, -course[:, 0]], 1)  # to the character's left

    feet = {side: _foot(plan, rig, side, t, path, across, heading) for side in (1, -1)}
    load = np.zeros_like(t)  # +1: on the left foot
    for step in plan.steps:
        load -= step.side * ((t > step.off) & (t < step.on) & (not step.flight))
    load = _smooth(load, 0.085)
    stride = {side: ((feet[side]["ankle"] - path) * course).sum(1) for side in (1, -1)}
    gait = _smooth(np.clip((stride[-1] - stride[1]) / 0.62, -1.2, 1.2), 0.035)  # +1: right foot ahead
    gait_arms = _smooth(gait, 0.05) * plan.swing

    push = _smooth(np.gradient(speed, t), 0.06)
    lean = c["lean"] + 1.6 * np.clip(push, -3, 3) + 2.2 * np.clip(speed / 1.2, 0, 2.5)
    hips_yaw = 6.0 * gait + c["hips_twist"]
    hips_list = -3.5 * load + c["hips_side"]  # swing side drops
    hips_tilt = 0.45 * lean
    hips = _rot("y", heading + hips_yaw) @ _rot("z", hips_list) @ _rot("x", hips_tilt)

    root = path + across * (0.024 * load)[:, None]
    root = root + course * (-0.0011 * c["lean"])[:, None]  # leaning takes the hips back
    height = _hip_height(rig, root, hips, feet, speed)
    stand = height[0]
    if plan.height:
        arc = quintic(t, plan.height)
        start, end = plan.height[0][0], plan.height[-1][0]
        active = ease(t, [(start - 0.15, 0), (start, 1), (end, 1), (end + 0.15, 0)])
        height = height * (1 - active) + (stand + arc) * active
    root[:, 1] = height

    world = {"Hips": hips, "LHipJoint": hips, "RHipJoint": hips}
    spine_yaw = c["twist"] - 1.75 * 6.0 * gait_arms
    spine_side = c["side"] - 0.9 * hips_list
    trunk = hips
    for name, share in (("LowerBack", 0.3), ("Spine", 0.35), ("Spine1", 0.35)):
        trunk = trunk @ _rot("y", share * spine_yaw) @ _rot("z", share * spine_side) @ _rot("x", share * 0.55 * lean)
        world[name] = trunk
    level = -0.75 * lean + c["nod"]
    neck_yaw = -0.75 * (spine_yaw + hips_yaw - c["look"])
    for name, share in (("Neck", 0.35), ("Neck1", 0.3), ("Head", 0.35)):
        trunk = trunk @ _rot("y", share * neck_yaw) @ _rot("z", -share * 0.6 * c["side"]) @ _rot("x", share * level)
        world[name] = trunk
    for side in (1, -1):
        _arm(world, rig, side, c, -side * gait_arms)
        _leg(world, rig, side, root, hips, heading, feet[side])

    keep = slice(None, None, FINE // FPS)
    local = np.zeros((count, len(ORDER), 3))
    for j, name in enumerate(ORDER):
        if name not in world:
            continue
        parent = rig.parents[j]
        turn = world[name] if parent < 0 else np.swapaxes(_world(world, rig, parent), 1, 2) @ world[name]
        local[:, j] = Rotation.from_matrix(turn[keep]).as_rotvec()
    root_turn = Rotation.from_matrix(world["Hips"][keep])
    local[:, 0] = _unwrap(root_turn.as_rotvec())
    return {
        "poses": _round(local, 15),
        "trans": _round((root - rig.joints[0] * [1, 1, 1])[keep] + [0, 0, rig.joints[0, 2]], 16),
        "fps": np.float32(FPS),
        "joint_names": np.array(ORDER),
    }


def _world(world: dict[str, np.ndarray], rig: Rig, joint: int) -> np.ndarray:
    while ORDER[joint] not in world:
        joint = rig.parents[joint]
    return world[ORDER[joint]]


def _unwrap(vectors: np.ndarray) -> np.ndarray:
    """Axis-angle without jumps from pi to -pi."""
    out = vectors.copy()
    for i in range(1, len(out)):
        angle = np.linalg.norm(out[i])
        if angle > 1e-9:
            options = [out[i] * (1 + 2 * np.pi * k / angle) for k in (-1, 0, 1)]
            out[i] = min(options, key=lambda o: np.linalg.norm(o - out[i - 1]))
    return out


def _round(x: np.ndarray, bits: int) -> np.ndarray:
    return (np.round(x * 2.0**bits) / 2.0**bits).astype(np.float32)


def _foot(plan: Plan, rig: Rig, side: int, t: np.ndarray, path: np.ndarray, across: np.ndarray, heading: np.ndarray) -> dict:
    """Ankle position (T, 3), foot rotation and toe rotation (T, 3, 3) of one foot."""
    _, _, ankle, ball = rig.leg(side)
    steps = sorted((s for s in plan.steps if s.side == side), key=lambda s: s.off)
    turning = np.gradient(heading, t)
    place, turn = [(path[0] + side * FOOT_APART * across[0])], [heading[0]]
    for i, s in enumerate(steps):
        leave = steps[i + 1].off if i + 1 < len(steps) else s.on + (s.on - s.off) * 1.5
        middle = s.on if s.flight else s.on + min(0.42 * (leave - s.on), 0.6)
        k = min(int(middle * FINE), len(t) - 1)
        apart = FOOT_APART + min(0.055, 0.0005 * abs(turning[k]))
        place.append(path[k] + side * apart * across[k])
        turn.append(heading[k])
    length = [np.linalg.norm(b - a) for a, b in itertools.pairwise(place)]

    pitch, bend = [(-1.0, 0.0)], [(-1.0, 1.0)]
    for s, reach in zip(steps, length, strict=True):
        size = min(1.0, reach / 1.05)
        off, on = s.pitch or (-52 * size - 6, 18 * size)
        span = s.on - s.off
        rise = 0.25 if s.flight else 0.30
        pitch += [(max(s.off - rise, pitch[-1][0] + 0.02), 0), (s.off - 0.45 * rise, 0.48 * off), (s.off + 0.02, off)]
        bend += [(max(s.off - rise, bend[-1][0] + 0.02), 1.0), (s.off + 0.02, 0.97)]
        if s.flight:
            pitch += [(s.off + 0.5 * span, 0.75 * off), (s.on, on), (s.on + 0.12, 0)]
            bend += [(s.off + 0.3 * span, 0.1), (s.on - 0.08, 0.3), (s.on, 1.0), (s.on + 0.12, 1.0)]
        else:
            pitch += [(s.off + 0.45 * span, 0.25 * off), (s.off + 0.8 * span, on), (s.on, on), (s.on + 0.22 * span, 0)]
            bend += [(s.off + 0.4 * span, 0.15), (s.off + 0.8 * span, 0.1), (s.on, 1.0)]
    pitch.append((t[-1] + 2, 0.0))
    bend.append((t[-1] + 2, 1.0))
    pitch_t = _smooth(PchipInterpolator(*np.array(pitch).T)(t), 0.012)
    bend_t = _smooth(PchipInterpolator(*np.array(bend).T)(t), 0.012) * np.minimum(pitch_t, 0)

    turns = [(-1.0, turn[0])]
    for s, a, b in zip(steps, turn[:-1], turn[1:], strict=True):
        turns += [(s.off, a), (s.on, b)]
    yaw = ease(t, turns)
    foot = _rot("y", yaw) @ _rot("x", -pitch_t)
    toe = foot @ _rot("x", bend_t)

    ball0, heel0 = ball * [1, 0, 1] + [0, 0.012, 0], rig.heel[side]
    relative = {"ball": ball0 - ankle, "heel": heel0 - ankle}
    flat = _rot("y", yaw)

    def standing(at: np.ndarray) -> np.ndarray:
        """Ankle while a foot stands at a place, rolling about ball or heel."""
        out = np.empty((len(t), 3))
        for name, mask in (("ball", pitch_t <= 0), ("heel", pitch_t > 0)):
            contact = at + np.einsum("tij,j->ti", flat, relative[name])
            out[mask] = (contact - np.einsum("tij,j->ti", foot, relative[name]))[mask]
        return out

    position = standing(place[0])
    lift = np.zeros_like(t)
    for i, s in enumerate(steps):
        before, after = position, standing(place[i + 1])
        a, b = round(s.off * FINE), min(round(s.on * FINE), len(t) - 1)
        if a >= len(t):
            break
        u = slice(a, b + 1)
        if s.flight:
            lift[u] = GRAVITY / 2 * (t[u] - s.off) * (s.on - t[u])
        else:
            r = np.clip((t[u] - s.off) / (s.on - s.off), 0, 1)
            lift[u] = s.lift * np.sin(np.pi * r) ** 1.4 * (1.25 - 0.5 * r)
        speed0 = (before[a] - before[max(a - 2, 0)]) * FINE / 2
        speed1 = (after[min(b + 2, len(t) - 1)] - after[b]) * FINE / 2
        swing = np.stack(
            [quintic(t[u], [(s.off, before[a, k], speed0[k], 0), (s.on, after[b, k], speed1[k], 0)]) for k in range(3)], 1
        )
        veer = min(1.0, abs(turn[i + 1] - turn[i]) / 45)  # round the standing leg in a turn
        swing += side * 0.06 * veer * np.sin(np.pi * np.clip((t[u] - s.off) / (s.on - s.off), 0, 1))[:, None] ** 2 * across[u]
        position = np.concatenate([position[:a], swing, after[b + 1 :]])
    position[:, 1] = lift - rig.foot_bottom(side, foot, toe)
    position[:, 1] = np.where(lift > 0, _smooth(position[:, 1], 0.008), position[:, 1])
    return {"ankle": position, "foot": foot, "toe": toe, "yaw": yaw, "lift": lift}


def _hip_height(rig: Rig, root: np.ndarray, hips: np.ndarray, feet: dict, speed: np.ndarray) -> np.ndarray:
    """The highest smooth root height (T,) that both legs can reach."""
    allowed = []
    for side in (1, -1):
        hip, knee, ankle, _ = rig.leg(side)
        length = REACH * (np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee))
        offset = np.einsum("tij,j->ti", hips, hip - rig.joints[0])
        gap = root + offset - feet[side]["ankle"]
        flat = np.minimum(gap[:, 0] ** 2 + gap[:, 2] ** 2, (0.9 * length) ** 2)
        allowed.append(feet[side]["ankle"][:, 1] + np.sqrt(length**2 - flat) - offset[:, 1])
    a, b = allowed
    low = np.minimum(a, b)
    smooth = _smooth(low, 0.05)
    smooth = smooth - 0.010 * np.clip(speed, 0, 1)
    for _ in range(20):
        excess = np.maximum(smooth - low, 0)
        if excess.max() < 5e-4:
            break
        smooth = smooth - 1.3 * _smooth(excess, 0.05)
    return smooth


def _leg(world: dict, rig: Rig, side: int, root: np.ndarray, hips: np.ndarray, heading: np.ndarray, foot: dict) -> None:
    """Thigh and shin from hip and ankle, knee ahead."""
    hip0, knee0, ankle0, _ = rig.leg(side)
    name = "Left" if side > 0 else "Right"
    l1, l2 = np.linalg.norm(knee0 - hip0), np.linalg.norm(ankle0 - knee0)
    hip = root + np.einsum("tij,j->ti", hips, hip0 - rig.joints[0])
    gap = foot["ankle"] - hip
    length = np.linalg.norm(gap, axis=1)
    reach = np.minimum(length, 0.9997 * (l1 + l2))
    down = gap / length[:, None]
    toward = 0.5 * hips[:, :, 2] + 0.5 * _rot("y", foot["yaw"] + side * 5)[:, :, 2]
    ahead = _unit(toward - (toward * down).sum(1, keepdims=True) * down)
    cosine = np.clip((l1**2 + reach**2 - l2**2) / (2 * l1 * reach), -1, 1)
    thigh = cosine[:, None] * down + np.sqrt(1 - cosine**2)[:, None] * ahead
    shin = _unit(reach[:, None] * down - l1 * thigh)
    hinge = np.cross(-down, ahead)
    rest = np.cross(-_unit(ankle0 - hip0), _unit(np.array([side * 0.08, 0, 1])))
    world[f"{name}UpLeg"] = _frame(thigh, hinge) @ _frame(knee0 - hip0, rest).T
    world[f"{name}Leg"] = _frame(shin, hinge) @ _frame(ankle0 - knee0, rest).T
    world[f"{name}Foot"] = foot["foot"]
    world[f"{name}ToeBase"] = foot["toe"]


def _arm(world: dict, rig: Rig, side: int, c: dict[str, np.ndarray], swing: np.ndarray) -> None:
    """Collar bone, upper arm and forearm; `swing` is +1 with the arm at the front of its walking swing."""
    name = "Left" if side > 0 else "Right"
    key = "left" if side > 0 else "right"
    shoulder, elbow, hand = rig.joint(f"{name}Arm"), rig.joint(f"{name}ForeArm"), rig.joint(f"{name}Hand")
    upper, fore = _unit(elbow - shoulder), _unit(hand - elbow)
    hinge = _unit(np.cross(upper, fore))
    rest_elbow = np.degrees(np.arctan2(np.linalg.norm(np.cross(upper, fore)), upper @ fore))
    rest_abduction = np.degrees(np.arctan2(abs(upper[0]), -upper[1]))

    abduct = HANG + c[f"abduct_{key}"]
    flex = 3 + 20 * swing + c[f"flex_{key}"]
    bend = 16 + 9 * swing + c[f"elbow_{key}"]
    inward = 10 + c[f"turn_{key}"]
    raised = abduct - rest_abduction
    collar = np.where(raised > 0, 0.26 * raised, 0.10 * raised)
    collar = _smooth(collar, 0.03) + 0.08 * np.clip(flex - 60, 0, None)
    chest = world["Spine1"]
    world[f"{name}Shoulder"] = chest @ _rot("z", side * collar) @ _rot("y", -side * 0.10 * np.clip(flex, -30, 90))
    down = _frame(np.array([0.0, -1.0, 0.0]), np.array([-1.0, 0.0, 0.0]))
    pose = _rot("x", -flex) @ _rot("z", side * abduct) @ _rot("y", -side * inward)
    world[f"{name}Arm"] = chest @ pose @ (down @ _frame(upper, hinge).T)
    turn = Rotation.from_rotvec(np.radians(bend - rest_elbow)[:, None] * hinge).as_matrix()
    world[f"{name}ForeArm"] = world[f"{name}Arm"] @ turn


def walking(start: float, count: int, pace: float, first: int = 1, swing: float = 0.78) -> list[Step]:
    """Alternate steps, one every `pace` seconds."""
    return [Step(first * (-1) ** k, start + k * pace, start + (k + swing) * pace) for k in range(count)]


def jump(at: float, up: float) -> tuple[list[Step], list[tuple[float, float, float, float]], dict[str, Keys]]:
    """A standing jump: crouch from `at`, take off 0.8 s later, rise by `up` metres."""
    v = np.sqrt(2 * GRAVITY * up)
    tall, reach = 0.068, 0.045  # m over standing, at take-off and on landing
    down = np.sqrt(v**2 + 2 * GRAVITY * (tall - reach))
    off = at + 0.8
    on = off + (v + down) / GRAVITY
    steps = [Step(side, off, on, flight=True, pitch=(-52, -30)) for side in (1, -1)]
    height = [
        (at, 0, 0, 0),
        (off - 0.27, -0.23, 0, 9.0),
        (off, tall, v, -GRAVITY),
        (on, reach, -down, -GRAVITY),
        (on + 0.24, -0.20, 0, 4.0),
        (on + 1.0, 0, 0, 0),
    ]
    arms = [(at, 0), (off - 0.38, -34), (off + 0.14, 88), (on + 0.28, 8), (on + 0.9, 0)]
    elbows = [(at, 0), (off - 0.38, 8), (off + 0.14, 38), (on + 0.28, 24), (on + 0.9, 0)]
    wide = [(at, 0), (off - 0.38, 8), (off + 0.14, 16), (on, 26), (on + 0.35, 14), (on + 0.9, 0)]
    lean = [(at, 0), (off - 0.25, 42), (off + 0.02, 2), (on - 0.05, 8), (on + 0.25, 36), (on + 0.95, 0)]
    channels = {"lean": lean}
    for key in ("left", "right"):
        channels |= {f"flex_{key}": arms, f"elbow_{key}": elbows, f"abduct_{key}": wide}
    return steps, height, channels


def _both(name: str, keys: Keys) -> dict[str, Keys]:
    return {f"{name}_left": keys, f"{name}_right": keys}


def _raised(abduct: Keys) -> dict[str, Keys]:
    """An arm turns outward as it is lifted: the shoulder would not let it pass otherwise."""
    return _both("turn", [(at, -0.35 * angle) for at, angle in abduct])


def plans() -> dict[str, Plan]:
    """All packaged motions."""
    out = {}
    out["stand"] = Plan(4.0, waves={"hips_side": [(0.3, 3.7, 1.2, 0.3)], "lean": [(0.3, 3.7, 1.5, 0.3)]})
    out["walk"] = Plan(6.5, walking(0.5, 12, 0.5), speed=[(0.35, 0), (1.35, 1.1)])
    out["walk_turn_stop"] = Plan(
        10.0,  # the last 4 s at rest, as a skirt swings for two
        walking(0.5, 10, 0.5),
        speed=[(0.35, 0), (1.25, 1.1), (1.75, 1.1), (2.45, 0.65), (3.65, 0.65), (4.35, 1.1), (4.9, 1.1), (5.3, 0)],
        heading=[(1.85, 0), (4.25, 180)],
    )
    steps, height, channels = jump(0.5, 0.26)
    out["jump"] = Plan(4.5, steps, height=height, channels=channels)
    out["twist"] = Plan(
        6.0,
        waves={"twist": [(0.4, 3.9, 38, 0.9)], "hips_twist": [(0.4, 3.9, 12, 0.9)]},
        channels={
            **_both("abduct", [(0.1, 0), (0.9, 28), (3.6, 28), (4.4, 0)]),
            **_both("elbow", [(0.1, 0), (0.9, 25), (3.6, 25), (4.4, 0)]),
        },
    )
    lift = [(0.4, 0), (1.6, 138), (2.1, 138), (3.2, 0), (3.6, 0), (4.4, 138), (4.7, 138), (5.6, 0)]
    out["lift_arms"] = Plan(6.5, channels=_both("abduct", lift) | _raised(lift), waves={"twist": [(3.7, 5.6, 25, 1.1)]})
    out["dance"] = _dance()
    out["mixed"] = _mixed()
    return out


def _dance() -> Plan:
    steps = walking(0.5, 4, 0.5) + walking(2.5, 10, 0.31) + walking(5.8, 2, 0.5)
    return Plan(
        7.5,
        steps,
        heading=[(2.4, 0), (5.6, 360)],
        waves={
            "hips_side": [(0.3, 2.7, 6, 1.0), (5.4, 7.1, 6, 1.0)],
            "twist": [(0.3, 2.7, 14, 1.0), (5.4, 7.1, 14, 1.0)],
            "side": [(0.3, 2.7, -6, 1.0)],
            "flex_left": [(0.3, 2.7, 18, 1.0)],
            "flex_right": [(0.3, 2.7, -18, 1.0)],
        },
        channels=_both("abduct", [(0.2, 0), (1.0, 22), (2.4, 22), (3.2, 68), (4.9, 68), (5.7, 30), (6.6, 20), (7.2, 0)])
        | _both("elbow", [(0.2, 0), (1.0, 45), (2.4, 45), (3.2, 18), (4.9, 18), (5.7, 50), (6.6, 35), (7.2, 0)]),
        swing=0.3,
    )


def _mixed() -> Plan:
    steps, height, channels = jump(4.1, 0.2)
    lift = [(6.1, 0), (6.9, 120), (7.1, 120), (7.9, 0)]
    arms = channels | {f"abduct_{key}": [*channels[f"abduct_{key}"], *lift] for key in ("left", "right")} | _raised(lift)
    return Plan(
        8.0,
        walking(0.45, 7, 0.48) + steps,
        speed=[(0.3, 0), (1.05, 1.1), (3.0, 1.0), (3.4, 0)],
        heading=[(1.3, 0), (3.0, -100)],
        height=height,
        channels=arms,
        waves={"twist": [(6.1, 7.9, 25, 1.1)]},
    )


def make_motions(body: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """All motions by file name."""
    rig = Rig(body)
    return {name: make_motion(plan, rig) for name, plan in plans().items()}

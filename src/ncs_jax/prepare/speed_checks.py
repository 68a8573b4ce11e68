"""What is too fast in a motion for what a scene models: glitches, by their frames, throws and spins beyond a swing's range."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from ncs_jax.errors import required
from ncs_jax.geometry.skinning import Blend
from ncs_jax.io import MotionRecord
from ncs_jax.prepare.posing import joint_transforms, world_axes
from ncs_jax.prepare.setting import Setting
from ncs_jax.scene.motion_names import split_frames

__all__ = ["flung", "frame_jumps", "frames_named", "good_stretches", "speed_faults", "thrown"]

JUMP = 0.3  # m by which the root or skin may leave its path within a frame: the thickness of a limb
TURN = 90.0  # degrees within a frame
THROWN = 1.0  # of a garment's length, by which leaps and lunges throw it, and walks, runs and most dances (0.93) do not
FLUNG = 4.0  # of its length, off the turning body, by which flips and pirouettes fling it, and most dances (2.8) do not
SEEN = 100  # points of the garment and of the body that are looked at
NAMED = 5  # frames, and stretches, that are named


class _Fault(NamedTuple):
    """Frames (T,) that are at fault, and what a risk says: what, how much and where, what that does, and what mends it."""

    frames: np.ndarray
    words: tuple[str, str, str, str]


def speed_faults(a: Setting, name: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield what is too fast in a motion, how much and in which frames, what that does, and what mends it."""
    record = a.motions[name]
    faults = [fault for fault in (_jumps(a, name, record), _turns(a, name, record), _throws(a, name, record)) if fault]
    good = good_stretches(name, record, np.any([fault.frames for fault in faults], axis=0)) if faults else ()
    for number, (what, value, risk, mend) in enumerate(fault.words for fault in faults):
        yield what, value, risk, f"{mend}; good stretches of it: {', '.join(good)}" if good and not number else mend


def good_stretches(name: str, record: MotionRecord, bad: np.ndarray) -> list[str]:
    """Return the longest stretches of a second or more without a bad frame (T,), in their order, as a scene names them."""
    starts, stops = (np.flatnonzero(np.diff(np.concatenate([[True], bad, [True]]).astype(int)) == way) for way in (-1, 1))
    long = [k for k in np.argsort(starts - stops, kind="stable")[:NAMED] if stops[k] - starts[k] >= record.fps]
    file, (first, each) = split_frames(name)[0], record.origin
    ends = [(first + ceil(starts[k] * each), first + int((stops[k] - 1) * each) + 1) for k in sorted(long)]
    return [f"{file}[{start}:{'' if start < 0 <= stop else stop}]" for start, stop in ends]  # below 0 they count from the end


def _throws(a: Setting, name: str, record: MotionRecord) -> _Fault | None:
    """Return the fault where the garment is thrown farther than a swing's linear range."""
    scene = a.scene
    if a.body is None or not (scene.network.method == "ncs" and scene.network.cell == "swing" and scene.physics.inertia):
        return None
    mesh, gravity = a.model.garment.mesh, np.array(scene.physics.gravity)
    rest, mass = np.asarray(mesh.rest, np.float64), np.asarray(mesh.vertex_area, np.float64)
    some = _some(len(rest))
    path = _paths(a, record, rest[some], a.model.blend, some)
    up = np.abs(gravity).argmax()
    hung = mass[some], record.fps, gravity, float(np.ptp(rest[:, up])), scene.network.damping
    aside, off = thrown(path, *hung), flung(path, *hung)
    bad, values = (aside > THROWN) | (off > FLUNG), []
    if aside.max() > THROWN:
        values += [f"thrown aside by {aside.max():.2f} of its length in {name}, {frames_named(aside, THROWN, record.origin)}"]
    if (off := np.where(aside > THROWN, 0, off)).max() > FLUNG:
        value = f"flung off the turning body by {off.max():.1f} of its length"
        values += [f"{value} in {name}, {frames_named(off, FLUNG, record.origin)}"]
    if not values:
        return None
    risk = "the swing is shortened to its linear range: it lags, and cloth is stretched"
    mend = "slow or smooth the motion there, or leave the frames out"
    return _Fault(bad, ("fast motion", f"the garment {'; '.join(values)}", risk, mend))


def thrown(path: np.ndarray, mass: np.ndarray, fps: float, gravity: np.ndarray, length: float, damping: float) -> np.ndarray:
    """Return how far a motion throws a garment aside in every frame, r.m.s. over it, in its own lengths L.

        q'' + c q' + (g / L) q = -a_t,   sqrt(mean |q|^2) / L

    It is what a pendulum of the garment's length does, by implicit Euler from rest, that is hung up where the body carries each
    point. a_t is that point's acceleration across gravity: what is along it stretches cloth, and does not swing it.

    Args:
        path: (frames, points, 3) as the body carries the garment, m. mass: (points,). damping: c, 1/s.
    """
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-30)
    push = _push(path, fps)
    return _swung(push - (push @ down)[..., None] * down, mass, fps, gravity, length, damping)


def flung(path: np.ndarray, mass: np.ndarray, fps: float, gravity: np.ndarray, length: float, damping: float) -> np.ndarray:
    """Return how far a motion flings a garment off the body that turns, r.m.s. over it in every frame, in its own lengths L.

        q'' + c q' + (g / L) q = R^T (-a)_t,   sqrt(mean |q|^2) / L

    It is the pendulum of `thrown`, but it turns with the body. Seen from there, a spin pushes outward for long, and its start
    and stop push along the turn. R is the rotation of the garment's points as a whole since the first frame. The pendulum hangs
    along R g, as in a flip cloth has no time to fall: what pushes along R g stretches it. In an even spin at r from the axis it
    comes to r omega^2 / g, the tangent of the angle at which a conical pendulum flies. Without turns it is `thrown`. Left out
    are Coriolis' acceleration, and that the centrifugal one grows as cloth flies out.

    Args:
        as of `thrown`.
    """
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-30)
    push = np.einsum("tba,tpb->tpa", _turned(path, mass), _push(path, fps))
    return _swung(push - (push @ down)[..., None] * down, mass, fps, gravity, length, damping)


def _push(path: np.ndarray, fps: float) -> np.ndarray:
    """Return what pushes a thing that a path (frames, points, 3) holds: less the path's acceleration, m/s^2."""
    begun = np.concatenate([path[:1], path[:1], path])
    return -(begun[2:] - 2 * begun[1:-1] + begun[:-2]) * fps**2


def _turned(path: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return the rotation (frames, 3, 3) of points as a whole since the first frame; about no axis on which all of them lie."""
    own = path - np.average(path, axis=1, weights=mass)[:, None]
    size = np.sum(mass[:, None] * own[0] ** 2)
    left, _, right = np.linalg.svd(np.einsum("tpa,pb->tab", own, mass[:, None] * own[0]) + 1e-9 * (size or 1.0) * np.eye(3))
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def _swung(push: np.ndarray, mass: np.ndarray, fps: float, gravity: np.ndarray, length: float, damping: float) -> np.ndarray:
    """Return how far a push (frames, points, 3) swings a pendulum, r.m.s. (frames,), in its lengths; by implicit Euler."""
    pull = float(np.linalg.norm(gravity))
    if not pull or not length:
        return np.zeros(len(push))
    h, square = 1 / fps, pull / length
    q, rate, far = np.zeros(push.shape[1:]), np.zeros(push.shape[1:]), np.zeros(len(push))
    for t, force in enumerate(push):
        rate = (rate + h * (force - square * q)) / (1 + h * damping + h * h * square)
        q = q + h * rate
        far[t] = np.sqrt(np.average(np.sum(q * q, axis=-1), weights=mass)) / length
    return far


def frames_named(size: np.ndarray, limit: float, origin: tuple[int, float] = (0, 1.0)) -> str:
    """Return as words in which frames a size (frames,) is beyond its limit: where the worst stretch begins, then the others.

    `origin`: of the motion, so that they are the file's frames.
    """
    bad = size > limit
    first = np.flatnonzero(bad & ~np.concatenate([[False], bad[:-1]]))
    worst = int(first[first <= size.argmax()][-1])
    others = [str(origin[0] + round(frame * origin[1])) for frame in first if frame != worst]
    more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
    return f"frame {origin[0] + round(worst * origin[1])}" + (f", also {', '.join(others[:NAMED])}{more}" if others else "")


def _jumps(a: Setting, name: str, record: MotionRecord) -> _Fault | None:
    """Return the fault where the root, or skin that the garment can touch, leaves its straight path within a frame."""
    path = record.translation.astype(np.float64)[:, None]
    if a.body is not None and a.model.body is not None:
        skin = np.asarray(a.model.body, np.float64)
        some = _some(len(skin))
        path = np.concatenate(
            [path, _paths(a, record, skin[some], required(a.model.body_blend, "model.body_blend"), some)], axis=1
        )
    begun = np.concatenate([path[:1], path[:1], path])
    away = np.linalg.norm(begun[2:] - 2 * begun[1:-1] + begun[:-2], axis=-1).max(axis=1)
    if not away.max() > JUMP:
        return None
    value = f"{away.max():.2f} m in {name}, {frames_named(away, JUMP, record.origin)}"
    risk = "the cloth is left behind, then torn along"
    return _Fault(away > JUMP, ("jump within a frame", value, risk, "clean or cut the motion there"))


def _turns(a: Setting, name: str, record: MotionRecord) -> _Fault | None:
    """Return the fault where a joint that carries the garment turns too far within a frame."""
    from scipy.spatial.transform import Rotation

    model = a.model
    axes = None if model.rest_rotations is None else np.asarray(model.rest_rotations, np.float64)
    local = world_axes(record.poses[:, list(model.source_joints)], axes)
    if len(local) < 2:
        return None
    turns = np.matmul(local[1:], np.swapaxes(local[:-1], -1, -2))
    turn = np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()).reshape(turns.shape[:2])
    if not turn.max() > TURN:
        return None
    number = model.source_joints[int(turn.max(axis=0).argmax())]
    label = a.body.joint_names[number] if a.body is not None and a.body.joint_names else str(number)
    size = np.concatenate([[0], turn.max(axis=1)])
    value = f"{turn.max():.0f} degrees in {name}, {frames_named(size, TURN, record.origin)}, joint {label}"
    return _Fault(size > TURN, ("turn within a frame", value, "a limb passes through cloth", "clean or cut the motion there"))


def frame_jumps(a: Setting) -> Iterator[tuple[str, str, str, str]]:
    """Yield what of a moving mesh leaves its path within a frame, as `speed_faults` does of a motion."""
    frames = required(required(a.body, "body").frames, "body.frames")
    path = frames[:, _some(frames.shape[1])].astype(np.float64)
    begun = np.concatenate([path[:1], path[:1], path])
    away = np.linalg.norm(begun[2:] - 2 * begun[1:-1] + begun[:-2], axis=-1).max(axis=1)
    if away.max() > JUMP:
        value = f"{away.max():.2f} m, {frames_named(away, JUMP)} at {a.model.fps:g} per second"
        yield "jump of the body within a frame", value, "the cloth is left behind, then torn along", "mend the frames there"


def _some(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, SEEN).round().astype(int))


def _paths(a: Setting, record: MotionRecord, rest: np.ndarray, weights: Blend, some: Sequence[int] | np.ndarray) -> np.ndarray:
    """Return where some vertices, at rest at `rest`, are in every frame (frames, points, 3), m, as the body carries them."""
    transforms = joint_transforms(required(a.body, "body"), record.poses)[:, list(a.model.source_joints)][
        :, list(weights.joints)
    ]
    blended = np.einsum("vj,tjab->tvab", np.asarray(weights.weights, np.float64)[some], transforms, optimize=True)
    return np.einsum("tvab,vb->tva", blended[..., :3], rest) + blended[..., 3] + record.translation.astype(np.float64)[:, None]

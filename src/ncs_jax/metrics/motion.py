"""How a garment moves: as seen from the body that carries it, after a stop, and beside a reference such as a simulation."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.geometry.skinning import blend, unpose
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_rest

__all__ = ["MEASURES", "carried", "compare_dynamics", "compare_motion", "hem", "measure_motion", "stops", "unposed"]

# name: unit and what it is
MEASURES = {
    "speed": ("mm/s", "r.m.s. speed of the garment as seen from the body"),
    "lag": ("s", "how far the hem comes after the body that carries it"),
    "settling": ("s", "after a stop, until the hem's speed is down to a tenth; mean over the stops"),
    "overshoot": ("%", "after a stop, how far the hem goes beyond rest, of its way there; mean over the stops"),
    "gain": ("", "speed over that with alpha = 0"),
    "dynamic_share": ("", "speed over that of the reference"),
    "stopped_share": ("", "the same of the frames after a stop"),
    "hem_correlation": ("", "of the hem's path as seen from the body with the reference's"),
    "distance": ("mm", "mean distance of the vertices to those of the reference"),
    "static_distance": ("mm", "the same of alpha = 0 to the reference without inertia"),
    "dynamic_correlation": ("", "of what alpha = 1 adds to alpha = 0 with what inertia adds to the reference"),
    "dynamic_factor": ("", "by which that is to be multiplied to come nearest: below 1 it is too large, above too small"),
}

HEM = 0.045  # of the vertices, the lowest ones
STILL = 0.5  # s without motion make a stop
SETTLED = 0.1
FARTHEST = 0.5  # s of lag that are looked at


@jax.jit
def _unposed(model: Model, vertices, matrices):
    return jax.lax.map(lambda frame: unpose(blend(frame[1], model.blend), frame[0]), (vertices, matrices))


def unposed(model: Model, vertices, track: MotionFeatures) -> Float[np.ndarray, "frames verts 3"]:
    """Return the garment as seen from the body: the inverse of each vertex's blended transform applied to it, m."""
    return np.asarray(_unposed(model, jnp.asarray(track.relative(vertices), model.basis.dtype), track.matrices))


@jax.jit
def carried(model: Model, matrices: Float[Array, "frames joints 3 4"]) -> Float[Array, "frames verts 3"]:
    """Return the garment in many frames as the body alone carries it, m."""
    return jax.lax.map(lambda m: pose_rest(model, m), matrices)


def hem(model: Model) -> np.ndarray:
    """Return the numbers of the lowest rest vertices, at least one: where a garment swings most."""
    down = np.asarray(model.material.gravity, np.float64)
    down = down if np.linalg.norm(down) > 0 else np.array([0.0, -1.0, 0.0])
    height = -np.asarray(model.garment.mesh.rest, np.float64) @ down
    return np.argsort(height, kind="stable")[: max(1, round(HEM * len(height)))]


def stops(track: MotionFeatures, model: Model) -> Iterator[tuple[int, int]]:
    """Return (first still frame, one past the last) wherever the character has moved and then does not for `STILL` seconds."""
    fps, joints = model.fps, len(model.skeleton.parents)  # what is worn below may go on moving
    matrices, start = np.asarray(track.matrices[:, :joints], np.float64), np.asarray(track.start)
    moved = np.abs(np.diff(matrices, axis=0)).reshape(len(matrices) - 1, -1).max(axis=1, initial=0) > 1e-6
    moving = np.concatenate([[False], moved & (start[1:] == start[:-1])])
    frame = 0
    while frame < len(start):
        last = frame + 1
        while last < len(start) and start[last] == start[frame] and not moving[last]:
            last += 1
        if moving[frame] and last - frame - 1 >= STILL * fps:
            yield frame + 1, last
        frame = last


def _speed(u: np.ndarray, track: MotionFeatures, fps: float, at=slice(None)) -> float:
    """R.m.s. speed, mm/s, without the steps from one motion to the next."""
    start = np.asarray(track.start)
    within = np.concatenate([[False], start[1:] == start[:-1]])[at]
    steps = np.diff(u, axis=0, prepend=u[:1])[at][within]
    return 1000 * fps * float(np.sqrt(np.mean(np.sum(steps.astype(np.float64) ** 2, axis=-1)))) if len(steps) else 0.0


def _after(path: np.ndarray, fps: float) -> tuple[float | None, float]:
    """Of a path (frames, 3) after a stop: settling time in s, None where it does not come to rest, and overshoot in %.

    Settled is what has but a hundredth of sum_(s >= 0) |v_s|^2 to come: where a swing decays by exp(-t / T), that is after
    T ln 10, which brings it to a tenth. Such a sum from the end has no steps where single swings leave a band or do not, and
    does not ask where rest is. The last half second may hold a tenth of that hundredth. Source: Schroeder 1965, reverberation.
    """
    away = path - path[-1]
    size = float(np.linalg.norm(away[0]))
    overshoot = 100 * max(float((-(away @ away[0])).max()) / size**2, 0.0) if size > 0 else 0.0
    left = np.cumsum(np.sum(np.diff(path, axis=0) ** 2, axis=1)[::-1])[::-1]
    if left[0] == 0:
        return 0.0, overshoot
    if left[-round(STILL * fps)] > SETTLED**2 / 10 * left[0]:
        return None, overshoot
    return float(np.argmax(left <= SETTLED**2 * left[0])) / fps, overshoot


def _lag(follows: np.ndarray, leads: np.ndarray, fps: float) -> float:
    """By how many seconds one path (frames, 3) comes after another: where their velocities correlate best."""
    a, b = (np.diff(path, axis=0) - np.diff(path, axis=0).mean(axis=0) for path in (follows, leads))
    most = min(round(FARTHEST * fps), len(a) - 2)
    if most < 1:
        return 0.0
    shifts = range(-most, most + 1)
    pairs = [(a[max(k, 0) : len(a) + min(k, 0)], b[max(-k, 0) : len(b) + min(-k, 0)]) for k in shifts]
    sizes = [np.sqrt(np.sum(p**2) * np.sum(q**2)) for p, q in pairs]
    likeness = np.array([np.sum(p * q) / size if size > 0 else 0.0 for (p, q), size in zip(pairs, sizes, strict=True)])
    best = int(likeness.argmax())
    between = 0.0
    if 0 < best < len(likeness) - 1:
        low, top, high = likeness[best - 1 : best + 2]
        curve = low - 2 * top + high
        between = 0.5 * (low - high) / curve if curve < 0 else 0.0
    return float(shifts[best] + between) / fps


def measure_motion(model: Model, vertices, track: MotionFeatures) -> dict[str, float]:
    """Measure how an animation (frames, verts, 3) of the model's garment moves by itself: the first four of `MEASURES`.

    `settling` and `overshoot` are left out where the character never stops for half a second, and `settling` also where the
    hem does not come to rest after any stop.
    """
    u, low, fps = unposed(model, vertices, track), hem(model), model.fps
    under = np.asarray(carried(model, track.matrices), np.float64)[:, low].mean(axis=1)
    path = track.relative(vertices).astype(np.float64)[:, low].mean(axis=1)
    found = {"speed": _speed(u, track, fps), "lag": _lag(path, under, fps)}
    after = [_after(u[first - 1 : last, low].astype(np.float64).mean(axis=1), fps) for first, last in stops(track, model)]
    if after:
        times = [time for time, _ in after if time is not None]
        if times:
            found["settling"] = float(np.mean(times))
        found["overshoot"] = float(np.mean([overshoot for _, overshoot in after]))
    return found


def compare_motion(model: Model, vertices, reference, track: MotionFeatures) -> dict[str, float]:
    """Compare an animation (frames, verts, 3) with another of the same garment and motion: `dynamic_share` to `distance`."""
    u, other = unposed(model, vertices, track), unposed(model, reference, track)
    fps, low = model.fps, hem(model)

    def share(at=slice(None)):
        theirs = _speed(other, track, fps, at)
        return _speed(u, track, fps, at) / theirs if theirs > 0 else float("nan")

    paths = [v[:, low].astype(np.float64).mean(axis=1) for v in (u, other)]
    a, b = ((path - path.mean(axis=0)).ravel() for path in paths)
    size = np.linalg.norm(a) * np.linalg.norm(b)
    found = {"dynamic_share": share()}
    still = [np.arange(first, last) for first, last in stops(track, model)]
    if still:
        found["stopped_share"] = share(np.concatenate(still))
    found["hem_correlation"] = float(a @ b / size) if size > 0 else float("nan")
    apart = np.asarray(vertices, np.float64) - np.asarray(reference, np.float64)
    found["distance"] = 1000 * float(np.linalg.norm(apart, axis=-1).mean())
    return found


def compare_dynamics(moving, still, reference, static_reference) -> dict[str, float]:
    """Compare both parts of an animation with those of a simulation of the same motion: the last three of `MEASURES`.

        D = x(alpha = 1) - x(alpha = 0),  R = x_dynamic - x_static:   correlation D . R / (|D| |R|),  factor D . R / |D|^2

    Args:
        moving, still: (frames, verts, 3) in m of alpha = 1 and of alpha = 0. reference, static_reference: simulated with
            inertia and without, where every frame is the equilibrium in its pose.

    The sums are over all vertices and frames. A factor or correlation is NaN where a part is zero.
    """
    moving, still, reference, static_reference = (
        np.asarray(x, np.float64) for x in (moving, still, reference, static_reference)
    )
    ours, theirs = moving - still, reference - static_reference
    together, size, true_size = (float(np.sum(a * b)) for a, b in ((ours, theirs), (ours, ours), (theirs, theirs)))
    both = np.sqrt(size * true_size)
    return {
        "static_distance": 1000 * float(np.linalg.norm(still - static_reference, axis=-1).mean()),
        "dynamic_correlation": together / both if both > 0 else float("nan"),
        "dynamic_factor": together / size if size > 0 else float("nan"),
    }

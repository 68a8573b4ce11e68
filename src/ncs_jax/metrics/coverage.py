"""How far a motion is from the motions that a garment was trained on, joint by joint, in poses and in speeds, and in strain.

A network is at the energy of a simulation where it was trained. Beyond, its energy rises with the distance of the pose: see
`FAR`. How steeply depends on garment and training; how much more it strains the cloth than there tells it for each: `STRAINED`.
Motions strain it unequally: a frame near a trained one is compared with that one, others with the mean of all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["FAR", "Coverage", "TrainedMotion", "coverage", "fault_of", "trained_motion", "with_strain"]

FAR = 0.2  # distance of a pose from the nearest trained one at which the energy is a tenth above what adapting reaches
FAST = 2.0  # times the largest trained rate, and twice as much of the accelerations, are the limit
GROWTH = 1.4  # power of the distance with which the energy rises beyond
STRAINED = 1.5  # times the mean strain of trained motions, at which the energy is as much above
TOLD = 0.1  # of the energy, above which a motion is told to be beyond
CARRIED = 0.005  # of the garment, that a joint and those below it carry at least, if it counts
KEPT = 1024  # poses of a joint, at most
STRAINS = 320  # frames of which the strain is kept, at most
MEAN = 160  # frames that the mean strain is of
CLOSE = 0.03  # distance within which every trained pose of a joint has a kept one, if there are no more than `KEPT`
SEEN = 8192  # frames that are looked at, at most
STILL = 0.1, 0.5  # 1/s, m/s^2: least limits of rates and accelerations
BLOCK = 512


@dataclass(frozen=True)
class TrainedMotion:
    """What a run keeps of the motions that it was trained on.

    Attributes:
        poses: (kept, 9) of each joint, those that are farthest from each other: the first two columns of its rotation since its
            parent, zeros for the root of a network that is free of its heading, and the direction of gravity that it sees.
        joint: (kept,) of which joint each is, of those that carry the garment.
        radius: (joints,) how far 19 of 20 trained poses are from the nearest kept one, at most.
        rates: (joints,) the largest rate of such a pose, 1/s. accelerations: (joints,) of each joint, m/s^2.
        strain: the mean of its edges' strain over these motions, %, once trained; 0 where nobody knows.
        frames, frame_strain: (strains, joints, 9), (strains,) whole poses far from each other, and the strain in each, %.
        frame_radius: how far 19 of 20 trained frames are from the nearest of these, at most, by the joint that is farthest.
    """

    poses: Float[np.ndarray, "kept 9"]
    joint: np.ndarray
    radius: Float[np.ndarray, "joints"]
    rates: Float[np.ndarray, "joints"]
    accelerations: Float[np.ndarray, "joints"]
    strain: float = 0.0
    frames: Float[np.ndarray, "strains joints 9"] = field(default_factory=lambda: np.zeros((0, 0, 9)))
    frame_strain: Float[np.ndarray, "strains"] = field(default_factory=lambda: np.zeros(0))
    frame_radius: float = 0.0

    def without_strain(self) -> TrainedMotion:
        """Return it as it is until the strain is known."""
        return TrainedMotion(self.poses, self.joint, self.radius, self.rates, self.accelerations)


@dataclass(frozen=True)
class Coverage:
    """How far each frame of a motion is from what a run was trained on.

    Attributes:
        poses, speeds: (frames, joints) distance of each joint's pose and speed as a share of the limit: 1 is at the limit.
        joints: their names.
        strain: the garment's mean strain over that which its training lets expect; 0 where nobody knows.
    """

    poses: Float[np.ndarray, "frames joints"]
    speeds: Float[np.ndarray, "frames joints"]
    joints: tuple[str, ...]
    strain: float = 0.0

    @property
    def distance(self) -> Float[np.ndarray, "frames"]:
        """Return how far each frame is, by the joint that is farthest: 1 is at the limit."""
        return np.maximum(self.poses, self.speeds).max(axis=1)

    @property
    def outside(self) -> np.ndarray:
        """Return which frames (frames,) are beyond the limit."""
        return self.distance > 1

    @property
    def share(self) -> float:
        """Return the share of frames that are beyond the limit, 0 to 1."""
        return float(np.mean(self.outside))

    @property
    def excess(self) -> float:
        """Return how much more energy is to be expected than adapting to the motion reaches, as a share of it.

        By the strain r, as its energy is quadratic, else by the distances d:

            `TOLD` (r^2 - 1) / (`STRAINED`^2 - 1),   mean over frames of `TOLD` d^`GROWTH`
        """
        if self.strain:
            return TOLD * max(self.strain**2 - 1, 0.0) / (STRAINED**2 - 1)
        return float(np.mean(TOLD * self.distance**GROWTH))

    @property
    def told(self) -> bool:
        """Return whether the motion as a whole is beyond what was trained."""
        return self.excess > TOLD

    @property
    def worst(self) -> tuple[int, str, str]:
        """Return the frame that is farthest, the joint that is, and whether by its pose or its speed."""
        frame = int(np.argmax(self.distance))
        joint = int(np.argmax(np.maximum(self.poses[frame], self.speeds[frame])))
        return frame, self.joints[joint], "pose" if self.poses[frame, joint] >= self.speeds[frame, joint] else "speed"

    def facts(self) -> dict:
        """Return all of it as JSON has it."""
        frame, joint, what = self.worst
        worst = {"frame": frame, "joint": joint, "by": what}
        found = {"outside": round(self.share, 4), "worst": worst, "strain": round(self.strain, 3)}
        return found | {"told": self.told, "means": str(self)}

    def __str__(self) -> str:
        """Return the share of frames, the worst of them, the strain, and what helps, in a sentence."""
        text = "every frame is near the poses and speeds that the run was trained on"
        if self.told:
            text = "its poses and speeds are near those that the run was trained on"
        if self.outside.any():
            frame, joint, what = self.worst
            text = f"{self.share:.0%} of the frames are beyond the poses and speeds that the run was trained on"
            text += f", frame {frame} most, by the {what} of {joint}"
        if not self.told:
            return text
        joined = " and" if self.outside.any() else ", but"
        strain = f"{joined} the cloth is strained {self.strain:.1f} times as much as there" if self.strain else ""
        return f"{text}{strain}; adapt it with --adapt 20 (in Python ncs_jax.adapt), or train on such motion"


def trained_motion(model: Model, track: MotionFeatures) -> TrainedMotion:
    """Return what a run keeps of the motions in a track: 1,024 poses of each joint at most, and the largest speeds."""
    poses, rates, accelerations = _described(model, track)
    joints = range(poses.shape[1])
    some = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), SEEN)).astype(int))
    spread = [_spread(poses[some, j], KEPT) for j in joints]
    kept = np.concatenate([poses[some[chosen], j] for j, (chosen, _) in zip(joints, spread, strict=True)])
    joint = np.repeat(np.array(joints, np.int16), [len(chosen) for chosen, _ in spread])
    radius = np.array([np.percentile(far, 95) for _, far in spread])
    return TrainedMotion(kept.astype(np.float16), joint, radius, rates.max(axis=0), accelerations.max(axis=0))


def with_strain(
    trained: TrainedMotion, model: Model, track: MotionFeatures, among: np.ndarray, strain: Callable[[np.ndarray], np.ndarray]
) -> TrainedMotion:
    """Return it with the strain of the trained garment: its mean, and that in frames of a track that are far from each other.

    among: the frames that were trained on. strain: gives that in the frames of some numbers, %.
    """
    poses = _described(model, track)[0]
    some = among[np.unique(np.linspace(0, len(among) - 1, min(len(among), SEEN)).astype(int))]
    chosen = some[_spread(poses[some].reshape(len(some), -1), STRAINS)[0]]
    kept, mean = poses[chosen].astype(np.float16), strain(among[np.linspace(0, len(among) - 1, MEAN).astype(int)]).mean()
    radius = float(np.percentile(_nearest(poses, kept)[0], 95))
    return replace(
        trained, strain=float(mean), frames=kept, frame_strain=strain(chosen).astype(np.float32), frame_radius=radius
    )


def fault_of(trained: TrainedMotion, model: Model) -> tuple[str, str, str] | None:
    """Return which field is none that a run of this model keeps, what is expected there, and what it is; None if all are."""
    joints, kept, strains = len(_carrying(model)), np.shape(trained.poses)[:1], np.shape(trained.frame_strain)[:1]
    shapes = {
        "poses": (*kept, 9), "joint": kept, **dict.fromkeys(("radius", "rates", "accelerations"), (joints,)),
        "strain": (), "frames": (*strains, joints if any(strains) else 0, 9), "frame_strain": strains, "frame_radius": (),
    }  # fmt: skip
    for name, shape in shapes.items():
        array = np.asarray(getattr(trained, name))
        if array.shape != shape:
            return name, f"shape {shape}", f"{array.shape}"
        if array.dtype.kind not in "iuf":
            return name, "numbers", f"{array.dtype}"
        least = -np.inf if name in ("poses", "frames") else 0
        if (wrong := ~(np.isfinite(array) & (array >= least))).any():
            return name, "finite numbers" if least else "finite numbers, none below 0,", f"{array[wrong].flat[0]}"
    if set(trained.joint.tolist()) != set(range(joints)):
        return "joint", f"every number from 0 to {joints - 1}", f"{sorted(set(trained.joint.tolist()))}"
    return None


def coverage(
    trained: TrainedMotion,
    model: Model,
    track: MotionFeatures,
    *,
    names: Sequence[str] = (),
    moving: bool = True,
    strain: np.ndarray | None = None,
    every: int = 1,
) -> Coverage:
    """Return how far the frames of a track are from what a run was trained on.

    For each joint it is the distance |d_t - d_k| to the nearest kept pose, less how far trained ones are, over `FAR`, and its
    rate and acceleration over the largest trained ones, times `FAST` and twice that. The strain that training lets expect is

        `e_t = mean + max(1 - far_t / FAR, 0) max(s_k - mean, 0)`

    s_k that of the nearest kept frame, far_t how far its farthest joint is less how far that of trained frames is. So a motion
    that was trained on is not told for being strained more than others, and none for being so by calm ones.

    Args:
        names: of the body's joints; their numbers where there are none. moving: whether the network reads speeds at all.
        strain: (frames / every,) that of the garment in every so many frames, %, as the network has it; None: nobody knows.
    """
    poses, rates, accelerations = _described(model, track)
    kept = [trained.poses[trained.joint == j, None] for j in range(poses.shape[1])]
    far = np.stack([_nearest(poses[:, j : j + 1], kept[j])[0] for j in range(poses.shape[1])], axis=1)
    far = np.maximum(far - trained.radius, 0) / FAR
    fast = rates / np.maximum(FAST * trained.rates, STILL[0])
    fast = np.maximum(fast, accelerations / np.maximum(2 * FAST * trained.accelerations, STILL[1]))
    numbers = [model.source_joints[j] for j in _carrying(model)]
    called = tuple(names[n] if names else str(n) for n in numbers)
    ratio = 0.0 if strain is None or not trained.strain else float(np.mean(strain) / _expected(trained, poses[::every]).mean())
    return Coverage(far, fast if moving else np.zeros_like(far), called, ratio)


def _expected(trained: TrainedMotion, poses: np.ndarray) -> np.ndarray:
    """Return the strain e_t of `coverage` in poses (frames, joints, 9), %."""
    if not len(trained.frames):  # a run of an earlier version whose motions are gone
        return np.full(len(poses), trained.strain)
    far, nearest = _nearest(poses, trained.frames)
    near = np.maximum(1 - np.maximum(far - trained.frame_radius, 0) / FAR, 0)
    return trained.strain + near * np.maximum(trained.frame_strain[nearest] - trained.strain, 0)


def _carrying(model: Model) -> np.ndarray:
    """Return the numbers of the joints that carry the garment, alone or with the joints below them; the root always does."""
    carried = np.zeros(len(model.skeleton.parents))
    np.add.at(carried, list(model.blend.joints), np.asarray(model.blend.weights, np.float64).mean(axis=0))
    for joint in reversed(range(len(carried))):
        if (parent := model.skeleton.parents[joint]) >= 0:
            carried[parent] += carried[joint]
    return np.flatnonzero(carried >= CARRIED)


def _described(model: Model, track: MotionFeatures) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pose of each joint (frames, joints, 9), its rate and the joint's acceleration (frames, joints).

    They are the descriptors (8) and (9) of `scene.descriptors` in physical units, whichever a network reads.
    """
    joints, skeleton = _carrying(model), model.skeleton
    parents = np.asarray(skeleton.parents)[joints]
    matrices = np.asarray(track.matrices, np.float64)[:, : len(skeleton.parents)]
    world = matrices[..., :3][:, joints]
    local = np.einsum("tjba,tjbc->tjac", matrices[..., :3][:, np.maximum(parents, 0)], world)
    local[:, parents < 0] = world[:, parents < 0]
    columns = local[..., :2].reshape(*local.shape[:2], 6)
    gravity = np.asarray(model.material.gravity, np.float64)
    down = np.einsum("tjba,b->tja", world, gravity / max(float(np.linalg.norm(gravity)), 1e-9))
    places = np.einsum("tjab,jb->tja", world, np.asarray(skeleton.joints, np.float64)[joints]) + matrices[..., 3][:, joints]
    poses = np.concatenate([columns, down], axis=-1)
    now, start = np.arange(len(poses)), np.asarray(track.start)
    one, two = np.maximum(now - 1, start), np.maximum(now - 2, start)
    rates = model.fps * np.linalg.norm(poses - poses[one], axis=-1)
    accelerations = model.fps**2 * np.linalg.norm(places - 2 * places[one] + places[two], axis=-1)
    if model.descriptor == "heading_free":
        poses[:, parents < 0, :6] = 0
    return poses, rates, accelerations


def _spread(poses: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of poses (frames, any) that are far from each other, and how far each is from the nearest of them.

    Each in turn is the one that is farthest from those before, `count` at most.
    """
    columns = np.ascontiguousarray(poses.T, np.float32)
    chosen, far = [0], np.full(len(poses), np.inf, np.float32)
    while True:
        away = columns - columns[:, chosen[-1], None]
        np.minimum(far, np.einsum("it,it->t", away, away), out=far)
        if far.max() <= CLOSE**2 or len(chosen) == count:
            return np.array(chosen), np.sqrt(far)
        chosen.append(int(far.argmax()))


def _nearest(poses: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the farthest joint of each pose (frames, joints, 9) is from the nearest kept pose, and which that is."""
    kept, far, which = kept.astype(np.float64), [], []
    for part in np.split(poses, range(BLOCK, len(poses), BLOCK)):
        away = np.zeros((len(part), len(kept)))
        for joint in range(poses.shape[1]):
            a, b = part[:, joint], kept[:, joint]
            square = (a * a).sum(1)[:, None] - 2 * a @ b.T + (b * b).sum(1)
            np.maximum(away, square, out=away)
        which.append(away.argmin(axis=1))
        far.append(np.sqrt(away.min(axis=1)))
    return np.concatenate(far), np.concatenate(which)

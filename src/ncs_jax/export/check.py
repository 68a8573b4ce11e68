"""A written file, run over a motion beside the network that it was made from."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.export.stablehlo import load_stablehlo
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.io.records import MotionRecord
from ncs_jax.network.methods.method import Method
from ncs_jax.network.rollout import stepper
from ncs_jax.scene.model import Model, local_rotations

__all__ = ["Check", "check_file", "load_step"]

FRAMES = 240  # of a motion that a file is checked on
THREADS = 2


class Check(NamedTuple):
    """The check of a written file: how it does over a motion, beside the step that it was made from.

    max_difference: the largest distance of a vertex, m. milliseconds: median of a frame on two threads. frames: how many.
    error: of the file from the garment as trained, mean and largest, mm, where the file has a smaller or a rounded network.
    """

    max_difference: float
    milliseconds: float
    frames: int
    error: tuple[float, float] | None


def load_step(file: Path, format: str) -> Callable | None:
    """Return the step of a written file, called with its arguments by name; None where onnxruntime is not installed."""
    if format == "stablehlo":
        loaded = load_stablehlo(file.read_bytes())
        return lambda **arguments: loaded(*arguments.values())
    try:
        import onnxruntime
    except ImportError:
        return None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    return lambda **arguments: session.run(None, arguments)


def check_file(
    step: Callable,
    size: int,
    model: Model,
    network: tuple[Method, dict],
    motion: MotionRecord,
    trained: tuple[Method, dict] | None,
) -> Check:
    """Run a file's step over the first frames of a motion, and compare.

    Args:
        step: of the file. size: of its state. network: and the parameters, that the file was made from. trained: the same,
            for the garment as trained, where the file has a smaller or a rounded network.
    """
    poses = np.asarray(motion.poses[:FRAMES], np.float32)
    # Near the origin, as motion features are: what single precision loses far from it is not the file's fault.
    places = np.asarray(motion.translation[:FRAMES] - motion.translation[:1], np.float32)
    rotations = np.asarray(axis_angle_to_matrix(jnp.asarray(poses[:, np.asarray(model.source_joints)])))
    vertices, milliseconds = _play(step, size, rotations, places)

    def distance(network, params):
        return np.linalg.norm(vertices - _streamed(model, network, params, poses, places), axis=-1)

    error = None
    if trained is not None:
        far = 1000 * distance(*trained)
        error = float(far.mean()), float(far.max())
    far = distance(*network)
    # A comparison with NaN is false: what is not finite must not pass for near.
    worst = float(far.max()) if np.all(np.isfinite(far)) else math.inf
    return Check(worst, milliseconds, len(vertices), error)


def _play(step: Callable, size: int, rotations: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the vertices of every frame by a file's step, and the median milliseconds of a frame."""
    alpha, state, seconds, frames = np.ones(1, np.float32), np.zeros(size, np.float32), [], []
    for turn, place in zip(rotations, places, strict=True):
        start = time.perf_counter()
        state, x = step(state=state, rotations=turn, translation=place, alpha=alpha)
        frames.append(np.asarray(x))
        seconds.append(time.perf_counter() - start)
    return np.stack(frames), 1000 * float(np.median(seconds))


def _streamed(model: Model, network: Method, params: dict, poses: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the vertices of every frame by `rollout.stepper`."""
    wide = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float16 else a, params)
    init, step = stepper(model, network, wide)
    step, state, frames = jax.jit(step, donate_argnums=0), init(), []
    for rotations, place in zip(local_rotations(model, jnp.asarray(poses)), jnp.asarray(places), strict=True):
        state, x = step(state, rotations, place)
        frames.append(np.asarray(x))
    return np.stack(frames)

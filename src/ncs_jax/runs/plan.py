"""How many steps a run has: those that are asked for, or as many as fit into so many minutes from its first step on."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable
from itertools import cycle
from typing import NamedTuple

import jax
import jax.numpy as jnp

from ncs_jax.runs.placed_scene import PlacedScene
from ncs_jax.runs.pose_stiffness import poses_of
from ncs_jax.simulation.ritz_modes import AT_ONCE
from ncs_jax.training.batches import CHUNK, whole_chunks
from ncs_jax.training.step import TrainState

__all__ = ["EARLY", "ENOUGH", "LOOKS", "Costs", "Minutes", "measure_costs", "steps_within"]

ENOUGH = 300  # steps; after fewer, a garment still looks as it did at the start
EARLY = (20, 50, 100)  # after so many steps, in which a garment falls farthest, its contacts are looked at once more
MOST = 10_000_000  # steps
MARGIN = 1.05  # of the time that is measured
LOOKS = 1 / 8, 3 / 8  # of the steps: whether they take the time that was measured is looked at here, before the stiffness is
OTHER = 0.1  # by this share slower or faster than measured, and the rest is planned anew
SLOW = 5.0  # s; a chunk that takes longer is timed once


class Costs(NamedTuple):
    """What training takes, s: a step, a validation, a checkpoint with what goes with it; and after how many steps each is due.

    A validation and a checkpoint are also due at the end. stiffness: of a pose, see `runs.pose_stiffness`.
    """

    step: float
    validation: float
    checkpoint: float
    lists: float
    validate_every: int
    checkpoint_every: int
    stiffness: float = 0.0

    def seconds(self, first: int, last: int, *, ends: bool = True) -> float:
        """Return how long the steps first to last take; `ends`: the run ends there."""
        validations, checkpoints = (
            (-(-last // every) if ends else last // every) - first // every
            for every in (self.validate_every, self.checkpoint_every)
        )
        lists = sum(first < step <= last for step in EARLY) + last // self.checkpoint_every - first // self.checkpoint_every
        poses = ends * poses_of(last) * (1 + (whole_chunks(last // 2) > first))
        rare = validations * self.validation + checkpoints * self.checkpoint + lists * self.lists + poses * self.stiffness
        return MARGIN * ((last - first) * self.step + rare)


class Minutes(NamedTuple):
    """A run from a step on that is to take some seconds, by what was measured before: another program may have run then."""

    costs: Costs
    first: int
    seconds: float

    def last(self, done: int, spent: float, last: int) -> int:
        """Return at which step the run ends, after `spent` seconds at step `done`: at `last`, unless its steps take another
        time than was measured. Half of it stays ahead if it is."""
        slower = spent * MARGIN / self.costs.seconds(self.first, done, ends=False)
        if abs(slower - 1) < OTHER:
            return last
        return max(
            steps_within((self.seconds - spent) / slower, self.costs, done), 2 * (done + CHUNK) if last > 2 * done else 0
        )


def steps_within(seconds: float, costs: Costs, first: int = 0) -> int:
    """Return at which step a run that stands at `first` is after so many seconds: a multiple of CHUNK, one chunk at least."""
    lasts = range((first // CHUNK + 1) * CHUNK, MOST + 1, CHUNK)
    return lasts[max(0, bisect_right(lasts, seconds, key=lambda last: costs.seconds(first, last)) - 1)]


def measure_costs(
    placed: PlacedScene, state: TrainState, validate: Callable[[], object] | None, checkpoint: float, *, stiffness: bool
) -> Costs:
    """Return what training takes from a state on; every program that it needs is compiled then.

    Args:
        state: to train from. validate: does what a validation does. checkpoint: how long one takes, s. stiffness: whether the
            stiffness in poses is looked for.
    """
    spec = placed.assembly.scene.training

    begins = cycle((int(state.step) + whole_chunks(spec.checkpoint_every), int(state.step)))  # of another share each time

    def lists() -> None:
        placed.refresh(state.params, next(begins))
        placed.rebuild_lists(state.params)

    def chunk() -> None:
        taken, _ = placed.run_chunk(placed.copied(jax.tree.map(jnp.array, state)), 0, CHUNK, CHUNK)
        placed.measure(placed.local(taken.params), CHUNK)
        jax.block_until_ready(taken)

    def compiled(work: Callable[[], object]) -> Callable[[], object]:
        work()
        return work

    relisted = _seconds(compiled(lists))
    placed.measure(state.params, CHUNK)
    step = _seconds(chunk)
    if step < SLOW:  # a first time takes a little more
        step = _seconds(chunk)
    validation = 0.0 if validate is None else _seconds(compiled(validate))
    every = whole_chunks(spec.validate_every), whole_chunks(spec.checkpoint_every)
    pose = _seconds(compiled(lambda: placed.find_stiffness(state.params))) / (AT_ONCE + 1) if stiffness else 0.0
    return Costs(step / CHUNK, validation, checkpoint, relisted, *every, pose)


def _seconds(work: Callable[[], object]) -> float:
    """Return how long work takes."""
    start = time.monotonic()
    work()
    return time.monotonic() - start

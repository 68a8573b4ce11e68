"""Train a garment into a run folder, and resume it."""

from __future__ import annotations

import platform
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from ncs_jax.energies.terms import OwnTerm
from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import summarise
from ncs_jax.runs.checkpoint import Checkpoints, check_writable, read_run, write_prepared, write_run
from ncs_jax.runs.log import Report, RunLog
from ncs_jax.runs.placed_scene import PlacedScene
from ncs_jax.runs.run import NetworkMaker, Run, assemble, check_own, own_names
from ncs_jax.scene.spec import Scene, load_scene, scene_from
from ncs_jax.training.batches import CHUNK, chunks
from ncs_jax.training.devices import trim_memory
from ncs_jax.training.step import TrainState

__all__ = ["train"]


IDLE = 0.5  # mm that alpha should make a difference of, at least
EARLY = (20, 50, 100)  # after so many steps, in which a garment falls farthest, its contacts are looked at once more


def train(
    scene: Scene | str | Path,
    out: str | Path | None = None,
    *,
    steps: int | None = None,
    minutes: float | None = None,
    seed: int | None = None,
    resume: bool = False,
    report: Callable[[Report], None] | None = None,
    terms: Sequence[OwnTerm] = (),
    network: NetworkMaker | None = None,
) -> Run:
    """Train a garment from the physics energy alone, on every device that JAX sees.

    Args:
        scene: a scene, or the path of a scene file. out: run folder for checkpoints and logs; None keeps nothing.
        steps: optimiser steps, else the scene's. minutes: instead, as many steps as fit. seed: else the scene's.
        resume: continue the run in `out`; its steps and seed stand. report: called after every chunk of steps.
        terms: of one's own, see `energies.terms.OwnTerm`: pure functions `term(x, step)` of positions (m) and step inputs, in
            J. network: makes a network of one's own from scene and model, see `network.methods.method.Method`.

    After `jax.distributed.initialize`, every process makes the same call, and the first one writes and reports.

    Raises:
        InputError: the scene or the folder is unusable, or the hosts do not divide the batch.
    """
    scene, began = load_scene(scene) if isinstance(scene, str | Path) else scene, time.monotonic()
    out = None if out is None else Path(out)
    facts = _facts(out, resume)
    if out is not None:
        if facts is not None:
            scene, seed = scene_from(facts["scene"], source=str(out / "run.json")), facts["seed"]
            check_own(facts, out, terms, network)
        check_writable(out)
    assembly = assemble(scene, terms=terms, network=network)
    trim_memory()
    placed = PlacedScene(assembly, scene.training.seed if seed is None else seed)
    if jax.process_index() > 0:  # placing the scene waited for every process: from here on, one may write
        out = report = None
    state = placed.initial_state()
    placed.refresh(state.params)
    if facts is None:  # before anything is written: whether it fits into memory
        placed.compile(state, CHUNK if minutes is not None else min(CHUNK, steps or scene.training.steps))
    planned = 0 if facts is None else facts["steps"]
    with closing(_Output(placed, out, report, {"steps": planned, **own_names(terms, network)})) as output:
        if planned:
            steps = planned
        else:
            fitting = None if minutes is None else _steps_within(60 * minutes, began, placed, output, state)
            steps = fitting or steps or scene.training.steps
            output.plan(steps)
        state = placed.copied(output.restore(state))
        return Run(assembly, _Loop(placed, output, state, steps, began).run(), steps)


def _facts(out: Path | None, resume: bool) -> dict | None:
    """Return what run.json says of the run to resume, None for a new run."""
    if out is None or not (out / "run.json").exists():
        if resume:
            raise InputError("no run to resume", file=out, mend="leave --resume out to begin one")
        return None
    if not resume:
        raise InputError("a new folder expected", file=out, value="a run", mend="add --resume, or choose another --out")
    return read_run(out)


class _Output:
    """What a run writes into its folder, if it has one, and what it reports."""

    def __init__(self, placed: PlacedScene, out: Path | None, report: Callable[[Report], None] | None, facts: dict):
        """Open the folder. `facts` of run.json: the steps planned, 0 in a new one; names of what is one's own."""
        self._placed, self._out, self._report, self._facts = placed, out, report, facts
        self._checkpoints: Checkpoints | None = None
        self._log: RunLog | None = None
        if out is not None:
            if not facts["steps"]:
                self.plan(0)
                write_prepared(out, placed.assembly.prepared)
            self._checkpoints = Checkpoints(out)

    def plan(self, steps: int) -> None:
        """Write into run.json how many steps the run has."""
        if self._out is not None:
            scene = self._placed.assembly.scene.to_dict()
            facts = self._facts | {"steps": steps, "seed": self._placed.seed, "scene": scene, "versions": _versions()}
            write_run(self._out, facts)

    def seconds_of_a_first_checkpoint(self, state: TrainState) -> float:
        """Write the state before the first step, unless there is one, and return how long that took."""
        start = time.monotonic()
        if self._checkpoints is not None and self._checkpoints.latest() is None:
            self._checkpoints.save(0, state)
        return time.monotonic() - start

    def restore(self, state: TrainState) -> TrainState:
        """Return the newest state of the folder, the one given where there is none."""
        if self._checkpoints is None or self._checkpoints.latest() is None:
            return state
        return self._checkpoints.restore(state)

    def begin_log(self, first: int) -> None:
        """Open the log, whose rows after the step `first` are dropped."""
        if self._out is not None:
            self._log = RunLog(self._out, first)

    def tell(self, entry: Report) -> None:
        """Log a report and hand it to whoever wants it."""
        if self._log is not None:
            self._log.write(entry)
        if self._report is not None:
            self._report(entry)

    def save(self, step: int, state: TrainState) -> None:
        """Write a checkpoint."""
        if self._checkpoints is not None:
            self._checkpoints.save(step, state)

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._log.close()


class _Loop:
    """The steps of a run, chunk by chunk, with what it carries from one chunk to the next."""

    def __init__(self, placed: PlacedScene, output: _Output, state: TrainState, steps: int, began: float):
        """`state`: on the devices; it is used up. `began`: when training was called, s."""
        spec = placed.assembly.scene.training
        self._placed, self._output, self._state, self._steps, self._began = placed, output, state, steps, began
        self._every, self._check = _whole_chunks(spec.checkpoint_every), _whole_chunks(spec.validate_every)
        self._first, self._dropped = int(state.step), int(state.dropped)
        # One look alone may see nothing but frames that stand still: these are all looks since the last validation.
        self._moved: deque[float] = deque(maxlen=self._check // CHUNK)
        self._timed: tuple[int, float] | None = None  # the step and the time after the first chunk, which compiles

    def run(self) -> dict:
        """Take every step that is left, and return the parameters."""
        placed = self._placed
        placed.refresh(placed.local(self._state.params))
        if self._first:
            placed.rebuild_lists(placed.local(self._state.params))
        self._output.begin_log(self._first)
        for at, count in chunks(self._first, self._steps):
            self._take(at, count)
        return placed.local(self._state.params)

    def _take(self, at: int, count: int) -> None:
        """Take the steps at to at + count, report them, and keep a checkpoint where one is due."""
        placed, done = self._placed, at + count
        self._state, logs = placed.run_chunk(self._state, at, count, self._steps)
        here, logs = placed.local((self._state, logs))
        if self._timed is None:  # this chunk was compiled
            trim_memory()
        energies = {k: float(v) for k, v in jax.tree.map(lambda a: a[-1], logs).items()}
        self._output.tell(self._entry(done, here, energies))
        whole = done % self._every == 0
        if whole or done == self._steps:
            self._output.save(done, here)
        if whole:  # where a run that is resumed begins
            placed.refresh(here.params)
        if whole or (done in EARLY and done < self._every):
            placed.rebuild_lists(here.params)

    def _entry(self, done: int, state: TrainState, energies: dict[str, float]) -> Report:
        """Return the report of a chunk: it is measured, and validated where that is due."""
        assembly, seen = self._placed.assembly, self._placed.measure(state.params, done)
        due = done % self._check == 0 or done == self._steps
        message = self._message(state, seen.get("moved"), due)
        validation = _validate(Run(assembly, state.params)) if due and assembly.scene.motion.validation else None
        return Report(
            step=done,
            steps=self._steps,
            energies=energies,
            strain=seen["strain"],
            penetrating=seen.get("penetrating", 0.0),
            dropped=self._dropped,
            left=self._pace(done) * (self._steps - done),
            seconds=time.monotonic() - self._began,
            message=message,
            validation=validation,
            devices=self._placed.devices,
            moved=seen.get("moved"),
        )

    def _message(self, state: TrainState, moved: float | None, due: bool) -> str:
        """Return why a step of the chunk was dropped, or that alpha does nothing, or "" where all is well."""
        if moved is not None:
            self._moved.append(moved)
        if int(state.dropped) > self._dropped:
            self._dropped = int(state.dropped)
            return "step dropped: " + self._placed.diagnose(state)
        if due and self._moved and (mean := sum(self._moved) / len(self._moved)) < IDLE:
            return f"the dynamic branch is idle: alpha = 0 and alpha = 1 differ by {mean:.2g} mm"
        return ""

    def _pace(self, done: int) -> float:
        """Return the seconds of a step since the first chunk, 0 after that chunk."""
        now = time.monotonic()
        if self._timed is None:
            self._timed = done, now
            return 0.0
        step, start = self._timed
        return (now - start) / (done - step)


def _whole_chunks(steps: int) -> int:
    """Return the next multiple of CHUNK."""
    return -(-steps // CHUNK) * CHUNK


def _steps_within(seconds: float, began: float, placed: PlacedScene, output: _Output, state: TrainState) -> int:
    """Return how many steps fit into so many seconds since `began`, by the pace of a few: whole chunks, one at least."""
    assembly, spec = placed.assembly, placed.assembly.scene.training

    def chunk(state):
        state, _ = placed.run_chunk(state, 0, CHUNK, CHUNK)
        placed.measure(placed.local(state.params), CHUNK)
        return jax.block_until_ready(state)

    def validate(state):
        _validate(Run(assembly, state.params))
        return state

    pace = _seconds(chunk, placed.copied(placed.initial_state())) / CHUNK
    if assembly.scene.motion.validation:
        pace += _seconds(validate, state) / _whole_chunks(spec.validate_every)
    pace += output.seconds_of_a_first_checkpoint(state) / _whole_chunks(spec.checkpoint_every)
    left = seconds - (time.monotonic() - began)
    steps = max(CHUNK, int(left / (1.05 * pace)) // CHUNK * CHUNK)
    return int(placed.copied(steps))


def _seconds(work: Callable, state) -> float:
    """Return how long `work(state) -> state` takes once it is compiled."""
    state = work(state)
    start = time.monotonic()
    work(state)
    return time.monotonic() - start


def _validate(run: Run) -> dict[str, float]:
    """Return means over the validation motions: total energy, strain, and penetration by the scene's own query."""
    rows = [summarise(run.evaluate(name, exact=False)) for name in run.assembly.scene.motion.validation]
    return {k: float(np.mean([r[k] for r in rows])) for k in ("total", "strain_mean", "penetrating") if k in rows[0]}


def _versions() -> dict[str, str]:
    names = ("ncs-jax", "jax", "flax", "optax", "orbax-checkpoint")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}

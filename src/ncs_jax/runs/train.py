"""Train a garment into a run folder, and resume it."""

from __future__ import annotations

import functools
import math
import platform
import time
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from ncs_jax.energies.terms import OwnTerm
from ncs_jax.errors import InputError, InputWarning
from ncs_jax.metrics.coverage import TrainedMotion, trained_motion
from ncs_jax.metrics.quality import summarise
from ncs_jax.prepare.build import Assembly
from ncs_jax.prepare.moving_body import refuse_training
from ncs_jax.runs.begin import assemble_run, facts_of_run, resumed_scene
from ncs_jax.runs.checkpoint import Checkpoints, read_trained, write_prepared, write_run, write_trained
from ncs_jax.runs.log import Report, RunLog
from ncs_jax.runs.placed_scene import PlacedScene, begin_programs
from ncs_jax.runs.plan import EARLY, ENOUGH, LOOKS, Minutes, measure_costs, steps_within
from ncs_jax.runs.run import NetworkMaker, Run, assemble, load_run, own_names
from ncs_jax.scene.spec import Scene, load_scene
from ncs_jax.training.batches import CHUNK, chunks, whole_chunks
from ncs_jax.training.devices import trim_memory
from ncs_jax.training.programs import Programs
from ncs_jax.training.step import TrainState

__all__ = ["Begun", "train", "train_assembly"]


IDLE = 0.5  # mm that alpha should make a difference of, at least
ALONG = 0.25  # of its swing that the cloth should go along with by the end


def train(
    scene: Scene | str | Path | None,
    out: str | Path | None = None,
    *,
    steps: int | None = None,
    minutes: float | None = None,
    seed: int | None = None,
    resume: bool = False,
    start: Run | str | Path | None = None,
    report: Callable[[Report], None] | None = None,
    say: Callable[[str], None] | None = None,
    terms: Sequence[OwnTerm] = (),
    network: NetworkMaker | None = None,
) -> Run:
    """Train a garment from the physics energy alone, on every device that JAX sees.

    Args:
        scene: a scene, or the path of a scene file; None, with `resume`: the run's own.
        out: run folder for checkpoints and logs; None keeps nothing.
        steps: optimiser steps in all, else the scene's. minutes: instead, as many as fit, from the first step on. seed: alike.
        resume: continue the run in `out`: to `steps`, for `minutes` more, or as was planned; its scene and seed stand.
        start: a run, or its folder, of the same garment and network, whose weights to begin from; the optimiser begins anew.
        report: called after every chunk of steps; KeyboardInterrupt from it ends the run with a checkpoint of these steps.
        say: called with what is done next, in words, before the first step.
        terms, network: of one's own, see `energies.terms.OwnTerm`, `network.methods.method.Method`: (scene, model) -> network.

    After `jax.distributed.initialize`, every process makes the same call, and the first one writes and reports.

    Raises:
        InputError: scene or folder are unusable, a run has more steps than it is to have or another scene, or `start` or the
            hosts do not fit.
    """
    scene, began = load_scene(scene) if isinstance(scene, str | Path) else scene, time.monotonic()
    if scene is not None:
        refuse_training(scene)
    out = None if out is None else Path(out)
    _check_options(steps, minutes, resume, start)
    facts = facts_of_run(out, resume, terms, network)
    if out is not None and facts is not None:
        scene, seed = resumed_scene(facts, out, scene, seed, steps), facts["seed"]
        done = Checkpoints(out).latest()
        if minutes is None and done == (steps or facts["steps"]):  # nothing is left to train
            return _finished(load_run(out, terms=terms, network=network), out)
        if say is not None:
            say(f"going on from step {done or 0}")
    if scene is None:
        raise InputError("a scene expected where no run is resumed", field="scene", mend="give a file, or ncs:NAME")
    programs, first = Programs(), CHUNK if minutes is not None else min(CHUNK, steps or scene.training.steps)
    begin = functools.partial(begin_programs, programs, count=first)  # while the rest is found out
    make_ready = functools.partial(assemble, terms=terms, network=network, report=say, ahead=begin)
    assembly, params = assemble_run(scene, facts, out, start, network, make_ready)
    trained = read_trained(out, assembly.model) if out is not None and facts is not None else None
    trim_memory()
    if say is not None:
        say("compiling")
    begin(assembly)
    seed = assembly.scene.training.seed if seed is None else seed
    said = own_names(terms, network) | ({"start": str(start)} if start else {})
    begun = Begun(facts, said, params, seed, began, trained)
    return train_assembly(assembly, out, begun, (steps, minutes), report=report, programs=programs)


class Begun(NamedTuple):
    """Where a training begins: what run.json says of the run that is resumed, None of a new one; what else it is to say.

    `params`: weights of another run, if it begins with some. `since`: when it was called for, s. `trained`: what was kept of
    its motions, if it is resumed.
    """

    facts: dict | None
    said: dict
    params: dict | None
    seed: int
    since: float
    trained: TrainedMotion | None = None


def _finished(run: Run, out: Path) -> Run:
    """Return a run that has all its steps, in a folder, which keeps what a training that was interrupted did not."""
    known = run.known
    if known is not None and known is not run.trained:
        write_trained(out, known)
    return replace(run, trained=known)


def train_assembly(
    assembly: Assembly,
    out: Path | None,
    begun: Begun,
    length: tuple[int | None, float | None],
    *,
    programs: Programs,
    report: Callable[[Report], None] | None = None,
    settle: Callable[[dict], dict] | None = None,
) -> Run:
    """Train a scene that was made ready, see `train`.

    Args:
        length: steps, minutes, or neither. programs: begun for it. settle: gives the weights to keep for the last ones.
    """
    placed, facts = PlacedScene(assembly, begun.seed, programs), begun.facts
    if jax.process_index() > 0:  # placing the scene waited for every process: from here on, one may write
        out = report = None
    state = placed.initial_state(begun.params)
    placed.refresh(state.params, 0)
    steps, minutes = length
    # Before anything is written: whether it fits into memory.
    placed.compile(state, CHUNK if minutes is not None else min(CHUNK, steps or assembly.scene.training.steps))
    facts = {"steps": 0, **begun.said} if facts is None else facts
    with closing(_Output(placed, out, report, facts)) as output:
        if begun.params is not None and begun.facts is None:
            output.save(0, state)  # a run that is killed has these weights no more
        state = output.restore(state)
        last, timed = _planned(placed, output, state, length, stiffness=settle is None)
        trained = output.keep_motion(begun.trained)
        return _Loop(placed, output, placed.copied(state), last, begun.since, settle).run(trained, timed)


def _check_options(steps: int | None, minutes: float | None, resume: bool, start) -> None:
    """Raise an InputError where two options exclude each other."""
    if steps is not None and not isinstance(steps, int | np.integer):
        raise InputError("a whole number expected", field="--steps", value=steps, mend="minutes may have fractions, steps not")
    if steps is not None and steps < 1:
        raise InputError("at least one step expected", field="--steps", value=steps, mend="leave it out for the scene's own")
    if steps is not None and minutes is not None:
        raise InputError("either steps or minutes expected", field="--minutes", value=minutes, mend="leave one of them out")
    if resume and start is not None:
        raise InputError("a run that is resumed has weights", field="--from", value=str(start), mend="leave it out")


def _planned(
    placed: PlacedScene, output: _Output, state: TrainState, length: tuple[int | None, float | None], *, stiffness: bool
) -> tuple[int, Minutes | None]:
    """Return at which step a run ends that stands at a state, and by what time if by time, and write it into run.json.

    length, stiffness: see `train_assembly`, `measure_costs`.
    """
    steps, minutes = length
    last, timed = steps or output.planned or placed.assembly.scene.training.steps, None
    if minutes is not None:
        assembly = placed.assembly
        validate = functools.partial(_validate, Run(assembly, state.params)) if assembly.scene.motion.validation else None
        costs = measure_costs(placed, state, validate, output.seconds_of_a_checkpoint(state), stiffness=stiffness)
        timed = Minutes(costs, int(state.step), 60 * minutes)
        last = int(placed.copied(steps_within(timed.seconds, costs, timed.first)))
        if last < ENOUGH and not output.started and jax.process_index() == 0:
            needed = math.ceil(costs.seconds(int(state.step), ENOUGH) / 60)
            upto = f", up to step {last}" if state.step else ""
            what = f"{minutes:g} minutes hold about {last - int(state.step)} steps on this machine{upto}: too few to learn from"
            more = " more" if state.step else ""
            warnings.warn(
                f"{what}; {ENOUGH} steps in all take about {needed} minute{'s' * (needed > 1)}{more}",
                InputWarning,
                stacklevel=4,
            )
    if last != output.planned:
        output.plan(last)
    return last, timed


class _Output:
    """What a run writes into its folder, if it has one, and what it reports."""

    def __init__(self, placed: PlacedScene, out: Path | None, report: Callable[[Report], None] | None, facts: dict):
        """Open the folder. `facts` of run.json: the steps planned, 0 in a new one; from where it began; what is one's own."""
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

    def keep_motion(self, there: TrainedMotion | None) -> TrainedMotion:
        """Write down what the run is trained on, which may have been done, and return it; its strain is that of the end."""
        a = self._placed.assembly
        trained = trained_motion(a.model, a.track) if there is None else there.without_strain()
        self.write_motion(trained)
        return trained

    def write_motion(self, trained: TrainedMotion) -> None:
        """Write down what the run is trained on."""
        if self._out is not None:
            write_trained(self._out, trained)

    @property
    def started(self) -> bool:
        """Return whether the run began with the weights of another one."""
        return bool(self._facts.get("start"))

    @property
    def planned(self) -> int:
        """Return how many steps were planned, 0 where none were."""
        return self._facts["steps"]

    def seconds_of_a_checkpoint(self, state: TrainState) -> float:
        """Return how long a checkpoint takes: to write the state before the first step, or to read the one that there is."""
        start = time.monotonic()
        if self._checkpoints is not None:
            if self._checkpoints.latest() is None:
                self._checkpoints.save(0, state)
            else:
                self._checkpoints.restore(state)
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

    def keep(self, step: int, assembly: Assembly) -> None:
        """Write what training has found out of the garment at a step."""
        if self._out is not None:
            write_prepared(self._out, assembly.prepared, step)

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

    def __init__(self, placed: PlacedScene, output: _Output, state: TrainState, steps: int, began: float, settle=None):
        """`state`: on the devices; it is used up. `began`: when training was called, s. settle: see `train_assembly`."""
        self._settle = settle
        spec = placed.assembly.scene.training
        self._placed, self._output, self._state, self._steps, self._began = placed, output, state, steps, began
        self._every, self._check = whole_chunks(spec.checkpoint_every), whole_chunks(spec.validate_every)
        self._first, self._dropped = int(state.step), int(state.dropped)
        self._before = self._dropped
        # One look alone may see nothing but frames that stand still: these are all looks since the last validation.
        self._moved: deque[tuple[float, float]] = deque(maxlen=self._check // CHUNK)  # and swung
        self._timed: tuple[int, float] | None = None  # the step and the time after the first chunk, which compiles

    def run(self, trained: TrainedMotion, timed: Minutes | None = None) -> Run:
        """Take every step that is left, and return the garment, trained on motions of which this is kept.

        timed: the time that it is to take; its end is planned anew where its steps take another time than was measured.
        """
        placed, start, done, looks = self._placed, time.monotonic(), self._first, list(LOOKS if timed else ())
        placed.refresh(placed.local(self._state.params), self._first)
        if self._first:
            placed.rebuild_lists(placed.local(self._state.params))
        self._output.begin_log(self._first)
        while done < self._steps:
            at, count = next(chunks(done, self._steps))
            self._take(at, count)
            done = at + count
            if timed and looks and looks[0] * (self._steps - self._first) <= done - self._first < self._steps - self._first:
                del looks[0]
                self._steps = int(placed.copied(timed.last(done, time.monotonic() - start, self._steps)))
                self._output.plan(self._steps)
        if 2 * (lost := self._dropped - self._before) > self._steps - self._first and jax.process_index() == 0:
            what = f"{lost} of {self._steps - self._first} steps were dropped, in which something was not finite"
            last = placed.diagnose(placed.local(self._state))
            warnings.warn(f"{what}: nothing was learned in them; the last one: {last}", InputWarning, stacklevel=4)
        params = placed.local(self._state.params)
        trained = placed.with_strain(trained, params)
        self._output.write_motion(trained)
        return Run(placed.assembly, params, self._steps, trained=trained)

    def _take(self, at: int, count: int) -> None:
        """Take the steps at to at + count, report them, and keep a checkpoint where one is due."""
        placed, done = self._placed, at + count
        self._state, logs = placed.run_chunk(self._state, at, count, self._steps)
        here, logs = placed.local((self._state, logs))
        # A run that is adapted to a motion keeps the stiffness of all motions.
        due = self._settle is None and done in (whole_chunks(self._steps // 2), self._steps)
        if due and placed.learn_pose_stiffness(here.params, done, self._steps):
            self._output.keep(done, placed.assembly)
        energies = {k: float(v) for k, v in jax.tree.map(lambda a: a[-1], logs).items()}
        try:
            self._output.tell(self._entry(done, here, energies))
        except KeyboardInterrupt:  # `report` ends the run
            self._output.save(done, here)
            raise
        whole = done % self._every == 0
        if self._settle is not None and done == self._steps:
            here = replace(here, params=self._settle(here.params))
            self._state = placed.copied(here)
        if whole or done == self._steps:
            self._output.save(done, here)
        if whole:  # where a run that is resumed begins
            placed.refresh(here.params, done)
        if whole or (done in EARLY and done < self._every):
            placed.rebuild_lists(here.params)

    def _entry(self, done: int, state: TrainState, energies: dict[str, float]) -> Report:
        """Return the report of a chunk: it is measured, and validated where that is due."""
        assembly, seen = self._placed.assembly, self._placed.measure(state.params, done)
        due = done % self._check == 0 or done == self._steps
        message = self._message(state, seen, due, done)
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

    def _message(self, state: TrainState, seen: dict[str, float], due: bool, done: int) -> str:
        """Return why a step of the chunk was dropped, or that alpha does nothing, or little, or "" where all is well."""
        if "moved" in seen:
            self._moved.append((seen["moved"], seen.get("swung", 0.0)))
        if int(state.dropped) > self._dropped:
            self._dropped = int(state.dropped)
            return "step dropped: " + self._placed.diagnose(state)
        if not due or not self._moved:
            return ""
        moved, swung = np.mean(self._moved, axis=0)
        if done == self._steps and self._settle is None and moved < ALONG * swung:
            share = f"{100 * moved / swung:.0f} % of its swing, {moved:.2g} of {swung:.2g} mm"
            return f"the cloth goes along with {share}: alpha does little until it is trained longer"
        return f"the dynamic branch is idle: alpha = 0 and alpha = 1 differ by {moved:.2g} mm" if moved < IDLE else ""

    def _pace(self, done: int) -> float:
        """Return the seconds of a step since the first chunk, 0 after that chunk."""
        now = time.monotonic()
        if self._timed is None:
            self._timed = done, now
            return 0.0
        step, start = self._timed
        return (now - start) / (done - step)


def _validate(run: Run) -> dict[str, float]:
    """Return means over the validation motions: total energy, strain, and penetration by the scene's own query."""
    rows = [summarise(run.evaluate(name, exact=False)) for name in run.assembly.scene.motion.validation]
    return {k: float(np.mean([r[k] for r in rows])) for k in ("total", "strain_mean", "penetrating") if k in rows[0]}


def _versions() -> dict[str, str]:
    names = ("ncs-jax", "jax", "flax", "optax", "orbax-checkpoint")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}

"""Train a garment into a run folder, and resume it."""

from __future__ import annotations

import platform
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.energies.contact.surface import rebuild_lists
from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import summarise
from ncs_jax.network.methods.swing import Swing
from ncs_jax.network.rollout import animate
from ncs_jax.runs.checkpoint import Checkpoints, check_writable, read_run, write_prepared, write_run
from ncs_jax.runs.log import Report, RunLog
from ncs_jax.runs.run import Run, assemble
from ncs_jax.scene.model import pose_body
from ncs_jax.scene.spec import Scene, load_scene, scene_from
from ncs_jax.training.batches import CHUNK, batches, chunks
from ncs_jax.training.devices import batch_mesh, compiled, copied, divided, give_back, local
from ncs_jax.training.loss import with_bodies
from ncs_jax.training.metrics import diagnose, training_metrics
from ncs_jax.training.step import chunk_runner, initial_state

__all__ = ["train"]


IDLE = 0.5  # mm that alpha should make a difference of, at least
LOOKED = 64  # poses that the search for contacts is prepared for,
EARLY = (20, 50, 100)  # after so many steps, in which a garment falls farthest, and with every checkpoint


def train(
    scene: Scene | str | Path,
    out: str | Path | None = None,
    *,
    steps: int | None = None,
    minutes: float | None = None,
    seed: int | None = None,
    resume: bool = False,
    report: Callable[[Report], None] | None = None,
) -> Run:
    """Train a garment from the physics energy alone, on every device that JAX sees.

    Args:
        scene: a scene, or the path of a scene file. out: run folder for checkpoints and logs; None keeps nothing.
        steps: optimiser steps, else the scene's. minutes: instead, as many steps as fit. seed: else the scene's.
        resume: continue the run in `out`; its steps and seed stand. report: called after every chunk of steps.

    After `jax.distributed.initialize`, every process makes the same call, and the first one writes and reports.

    Raises:
        InputError: the scene or the folder is unusable, or the hosts do not divide the batch.
    """
    scene = load_scene(scene) if isinstance(scene, str | Path) else scene
    began = time.monotonic()
    out = None if out is None else Path(out)
    facts = None
    if out is not None and (out / "run.json").exists():
        if not resume:
            raise InputError("a new folder expected", file=out, value="a run", mend="add --resume, or choose another --out")
        facts = read_run(out)
        scene = scene_from(facts["scene"], source=str(out / "run.json"))
    elif resume:
        raise InputError("no run to resume", file=out, mend="leave --resume out to begin one")
    if out is not None:
        check_writable(out)
    assembly = assemble(scene)
    give_back()
    spec, model, network, track = scene.training, assembly.model, assembly.network, assembly.track
    seed = (spec.seed if seed is None else seed) if facts is None else facts["seed"]
    mesh = batch_mesh(spec.batch)
    run_chunk = chunk_runner(network, spec, mesh)
    everywhere = copied(mesh, (model, with_bodies(model, track, spec.batch)))
    # That waited for every process: from here on, one may write.
    if jax.process_index() > 0:
        out = report = None
    look = jax.jit(lambda model, params, track, ends: training_metrics(model, network, spec.window, params, track, ends))
    frames = track.start.shape[0]
    placed = jax.jit(lambda m, p, t: (animate(m, network, p, t, None), jax.vmap(lambda at: pose_body(m, at))(t.matrices)))
    motions, swings = track, jax.jit(network.swings) if isinstance(network, Swing) else None

    def look_at_swings(params):
        """Tell the motions what swings the network gives now, if it has any."""
        nonlocal track, everywhere
        if swings is not None:
            q = swings(params, model, motions)
            track, everywhere = replace(track, swing=q), (everywhere[0], replace(everywhere[1], swing=copied(mesh, q)))

    def look_at_contacts(params):
        """Tell the search for the nearest vertex where the garment is now: what it finds is the same, several times as fast."""
        nonlocal model, everywhere
        if model.terms.collision == "plane" and model.terms.exact:
            some = np.unique(np.linspace(0, frames - 1, LOOKED).astype(int))
            part = replace(jax.tree.map(lambda a: a[some], motions), origin=None)
            cloth, body = map(np.asarray, placed(model, params, part))
            model = replace(model, surface=rebuild_lists(model.surface, list(zip(cloth, body, strict=True))))
            everywhere = (copied(mesh, model), everywhere[1])

    def indices(first, count):
        ends = batches(frames, spec.batch, seed, first, count)
        pairs = np.stack([np.random.default_rng([seed, 1, s]).permutation(spec.batch) for s in range(first, first + count)])
        return ends, pairs.astype(np.int32)

    programs: dict[int, Callable] = {}

    def prepared(first, count, state, steps):
        """A chunk's arguments, its program compiled."""
        arguments = (state, *divided(mesh, indices(first, count)), steps, *everywhere)
        if count not in programs:
            programs[count] = compiled(run_chunk, *arguments)
        return arguments

    def run_steps(first, count, state, steps):
        arguments = prepared(first, count, state, steps)
        return programs[count](*arguments)

    state = initial_state(model, network, seed)
    look_at_swings(state.params)
    if facts is None:  # before anything is written: whether it fits into memory
        prepared(0, CHUNK if minutes is not None else min(CHUNK, steps or spec.steps), copied(mesh, state), 0)
    if out is not None and facts is None:
        write_run(out, {"steps": 0, "seed": seed, "scene": scene.to_dict()})
        write_prepared(out, assembly.prepared)
    checkpoints = None if out is None else Checkpoints(out)
    every = -(-spec.checkpoint_every // CHUNK) * CHUNK
    check = -(-spec.validate_every // CHUNK) * CHUNK
    if facts is not None and facts["steps"]:
        steps = facts["steps"]
    elif minutes is not None:

        def chunk(state):
            state, _ = run_steps(0, CHUNK, state, CHUNK)
            look(model, local(mesh, state.params), track, jnp.arange(4) % frames)
            return jax.block_until_ready(state)

        pace = _seconds(chunk, copied(mesh, initial_state(model, network, seed))) / CHUNK
        if scene.motion.validation:
            pace += _seconds(lambda s: _validate(Run(assembly, s.params)) and s, state) / check
        if checkpoints is not None and checkpoints.latest() is None:
            start = time.monotonic()
            checkpoints.save(0, state)
            pace += (time.monotonic() - start) / every
        steps = max(CHUNK, int((60 * minutes - (time.monotonic() - began)) / (1.05 * pace)) // CHUNK * CHUNK)
        steps = int(copied(mesh, steps))
    else:
        steps = steps or spec.steps
    if out is not None and (facts is None or not facts["steps"]):
        facts = {"steps": steps, "seed": seed, "scene": scene.to_dict(), "versions": _versions()}
        write_run(out, facts)

    if resume and checkpoints is not None and checkpoints.latest() is not None:
        state = checkpoints.restore(state)
    state = copied(mesh, state)
    first = int(state.step)
    look_at_swings(local(mesh, state.params))
    if first:
        look_at_contacts(local(mesh, state.params))
    log = None if out is None else RunLog(out, first)
    dropped, started, pace = int(state.dropped), time.monotonic(), None
    moved: deque[float] = deque(maxlen=check // CHUNK)  # of one look alone, it may be that all its frames stand still
    for at, count in chunks(first, steps):
        state, logs = run_steps(at, count, state, steps)
        here, logs = local(mesh, (state, logs))
        if pace is None:  # this chunk was compiled
            give_back()
        energies = {k: float(v) for k, v in jax.tree.map(lambda a: a[-1], logs).items()}
        done = at + count
        seen = {
            k: float(v)
            for k, v in look(model, here.params, track, batches(frames, spec.batch, seed, done - 1, 1)[0, :4]).items()
        }
        message = ""
        if int(here.dropped) > dropped:
            dropped = int(here.dropped)
            message = "step dropped: " + diagnose(model, network, here.params, track, here.fault)
        validation = None
        if scene.motion.validation and (done % check == 0 or done == steps):
            validation = _validate(Run(assembly, here.params))
        if "moved" in seen:
            moved.append(seen["moved"])
        if not message and moved and (mean := sum(moved) / len(moved)) < IDLE and (done % check == 0 or done == steps):
            message = f"the dynamic branch is idle: alpha = 0 and alpha = 1 differ by {mean:.2g} mm"
        now = time.monotonic()
        if pace is None:  # the first chunk compiles: it does not count for the pace
            pace, started = 0.0, now
        else:
            pace = (now - started) / (done - first - min(CHUNK, count))
        entry = Report(
            done, steps, energies, seen["strain"], seen.get("penetrating", 0.0), dropped, now - began,
            pace * (steps - done), message, validation, 1 if mesh is None else mesh.size, seen.get("moved"),
        )  # fmt: skip
        if log is not None:
            log.write(entry)
        if report is not None:
            report(entry)
        if checkpoints is not None and (done % every == 0 or done == steps):
            checkpoints.save(done, here)
        if done % every == 0:  # where a run that is resumed begins
            look_at_swings(here.params)
        if done % every == 0 or (done in EARLY and done < every):
            look_at_contacts(here.params)
    if checkpoints is not None:
        checkpoints.close()
    if log is not None:
        log.close()
    return Run(assembly, local(mesh, state.params), steps)


def _seconds(work: Callable, state) -> float:
    """How long `work(state) -> state` takes once it is compiled."""
    state = work(state)
    start = time.monotonic()
    work(state)
    return time.monotonic() - start


def _validate(run: Run) -> dict[str, float]:
    """Mean over the validation motions of total energy, strain and penetration, this by the scene's own query."""
    rows = [summarise(run.evaluate(name, exact=False)) for name in run.assembly.scene.motion.validation]
    return {k: float(np.mean([r[k] for r in rows])) for k in ("total", "strain_mean", "penetrating") if k in rows[0]}


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{p: version(p) for p in ("ncs-jax", "jax", "flax", "optax", "orbax-checkpoint")},
    }

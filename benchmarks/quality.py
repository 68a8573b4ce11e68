"""How long training takes to a given energy: seconds of training alone, and the mean total energy over all frames.

    python -m benchmarks.quality [SCENE] [--steps 300] [--every 100] [--energies 0.28 0.27] [--seed 1] [--quick] [--json FILE]

Trains as `ncs train --steps N` does and stops the clock to measure the parameters so far: over all frames of the training
motions, as `experiments/seeds.py` does, inertia included; what is inside the body is told by the scene's own query. Compiling
is apart. Without --energies they are those at which 50, 80, 90, 95 and 99 % of the fall from the first measurement to the
lowest lie behind. The least is that of a step with the first batch (`benchmarks/work.py`).
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import work
from benchmarks.measure import clock, clocks, read, run, table
from benchmarks.training import ready
from experiments.seeds import measure
from ncs_jax import Run
from ncs_jax.training.batches import CHUNK, batches, chunks
from ncs_jax.training.step import chunk_runner, initial_state

FALL = (0.5, 0.8, 0.9, 0.95, 0.99)
SHOWN = {"total": "total J", "strain_mean": "strain %", "penetrating": "inside %", "out_of_balance": "off balance g"}


def benchmark(options) -> dict:
    """Train a scene and measure it again and again; seconds until each energy is reached."""
    steps, every = (2 * CHUNK, CHUNK) if options.quick else (options.steps, options.every)
    assembly, seed = ready(read(options.scene)), options.seed
    model, network, track, spec = assembly.model, assembly.network, assembly.track, assembly.scene.training
    program = chunk_runner(network, spec)

    def chunk(state, first, count):
        ends = jnp.asarray(batches(track.start.shape[0], spec.batch, seed, first, count))
        mixed = [np.random.default_rng([seed, 1, s]).permutation(spec.batch) for s in range(first, first + count)]
        start = time.perf_counter()
        state, _ = program(state, ends, jnp.asarray(np.stack(mixed).astype(np.int32)), steps, model, track)
        return jax.block_until_ready(state), time.perf_counter() - start

    compiling = 0.0
    for count in {count for _, count in chunks(0, steps)}:  # every length of a chunk is a program of its own
        state, first = chunk(initial_state(model, network, seed), 0, count)
        compiling += first - chunk(state, 0, count)[1]
    state, passed, each = initial_state(model, network, seed), 0.0, []
    snapshots: list[dict[str, float]] = []
    for first, count in chunks(0, steps):
        state, seconds = chunk(state, first, count)
        passed, done = passed + seconds, first + count
        each.append(seconds / count)
        if done % (-(-every // CHUNK) * CHUNK) == 0 or done == steps:
            means = measure(Run(assembly, state.params, done), exact=False)
            snapshots.append({"step": done, "seconds": passed, **{name: means[name] for name in SHOWN if name in means}})
    totals = np.array([s["total"] for s in snapshots])
    wanted = options.energies or [float(totals[0] - share * (totals[0] - totals.min())) for share in FALL]
    reached = [{"energy": e, **next((s for s in snapshots if s["total"] <= e), {})} for e in wanted]
    needed = work.training(assembly, state.params, batches(track.start.shape[0], spec.batch, seed, 0, 1)[0])
    return {
        "steps": steps,
        "dropped": int(state.dropped),
        "snapshots": snapshots,
        "reached": reached,
        "rows": {"a step": {"seconds": clock(each, compiling), "work": needed["step"]}},
    }


def show(figures: dict) -> str:
    """What was measured, and when each energy was reached."""
    names = [name for name in SHOWN if name in figures["snapshots"][0]]
    rows = [[str(s["step"]), s["seconds"], f"{s['total']:.4f}", *(s[name] for name in names[1:])] for s in figures["snapshots"]]
    reached = [[f"{r['energy']:.4f}", r.get("step", "not"), r.get("seconds", "reached")] for r in figures["reached"]]
    seen = table(["step", "s", *(SHOWN[name] for name in names)], rows, 13)
    return "\n\n".join([clocks(figures["rows"]), seen, table(["first at or under, J", "step", "s"], reached, 13)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    return run(
        __doc__, benchmark, show, arguments,
        steps=(300, "of the training, whose schedule ends there"), every=(100, f"steps between measurements, in {CHUNK}s"),
        energies=((), "to be reached, J"), seed=(1, "of the training"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

"""What XLA counts in the compiled programs: a slow-down is seen without a stopwatch.

    python -m benchmarks.cost [SCENE] [--quick] [--json FILE]

Of a training step, a whole motion, a streamed frame and a simulated frame of both solvers: `flops` and `bytes` accessed by
XLA's own cost analysis, the `temporary` bytes that the program needs, and the `rounds` of its loops of fixed length, since the
analysis counts a loop's body once. How often any other loop goes round it does not see. The scene of the tests is compared with
recorded counts by `tests/test_cost.py`. The counts are those of one version of JAX on one kind of processor.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.measure import read, run, table
from benchmarks.training import batch, ready
from ncs_jax.network.rollout import animate
from ncs_jax.network.rollout import stepper as rollout_of
from ncs_jax.prepare.build import Assembly
from ncs_jax.simulation.implicit_euler import simulator_from
from ncs_jax.simulation.implicit_euler import stepper as simulation_of
from ncs_jax.simulation.solver.minimise import Settings
from ncs_jax.training.step import chunk_runner, initial_state

COUNTS = ("flops", "bytes", "temporary", "rounds")


def counted(lowered) -> dict[str, int]:
    """What XLA counts in a program."""
    compiled = lowered.compile()
    analysis, text = compiled.cost_analysis(), compiled.as_text()
    rounds = re.findall(r'known_trip_count["\\\s]*:\s*\{["\\\s]*n["\\\s]*:\s*["\\]*(\d+)', text)
    counts = analysis["flops"], analysis["bytes accessed"], compiled.memory_analysis().temp_size_in_bytes, sum(map(int, rounds))
    return dict(zip(COUNTS, map(int, counts), strict=True))


def programs(assembly: Assembly) -> dict[str, Callable]:
    """How each program of a scene is lowered."""
    model, network, track = assembly.model, assembly.network, assembly.track
    state = initial_state(model, network, 0)
    rollout: Any = rollout_of(model, network, state.params)
    chunk, indices = chunk_runner(network, assembly.scene.training), batch(assembly, 1)

    def simulated(solver):
        def follow(state, simulator, matrices):
            return simulation_of(simulator, Settings(solver)).follow(state, matrices)

        simulator = simulator_from(model)
        begun = simulation_of(simulator, Settings(solver)).init()
        return jax.jit(follow).lower(begun, simulator, track.matrices[0])

    turn, place = jnp.zeros((len(model.skeleton.parents), 3, 3), model.basis.dtype), jnp.zeros(3, model.basis.dtype)
    return {
        "training step": lambda: chunk.lower(state, *indices, 1000, model, track),
        "whole motion": lambda: jax.jit(animate, static_argnums=1).lower(model, network, state.params, track),
        "streamed frame": lambda: jax.jit(rollout.step).lower(rollout.init(), turn, place),
        "quasi_newton": lambda: simulated("quasi_newton"),
        "newton": lambda: simulated("newton"),
    }


def benchmark(options) -> dict:
    """Count all programs of a scene; `quick`: but for Newton's, which takes longest to compile."""
    lowered = programs(ready(read(options.scene)))
    return {"rows": {name: counted(lower()) for name, lower in lowered.items() if not options.quick or name != "newton"}}


def show(figures: dict) -> str:
    """The table."""
    return table(["", *COUNTS], [[name, *row.values()] for name, row in figures["rows"].items()], 12)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    return run(__doc__, benchmark, show, arguments)


if __name__ == "__main__":
    sys.exit(main())

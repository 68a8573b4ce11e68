"""What a simulated frame costs with both solvers, how well it is solved, and how the time grows with the garment.

    python -m benchmarks.simulator [SCENE] [--frames 30] [--iterations 9] [--growth] [--quick] [--json FILE]

Newton solves every frame to 0.1 g; quasi-Newton stops after a fixed number of iterations, 9, and says what is left. Seconds a
frame are those of a stream, compile time and the first, static, frame apart. `--growth` instead divides every triangle of the
scene's garment in four, and again, and measures so many iterations of both. The least is that of the median number of
iterations: of one sparse factor each for Newton and one a frame for quasi-Newton, and of reading it twice to solve with it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from benchmarks import work
from benchmarks.growth import finer
from benchmarks.measure import Work, clock, read, run, table
from ncs_jax import assemble
from ncs_jax.prepare.build import Assembly
from ncs_jax.simulation.implicit_euler import simulator_from, stepper
from ncs_jax.simulation.solver.minimise import CONVERGED, Settings

FAST = Settings("quasi_newton", tolerance=1.0)
TIMES = (1, 4, 16)  # as many triangles


def stream(assembly: Assembly, settings: Settings, frames: int) -> dict:
    """Simulate frame by frame; seconds, iterations and residuals of every frame but the first."""
    simulator = simulator_from(assembly.model)
    fixed, kind = jax.tree.flatten(simulator)
    state, form = jax.tree.flatten(stepper(simulator, settings).init())

    @jax.jit
    def step(fixed, state, matrices):  # of plain arrays: the classes check their types, which `lower` does not have
        simulation = stepper(jax.tree.unflatten(kind, fixed), settings)
        state, _ = simulation.follow(jax.tree.unflatten(form, state), matrices)
        return jax.tree.leaves(state)

    start, rows = time.perf_counter(), []
    program = step.lower(fixed, state, assembly.track.matrices[0]).compile()
    compiled = time.perf_counter() - start
    frames = min(frames, len(assembly.track.matrices))
    for t in range(frames):
        start = time.perf_counter()
        state = jax.block_until_ready(program(fixed, state, assembly.track.matrices[t]))
        s = jax.tree.unflatten(form, state).solution
        rows.append((time.perf_counter() - start, int(s.iterations), float(s.residual), int(s.status)))
    first, rest = rows[0], np.array(rows[1:])
    seconds, iterations, residual, status = rest.T
    typical, newton = float(np.median(iterations)), settings.solver == "newton"
    factor, solve = work.factor(simulator.order, 3 if newton else 1, assembly.model.garment.mesh.rest.dtype.itemsize)
    factors = typical if newton else 1
    return {
        "first": first[0],
        "seconds": clock(seconds, compiled) | {"p90": float(np.percentile(seconds, 90))},
        "each": float(np.median(seconds / np.maximum(iterations, 1))),
        "iterations": {"median": typical, "max": float(iterations.max())},
        "residual": {"median": float(np.median(residual)), "max": float(residual.max())},
        "unsolved": int(np.sum(status != CONVERGED)),
        "frames": frames,
        "work": Work(factors * factor.flops + typical * solve.flops, factors * factor.bytes + typical * solve.bytes),
    }


def benchmark(options) -> dict:
    """Measure both solvers on a scene, or some iterations of each on ever finer garments; `quick`: quasi-Newton alone."""
    spec, rows, iterations = read(options.scene), {}, options.iterations
    frames = 3 if options.quick else max(options.frames, 2)
    solvers = [replace(FAST, iterations=iterations)] if options.quick else [Settings(), replace(FAST, iterations=iterations)]
    with tempfile.TemporaryDirectory() as folder:
        for times in TIMES if options.growth and not options.quick else TIMES[:1]:
            finest = finer(spec, Path(folder), garment=times)
            assembly = assemble(finest.without_network())
            for settings in solvers:
                if options.growth:
                    settings = Settings(settings.solver, tolerance=1e-9, iterations=iterations, first=iterations)
                row = stream(assembly, settings, frames)
                rows[f"{settings.solver}, {len(assembly.model.garment.mesh.rest)} vertices"] = row
    return {"rows": rows}


def show(figures: dict) -> str:
    """The table."""
    heads = ["s a frame, residual in g", "compile", "min", "median", "p90", "max", "least", "% of limit"]
    heads += ["iterations", "each", "residual", "worst", "unsolved"]
    lines = []
    for name, row in figures["rows"].items():
        times = [row["seconds"][k] for k in ("compile", "min", "median", "p90", "max")]
        solved = [row["iterations"]["median"], row["each"], *row["residual"].values()]
        lines.append([name, *times, row["least"], 100 * row["share"], *solved, f"{row['unsolved']} of {row['frames'] - 1}"])
    return table(heads, lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    return run(
        __doc__, benchmark, show, arguments, scene=str(Path(__file__).parent / "tshirt.toml"),
        frames=(30, "of the scene's first motion, its first too"), iterations=(9, "of quasi-Newton; with --growth of both"),
        growth=(False, "some iterations on ever finer garments"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

"""The dial between a network and its simulation: what some iterations of the solver on every frame cost, and give.

    python -m benchmarks.dial RUN [--motion ncs:mixed] [--frames 120] [--iterations 1,2,4,8,16,32] [--json FILE]

A row for the network, each number of iterations, and the simulation to 0.005 g. Milliseconds a frame are medians of processor
and wall-clock time, without the network's own few. Residual (g), energy (J) and strain are means over frames, by the energy
that the solver minimises. The distance from the simulation (mm) is the mean over vertices and frames.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import ncs_jax
from ncs_jax import InputError
from ncs_jax.metrics.quality import measure
from ncs_jax.runs.refine import with_smooth_contact

BALANCE = 0.005  # g: of the simulation


def dial(folder: str, motion: str, frames: int, iterations: list[int]) -> list[dict]:
    """Return a row for the network, each number of iterations, and the simulation."""
    run = ncs_jax.load_run(folder)
    scene, record = run.assembly.scene, run.motion(motion)
    record = replace(record, poses=record.poses[:frames], translation=record.translation[:frames])
    track = run.track(record)
    judge = with_smooth_contact(run.assembly, track)
    smooth = replace(scene.physics, collision=replace(scene.physics.collision, distance="smooth"))
    exact = replace(scene, physics=smooth, simulation=replace(scene.simulation, tolerance=BALANCE))
    done = ncs_jax.simulate(exact, f"{motion}[0:{frames}]", report=lambda progress: None)
    rows = []

    def row(name: str, x: np.ndarray, cpu: float, wall: float) -> None:
        found = measure(judge, x, track)
        away = 1000 * float(np.linalg.norm(x - done.vertices, axis=-1).mean())
        means = {q: float(found[q].mean()) for q in ("out_of_balance", "total", "strain_mean", "penetrating")}
        rows.append({"iterations": name, "cpu_ms": cpu, "wall_ms": wall, **means, "distance_mm": away})
        print("".join(f"{v:>12}" if isinstance(v, str) else f"{v:12.4g}" for v in rows[-1].values()), flush=True)

    print("".join(f"{c:>12}" for c in ("iterations", "cpu, ms", "wall, ms", "g", "J", "strain, %", "inside, %", "away, mm")))
    row("0", run.animate(record), 0.0, 0.0)
    for count in iterations:
        marks: list[tuple[float, float]] = []

        def mark(*_, marks=marks) -> None:
            marks.append((time.process_time(), time.perf_counter()))

        x = run.animate(record, refine=count, report=mark)
        cpu, wall = (1000 * float(np.median(np.diff([m[k] for m in marks]))) for k in (0, 1))
        row(str(count), x, cpu, wall)
    row("simulation", done.vertices, float("nan"), 1000 * float(np.median(done.seconds)))
    return rows


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dial", description=__doc__.splitlines()[0])
    parser.add_argument("run", metavar="RUN", help="folder that ncs train made")
    parser.add_argument("--motion", default="ncs:mixed", help="file or ncs:NAME (default: ncs:mixed)")
    parser.add_argument("--frames", type=int, default=120, help="of the motion, from its first (default: 120)")
    parser.add_argument("--iterations", default="1,2,4,8,16,32", metavar="N,N", help="default: 1,2,4,8,16,32")
    parser.add_argument("--json", metavar="FILE", help="keep the figures")
    options = parser.parse_args(arguments)
    try:
        rows = dial(options.run, options.motion, options.frames, [int(n) for n in options.iterations.split(",")])
    except InputError as error:
        print(f"dial: {error}", file=sys.stderr)
        return 2
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

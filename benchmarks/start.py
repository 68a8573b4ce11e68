"""How long a host in Python waits: a fresh process that loads a run folder and streams its first frame, programs cached.

    python -m benchmarks.start RUN [--repeats 5] [--json FILE]

Each repeat is a process by itself, after one that fills the compilation cache; its settings are JAX's own, all but the folder.
Wall-clock and processor seconds by stage, medians of the repeats: the former are the machine's, shared as it is; the latter are
the work's. Byte code is kept, as Python does unless it is told otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from ncs_jax import InputError

STAGES = """
import json, sys, time
marks = [("", time.perf_counter(), time.process_time())]
def mark(name):
    marks.append((name, time.perf_counter(), time.process_time()))
import jax.numpy, numpy as np
mark("import jax")
import ncs_jax
mark("import ncs_jax")
run = ncs_jax.load_run(sys.argv[1])
mark("load_run")
model = run.assembly.model
init, step = ncs_jax.stepper(model, run.assembly.network, run.params)
eye = np.broadcast_to(np.eye(3, dtype=np.float32), (len(model.source_joints), 3, 3))
_, x = jax.jit(step)(init(), eye, np.zeros(3, np.float32), 1.0)
x.block_until_ready()
mark("first frame")
print(json.dumps({b[0]: [b[1] - a[1], b[2] - a[2]] for a, b in zip(marks, marks[1:])}))
"""


def started(run: str, repeats: int) -> dict[str, dict[str, float]]:
    """Median seconds {stage: {"wall": s, "cpu": s}} and their sums under `all`."""
    with tempfile.TemporaryDirectory() as cache:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "PYTHONDONTWRITE"))}
        command = [sys.executable, "-c", STAGES, run]
        lines = []
        for _ in range(repeats + 1):
            done = subprocess.run(
                command, capture_output=True, text=True, env={**kept, "JAX_COMPILATION_CACHE_DIR": cache}, check=False
            )
            if done.returncode:
                raise InputError((done.stderr.strip().splitlines() or ["it broke off"])[-1], file=run)
            lines.append(json.loads(done.stdout.splitlines()[-1]))
    found = {stage: [statistics.median(line[stage][i] for line in lines[1:]) for i in (0, 1)] for stage in lines[0]}
    found["all"] = [statistics.median(sum(s[i] for s in line.values()) for line in lines[1:]) for i in (0, 1)]
    return {stage: {"wall": wall, "cpu": cpu} for stage, (wall, cpu) in found.items()}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.start", description=__doc__.splitlines()[0])
    parser.add_argument("run", metavar="RUN", help="folder that ncs train made")
    parser.add_argument("--repeats", type=int, default=5, help="processes that are timed (default: 5)")
    parser.add_argument("--json", metavar="FILE", help="keep the figures")
    options = parser.parse_args(arguments)
    try:
        rows = started(options.run, max(options.repeats, 1))
    except InputError as error:
        print(f"start: {error}", file=sys.stderr)
        return 2
    print(f"{'seconds':16} {'wall':>6} {'cpu':>6}")
    for stage, row in rows.items():
        print(f"{stage:16} {row['wall']:6.2f} {row['cpu']:6.2f}")
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How long a host in Python waits for its first frame, and a user for a command: fresh processes, programs cached or not.

    python -m benchmarks.start RUN [--repeats 5] [--json FILE]
    python -m benchmarks.start --command "check ncs:skirt" [--json FILE]

The first loads a run folder and streams a frame, programs cached. The second runs a command of `ncs` twice, from an empty cache
and again, and counts the programs that JAX compiles or loads; of `train SCENE` all until the first report, after 20 steps. Each
repeat is a process by itself; of a run folder those after one that fills the compilation cache. Settings are JAX's own, all but
the folder. Wall-clock and processor seconds by stage, medians of the repeats: the former are the machine's, as shared; the
latter are the work's. Byte code is kept, as Python does unless it is told otherwise.
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

COMMAND = """
import json, resource, sys, time
began, words, count = time.perf_counter(), sys.argv[1:], []
import jax
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: count.append(name))
def told():
    used = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    programs = sum("backend_compile" in name for name in count)
    print("\\n" + json.dumps({"wall": time.perf_counter() - began, "cpu": used, "programs": programs}), flush=True)
if words[0] == "train":
    from ncs_jax.runs.train import train
    class Begun(Exception):
        pass
    def report(entry):
        raise Begun
    try:
        train(words[1], steps=1000, report=report)
    except Begun:
        told()
else:
    from ncs_jax.cli import main
    main(words)
    told()
"""


def waited(words: list[str]) -> dict[str, dict[str, float]]:
    """Seconds of a command and its programs, {"cold" or "cached": {"wall": s, "cpu": s, "programs": count}}."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "PYTHONDONTWRITE"))}
    found = {}
    with tempfile.TemporaryDirectory() as cache:
        chosen = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        env = {**kept, **chosen, "OPENBLAS_NUM_THREADS": "1"}
        for state in ("cold", "cached"):
            command = [sys.executable, "-c", COMMAND, *words]
            done = subprocess.run(command, capture_output=True, text=True, env=env, check=False)
            rows = [line for line in done.stdout.splitlines() if line.startswith('{"wall"')]
            if done.returncode or not rows:
                raise InputError((done.stderr.strip().splitlines() or ["it broke off"])[-1], field="--command", value=words)
            found[state] = json.loads(rows[-1])
    return found


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
    parser.add_argument("run", metavar="RUN", nargs="?", help="folder that ncs train made")
    parser.add_argument("--command", metavar="WORDS", help='a command of ncs instead, such as "check ncs:skirt"')
    parser.add_argument("--repeats", type=int, default=5, help="processes that are timed (default: 5)")
    parser.add_argument("--json", metavar="FILE", help="keep the figures")
    options = parser.parse_args(arguments)
    try:
        if options.command is None and options.run is None:
            raise InputError(
                "a run folder or a command is needed", field="RUN", mend='give one, or --command "check ncs:skirt"'
            )
        rows = waited(options.command.split()) if options.command else started(options.run, max(options.repeats, 1))
    except InputError as error:
        print(f"start: {error}", file=sys.stderr)
        return 2
    print(f"{'seconds':16} {'wall':>6} {'cpu':>6}")
    for stage, row in rows.items():
        print(
            f"{stage:16} {row['wall']:6.2f} {row['cpu']:6.2f}"
            + (f"{row['programs']:6.0f} programs" if "programs" in row else "")
        )
    if options.json:
        Path(options.json).write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

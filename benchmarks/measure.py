"""What all benchmarks share: clocks that keep compiling apart, the machine's own limits, how figures are shown and kept.

A benchmark is a function of the command line's options that returns figures, among them rows {name: {"seconds": clock, "work":
Work}}. `run` measures the machine's limits before and after and sets every row beside the least that its work could take.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ncs_jax import InputError
from ncs_jax.scene.spec import Scene, load_scene

ROUNDS = 8  # of a part in one compiled loop
SIDE = 2048  # of the matrices whose product tells the arithmetic limit
COPIES = (1 << 20, 1 << 24, 1 << 28)  # bytes moved by copies, that tell the limits of the near cache, the far one, the memory


class Work(NamedTuple):
    """What a computation cannot avoid: the arithmetic of its matrix products, and the bytes it has to read and write.

    Arithmetic outside of matrix products is not counted, nor is anything that could stay in registers or in a cache.
    """

    flops: float = 0.0
    bytes: float = 0.0


@dataclass(frozen=True)
class Limits:
    """The machine during this run: flop/s of a large float32 product in JAX; byte/s, read and written, of copies by size."""

    flops: float
    copies: dict[int, float]

    def least(self, work: Work) -> float:
        """Seconds that `work` takes at least, arithmetic and traffic at the same time. What is small may stay in a cache."""
        reached = [rate for size, rate in self.copies.items() if size <= max(work.bytes, min(self.copies))]
        return max(work.flops / self.flops, work.bytes / min(reached))

    def best(self, other: Limits) -> Limits:
        """The faster of two measurements."""
        return Limits(max(self.flops, other.flops), {k: max(rate, other.copies[k]) for k, rate in self.copies.items()})


def limits(quick: bool = False) -> Limits:
    """Measure them: the best of several rounds on all cores that this process may use; `quick`: too small to mean much."""
    side, sizes, rounds = (256, COPIES[:1], 3) if quick else (SIDE, COPIES, 7)
    a = jnp.ones((side, side), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    best = timed(lambda: product(a), rounds)["min"]
    return Limits(2 * side**3 / best, {size: size / _copying(size, rounds) for size in sizes})


def _copying(size: int, rounds: int) -> float:
    often = max(1, (1 << 24) // size)
    if jax.default_backend() != "cpu":
        return looped(lambda x: x + 1, jnp.ones(size // 8, jnp.float32), repeats=rounds, rounds=8 * often)["min"]
    cores = _cores()
    source, target = np.ones((2, cores, size // 8 // cores), np.float32)

    def copy(core):
        for _ in range(often):
            np.copyto(target[core], source[core])

    with ThreadPoolExecutor(cores) as pool:  # NumPy's copy lets other threads run
        return timed(lambda: list(pool.map(copy, range(cores))), rounds, often)["min"]


# --- clocks and memory ------------------------------------------------------------------------------------------------


def clock(seconds: Sequence[float] | np.ndarray, compiling: float = 0.0) -> dict[str, float]:
    """What is told of repeats, in seconds."""
    a = np.asarray(seconds)
    figures = {"min": a.min(), "median": np.median(a), "p99": np.percentile(a, 99), "max": a.max()}
    return {"compile": compiling, "repeats": len(a), **{name: float(figure) for name, figure in figures.items()}}


def timed(work: Callable, repeats: int, count: int = 1) -> dict[str, float]:
    """Seconds of the first call less a typical one (`compile`), and of `repeats` further ones, each divided by `count`."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append((time.perf_counter() - start) / count)
    return clock(seconds[1:], count * max(0.0, seconds[0] - float(np.median(seconds[1:]))))


def advanced(step: Callable, carry, *fixed, repeats: int, rounds: int = ROUNDS) -> dict[str, float]:
    """Seconds of `carry = step(carry, *fixed)`, `rounds` of it in one compiled loop, in the memory that the last round had."""

    def loop(carry, *fixed):
        return lax.fori_loop(0, rounds, lambda _, carry: step(carry, *fixed), carry)

    program, held = jax.jit(loop, donate_argnums=0), jax.tree.map(jnp.array, carry)

    def several():
        nonlocal held
        held = program(held, *fixed)
        return held

    return timed(several, repeats, rounds)


def nudged(tree, by):
    """The first number of every array with a fraction plus `by`: next to no work, and all that reads them must follow it."""

    def of(leaf):
        fraction = jnp.issubdtype(leaf.dtype, jnp.floating) and leaf.size > 0
        return leaf.at[(0,) * leaf.ndim].add(by.astype(leaf.dtype)) if fraction else leaf

    return jax.tree.map(of, tree)


def looped(function: Callable, varied, *fixed, repeats: int, rounds: int = ROUNDS) -> dict[str, float]:
    """Seconds of `function(varied, *fixed)`, `rounds` of it in one compiled loop, as it stands in the scan of a training.

    A part that is a program of its own gets fresh pages for what it writes, which may cost more than the part. So what is
    written is carried from round to round, and one number of every array of `varied` depends on the round before, without
    which XLA would do the work once and not in every round: `varied` is to be that on which all the work depends.
    """

    def step(carry, *fixed):
        inputs, outputs = carry
        first = [jnp.ravel(leaf)[0].astype(jnp.float32) for leaf in outputs if leaf.size]
        inputs = nudged(inputs, 1e-30 * sum(first, start=jnp.zeros((), jnp.float32)))
        return inputs, jax.tree.leaves(function(inputs, *fixed))

    shapes = jax.eval_shape(lambda *a: jax.tree.leaves(function(*a)), varied, *fixed)
    outputs = [jnp.zeros(s.shape, s.dtype) for s in shapes]
    return advanced(step, (varied, outputs), *fixed, repeats=repeats, rounds=rounds)


def peak_memory() -> int:
    """The most bytes that this process has had in memory since `forget_peak`; where there is an accelerator, ever on that."""
    told = jax.devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    if told:
        return int(told["peak_bytes_in_use"])
    if here := _found("/proc/self/status", "VmHWM"):  # unlike `getrusage` without what the process was started from
        return 1024 * int(here.split()[0])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def forget_peak() -> None:
    """What was freed until now no longer counts, where the system can do that: then a peak is that of a part alone."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def apart(module: str, arguments: Sequence[str], timeout: float) -> dict[str, Any]:
    """The JSON object that `python -m module arguments` prints as its last line; where it fails, {"failed": why}."""
    command = [sys.executable, "-m", module, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, cwd=Path(__file__).parents[1])
    except subprocess.TimeoutExpired:
        return {"failed": f"took longer than {timeout:.0f} s"}
    if done.returncode:
        said = (done.stderr.splitlines() or [f"exit code {done.returncode}"])[-1]
        scarce = done.returncode == -9 or any(word in said for word in ("RESOURCE_EXHAUSTED", "MemoryError", "bad_alloc"))
        return {"failed": "does not fit into memory" if scarce else said}
    return json.loads(done.stdout.splitlines()[-1])


# --- where it ran -----------------------------------------------------------------------------------------------------


def _cores() -> int:
    """How many of the processor's cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _found(path: str, key: str) -> str:
    """The value of the first line `key : value` of a file that only Linux has; empty where there is none."""
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def machine() -> dict[str, Any]:
    """What this runs on; `load`: how many programs wanted a core in the minute before."""
    return {
        "processor": _found("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": _cores(),
        "device": str(getattr(jax.devices()[0], "device_kind", jax.default_backend())),
        "memory": 1024 * int((_found("/proc/meminfo", "MemTotal") or "0").split()[0]),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


# --- what is shown ----------------------------------------------------------------------------------------------------


def table(heads: Sequence[str], rows: Sequence[Sequence[object]], width: int = 10) -> str:
    """Aligned text: the first column to the left, all others to the right; three digits of a number, nothing for None."""

    def shown(cell) -> str:
        if isinstance(cell, float):
            return f"{cell:.3g}" if abs(cell) < 1000 else f"{cell:.0f}"
        return "" if cell is None else str(cell)

    cells = [[*map(shown, row)] for row in (heads, *rows)]
    first = max(len(row[0]) for row in cells)
    return "\n".join((f"{row[0]:{first}}" + "".join(f" {cell:>{width}}" for cell in row[1:])).rstrip() for row in cells)


def clocks(rows: dict[str, dict], extra: Sequence[str] = ()) -> str:
    """The table of rows: seconds compiling, then ms, the least that it could be, and how near the median comes to that."""
    heads = ["", "compile s", "repeats", "min ms", "median ms", "p99 ms", "max ms", "least ms", "% of limit", *extra]
    lines: list[list[object]] = []
    for name, row in rows.items():
        if "failed" in row:
            lines.append([f"{name}: {row['failed']}"])
            continue
        t = row["seconds"]
        times = [1000 * t[k] for k in ("min", "median", "p99", "max")]
        lines.append(
            [name, t["compile"], t["repeats"], *times, 1000 * row["least"], 100 * row["share"], *(row.get(k) for k in extra)]
        )
    return table(heads, lines)


def finished(rows: dict[str, dict], bounds: Limits) -> None:
    """Give every row the least time of its work, that of one of `times` where given, and which share it is of the median."""
    for row in rows.values():
        if "work" in row:
            row["work"] = Work(*row["work"])
            row["least"] = bounds.least(row["work"]) / row.get("times", 1)
            row["share"] = row["least"] / row["seconds"]["median"]
            row["work"] = row["work"]._asdict()


def run(
    doc: str,
    measure: Callable[[Any], dict],
    show: Callable[[dict], str],
    arguments: Sequence[str] | None,
    scene: str = "ncs:tshirt",
    **options: tuple[Any, str],
) -> int:
    """Run a benchmark from the command line: 0, or 2 for input that cannot be used.

    Args:
        doc: of the module. measure: from the options to the figures. show: what to print of them. scene: the default one.
        options: default and meaning of further options by name; those with an empty tuple take several numbers, with a string a
            string.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=scene, help=f"scene file, or ncs:NAME (default: {scene})")
    parser.add_argument("--quick", action="store_true", help="as little of everything as still runs, to see that it does")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    for name, (default, text) in options.items():
        flag = "--" + name.replace("_", "-")
        if default is False:
            parser.add_argument(flag, action="store_true", help=text)
        elif isinstance(default, str):
            parser.add_argument(flag, default=default, metavar="TEXT", help=text)
        elif default == ():
            parser.add_argument(flag, type=float, nargs="+", default=default, help=text)
        else:
            parser.add_argument(flag, type=_whole, default=default, metavar="N", help=f"{text} (default: {default})")
    chosen = parser.parse_args(arguments)
    name = doc.split("python -m ")[1].split()[0].rpartition(".")[2]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `ncs` does
    where = machine()
    try:
        if chosen.json and not Path(chosen.json).absolute().parent.is_dir():
            raise InputError("no such folder", file=chosen.json, field="--json", mend="make the folder first")
        before = limits(chosen.quick)
        forget_peak()
        figures = measure(chosen)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    bounds = before.best(limits(chosen.quick))  # whatever else ran on the machine in between
    finished(figures["rows"], bounds)
    versions = {"python": platform.python_version(), **{n: version(n) for n in ("ncs-jax", "jax", "jaxlib", "numpy")}}
    shared = {"options": vars(chosen), "limits": bounds.__dict__, "machine": where, "versions": versions}
    print(f"{name} of {chosen.scene}: " + ", ".join(f"{k} {v}" for k, v in figures.items() if isinstance(v, int | str)))
    print(show(figures))
    rates = ", ".join(f"{rate / 1e9:.0f} ({size / 2**20:.0f} MB)" for size, rate in bounds.copies.items())
    print(f"\nlimits: {bounds.flops / 1e9:.0f} Gflop/s in products, GB/s in copies {rates}")
    print(", ".join(f"{k} {v}" for k, v in (where | versions).items()))
    if chosen.json:
        Path(chosen.json).write_text(json.dumps({"benchmark": name, **figures, **shared}, indent=2) + "\n")
    return 0


def _whole(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"a whole number from 1 expected, not {text!r}")
    return int(text)


def read(scene: str | Scene) -> Scene:
    """A scene that has something to train on."""
    spec = load_scene(scene) if isinstance(scene, str) else scene
    if not spec.motion.files:
        raise InputError("a motion is needed", file=spec.source, field="motion.files", mend="name one, as ncs:walk")
    return spec

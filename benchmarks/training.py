"""What a training step costs on a scene, compile time apart.

    python -m benchmarks.training [SCENE] [--repeats 7] [--json FILE]

Prints, for each part, the seconds it takes to compile, and the minimum, median and maximum of the repeats once it is
compiled. `yardstick` is the time of the step's own matrix products alone, the least a step could take on this machine.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import InputError, assemble, load_scene
from ncs_jax.rollout import animate
from ncs_jax.training import CHUNK, batches, chunk_runner, gradients, initial_state


def timed(work: Callable, repeats: int, count: int = 1) -> dict[str, float]:
    """Seconds of the first call less a typical one, and of `repeats` further ones, each divided by `count`."""
    start = time.perf_counter()
    jax.block_until_ready(work())
    first = time.perf_counter() - start
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append((time.perf_counter() - start) / count)
    compile_seconds = max(0.0, first - count * float(np.median(seconds)))
    return {"compile": compile_seconds, "min": min(seconds), "median": float(np.median(seconds)), "max": max(seconds)}


def products(params: dict, batch: int, window: int) -> Callable:
    """The matrix products that a step cannot avoid: forward and backward of every kernel, over the frames it is applied to."""
    jobs = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if leaf.ndim == 2:
            frames = batch * (window if "dynamic" in jax.tree_util.keystr(path) else 1)
            jobs.append((jnp.ones((frames, leaf.shape[0]), leaf.dtype), leaf, jnp.ones((frames, leaf.shape[1]), leaf.dtype)))

    @jax.jit
    def run(jobs):
        return [(x @ w, g @ w.T, x.T @ g) for x, w, g in jobs]

    return lambda: run(jobs)


def benchmark(scene: str | Path = "ncs:tshirt", repeats: int = 7) -> dict:
    """Measure a scene's training step and its whole-sequence inference."""
    assembly = assemble(load_scene(scene))
    model, network, track, spec = assembly.model, assembly.network, assembly.track, assembly.scene.training
    frames = track.start.shape[0]
    ends = jnp.asarray(batches(frames, spec.batch, 0, 0, CHUNK))
    pairs = jnp.zeros_like(ends)
    state = initial_state(model, network, 0)
    gradient = jax.jit(lambda model, params, track, ends, pairs: gradients(model, network, spec, params, track, ends, pairs)[0])
    parts = {"gradient": timed(lambda: gradient(model, state.params, track, ends[0], pairs[0]), repeats)}
    parts["yardstick"] = timed(products(state.params, spec.batch, spec.window), repeats)
    sequence = jax.jit(animate, static_argnums=1)
    parts["animate, a frame"] = timed(lambda: sequence(model, network, state.params, track), repeats, frames)
    run, held = chunk_runner(network, spec), [state]

    def chunk():
        held[0], logs = run(held[0], ends, pairs, 1000, model, track)
        return logs

    parts["step"] = timed(chunk, repeats, CHUNK)
    return {
        "scene": str(scene),
        "vertices": model.garment.mesh.rest.shape[0],
        "touchable body vertices": 0 if model.body is None else model.body.shape[0],
        "batch": spec.batch,
        "window": spec.window,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(held[0].params)),
        "seconds": parts,
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "versions": {"python": platform.python_version(), "jax": jax.__version__},
        "device": jax.devices()[0].platform,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="ncs:tshirt", help="scene file, or ncs:NAME (default: ncs:tshirt)")
    parser.add_argument("--repeats", type=int, default=7, help="timed calls of each part (default: 7)")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    options = parser.parse_args(arguments)
    try:
        result = benchmark(options.scene, options.repeats)
    except InputError as error:
        print(f"training: {error}", file=sys.stderr)
        return 2
    print(", ".join(f"{k} {v}" for k, v in result.items() if k not in ("seconds", "machine", "versions")))
    print(f"{'ms':20} {'compile':>9} {'min':>9} {'median':>9} {'max':>9}")
    for name, t in result["seconds"].items():
        print(f"{name:20} " + " ".join(f"{1000 * t[k]:9.2f}" for k in ("compile", "min", "median", "max")))
    step, least = result["seconds"]["step"]["median"], result["seconds"]["yardstick"]["median"]
    print(f"the step's own matrix products are {100 * least / step:.0f} % of it")
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What a simulated frame costs with both solvers, how well it is solved, and how the time grows with the garment.

    python -m benchmarks.simulator [SCENE] [--frames N] [--iterations N] [--growth] [--json FILE]

Newton solves every frame to 0.1 g; quasi-Newton stops after a fixed number of iterations, 9, and says
what is left. Seconds a frame are those of a stream, compile time and the first, static, frame apart. `--growth` instead divides
every triangle of the scene's garment in four, and again, and measures one iteration of both.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from ncs_jax import InputError, assemble, load_scene
from ncs_jax.assembly import Assembly
from ncs_jax.io.npz import write_npz
from ncs_jax.scene import Scene
from ncs_jax.simulator import simulator_from, stepper
from ncs_jax.solver.minimise import CONVERGED, Settings

HERE = Path(__file__).parent
FAST = Settings("quasi_newton", tolerance=1.0, iterations=9)
TWICE = (1, 4, 16)  # times as many triangles


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
    return {
        "compile": compiled,
        "first": first[0],
        "seconds": {
            "min": seconds.min(),
            "median": np.median(seconds),
            "p90": np.percentile(seconds, 90),
            "max": seconds.max(),
        },
        "each": float(np.median(seconds / np.maximum(iterations, 1))),
        "iterations": {"median": np.median(iterations), "max": iterations.max()},
        "residual": {"median": np.median(residual), "max": residual.max()},
        "unsolved": int(np.sum(status != CONVERGED)),
        "frames": frames,
        "vertices": len(assembly.model.garment.mesh.rest),
    }


def finer(scene: Scene, times: int, folder: Path) -> Scene:
    """The scene with every triangle of its garment divided into `times`, a power of four."""
    from trimesh.remesh import subdivide

    mesh = assemble(scene).model.garment.mesh
    vertices, faces = np.asarray(mesh.rest, np.float64), np.asarray(mesh.faces)
    while times > 1:
        vertices, faces = subdivide(vertices, faces)
        times //= 4
    path = folder / f"garment{len(vertices)}.npz"
    write_npz(path, vertices=vertices, faces=faces.astype(np.int32))
    return replace(scene, garment=replace(scene.garment, file=str(path), pins=""), network=replace(scene.network, modes=0))


def benchmark(scene: str | Path = HERE / "tshirt.toml", frames: int = 30, iterations: int = 9, growth: bool = False) -> dict:
    """Measure both solvers on a scene, or an iteration of each on ever finer garments."""
    spec = load_scene(scene)
    rows = {}
    if growth:
        with tempfile.TemporaryDirectory() as folder:
            for times in TWICE:
                assembly = assemble(finer(spec, times, Path(folder)))
                for name in ("newton", "quasi_newton"):
                    few = Settings(name, tolerance=1e-9, iterations=iterations, first=iterations)
                    row = stream(assembly, few, frames)
                    rows[f"{name}, {row['vertices']} vertices"] = row
    else:
        assembly = assemble(spec)
        rows["newton"] = stream(assembly, Settings(), frames)
        rows["quasi_newton"] = stream(assembly, replace(FAST, iterations=iterations), frames)
    return {
        "scene": str(scene),
        "rows": rows,
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "versions": {"python": platform.python_version(), "jax": jax.__version__},
        "device": jax.devices()[0].platform,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=HERE / "tshirt.toml", help="scene file (default: benchmarks/tshirt.toml)")
    parser.add_argument("--frames", type=int, default=30, help="frames of the scene's first motion (default: 30)")
    parser.add_argument("--iterations", type=int, default=9, help="of quasi-Newton; with --growth of both (default: 9)")
    parser.add_argument("--growth", action="store_true", help="one iteration on ever finer garments")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    options = parser.parse_args(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `ncs simulate` does
    try:
        result = benchmark(options.scene, max(options.frames, 2), options.iterations, options.growth)
    except InputError as error:
        print(f"simulator: {error}", file=sys.stderr)
        return 2
    print(f"{result['scene']}, {result['machine']['cores']} cores, {result['device']}; seconds a frame, residual in g")
    heads = ("compile", "min", "median", "p90", "max", "iterations", "an iteration", "residual", "worst", "unsolved")
    print(f"{'':32}" + " ".join(f"{head:>12}" for head in heads))
    for name, row in result["rows"].items():
        figures = (
            row["compile"],
            *row["seconds"].values(),
            row["iterations"]["median"],
            row["each"],
            *row["residual"].values(),
        )
        print(
            f"{name:32}" + " ".join(f"{figure:12.3f}" for figure in figures) + f" {row['unsolved']:>5} of {row['frames'] - 1}"
        )
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=2, default=float) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

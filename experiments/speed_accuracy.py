"""What does accuracy cost? Networks, smaller decoders, contact queries, meshes and simulations of one garment on one curve.

    python -m experiments.speed_accuracy ncs:tshirt --out runs/speed_accuracy

Every preset is trained for its own steps. What is beside them is `fast` but for what its name says; contact by triangles is so
slow to train that those are compared after few steps. Every point is measured in a process of its own. They are judged on one
motion (the scene's first validation motion, else its first) by the scene's own energies, against the simulation of its own
garment: mean total energy above the simulation's in %, strain and penetration in %, millimetres to it, ms of a streamed frame,
frames/s of the whole motion, peak memory in MB of the training or the simulation. Simulations have smooth contact, without
which they do not converge. Writes speed_accuracy.csv, .md and .png. What was measured is kept in the folder `points` beside
them, so that a run that broke off goes on where it was; delete it to measure anew. `--quick` is for trying it out, with a
simulation of either kind and one network: its numbers mean nothing. All takes an hour and a quarter on two cores.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import peak_memory
from experiments.study import QUICK_STEPS, apart, axes_of, changed, named, quickened, write
from ncs_jax import (
    InputError,
    Run,
    Scene,
    assemble,
    load_scene,
    local_rotations,
    measure,
    simulate,
    stepper,
    summarise,
    train,
)
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.prepare.build import features_from_records
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.scene.spec import PRESETS

COLUMNS = {
    "point": "",
    "excess": "energy above simulation, %",
    "strain_mean": "strain, %",
    "penetrating": "penetrating, %",
    "distance": "mm to simulation",
    "frame": "ms a frame",
    "rate": "frames/s, whole motion",
    "minutes": "training, min",
    "memory": "peak, MB",
}
QUICK = ("simulation, quasi-Newton, 9 iterations", "fast")  # the points beside the simulation that `--quick` runs
BRIEF = 500  # steps of the networks whose contact is compared
# Of every preset's decoder.
SMALLER: dict[str, dict] = {
    "rank 64": {"rank": 64},
    "rank 16": {"rank": 16},
    "bfloat16": {"bfloat16": True},
}


@dataclasses.dataclass(frozen=True)
class Point:
    """One scene to train or to simulate, and the one whose energies the result is judged by."""

    name: str
    scene: Scene
    judge: Scene
    simulated: bool = False


def points(scene: Scene, finer: str | None) -> list[Point]:
    """The points of the curve; those of a finer garment file, where there is one, come with its own simulation."""

    def contact(scene, **values):
        return changed(scene, physics={"collision": values})

    def smooth(scene, **simulation):
        return changed(scene, physics={"collision": {"distance": "smooth"}}, simulation=simulation)

    result = [
        Point("simulation", smooth(scene), scene, True),
        Point("simulation, tolerance 1 g", smooth(scene, tolerance=1.0), scene, True),
        Point("simulation, 2 substeps", smooth(scene, substeps=2), scene, True),
        Point("simulation, quasi-Newton, 9 iterations", smooth(scene, solver="quasi_newton", iterations=9), scene, True),
    ]
    result += [Point(name, changed(scene, **tables), scene) for name, tables in PRESETS.items()]
    scene = changed(scene, **PRESETS["fast"])
    brief = changed(scene, training={"steps": BRIEF})
    result += [Point(f"{BRIEF} steps", brief, scene)]
    result += [Point(f"{BRIEF} steps, contact by triangles", contact(brief, distance="triangle"), scene)]
    result += [Point(f"{BRIEF} steps, contact by candidates", contact(brief, search="candidates"), scene)]
    if finer is not None:
        fine = changed(scene, garment={"file": finer})
        result += [Point("simulation, finer mesh", smooth(fine), fine, True), Point("fast, finer mesh", fine, fine)]
    return result


def judge_of(point: Point) -> Callable[[np.ndarray], dict[str, Any]]:
    """What takes vertices and returns them and every quantity by the energies of the point's judge."""
    assembly = assemble(point.judge)
    track = features_from_records(assembly.model, load_motion(assembly.scene, motion_of(point.scene), assembly.body))
    return lambda vertices: {"vertices": vertices, **summarise(measure(assembly.model, vertices, track))}


def motion_of(scene: Scene) -> str:
    """The motion that everything is judged on."""
    return (*scene.motion.validation, *scene.motion.files)[0]


def trained(point: Point, steps: int | None) -> list[dict]:
    """Train a network and measure it, as it is and made smaller: rows with the vertices under "vertices"."""
    began = time.monotonic()
    run = train(point.scene, steps=steps)
    taken, memory = (time.monotonic() - began) / 60, peak_memory() / 1e6
    name = motion_of(point.scene)
    rows = []
    track, judged = run.track(name), judge_of(point)
    variants: dict[str, dict] = {"": {}, **(SMALLER if point.name in PRESETS else {})}
    for label, options in variants.items():
        if options.get("rank", 0) > min(len(track.start), point.scene.network.decoder[-1]):
            continue  # the motion or the decoder has not so many
        small = run.compressed(name, **options) if options else run
        x = small.animate(track)
        row = {"point": f"{point.name}, {label}" if label else point.name, "minutes": taken, "memory": memory}
        row |= judged(x)
        row["frame"] = 1e3 * streamed(small, name)
        row["rate"] = len(x) / median(lambda small=small, track=track: small.animate(track))
        rows.append(row)
    return rows


def simulated(point: Point) -> list[dict]:
    """Simulate and measure."""
    name = motion_of(point.scene)
    result = simulate(point.scene, name)
    row = {"point": point.name, "frame": 1e3 * float(np.median(result.seconds[1:])), "memory": peak_memory() / 1e6}
    return [row | judge_of(point)(result.vertices)]


def median(call, repeats: int = 7) -> float:
    """Median time of a call in s, the first one left out."""
    call()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def streamed(run: Run, motion: str) -> float:
    """Median time in s of one frame of a stream with carried state, over the motion."""
    model, record = run.assembly.model, run.motion(motion)
    rollout = stepper(model, run.assembly.network, run.params)
    local, way = local_rotations(model, jnp.asarray(record.poses)), jnp.asarray(record.translation)
    step = jax.jit(rollout.step, donate_argnums=0)
    state, times = rollout.init(), []
    for t in range(len(local)):
        frame = jax.block_until_ready((local[t], way[t]))
        began = time.perf_counter()
        state, _ = jax.block_until_ready(step(state, *frame))
        times.append(time.perf_counter() - began)
    return float(np.median(times[1:]))


def measured(point: Point, steps: int | None, kept: Path) -> list[dict]:
    """A point's rows, from a process of its own: measured once, and read from the folder after that."""
    file = kept / f"{named(point.name, point.scene.to_dict(), steps)}.npz"
    if not file.exists():
        rows = apart(simulated, point) if point.simulated else apart(trained, point, steps)
        vertices = np.stack([row.pop("vertices") for row in rows])
        kept.mkdir(parents=True, exist_ok=True)
        write_npz(file, vertices=vertices, rows=np.array(json.dumps(rows)))
    with np.load(file, allow_pickle=False) as arrays:
        return [row | {"vertices": x} for row, x in zip(json.loads(str(arrays["rows"])), arrays["vertices"], strict=True)]


def experiment(
    scene: Scene, out: Path, *, finer: str | None = None, steps: int | None = None, only: Sequence[str] = ()
) -> list[dict]:
    """Measure every point, write the tables and the picture into `out`, and return the rows."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict] = []
    references: dict[str, dict] = {}  # by garment file
    wanted = [point for point in points(scene, finer) if not only or point.name in ("simulation", *only)]
    for point in wanted:
        found = measured(point, steps, out / "points")
        reference = references.setdefault(point.scene.garment.file, found[0])
        for row in found:
            row["excess"] = 100 * (row["total"] - reference["total"]) / abs(reference["total"])
            row["distance"] = 1e3 * float(np.linalg.norm(row["vertices"] - reference["vertices"], axis=-1).mean())
            print("  ".join(f"{k} {row[k]:.4g}" if k != "point" else f"{row[k]:28}" for k in COLUMNS if k in row), flush=True)
        rows += found
        write(out, "speed_accuracy", [{k: row[k] for k in (*COLUMNS, "total") if k in row} for row in rows], COLUMNS)
    draw(out / "speed_accuracy.png", rows)
    return rows


def draw(path: Path, rows: list[dict]) -> None:
    """Excess energy over the time of a frame and of the training, and distance to the simulation over the time of a frame."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import LogLocator

    families: dict[str, list[dict]] = {}
    for row in rows:
        if row["excess"] > 0:  # not the simulation itself
            families.setdefault(row["point"].partition(", rank")[0].removesuffix(", bfloat16"), []).append(row)
    shapes = dict(zip(SMALLER, "v^D", strict=True))
    panels = (("frame", "excess"), ("minutes", "excess"), ("frame", "distance"))
    with axes_of(path, len(panels) + 1, (3.4, 4.0)) as every:
        for axes, (over, key) in zip(every, panels, strict=False):
            for i, (name, family) in enumerate(families.items()):
                for row in family:
                    label = row["point"].removeprefix(f"{name}, ")
                    shape = "s" if name.startswith("simulation") else shapes.get(label, "o")
                    if over in row:
                        axes.plot(row[over], row[key], shape, color=f"C{i % 10}", markersize=7 if label == name else 4)
            axes.set(xlabel=COLUMNS[over], ylabel=COLUMNS[key], xscale="log", yscale="log" if key == "excess" else "linear")
            for axis in (axes.xaxis, axes.yaxis)[: 2 if key == "excess" else 1]:
                axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.set_major_formatter("{x:g}")
                axis.set_minor_formatter("")
        legend = [
            Line2D([], [], marker="s" if name.startswith("simulation") else "o", color=f"C{i % 10}", linestyle="", label=name)
            for i, name in enumerate(families)
        ]
        legend += [Line2D([], [], marker=shape, color="0.5", linestyle="", label=name) for name, shape in shapes.items()]
        every[-1].legend(handles=legend, loc="center left", frameon=False)
        every[-1].axis("off")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="ncs:tshirt", help="scene file, or ncs:NAME (default: ncs:tshirt)")
    parser.add_argument("--finer", metavar="FILE", help="a finer mesh of the garment (default: the packaged one, where it is)")
    parser.add_argument("--only", nargs="+", default=(), metavar="POINT", help="these points, beside the simulation")
    parser.add_argument("--quick", action="store_true", help="to try it out, smallest: the numbers mean nothing")
    parser.add_argument("--out", default="runs/speed_accuracy", help="folder for the tables and the picture")
    options = parser.parse_args(arguments)
    try:
        scene = load_scene(options.scene)
        finer = options.finer or (f"{scene.garment.file}_fine" if scene.garment.file.startswith("ncs:") else None)
        if options.quick:
            scene, finer = quickened(scene), options.finer
        steps, few = (QUICK_STEPS, QUICK) if options.quick else (None, ())
        experiment(scene, Path(options.out), finer=finer, only=options.only or few, steps=steps)
    except InputError as error:
        print(f"speed_accuracy: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

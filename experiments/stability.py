"""Where does it break? Energies, networks, simulator and training, each swept along one axis after another until they do.

    python -m experiments.stability [--out experiments/results] [--only energies networks simulator training scenes runs]

All is worked out in float32 and in float64 from the same numbers. A cell of the map is how far the two are apart, as a share
of the result: of an energy the worst of its value, its gradient and its second derivative along a direction (in a shape
where they are smaller than of the garment as worn, which at rest has none, as a share of those); of networks and
simulator the vertices, the simulator's in the precision that `ncs simulate` takes by itself and to one tolerance in both; where
it is out of balance, by how many g, if that is more. It is `safe` up to a thousandth, `at risk` above it, `broken`
where a number is not finite, `refused` where a scene is not accepted, or more pairs are in self-contact than its lists hold.
Training has nothing to be compared with: it is safe where no step is dropped and the energy falls. Limbs that leap have no one
answer: the simulator is safe where it finds its balance to 0.1 g. Writes stability_PART.csv of all cells, .md and .png of every
part. Half an hour on two cores.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from experiments.specimens import TERMS, along_axis, evaluated, hanging, least, limbs, shapes, specimen
from experiments.study import axes_of, changed, write_csv, write_markdown
from ncs_jax import InputError, Scene, assemble, load_scene, train
from ncs_jax.energies.terms import Material
from ncs_jax.io import MotionRecord
from ncs_jax.network.methods.swing import Swing
from ncs_jax.network.rollout import animate
from ncs_jax.prepare.build import features_from_records
from ncs_jax.runs.simulate import rounding
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.solver.minimise import Settings
from ncs_jax.training.batches import batches
from ncs_jax.training.loss import with_bodies
from ncs_jax.training.step import TrainState, chunk_runner, initial_state

TOLERANCE = 1e-3
# g; with 0.1, what is left out of balance may be a thousandth of the result where the cloth is taut and folds softly
TOLERANCE = 0.02  # g
SETTINGS = Settings(tolerance=TOLERANCE, iterations=300)
LIMBS = replace(SETTINGS, tolerance=0.1)
CELLS = ("gated", "swing")
STATES = ("safe", "at risk", "broken", "refused")


def tens(low: int, high: int) -> tuple[float, ...]:
    """10^low to 10^high."""
    return tuple(10.0**k for k in range(low, high + 1))


TIMES = (1 / 1000, 1 / 480, 1 / 240, 1 / 120, 1 / 60, 1 / 30, 1 / 15, 1 / 5, 1 / 2)
PHYSICS: dict[str, tuple[float, ...]] = {
    "time step, s": TIMES,
    "stiffness, times the default": tens(-6, 9),
    "density, kg/m^2": tens(-4, 4),
    "gravity, g": (0, *tens(-2, 2)),
    "size, times the default": tens(-3, 3),
    "from the origin, m": (0, *tens(0, 5)),
}


def apart(single: Any, double: Any, usual: Any = 0.0) -> float:
    """How far a result in float32 is from that in float64, as a share of it; infinite where a number is not finite.

    As a share of what is usual where that is larger.
    """
    a, b = (np.asarray(v, np.float64) for v in (single, double))
    if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
        return np.inf
    size = max(float(np.linalg.norm(v)) for v in (b, usual))
    return float(np.linalg.norm(a - b)) / size if size > 0 else float(np.any(a != 0))


def state(error: float) -> str:
    """What a cell of the map says; an error that is no number says that the scene was refused."""
    if np.isnan(error):
        return "refused"
    return STATES[2 if not np.isfinite(error) else int(error > TOLERANCE)]


def cell(subject: str, axis: str, value: Any, error: float, **more: Any) -> dict:
    """One row of the map's table."""
    return {"subject": subject, "axis": axis, "value": value, "error": error, "state": state(error), **more}


def tried(subject: str, axis: str, value: Any, row: Callable[[], dict]) -> dict:
    """The row, or that the scene was refused, and why."""
    try:
        return row()
    except InputError as error:
        return refused(subject, axis, value, error)


def refused(subject: str, axis: str, value: Any, error: InputError) -> dict:
    """The row of a scene that was refused, and why."""
    why = str(error) if error.file is None else str(error).replace(str(error.file), Path(error.file).name)
    return cell(subject, axis, value, np.nan, why=why)


# Energies

DERIVATIVES = ("of the value", "of the gradient", "of the second derivative")


def of_energies(scene: Scene, quick: bool) -> list[dict]:
    """Every term along every axis, and in every shape."""
    s = specimen(scene)
    none = dict.fromkeys(TERMS, (0.0, 0.0, 0.0))
    usual = none | evaluated(s, list(TERMS), jnp.float64)
    cases = [(axis, value, along_axis(s, axis, value), none) for axis, values in PHYSICS.items() for value in values]
    cases += [("shape", name, shaped, usual) for name, shaped in shapes(s)]
    rows = []
    for axis, value, case, beside in cases[:: 60 if quick else 1]:
        single, double = (evaluated(case, list(TERMS), dtype) for dtype in (jnp.float32, jnp.float64))
        for name in TERMS:
            if name in single and name in double:
                errors = [*map(apart, single[name], double[name], beside[name])]
                rows.append(cell(name, axis, value, max(errors), **dict(zip(DERIVATIVES, errors, strict=True))))
            else:
                rows.append(cell(name, axis, value, np.nan, why="more pairs are near each other than the lists hold"))
    return rows


# Networks


@dataclass(frozen=True)
class Wearer:
    """A trained garment in both precisions."""

    assembly: Any
    double: Any
    params: dict

    def vertices(self, record: MotionRecord, alpha: float = 1.0) -> list[np.ndarray]:
        """Seen from the root, in float32 and in float64."""
        both = ((self.assembly, jnp.float32), (self.double, jnp.float64))
        return [worn(a, self.params, record, alpha, dtype) for a, dtype in both]


def worn(a: Any, params: dict, record: MotionRecord, alpha: float, dtype: Any) -> np.ndarray:
    """Vertices of a trained garment, seen from the root, worked out in a precision."""
    track = features_from_records(a.model, record)
    params = jax.tree.map(lambda p: jnp.asarray(p, dtype), params)
    x = track.relative(animated(a.network, a.model, params, track, jnp.asarray(alpha, dtype)))
    return x.astype(np.float64) - np.asarray(track.matrices[:, 0, :, 3], np.float64)[:, None]


@functools.partial(jax.jit, static_argnums=0)
def animated(network, model: Model, params: dict, track: MotionFeatures, alpha):
    """The vertices of a motion."""
    return animate(model, network, params, track, alpha)


def in_double(a: Any) -> Any:
    """The same numbers in float64."""

    def cast(leaf):
        return leaf.astype(jnp.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return replace(a, model=jax.tree.map(cast, a.model))


def wandering(like: MotionRecord, frames: int) -> MotionRecord:
    """A character that turns its joints at random, and walks where it likes."""
    rng, joints = np.random.default_rng(1), like.poses.shape[1]
    t = np.arange(frames)[:, None, None] / like.fps
    sizes, rates = 0.2 * rng.standard_normal((4, joints, 3)), rng.uniform(0.5, 9, (4, joints, 3))
    waves = [size * np.sin(rate * t + k) for k, (size, rate) in enumerate(zip(sizes, rates, strict=True))]
    poses = np.sum(waves, axis=0)
    way = np.cumsum(0.03 * np.sin(0.7 * t[:, 0] + np.arange(3)) * [1, 0, 1], axis=0)
    return MotionRecord(poses.astype(np.float32), way, like.fps, like.joint_names)


def motions(record: MotionRecord) -> Iterator[tuple[str, float, MotionRecord, float]]:
    """(axis, value, motion, alpha)."""
    frames = np.arange(len(record.poses))
    middle = len(frames) // 2
    for alpha in (0, 0.5, 1, 2, 5, 10, 30, 100):
        yield "alpha", alpha, record, float(alpha)
    for speed in (1, 2, 5, 10, 30, 100):
        at = frames * speed % len(frames)
        yield "motion, times as fast", speed, replace(record, poses=record.poses[at], translation=record.translation[at]), 1.0
    for away in PHYSICS["from the origin, m"]:
        yield (
            "from the origin, m",
            away,
            replace(record, translation=record.translation + away * np.array([0.6, 0.0, 0.8])),
            1.0,
        )
    for angle in (1, 10, 90, 179, 180):
        poses = record.poses.copy()
        poses[middle:, :, 0] += np.radians(angle)
        yield "all joints turned at once, degrees", angle, replace(record, poses=poses), 1.0
    for jump in tens(-1, 4):
        translation = record.translation + jump * (frames >= middle)[:, None]
        yield "jump within a frame, m", jump, replace(record, translation=translation), 1.0


def of_networks(scene: Scene, quick: bool) -> list[dict]:
    """A network of 300 steps on every kind of motion."""
    run = train(scene, steps=10 if quick else 300)
    a = run.assembly
    wearer = Wearer(a, in_double(a), run.params)
    record = run.motion(scene.motion.files[0])
    cases = list(motions(record))
    rows = [
        cell("network", axis, value, apart(*wearer.vertices(case, alpha)))
        for axis, value, case, alpha in cases[:: 27 if quick else 1]
    ]
    long = 100 if quick else 10_000
    restless, resting = wandering(record, long), np.minimum(np.arange(long), len(record.poses) - 1)
    rested = replace(record, poses=record.poses[resting], translation=record.translation[resting])
    for axis, motion in (("frames of random motion", restless), ("frames after the motion", rested)):
        single, double = wearer.vertices(motion)
        for value in (10.0**k for k in range(1, 5) if 10**k <= long):
            part = slice(int(0.9 * value), int(value))
            rows.append(cell("network", axis, value, apart(single[part], double[part])))
    small = run.compressed(scene.motion.files[0], bfloat16=True)
    for _, alpha, case, _ in (c for c in cases if c[0] == "alpha"):
        found = worn(small.assembly, small.params, case, alpha, jnp.float32)
        rows.append(cell("network, bfloat16", "alpha", alpha, apart(found, wearer.vertices(case, alpha)[1])))
    for fps in [30] if quick else [1, 5, 15, 30, 60, 120, 240, 1000]:
        once, twice = (replace(b, model=replace(b.model, fps=float(fps))) for b in (a, wearer.double))
        used = replace(record, fps=float(fps))
        rows.append(cell("network", "frames per second of use", fps, apart(*Wearer(once, twice, run.params).vertices(used))))
    return rows


# Simulator and training


def materials(material: Material, axis: str, value: Any) -> Material:
    """At a value of one of the axes of `SWEPT` that are of the material."""
    if axis.startswith("gravity of"):
        along = np.eye(3)["xyz".index(value[-1])] * (-1 if value.startswith("-") else 1)
        pull = np.asarray(material.gravity)
        return replace(material, gravity=jnp.asarray(np.linalg.norm(pull) * along, pull.dtype))
    factor = value / float(material.density) if axis.startswith("density") else value
    stretched = tuple(n * n.dtype.type(factor) for n in material.membrane)
    names: tuple[str, ...] = ("bending", "collision", "pinning") if axis.startswith("stiffness") else (axis.split(",")[0],)
    if axis.startswith(("stiffness", "membrane")):
        material = replace(material, membrane=stretched)
    return replace(
        material, **{n: getattr(material, n) * getattr(material, n).dtype.type(factor) for n in names if n != "membrane"}
    )


def hung(folder: Path, axis: str, value: float, dtype: Any, cell: str = "gated"):
    """The sheet made ready at a value of an axis."""
    field = {"time": "fps", "size": "size", "from": "away", "jump": "jump"}.get(axis.split()[0].strip(","))
    own = {} if field is None else {field: 1 / value if field == "fps" else value}
    a = assemble(changed(hanging(folder, **own), network={"cell": cell}), dtype=dtype)
    if own:
        return a
    return replace(a, model=replace(a.model, material=materials(a.model.material, axis, value)))


@functools.partial(jax.jit, static_argnums=2)
def simulated(simulator, track: MotionFeatures, settings: Settings):
    """Vertices and how it went."""
    return simulate(simulator, track, settings)


SWEPT: dict[str, tuple[Any, ...]] = {
    **PHYSICS,
    "membrane, times the default": tens(-6, 9),
    "bending, times the default": tens(-6, 9),
    "gravity of 1 g along": ("x", "-x", "y", "-y", "z", "-z"),
    "jump within a frame, sizes": tens(-1, 4),
}


def simulated_apart(axis: str, value: Any, made: Callable[[Any], Any]) -> dict:
    """The row of a simulation, in the precision that `ncs simulate` takes and in float64; out of balance, it is no answer."""

    def found(a):
        x, solution = simulated(simulator_from(a.model), a.track, SETTINGS)
        return a.track.relative(x) - np.asarray(a.track.matrices)[:, :1, :, 3], solution

    single, exact = made(jnp.float32), found(made(jnp.float64))
    enough = rounding(single.model) <= TOLERANCE
    x, solution = found(single) if enough else exact
    residual, off = float(np.max(solution.residual)), apart(x, exact[0])
    return cell(
        "simulator", axis, value, max(off, residual if np.any(solution.status) else 0.0), apart=off,
        precision="single" if enough else "double", residual=residual, iterations=int(np.max(solution.iterations)),
        status=int(np.max(solution.status)),
    )  # fmt: skip


def learned(subject: str, axis: str, value: Any, a: Any, seed: int = 0, steps: int = 300) -> dict:
    """The row of a training: by how much its last energies are above its first, as a share, where they are; see `fall`."""
    spec, network = a.scene.training, cast(Any, a.network)
    track = with_bodies(a.model, a.track, spec.batch)
    ends = batches(len(track.start), spec.batch, seed, 0, steps)
    state = initial_state(a.model, network, seed)
    if isinstance(network, Swing):
        track = replace(track, swing=jax.jit(network.swings)(state.params, a.model, a.track))
    end, logs = runner(network, spec)(state, ends, np.zeros_like(ends), steps, a.model, track)
    return fall(subject, axis, value, end, logs)


def swept(quick: bool) -> list[str]:
    """The axes, or the first of them."""
    return list(SWEPT)[: 1 if quick else None]


def of_simulator(scene: Scene, quick: bool) -> list[dict]:
    """A sheet that hangs from a bar, along every axis; and the scene's garment when limbs go where none can."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for axis in swept(quick):
            for value in SWEPT[axis][:: 9 if quick else 1]:
                made = functools.partial(hung, Path(folder), axis, value)
                rows.append(tried("simulator", axis, value, functools.partial(simulated_apart, axis, value, made)))
            jax.clear_caches()
    for name, a in limbs(scene)[: 1 if quick else None]:
        x, solution = simulated(simulator_from(a.model), a.track, LIMBS)
        left = float(np.max(solution.residual))
        error = (left if np.any(solution.status) else 0.0) if np.all(np.isfinite(x)) else np.inf
        status = int(np.max(solution.status))
        rows.append(cell("simulator", "limbs, on a body", name, error, residual=left, status=status))
    return rows


def of_training(scene: Scene, quick: bool) -> list[dict]:
    """The same sheet learned for 300 steps, along every axis, by a gated unit and by a swing."""
    del scene
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for cell, axis in itertools.product(CELLS, swept(quick)):
            subject = f"training, {cell}"
            for value in SWEPT[axis][:: 9 if quick else 1]:

                def learn(subject=subject, cell=cell, axis=axis, value=value):
                    return learned(subject, axis, value, hung(Path(folder), axis, value, jnp.float32, cell))

                rows.append(tried(subject, axis, value, learn))
            jax.clear_caches()
    return rows


def of_scenes(scene: Scene, quick: bool) -> list[dict]:
    """Scenes of which something is as little as it can be, learned and simulated."""
    del scene
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, small in least(Path(folder))[: 2 if quick else None]:
            made = functools.partial(assemble, small)
            try:
                rows.append(learned("training", "scene", name, made(), steps=60))
                rows.append(simulated_apart("scene", name, lambda dtype, made=made: made(dtype=dtype)))
            except InputError as error:
                rows.append(refused("training", "scene", name, error))
    return rows


EDGES: dict[str, tuple[str, dict]] = {
    "T-shirt, soft and light, 240 frames/s": (
        "ncs:tshirt",
        {"motion": {"fps": 240.0}, "physics": {"density": 0.01, "membrane": {"lam": 0.0418, "mu": 0.0222}}},
    ),
    "T-shirt, stiff and heavy, 5 frames/s": (
        "ncs:tshirt",
        {"motion": {"fps": 5.0}, "physics": {"density": 10.0, "membrane": {"lam": 4.18e5, "mu": 2.22e5}}},
    ),
    "skirt, bending 10,000 times as stiff, contact too": (
        "ncs:skirt", {"physics": {"bending": {"stiffness": 0.1}, "collision": {"stiffness": 1e5}}},
    ),
    "skirt, Baraff-Witkin, gravity 10 g": (
        "ncs:skirt", {"physics": {"gravity": (0.0, -98.1, 0.0), "membrane": {"model": "baraff_witkin"}}},
    ),
}  # fmt: skip


def of_runs(scene: Scene, quick: bool) -> list[dict]:
    """Five seeds each of four scenes at the edges, 500 steps."""
    del scene
    rows = []
    for name, (base, tables) in list(EDGES.items())[: 1 if quick else None]:
        a = assemble(changed(load_scene(base), **tables))
        rows += [learned("training", name, seed, a, seed, 20 if quick else 500) for seed in range(1 if quick else 5)]
    return rows


def fall(subject: str, axis: str, value: Any, end: TrainState, logs: dict) -> dict:
    """The row of a training: how much higher its last energies are than its first, or that a step was dropped."""
    total = np.asarray(sum(logs.values()), np.float64)
    tenth = max(1, len(total) // 10)
    first, last = total[:tenth].mean(), total[-tenth:].mean()
    bad = int(end.dropped) > 0 or not np.all(np.isfinite(total))
    error = np.inf if bad else max(0.0, (last - first) / max(abs(first), 1e-30))
    return cell(subject, axis, value, error, dropped=int(end.dropped), first=first, last=last)


@functools.cache
def runner(network: Any, spec: Any):
    """One compiled training for all that share it."""
    return chunk_runner(network, spec)


# The map

PARTS: dict[str, Callable[[Scene, bool], list[dict]]] = {
    "energies": of_energies,
    "networks": of_networks,
    "simulator": of_simulator,
    "training": of_training,
    "scenes": of_scenes,
    "runs": of_runs,
}


def shown(value: Any) -> str:
    """A value of an axis."""
    return f"{value:.3g}" if isinstance(value, int | float) else str(value)


def ranges(rows: Sequence[dict]) -> list[dict]:
    """For every subject and axis: from where to where it is safe, and the first values beyond."""
    found = []
    for subject, axis in dict.fromkeys((r["subject"], r["axis"]) for r in rows):
        own = [r for r in rows if (r["subject"], r["axis"]) == (subject, axis)]
        finite = [r["error"] for r in own if np.isfinite(r["error"])]
        told = {s: ", ".join(shown(r["value"]) for r in own if r["state"] == s) for s in STATES}
        found.append({"subject": subject, "axis": axis, **told, "worst": max(finite, default=np.inf)})
    return found


def draw(path: Path, rows: Sequence[dict]) -> None:
    """A panel for every axis: its subjects over values, coloured by the error; black: broken, white: refused."""
    from matplotlib.colors import LogNorm

    every = list(dict.fromkeys(r["axis"] for r in rows))
    most, longest = len({r["subject"] for r in rows}), max(len(shown(r["value"])) for r in rows)
    labelled = most < 4  # on every panel; else on the left ones
    across = 4 if len(every) > 4 else 2
    with axes_of(path, len(every), (4.6 if labelled else 3.6, 1.2 + 0.25 * most + 0.08 * longest), across=across) as panels:
        for place, (axes, axis) in enumerate(zip(panels, every, strict=True)):
            own = [r for r in rows if r["axis"] == axis]
            subjects, values = (list(dict.fromkeys(r[key] for r in own)) for key in ("subject", "value"))
            table = np.full((len(subjects), len(values)), np.nan)
            for r in own:
                table[subjects.index(r["subject"]), values.index(r["value"])] = max(r["error"], 1e-9)
            axes.set_facecolor("white")
            image = axes.imshow(np.ma.masked_invalid(table), norm=LogNorm(1e-8, 1), cmap="RdYlGn_r", aspect="auto")
            for i, j in np.argwhere(np.isinf(table)):
                axes.fill([j - 0.5, j + 0.5, j + 0.5, j - 0.5], [i - 0.5, i - 0.5, i + 0.5, i + 0.5], color="black")
            axes.set_xticks(range(len(values)), [*map(shown, values)], rotation=90, fontsize=7)
            names = subjects if labelled or place % across == 0 else [""] * len(subjects)
            axes.set_yticks(range(len(subjects)), names, fontsize=8)
            axes.set_title(axis, fontsize=9)
        bar = axes.figure.colorbar(image, ax=list(panels), fraction=0.03, aspect=40)
        bar.set_label("error, a share\nwhite: refused, black: broken", fontsize=8)


def experiment(scene: Scene, out: Path, *, only: Sequence[str] = (), quick: bool = False) -> dict[str, list[dict]]:
    """Measure every part and write its tables and its picture into `out`."""
    found = {}
    with jax.enable_x64(True):
        for name, part in PARTS.items():
            if only and name not in only:
                continue
            began = time.monotonic()
            rows = part(scene, quick)
            jax.clear_caches()  # a process may hold only so many pieces of memory, and every program is several
            write_csv(out / f"stability_{name}.csv", rows)
            headings = {"subject": "", "axis": "", **{s: s for s in STATES}, "worst": "worst"}
            write_markdown(out / f"stability_{name}.md", ranges(rows), headings)
            draw(out / f"stability_{name}.png", rows)
            found[name] = rows
            print(f"{name}: {len(rows)} cells, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="ncs:tshirt", help="scene file, or ncs:NAME (default: ncs:tshirt)")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=(), help="these parts")
    parser.add_argument("--quick", action="store_true", help="a few cells of each, to try it out")
    parser.add_argument("--out", default="experiments/results", help="folder for tables and pictures")
    o = parser.parse_args(arguments)
    try:
        found = experiment(load_scene(o.scene), Path(o.out), only=o.only, quick=o.quick)
    except InputError as error:
        print(f"stability: {error}", file=sys.stderr)
        return 2
    for name, rows in found.items():
        print(name, {s: sum(r["state"] == s for r in rows) for s in STATES})
    return 0


if __name__ == "__main__":
    sys.exit(main())

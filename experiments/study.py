"""What the experiments share: scenes changed field by field, simulations and trained runs kept, tables, a command line."""

from __future__ import annotations

import argparse
import csv
import fcntl
import hashlib
import json
import multiprocessing
import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import jax
import numpy as np

from ncs_jax import InputError, Run, Scene, assemble, load_scene, scene_from, simulate, summarise, train
from ncs_jax.io import read_motion
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.metrics.motion import compare_dynamics, compare_motion, measure_motion
from ncs_jax.metrics.quality import measure
from ncs_jax.metrics.seen import measure_seen
from ncs_jax.network.methods.method import Method
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.spec import split_frames
from ncs_jax.training.batches import batches, chunks
from ncs_jax.training.loss import with_bodies
from ncs_jax.training.step import chunk_runner, initial_state

UNSEEN = ("ncs:mixed", "ncs:walk_turn_stop")  # the second has a stop
STAND = 4.0  # s for which a stop at a motion's end is held on: a skirt swings for as long again as it does there
# g of a reference simulation. In 1/30 s that is 1.6 mm/s. With 0.02 it is 6.5 mm/s, as much as a hem has that has settled:
# a T-shirt's took from 0.87 to 1.43 s for it, by the processor, and was 3 % slower. With 0.1 it stops short of where it hangs.
BALANCE = 0.005
# g of a second one. Of buckled cloth in a swing there are many motions that are in balance: how far two simulations are apart
# is how near a network can be said to come to either.
COARSE = 0.02
KEPT = Path("runs/study")
# What a table of networks has to say of each.
COLUMNS = {
    "total": "energy, J",
    "strain_mean": "strain, %",
    "penetrating": "inside, %",
    "skin_share": "skin seen, %",
    "body_intersecting": "triangles through the body, %",
    "dynamic_share": "dynamic share",
    "hem_correlation": "hem correlation",
    "distance": "mm to simulation",
    "sensitivity": "two simulations, mm",
    "static_distance": "static part, mm",
    "dynamic_correlation": "dynamic correlation",
    "dynamic_factor": "dynamic factor",
    "stopped_share": "after a stop",
    "settling": "settling, s",
    "overshoot": "overshoot, %",
    "minutes": "training, min",
}


def changed(scene: Scene, **tables: dict) -> Scene:
    """The scene with some fields of some tables replaced, one table within another by a dict in a dict."""

    def merged(old: dict, new: dict) -> dict:
        inner = {key: merged(old[key], value) for key, value in new.items() if isinstance(value, dict)}
        return old | new | inner

    return scene_from(merged(scene.to_dict(), tables), source=scene.source)


QUICK: dict[str, dict] = {
    "network": {"static": (16, 16), "joint": (8,), "dynamic": (16,), "decoder": (16,), "modes": 8, "vibrations": 4},
    "training": {"batch": 4, "window": 5},
    "simulation": {"solver": "quasi_newton", "precision": "single", "iterations": 5},
}  # the smallest that runs every line; its numbers mean nothing
FEW = 24  # frames of every motion
QUICK_STEPS = 20


def quickened(scene: Scene) -> Scene:
    """The scene with a few frames of every motion, the smallest network and a simulation that stops early."""
    return changed(scene, motion={"frames": (0, FEW), "mirror": False}, **QUICK)


def stem(motion: str) -> str:
    """The name of a motion's file alone, without its frames."""
    return Path(split_frames(motion)[0].removeprefix("ncs:")).stem


def without(scene: Scene, unseen: Sequence[str]) -> Scene:
    """The scene trained on its motions but these, and not validated."""
    names = [stem(motion) for motion in unseen]
    return changed(scene, motion={"files": tuple(m for m in scene.motion.files if stem(m) not in names), "validation": ()})


def standing(scene: Scene, motions: Sequence[str], kept: Path) -> tuple[str, ...]:
    """The motions; of one that ends standing, a file with its last pose held for `STAND` seconds more."""
    found = []
    for motion in motions:
        name, frames = split_frames(motion)
        chosen = None if frames is None else (frames[0], frames[1] if len(frames) > 1 else None)
        file = kept / "motions" / f"{'_'.join([stem(name), *map(str, frames or ())])}.npz"
        record = read_motion(scene.path(name), frame_range=chosen)
        plain = record.joints is None and not record.up  # of another skeleton or another up, its file says more
        if plain and len(record.poses) > record.fps and not np.any(record.poses[-round(record.fps / 2) :] - record.poses[-1]):
            poses, way = (
                np.concatenate([a, np.repeat(a[-1:], round(STAND * record.fps), axis=0)])
                for a in (record.poses, record.translation)
            )
            names = {"joint_names": np.array(record.joint_names)} if record.joint_names else {}
            file.parent.mkdir(parents=True, exist_ok=True)
            write_npz(file, poses=poses, trans=way, fps=np.asarray(record.fps), **names)
            motion = str(file.resolve())
        found.append(motion)
    return tuple(found)


def recurrent(scene: Scene, cell: str = "gated") -> Scene:
    """The scene whose network remembers by a recurrence, which only its own motion trains."""
    return changed(scene, network={"cell": cell}, training={"motion_augmentation": 0.0})


def named(*told: Any) -> str:
    """A name of anything that JSON can tell, for a file."""
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


@contextmanager
def one_at_a_time(file: Path) -> Iterator[None]:
    """Another process that wants to make the same file waits here, and then finds it made."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def twins(scene: Scene) -> dict[str, Scene]:
    """The scene to be simulated: "dynamic", each frame to `BALANCE`; "coarse", to `COARSE`; "static", without inertia.

    All with smooth contact, as none converges with any other.
    """
    dynamic = changed(scene, physics={"collision": {"distance": "smooth"}}, simulation={"tolerance": BALANCE})
    return {
        "dynamic": dynamic,
        "coarse": changed(dynamic, simulation={"tolerance": COARSE}),
        # every frame is sought far from rest, as a first one
        "static": changed(dynamic, physics={"inertia": False}, simulation={"iterations": 10 * scene.simulation.iterations}),
    }


def simulation_file(twin: Scene, motion: str, kept: Path) -> Path:
    """Where a simulation is kept: of the same body, garment, physics and motion, whatever the network."""
    tables = twin.to_dict()
    told = [motion, twin.motion.fps, *(tables[name] for name in ("body", "garment", "physics", "simulation"))]
    return kept / "simulations" / f"{named(told)}.npz"


def reference(scene: Scene, motion: str, kept: Path, twin: str = "dynamic") -> np.ndarray:
    """The scene's garment simulated over a motion, (frames, verts, 3) in m, as one of its `twins`.

    Made once, and read from the folder after that; where it was interrupted it goes on.
    """
    alike = twins(scene)[twin]
    file = simulation_file(alike, motion, kept)
    partial = file.with_name(f"{file.stem}-{named(alike.to_dict())}.partial.npz")  # of this scene: others may share the file
    with one_at_a_time(file):
        if not file.exists():
            write_npz(file, vertices=simulate(alike, motion, partial=partial).vertices)
            partial.unlink(missing_ok=True)
    with np.load(file, allow_pickle=False) as arrays:
        return arrays["vertices"]


def references(scenes: Iterable[Scene], motions: Sequence[str], kept: Path) -> None:
    """Make the simulations that animations of the motions are judged by (`judged_on`), those that are missing two at a time."""
    jobs: dict[Path, tuple] = {}
    for scene in scenes:
        for place, motion in enumerate(motions):
            for name, twin in twins(scene).items():
                file = simulation_file(twin, motion, kept)
                if not file.exists() and (name == "dynamic" or not place):
                    jobs.setdefault(file, (reference, scene, motion, kept, name))
    abreast(list(jobs.values()))


def trained(scene: Scene, steps: int, kept: Path, minutes: float | None = None) -> tuple[Run, float]:
    """The scene's network after so many steps or minutes, and how many minutes it took: trained once, and read after that."""
    told = [steps] if minutes is None else ["minutes", minutes]
    folder = kept / "trained" / named(scene.to_dict(), *told)
    with one_at_a_time(folder):
        begun = (folder / "run.json").exists()
        length: dict = {"steps": steps} if minutes is None else {} if begun else {"minutes": minutes}
        run = train(scene, folder, resume=begun, **length)
    with (folder / "log.csv").open(newline="") as file:
        seconds = [float(row["seconds"]) for row in csv.DictReader(file)]
    return run, seconds[-1] / 60


def fitted(scene: Scene, altered: Callable[[Any, MotionFeatures], Method], steps: int) -> tuple[Run, float]:
    """As `trained`, of a network that no scene file names. Nothing is kept."""
    began, a, spec = time.monotonic(), assemble(scene), scene.training
    a = replace(a, network=altered(a.network, a.track))
    run, track, frames = chunk_runner(a.network, spec), with_bodies(a.model, a.track, spec.batch), len(a.track.start)
    state = initial_state(a.model, a.network, spec.seed)
    for at, count in chunks(0, steps):
        ends = batches(frames, spec.batch, spec.seed, at, count)
        state, _ = run(state, ends, np.zeros_like(ends), steps, a.model, track)
    params = jax.block_until_ready(state.params)
    return Run(a, params, steps), (time.monotonic() - began) / 60


def moving(run: Run, motion: str, vertices: np.ndarray, simulated: np.ndarray) -> dict[str, float]:
    """Every measure of motion beside the simulation of an animation of a run's garment."""
    model, track = run.assembly.model, run.track(motion)
    return measure_motion(model, vertices, track) | compare_motion(model, vertices, simulated, track)


def still(run: Run, motion: str) -> np.ndarray | None:
    """The static part of a run's animation, that of alpha = 0; None where none can be told from the rest."""
    network = run.assembly.network
    return run.animate(motion, 0.0) if network.controlled or not network.state else None


def judged(run: Run, motion: str, vertices: np.ndarray, static: np.ndarray | None, kept: Path) -> dict[str, float]:
    """The same and every quantity; how far two simulations are apart, mm; and both parts of it beside a simulation's.

    static: the animation's static part, None where it has none.
    """
    scene = run.assembly.scene
    simulated, other = (reference(scene, motion, kept, twin) for twin in ("dynamic", "coarse"))
    model, track = run.assembly.model, run.track(motion)
    found = summarise(measure_seen(model, vertices, track) | measure(model, vertices, track))
    found |= moving(run, motion, vertices, simulated)
    found["sensitivity"] = 1000 * float(np.linalg.norm(np.subtract(simulated, other, dtype=np.float64), axis=-1).mean())
    if static is not None:
        parts = compare_dynamics(vertices, static, simulated, reference(scene, motion, kept, "static"))
        found |= {name: value for name, value in parts.items() if np.isfinite(value)}
    return found


def judged_on(
    run: Run, motions: Sequence[str], animations: Sequence[np.ndarray], static: np.ndarray | None, kept: Path
) -> dict[str, float]:
    """The same on several motions: what the first has nothing to say of, such as a stop, is from the next.

    static: as of `judged`, on the first motion.
    """
    found = judged(run, motions[0], animations[0], static, kept)
    for motion, vertices in zip(motions[1:], animations[1:], strict=True):
        found = moving(run, motion, vertices, reference(run.assembly.scene, motion, kept)) | found
    return found


def network(scene: Scene, motions: Sequence[str], steps: int, kept: Path) -> dict[str, float]:
    """Train the scene's network and judge it on the motions."""
    run, minutes = trained(scene, steps, kept)
    animations = [run.animate(motion) for motion in motions]
    return judged_on(run, motions, animations, still(run, motions[0]), kept) | {"minutes": minutes}


def networks(scenes: dict[str, Scene], motions: Sequence[str], steps: int, kept: Path, what: str = "network") -> list[dict]:
    """The same of several scenes, two at a time: a row each, named by its key."""
    references(scenes.values(), motions, kept)
    found = abreast([(network, scene, motions, steps, kept) for scene in scenes.values()])
    return [{what: name, **row} for name, row in zip(scenes, found, strict=True)]


def keep_programs(kept: Path) -> None:
    """What one process (`apart`) compiles, the later ones read from the folder; and each runs as the command does."""
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(kept.resolve() / "programs"))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `ncs simulate` does


def apart(job: Callable, *arguments: Any) -> Any:
    """What a function of a module returns, from a process of its own: its memory and its programs are gone afterwards."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as alone:
        return alone.submit(job, *arguments).result()


def abreast(jobs: Sequence[Sequence[Any]]) -> list:
    """What the jobs (function, *arguments) return, two at a time, each in a process and on a half of the cores of its own.

    Much of what a network takes, compiling above all, keeps but one core busy.
    """
    cores = sorted(os.sched_getaffinity(0))
    halves: SimpleQueue = SimpleQueue()
    ended: list[float] = []
    began = time.monotonic()
    for half in (cores[::2], cores[1::2]):
        halves.put(half or cores)

    def one(job):
        half = halves.get()
        try:
            return apart(on_cores, half, *job)
        finally:
            halves.put(half)
            ended.append(time.monotonic() - began)
            told = f"{len(ended)} of {len(jobs)} done ({job[0].__name__}), {ended[-1]:.0f} s"
            print(told, file=sys.stderr, flush=True)

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(one, jobs))


def on_cores(cores: Sequence[int], job: Callable, *arguments: Any) -> Any:
    """What a function returns, of a process that keeps to these cores."""
    os.sched_setaffinity(0, cores)
    return job(*arguments)


def write_csv(file: Path, rows: Sequence[dict]) -> None:
    """All of the rows."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as opened:
        table = csv.DictWriter(opened, list(dict.fromkeys(key for row in rows for key in row)))
        table.writeheader()
        table.writerows(rows)


def write_markdown(file: Path, rows: Sequence[dict], columns: dict[str, str]) -> None:
    """Some columns {key: heading} of the rows."""

    def shown(value: Any) -> str:
        return f"{value:.3g}" if isinstance(value, float) else str(value)

    columns = {key: heading for key, heading in columns.items() if any(key in row for row in rows)}
    lines = ["| " + " | ".join(columns.values()) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(shown(row.get(key, "")) for key in columns) + " |" for row in rows]
    file.write_text("\n".join(lines) + "\n")


def write(out: Path, name: str, rows: Sequence[dict], columns: dict[str, str]) -> None:
    """All of the rows as NAME.csv, and some columns {key: heading} of them as a Markdown table NAME.md."""
    write_csv(out / f"{name}.csv", rows)
    write_markdown(out / f"{name}.md", rows, columns)


def command(name: str, doc: str | None, experiment: Callable, arguments: Sequence[str] | None = None) -> int:
    """Run an experiment(scene, unseen, steps, out, kept) from the command line, and show its table."""
    parser = argparse.ArgumentParser(prog=name, description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="ncs:tshirt", help="scene file, or ncs:NAME (default: ncs:tshirt)")
    parser.add_argument("--steps", type=int, default=2000, help="of training, for every network (default: 2000)")
    parser.add_argument("--unseen", nargs="+", default=UNSEEN, metavar="MOTION", help="what none is trained on")
    parser.add_argument("--quick", action="store_true", help="to try it out, smallest: the numbers mean nothing")
    parser.add_argument("--out", default=f"runs/{name}", help=f"folder for the table and the picture (default: runs/{name})")
    parser.add_argument("--kept", type=Path, default=KEPT, help=f"folder of simulations and trained networks (default: {KEPT})")
    o = parser.parse_args(arguments)
    keep_programs(o.kept)
    try:
        scene = load_scene(o.scene)
        if o.quick:
            scene, o.steps, o.unseen = quickened(scene), QUICK_STEPS, o.unseen[:1]
        print(f"{name}: {o.steps} steps of each network; what is simulated and trained is kept in {o.kept}", file=sys.stderr)
        experiment(scene, standing(scene, o.unseen, o.kept), o.steps, Path(o.out), o.kept)
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    print((Path(o.out) / f"{name}.md").read_text(), end="")
    return 0


@contextmanager
def axes_of(path: Path, count: int, size: tuple[float, float] = (4.0, 3.6), across: int | None = None) -> Iterator[Any]:
    """So many axes, all beside each other or so many across, saved as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across = min(count, across or count)
    down = -(-count // across)
    figure = Figure(figsize=(1 + across * size[0], down * size[1]), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    every = figure.subplots(down, across, squeeze=False).ravel()
    for empty in every[count:]:
        empty.remove()
    every = every[:count]
    yield every
    for axes in every:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def bars(path: Path, rows: Sequence[dict], key: str, columns: dict[str, str]) -> None:
    """A bar for every row that has it, of each column."""
    with axes_of(path, len(columns), (3.6, 1.2 + 0.3 * len(rows))) as every:
        for place, (axes, (name, heading)) in enumerate(zip(every, columns.items(), strict=True)):
            axes.barh([row[key] for row in rows], [row.get(name, 0) for row in rows], color="C0", height=0.6)
            values = [row[name] for row in rows if name in row]
            if name.endswith("total"):  # what sets energies apart is little of them
                axes.set_xlim(min(values) - 0.5 * np.ptp(values), max(values) + 0.1 * np.ptp(values))
            axes.invert_yaxis()
            axes.locator_params(axis="x", nbins=4)
            axes.set_xlabel(textwrap.fill(heading, 36))
            if place:
                axes.set_yticklabels([])


def lines(path: Path, rows: Sequence[dict], key: str, columns: dict[str, str]) -> None:
    """Each column over another one."""
    with axes_of(path, len(columns), (3.2, 3.0)) as every:
        for axes, (name, heading) in zip(every, columns.items(), strict=True):
            axes.plot([row[key] for row in rows], [row[name] for row in rows], marker="o", markersize=3)
            axes.set(xlabel=key, ylabel=heading)

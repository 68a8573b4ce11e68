"""Fast motion: a swing beside a gated unit and beside itself without swing, on what people and recordings do at their fastest.

    python -m experiments.fast_motion [SCENE] [--steps 200] [--seeds 2] [--quick] [--out runs/fast_motion]

Two trainings of each cell and seed: on the fast clips themselves (`CLIPS`), and on the scene's motions alone, to which every
fast clip is new. Each is rolled out on every clip: energy, its worst frame, strain, share inside the body. Writes
fast_motion.csv and .md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from experiments.study import KEPT, changed, keep_programs, quickened, write
from ncs_jax import InputError, Run, Scene, load_scene, train
from ncs_jax.io import BodyRecord, read_body, read_motion
from ncs_jax.io.packaged import packaged
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.metrics.quality import measure

SCENE = Path(__file__).with_suffix(".toml")
FPS, FRAMES = 30, 75
BEGIN = 15  # the frame in which a clip begins to move
FIRST = 50  # steps in which a burst of energy would show
CELLS = ("gated", "swing")
SETS = ("them", "others")  # the clips themselves; the scene's own motions
COLUMNS = {
    "trained": "trained on",
    "clip": "clip",
    "cell": "cell",
    "energy": "energy, J",
    "spread": "of the seeds",
    "stopped": "had it stopped in that frame, J",
    "worst": "worst frame, J",
    "strain": "strain, %",
    "inside": "inside, %",
    "first": f"largest in the first {FIRST} steps, J",
}


def _ramp(seconds: float, at: float = BEGIN / FPS) -> np.ndarray:
    """From 0 to 1 in so many seconds, smoothly."""
    t = np.clip((np.arange(FRAMES) / FPS - at) / seconds, 0, 1)
    return t * t * (3 - 2 * t)


class _Clip:
    """Poses of the body and the path of its root, at first those of standing."""

    def __init__(self, body: BodyRecord):
        self.names = body.joint_names
        self.poses, self.path = np.zeros((FRAMES, len(self.names), 3)), np.zeros((FRAMES, 3))

    def turn(self, joint: str, axis: int, degrees: np.ndarray) -> None:
        self.poses[:, self.names.index(joint), axis] += np.radians(degrees)


def lunge(clip: _Clip) -> None:
    """0.8 m aside in half a second, tilted by 35 and turned by 120 degrees, and back."""
    there = _ramp(0.5) - _ramp(0.5, 1.5)
    clip.path += there[:, None] * [0.8, -0.12, 0.1]
    clip.turn("Hips", 1, 120 * there)
    clip.turn("Hips", 2, 35 * there)
    clip.turn("LeftUpLeg", 2, 50 * there)


def jump(clip: _Clip) -> None:
    """0.6 m up in free flight, after a crouch."""
    t = np.arange(FRAMES) / FPS - BEGIN / FPS
    clip.path[:, 1] += np.where((t > 0) & (t < 0.7), 4.905 * t * (0.7 - t), 0)
    for leg in ("LeftUpLeg", "RightUpLeg"):
        clip.turn(leg, 0, -60 * (_ramp(0.2, 0.3) - _ramp(0.15, 0.5)))


def spin(clip: _Clip) -> None:
    """Two turns in a second, and still."""
    clip.turn("Hips", 1, 720 * _ramp(1.0))


def tilt(clip: _Clip) -> None:
    """The trunk to the horizontal in 0.4 s."""
    clip.turn("Hips", 0, 85 * _ramp(0.4))
    for leg in ("LeftUpLeg", "RightUpLeg"):
        clip.turn(leg, 0, -85 * _ramp(0.4))


def stop(clip: _Clip) -> None:
    """3 m/s, and still from one frame to the next."""
    t = np.arange(FRAMES) / FPS
    clip.path[:, 2] += 3 * np.clip(t - 0.5, 0, 0.8)


def kick(clip: _Clip) -> None:
    """A leg up through the cloth in 0.2 s, and down."""
    clip.turn("LeftUpLeg", 0, -100 * (_ramp(0.2) - _ramp(0.2, 1.2)))


def glitch(clip: _Clip) -> None:
    """A leg elsewhere in one frame, and the root 0.3 m aside in another."""
    clip.poses[BEGIN, clip.names.index("LeftUpLeg"), 0] = np.radians(-80)
    clip.path[2 * BEGIN, 0] = 0.3


def dance(clip: _Clip) -> None:
    """The packaged dance at three times its speed."""
    record = read_motion(packaged("dance"))
    clip.poses, clip.path = (a[::3][:FRAMES] for a in (record.poses, record.translation))


CLIPS: dict[str, Callable[[_Clip], None]] = {f.__name__: f for f in (lunge, jump, spin, tilt, stop, kick, glitch, dance)}


def clips(folder: Path, body: BodyRecord, names: Sequence[str] = tuple(CLIPS)) -> dict[str, str]:
    """Write the clips for a body of the packaged joints into a folder: the file of each."""
    files = {}
    for name in names:
        clip, file = _Clip(body), (folder / f"{name}.npz").resolve()
        CLIPS[name](clip)
        file.parent.mkdir(parents=True, exist_ok=True)
        arrays = {"poses": clip.poses, "trans": clip.path, "joint_names": np.array(clip.names)}
        write_npz(file, **arrays, fps=np.asarray(float(FPS)))
        files[name] = str(file)
    return files


def trained(scene: Scene, steps: int) -> tuple[Run, float]:
    """A run, and the most that a batch of its first steps has of the energies that both cells have."""
    seen: list[float] = []

    def watch(report) -> None:
        if report.step <= FIRST:
            seen.append(sum(v for k, v in report.energies.items() if k not in ("hold", "inertia")))

    return train(scene, steps=steps, report=watch), max(seen)


def judged(run: Run, motion: str, alpha: float) -> dict[str, float]:
    """Energy and its worst frame, J, strain and share inside, %; and `stopped`."""
    model, track = run.assembly.model, run.track(motion)
    moved = run.animate(motion, alpha)
    rows = measure(model, moved, track, exact=False)
    found = {"energy": rows["total"].mean(), "worst": rows["total"].max(), "strain": rows["strain_mean"].mean()}
    if alpha and run.assembly.scene.network.cell == "swing":
        found["stopped"] = stopped(run, motion, moved).mean()
    return {k: float(v) for k, v in (found | {"inside": rows["penetrating"].mean()}).items()}


def stopped(run: Run, motion: str, moved: np.ndarray) -> np.ndarray:
    """Return the energy of every frame, J, had the cloth not gone along with its swing there, after frames in which it had.

    What a step minimises is the energy (10) of one frame after what was before it, and not the sum over a motion: cloth that
    swings has more of that than cloth that never began to.
    """
    model, track = run.assembly.model, run.track(motion)
    still = run.animate(motion, 0.0)
    rows = measure(model, still, track, exact=False)
    earlier = [np.concatenate([moved[:1]] * k + [moved[:-k]]) for k in (1, 2)]
    mass = np.asarray(model.material.density * model.garment.mesh.vertex_area, np.float64)
    away = still.astype(np.float64) - 2 * earlier[0] + earlier[1]
    return rows["total"] - rows["inertia"] + 0.5 * model.fps**2 * np.einsum("v,fvi,fvi->f", mass, away, away)


def experiment(
    scene: Scene,
    steps: int,
    seeds: int,
    out: Path,
    *,
    names: Sequence[str] = tuple(CLIPS),
    sets: Sequence[str] = SETS,
    cells: Sequence[str] = CELLS,
) -> list[dict]:
    """Train every cell on both sets of motions from every seed, judge them on every clip, and return the rows."""
    files = clips(out / "clips", read_body(scene.path(scene.body.file)), names)
    own = scene.motion.files
    found: list[dict] = []
    for told, motions in {"them": tuple(files.values()), "others": own}.items():
        if told not in sets:
            continue
        for cell in cells:
            some: dict[tuple[str, str], list[dict]] = {}
            for seed in range(seeds):
                table: dict[str, dict] = {"motion": {"files": motions, "validation": ()}, "training": {"seed": seed}}
                one = changed(scene, network={"cell": cell}, **table)
                run, first = trained(one, steps)
                for name, file in files.items():
                    for shown, alpha in ((cell, 1.0), ("swing, alpha = 0", 0.0))[: 1 + (cell == "swing")]:
                        some.setdefault((name, shown), []).append(judged(run, file, alpha) | {"first": first})
                        print(told, name, shown, seed, some[name, shown][-1], file=sys.stderr, flush=True)
            for (name, shown), rows in some.items():
                mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
                spread = float(np.ptp([row["energy"] for row in rows]))
                found.append({"trained": told, "clip": name, "cell": shown, **mean, "spread": spread})
    order = {name: k for k, name in enumerate(files)}
    found.sort(key=lambda row: (row["trained"] != "them", order[row["clip"]]))
    write(out, "fast_motion", found, COLUMNS)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it from the command line, and show its table."""
    parser = argparse.ArgumentParser(
        prog="fast_motion", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default=SCENE, help="scene file, or ncs:NAME (default: fast_motion.toml beside it)")
    parser.add_argument("--steps", type=int, default=200, help="of every training (default: 200)")
    parser.add_argument("--seeds", type=int, default=2, help="of every training (default: 2)")
    parser.add_argument("--clips", nargs="+", choices=CLIPS, default=tuple(CLIPS), help="which (default: all)")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=SETS, help="what to train on (default: both)")
    parser.add_argument("--cells", nargs="+", choices=CELLS, default=CELLS, help="which (default: both)")
    parser.add_argument("--quick", action="store_true", help="to try it out, smallest: the numbers mean nothing")
    parser.add_argument("--out", type=Path, default=Path("runs/fast_motion"), help="folder (default: runs/fast_motion)")
    o = parser.parse_args(arguments)
    keep_programs(KEPT)
    try:
        scene = load_scene(o.scene, "fast")
        if o.quick:
            scene, o.steps, o.seeds = quickened(scene), 10, 1
        experiment(scene, o.steps, o.seeds, o.out, names=o.clips, sets=o.sets, cells=o.cells)
    except InputError as error:
        print(f"fast_motion: {error}", file=sys.stderr)
        return 2
    print((o.out / "fast_motion.md").read_text(), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())

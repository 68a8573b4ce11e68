"""What many motions cost beside few: memory by stage, and the time to the first step, of a step and of a new share of them.

    python -m benchmarks.scale [SCENE] [--minutes 60] [--clips 3000] [--repeats 5] [--quick] [--json FILE]

The many are made here: pieces of the packaged motions, each of which others are mixed into, mirrored or not, turned, and played
faster or slower; in folders as AMASS has them. Scene and many are trained in processes of their own, so that the peak of memory
is that of each stage. A refresh goes with every checkpoint: the next share of the motions, and the swing of its frames.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.measure import apart, forget_peak, peak_memory, read, run, table
from ncs_jax import InputError, io
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.prepare.mirroring import mirror_partners
from ncs_jax.prepare.retarget import body_names
from ncs_jax.runs.placed_scene import PlacedScene
from ncs_jax.runs.run import assemble
from ncs_jax.scene.features import mirror
from ncs_jax.scene.spec import Scene, load_scene, scene_from
from ncs_jax.training.batches import CHUNK
from ncs_jax.training.devices import trim_memory

SOURCES = ("stand", "walk", "walk_turn_stop", "jump", "twist", "lift_arms", "dance", "mixed")
FPS = 30
SUBJECTS = 20  # folders, of three data sets


def make_motions(folder: Path, minutes: float, clips: int, seed: int = 0) -> int:
    """Write so many clips, of so many minutes together, into a folder as AMASS lays it out; return the frames made."""
    rng, body = np.random.default_rng(seed), io.read_body("ncs:body")
    partner, axis = mirror_partners(body_names(body), body.joints, body.parents)
    sources = [io.read_motion(f"ncs:{name}") for name in SOURCES]
    total, made = round(60 * FPS * minutes), 0
    lengths = rng.dirichlet(np.full(clips, 4.0)) * (total - 2 * clips)
    cuts = np.concatenate([[0], np.cumsum(lengths).round().astype(int)])
    for number, length in enumerate((np.diff(cuts) + 2).tolist()):
        a, b = (sources[i] for i in rng.integers(len(sources), size=2))
        poses, path = _played(a, length, rng)
        other, _ = _played(b, length, rng)
        share = rng.uniform(0, 0.5, (1, poses.shape[1], 1))
        share[:, 0] = 0  # the heading is its own
        poses = poses + share * (other - poses)  # small angles: as good as between rotations
        if rng.random() < 0.5:
            poses, path = mirror(poses, path, partner, axis)
        turn = Rotation.from_rotvec([0, rng.uniform(-np.pi, np.pi), 0])
        poses[:, 0], path = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec(), turn.apply(path)
        subject = folder / f"Set{number % 3}" / f"Subject_{number % SUBJECTS}_F"
        names = {"joint_names": np.array(body.joint_names), "fps": np.array(FPS, np.float32)}
        write_npz(
            subject / f"clip {number:05d}_poses.npz", poses=poses.astype(np.float32), trans=path.astype(np.float32), **names
        )
        made += length
    for subject in sorted(folder.glob("*/*")):
        write_npz(subject / "shape.npz", betas=np.zeros(16), gender=np.array("female"))
    return made


def _played(motion: io.MotionRecord, frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """So many frames of a motion from some moment on, at some speed, to and fro where it is too short."""
    times = rng.uniform(0, len(motion.poses)) + rng.uniform(0.7, 1.3) * np.arange(frames)
    last = len(motion.poses) - 1
    times = last - np.abs(times % (2 * last) - last)
    low = np.minimum(times.astype(int), last - 1)
    t = (times - low)[:, None]
    poses = motion.poses[low] + t[..., None] * (motion.poses[low + 1] - motion.poses[low])
    return poses, motion.translation[low] + t * (motion.translation[low + 1] - motion.translation[low])


def point(scene: Scene, repeats: int) -> dict:
    """A scene, measured in this process, as `train` takes it up."""
    peaks, seconds, began = {}, {}, np.zeros(2)

    def clocks() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])

    def stage(name: str) -> None:
        nonlocal began
        peaks[name], seconds[name] = peak_memory() >> 20, clocks() - began
        forget_peak()
        began = clocks()

    forget_peak()
    began = clocks()
    stage("start")
    assembly = assemble(scene)
    trim_memory()
    stage("made ready")
    placed = PlacedScene(assembly, 0)
    state = placed.initial_state()
    stage("placed")
    placed.refresh(state.params, 0)
    stage("refresh, compiled")
    placed.compile(state, CHUNK)
    stage("step, compiled")
    each, spec = [], scene.training
    for chunk in range(repeats + 1):
        start = clocks()
        state, _ = placed.run_chunk(state, chunk * CHUNK, CHUNK, spec.steps)
        jax.block_until_ready(state)
        each.append((clocks() - start) / CHUNK)
    stage("steps")
    renewed = []
    for number in range(1, 3):
        start = clocks()
        placed.refresh(state.params, number * spec.checkpoint_every)
        jax.block_until_ready(placed.features)
        renewed.append(clocks() - start)
    stage("refresh")
    placed.rebuild_lists(state.params)
    stage("lists")
    step, refresh = np.median(each[1:], axis=0), np.min(renewed, axis=0)
    return {
        "frames": sum(len(assembly.motions[name].poses) for name in assembly.scene.motion.files),
        "motions": len(assembly.scene.motion.files),
        "peaks": peaks,
        "seconds": seconds,
        "ms a step": 1000 * step,
        "refresh": refresh,
        "share": 100 * refresh / (spec.checkpoint_every * step + refresh),
    }


def benchmark(options) -> dict:
    """Measure the scene as it is, then with many motions."""
    spec = read(options.scene)
    where = options.scene if options.scene.startswith("ncs:") else str(Path(options.scene).absolute())
    minutes, clips = (1, 20) if options.quick else (options.minutes, options.clips)
    found = {}
    with tempfile.TemporaryDirectory() as made:
        start = time.perf_counter()
        frames = make_motions(Path(made), minutes, clips)
        print(f"made {frames} frames in {clips} motions, {time.perf_counter() - start:.0f} s", file=sys.stderr)
        for name, motions in (("the scene", list(spec.motion.files)), (f"{minutes} minutes", [made])):
            found[name] = apart(
                "benchmarks.scale", [POINT, where, str(1 if options.quick else options.repeats), json.dumps(motions)], 3600
            )
    return {"points": found, "rows": {}}


def show(figures: dict) -> str:
    """The table."""
    points = figures["points"]
    failed = [f"{name}: {found['failed']}" for name, found in points.items() if "failed" in found]
    points = {name: found for name, found in points.items() if "failed" not in found}
    if not points:
        return "\n".join(failed)
    first = next(iter(points.values()))
    rows = [[f"peak MB, {stage}", *(p["peaks"][stage] for p in points.values())] for stage in first["peaks"]]
    rows.append(["peak MB", *(max(p["peaks"].values()) for p in points.values())])
    for number, clock in enumerate(("wall", "processor")):
        rows += [
            [f"s, {stage}, {clock}", *(p["seconds"][stage][number] for p in points.values())] for stage in first["seconds"]
        ]
        rows.append([f"ms a step, {clock}", *(p["ms a step"][number] for p in points.values())])
        rows.append([f"s a refresh, {clock}", *(p["refresh"][number] for p in points.values())])
        rows.append([f"% of training, {clock}", *(p["share"][number] for p in points.values())])
    heads = ["", *(f"{name}" for name in points)]
    rows = [["frames", *(p["frames"] for p in points.values())], ["motions", *(p["motions"] for p in points.values())], *rows]
    return "\n".join([table(heads, rows, 12), *failed])


POINT = "--point"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == [POINT]:
        try:
            scene = load_scene(given[1])
            tables = scene.to_dict()
            tables["motion"] |= {"files": json.loads(given[3]), "validation": []}
            found = point(scene_from(tables, scene.source), int(given[2]))
            print(json.dumps(found, default=lambda a: a.tolist()))
        except InputError as error:
            print(f"scale: {error}", file=sys.stderr)
            return 2
        return 0
    return run(
        __doc__, benchmark, show, given,
        minutes=(60, "minutes of motion"), clips=(3000, "motions that they are in"), repeats=(5, "timed chunks of steps"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

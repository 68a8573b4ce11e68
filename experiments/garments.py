"""The field's table: every garment of some folders on one body, by every method and by the simulation, in HOOD's columns.

    python -m experiments.garments FOLDER [FOLDER ...] --body BODY --motions M [M ...] [--unseen M [M ...]]
        [--methods simulation pbns snug ncs] [--steps 2000 | --minutes 10] [--fps 30] [--quick] [--out runs/garments]

Every mesh is placed on the body as by `ncs fit`. What hangs, and of which the mesh alone does not tell how high, is placed as
the others of its folder, if these agree. The cloth is that of HOOD's evaluation. Each method is trained on the motions, and is
measured on them and on the unseen ones by the energy that the simulation minimises, with smooth contact. The columns are those
of HOOD (Grigorev et al. 2023), means over all frames: stretch (St. Venant-Kirchhoff), bending, inertia, gravity (heights from
where the motion begins), collision, total, norm of the gradient (mean over the vertices), and vertices that penetrate, which
begins 1 mm outside of the skin there. Unlike there, contact is a part of the energy and so of its gradient, there is no
friction, and bending is measured from the garment as it is made. Beside them: vertices inside, triangles that pass through
others, out of balance (median), and the distance to the simulation.

Writes garments.csv, a row for every motion too, garments.md, and a picture of each garment. A garment that cannot be used is
told by name, and the others go on. What is simulated and trained is kept in `--kept`.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.study import (
    KEPT,
    QUICK_STEPS,
    abreast,
    apart,
    changed,
    keep_programs,
    named,
    quickened,
    reference,
    trained,
    twins,
    write_csv,
    write_markdown,
)
from ncs_jax import InputError, Run, Scene, assemble, io, scene_from, summarise
from ncs_jax.cli import arguments
from ncs_jax.io.mesh.garment import FORMATS
from ncs_jax.metrics.quality import measure
from ncs_jax.metrics.seen import measure_seen
from ncs_jax.prepare.fit import PINS, settle
from ncs_jax.prepare.garment_placement import place
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.placement import Placement
from ncs_jax.prepare.skinning_weights import with_body_weights
from ncs_jax.scene.motion_names import split_frames

METHODS = ("simulation", "pbns", "snug", "ncs")
THICKNESS = 4.7e-4  # m
# By which HOOD measures itself and SNUG (Santesteban et al. 2022): a Young's modulus of 70 kPa and a Poisson's ratio of 0.485
# in plane stress, and 50 times the bending stiffness that follows. The Lame parameters, in Pa there, are times the thickness.
CLOTH: dict[str, Any] = {
    "density": 0.20022,
    "membrane": {"model": "stvk", "lam": 44_400 * THICKNESS, "mu": 23_600 * THICKNESS},
    "bending": {"stiffness": 3.9625778e-5},
}
AGREE = 0.03  # m that places of a folder's garments may differ by
ALL = "all"
COLUMNS = {
    "garment": "garment",
    "method": "method",
    "on": "motions",
    "membrane": "stretch, J",
    "bending": "bending, J",
    "inertia": "inertia, J",
    "gravity": "gravity, J",
    "collision": "collision, J",
    "total": "total, J",
    "gradient_norm": "gradient norm, N",
    "within_1mm": "penetrating at 1 mm, %",
    "penetrating": "inside, %",
    "self_intersecting": "self-intersections, %",
    "body_intersecting": "triangles through the body, %",
    "skin_share": "skin seen, %",
    "out_of_balance": "out of balance, g",
    "distance": "mm to simulation",
    "minutes": "training, min",
}


@dataclass(frozen=True)
class Task:
    """What is done with every garment: motions to train on, others to measure on too, for how long, and where all is kept."""

    motions: tuple[str, ...]
    unseen: tuple[str, ...]
    steps: int
    minutes: float | None
    kept: Path

    @property
    def measured(self) -> tuple[str, ...]:
        """All motions."""
        return tuple(dict.fromkeys((*self.motions, *self.unseen)))


# --- from files to scenes -------------------------------------------------------------------------------------------


def garment_files(places: Sequence[str], others: Sequence[str]) -> list[Path]:
    """The mesh files of folders, and files that are named themselves; but the body and the motions."""
    taken = {Path(name).resolve() for name in others}
    found: dict[Path, Path] = {}  # by where it really lies, so that none is there twice
    for folder in map(Path, places):
        if not folder.exists():
            raise InputError("a folder of garments, or one garment, expected", file=folder, mend="check the path")
        files = sorted(folder.iterdir()) if folder.is_dir() else [folder]
        meshes = [f for f in files if f == folder or (f.suffix.lower() in FORMATS and f.resolve() not in taken)]
        found |= {f.resolve(): f for f in meshes if f.resolve() not in found}
    if not found:
        raise InputError(f"a mesh file expected, {', '.join(FORMATS)}", field="FOLDER", value=" ".join(map(str, places)))
    return list(found.values())


def placed(files: Sequence[Path], body: io.BodyRecord) -> Iterator[tuple[Path, Placement | InputError]]:
    """Every garment at its place on the body; one that is in doubt as the others of its folder, if these agree."""
    read: dict[Path, io.GarmentRecord] = {}
    found: dict[Path, Placement | InputError] = {}
    for file in files:
        try:
            read[file] = with_body_weights(io.read_garment(file, turn_faces=True), body)
            found[file] = place(file, read[file], body)
        except InputError as error:
            found[file] = error
    for file, own in found.items():
        others = [p for f, p in found.items() if f.parent == file.parent and isinstance(p, Placement) and not p.doubt]
        if isinstance(own, Placement) and own.doubt and (known := agreed(others)):
            own = place(file, read[file], body, **known)
            print(f"{file}: placed as the others of its folder, {own.options}", file=sys.stderr)
        yield file, own


def agreed(places: Sequence[Placement]) -> dict[str, Any]:
    """Unit, axes and place on which two or more garments of one origin agree, as `place` takes them; else nothing."""
    ways, shifts = {(p.scale, p.up, p.turn) for p in places}, np.array([p.shift for p in places])
    if len(places) < 2 or len(ways) > 1 or np.ptp(shifts, axis=0).max() > AGREE:
        return {}
    scale, up, turn = ways.pop()
    return {"scale": scale, "up": up, "turn": turn, "move": tuple(np.median(shifts, axis=0).tolist())}


def scenes_of(files: Sequence[Path], plain: Scene, body: io.BodyRecord, kept: Path) -> tuple[dict[str, Scene], dict[str, str]]:
    """A scene of every garment that can be used, by its name, and why others cannot."""
    scenes: dict[str, Scene] = {}
    refused: dict[str, str] = {}
    for file, found in placed(files, body):
        try:
            if isinstance(found, InputError):
                raise found
            cloth = settle(file, found, body)
            # Named by the mesh that fitting makes, to .01 mm: what is kept is looked up by this name.
            content = hashlib.sha256(file.read_bytes() + cloth.garment.vertices.round(5).tobytes()).hexdigest()
            own = kept / "fitted" / f"{file.stem}_{named(content, plain.to_dict()['body'])}.npz"
            own.parent.mkdir(parents=True, exist_ok=True)
            io.write_garment(own, cloth.garment)
        except InputError as error:
            refused[str(file)] = str(error)
            print(f"not used: {error}", file=sys.stderr)
            continue
        contact = {"thickness": cloth.contact.thickness, "stiffness": cloth.contact.stiffness}
        names = (file.stem, file.name, f"{file.parent.name}_{file.name}", "_".join(file.resolve().parts[1:]))
        scenes[next(name for name in names if name not in scenes)] = changed(
            plain,
            garment={"file": str(own.resolve()), "pins": PINS if PINS in cloth.garment.groups else ""},
            physics={**CLOTH, "collision": contact},
            training={"window": 15, "motion_augmentation": 0.5},  # as `ncs fit` writes
        )
    return scenes, refused


# --- measured -------------------------------------------------------------------------------------------------------


def rows_of(
    scene: Scene, task: Task, animations: Sequence[np.ndarray], beside: Sequence[np.ndarray], facts: dict[str, Any]
) -> list[dict]:
    """A row for every motion, one for all that it was trained on, one for all others; `beside` are simulations, if any."""
    judge = Run(assemble(twins(scene.without_network())["dynamic"]), {})
    found = {}
    for k, (motion, vertices) in enumerate(zip(task.measured, animations, strict=True)):
        model, track = judge.assembly.model, judge.track(motion)
        found[motion] = measure_seen(model, vertices, track) | measure(model, vertices, track, self_contact=True)
        if beside:
            away = np.linalg.norm(np.subtract(vertices, beside[k], dtype=np.float64), axis=-1)
            found[motion]["distance"] = 1000 * away.mean(axis=-1)
    rows = []
    for on, motions in {"trained": task.motions, "unseen": task.measured[len(task.motions) :]}.items():
        each = {motion: found[motion] for motion in motions}
        if motions:
            each[ALL] = {key: np.concatenate([found[motion][key] for motion in motions]) for key in found[motions[0]]}
        for motion, arrays in each.items():
            rows.append({**facts, "on": on, "motion": motion, "frames": len(arrays["total"]), **summarise(arrays)})
    return rows


def measured(name: str, scene: Scene, method: str, beside: bool, task: Task) -> tuple[list[dict], np.ndarray] | str:
    """Train one method, or take the simulation: its rows, `beside` simulations, and its first animation; or what is wrong."""
    facts: dict[str, Any] = {"garment": name, "method": method}
    try:
        simulations = [reference(scene, motion, task.kept) for motion in task.measured] if beside else []
        if method == "simulation":
            animations = simulations
        else:
            scene = changed(scene, network={"method": method})
            run, facts["minutes"] = trained(scene, task.steps, task.kept, task.minutes)
            facts["steps"] = run.steps
            animations = [run.animate(motion) for motion in task.measured]
        facts["vertices"] = animations[0].shape[1]
        return rows_of(scene, task, animations, simulations, facts), animations[0]
    except InputError as error:
        return str(error)


def simulated(scene: Scene, motion: str, kept: Path) -> str:
    """Simulate; why it cannot be, else nothing."""
    try:
        reference(scene, motion, kept)
    except InputError as error:
        return str(error)
    return ""


def draw(path: Path, scene: Scene, motion: str, animations: dict[str, np.ndarray]) -> None:
    """The same moments of all methods, in a row each."""
    from ncs_jax.view.character import animation_of
    from ncs_jax.view.pictures import contact_sheet

    run = Run(assemble(scene.without_network()), {})
    record = run.motion(motion)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = {method: animation_of(run.assembly, record, vertices) for method, vertices in animations.items()}
    contact_sheet(path, drawn, tile=400)


def experiment(scenes: dict[str, Scene], methods: Sequence[str], task: Task, out: Path) -> tuple[list[dict], dict[str, str]]:
    """Simulate, train and measure all, two at a time; write a picture of each garment; the rows, and what could not be used."""
    refused: dict[str, str] = {}
    beside = "simulation" in methods
    if beside:
        jobs = [(name, scene, motion) for motion in task.measured for name, scene in scenes.items()]
        faults = abreast([(simulated, scene, motion, task.kept) for _, scene, motion in jobs])
        refused = {name: f"{name}: {fault}" for (name, *_), fault in zip(jobs, faults, strict=True) if fault}
        scenes = {name: scene for name, scene in scenes.items() if name not in refused}
    todo = [(name, method) for name in scenes for method in methods]
    results = abreast([(measured, name, scenes[name], method, beside, task) for name, method in todo])
    rows: list[dict] = []
    drawn: dict[str, dict[str, np.ndarray]] = {}
    for (name, method), result in zip(todo, results, strict=True):
        if isinstance(result, str):
            refused[f"{name}, {method}"] = f"{name}, {method}: {result}"
            continue
        rows += result[0]
        drawn.setdefault(name, {})[method] = result[1]
    for name, animations in drawn.items():
        apart(draw, out / f"{name}.png", scenes[name], task.measured[0], animations)
    for fault in refused.values():
        print(f"not used: {fault}", file=sys.stderr)
    return rows, refused


def main(given: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="garments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", metavar="FOLDER", help="folders of garments made for the body, or garments")
    arguments.add_body(parser)
    parser.add_argument("--motions", nargs="+", required=True, metavar="M", help="to train and to measure on")
    parser.add_argument("--unseen", nargs="+", default=[], metavar="M", help="to measure on only")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS, help="default: all")
    long = parser.add_mutually_exclusive_group()
    long.add_argument("--steps", type=arguments.whole, default=2000, help="of training, for every network (default: 2000)")
    long.add_argument("--minutes", type=arguments.positive, help="of training, for every network, two at a time")
    parser.add_argument("--fps", type=arguments.positive, default=30.0, help="frames per second (default: 30, HOOD's)")
    parser.add_argument("--quick", action="store_true", help="to try it out, smallest: the numbers mean nothing")
    parser.add_argument(
        "--out", type=Path, default="runs/garments", help="folder of table and pictures (default: runs/garments)"
    )
    parser.add_argument("--kept", type=Path, default=KEPT, help=f"folder of simulations and trained networks (default: {KEPT})")
    o = parser.parse_args(given)
    keep_programs(o.kept)
    try:
        rows, refused = run(o)
    except InputError as error:
        print(f"garments: {error}", file=sys.stderr)
        return 2
    if not rows:
        print("garments: no garment could be used", file=sys.stderr)
        return 2
    write_csv(o.out / "garments.csv", rows)
    table = o.out / "garments.md"
    write_markdown(table, [row for row in rows if row["motion"] == ALL], COLUMNS)
    text = table.read_text() + "".join(f"\nNot used: {why}\n" for why in refused.values())
    table.write_text(text)
    print(text, end="")
    return 0


def run(o: argparse.Namespace) -> tuple[list[dict], dict[str, str]]:
    """Do what the command line asks for: the rows, and what could not be used."""

    def whole(name: str) -> str:
        return name if name.startswith("ncs:") else str(Path(name).resolve())

    body = whole(o.body)
    motions, unseen = (tuple(dict.fromkeys(map(whole, names))) for names in (o.motions, o.unseen))
    task = Task(motions, unseen, QUICK_STEPS if o.quick else o.steps, None if o.quick else o.minutes, o.kept)
    person = {"file": body, "betas": tuple(o.betas), "part": tuple(o.part) or "auto"}
    plain = scene_from({"body": person, "motion": {"files": motions, "fps": o.fps}})
    plain = quickened(plain) if o.quick else plain
    record = arguments.body_of(o)
    files = garment_files(o.folders, [body, *(split_frames(motion)[0] for motion in task.measured)])
    for motion in task.measured:
        load_motion(plain, motion, record)  # one that cannot be used is no garment's fault
    scenes, refused = scenes_of(files, plain, record, o.kept)
    rows, more = experiment(scenes, o.methods, task, o.out)
    return rows, refused | more


if __name__ == "__main__":
    sys.exit(main())

"""PBNS, SNUG, NCS and a simulation, side by side: the same garment, energies, decoder and time of training.

    python -m experiments.methods [SCENE] [--minutes 4] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick] [--out runs/methods]

Every network is trained on the scene's motions but the unseen ones, in a process of its own, and judged on those beside the
simulation: energies, strain, penetration, and how it moves (`ncs_jax.dynamics.MEASURES`). Writes methods.csv, .md and .png, a
strip of the same frames of all four for each motion. `--quick` is for trying it out: its numbers mean nothing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.speed_accuracy import streamed
from experiments.study import apart, changed, judged, reference, write
from ncs_jax import InputError, Run, Scene, assemble, load_scene, train
from ncs_jax.preview import posed_body

METHODS = ("pbns", "snug", "ncs")
UNSEEN = ("ncs:mixed", "ncs:walk_turn_stop")
COLUMNS = {
    "method": "",
    "motion": "on",
    "total": "energy, J",
    "strain_mean": "strain, %",
    "penetrating": "inside, %",
    "dynamic_share": "dynamic share",
    "stopped_share": "after a stop",
    "settling": "settling, s",
    "overshoot": "overshoot, %",
    "lag": "lag, s",
    "hem_correlation": "hem correlation",
    "distance": "mm to simulation",
    "minutes": "training, min",
    "frame": "ms a frame",
}


def trained(scene: Scene, unseen: Sequence[str], kept: Path, minutes: float | None, steps: int | None) -> list[dict]:
    """Train the scene's method and judge it on the unseen motions: a row each, the vertices in it."""
    began = time.monotonic()
    run = train(scene, minutes=minutes, steps=steps)
    taken = (time.monotonic() - began) / 60
    rows = []
    for motion in unseen:
        x = run.animate(motion)
        row = {"method": scene.network.method, "motion": motion, **judged(run, motion, x, reference(scene, motion, kept))}
        rows.append(row | {"minutes": taken, "frame": 1e3 * streamed(run, motion), "vertices": x})
    return rows


def simulated(scene: Scene, unseen: Sequence[str], kept: Path) -> list[dict]:
    """The simulation, judged like the others."""
    run, rows = Run(assemble(scene), {}), []
    for motion in unseen:
        x = reference(scene, motion, kept)
        rows.append({"method": "simulation", "motion": motion, **judged(run, motion, x, x), "vertices": x})
    return rows


def experiment(
    scene: Scene, out: Path, unseen: Sequence[str] = UNSEEN, *, minutes: float | None = 4.0, steps: int | None = None
) -> list[dict]:
    """Measure all four, write the table and the strips into `out`, and return the rows."""
    seen = tuple(name for name in scene.motion.files if name not in unseen)
    scene = changed(scene, motion={"files": seen, "validation": ()})
    kept = out / "simulations"
    rows = apart(simulated, scene, unseen, kept)
    for method in METHODS:
        rows += apart(trained, changed(scene, network={"method": method}), unseen, kept, minutes, steps)
    told = [{key: value for key, value in row.items() if key != "vertices"} for row in rows]
    write(out, "methods", told, COLUMNS)
    draw(scene, out, rows)
    return told


def draw(scene: Scene, out: Path, rows: Sequence[dict]) -> None:
    """For each motion, the contact sheets of all methods below each other."""
    from PIL import Image, ImageDraw

    from ncs_jax.pictures import INK, PAPER, contact_sheet

    run = Run(assemble(scene), {})
    for motion in dict.fromkeys(row["motion"] for row in rows):
        sheets = []
        for row in (row for row in rows if row["motion"] == motion):
            file = out / "sheet.png"
            body = None if run.assembly.body is None else posed_body(run.assembly.body, run.motion(motion))
            faces = None if run.assembly.body is None else run.assembly.body.faces
            contact_sheet(file, row["vertices"], run.assembly.garment.faces, body, faces, run.assembly.model.fps, tile=260)
            with Image.open(file) as drawn:
                sheets.append((row["method"], drawn.convert("RGB")))
            file.unlink()
        strip = Image.new("RGB", (max(s.width for _, s in sheets), sum(s.height for _, s in sheets)), PAPER)
        top = 0
        for method, sheet in sheets:
            strip.paste(sheet, (0, top))
            ImageDraw.Draw(strip).text((60, top + 8), method.upper() if len(method) < 5 else method, INK)
            top += sheet.height
        strip.save(out / f"methods_{Path(motion.removeprefix('ncs:')).stem}.png", optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="ncs:tshirt", help="scene file, or ncs:NAME (default: ncs:tshirt)")
    parser.add_argument("--minutes", type=float, default=4.0, help="of training, for every network (default: 4)")
    parser.add_argument("--unseen", nargs="+", default=UNSEEN, metavar="MOTION", help="what none is trained on")
    parser.add_argument("--quick", action="store_true", help="20 steps of training")
    parser.add_argument("--out", default="runs/methods", help="folder for the table and the pictures")
    options = parser.parse_args(arguments)
    try:
        length = {"steps": 20, "minutes": None} if options.quick else {"minutes": options.minutes}
        rows = experiment(load_scene(options.scene), Path(options.out), options.unseen, **length)
    except InputError as error:
        print(f"methods: {error}", file=sys.stderr)
        return 2
    for row in rows:
        print("  ".join(f"{k} {row[k]:.4g}" if isinstance(row[k], float) else f"{row[k]:12}" for k in COLUMNS if k in row))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What does training need? Window, batch, number of motions; a network trained at 15, 30 or 60 frames/s used at all three.

    python -m experiments.budget [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

Windows (of a gated unit), batches and numbers of motions are changed one at a time from the scene's own and trained for as
many steps. Writes budget.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from experiments.study import (
    COLUMNS,
    abreast,
    bars,
    changed,
    command,
    judged,
    networks,
    recurrent,
    references,
    still,
    trained,
    without,
    write,
)
from ncs_jax import Scene, assemble

WINDOWS, BATCHES, RATES = (5, 15, 30), (8, 32, 64), (15.0, 30.0, 60.0)


def used(scene: Scene, motion: str, steps: int, kept: Path) -> list[dict]:
    """Train at the scene's frame rate, use at all of them: a row each."""
    run, minutes = trained(scene, steps, kept)
    rows = []
    for fps in RATES:
        other = assemble(changed(scene, motion={"fps": fps}), prepared=run.assembly.prepared)
        there = replace(run, assembly=other)
        row = judged(there, motion, there.animate(motion), still(there, motion), kept)
        rows.append({"change": f"trained at {scene.motion.fps:g} frames/s, used at {fps:g}", **row, "minutes": minutes})
    return rows


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    scene = without(scene, unseen)
    files = scene.motion.files
    scenes = {f"window of {n}": changed(recurrent(scene), training={"window": n}) for n in WINDOWS}
    scenes |= {f"batch of {n}": changed(scene, training={"batch": n}) for n in BATCHES}
    counts = sorted({min(n, len(files)) for n in (1, 3, len(files))})
    # the last ones, which move most
    scenes |= {f"{n} of {len(files)} motions": changed(scene, motion={"files": files[-n:]}) for n in counts}
    rows = networks(scenes, unseen, steps, kept, "change")
    at = {fps: changed(scene, motion={"fps": fps}) for fps in RATES}
    references([at[fps] for fps in sorted(RATES, reverse=True)], unseen[:1], kept)
    for found in abreast([(used, at[fps], unseen[0], steps, kept) for fps in RATES]):
        rows += found
    write(out, "budget", rows, {"change": "", **COLUMNS})
    bars(out / "budget.png", rows, "change", {key: COLUMNS[key] for key in ("dynamic_share", "distance", "minutes")})
    return rows


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    by = {row["change"]: row for row in rows}
    far = ", ".join(f"{name} {row['distance']:.1f} mm" for name, row in by.items() if "frames/s" not in name)

    def rate(a, b):
        row = by[f"trained at {a:g} frames/s, used at {b:g}"]
        return f"{row['distance']:.1f} mm ({row['dynamic_share']:.2f} of the simulation's speed)"

    return (
        f"To the simulation: {far}; trained at 15 frames/s and used at 60 {rate(15, 60)}, trained at 60 and used there "
        f"{rate(60, 60)}."
    )


main = partial(command, "budget", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

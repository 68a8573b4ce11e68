"""Motion control: what alpha, the scale of the dynamic code, does to speed, strain, penetration and energy.

    python -m experiments.control [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

One network, trained on the scene's motions but the unseen ones, animates those with alpha from 0 to 3: all is of the first, but
what moves after a stop is of the first that has one. A result counts as usable while no more than 1 % of the vertices are
inside the body and the mean strain is at most twice that of alpha = 1. Writes control.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from experiments.study import apart, command, judged_on, lines, references, still, trained, without, write
from ncs_jax import Scene

ALPHAS = np.arange(0, 3.01, 0.25)
INSIDE, STRAIN = 1.0, 2.0  # %, of the strain at alpha = 1
COLUMNS = {
    "alpha": "alpha",
    "speed": "speed, mm/s",
    "dynamic_share": "of the simulation's",
    "strain_mean": "strain, %",
    "penetrating": "inside, %",
    "total": "energy, J",
    "distance": "mm to simulation",
    "sensitivity": "two simulations, mm",
    "dynamic_correlation": "dynamic correlation",
    "dynamic_factor": "dynamic factor",
    "stopped_share": "after a stop",
    "usable": "usable",
}


def measured(scene: Scene, motions: Sequence[str], steps: int, kept: Path) -> list[dict]:
    """A row for each alpha."""
    run, _ = trained(scene, steps, kept)
    static = still(run, motions[0])
    animations = {float(a): [run.animate(motion, a) for motion in motions] for a in ALPHAS}
    return [{"alpha": a, **judged_on(run, motions, found, static, kept)} for a, found in animations.items()]


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    scene = without(scene, unseen)
    references([scene], unseen, kept)
    rows = apart(measured, scene, unseen, steps, kept)
    strain = next(row["strain_mean"] for row in rows if row["alpha"] == 1)
    for row in rows:
        good = row.get("penetrating", 0) <= INSIDE and row["strain_mean"] <= STRAIN * strain
        row["usable"] = "yes" if good else "no"
    write(out, "control", rows, COLUMNS)
    lines(out / "control.png", rows, "alpha", {key: COLUMNS[key] for key in ("speed", "strain_mean", "penetrating", "total")})
    return rows


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    still, one = rows[0], next(row for row in rows if row["alpha"] == 1)
    usable = [row["alpha"] for row in rows if row["usable"] == "yes" and row["alpha"] >= 1]
    upto = f"usable up to alpha = {max(usable):g}" if usable else "not usable at alpha = 1"
    swung = [f"{row['stopped_share']:.2f}" for row in (one, rows[-1]) if "stopped_share" in row]
    stopped = f"; after a stop it moves {' and '.join(swung)} of what the simulation does" if swung else ""
    return (
        f"From alpha = 0 to {rows[-1]['alpha']:g} the garment's speed goes from {still['speed']:.0f} over {one['speed']:.0f} "
        f"(alpha = 1) to {rows[-1]['speed']:.0f} mm/s, strain from {still['strain_mean']:.2f} to "
        f"{rows[-1]['strain_mean']:.2f} %{stopped}; the result is {upto} by the measure above."
    )


main = partial(command, "control", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

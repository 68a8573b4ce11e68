"""How much of a number is luck? The scene's network, trained from three seeds.

    python -m experiments.spread [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

All else is the same. The last row is the greatest value less the least one: what two networks differ by that differ in nothing
but chance. Writes spread.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from experiments.study import COLUMNS, bars, changed, command, networks, without, write
from ncs_jax import Scene

SEEDS = 3
RANGE = "greatest less least"


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    scene = without(scene, unseen)
    seeds = [scene.training.seed + k for k in range(SEEDS)]
    rows = networks({str(seed): changed(scene, training={"seed": seed}) for seed in seeds}, unseen, steps, kept, "seed")
    of_all = {key: [row[key] for row in rows] for key in rows[0] if key != "seed" and all(key in row for row in rows)}
    between = {"seed": RANGE} | {key: max(values) - min(values) for key, values in of_all.items()}
    write(out, "spread", [*rows, between], {"seed": "", **COLUMNS})
    bars(out / "spread.png", rows, "seed", {key: COLUMNS[key] for key in ("total", "dynamic_share", "distance")})
    return [*rows, between]


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    first, between = rows[0], rows[-1]
    text = (
        f"From seed to seed the energy differs by {100 * between['total'] / first['total']:.2f} %, the dynamic share by "
        f"{between['dynamic_share']:.3f}, the hem correlation by {between['hem_correlation']:.3f} and the distance to the "
        f"simulation by {between['distance']:.2f} mm"
    )
    if "stopped_share" in between:
        text += f", what moves after a stop by {between['stopped_share']:.2f}"
    if "settling" in between:
        text += f", its settling by {between['settling']:.2f} s"
    return text + ": differences in this study that are smaller than these say nothing."


main = partial(command, "spread", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

"""Does augmentation help on motions that were not trained on? Another window's motion on a pose, and mirrored motions.

    python -m experiments.augmentation [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

`training.motion_augmentation` is the share of a batch that has another window's dynamic code on its static code;
`motion.mirror` adds every motion in a mirror; `training.recombined` is the share in poses put together of the motions' limbs.
Writes augmentation.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from experiments.study import COLUMNS, bars, changed, command, networks, without, write
from ncs_jax import Scene

# Share of a batch with another window's motion, whether mirrored motions are added, and the share in recombined poses.
CHOICES = {
    "none": (0.0, False, 0.0),
    "motion": (0.5, False, 0.0),
    "mirror": (0.0, True, 0.0),
    "recombined": (0.0, False, 0.3),
    "all": (0.5, True, 0.3),
}


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    scene = without(scene, unseen)
    scenes = {
        name: changed(scene, training={"motion_augmentation": share, "recombined": poses}, motion={"mirror": mirrored})
        for name, (share, mirrored, poses) in CHOICES.items()
    }
    rows = networks(scenes, unseen, steps, kept, "augmentation")
    write(out, "augmentation", rows, {"augmentation": "", **COLUMNS})
    bars(out / "augmentation.png", rows, "augmentation", {key: COLUMNS[key] for key in ("total", "dynamic_share", "distance")})
    return rows


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    none, *others = rows

    def told(row):
        change = 100 * (row["total"] / none["total"] - 1)
        return f"{row['augmentation']}: energy {change:+.2f} %, {row['distance'] - none['distance']:+.1f} mm{stopped(row)}"

    def stopped(row):
        return f", {row['stopped_share']:.2f} after a stop" if "stopped_share" in row else ""

    first = f"Against none ({none['total']:.4f} J, {none['distance']:.1f} mm{stopped(none)}): "
    return first + "; ".join(map(told, others)) + "."


main = partial(command, "augmentation", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

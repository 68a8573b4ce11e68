"""Motion that no network has seen: every method on each motion by itself, beside what simulations are from each other there.

    python -m experiments.unseen [SCENE] [--unseen ncs:mixed ncs:walk_turn_stop] [--methods ncs pbns] [--seeds 2]
        [--minutes 10] [--adapt SECONDS] [--quick] [--out runs/unseen]

Networks are trained one after another on the scene's motions but the unseen ones, on all cores; as a row with "adapted" each
is adapted to each motion after that (`ncs_jax.adapt`). With each motion stand a second simulation of it, which is less exact,
and one without inertia, the equilibrium of every pose. Energies are those of the scene's own contact, depths the deepest of
all frames. Writes unseen.csv, .md, and a strip of the same frames of all for each motion. What is simulated and trained is
kept in `--kept`, where the same command goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from experiments.methods import METHODS, SIMULATIONS, draw, simulated
from experiments.study import (
    COLUMNS,
    KEPT,
    QUICK_STEPS,
    UNSEEN,
    apart,
    changed,
    judged,
    keep_programs,
    quickened,
    references,
    standing,
    stem,
    still,
    trained,
    without,
    write,
)
from ncs_jax import InputError, Run, Scene, adapt, assemble, load_scene
from ncs_jax.cli import arguments

SHOWN = {"motion": "", "method": "", "seed": "", **COLUMNS, "depth_max": "deepest, mm"}
Found = list[tuple[str, dict, np.ndarray]]  # motion, row, animation


def learned(scene: Scene, unseen: Sequence[str], length: tuple[int, float | None], seconds: float | None, kept: Path) -> Found:
    """Train the scene's network for (steps, minutes): what it is on each motion, and what adapted to it for so many seconds."""
    run, minutes = trained(scene, length[0], kept, length[1])
    found = []
    for motion in unseen:
        found.append(told(run, motion, "", minutes, kept))
        if seconds:
            found.append(told(adapt(run, motion, seconds).run, motion, ", adapted", minutes + seconds / 60, kept))
    return found


def told(run: Run, motion: str, more: str, minutes: float, kept: Path) -> tuple[str, dict, np.ndarray]:
    """The motion, the row of a network on it, and its animation."""
    scene, vertices = run.assembly.scene, run.animate(motion)
    row = {"method": scene.network.method + more, "seed": scene.training.seed}
    return motion, row | judged(run, motion, vertices, still(run, motion), kept) | {"minutes": minutes}, vertices


def references_of(scene: Scene, motion: str, kept: Path) -> Found:
    """The same of the simulations of a motion."""
    references([scene], [motion], kept)
    made = [apart(simulated, scene, [motion], kept, twin) for twin in SIMULATIONS]
    return [(motion, row, animations[0]) for row, animations in made]


def experiment(
    scene: Scene,
    unseen: Sequence[str],
    out: Path,
    kept: Path,
    *,
    methods: Sequence[str] = ("ncs", "pbns"),
    seeds: int = 2,
    length: tuple[int, float | None] = (0, 10.0),
    seconds: float | None = None,
) -> list[dict]:
    """Measure all, write the table as it grows and a strip for each motion, of the first seed, into `out`; return the rows."""
    scene = without(scene, unseen)
    shown: dict[str, dict[str, np.ndarray]] = {motion: {} for motion in unseen}
    rows: dict[str, list[dict]] = {motion: [] for motion in unseen}

    def add(found: Found) -> None:
        for motion, row, vertices in found:
            rows[motion].append({"motion": stem(motion), **row})
            shown[motion].setdefault(row["method"], vertices)
        write(out, "unseen", list(chain(*rows.values())), SHOWN)

    for motion in unseen:
        add(references_of(scene, motion, kept))
    for seed in range(scene.training.seed, scene.training.seed + seeds):
        for method in methods:
            one = changed(scene, network={"method": method}, training={"seed": seed})
            add(apart(learned, one, unseen, length, seconds, kept))
            print(f"{method}, seed {seed}: trained and measured", file=sys.stderr, flush=True)
    still_scene = Run(assemble(scene.without_network()), {})
    for motion, animations in shown.items():
        animations.pop(SIMULATIONS["coarse"])  # nobody sees a difference
        draw(out / f"unseen_{stem(motion)}.png", still_scene, motion, animations)
    return list(chain(*rows.values()))


def main(given: Sequence[str] | None = None) -> int:
    """Run it from the command line, and show its table."""
    parser = argparse.ArgumentParser(prog="unseen", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="ncs:skirt", help="scene file, or ncs:NAME (default: ncs:skirt)")
    parser.add_argument("--unseen", nargs="+", default=UNSEEN, metavar="MOTION", help="what none is trained on")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=("ncs", "pbns"), help="default: ncs pbns")
    parser.add_argument("--seeds", type=arguments.whole, default=2, help="of every network (default: 2)")
    parser.add_argument("--minutes", type=arguments.positive, default=10.0, help="of training each (default: 10)")
    parser.add_argument("--adapt", type=arguments.positive, metavar="SECONDS", help="to each motion (default: not)")
    parser.add_argument("--quick", action="store_true", help="to try it out, smallest: the numbers mean nothing")
    parser.add_argument("--out", type=Path, default=Path("runs/unseen"), help="folder of the table (default: runs/unseen)")
    parser.add_argument("--kept", type=Path, default=KEPT, help=f"folder of simulations and trained networks (default: {KEPT})")
    o = parser.parse_args(given)
    keep_programs(o.kept)
    try:
        scene, length = load_scene(o.scene), (0, o.minutes)
        if o.quick:
            scene, length, o.seeds, o.unseen = quickened(scene), (QUICK_STEPS, None), 1, o.unseen[:1]
        unseen = standing(scene, o.unseen, o.kept)
        experiment(scene, unseen, o.out, o.kept, methods=o.methods, seeds=o.seeds, length=length, seconds=o.adapt)
    except InputError as error:
        print(f"unseen: {error}", file=sys.stderr)
        return 2
    print((o.out / "unseen.md").read_text(), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())

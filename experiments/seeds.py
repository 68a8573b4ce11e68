"""Does training depend on luck? Train one scene from several seeds and tabulate what each comes to.

    python -m experiments.seeds SCENE --steps 300 --seeds 5 --out runs/seeds

Writes seeds.csv (one row a seed: mean total energy over all frames of the training motions and its terms in J, strain and
penetration in %, dropped steps) and seeds.png (the energy of every seed while it trains).
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ncs_jax import InputError, Report, Run, load_scene, summarise, train
from ncs_jax.scene.spec import Scene

COLUMNS = ("total", "membrane", "bending", "collision", "gravity", "inertia", "strain_mean", "penetrating", "out_of_balance")


def measure(run: Run, *, exact: bool = True) -> dict[str, float]:
    """Mean of every quantity over all frames of the scene's training motions; `exact` as in `Run.evaluate`."""
    rows = [run.evaluate(name, exact=exact) for name in run.assembly.scene.motion.files]
    return summarise({name: np.concatenate([r[name] for r in rows]) for name in rows[0]})


def experiment(scene: Scene | str | Path, out: str | Path, *, steps: int = 300, seeds: Sequence[int] = range(5)) -> list[dict]:
    """Train and measure a scene once a seed; write the table and the picture into `out`; return the table's rows."""
    scene = load_scene(scene) if isinstance(scene, str | Path) else scene
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    rows, curves = [], {}
    for seed in seeds:
        reports: list[Report] = []
        run = train(scene, steps=steps, seed=seed, report=reports.append)
        means = measure(run)
        row = {"seed": seed, "steps": steps, **{n: means[n] for n in COLUMNS if n in means}, "dropped": reports[-1].dropped}
        rows.append(row)
        curves[seed] = [(r.step, sum(r.energies.values())) for r in reports]
        print("  ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True)
        with (out / "seeds.csv").open("w", newline="") as file:
            table = csv.DictWriter(file, rows[0])
            table.writeheader()
            table.writerows(rows)
    draw(out / "seeds.png", curves, {row["seed"]: row["total"] for row in rows})
    return rows


def draw(path: Path, curves: dict[int, list[tuple[int, float]]], means: dict[int, float]) -> None:
    """Energy of every seed while it trains, and after it over all frames."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for seed, curve in curves.items():
        steps, energy = np.array(curve).T
        (line,) = axes.plot(steps, energy, linewidth=1, alpha=0.7, label=f"seed {seed}: {means[seed]:.4f} J over all frames")
        axes.plot(steps[-1], means[seed], "o", color=line.get_color())
    axes.set(xlabel="step", ylabel="total energy of the batch, J")
    low, high = min(means.values()), max(e for curve in curves.values() for _, e in curve[len(curve) // 3 :])
    axes.set_ylim(low - 0.1 * (high - low), high + 0.2 * (high - low))
    axes.legend(fontsize=8, frameon=False)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="scene file, or ncs:NAME")
    parser.add_argument("--steps", type=int, default=300, help="optimiser steps of each (default: 300)")
    parser.add_argument("--seeds", type=int, default=5, help="how many (default: 5)")
    parser.add_argument("--out", default="runs/seeds", help="folder for the table and the picture")
    options = parser.parse_args(arguments)
    try:
        rows = experiment(options.scene, options.out, steps=options.steps, seeds=range(options.seeds))
    except InputError as error:
        print(f"seeds: {error}", file=sys.stderr)
        return 2
    totals = [row["total"] for row in rows]
    print(f"total energy over all frames: {min(totals):.4f} to {max(totals):.4f} J, dropped {sum(r['dropped'] for r in rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Whether a run knows its limits: what it expects of each clip beside what adapting to that clip gains.

    python -m experiments.limits RUN MOTION [MOTION ...] [--adapt 20] [--out runs/limits]

A motion is beyond what was trained where the network's energy is more than a tenth above what adapting to it reaches, by the
same measure of both; the run tells it beforehand, by how strained the cloth is (`ncs_jax.metrics.coverage`). It is told rightly
where both say the same. Writes limits.csv, limits.md, and a picture of the one over the other.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.study import apart, axes_of, stem, write
from ncs_jax import InputError, Run, adapt, load_run
from ncs_jax.cli import arguments
from ncs_jax.errors import required
from ncs_jax.metrics.coverage import TOLD

COLUMNS = {
    "motion": "motion",
    "frames": "frames",
    "outside": "frames beyond, %",
    "worst": "most, by",
    "expected": "expected above adapted, %",
    "excess": "is above adapted, %",
    "before": "network, J",
    "after": "adapted, J",
    "inside_before": "vertices inside, %",
    "inside_after": "adapted, %",
    "told": "told",
    "right": "rightly",
}


def looked_at(folder: Path, motion: str, seconds: float) -> dict:
    """The row of a motion: it is adapted to for so many seconds."""
    run: Run = load_run(folder)
    known = required(run.coverage(motion), "run.coverage")
    adapted = adapt(run, motion, seconds)
    excess = adapted.before["total"] / adapted.after["total"] - 1
    frame, joint, what = known.worst
    return {
        "motion": stem(motion),
        "frames": len(known.distance),
        "outside": 100 * known.share,
        "worst": f"{what} of {joint}, {frame}",
        "expected": 100 * known.excess,
        "excess": 100 * excess,
        "before": adapted.before["total"],
        "after": adapted.after["total"],
        "inside_before": adapted.before.get("penetrating", 0.0),
        "inside_after": adapted.after.get("penetrating", 0.0),
        "told": "beyond" if known.told else "",
        "right": "yes" if known.told == (excess > TOLD) else "no",
    }


def experiment(folder: Path, motions: Sequence[str], seconds: float, out: Path) -> list[dict]:
    """Measure all, and write the table as it grows and the picture into `out`; return the rows."""
    rows: list[dict] = []
    for motion in motions:
        rows.append(apart(looked_at, folder, motion, seconds))
        write(out, "limits", rows, COLUMNS)
        print(f"{rows[-1]['motion']}: {len(rows)} of {len(motions)}", file=sys.stderr, flush=True)
    with axes_of(out / "limits.png", 1, (5.0, 4.0)) as (axes,):
        for told, color in (("", "C0"), ("beyond", "C1")):
            some = [row for row in rows if row["told"] == told]
            label = "told to be beyond" if told else "not told"
            axes.scatter([r["expected"] for r in some], [max(r["excess"], 0.1) for r in some], color=color, label=label, s=18)
        axes.axhline(100 * TOLD, color="0.5", lw=1)
        axes.axvline(100 * TOLD, color="0.5", lw=1)
        axes.set(xscale="log", yscale="log", xlabel=COLUMNS["expected"], ylabel=COLUMNS["excess"])
        axes.legend(frameon=False, fontsize=8)
    return rows


def main(given: Sequence[str] | None = None) -> int:
    """Run it from the command line, and show its table."""
    parser = argparse.ArgumentParser(prog="limits", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("motions", nargs="+", metavar="MOTION", help="that it was not trained on, or was")
    parser.add_argument(
        "--adapt", type=arguments.positive, default=20.0, metavar="SECONDS", help="to each motion (default: 20)"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/limits"), help="folder of the table (default: runs/limits)")
    o = parser.parse_args(given)
    try:
        rows = experiment(o.run, o.motions, o.adapt, o.out)
    except InputError as error:
        print(f"limits: {error}", file=sys.stderr)
        return 2
    print((o.out / "limits.md").read_text(), end="")
    print(f"told rightly: {sum(row['right'] == 'yes' for row in rows)} of {len(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The study: every experiment, and the page that has all their tables and pictures.

    python -m experiments [--steps 600] [--quick] [--page] [--out experiments] [--kept runs/study]

Writes OUT/README.md and its tables and pictures in OUT/results. What has been simulated and trained is kept in `--kept`, where
a study that was interrupted goes on; a fresh one starts from an empty folder. `--page` writes the page anew from the tables
that are there. Tables of another run in OUT/results/repeated are held beside them.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments import architecture, augmentation, budget, control, descriptors, falling, membranes, methods, spread
from experiments.study import BALANCE, COARSE, KEPT, STAND, UNSEEN, keep_programs, standing, stem
from ncs_jax import InputError, load_scene

STEPS = 600
LONG = 5  # times as many steps for the methods side by side, and for motion control
FALLS = 10_000


class Section(NamedTuple):
    """A part of the page: an experiment's module, its garment, how many times the steps, and its pictures but for one."""

    title: str
    module: Any
    scene: str = "ncs:tshirt"
    times: int = 1
    pictures: tuple[str, ...] = ()


STRIPS = tuple(map(stem, UNSEEN))
SECTIONS = {
    "methods": Section(
        "Four methods side by side: T-shirt", methods, times=LONG, pictures=tuple(f"methods_{name}" for name in STRIPS)
    ),
    "skirt": Section("Four methods side by side: skirt", methods, "ncs:skirt", LONG, tuple(f"skirt_{name}" for name in STRIPS)),
    "falling": Section("Free fall and a pendulum", falling),
    "control": Section("Motion control", control, times=LONG),
    "spread": Section("Spread", spread),
    "descriptors": Section("Descriptors", descriptors),
    "architecture": Section("Architecture", architecture),
    "augmentation": Section("Augmentation", augmentation),
    "budget": Section("Training data and budget", budget),
    "membranes": Section("Membranes", membranes),
}
# What is chosen: the table, its column, what that begins or ends with, and the table's columns of energy and distance.
CHOICES = {
    "network": ("architecture", "network", "", "total", "distance"),
    "descriptor": ("descriptors", "descriptor", "", "unseen_total", "unseen_distance"),
    "augmentation": ("augmentation", "augmentation", "", "total", "distance"),
    "window (gated unit)": ("budget", "change", "window of", "total", "distance"),
    "batch": ("budget", "change", "batch of", "total", "distance"),
    "number of motions": ("budget", "change", "motions", "total", "distance"),
}


def number(text: str) -> float | str:
    """As it was before it was written."""
    try:
        return float(text)
    except ValueError:
        return text


def rows_of(results: Path, name: str) -> list[dict]:
    """An experiment's rows, as it wrote them."""
    with (results / f"{name}.csv").open(newline="") as file:
        return [{key: number(value) for key, value in row.items() if value} for row in csv.DictReader(file)]


def written(results: Path, name: str) -> str:
    """An experiment's part of the page."""
    title, module, _, _, pictures = SECTIONS[name]
    shown = "\n\n".join(f"![{title}](results/{picture}.png)" for picture in pictures or (name,))
    told, table = module.__doc__.split("\n\n")[0], (results / f"{name}.md").read_text()
    text = module.conclusion(rows_of(results, name))
    return f"## {title}\n\n{told} (`python -m {module.__name__}`)\n\n{text}\n\n{table}\n{shown}\n"


def ranked(results: Path) -> Iterator[tuple[float, str]]:
    """Of everything that can be chosen: how far the distances of the choices are apart, mm, and a line that says so."""
    for what, (name, column, sign, energy, distance) in CHOICES.items():
        rows = [row for row in rows_of(results, name) if sign in str(row[column])]
        best, worst = (choose(rows, key=lambda row: row[distance]) for choose in (min, max))
        apart = worst[distance] - best[distance]
        moving = [row["stopped_share"] for row in rows if "stopped_share" in row]
        cells = [
            what, best[column], worst[column], f"{best[distance]:.1f}", f"{worst[distance]:.1f}", f"{apart:.1f}",
            f"{100 * (worst[energy] / best[energy] - 1):+.2f}", f"{min(moving):.2f} to {max(moving):.2f}" if moving else "",
        ]  # fmt: skip
        yield apart, f"| {' | '.join(map(str, cells))} |"


def mattered(results: Path) -> str:
    """Which choices mattered."""
    first, *_, luck = rows_of(results, "spread")
    mm, stopped = f"{luck['distance']:.1f} mm", f"{luck['stopped_share']:.2f}"
    floor = first.get("sensitivity")
    mm += "" if floor is None else f", and two simulations are {floor:.1f} mm apart"
    found = sorted(ranked(results), reverse=True)
    lines = "\n".join(line for _, line in found)
    more = sum(apart > luck["distance"] for apart, _ in found)
    return f"""## What mattered

For each thing that can be chosen: how far the best and the worst choice are from the simulation. From seed to seed the distance
differs by {mm}; {more} of {len(found)} choices make a larger difference. What moves after a stop, as a share of what the
simulation moves there, differs by {stopped} from seed to seed.

| what is chosen | best | worst | best, mm | worst, mm | difference, mm | energy of the worst, % | moves after a stop |
|---|---|---|---|---|---|---|---|
{lines}
"""


# A quantity of the tables, and how a difference of it is told.
REPEATED = {
    "total": ("energy, %", "{:.2f}"),
    "dynamic_share": ("dynamic share", "{:.3f}"),
    "hem_correlation": ("hem correlation", "{:.3f}"),
    "distance": ("mm to simulation", "{:.2f}"),
    "stopped_share": ("after a stop", "{:.2f}"),
    "settling": ("settling, s", "{:.2f}"),
}


def repeated(results: Path) -> str:
    """How far the same study came out elsewhere, whose tables lie in the folder `repeated`; empty where there is none."""
    other = results / "repeated"
    if not other.is_dir():
        return ""
    lines = []
    for name, section in SECTIONS.items():
        if section.module is falling:
            continue
        ours, theirs = ({next(iter(row.values())): row for row in rows_of(folder, name)} for folder in (results, other))
        pairs = [(a, theirs[key]) for key, a in ours.items() if key in theirs and key != spread.RANGE]
        cells = [section.title]
        for key, (_, told) in REPEATED.items():
            both = [(a[k], b[k]) for a, b in pairs for k in (key, f"unseen_{key}") if k in a and k in b]
            apart = [abs(a - b) * (100 / abs(a) if key == "total" else 1) for a, b in both]
            cells.append(told.format(max(apart)) if apart else "")
        lines.append(f"| {' | '.join(cells)} |")
    table = "\n".join(lines)
    here, there = (
        next(
            row["distance"] for row in rows_of(folder, "falling") if (row["case"], row["inertia"]) == ("pendulum", "constants")
        )
        for folder in (results, other)
    )
    return f"""## Repeated with other instructions of the processor

One machine gives every number again to the last digit, but for the times. A machine with other instructions rounds
differently, and then a training or a simulation takes another path. The table shows, for each section, the row that differs
most. The simulation's own settling differs too, and with it whatever is compared with it. The pendulum is {here:.0f} mm from
its simulation here, and {there:.0f} mm there.

| {" | ".join(["section", *(label for label, _ in REPEATED.values())])} |
{"|---" * (1 + len(REPEATED))}|
{table}
"""


def page(results: Path) -> str:
    """The whole page, from the tables."""
    (facts,) = rows_of(results, "study")
    steps = round(facts["steps"])
    head = f"""# The study

Every claim of the method as an experiment on the packaged garments. `make study` makes all tables and pictures here, in
{facts["minutes"]:.0f} minutes.

- Every network is trained from one seed: for {LONG * steps:,} steps where methods stand side by side and for motion control,
  for {steps:,} elsewhere.
- It is trained on the scene's motions without {" and ".join(f"`{name}`" for name in UNSEEN)}. It is measured on these two.
- It is compared with simulations with smooth contact, in which each frame is in balance to {BALANCE:g} g.
- *Two simulations* is how far that simulation is from one in balance to {COARSE:g} g: a network cannot be told to be nearer.
- *Static part* is how far the network with alpha = 0 is from a simulation without inertia, the equilibrium of every pose.
  *Dynamic correlation* compares what alpha = 1 adds with what inertia adds to the simulation. Times the *dynamic factor* it
  comes nearest to that.
- A motion that ends standing is held for {STAND:g} s more.
- The section Spread says how much such numbers differ from seed to seed.
- Minutes are by the clock. Other work on the machine adds to them, such as a second network that is trained at the same time.
  Milliseconds of a frame are those of one network alone.
- Not a part of it is `python -m experiments.garments`: any folder of garments for a body, in the columns of HOOD.
"""
    parts = [head, mattered(results), *(written(results, name) for name in SECTIONS), repeated(results)]
    return "\n".join(filter(None, parts))


def study(steps: int, falls: int, results: Path, kept: Path) -> None:
    """Run every experiment; the time of a study that was interrupted counts too."""
    clock = kept / "minutes.txt"
    spent, began = float(clock.read_text()) if clock.exists() else 0.0, time.monotonic()
    for name, (title, module, scene, times, _) in SECTIONS.items():
        if module is falling:
            rows = falling.experiment(results, falls)
        else:
            loaded = load_scene(scene)
            more = (name,) if module is methods else ()
            rows = module.experiment(loaded, standing(loaded, UNSEEN, kept), times * steps, results, kept, *more)
        minutes = spent + (time.monotonic() - began) / 60
        clock.write_text(f"{minutes}")
        print(f"{minutes:5.1f} min  {title}: {module.conclusion(rows)}", flush=True)
    with (results / "study.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["steps", "minutes"], [steps, minutes]])
    clock.unlink()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=STEPS, help=f"of training (default: {STEPS})")
    parser.add_argument("--quick", action="store_true", help="20 steps, to try it out: the numbers mean nothing")
    parser.add_argument("--page", action="store_true", help="measure nothing: the page from the tables in OUT/results")
    parser.add_argument(
        "--out", type=Path, default="experiments", help="folder for README.md and results/ (default: experiments)"
    )
    parser.add_argument("--kept", type=Path, default=KEPT, help=f"folder of simulations and trained networks (default: {KEPT})")
    o = parser.parse_args(arguments)
    keep_programs(o.kept)
    results = o.out / "results"
    try:
        if not o.page:
            study(20 if o.quick else o.steps, 100 if o.quick else FALLS, results, o.kept)
        (o.out / "README.md").write_text(page(results))
    except InputError as error:
        print(f"study: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

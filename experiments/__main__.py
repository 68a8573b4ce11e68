"""The study: every experiment, and the page that has all their tables and pictures.

    python -m experiments [--steps 700] [--quick] [--out experiments] [--kept runs/study]

Writes OUT/README.md and its tables and pictures in OUT/results. What has been simulated and trained is kept in `--kept`, where
a study that was interrupted goes on; a fresh one starts from an empty folder.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments import architecture, augmentation, budget, control, descriptors, falling, membranes, methods, spread
from experiments.study import BALANCE, KEPT, STAND, UNSEEN, keep_programs, standing, stem
from ncs_jax import InputError, load_scene

SCENE, SKIRT = "ncs:tshirt", "ncs:skirt"
LONG = 5  # times as many steps for the methods side by side, and for motion control


def section(title: str, module: Any, rows: Sequence[dict], out: Path, name: str, pictures: Sequence[str]) -> str:
    """An experiment's part of the page."""
    shown = "\n\n".join(f"![{title}](results/{picture}.png)" for picture in pictures)
    told = module.__doc__.split("\n\n")[0]
    table = (out / f"{name}.md").read_text()
    return f"## {title}\n\n{told} (`python -m {module.__name__}`)\n\n{module.conclusion(rows)}\n\n{table}\n{shown}\n"


def study(steps: int, falls: int, out: Path, kept: Path) -> str:
    """Run every experiment and return the page."""
    results, began = out / "results", time.monotonic()
    scene, skirt = load_scene(SCENE), load_scene(SKIRT)
    parts = []

    def add(title, module, rows, name, pictures):
        parts.append(section(title, module, rows, results, name, pictures))
        print(f"{(time.monotonic() - began) / 60:5.1f} min  {title}: {module.conclusion(rows)}", flush=True)

    unseen = standing(scene, UNSEEN, kept)
    strips = [*map(stem, unseen)]
    for name, one in (("methods", scene), ("skirt", skirt)):
        title = f"Four methods side by side: {one.garment.file.removeprefix('ncs:')}"
        rows = methods.experiment(one, unseen, LONG * steps, results, kept, name)
        add(title, methods, rows, name, [f"{name}_{strip}" for strip in strips])
    add("Free fall and a pendulum", falling, falling.experiment(results, falls), "falling", ["falling"])
    for title, module, count in (
        ("Motion control", control, LONG * steps),
        ("Spread", spread, steps),
        ("Descriptors", descriptors, steps),
        ("Architecture", architecture, steps),
        ("Augmentation", augmentation, steps),
        ("Training data and budget", budget, steps),
        ("Membranes", membranes, steps),
    ):
        name = module.__name__.rpartition(".")[2]
        add(title, module, module.experiment(scene, unseen, count, results, kept), name, [name])
    minutes = (time.monotonic() - began) / 60
    head = f"""# The study

Every claim of the method as an experiment on the packaged garments. All tables and pictures here are made by `make study`, in
{minutes:.0f} minutes. Every network is trained from one seed on the scene's motions without
{" and ".join(f"`{name}`" for name in UNSEEN)}, on which all is measured, beside simulations with smooth contact, of
which each frame is in balance to {BALANCE:g} g: for {LONG * steps:,} steps where methods stand side by side and for motion
control, for {steps:,} elsewhere. A motion that ends standing is held for {STAND:g} s more. By how much such numbers differ from
seed to seed says the section Spread.
"""
    return "\n".join([head, *parts])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        prog="experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=700, help="of training (default: 700)")
    parser.add_argument("--quick", action="store_true", help="20 steps, to try it out: the numbers mean nothing")
    parser.add_argument("--out", default="experiments", help="folder for README.md and results/ (default: experiments)")
    parser.add_argument("--kept", type=Path, default=KEPT, help=f"folder of simulations and trained networks (default: {KEPT})")
    o = parser.parse_args(arguments)
    steps, falls = (20, 100) if o.quick else (o.steps, 10_000)
    keep_programs(o.kept)
    try:
        page = study(steps, falls, Path(o.out), o.kept)
    except InputError as error:
        print(f"study: {error}", file=sys.stderr)
        return 2
    (Path(o.out) / "README.md").write_text(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())

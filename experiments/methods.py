"""PBNS, SNUG, NCS and a simulation, side by side: the same garment, energies, decoder and steps of training.

    python -m experiments.methods [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick] [--out runs/methods]

Every network is trained on the scene's motions but the unseen ones, two at a time, and judged on those beside the
simulation: energies, strain, penetration and how it moves (`ncs_jax.metrics.motion.MEASURES`), after a stop on the first
motion that has one. On the first motion the simulation also stands beside a second one of itself, which is less exact, and one
without inertia, the equilibrium of every pose, from which the static part of every method is measured. Writes methods.csv, .md
and .png, a strip of the same frames of all methods for each motion.

NCS with a swing begins at the drape, which the search for its vibrations finds. PBNS, SNUG and NCS with a gated unit begin at
rest, as published.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from experiments.speed_accuracy import streamed
from experiments.study import (
    COARSE,
    COLUMNS,
    abreast,
    apart,
    changed,
    command,
    judged_on,
    recurrent,
    reference,
    references,
    stem,
    still,
    trained,
    without,
    write,
)
from ncs_jax import Run, Scene, assemble
from ncs_jax.metrics.motion import stops

METHODS = ("pbns", "snug", "ncs")
SIMULATIONS = {"dynamic": "simulation", "coarse": f"simulation, to {COARSE:g} g", "static": "simulation without inertia"}
RECURRENT = "ncs, gated"  # beside NCS with the garment's own swing, if that is the scene's


def learned(name: str, scene: Scene, unseen: Sequence[str], steps: int, kept: Path) -> tuple[dict, list[np.ndarray]]:
    """Train the scene's method: its row, so named, and its animations of the unseen motions."""
    run, minutes = trained(scene, steps, kept)
    found = [run.animate(motion) for motion in unseen]
    return {"method": name, **judged_on(run, unseen, found, still(run, unseen[0]), kept), "minutes": minutes}, found


def streaming(scenes: Sequence[Scene], motion: str, steps: int, kept: Path) -> list[float]:
    """What a frame takes each trained network, ms."""
    return [1e3 * streamed(trained(scene, steps, kept)[0], motion) for scene in scenes]


def simulated(scene: Scene, unseen: Sequence[str], kept: Path, twin: str) -> tuple[dict, list[np.ndarray]]:
    """A simulation, judged like the others: that to `BALANCE` on all motions, any other on the first."""
    motions = unseen if twin == "dynamic" else unseen[:1]
    found = [reference(scene, motion, kept, twin) for motion in motions]
    run, static = Run(assemble(scene.without_network()), {}), reference(scene, unseen[0], kept, "static")
    return {"method": SIMULATIONS[twin], **judged_on(run, motions, found, static, kept)}, found


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path, name: str = "methods") -> list[dict]:
    """Measure all four, write the table and the strips into `out`, and return the rows."""
    scene = without(scene, unseen)
    scenes = {method: changed(scene, network={"method": method}) for method in METHODS}
    if scene.network.cell == "swing":
        scenes[RECURRENT] = recurrent(scenes["ncs"])
    references([scene], unseen, kept)
    made = [apart(simulated, scene, unseen, kept, twin) for twin in SIMULATIONS]
    made += abreast([(learned, method, one, unseen, steps, kept) for method, one in scenes.items()])
    rows = [row for row, _ in made]
    frames = apart(streaming, list(scenes.values()), unseen[0], steps, kept)  # with both cores to itself
    count = len(SIMULATIONS)
    rows[count:] = [row | {"frame": ms} for row, ms in zip(rows[count:], frames, strict=True)]
    write(out, name, rows, {"method": "", **COLUMNS, "lag": "lag, s", "frame": "ms a frame"})
    run = Run(assemble(scene.without_network()), {})
    for k, motion in enumerate(unseen):
        file = out / f"{name}_{stem(motion)}.png"
        shown = {row["method"]: animations[k] for row, animations in made if len(animations) > k}
        shown.pop(SIMULATIONS["coarse"], None)  # nobody sees a difference
        draw(file, run, motion, shown)
    return rows


def draw(path: Path, run: Run, motion: str, animations: dict[str, np.ndarray]) -> None:
    """The contact sheets of all methods below each other, of a motion up to a second after its last stop."""
    from PIL import Image, ImageDraw

    from ncs_jax.view.animation import Animation
    from ncs_jax.view.character import posed_body
    from ncs_jax.view.pictures import INK, contact_sheet
    from ncs_jax.view.rasteriser import PAPER

    a = run.assembly
    body = posed_body(a, run.motion(motion))
    end = max((first + round(a.model.fps) for first, _ in stops(run.track(motion), a.model)), default=None)
    sheets = []
    with tempfile.TemporaryDirectory() as folder:
        for method, vertices in animations.items():
            file = Path(folder) / "sheet.png"
            contact_sheet(file, Animation(vertices, a.garment.faces, a.model.fps, body).until(end), tile=260)
            with Image.open(file) as drawn:
                sheets.append((method, drawn.convert("RGB")))
    strip = Image.new("RGB", (max(s.width for _, s in sheets), sum(s.height for _, s in sheets)), PAPER)
    top = 0
    for method, sheet in sheets:
        strip.paste(sheet, (0, top))
        ImageDraw.Draw(strip).text((60, top + 8), method.upper() if len(method) < 5 else method, INK)
        top += sheet.height
    strip.save(path, optimize=True)


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    by = {row["method"]: row for row in rows}
    sim, ncs, pbns, snug = (by[name] for name in ("simulation", "ncs", "pbns", "snug"))
    near = 0.7 <= ncs["dynamic_share"] <= 1.3
    moves = "moves as much as the simulation to within 30 %" if near else "does not move as much as the simulation"
    text = f"NCS {moves} ({ncs['dynamic_share']:.2f} of its speed, hem correlation {ncs['hem_correlation']:.2f}, "
    text += f"{ncs['distance']:.1f} mm from it), SNUG {snug['dynamic_share']:.2f}, PBNS {pbns['dynamic_share']:.2f}"
    if "stopped_share" in ncs:
        text += f"; after a stop NCS still moves ({ncs['stopped_share']:.2f}), PBNS stands ({pbns['stopped_share']:.2f})"
        times = [f"{row['settling']:.2f} s" if "settling" in row else "longer than it was looked at" for row in (ncs, sim)]
        text += f", and NCS settles in {times[0]} where the simulation takes {times[1]}"
    if "sensitivity" in ncs:
        static = by[SIMULATIONS["static"]]
        text += (
            f". Two simulations are {ncs['sensitivity']:.1f} mm apart, one without inertia is {static['distance']:.1f} mm off"
        )
        text += f"; from that the static part of NCS is {ncs['static_distance']:.1f} mm, PBNS {pbns['static_distance']:.1f} mm"
        if "dynamic_factor" in ncs:
            text += f"; the dynamic part of NCS correlates with the true one by {ncs['dynamic_correlation']:.2f}"
            text += f" and is nearest to it {ncs['dynamic_factor']:.2f} times as large"
    if RECURRENT in by:
        gated = by[RECURRENT]
        text += f". With a gated unit in place of the swing: {gated['dynamic_share']:.2f}"
        if "stopped_share" in gated:
            text += f", {gated['stopped_share']:.2f} after the stop"
    return text + "."


main = partial(command, "methods", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

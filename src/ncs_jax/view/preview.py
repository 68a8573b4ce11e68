"""What a run looks like: pictures, curves, and one page that plays it."""

from __future__ import annotations

import csv
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import summarise
from ncs_jax.runs.run import Run
from ncs_jax.view import curves, page, pictures
from ncs_jax.view.character import animation_of

__all__ = ["preview"]

ALPHAS = (0.0, 1.0, 1.5)


def preview(run: Run, folder: str | Path, motion: str | None = None, *, title: str = "") -> dict[str, float]:
    """Write preview.png, preview.gif, preview.html and energies.png into a folder; return the motion's evaluation at alpha 1.

    The curves need matplotlib, of the `plots` extra; without it they are left out.

    Args:
        run: trained. folder: where to. motion: a motion's name or file; else the scene's first validation or training motion.

    Raises:
        InputError: there is no motion to show, it is unusable, a vertex is not finite, or the run's own terms were not given.
    """
    folder = Path(folder)
    scene = run.assembly.scene
    names = (motion,) if motion else (*scene.motion.validation, *scene.motion.files)
    if not names:
        raise InputError("a motion to show is needed", field="motion.files", mend="name one in the scene")
    name = names[0]
    track = run.track(name)
    alphas = ALPHAS if run.assembly.network.controlled else (0.0,)
    vertices = {f"{alpha:g}": run.animate(track, alpha) for alpha in alphas}
    shown = "1" if "1" in vertices else "0"
    animation = animation_of(run.assembly, run.motion(name), vertices[shown])
    quantities = summarise(run.evaluate(track))
    facts = {
        "motion": name,
        "trained": f"{run.steps} steps on {', '.join(scene.motion.files)}",
        "mean strain": f"{quantities['strain_mean']:.2f} %",
    }
    if "penetrating" in quantities:
        facts["penetrating vertices"] = f"{quantities['penetrating']:.2f} %"
    pictures.contact_sheet(folder / "preview.png", animation)
    pictures.animation_gif(folder / "preview.gif", animation)
    by_alpha = {alpha: replace(animation, garment=x) for alpha, x in vertices.items()}
    page.write_page(folder / "preview.html", by_alpha, title=title or "Neural cloth simulation", facts=facts)
    log = folder / "log.csv"
    if log.exists() and find_spec("matplotlib"):
        with log.open(newline="") as file:
            curves.energy_curves(folder / "energies.png", list(csv.DictReader(file)))
    return quantities

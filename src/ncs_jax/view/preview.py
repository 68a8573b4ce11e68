"""What a run looks like: pictures, one page that plays it, curves. What is looked at first is drawn first."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import summarise
from ncs_jax.runs.run import Run
from ncs_jax.view import curves, page, pictures
from ncs_jax.view.character import animation_of

__all__ = ["PreviewStep", "preview"]

ALPHAS = (0.0, 1.0, 1.5)


@dataclass(frozen=True)
class PreviewStep:
    """What a preview says as it goes on: a file that is now there, if any, what comes next, and the share that is done."""

    file: Path | None
    next: str
    share: float


def preview(
    run: Run,
    folder: str | Path,
    motion: str | None = None,
    *,
    title: str = "",
    log: str | Path | None = None,
    report: Callable[[PreviewStep], None] | None = None,
) -> dict[str, float]:
    """Write preview.png, preview.html, preview.gif and energies.png into a folder; return the motion's evaluation at alpha 1.

    The picture and the page come first. The evaluation is the last, and the page is then written again with it. The curves need
    a log and matplotlib, of the `plots` extra.

    Args:
        run: trained.
        folder: where to; it is made if need be.
        motion: a motion's name or file; else the scene's first validation or training motion.
        title: of the page.
        log: the run's log.csv; else that of the folder, if it has one.
        report: called after every file, and as the GIF goes on.

    Raises:
        InputError: there is no motion to show, it is unusable, a vertex is not finite, or the run's own terms were not given.
    """
    run.check_terms()
    folder, scene = Path(folder), run.assembly.scene
    names = (motion,) if motion else (*scene.motion.validation, *scene.motion.files)
    if not names:
        raise InputError("a motion to show is needed", field="motion.files", mend="name one in the scene")
    folder.mkdir(parents=True, exist_ok=True)
    tell, title = report or (lambda step: None), title or "Neural cloth simulation"
    tell(PreviewStep(None, "drawing the picture", 0.0))
    track, controlled = run.track(names[0]), run.assembly.network.controlled
    shown = 1.0 if controlled else 0.0
    animation = animation_of(run.assembly, run.motion(names[0]), run.animate(track, shown))
    pictures.contact_sheet(sheet := folder / "preview.png", animation)

    tell(PreviewStep(sheet, "writing the page", 0.2))
    by_alpha = {
        f"{alpha:g}": animation if alpha == shown else replace(animation, garment=run.animate(track, alpha))
        for alpha in (ALPHAS if controlled else (0.0,))
    }
    facts = {"motion": names[0], "trained": f"{run.steps} steps on {', '.join(scene.motion.files)}"}
    page.write_page(played := folder / "preview.html", by_alpha, title=title, facts=facts)

    tell(PreviewStep(played, "drawing the GIF", 0.3))
    gif = folder / "preview.gif"
    pictures.animation_gif(gif, animation, report=lambda share: tell(PreviewStep(None, "drawing the GIF", 0.3 + 0.3 * share)))

    tell(PreviewStep(gif, "measuring strain and penetration exactly", 0.6))
    if (drawn := _draw_curves(folder, Path(log or folder / "log.csv"))) is not None:
        tell(PreviewStep(drawn, "measuring strain and penetration exactly", 0.6))
    quantities = summarise(run.evaluate(track))
    facts["mean strain"] = f"{quantities['strain_mean']:.2f} %"
    if "penetrating" in quantities:
        facts["penetrating vertices"] = f"{quantities['penetrating']:.2f} %"
    page.write_page(played, by_alpha, title=title, facts=facts)
    tell(PreviewStep(None, "done", 1.0))
    return quantities


def _draw_curves(folder: Path, log: Path) -> Path | None:
    """Draw the energies over training, and return the file; None without a log or matplotlib."""
    if not log.exists() or not find_spec("matplotlib"):
        return None
    with log.open(newline="") as file:
        curves.energy_curves(drawn := folder / "energies.png", list(csv.DictReader(file)))
    return drawn

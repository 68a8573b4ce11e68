"""What a run looks like: pictures, one page that plays it, curves. What is looked at first is drawn first."""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import measure_on_host, summarise
from ncs_jax.metrics.seen import LOOKED_AT, shown_skin
from ncs_jax.runs.run import Run
from ncs_jax.view import curves, page, pictures, video
from ncs_jax.view.animation import Animation
from ncs_jax.view.character import animation_of

__all__ = ["PreviewStep", "preview"]

ALPHAS = (0.0, 1.0, 1.5)
TILE = 400  # pixels; height of a moment in the picture
MOMENTS = 8  # in the picture of the alphas
FPS, FRAMES, SIZE = 10.0, 80, (300, 375)  # of the GIF
NAMED = 8  # motions that a run trained on which the page names


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
    mp4: bool = False,
    report: Callable[[PreviewStep], None] | None = None,
) -> dict[str, float]:
    """Write preview.png, .html, .gif, alphas.png and energies.png into a folder; return how the motion comes out at alpha 1.

    Cloth is put outside of the body, as by `ncs animate`. Alphas are in rows, where they differ most. The picture and the page
    come first, the measures last, and the page is then written again with them. Strain and penetration are exact, of every
    n-th frame, at most `seen.LOOKED_AT`: `ncs evaluate` measures all, and the energies. Keys: strain_mean (%), with a body what
    `metrics.quality` says of penetration; every, n; and what `metrics.seen.SkinShown` has, as skin_looked and so on. Curves
    need a log and matplotlib.

    Args:
        run: trained.
        folder: where to; it is made if need be.
        motion: a motion's name or file; else the scene's first validation or training motion.
        title: of the page.
        log: the run's log.csv; else that of the folder, if it has one.
        mp4: a video of every frame, preview.mp4, in place of the GIF; it takes the package av.
        report: called after every file, and as the GIF goes on.

    Raises:
        InputError: there is no motion to show, it is unusable, or a vertex is not finite.
    """
    folder, scene = Path(folder), run.assembly.scene
    names = (motion,) if motion else (*scene.motion.validation, *scene.motion.files)
    if not names:
        raise InputError("a motion to show is needed", field="motion.files", mend="name one in the scene")
    folder.mkdir(parents=True, exist_ok=True)
    tell, title = report or (lambda step: None), title or "Neural cloth simulation"
    tell(PreviewStep(None, "drawing the picture", 0.0))
    track, controlled = run.track(names[0]), run.assembly.network.controlled
    animated = functools.partial(run.animate, track, outside=True)
    animation = animation_of(run.assembly, run.motion(names[0]), animated(float(controlled)))
    pictures.contact_sheet(sheet := folder / "preview.png", animation, tile=TILE)

    tell(PreviewStep(sheet, "writing the page", 0.2))
    others = {alpha: replace(animation, garment=animated(alpha)) for alpha in ALPHAS if controlled and alpha != 1}
    by_alpha = {f"{alpha:g}": others.get(alpha, animation) for alpha in (ALPHAS if controlled else (0.0,))}
    write = functools.partial(page.write_encoded, played := folder / "preview.html", page.encode(by_alpha), title=title)
    write(facts=(facts := _facts_of_the_run(run, names[0], by_alpha)))
    tell(PreviewStep(played, "drawing the alphas", 0.3))
    moving = "drawing the video" if mp4 else "drawing the GIF"
    tell(PreviewStep(_draw_alphas(folder, by_alpha) if controlled else None, moving, 0.35))
    drawing = lambda share: tell(PreviewStep(None, moving, 0.35 + 0.45 * share))  # noqa: E731
    moved = _draw_moving(folder / ("preview.mp4" if mp4 else "preview.gif"), animation, drawing)

    tell(PreviewStep(moved, "measuring strain and penetration", 0.8))
    if (drawn := _draw_curves(folder, Path(log or folder / "log.csv"))) is not None:
        tell(PreviewStep(drawn, "measuring strain and penetration", 0.8))
    quantities = _measured(run, animation)
    write(facts=facts | _facts_of(quantities))
    tell(PreviewStep(None, "done", 1.0))
    return quantities


def _draw_moving(file: Path, animation: Animation, report: Callable[[float], None]) -> Path:
    """Draw a video of every frame, or a GIF of some, as the file's name ends, and return the file."""
    if file.suffix == ".mp4":
        video.animation_mp4(file, animation, report=report)
    else:
        few = animation.every(max(1, round(animation.fps / FPS)))
        pictures.animation_gif(file, few, max_frames=FRAMES, size=SIZE, report=report)
    return file


def _some(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def _facts_of_the_run(run: Run, motion: str, by_alpha: dict[str, Animation]) -> dict[str, str]:
    """Return what the page says of the run, the motion, and what alpha does to it."""
    far = {"alpha 0 and 1.5": f"up to {1000 * _apart(by_alpha).max():.0f} mm apart, the mean of the garment"}
    trained = f"{run.steps} steps on {_some(run.assembly.scene.motion.files)}"
    return {"motion": motion, **(far if len(by_alpha) > 1 else {}), "trained": trained}


def _draw_alphas(folder: Path, by_alpha: dict[str, Animation]) -> Path:
    """Draw a motion at every alpha, each in a row, and return the file."""
    rows = {f"alpha {name}": each for name, each in by_alpha.items()}
    pictures.contact_sheet(drawn := folder / "alphas.png", rows, frames=_moments(_apart(by_alpha)), tile=TILE)
    return drawn


def _apart(by_alpha: dict[str, Animation]) -> np.ndarray:
    """Return how far the garment at the least alpha is from that at the largest, the mean over its vertices (frames,), m."""
    each = list(by_alpha.values())
    low, high = each[0], each[-1]
    return np.linalg.norm(np.asarray(high.garment, np.float32) - low.garment, axis=2).mean(axis=1)


def _moments(apart: np.ndarray) -> list[int]:
    """Return the frames to show: of `MOMENTS` stretches of a motion, each the one in which the alphas are farthest apart."""
    stretches = np.array_split(np.arange(len(apart)), min(MOMENTS, len(apart)))
    return [int(some[apart[some].argmax()]) for some in stretches]


def _facts_of(quantities: dict[str, float]) -> dict[str, str]:
    """Return what the page says of strain and penetration."""
    every = f" (one frame in {quantities['every']:.0f})" if quantities["every"] > 1 else ""
    names = {"strain_mean": "mean strain", "penetrating": "penetrating vertices"}
    return {names[key]: f"{quantities[key]:.2f} %{every}" for key in names if key in quantities}


def _measured(run: Run, animation: Animation) -> dict[str, float]:
    """Return mean strain and penetration of every n-th frame, and where skin shows."""
    every, skin = -(-len(animation.garment) // LOOKED_AT), None
    if animation.body is not None:
        part, whole = run.assembly.prepared.part, animation.body.vertices
        count = whole.shape[1] - animation.body.worn
        skin = np.concatenate([whole[::every, part], whole[::every, count:]], axis=1)
    model, cloth = run.assembly.model, animation.garment[::every]
    found = summarise(measure_on_host(model, cloth, skin)) | {"every": float(every)}
    if skin is None:
        return found
    shown = shown_skin(model, cloth, skin, every * np.arange(len(cloth)))
    return found | {f"skin_{name}": float(value) for name, value in asdict(shown).items()}


def _draw_curves(folder: Path, log: Path) -> Path | None:
    """Draw the energies over training, and return the file; None without a log or matplotlib."""
    if not log.exists() or not find_spec("matplotlib"):
        return None
    with log.open(newline="") as file:
        curves.energy_curves(drawn := folder / "energies.png", list(csv.DictReader(file)))
    return drawn

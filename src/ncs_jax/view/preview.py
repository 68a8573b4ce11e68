"""What a run looks like: pictures, one page that plays it, curves. What is looked at first is drawn first."""

from __future__ import annotations

import csv
import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.geometry.surface_distance import border_of, signed_distance
from ncs_jax.metrics.quality import DEEPEST, winding_number
from ncs_jax.runs.run import Run
from ncs_jax.view import curves, page, pictures
from ncs_jax.view.animation import Animation
from ncs_jax.view.character import animation_of

__all__ = ["PreviewStep", "preview"]

ALPHAS = (0.0, 1.0, 1.5)
TILE = 400  # pixels; height of a moment in the picture
FPS, FRAMES, SIZE = 10.0, 80, (300, 375)  # of the GIF
MEASURED = 24  # frames, at most, of which strain and penetration are measured
CLEAR = 0.02  # m; cloth that is farther outside the nearest vertex's tangent plane is not inside the body


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
    """Write preview.png, preview.html, preview.gif and energies.png into a folder; return how the motion comes out at alpha 1.

    The picture and the page come first, the measures last, and the page is then written again with them. Strain and penetration
    are exact, of every n-th frame, so that there are no more than `MEASURED`: `ncs evaluate` measures all, and the energies.
    Keys: strain_mean (%), and with a body penetrating (%) and depth_max (mm), as in `metrics.quality.QUANTITIES`; every, which
    is n. The curves need a log and matplotlib, of the `plots` extra.

    Args:
        run: trained.
        folder: where to; it is made if need be.
        motion: a motion's name or file; else the scene's first validation or training motion.
        title: of the page.
        log: the run's log.csv; else that of the folder, if it has one.
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
    shown = 1.0 if controlled else 0.0
    animation = animation_of(run.assembly, run.motion(names[0]), run.animate(track, shown))
    pictures.contact_sheet(sheet := folder / "preview.png", animation, tile=TILE)

    tell(PreviewStep(sheet, "writing the page", 0.2))
    by_alpha = {
        f"{alpha:g}": animation if alpha == shown else replace(animation, garment=run.animate(track, alpha))
        for alpha in (ALPHAS if controlled else (0.0,))
    }
    facts = {"motion": names[0], "trained": f"{run.steps} steps on {', '.join(scene.motion.files)}"}
    write = functools.partial(page.write_encoded, played := folder / "preview.html", page.encode(by_alpha), title=title)
    write(facts=facts)

    tell(PreviewStep(played, "drawing the GIF", 0.3))
    drawing = lambda share: tell(PreviewStep(None, "drawing the GIF", 0.3 + 0.5 * share))  # noqa: E731
    few = animation.every(max(1, round(animation.fps / FPS)))
    pictures.animation_gif(gif := folder / "preview.gif", few, max_frames=FRAMES, size=SIZE, report=drawing)

    tell(PreviewStep(gif, "measuring strain and penetration", 0.8))
    if (drawn := _draw_curves(folder, Path(log or folder / "log.csv"))) is not None:
        tell(PreviewStep(drawn, "measuring strain and penetration", 0.8))
    quantities = _measured(run, animation)
    write(facts=facts | _facts_of(quantities))
    tell(PreviewStep(None, "done", 1.0))
    return quantities


def _facts_of(quantities: dict[str, float]) -> dict[str, str]:
    """Return what the page says of strain and penetration."""
    every = f" (one frame in {quantities['every']:.0f})" if quantities["every"] > 1 else ""
    names = {"strain_mean": "mean strain", "penetrating": "penetrating vertices"}
    return {names[key]: f"{quantities[key]:.2f} %{every}" for key in names if key in quantities}


def _measured(run: Run, animation: Animation) -> dict[str, float]:
    """Return mean strain and penetration of every n-th frame, found on the host: nothing is compiled for them."""
    model, every = run.assembly.model, -(-len(animation.garment) // MEASURED)
    cloths = np.asarray(animation.garment[::every], np.float64)
    mesh = model.garment.mesh
    edges, rest = np.asarray(mesh.edges), np.asarray(mesh.edge_length, np.float64)
    lengths = np.linalg.norm(cloths[:, edges[:, 1]] - cloths[:, edges[:, 0]], axis=2)
    strain = np.abs(lengths / np.where(rest > 0, rest, 1) - 1)
    found = {"strain_mean": 100 * float(strain.mean()), "every": float(every)}
    if model.surface is None or animation.body is None:
        return found
    faces, part, whole = np.asarray(model.surface.faces), run.assembly.prepared.part, animation.body.vertices
    count = whole.shape[1] - animation.body.worn
    bodies = np.concatenate([whole[::every, part], whole[::every, count:]], axis=1).astype(np.float64)
    border = border_of(faces, bodies.shape[1])
    depths = np.stack([-signed_distance(x, y, faces, border, CLEAR) for x, y in zip(cloths, bodies, strict=True)])
    if model.under:  # as `metrics.quality` does, because a crease of what is worn below may be folded
        for depth, x, y in zip(depths, cloths, bodies, strict=True):
            deepest = np.argsort(-depth)[:DEEPEST]
            inside = np.asarray(winding_number(jnp.asarray(x[deepest]), jnp.asarray(y[faces]))) > 0.5
            depth[deepest] = np.where(inside, depth[deepest], -np.abs(depth[deepest]))
    return found | {"penetrating": 100 * float((depths > 0).mean()), "depth_max": 1000 * max(0.0, float(depths.max()))}


def _draw_curves(folder: Path, log: Path) -> Path | None:
    """Draw the energies over training, and return the file; None without a log or matplotlib."""
    if not log.exists() or not find_spec("matplotlib"):
        return None
    with log.open(newline="") as file:
        curves.energy_curves(drawn := folder / "energies.png", list(csv.DictReader(file)))
    return drawn

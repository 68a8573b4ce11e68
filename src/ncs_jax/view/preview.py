"""What a run looks like: pictures, curves, and one page that plays it."""

from __future__ import annotations

import csv
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import Skeleton, blend, blend_from, forward, skin, to_rest_axes, transforms
from ncs_jax.metrics.quality import summarise
from ncs_jax.network.rollout import animated
from ncs_jax.prepare.build import Assembly, features_from_records
from ncs_jax.runs.run import Run

__all__ = ["posed_body", "preview", "worn_over"]

ALPHAS = (0.0, 1.0, 1.5)


def posed_body(body: io.BodyRecord, motion: io.MotionRecord) -> np.ndarray:
    """The whole body's vertices over a motion, (frames, body, 3) in m."""
    skeleton = Skeleton(jnp.asarray(body.joints, jnp.float32), tuple(int(p) for p in body.parents))
    weights, rest = blend_from(body.weights), jnp.asarray(body.vertices, jnp.float32)
    local = axis_angle_to_matrix(jnp.asarray(motion.poses, jnp.float32))
    if body.rest_rotations is not None:
        local = to_rest_axes(local, jnp.asarray(body.rest_rotations, jnp.float32))

    @jax.jit
    def run(local, translation):
        matrices = transforms(skeleton, forward(skeleton, local, translation))
        return jax.lax.map(lambda m: skin(blend(m, weights), rest), matrices)

    return np.asarray(run(local, jnp.asarray(motion.translation, jnp.float32)))


def worn_over(a: Assembly, motion: io.MotionRecord) -> tuple[np.ndarray, np.ndarray, int] | tuple[None, None, int]:
    """What a garment is worn over as one mesh, body and garments below.

    Returns:
        Vertices (frames, verts, 3) in m, faces, and how many of the vertices, the last, are of garments. None without a body.
    """
    if a.body is None:
        return None, None, 0
    vertices, faces = [posed_body(a.body, motion)], [a.body.faces]
    for layer in a.model.under:
        faces.append(np.asarray(layer.model.garment.mesh.faces) + sum(v.shape[1] for v in vertices))
        vertices.append(animated(layer.model, layer.network, layer.params, features_from_records(layer.model, motion)))
    return np.concatenate(vertices, axis=1), np.concatenate(faces), sum(v.shape[1] for v in vertices[1:])


def preview(run: Run, folder: str | Path, motion: str | None = None, *, title: str = "") -> dict[str, float]:
    """Write preview.png, preview.gif, preview.html and energies.png into a folder; return the motion's evaluation at alpha 1.

    The curves need matplotlib, of the `plots` extra; without it they are left out.

    Args:
        run: trained. folder: where to. motion: a motion's name or file; else the scene's first validation or training motion.
    """
    from ncs_jax.view import curves, page, pictures

    folder = Path(folder)
    scene = run.assembly.scene
    names = (motion,) if motion else (*scene.motion.validation, *scene.motion.files)
    if not names:
        raise InputError("a motion to show is needed", field="motion.files", mend="name one in the scene")
    name = names[0]
    track = run.track(name)
    alphas = ALPHAS if run.assembly.network.controlled else (0.0,)
    animations = {f"{alpha:g}": run.animate(track, alpha) for alpha in alphas}
    garment = animations["1"] if "1" in animations else animations["0"]
    faces = run.assembly.garment.faces
    body, body_faces, worn = worn_over(run.assembly, run.motion(name))
    fps = run.assembly.model.fps
    quantities = summarise(run.evaluate(track))
    facts = {
        "motion": name,
        "trained": f"{run.steps} steps on {', '.join(scene.motion.files)}",
        "mean strain": f"{quantities['strain_mean']:.2f} %",
    }
    if "penetrating" in quantities:
        facts["penetrating vertices"] = f"{quantities['penetrating']:.2f} %"
    pictures.contact_sheet(folder / "preview.png", garment, faces, body, body_faces, fps, worn=worn)
    pictures.animation_gif(folder / "preview.gif", garment, faces, body, body_faces, fps, worn=worn)
    page.write_page(
        folder / "preview.html", animations, faces, body, body_faces, fps, title or "Neural cloth simulation", facts, worn
    )
    log = folder / "log.csv"
    if log.exists() and find_spec("matplotlib"):
        with log.open(newline="") as file:
            curves.energy_curves(folder / "energies.png", list(csv.DictReader(file)))
    return quantities

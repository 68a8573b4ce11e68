"""What a person sees of a garment that goes through a body: skin where there should be cloth, and surfaces that cross."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.terms import Terms
from ncs_jax.errors import InputError, required, shaped
from ncs_jax.geometry.triangle_crossings import crossed
from ncs_jax.metrics.skin import CoveredSkin, covered_skin, skin_pixels
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body, resting_body

__all__ = ["EVERY", "SkinShown", "measure_seen", "shown_skin", "touchable_bodies"]

EVERY = 5  # one frame in so many is looked at
LOOKED_AT = 24  # frames, where it is to be quick
VISIBLE = 20  # pixels of skin, of 256 for the garment's largest side, that a person sees in passing: 2 cm^2 of a dress
BLOCK = 16  # frames whose bodies are posed at once, so that motions of every length share one compilation


@jax.jit
def _posed(model: Model, matrices: Float[Array, "frames joints 3 4"]) -> Float[Array, "frames body 3"]:
    return lax.map(lambda m: pose_body(model, m), matrices)


def measure_seen(
    model: Model, vertices: Float[Array | np.ndarray, "frames verts 3"], track: MotionFeatures, every: int = EVERY
) -> dict[str, np.ndarray]:
    """Return `self_intersecting`, and with a body `body_intersecting`, `skin_pixels` and `skin_share`, of some frames.

    They are of the first frame and of every `every`-th one after it: value i of each is of frame `i * every`. What they are,
    `quality.QUANTITIES` says, and `skin.skin_pixels` by an equation. The body is its touchable part, with the garments worn
    below. All is found on the host, in some 0.1 s a frame, by a core each; only the bodies are posed by a program.

    Args:
        vertices: (frames, verts, 3) in m, of the motion's first frames, or of all. track: the motion that they belong to.

    Raises:
        InputError: the vertices are not the garment's or not finite, or there are more frames than the motion has.
    """
    verts, count = len(model.garment.mesh.rest), len(vertices)
    shaped(vertices, (verts, 3), "vertices", f"the garment's {verts} vertices (frames, {verts}, 3), m,")
    if count > len(track.start):
        raise InputError(f"at most the track's {len(track.start)} frames expected", field="vertices", value=f"{count} frames")
    chosen = np.arange(0, count, every)
    x = track.relative(np.asarray(vertices))[chosen].astype(np.float64)
    if not np.isfinite(x).all():
        bad = int(chosen[~np.isfinite(x).all(axis=(1, 2))][0])
        raise InputError("finite vertices expected", field="vertices", value=f"frame {bad}", mend="see ncs check")
    cloth = np.asarray(model.garment.mesh.faces)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        rows = {"self_intersecting": np.array([100.0 * f.mean() for f in pool.map(lambda frame: crossed(frame, cloth), x)])}
        if model.surface is not None:
            faces, skin = np.asarray(model.surface.faces), _covered(model)

            def look(frame: int) -> tuple[float, int, int]:
                through = crossed(x[frame], cloth, body[frame], faces)
                shown, seen = skin_pixels(skin, body[frame], x[frame])
                return 100.0 * float(through.mean()), len(shown), seen

            body = touchable_bodies(model, track, chosen)
            through, shown, seen = (np.array(part, np.float64) for part in zip(*pool.map(look, range(len(x))), strict=True))
            rows |= {"body_intersecting": through, "skin_pixels": shown, "skin_share": 100 * shown / np.maximum(seen, 1)}
    return rows


@dataclass(frozen=True)
class SkinShown:
    """In how many frames of an animation skin shows, and where most.

    Attributes:
        looked: how many frames were looked at. shown: in how many of these it is seen, in `VISIBLE` pixels and more of
            `skin.skin_pixels`. frame, pixels: the worst, and in how many it shows there. vertex: of the skin that shows most
            there, as `model.surface` numbers it; 0 where none does.
    """

    looked: int
    shown: int
    frame: int
    pixels: int
    vertex: int


def shown_skin(model: Model, vertices: np.ndarray, body: np.ndarray, frames: np.ndarray) -> SkinShown:
    """Return where skin shows in some frames of an animation, and compile nothing.

    Args:
        vertices: (looked, verts, 3) in m, of these frames. body: (looked, body, 3) in m, as `model.surface` numbers it, such as
            `touchable_bodies`. frames: (looked,) their numbers.
    """
    x, body, skin = vertices.astype(np.float64), body.astype(np.float64), _covered(model)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        shown = list(pool.map(lambda k: skin_pixels(skin, body[k], x[k])[0], range(len(x))))
    pixels = np.array([len(faces) for faces in shown])
    worst = int(pixels.argmax())
    vertex = int(skin.faces[np.bincount(shown[worst]).argmax(), 0]) if pixels[worst] else 0
    return SkinShown(len(x), int((pixels >= VISIBLE).sum()), int(frames[worst]), int(pixels[worst]), vertex)


def _covered(model: Model) -> CoveredSkin:
    """Return what is needed to count the pixels of skin that shows through the model's garment."""
    mesh, faces = model.garment.mesh, np.asarray(required(model.surface, "model.surface").faces)
    return covered_skin(resting_body(model), faces, np.asarray(mesh.rest), np.asarray(mesh.faces))


def touchable_bodies(model: Model, track: MotionFeatures, chosen: np.ndarray) -> np.ndarray:
    """Return what the garment may touch in some frames, (frames, body, 3) in m, measured from the track's origin."""
    bare = replace(model, terms=Terms(), vibrations=None)  # the same program whatever the terms
    blocks = []
    for first in range(0, len(chosen), BLOCK):
        some = chosen[np.minimum(np.arange(first, first + BLOCK), len(chosen) - 1)]
        matrices = np.array(track.matrices[some])
        origin = matrices[:, 0, :, 3].copy()  # seen from the root joint single precision is finest
        matrices[..., 3] -= origin[:, None]
        blocks.append(np.asarray(_posed(bare, matrices), np.float64) + origin[:, None])
    return np.concatenate(blocks)[: len(chosen)]

"""Put a trained garment outside of the body that it is animated on, each frame by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.energies.contact.halfway import halfway_from
from ncs_jax.energies.contact.layers import rim_ways
from ncs_jax.energies.contact.outside import put_outside
from ncs_jax.energies.contact.points import MOST, contact_points
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.geometry.enclosure import beside
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body, resting_body

__all__ = ["Pushing", "outside", "outside_body", "pushing"]

BLOCK = 32  # frames at a time
STRETCHED, LIMB = 2.0, 0.05  # times its length, around a limb of such a radius, m: cloth that must not sink between points
MARGIN = 0.75  # of the thickness: with half of it a knee still showed between points; cloth at rest lies farther out


class Pushing(NamedTuple):
    """What puts a garment outside of the body.

    surface: the model's, with more points between vertices, see `pushing`. skin: 1 for vertices of the touchable body that
    push, 0 for the others.
    """

    surface: Surface
    skin: Float[Array, "body"]


def pushing(model: Model) -> Pushing | None:
    """Return what puts the model's garment outside of the body; None without contact.

    A network may stretch cloth beyond what contact was planned for, and skin shows between the points that it trains with. So
    edges are cut into so many pieces, `MOST` at most, that none would sink by more than the margin were it `STRETCHED` over a
    `LIMB`:

        (STRETCHED L / n)^2 / (8 LIMB) <= margin

    Skin `beside` the garment at rest, as that of an arm which presses into a dress, does not push: cloth would go around it.
    """
    if model.surface is None:
        return None
    body, mesh, surface = resting_body(model), model.garment.mesh, model.surface
    rest, faces = np.asarray(mesh.rest, np.float64), np.asarray(mesh.faces)
    longest = np.linalg.norm(rest[faces] - rest[np.roll(faces, 1, axis=1)], axis=2).max(axis=1)
    sinks = (STRETCHED * longest) ** 2 / (8 * LIMB) / (MARGIN * float(model.material.thickness))
    pieces = np.clip(np.ceil(np.sqrt(sinks)), 1, MOST).astype(int)
    if surface.points is not None:
        numbered = np.array([len(rest) ** 2, len(rest), 1], np.int64)
        seen = np.isin(faces @ numbered, np.asarray(surface.points.corners) @ numbered)
        pieces = np.maximum(pieces, np.where(seen, 2, 1))
    points = contact_points(faces, pieces)
    halfway = None if points is None else surface.halfway or halfway_from(body)
    skin = jnp.asarray(~beside(body, rest, faces), model.basis.dtype)
    return Pushing(replace(surface, points=points, halfway=halfway), skin)


def outside(
    model: Model, by: Pushing, matrices: Float[Array, "joints 3 4 *poses"], x: Float[Array, "verts 3 *poses"]
) -> Float[Array, "verts 3 *poses"]:
    """Return the garment put outside of the body by `put_outside`, to `MARGIN` of the contact's thickness, m.

    Of garments worn together, each is then put outside of those below it, from the skin outwards.
    """
    margin = MARGIN * model.material.thickness
    x = put_outside(x, pose_body(model, matrices), by.surface, by.skin, margin)
    for upper in model.garment.uppers:
        lower, own, below = x[: upper.first], x[upper.first : upper.stop], upper.below
        found = put_outside(own, lower, below, jnp.ones(upper.first, x.dtype), margin, rim_ways(lower, below))
        x = x.at[upper.first : upper.stop].set(found)
    return x


@jax.jit
def _outside(model: Model, by: Pushing, matrices: Float[Array, "frames joints 3 4"], x: Float[Array, "frames verts 3"]):
    return jnp.moveaxis(outside(model, by, jnp.moveaxis(matrices, 0, -1), jnp.moveaxis(x, 0, -1)), -1, 0)


def outside_body(model: Model, track: MotionFeatures, vertices: np.ndarray) -> np.ndarray:
    """Return an animation (frames, verts, 3), m, of the model's garment over a motion, with each frame put `outside`.

    In a scene without contact it is returned as it is.
    """
    by, frames = pushing(model), len(vertices)
    if by is None:
        return vertices
    x, found = track.relative(vertices).astype(model.basis.dtype, copy=False), np.empty_like(vertices)
    for first in range(0, frames, BLOCK):
        at = np.minimum(np.arange(first, first + BLOCK), frames - 1)
        found[first : first + BLOCK] = np.asarray(_outside(model, by, track.matrices[at], x[at]))[: frames - first]
    return found if track.origin is None else found + np.asarray(track.origin)[:, None]

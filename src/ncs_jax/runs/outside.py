"""Put a trained garment outside of the body that it is animated on, each frame by itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.energies.contact.layers import rim_ways
from ncs_jax.energies.contact.outside import put_outside
from ncs_jax.errors import required
from ncs_jax.geometry.enclosure import beside
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body, resting_body

__all__ = ["outside", "outside_body", "pushing"]

BLOCK = 32  # frames at a time
MARGIN = 0.75  # of the thickness: with half of it a knee still showed between points; cloth at rest lies farther out


def pushing(model: Model) -> Float[Array, "body"] | None:
    """Return 1 for the vertices of the touchable body that put cloth outside, 0 for the others; None without contact.

    Skin `beside` the garment at rest, as that of an arm which presses into a dress, does not: cloth would go around it.
    """
    if model.surface is None:
        return None
    mesh = model.garment.mesh
    return jnp.asarray(~beside(resting_body(model), np.asarray(mesh.rest), np.asarray(mesh.faces)), model.basis.dtype)


def outside(
    model: Model, skin: Float[Array, "body"], matrices: Float[Array, "joints 3 4 *poses"], x: Float[Array, "verts 3 *poses"]
) -> Float[Array, "verts 3 *poses"]:
    """Return the garment put outside of the body by `put_outside`, to `MARGIN` of the contact's thickness, m.

    Of garments worn together, each is then put outside of those below it, from the skin outwards.
    """
    surface, margin = required(model.surface, "model.surface"), MARGIN * model.material.thickness
    x = put_outside(x, pose_body(model, matrices), surface, skin, margin)
    for upper in model.garment.uppers:
        lower, own, below = x[: upper.first], x[upper.first : upper.stop], upper.below
        found = put_outside(own, lower, below, jnp.ones(upper.first, x.dtype), margin, rim_ways(lower, below))
        x = x.at[upper.first : upper.stop].set(found)
    return x


@jax.jit
def _outside(model: Model, skin, matrices: Float[Array, "frames joints 3 4"], x: Float[Array, "frames verts 3"]):
    return jnp.moveaxis(outside(model, skin, jnp.moveaxis(matrices, 0, -1), jnp.moveaxis(x, 0, -1)), -1, 0)


def outside_body(model: Model, track: MotionFeatures, vertices: np.ndarray) -> np.ndarray:
    """Return an animation (frames, verts, 3), m, of the model's garment over a motion, with each frame put `outside`.

    In a scene without contact it is returned as it is.
    """
    skin, frames = pushing(model), len(vertices)
    if skin is None:
        return vertices
    x, found = track.relative(vertices).astype(model.basis.dtype, copy=False), np.empty_like(vertices)
    for first in range(0, frames, BLOCK):
        at = np.minimum(np.arange(first, first + BLOCK), frames - 1)
        found[first : first + BLOCK] = np.asarray(_outside(model, skin, track.matrices[at], x[at]))[: frames - first]
    return found if track.origin is None else found + np.asarray(track.origin)[:, None]

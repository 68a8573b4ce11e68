"""Skin beside a garment, as that of an arm beside a dress: cloth is always on its inner side, however it is turned."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact.nearest import smallest
from ncs_jax.geometry.numerics import normalize
from ncs_jax.geometry.skinning import Blend, blend, skin

__all__ = ["Beside", "turned_inwards"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Beside:
    """Vertices of the body beside a garment at rest, and some of the garment's: places in m, outward normals and weights."""

    skin: Int[Array, "skin"]
    points: Float[Array, "samples 3"]
    outward: Float[Array, "samples 3"]
    blend: Blend


def turned_inwards(
    normals: Float[Array, "body 3 *poses"],
    body: Float[Array, "body 3 *poses"],
    matrices: Float[Array, "joints 3 4 *poses"],
    found: Beside,
) -> Float[Array, "body 3 *poses"]:
    """Return unit normals of the body of which those beside the garment point to its inside.

        n <- ((1 - w) n - w N) / |(1 - w) n - w N|,   w = clip(n . N + 1/2, 0, 1)

    N is the outward normal of the garment where it is nearest to that skin, as the body alone carries it. A hand that reaches
    into a skirt so keeps pushing the skirt before it. By its own normals the half of the hand that is turned to the outside
    would push cloth out around itself, and a network, which knows nothing of the frame before, would sooner lift the skirt over
    the arm than let the arm pass through it.

    Args:
        normals, body: in one pose or several, m. matrices: joint transforms there.
    """

    def one(pose):
        normals, body, matrices = pose
        carried, own = blend(matrices, found.blend), body[found.skin]
        cloth = skin(carried, found.points)
        middle = jnp.mean(cloth, axis=0, keepdims=True)
        cloth = cloth - middle
        apart = jnp.sum(cloth**2, axis=1)[:, None] - 2 * jnp.matmul(cloth, (own - middle).T, precision="highest")
        outward = jnp.sum(carried[:, :, :3] * found.outward[:, None], axis=-1)
        outward, n = normalize(outward)[smallest(apart, 1)[0]], normals[found.skin]
        w = jnp.clip(jnp.sum(n * outward, axis=1, keepdims=True) + 0.5, 0, 1)
        return normals.at[found.skin].set(normalize((1 - w) * n - w * outward))

    if body.ndim == 2:
        return one((normals, body, matrices))
    poses = tuple(jnp.moveaxis(a, -1, 0) for a in (normals, body, matrices))
    return jnp.moveaxis(lax.map(one, poses), 0, -1)

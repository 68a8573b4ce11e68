"""The mass matrix of a garment's vibrations in a pose, and between two poses, from the joints' rotations alone.

Skinning blends the joints' rotations, P_t = sum_j w_j R_j(t) D. So

    P_t^T M P_s = sum_ja,ib (R_j(t)^T R_i(s))_ab K_ja,ib,   K_ja,ib = sum_v m_v w_vj w_vi d_va d_vb^T

of which K is a constant of the garment. A pose costs as much whatever the number of vertices, and is one product of matrices.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.geometry.skinning import Blend

__all__ = ["constants", "modal_mass", "pulled", "rotations_of"]


def constants(
    directions: Float[Array, "verts 3 modes"], mass: Float[Array, "verts"], weights: Blend
) -> Float[Array, "modes modes axes axes"]:
    """Return K, of the axes of the joints that carry the garment, three each, kg m^2."""
    modes, used = directions.shape[2], weights.weights.shape[1]
    root = jnp.sqrt(mass)[:, None] * weights.weights
    each = (root[:, None, :, None] * jnp.moveaxis(directions, 2, 1)[:, :, None, :]).reshape(len(mass), -1)
    found = jnp.matmul(each.T, each, precision="highest").reshape(modes, 3 * used, modes, 3 * used)
    return jnp.moveaxis(found, 2, 1)


def rotations_of(matrices: Float[Array, "joints 3 4 *poses"], weights: Blend) -> Float[Array, "3 axes *poses"]:
    """Return the axes, column by column, of the joints that carry the garment."""
    used = jnp.moveaxis(matrices[np.asarray(weights.joints), :, :3], 0, 1)
    return used.reshape(3, -1, *matrices.shape[3:])


def modal_mass(
    constants: Float[Array, "modes modes axes axes"], now: Float[Array, "3 axes poses"], then: Float[Array, "3 axes poses"]
) -> Float[Array, "modes modes poses"]:
    """Return P_t^T M P_s (modes, modes, poses), kg m^2, of the rotations now, t, and then, s, see `rotations_of`."""
    products = now[0, :, None] * then[0, None] + now[1, :, None] * then[1, None] + now[2, :, None] * then[2, None]
    modes, poses = len(constants), now.shape[-1]
    found = jnp.matmul(constants.reshape(modes * modes, -1), products.reshape(-1, poses), precision="highest")
    return found.reshape(modes, modes, poses)


def pulled(
    directions: Float[Array, "verts 3 modes"], transforms: Float[Array, "verts 3 4 poses"], force: Float[Array, "verts 3 poses"]
) -> Float[Array, "modes poses"]:
    """Return P_t^T f (modes, poses): the part of forces f in each pose that moves the vibrations."""
    columns = [transforms[:, i, :3] * force[:, i, None] for i in range(3)]
    unposed = columns[0] + columns[1] + columns[2]
    flat = directions.reshape(-1, directions.shape[2])
    return jnp.matmul(flat.T, unposed.reshape(len(flat), -1), precision="highest")

"""What every membrane shares: the deformation gradient of a triangle in its material axes."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.mesh import Mesh

__all__ = ["deformation"]


def deformation(x: Float[Array, "verts 3"], mesh: Mesh) -> Float[Array, "2 faces 3"]:
    """Images w_u, w_v of the unit material axes of every face: the two columns of F = dx/du (3x2), dimensionless."""
    p = x[mesh.faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    inverse = mesh.face_axes
    return jnp.stack([e1 * inverse[:, 0, i, None] + e2 * inverse[:, 1, i, None] for i in (0, 1)])

"""Cloth put out of the body: what contact has left inside, moved to the skin at once and without a solver."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.contact.between import touched
from ncs_jax.energies.contact.distance import gathered
from ncs_jax.energies.contact.points import on_vertices, with_points
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.geometry.soa_vectors import dot, minus

__all__ = ["put_outside"]

ROUNDS = 3
NEAR, FAR = 0.02, 0.04  # m from the nearest vertex of the body: up to where its plane is the skin, and from where it is not


def put_outside(
    x: Float[Array, "verts 3 *poses"],
    body: Float[Array, "body 3 *poses"],
    surface: Surface,
    skin: Float[Array, "body"],
    margin: float | Float[Array, ""],
    rims: Float[Array, "body 3 *poses"] | None = None,
) -> Float[Array, "verts 3 *poses"]:
    """Return cloth whose vertices, and the points between them, lie outside of the skin by a margin, m.

        x_k <- x_k + sum_p w_pk s_p n_p / sum_{p: s_p > 0} w_pk,    s_p = c_p max(margin - n_p . (x_p - b_p), 0)

    `ROUNDS` times. b_p is the vertex of the body nearest to p and n_p its normal, w_pk how much of p its corner k carries: a
    point alone is moved onto the plane that is the margin off the skin, and several that share a corner move it by their mean.
    c_p is `skin` at b_p, less where p is farther from b_p than `NEAR`, and 0 beyond `FAR`: there the plane says nothing of the
    skin. So cloth that lies deeper stays where it is.

    Args:
        x, body: in one pose or several. surface: of both. skin: 1 for vertices of the body that push, 0 for others. rims: the
            ways out of its rim, beyond which nothing pushes.

    It has no memory and no velocity: each frame is mended by itself. Cf. Mueller et al. 2007, Position Based Dynamics.
    """
    normals = vertex_normals(body, surface)

    def once(_, x):
        p = with_points(x, surface.points)
        index = touched(p, body, surface)
        normal, gap = gathered(normals, index), minus([p[:, i] for i in range(3)], gathered(body, index))
        share = skin[index] * jnp.clip((FAR - jnp.sqrt(dot(gap, gap))) / (FAR - NEAR), 0, 1)
        if rims is not None:
            share = jnp.where(surface.border[index] & (dot(gathered(rims, index), gap) > 0), 0, share)
        short = share * jnp.maximum(margin - dot(normal, gap), 0)
        moved = on_vertices(jnp.stack([short * n for n in normal], axis=1), surface.points)
        carried = on_vertices((short > 0)[:, None].astype(x.dtype), surface.points)
        return x + jnp.where(carried > 0, moved / jnp.where(carried > 0, carried, 1), 0)

    return lax.fori_loop(0, ROUNDS, once, x)

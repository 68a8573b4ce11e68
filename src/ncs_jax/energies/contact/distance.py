"""Signed distance to a body feature that is known: a vertex's tangent plane, or a triangle."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact.nearest import nearest_triangle, rows_at
from ncs_jax.energies.contact.surface import Surface, face_normals
from ncs_jax.geometry.closest_point import closest_weights, gap_to
from ncs_jax.geometry.numerics import angle_between, normalize
from ncs_jax.geometry.soa_vectors import dot, minus

__all__ = ["nearest_distance", "plane_distance", "triangle_distance"]


def plane_distance(
    x: Float[Array, "verts 3 *poses"],
    body: Float[Array, "body 3 *poses"],
    normals: Float[Array, "body 3 *poses"],
    index: Int[Array, "verts *poses"],
) -> Float[Array, "verts *poses"]:
    """Return the signed distance in m to the tangent plane of the nearest vertex: d = n . (x - b), negative inside.

    Its value jumps where the nearest vertex changes, so a finite difference across a jump does not meet the gradient.
    """
    return dot(_gathered(normals, index), minus([x[:, i] for i in range(3)], _gathered(body, index)))


def _gathered(table: Float[Array, "body 3 *poses"], index: Int[Array, "verts *poses"]) -> list[Float[Array, "verts *poses"]]:
    """Return the three components of rows of a table, in every pose those that it names there."""
    poses = index[:1].size
    rows = rows_at(table.reshape(-1, 3, poses), index.reshape(-1, poses), jnp.arange(poses, dtype=index.dtype)[None])
    return [component.reshape(index.shape) for component in rows]


def triangle_distance(
    x: Float[Array, "verts 3"], body: Float[Array, "body 3"], surface: Surface, index: Int[Array, "verts"]
) -> Float[Array, "verts"]:
    """Return the exact signed distance in m to the nearest triangle `index`, negative inside.

        d = n . (x - c),  c the closest point, n = +-(x - c)/|x - c|

    The sign comes from the pseudo-normal of the feature that holds c (face, edge or vertex), which alone is right at
    edges and vertices; on the rim of a touchable part, where the body goes on unseen, everything counts as outside. The
    closest point and n are constants to the derivative, which is exact to first order; on the surface itself, and wherever c
    lies within a face, n is the pseudo-normal. Differences are formed from a corner of the triangle, so that it costs no
    accuracy to be far from the origin. Source: Baerentzen and Aanaes 2005; closest point after Ericson 2005, 5.1.5.
    """
    triangle = body[surface.faces[index]]
    weights = closest_weights(lax.stop_gradient(x), lax.stop_gradient(triangle))
    normal = _pseudo_normal(lax.stop_gradient(body), surface, index, weights)
    gap = gap_to(x, triangle, weights)
    away = lax.stop_gradient(gap)
    length = jnp.sqrt(jnp.sum(away * away, axis=-1, keepdims=True))
    side = jnp.sign(jnp.sum(away * normal, axis=-1, keepdims=True))
    rim = jnp.all(surface.border[surface.faces[index]] | (weights <= 0), axis=-1, keepdims=True)
    side = jnp.where(rim, 1, side)
    touching = length < 1e-7  # m: the rounding of a float32 position at 1 m
    within = jnp.all(weights > 0, axis=-1, keepdims=True) & ~rim
    direction = jnp.where(touching | within | (side == 0), normal, side * away / jnp.where(touching, 1, length))
    return jnp.sum(direction * gap, axis=-1)


def nearest_distance(
    x: Float[Array, "verts 3"], body: Float[Array, "body 3"], surface: Surface, *, exact: bool = True
) -> Float[Array, "verts"]:
    """Return `triangle_distance` to the triangle that `nearest_triangle` finds, m."""
    return triangle_distance(x, body, surface, nearest_triangle(x, body, surface, exact=exact)[0])


def _pseudo_normal(body, surface, index, weights):
    """Normal of the feature that holds the closest point: face, mean of an edge's two faces, or angle-weighted at a vertex."""
    normals = jnp.concatenate([face_normals(body, surface.faces), jnp.zeros_like(body[:1])])
    zero = weights <= 0
    count = jnp.sum(zero, axis=-1)
    # the edge opposite corner k lies between corners k+1 and k+2, which is edge k+1 of the face
    opposite = (jnp.argmax(zero, axis=-1) + 1) % 3
    edge = jnp.take_along_axis(surface.face_edges[index], opposite[:, None], axis=1)[:, 0]
    along = jnp.sum(normals[surface.edge_sides[edge]], axis=1)
    corner = jnp.take_along_axis(surface.faces[index], jnp.argmax(weights, axis=-1)[:, None], axis=1)[:, 0]
    ring = surface.rings[corner]  # (verts, most)
    at = jnp.concatenate([surface.faces, jnp.zeros_like(surface.faces[:1])])[ring]
    here = at == corner[:, None, None]
    p = body[at]
    first, second = jnp.roll(p, -1, axis=2), jnp.roll(p, -2, axis=2)
    angles = jnp.sum(jnp.where(here, angle_between(first - p, second - p), 0), axis=-1)
    tip = jnp.sum(angles[..., None] * normals[ring], axis=1)
    chosen = jnp.where((count == 0)[:, None], normals[index], jnp.where((count == 1)[:, None], along, tip))
    return normalize(chosen)

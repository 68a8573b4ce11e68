"""How far cloth may move before it can pass through cloth: bounds on a step."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ncs_jax.energies.contact.pairs import (
    CHUNK,
    Groups,
    Pairs,
    candidate_room,
    corners_of,
    edge_weights,
    overlapping_members,
    point_weights,
    separation,
)
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.numerics import norm
from ncs_jax.geometry.soa_vectors import dot

__all__ = ["free_share", "limit_approach", "swept_share"]


PASSES = 16  # over the pairs until none is brought too near


def _free(x, p, vertices, rest, weigh, split: int):
    """The share of the move p on which each pair stays apart; `split` vertices are its first primitive's.

        t = 0.9 d / max_ij n . (p_j - p_i),   i in the first primitive, j in the second

    Both are convex, so between them lies a slab of width d across n, which cannot shrink faster than the fastest two of their
    vertices approach along n. Pairs that touch, d = 0, or do in the rest shape, do not hinder. Source: Li et al. 2020, 5 (steps
    that keep apart), here by separating planes.
    """
    at, moves = corners_of(x, vertices), corners_of(p, vertices)
    gap = separation(at, weigh(at))
    distance = jnp.sqrt(dot(gap, gap))
    along = jnp.sum(moves * gap[None], axis=1)  # times the distance
    closing = jnp.max(along[split:], axis=0) - jnp.min(along[:split], axis=0)
    hinders = (closing > 0) & (distance > 0) & (rest > 0)
    return jnp.where(hinders, 0.9 * distance**2 / jnp.where(hinders, closing, 1), 1)


def _relative(p):
    """Moves without what moves nothing against anything, the middle of their bounding box."""
    return p - (jnp.min(p, axis=0, keepdims=True) + jnp.max(p, axis=0, keepdims=True)) / 2


def free_share(x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], pairs: Pairs, radius) -> Float[Array, ""]:
    """Return the largest share t, at most 1, of the move p (m) on whose way no pair can pass through each other.

    The listed pairs by planes between them (see `_free`); all others are `radius` apart (m, of the search that found the
    pairs), of which no two vertices use up more than 0.9.
    """
    p = _relative(p)
    points, edges = pairs.rest[: len(pairs.points)], pairs.rest[len(pairs.points) :]
    listed = jnp.concatenate(
        [_free(x, p, pairs.points, points, point_weights, 1), _free(x, p, pairs.edges, edges, edge_weights, 2)]
    )
    far = 2 * jnp.sqrt(jnp.max(jnp.sum(p**2, axis=-1)))
    return jnp.minimum(jnp.min(listed, initial=1), 0.9 * radius / jnp.maximum(far, 0.9 * radius))


def limit_approach(x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], pairs: Pairs) -> Float[Array, "verts 3"]:
    """Return the move p (m) without what would bring the listed pairs of x nearer than a fifth of their distance.

    A plane across n midway between the two goes with them, at the mean of their vertices' speeds along n. What carries a vertex
    nearer to it than allowed is taken off, the mean over its pairs, until nothing is left or `PASSES` times. So one pair that
    closes does not hold up the whole garment. Source: Mueller et al. 2007 (constraints one by one, on the places themselves).
    """

    def planes(vertices, rest, weigh, split):
        at = corners_of(x, vertices)
        gap = separation(at, weigh(at)).T
        distance = norm(gap)
        allowed = jnp.where((distance > 0) & (rest > 0), 0.4 * distance, jnp.inf)
        return vertices, gap / jnp.where(distance > 0, distance, 1)[:, None], allowed[:, None], split

    count = len(pairs.points)
    both = planes(pairs.points, pairs.rest[:count], point_weights, 1), planes(pairs.edges, pairs.rest[count:], edge_weights, 2)

    def one(state):
        p, _, passes = state
        table = jnp.zeros((len(p), 4), p.dtype)
        for vertices, n, allowed, split in both:
            speed = jnp.sum(p[vertices] * n[:, None], axis=-1)
            first, second = speed[:, :split], speed[:, split:]
            plane = (jnp.mean(first, axis=1, keepdims=True) + jnp.mean(second, axis=1, keepdims=True)) / 2
            off = jnp.maximum(plane - allowed - first, 0), jnp.minimum(plane + allowed - second, 0)
            off = jnp.concatenate(off, axis=1)
            each = jnp.concatenate([off[..., None] * n[:, None], (off != 0)[..., None].astype(p.dtype)], axis=-1)
            table = table.at[vertices.reshape(-1)].add(each.reshape(-1, 4))
        return p + table[:, :3] / jnp.maximum(table[:, 3:], 1), jnp.any(table[:, 3] > 0), passes + 1

    middle = p - _relative(p)
    state = (p - middle, jnp.bool_(True), jnp.int32(0))
    return lax.while_loop(lambda state: state[1] & (state[2] < PASSES), one, state)[0] + middle


def swept_share(
    x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], mesh: Mesh, groups: Groups
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Return the share of the move p that is free of collision, over all pairs whose swept boxes overlap; and whether the
    search overflowed."""
    x, p = lax.stop_gradient(x), _relative(lax.stop_gradient(p))

    def share(first, second, weigh, most):
        i, j, found, full = overlapping_members(x, first, second, jnp.zeros((), x.dtype), most, x + p)
        corners, others = first[0], second[0]
        split = corners.shape[1]

        def look(state):
            start, least = state
            here, there = (lax.dynamic_slice(k, (start,), (CHUNK,)) for k in (i, j))
            vertices = jnp.concatenate([corners[here], others[there]], axis=1)
            rest = corners_of(mesh.rest, vertices)
            apart = separation(rest, weigh(rest))
            t = _free(x, p, vertices, dot(apart, apart), weigh, split)
            t = jnp.where(start + jnp.arange(CHUNK, dtype=jnp.int32) < found, t, 1)
            return start + CHUNK, jnp.minimum(least, jnp.min(t))

        state = (jnp.int32(0), jnp.ones((), x.dtype))
        return lax.while_loop(lambda state: state[0] < jnp.minimum(found, most), look, state)[1], full

    verts, edges = (jnp.arange(len(x), dtype=jnp.int32)[:, None], groups.verts), (mesh.edges, groups.edges)
    room = 4 * candidate_room(len(mesh.edges))  # ways are longer than what lies still
    points, full = share(verts, (mesh.faces, groups.faces), point_weights, room)
    crossings, fuller = share(edges, edges, edge_weights, room)
    return jnp.minimum(points, crossings), full | fuller

"""Cloth put out of the body: what contact has left inside, moved to the skin at once and without a solver."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.between import touched
from ncs_jax.energies.contact.distance import plane_distance
from ncs_jax.energies.contact.nearest import boxes_around, nearest_of_few, rows_at
from ncs_jax.energies.contact.points import on_vertices, with_points
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.geometry.closest_point import triangle_weights
from ncs_jax.geometry.soa_vectors import direction, dot, minus, plus, times

__all__ = ["put_outside"]

ROUNDS = 3
NEAR, FAR = 0.04, 0.08  # m from the skin: up to where its normal there says what is inside, and from where it does not
AT_ONCE = 64  # points that are looked at in one turn, for each pose


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

    `ROUNDS` times. b_p is the point of the body nearest to p (`nearest_of_few`) and n_p the normal there, that of the vertices
    of its triangle by their weights; w_pk is how much of p its corner k carries: a point alone is moved onto the plane that is
    the margin off the skin, and several that share a corner move it by their mean. c_p is `skin` at the corner that b_p is most
    of, less where p is farther from b_p than `NEAR`, and 0 beyond `FAR`. So cloth that lies deeper stays where it is.

    b_p is looked for where p comes below the margin over the plane of a vertex that pushes, and s_p is 0 elsewhere. That
    plane alone would not do: where an arm hangs beside the trunk, it is of the one or the other by chance.

    Args:
        x, body: in one pose or several. surface: of both. skin: 1 for vertices of the body that push, 0 for others. rims: the
            ways out of its rim, beyond which nothing pushes.

    It has no memory, no velocity and no derivative: each frame is mended by itself. Cf. Mueller et al. 2007, Position Based
    Dynamics.
    """
    shape = x.shape
    x, body = x.reshape(*x.shape[:2], -1), body.reshape(*body.shape[:2], -1)
    normals, boxes, poses = vertex_normals(body, surface), boxes_around(body, surface), x.shape[2]

    def short(p, at):
        pose = at % poses
        p = rows_at(p, at // poses, pose)
        corners = surface.faces[nearest_of_few(p, pose, body, surface, boxes)].T
        places = [rows_at(body, k, pose) for k in corners]
        weights = triangle_weights(p, *places)
        nearest, normal = (_mixed(weights, each) for each in (places, [rows_at(normals, k, pose) for k in corners]))
        normal, gap = direction(normal), minus(p, nearest)
        corner = jnp.take_along_axis(corners, jnp.argmax(jnp.stack(weights), axis=0)[None], axis=0)[0]
        share = skin[corner] * jnp.clip((FAR - jnp.sqrt(dot(gap, gap))) / (FAR - NEAR), 0, 1)
        if rims is not None:
            out = rows_at(rims.reshape(body.shape), corner, pose)
            beyond = dot(out, minus(p, rows_at(body, corner, pose))) > 0
            share = jnp.where(surface.border[corner] & beyond, 0, share)
        return jnp.stack(times(share * jnp.maximum(margin - dot(normal, gap), 0), normal), axis=1)

    def once(_, x):
        p = with_points(x, surface.points)
        index = touched(p, body, surface)
        may = (skin[index] > 0) & (plane_distance(p, body, normals, index) < margin)
        ways = _of_those(may, lambda at: short(p, at), AT_ONCE * poses, x.dtype).reshape(len(p), poses, 3)
        moved = on_vertices(jnp.moveaxis(ways, 1, 2), surface.points)
        carried = on_vertices(jnp.any(ways != 0, axis=2)[:, None].astype(x.dtype), surface.points)
        return x + jnp.where(carried > 0, moved / jnp.where(carried > 0, carried, 1), 0)

    return lax.fori_loop(0, ROUNDS, once, x).reshape(shape)


def _mixed(weights, vectors):
    a, b, c = (times(w, v) for w, v in zip(weights, vectors, strict=True))
    return plus(plus(a, b), c)


def _of_those(
    wanted: Bool[Array, "..."], look: Callable[[Int[Array, "few"]], Float[Array, "few 3"]], few: int, dtype
) -> Float[Array, "all 3"]:
    """Return what `look` says of the numbers of those that are wanted, so few at a time; zero for all others."""
    every = wanted.size
    few = min(few, every)
    todo = jnp.nonzero(wanted.reshape(-1), size=every + few, fill_value=every)[0].astype(jnp.int32)

    def turn(k, found):
        at = lax.dynamic_slice_in_dim(todo, k * few, few)
        return found.at[at].set(look(jnp.where(at < every, at, todo[0])), mode="drop")  # the last turn is filled with the first

    return lax.fori_loop(0, -(-jnp.sum(wanted) // few), turn, jnp.zeros((every, 3), dtype))

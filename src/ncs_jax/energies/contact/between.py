"""The vertex of the body that a point between a garment's vertices touches, without a search of its own."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact.halfway import looked_up
from ncs_jax.energies.contact.nearest import nearest_vertex
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.errors import required
from ncs_jax.geometry.soa_vectors import dot, minus

__all__ = ["touched", "with_between"]


def touched(
    x: Float[Array, "all 3 *poses"], body: Float[Array, "body 3 *poses"], surface: Surface, *, exact: bool = True
) -> Int[Array, "all *poses"]:
    """Return the body's vertex that each vertex touches, the nearest, and each point between them, `with_between`."""
    index, _ = nearest_vertex(x[: surface.verts], body, surface, exact=exact)
    return with_between(x, body, index, surface)


def with_between(
    x: Float[Array, "all 3 *poses"], body: Float[Array, "body 3 *poses"], index: Int[Array, "verts *poses"], surface: Surface
) -> Int[Array, "all *poses"]:
    """Return the body's vertex near each vertex, as given, and near each point between them.

        near(p) = argmin_b |x_p - b|   over   near(k), k the corners that carry p, and
        the vertex of the resting body nearest to  sum_k w_pk rest(near(k))

    Between two places on the skin lies skin, whatever the pose: as the body was built, what is half way is looked up in a table
    of space. Where limbs meet it may be that of neither, and a corner's is nearer. Every pose may lie beside others.
    """
    points = surface.points
    if points is None:
        return index
    table, poses = required(surface.halfway, "surface.halfway"), index[:1].size
    x, body = (lax.stop_gradient(a).reshape(len(a), 3, poses) for a in (x, body))
    own = index.reshape(-1, poses)
    pose = jnp.arange(poses, dtype=index.dtype)[None]

    def places(at):  # by component, each of which a CPU gathers several times faster than rows of three
        flat = at * poses + pose
        return [body[:, i].reshape(-1).at[flat].get(mode="promise_in_bounds") for i in range(3)]

    seen, weights = [x[len(index) :, i] for i in range(3)], points.weights.astype(table.rest.dtype)
    rest = [table.rest[:, i].at[own].get(mode="promise_in_bounds") for i in range(3)]
    corners = [points.corners[:, k] for k in range(3)]
    parts = [[weights[:, k, None] * r[corners[k]] for k in range(3)] for r in rest]
    middle = [a + b + c for a, b, c in parts]
    best = looked_up(table, middle)
    least = _square(seen, places(best))
    near = places(own)
    for k in range(3):
        square = jnp.where(points.weights[:, k, None] > 0, _square(seen, [b[corners[k]] for b in near]), jnp.inf)
        best, least = jnp.where(square < least, own[corners[k]], best), jnp.minimum(square, least)
    return jnp.concatenate([index, best.reshape(-1, *index.shape[1:])])


def _square(a, b):
    gap = minus(a, b)
    return dot(gap, gap)

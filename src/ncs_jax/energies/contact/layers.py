"""Contact of garments that are worn together: one mesh of several, each outside those nearer to the skin, and felt by them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact.between import touched
from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.distance import nearest_distance, plane_distance, triangle_distance
from ncs_jax.energies.contact.nearest import nearest_triangle
from ncs_jax.energies.contact.points import on_vertices, with_points
from ncs_jax.energies.contact.surface import Surface, face_normals, moving_normals
from ncs_jax.geometry.closest_point import closest_weights, gap_to

__all__ = ["Upper", "layer_blocks", "layer_distances", "layer_product", "layers", "rim_ways"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Upper:
    """A garment over others of its mesh: the vertices `first` to `stop` - 1. `below`: the surface of all vertices before."""

    below: Surface
    first: int = field(metadata={"static": True})
    stop: int = field(metadata={"static": True})


class _Planes(NamedTuple):
    """Normals at all vertices that lie below some garment, and the ways out at rims there, see `rim_ways`."""

    normals: Float[Array, "below 3 *poses"]
    ways: Float[Array, "below 3 *poses"]


def _planes(x: Float[Array, "verts 3 *poses"], uppers: tuple[Upper, ...]) -> _Planes:
    """Return them of what is below the outermost, which is what is below each and more; XLA would make them for each point."""
    lower, surface = x[: uppers[-1].first], uppers[-1].below
    made = _Planes(moving_normals(lower, surface), rim_ways(lax.stop_gradient(lower), surface))
    return lax.optimization_barrier(made)


def _by_planes(x: Float[Array, "verts 3 *poses"], upper: Upper, planes: _Planes) -> Float[Array, "points *poses"]:
    """Return distances from the plane of the nearest vertex below, m; cloth that hangs beyond a rim touches nothing."""
    lower, own, surface = x[: upper.first], x[upper.first : upper.stop], upper.below
    if surface.points is not None:
        own = lax.optimization_barrier(with_points(own, surface.points))
    index = touched(own, lower, surface)
    distance = plane_distance(own, lower, planes.normals[: upper.first], index)
    beyond = lax.stop_gradient(plane_distance(own, lower, planes.ways[: upper.first], index)) > 0
    return jnp.where(surface.border[index] & beyond, jnp.inf, distance)


def rim_ways(lower: Float[Array, "body 3 *poses"], surface: Surface) -> Float[Array, "body 3 *poses"]:
    """Return the ways out of the surface at its rim: from the middles of the triangles around each vertex to it."""
    middles = jnp.mean(lower[surface.faces], axis=1)
    around = [jnp.take(middles, at, axis=0, mode="fill", fill_value=0) for at in surface.rings.T]
    count = jnp.sum(surface.rings < len(surface.faces), axis=1).astype(lower.dtype).reshape(-1, *(1,) * (lower.ndim - 1))
    return count * lower - sum(around, start=jnp.zeros_like(lower))


def layers(
    x: Float[Array, "verts 3 *poses"], uppers: tuple[Upper, ...], thickness, stiffness, *, planes: bool = True
) -> Float[Array, "*poses"]:
    """Return the energy of contact between garments that are worn together, J.

        E = k_c sum_u sum_{p of u} min(d_p - eps, 0)^2,   d_p = n . (x_p - c),   c nearest to p of all garments below u

    Args:
        x: (verts, 3) in m, (verts, 3, *poses) by planes. uppers: the garments that are over others. thickness: eps, m.
        stiffness: k_c, J/m^2 each. planes: c is the nearest vertex and n its normal, and beyond a rim nothing touches: the law
            of contact with the body (12), quick, but it jumps where another vertex becomes nearest. Else c is the nearest point
            and d its signed distance (`triangle_distance`), which does not; where c is on a rim, n is that of its triangle, and
            the energy falls to nothing as p comes past the rim by eps.

    p are the vertices of u and, where contact looks between them, its points there. What lies below moves too: n and c are
    differentiated, so that to each force there is one against it.
    """
    energy, below = jnp.zeros(x.shape[2:], x.dtype), _planes(x, uppers) if planes and uppers else None
    for upper in uppers:
        if below is not None:
            energy += collision(_by_planes(x, upper, below), thickness, stiffness)
        else:
            touch = _by_triangles(*_both(x, upper), upper.below, thickness)
            energy += stiffness * jnp.sum(touch.share * jnp.minimum(touch.distance - thickness, 0) ** 2)
    return energy


class _Touch(NamedTuple):
    """Where points of a garment touch those below: signed distances, shares of the energy, corners and weights of c."""

    distance: Float[Array, "points"]
    share: Float[Array, "points"]
    corners: Int[Array, "points 3"]
    weights: Float[Array, "points 3"]


def _both(x: Float[Array, "verts 3"], upper: Upper) -> tuple[Float[Array, "points 3"], Float[Array, "below 3"]]:
    """Return the points of a garment, and the vertices below it."""
    return with_points(x[upper.first : upper.stop], upper.below.points), x[: upper.first]


def _by_triangles(own: Float[Array, "points 3"], lower: Float[Array, "below 3"], surface: Surface, thickness) -> _Touch:
    """Return the contact of `layers` by triangles: d = n . (p - c), and where c is on a rim, (1 - s^2/eps^2)^2 of the energy.

    There n is that of the triangle, and s is how far p is past the rim, along the triangle: nothing jumps as p comes past it.
    """
    index, _ = nearest_triangle(own, lower, surface)
    corners = surface.faces[index]
    weights = closest_weights(lax.stop_gradient(own), lax.stop_gradient(lower[corners]))
    rim = jnp.all(surface.border[corners] | (weights <= 0), axis=-1)
    gap, normal = gap_to(own, lower[corners], weights), face_normals(lower, surface.faces)[index]
    across = jnp.sum(normal * gap, axis=-1)
    aside = gap - across[:, None] * normal
    past = jnp.maximum(1 - jnp.sum(aside * aside, axis=-1) / thickness**2, 0) ** 2
    distance = jnp.where(rim, across, triangle_distance(own, lower, surface, index))
    return _Touch(distance, jnp.where(rim, past, 1), corners, weights)


def _parted(touch: _Touch) -> tuple[Float[Array, "points"], _Touch]:
    return touch.distance, touch


def layer_distances(x: Float[Array, "verts 3"], upper: Upper) -> Float[Array, "points"]:
    """Return exact signed distances of a garment's vertices, and of the points between them, to the garments below it, m."""
    return nearest_distance(*_both(x, upper), upper.below)


def layer_blocks(x: Float[Array, "verts 3"], uppers: tuple[Upper, ...], thickness, stiffness) -> Float[Array, "verts 3 3"]:
    """Return blocks of single vertices that are no less than the second derivative of `layers` with d's directions held, N/m.

    A spring between two points that v_k and w_k carry is at most twice its own blocks there:
    (sum v_k a_k - sum w_k b_k)^2 <= 2 sum v_k a_k^2 + 2 sum w_k b_k^2.
    """
    x, blocks = lax.stop_gradient(x), jnp.zeros((*x.shape, 3), x.dtype)
    for upper in uppers:
        (own, lower), below = _both(x, upper), upper.below
        _, back, touch = jax.vjp(lambda own, at=(lower, below, thickness): _parted(_by_triangles(own, *at)), own, has_aux=True)
        (n,) = back(jnp.ones_like(touch.distance))
        push = jnp.where(touch.distance < thickness, 4 * stiffness * touch.share, 0)[:, None, None]
        push = push * n[:, :, None] * n[:, None, :]
        carried = touch.weights[..., None, None] * push[:, None]
        blocks = blocks.at[upper.first : upper.stop].add(on_vertices(push, below.points)).at[touch.corners].add(carried)
    return blocks


def layer_product(
    x: Float[Array, "verts 3"], uppers: tuple[Upper, ...], thickness, stiffness
) -> Callable[[Float[Array, "verts 3"]], Float[Array, "verts 3"]]:
    """Return the product with 2 k_c sum_p grad d_p grad d_p^T: the second derivative of `layers`, d's directions held, N/m."""

    def pressed(x):
        found = [_by_triangles(*_both(x, upper), upper.below, thickness) for upper in uppers]
        kept = [jnp.where(touch.distance < thickness, touch.share, 0) for touch in found]
        return [touch.distance for touch in found], kept

    _, along, kept = jax.linearize(pressed, lax.stop_gradient(x), has_aux=True)
    back = jax.linear_transpose(along, x)
    return lambda p: back([2 * stiffness * share * d for share, d in zip(kept, along(p), strict=True)])[0]

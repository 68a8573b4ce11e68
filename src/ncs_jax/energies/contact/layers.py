"""Contact of garments that are worn together: one mesh of several, each outside those nearer to the skin, and felt by them."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.contact.between import touched
from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.distance import nearest_distance, plane_distance, triangle_distance
from ncs_jax.energies.contact.nearest import nearest_triangle
from ncs_jax.energies.contact.points import on_vertices, with_points
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.geometry.closest_point import closest_weights

__all__ = ["Upper", "layer_blocks", "layer_distances", "layers", "rim_ways"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Upper:
    """A garment over others of its mesh: the vertices `first` to `stop` - 1. `below`: the surface of all vertices before."""

    below: Surface
    first: int = field(metadata={"static": True})
    stop: int = field(metadata={"static": True})


def _by_planes(x: Float[Array, "verts 3 *poses"], upper: Upper) -> Float[Array, "points *poses"]:
    """Return distances from the plane of the nearest vertex below, m; cloth that hangs beyond a rim touches nothing."""
    lower, own, surface = x[: upper.first], x[upper.first : upper.stop], upper.below
    if surface.points is not None:
        own = lax.optimization_barrier(with_points(own, surface.points))
    index = touched(own, lower, surface)
    distance = plane_distance(own, lower, vertex_normals(lower, surface), index)
    beyond = lax.stop_gradient(plane_distance(own, lower, rim_ways(lower, surface), index)) > 0
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
            and d its signed distance (`triangle_distance`), which does not.

    p are the vertices of u and, where contact looks between them, its points there. What lies below moves too: n and c are
    differentiated, so that to each force there is one against it.
    """
    energy = jnp.zeros(x.shape[2:], x.dtype)
    for upper in uppers:
        distance = _by_planes(x, upper) if planes else layer_distances(x, upper)
        energy += collision(distance, thickness, stiffness)
    return energy


def layer_distances(x: Float[Array, "verts 3"], upper: Upper) -> Float[Array, "points"]:
    """Return exact signed distances of a garment's vertices, and of the points between them, to the garments below it, m."""
    own = with_points(x[upper.first : upper.stop], upper.below.points)
    return nearest_distance(own, x[: upper.first], upper.below)


def layer_blocks(x: Float[Array, "verts 3"], uppers: tuple[Upper, ...], thickness, stiffness) -> Float[Array, "verts 3 3"]:
    """Return blocks of single vertices that are no less than the second derivative of `layers` with d's directions held, N/m.

    A spring between two points that v_k and w_k carry is at most twice its own blocks there:
    (sum v_k a_k - sum w_k b_k)^2 <= 2 sum v_k a_k^2 + 2 sum w_k b_k^2.
    """
    x, blocks = lax.stop_gradient(x), jnp.zeros((*x.shape, 3), x.dtype)
    for upper in uppers:
        lower, surface = x[: upper.first], upper.below
        own = with_points(x[upper.first : upper.stop], surface.points)
        index, _ = nearest_triangle(own, lower, surface)
        distance, back = jax.vjp(lambda own, at=(lower, surface, index): triangle_distance(own, *at), own)
        (n,) = back(jnp.ones_like(distance))
        push = jnp.where(distance < thickness, 4 * stiffness, 0)[:, None, None] * n[:, :, None] * n[:, None, :]
        corners = surface.faces[index]
        carried = closest_weights(own, lower[corners])[..., None, None] * push[:, None]
        blocks = blocks.at[upper.first : upper.stop].add(on_vertices(push, surface.points)).at[corners].add(carried)
    return blocks

"""Contact of garments that are worn together: one mesh of several, each outside those nearer to the skin, and felt by them."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.distance import nearest_distance, plane_distance, triangle_distance
from ncs_jax.energies.contact.nearest import nearest_triangle, nearest_vertex
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.geometry.closest_point import closest_weights

__all__ = ["Upper", "layer_blocks", "layers"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Upper:
    """A garment over others of its mesh: the vertices `first` to `stop` - 1. `below`: the surface of all vertices before."""

    below: Surface
    first: int = field(metadata={"static": True})
    stop: int = field(metadata={"static": True})


def _by_planes(x: Float[Array, "verts 3 *poses"], upper: Upper) -> Float[Array, "own *poses"]:
    """Return distances from the plane of the nearest vertex below, m; cloth whose nearest is on a rim touches nothing."""
    lower, own, surface = x[: upper.first], x[upper.first : upper.stop], upper.below
    index, _ = nearest_vertex(own, lower, surface)
    distance = plane_distance(own, lower, vertex_normals(lower, surface), index)
    return jnp.where(surface.border[index], jnp.inf, distance)


def layers(
    x: Float[Array, "verts 3 *poses"], uppers: tuple[Upper, ...], thickness, stiffness, *, planes: bool = True
) -> Float[Array, "*poses"]:
    """Return the energy of contact between garments that are worn together, J.

        E = k_c sum_u sum_{v of u} min(d_v - eps, 0)^2,   d_v = n . (x_v - c),   c nearest to v of all garments below u

    Args:
        x: (verts, 3) in m, (verts, 3, *poses) by planes. uppers: the garments that are over others. thickness: eps, m.
        stiffness: k_c, J/m^2 each. planes: c is the nearest vertex and n its normal, and on a rim nothing touches: the law of
            contact with the body (12), quick, but it jumps where another vertex becomes nearest. Else c is the nearest point
            and d its signed distance (`triangle_distance`), which does not.

    What lies below moves too: n and c are differentiated, so that to each force there is one against it.
    """
    energy = jnp.zeros(x.shape[2:], x.dtype)
    for upper in uppers:
        own, lower = x[upper.first : upper.stop], x[: upper.first]
        distance = _by_planes(x, upper) if planes else nearest_distance(own, lower, upper.below)
        energy += collision(distance, thickness, stiffness)
    return energy


def layer_blocks(x: Float[Array, "verts 3"], uppers: tuple[Upper, ...], thickness, stiffness) -> Float[Array, "verts 3 3"]:
    """Return blocks of single vertices that are no less than the second derivative of `layers` with d's directions held, N/m.

    A spring between a vertex and a point that w_k carry is at most twice its own blocks there:
    (a - sum w_k b_k)^2 <= 2 a^2 + 2 sum w_k b_k^2.
    """
    x, blocks = lax.stop_gradient(x), jnp.zeros((*x.shape, 3), x.dtype)
    for upper in uppers:
        own, lower, surface = x[upper.first : upper.stop], x[: upper.first], upper.below
        index, _ = nearest_triangle(own, lower, surface)
        distance, back = jax.vjp(lambda own, at=(lower, surface, index): triangle_distance(own, *at), own)
        (n,) = back(jnp.ones_like(distance))
        push = jnp.where(distance < thickness, 4 * stiffness, 0)[:, None, None] * n[:, :, None] * n[:, None, :]
        corners = surface.faces[index]
        carried = closest_weights(own, lower[corners])[..., None, None] * push[:, None]
        blocks = blocks.at[upper.first : upper.stop].add(push).at[corners].add(carried)
    return blocks

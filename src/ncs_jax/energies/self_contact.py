"""Self-contact: cloth that keeps its distance from itself, pair by pair of point and triangle and of edge and edge.

The pairs come from `proximity.nearby_pairs`. Every pair is a spring along one direction n between two points that weights w_i
take from its four vertices, so energy, gradient and Gauss-Newton Hessian are sums of a gather and a scatter over the pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.proximity import Pairs, corners_of, edge_weights, point_weights, separation
from ncs_jax.numerics import norm, normalize

__all__ = ["Repulsion", "blocks", "energy", "gradient", "product", "repulsion", "self_contact", "springs"]


class Repulsion(NamedTuple):
    """How the pairs push: d = n . sum_i w_i x_i, first the pairs of point and triangle, then those of edge and edge."""

    vertices: Int[Array, "pairs 4"]
    shortfall: Float[Array, "pairs"]  # min(d - eps, 0) in m
    weights: Float[Array, "pairs 4"]  # point and triangle: 1, -a, -b, -c; edge and edge: 1 - s, s, t - 1, -t
    direction: Float[Array, "pairs 3"]  # n, unit; zero where the two touch


def _apart(x, pairs):
    """Vertices, weights and separation of all pairs; the weights are constants to the derivative."""
    points, edges = corners_of(x, pairs.points), corners_of(x, pairs.edges)
    weights = [point_weights(lax.stop_gradient(points)), edge_weights(lax.stop_gradient(edges))]
    apart = [separation(p, w) for p, w in zip((points, edges), weights, strict=True)]
    return jnp.concatenate([pairs.points, pairs.edges]), jnp.concatenate(weights, axis=1).T, jnp.concatenate(apart, axis=1).T


def _shortfall(distance, pairs, thickness):
    return jnp.minimum(distance - jnp.minimum(thickness, pairs.rest), 0)


def repulsion(x: Float[Array, "verts 3"], pairs: Pairs, thickness: Float[Array, ""] | float) -> Repulsion:
    """What every pair contributes at x (m), with thickness eps in m; see `self_contact`."""
    vertices, weights, apart = _apart(x, pairs)
    return Repulsion(vertices, _shortfall(norm(apart), pairs, thickness), weights, normalize(apart))


def self_contact(
    x: Float[Array, "verts 3"],
    pairs: Pairs,
    thickness: Float[Array, ""] | float,
    stiffness: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Self-contact energy in J.

        E = k_s sum_pairs min(d - min(eps, d_rest), 0)^2

    Args:
        x: (verts, 3) positions in m. pairs: all those nearer than eps. thickness: eps in m. stiffness: k_s in J/m^2 a pair.

    d is the unsigned distance of point and triangle, or of edge and edge, each as a whole: a distance between two convex sets
    has no steps, so neither has the energy. (To count edges only where their insides are closest would make steps at their
    ends.) A pair that is nearer than eps in the rest shape keeps its rest distance, so that the garment rests at rest. The
    closest points are constants to the derivative, which is exact to first order wherever they are the only ones, and one of
    the derivatives beside the kink where edges are parallel; it is zero where the two touch, d = 0. The second is not exact.
    Source: Bridson, Fedkiw and Anderson 2002, 7.1 (the pairs); Li et al. 2020, 3 (all pairs, unclassified).
    """
    return stiffness * jnp.sum(_shortfall(norm(_apart(x, pairs)[2]), pairs, thickness) ** 2)


def energy(found: Repulsion, stiffness: Float[Array, ""] | float) -> Float[Array, ""]:
    """E = k_s sum shortfall^2 in J: `self_contact` of pairs that are known."""
    return stiffness * jnp.sum(found.shortfall**2)


def _spread(found, each, like):
    """What every pair gives to its four vertices, added up by vertex."""
    shape = each.shape[2:]
    return jnp.zeros((len(like), *shape), like.dtype).at[found.vertices.reshape(-1)].add(each.reshape(-1, *shape))


def gradient(found: Repulsion, x: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3"]:
    """dE/dx_i = sum_pairs 2 k_s min(d - eps, 0) w_i n in N; of x only the shape counts."""
    along = (2 * stiffness * found.shortfall)[:, None] * found.weights
    return _spread(found, along[..., None] * found.direction[:, None], x)


def springs(found: Repulsion, stiffness: Float[Array, ""] | float) -> Float[Array, "pairs 4 3"]:
    """v_i = sqrt(2 k_s [d < eps]) w_i n: the Gauss-Newton Hessian is sum_pairs v v^T, positive semi-definite."""
    root = jnp.where(found.shortfall < 0, jnp.sqrt(2 * stiffness), 0)
    return (root[:, None] * found.weights)[..., None] * found.direction[:, None]


def product(found: Repulsion, p: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3"]:
    """Gauss-Newton Hessian times p (m): sum_pairs v (v . p) in N."""
    v = springs(found, stiffness)
    return _spread(found, v * jnp.sum(v * p[found.vertices], axis=(1, 2))[:, None, None], p)


def blocks(found: Repulsion, x: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3 3"]:
    """Blocks on the diagonal of the Gauss-Newton Hessian: sum_pairs v_i v_i^T in N/m; of x only the shape counts."""
    v = springs(found, stiffness)
    return _spread(found, v[..., :, None] * v[..., None, :], x)

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

__all__ = ["Repulsion", "blocks", "energy", "gradient", "product", "repulsion", "self_contact", "unhindered"]


class Repulsion(NamedTuple):
    """How the pairs push: d = n . sum_i w_i x_i, first the pairs of point and triangle, then those of edge and edge."""

    vertices: Int[Array, "pairs 4"]
    shortfall: Float[Array, "pairs"]  # min(d - eps, 0) in m
    weights: Float[Array, "pairs 4"]  # point and triangle: 1, -a, -b, -c; edge and edge: 1 - s, s, t - 1, -t
    direction: Float[Array, "pairs 3"]  # n, unit; zero where the two touch
    distance: Float[Array, "pairs"]  # d in m


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
    distance = norm(apart)
    return Repulsion(vertices, _shortfall(distance, pairs, thickness), weights, normalize(apart), distance)


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


def _spread(found, along, like):
    """sum_pairs along w_i n at vertex i."""
    force = (along[:, None] * found.weights)[..., None] * found.direction[:, None, :]
    return jnp.zeros_like(like).at[found.vertices.reshape(-1)].add(force.reshape(-1, 3))


def gradient(found: Repulsion, x: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3"]:
    """dE/dx_i = sum_pairs 2 k_s min(d - eps, 0) w_i n in N; of x only the shape counts."""
    return _spread(found, 2 * stiffness * found.shortfall, x)


def product(found: Repulsion, p: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3"]:
    """Gauss-Newton Hessian times p (m): sum_pairs 2 k_s [d < eps] w_i n (n . sum_j w_j p_j) in N; positive semi-definite."""
    moved = jnp.sum(found.weights[..., None] * p[found.vertices], axis=1)
    return _spread(found, _stiff(found, stiffness) * jnp.sum(found.direction * moved, axis=-1), p)


def blocks(found: Repulsion, x: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3 3"]:
    """Blocks on the diagonal of the Gauss-Newton Hessian: sum_pairs 2 k_s [d < eps] w_i^2 n n^T in N/m; of x only the shape."""
    square = found.direction[:, :, None] * found.direction[:, None, :]
    each = (_stiff(found, stiffness)[:, None] * found.weights**2)[..., None, None] * square[:, None]
    return jnp.zeros((*x.shape, 3), x.dtype).at[found.vertices.reshape(-1)].add(each.reshape(-1, 3, 3))


def _stiff(found, stiffness):
    return 2 * stiffness * (found.shortfall < 0).astype(found.shortfall.dtype)


def unhindered(
    x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], pairs: Pairs, radius: Float[Array, ""] | float
) -> Float[Array, ""]:
    """Largest share t, at most 1, of the move p (m) on whose way no pair can pass through each other.

        t = min(1, 0.9 d / max_ij n . (p_j - p_i) of every pair in `pairs`, 0.9 radius / (2 max_i |p_i - c|))

    with i in the pair's first primitive and j in its second: both are convex, so between them lies a slab of width d across n,
    which cannot shrink faster than the fastest two of their vertices approach along n. All other pairs are `radius` apart (m,
    of the search that found the pairs, without overflow), and no two vertices approach each other faster than
    2 max |p_i - c|, whatever the constant c: the middle of the moves' bounding box.

    Pairs that touch, d = 0, or touch in the rest shape, do not hinder. Source: Li et al. 2020, 5 (steps that keep apart), here
    by separating planes.
    """
    vertices, _, apart = _apart(x, pairs)
    distance, count = norm(apart), len(pairs.points)
    moves = jnp.sum(p[vertices] * normalize(apart)[:, None], axis=-1)

    def closing(moves, first):
        return jnp.max(moves[:, first:], axis=1) - jnp.min(moves[:, :first], axis=1)

    speed = jnp.concatenate([closing(moves[:count], 1), closing(moves[count:], 2)])
    hinder = (speed > 0) & (distance > 0) & (pairs.rest > 0)
    near = jnp.min(jnp.where(hinder, 0.9 * distance / jnp.where(hinder, speed, 1), 1), initial=1)
    middle = (jnp.min(p, axis=0) + jnp.max(p, axis=0)) / 2
    far = 2 * jnp.sqrt(jnp.max(jnp.sum((p - middle[None]) ** 2, axis=-1)))
    return jnp.minimum(near, 0.9 * radius / jnp.maximum(far, 0.9 * radius))

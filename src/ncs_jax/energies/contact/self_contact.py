"""Self-contact: cloth that keeps its distance from itself, pair by pair of point and triangle and of edge and edge.

The pairs come from `pairs.nearby_pairs`. Every pair is a spring along one direction n between two points that weights w_i
take from its four vertices, so energy, gradient and Hessian along n are sums of a gather and a scatter over the pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.contact.pairs import Pairs, corners_of, edge_weights, point_weights, separation
from ncs_jax.geometry.numerics import norm, normalize

__all__ = ["Repulsion", "barrier", "blocks", "energy", "gradient", "product", "repulsion", "self_contact", "springs"]


LEAST = 0.01  # of the distance to keep: the barrier's logarithm ends there, and a parabola goes on to a distance of zero


class Repulsion(NamedTuple):
    """How the pairs push: d = n . sum_i w_i x_i, first the pairs of point and triangle, then those of edge and edge."""

    vertices: Int[Array, "pairs 4"]
    value: Float[Array, "pairs"]  # E / k_s in m^2,
    slope: Float[Array, "pairs"]  # its first derivative by d in m, not positive,
    curvature: Float[Array, "pairs"]  # and its second, not negative; all three zero where d is at least eps
    weights: Float[Array, "pairs 4"]  # point and triangle: 1, -a, -b, -c; edge and edge: 1 - s, s, t - 1, -t
    direction: Float[Array, "pairs 3"]  # n, unit; zero where the two touch


def _apart(x, pairs):
    """Vertices, weights and separation of all pairs; the weights are constants to the derivative."""
    points, edges = corners_of(x, pairs.points), corners_of(x, pairs.edges)
    weights = [point_weights(lax.stop_gradient(points)), edge_weights(lax.stop_gradient(edges))]
    apart = [separation(p, w) for p, w in zip((points, edges), weights, strict=True)]
    return jnp.concatenate([pairs.points, pairs.edges]), jnp.concatenate(weights, axis=1).T, jnp.concatenate(apart, axis=1).T


def barrier(s: Float[Array, "*pairs"]) -> tuple[Float[Array, "*pairs"], Float[Array, "*pairs"], Float[Array, "*pairs"]]:
    """Return B(s) = -(1 - s)^2 ln s for s < 1, else 0, and its first two derivatives; below `LEAST` its parabola there."""
    t = jnp.clip(s, LEAST, 1)
    log, rest, below = jnp.log(t), 1 - t, jnp.minimum(s - LEAST, 0)
    value, slope = -(rest**2) * log, 2 * rest * log - rest**2 / t
    curvature = (rest / t) ** 2 + 4 * rest / t - 2 * log
    return value + below * (slope + below * curvature / 2), slope + below * curvature, curvature


def _pushed(distance, pairs, thickness):
    """Barrier of every pair, its derivatives, and the distance it is to keep, m."""
    keep = jnp.minimum(thickness, pairs.rest)
    return *barrier(jnp.where(keep > 0, distance / jnp.where(keep > 0, keep, 1), 1)), keep


def repulsion(x: Float[Array, "verts 3"], pairs: Pairs, thickness: Float[Array, ""] | float) -> Repulsion:
    """Return what every pair contributes at x (m), with thickness eps in m; see `self_contact`."""
    vertices, weights, apart = _apart(x, pairs)
    value, slope, curvature, keep = _pushed(norm(apart), pairs, thickness)
    return Repulsion(vertices, keep**2 * value, keep * slope, curvature, weights, normalize(apart))


def self_contact(
    x: Float[Array, "verts 3"],
    pairs: Pairs,
    thickness: Float[Array, ""] | float,
    stiffness: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Return the self-contact energy in J.

        E = k_s sum_pairs e^2 B(d / e),   B(s) = -(1 - s)^2 ln s for s < 1, else 0,   e = min(eps, d_rest)

    Args:
        x: (verts, 3) positions in m. pairs: all those nearer than eps. thickness: eps in m. stiffness: k_s in J/m^2 a pair.

    A barrier: however hard cloth is pressed on cloth, some distance is left, and a solver's step sees the wall before it is
    there. The logarithm ends at a hundredth of the distance: cloth that already passes through cloth has a finite force.
    d is the unsigned distance of point and triangle, or of edge and edge, each as a whole: a distance between two convex sets
    has no steps, so neither has the energy. (To count edges only where their insides are closest would make steps at their
    ends.) A pair that is nearer than eps in the rest shape keeps its rest distance, so that the garment rests at rest. The
    closest points are constants to the derivative, which is exact to first order wherever they are the only ones, and one of
    the derivatives beside the kink where edges are parallel; it is zero where the two touch, d = 0. The second is not exact.
    Source: Bridson, Fedkiw and Anderson 2002, 7.1 (the pairs); Li et al. 2020, 3 (all pairs, unclassified)
    and eq. 6 (the barrier).
    """
    value, *_, keep = _pushed(norm(_apart(x, pairs)[2]), pairs, thickness)
    return stiffness * jnp.sum(keep**2 * value)


def energy(found: Repulsion, stiffness: Float[Array, ""] | float) -> Float[Array, ""]:
    """Return E in J: `self_contact` of pairs that are known."""
    return stiffness * jnp.sum(found.value)


def _spread(found, each, like):
    """What every pair gives to its four vertices, added up by vertex."""
    shape = each.shape[2:]
    return jnp.zeros((len(like), *shape), like.dtype).at[found.vertices.reshape(-1)].add(each.reshape(-1, *shape))


def gradient(found: Repulsion, x: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3"]:
    """Return dE/dx_i = sum_pairs dE/dd w_i n in N; of x only the shape counts."""
    along = (stiffness * found.slope)[:, None] * found.weights
    return _spread(found, along[..., None] * found.direction[:, None], x)


def springs(found: Repulsion, stiffness: Float[Array, ""] | float) -> Float[Array, "pairs 4 3"]:
    """Return v_i = sqrt(d^2E/dd^2) w_i n: the Hessian along n is sum_pairs v v^T, positive semi-definite."""
    return (jnp.sqrt(stiffness * found.curvature)[:, None] * found.weights)[..., None] * found.direction[:, None]


def product(found: Repulsion, p: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3"]:
    """Return the Hessian along n times p (m): sum_pairs v (v . p) in N."""
    v = springs(found, stiffness)
    return _spread(found, v * jnp.sum(v * p[found.vertices], axis=(1, 2))[:, None, None], p)


def blocks(found: Repulsion, x: Float[Array, "verts 3"], stiffness: Float[Array, ""] | float) -> Float[Array, "verts 3 3"]:
    """Return blocks on the diagonal of the Hessian along n: sum_pairs v_i v_i^T in N/m; of x only the shape counts."""
    v = springs(found, stiffness)
    return _spread(found, v[..., :, None] * v[..., None, :], x)

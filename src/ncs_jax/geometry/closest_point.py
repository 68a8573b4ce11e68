"""The closest point of a triangle to a point, once plainly and twice in the processor's vector lanes.

`closest_weights` has one point and triangle a row. `triangle_weights` is the same by component (`soa_vectors`), for many pairs
at once, and `triangle_square` its squared distance alone, for searches. `tests/test_closest_point.py` holds them equal.
Source: Ericson 2005, 5.1.5, with areas by cross products, which do not cancel.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.geometry.soa_vectors import Vector, cross, dot, minus, times

__all__ = ["closest_weights", "gap_to", "ratio", "triangle_square", "triangle_weights"]


def ratio(p: Array, q: Array) -> Array:
    """Return p / q within 0 and 1, for q >= 0; p itself, so clipped, where q is zero."""
    return jnp.clip(p / jnp.where(q > 0, q, 1), 0, 1)


def gap_to(x: Float[Array, "*#some 3"], corners: Float[Array, "*#some 3 3"], weights: Float[Array, "*#some 3"]) -> Array:
    """Return x - sum_k w_k c_k (..., 3) for weights that add up to 1, as differences from the first corner."""
    a, b, c = (corners[..., k, :] for k in range(3))
    return x - a - weights[..., 1:2] * (b - a) - weights[..., 2:] * (c - a)


def closest_weights(x: Float[Array, "rows 3"], corners: Float[Array, "rows 3 3"]) -> Float[Array, "rows 3"]:
    """Return the barycentric coordinates of the closest point of each triangle.

    The nearest of the three edges holds it, unless x lies over the inside. A triangle of no area is its edges.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, bc = b - a, c - a, c - b
    normal = jnp.cross(ab, ac)
    square = jnp.sum(normal * normal, axis=-1)

    def inner(p, q):
        return jnp.sum(p * q, axis=-1)

    wa = inner(jnp.cross(bc, x - b), normal)
    wb = inner(jnp.cross(-ac, x - c), normal)
    wc = inner(jnp.cross(ab, x - a), normal)
    face = jnp.stack([wa, wb, wc], axis=-1) / jnp.where(square > 0, square, 1)[:, None]
    inside = (square > 0) & jnp.all(face > 0, axis=-1)
    s, t, u = (
        ratio(inner(x - a, ab), inner(ab, ab)),
        ratio(inner(x - b, bc), inner(bc, bc)),
        ratio(inner(x - c, -ac), inner(ac, ac)),
    )
    zero = jnp.zeros_like(s)
    edges = jnp.stack([jnp.stack(w, axis=-1) for w in ([1 - s, s, zero], [zero, 1 - t, t], [u, zero, 1 - u])], axis=1)
    gap = gap_to(x[:, None], corners[:, None], edges)
    best = jnp.argmin(jnp.sum(gap * gap, axis=-1), axis=1)
    return jnp.where(inside[:, None], face, jnp.take_along_axis(edges, best[:, None, None], axis=1)[:, 0])


def _edges(p: Vector, a: Vector, b: Vector, c: Vector):
    """The edges ab, bc, ca, and the point seen from a, b and c."""
    return (minus(b, a), minus(c, b), minus(a, c)), (minus(p, a), minus(p, b), minus(p, c))


def _on_segment(p: Vector, edge: Vector) -> tuple[Array, Array]:
    """Where on the segment from 0 to `edge` the closest point to p is, from 0 to 1, and its squared distance."""
    t = ratio(dot(p, edge), dot(edge, edge))
    gap = minus(p, times(t, edge))
    return t, dot(gap, gap)


def triangle_weights(p: Vector, a: Vector, b: Vector, c: Vector) -> list[Array]:
    """Return what `closest_weights` does, three arrays of any one shape."""
    (ab, bc, ca), (pa, pb, pc) = _edges(p, a, b, c)
    normal = cross(bc, ca)
    square = dot(normal, normal)
    whole = jnp.where(square > 0, square, 1)
    face = [dot(cross(e, q), normal) / whole for e, q in ((bc, pb), (ca, pc), (ab, pa))]
    inside = (face[0] > 0) & (face[1] > 0) & (face[2] > 0) & (square > 0)
    (s, first), (t, second), (u, third) = _on_segment(pa, ab), _on_segment(pb, bc), _on_segment(pc, ca)
    on_first, on_second = (first <= second) & (first <= third), second <= third
    border = [
        jnp.where(on_first, 1 - s, jnp.where(on_second, 0, u)),
        jnp.where(on_first, s, jnp.where(on_second, 1 - t, 0)),
        jnp.where(on_first, 0, jnp.where(on_second, t, 1 - u)),
    ]
    return [jnp.where(inside, f, e) for f, e in zip(face, border, strict=True)]


def triangle_square(p: Vector, a: Vector, b: Vector, c: Vector) -> Array:
    """Return the squared distance to the point of `triangle_weights`, without making the point."""
    (ab, bc, ca), (pa, pb, pc) = _edges(p, a, b, c)
    normal = cross(ab, minus(c, a))
    square = dot(normal, normal)
    inside = (dot(cross(ab, pa), normal) > 0) & (dot(cross(bc, pb), normal) > 0) & (dot(cross(ca, pc), normal) > 0)
    plane = dot(pa, normal) ** 2 / jnp.where(square > 0, square, 1)
    first, second, third = (_on_segment(q, e)[1] for q, e in ((pa, ab), (pb, bc), (pc, ca)))
    return jnp.where(inside & (square > 0), plane, jnp.minimum(jnp.minimum(first, second), third))

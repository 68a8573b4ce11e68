"""Norms, directions and angles whose value, first and second derivative are finite everywhere.

Each function masks its *input*, row by row, before the singular operation, so that a singular row neither spoils its own
derivatives nor those of its neighbours (`tests/test_numerics.py`).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

__all__ = ["angle_between", "arctan2", "least_length", "norm", "normalize", "positive_part", "signed_angle"]

SWEEPS = 30  # of Jacobi rotations, at most


def least_length(dtype) -> float:
    """Return the least length, in the unit of the argument, for which a second derivative 1/length^2 stays in range."""
    return 1e-12 if dtype == jnp.float32 else 1e-100


# atan(t)/t over t^2, |t| <= 1: least absolute error, 6e-9 before rounding
_ARCTANGENT = (
    0.999999881,
    -0.333325952,
    0.199858963,
    -0.14161177,
    0.104987912,
    -0.0723458901,
    0.0397785194,
    -0.0143998954,
    0.00245639519,
)


def arctan2(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the angle of (x, y) in (-pi, pi], 0 at the origin; in float32 by a polynomial, five times faster on a CPU."""
    if y.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    most, least = jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.minimum(jnp.abs(x), jnp.abs(y))
    t = least / jnp.where(most > 0, most, 1)
    square, angle = t * t, jnp.full_like(t, _ARCTANGENT[-1])
    for k in _ARCTANGENT[-2::-1]:
        angle = angle * square + k
    angle = angle * t
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), np.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def norm(x: Float[Array, "*rows n"]) -> Float[Array, "*rows"]:
    """Return the Euclidean length of the last axis; zero with zero derivatives where the row vanishes."""
    square = jnp.sum(x * x, axis=-1)
    singular = square < least_length(x.dtype) ** 2
    return jnp.where(singular, 0, jnp.sqrt(jnp.where(singular, 1, square)))


def normalize(x: Float[Array, "*shape"], axis: int = -1) -> Float[Array, "*shape"]:
    """Return the unit vector along an axis; zero with zero derivatives where the row vanishes."""
    # A direction does not depend on scale, so the scale is a constant to the derivative, and no power of it leaves the range.
    size = lax.stop_gradient(jnp.max(jnp.abs(x), axis=axis, keepdims=True))
    singular = size < least_length(x.dtype)
    x = jnp.where(singular, 1, x) / jnp.where(singular, 1, size)
    return jnp.where(singular, 0, x * jnp.sum(x * x, axis=axis, keepdims=True) ** -0.5)


def signed_angle(sine: Float[Array, "*rows"], cosine: Float[Array, "*rows"]) -> Float[Array, "*rows"]:
    """Return atan2(sine, cosine) for any common scale of the two; zero with zero derivatives where both vanish."""
    size = lax.stop_gradient(jnp.maximum(jnp.abs(sine), jnp.abs(cosine)))
    singular = size < least_length(size.dtype)
    size = jnp.where(singular, 1, size)
    return jnp.arctan2(jnp.where(singular, 0, sine) / size, jnp.where(singular, 1, cosine) / size)


def angle_between(a: Float[Array, "*rows 3"], b: Float[Array, "*rows 3"]) -> Float[Array, "*rows"]:
    """Return the angle in [0, pi] between two vectors, atan2(|a x b|, a . b), accurate at 0 and pi; zero where one vanishes."""
    a, b = normalize(a), normalize(b)
    return signed_angle(norm(jnp.cross(a, b)), jnp.sum(a * b, axis=-1))


def positive_part(a: Float[Array, "n n *lanes"]) -> Float[Array, "n n *lanes"]:
    """Return the positive semi-definite matrices nearest to small symmetric ones: V max(Lambda, 0) V^T.

    Cyclic Jacobi rotations turn thousands of matrices at once, one a lane, until all are diagonal to rounding. Source: Golub
    and Van Loan, 8.5.
    """
    n = a.shape[0]
    pairs = [(p, q) for p in range(n) for q in range(p + 1, n)]
    eye = jnp.broadcast_to(jnp.eye(n, dtype=a.dtype).reshape(n, n, *(1,) * (a.ndim - 2)), a.shape)
    size = jnp.max(jnp.abs(a), axis=(0, 1))
    scale = jnp.where(size > 0, size, 1)
    rounding = jnp.finfo(a.dtype).eps

    def unfinished(state):
        matrices, _, count = state
        beside = jnp.stack([jnp.abs(matrices[p, q]) for p, q in pairs])
        return jnp.any(~(beside <= rounding)) & (count < SWEEPS)

    def sweep(state):
        m = {(i, j): state[0][i, j] for i in range(n) for j in range(i, n)}
        v = {(i, j): state[1][i, j] for i in range(n) for j in range(n)}

        def at(i, j):
            return (i, j) if i <= j else (j, i)

        for p, q in pairs:
            off = m[p, q]
            none = jnp.abs(off) <= rounding  # what is done stays as it is, whatever its neighbours still need
            ratio = (m[q, q] - m[p, p]) / (2 * jnp.where(none, 1, off))
            t = jnp.where(none, 0, jnp.where(ratio >= 0, 1, -1) / (jnp.abs(ratio) + jnp.sqrt(ratio * ratio + 1)))
            c = 1 / jnp.sqrt(t * t + 1)
            s = t * c
            m[p, p], m[q, q], m[p, q] = m[p, p] - t * off, m[q, q] + t * off, jnp.zeros_like(off)
            for r in range(n):
                if r not in (p, q):
                    x, y = m[at(r, p)], m[at(r, q)]
                    m[at(r, p)], m[at(r, q)] = c * x - s * y, s * x + c * y
                x, y = v[r, p], v[r, q]
                v[r, p], v[r, q] = c * x - s * y, s * x + c * y
        return (
            jnp.stack([jnp.stack([m[at(i, j)] for j in range(n)]) for i in range(n)]),
            jnp.stack([jnp.stack([v[i, j] for j in range(n)]) for i in range(n)]),
            state[2] + 1,
        )

    values, vectors, _ = lax.while_loop(unfinished, sweep, (a / scale[None, None], eye, jnp.zeros((), jnp.int32)))
    kept = [jnp.maximum(values[k, k], 0) * scale for k in range(n)]
    return jnp.stack(
        [jnp.stack([sum(vectors[i, k] * kept[k] * vectors[j, k] for k in range(n)) for j in range(n)]) for i in range(n)]
    )

"""Norms, directions and angles whose value, first and second derivative are finite everywhere.

Each function masks its *input*, row by row, before the singular operation, so that a singular row neither spoils its own
derivatives nor those of its neighbours (`tests/test_numerics.py`).
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

__all__ = ["angle_between", "norm", "normalize", "signed_angle"]


def _least(dtype):
    """Length in the unit of the argument; under it a second derivative 1/length^2 nears the end of the range of the type."""
    return 1e-12 if dtype == jnp.float32 else 1e-100


def norm(x: Float[Array, "*rows n"]) -> Float[Array, "*rows"]:
    """Euclidean length of the last axis; zero with zero derivatives where the row vanishes."""
    square = jnp.sum(x * x, axis=-1)
    singular = square < _least(x.dtype) ** 2
    return jnp.where(singular, 0, jnp.sqrt(jnp.where(singular, 1, square)))


def normalize(x: Float[Array, "*rows n"]) -> Float[Array, "*rows n"]:
    """Unit vector along the last axis; zero with zero derivatives where the row vanishes."""
    # A direction does not depend on scale, so the scale is a constant to the derivative, and no power of it leaves the range.
    size = lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True))
    singular = size < _least(x.dtype)
    x = jnp.where(singular, 1, x) / jnp.where(singular, 1, size)
    return jnp.where(singular, 0, x * jnp.sum(x * x, axis=-1, keepdims=True) ** -0.5)


def signed_angle(sine: Float[Array, "*rows"], cosine: Float[Array, "*rows"]) -> Float[Array, "*rows"]:
    """atan2(sine, cosine) for any common scale of the two; zero with zero derivatives where both vanish."""
    size = lax.stop_gradient(jnp.maximum(jnp.abs(sine), jnp.abs(cosine)))
    singular = size < _least(size.dtype)
    size = jnp.where(singular, 1, size)
    return jnp.arctan2(jnp.where(singular, 0, sine) / size, jnp.where(singular, 1, cosine) / size)


def angle_between(a: Float[Array, "*rows 3"], b: Float[Array, "*rows 3"]) -> Float[Array, "*rows"]:
    """Angle in [0, pi] between two vectors by atan2(|a x b|, a . b), accurate at 0 and at pi; zero where one vanishes."""
    a, b = normalize(a), normalize(b)
    return signed_angle(norm(jnp.cross(a, b)), jnp.sum(a * b, axis=-1))

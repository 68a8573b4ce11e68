"""Norms, directions and angles whose value, first and second derivative are finite everywhere.

Each function masks its *input*, row by row, before the singular operation, so that a singular row neither spoils its own
derivatives nor those of its neighbours (`tests/test_numerics.py`).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["angle_between", "norm", "normalize", "signed_angle"]


def _singular(square):
    """Where the second derivative of a square root, of size square**(-3/2), would leave the range of the type.

    In float32 that is a length under 1e-12, in float64 one under 1e-100, in the unit of the argument.
    """
    return square < (1e-24 if square.dtype == jnp.float32 else 1e-200)


def norm(x: Float[Array, "*rows n"]) -> Float[Array, "*rows"]:
    """Euclidean length of the last axis; zero with zero derivatives where the row vanishes."""
    square = jnp.sum(x * x, axis=-1)
    singular = _singular(square)
    return jnp.where(singular, 0, jnp.sqrt(jnp.where(singular, 1, square)))


def normalize(x: Float[Array, "*rows n"]) -> Float[Array, "*rows n"]:
    """Unit vector along the last axis; zero with zero derivatives where the row vanishes."""
    square = jnp.sum(x * x, axis=-1, keepdims=True)
    singular = _singular(square)
    return jnp.where(singular, 0, x) * jnp.where(singular, 1, square) ** -0.5


def signed_angle(sine: Float[Array, "*rows"], cosine: Float[Array, "*rows"]) -> Float[Array, "*rows"]:
    """atan2(sine, cosine) for any common scale of the two; zero with zero derivatives where both vanish."""
    singular = _singular(sine * sine + cosine * cosine)
    return jnp.arctan2(jnp.where(singular, 0, sine), jnp.where(singular, 1, cosine))


def angle_between(a: Float[Array, "*rows 3"], b: Float[Array, "*rows 3"]) -> Float[Array, "*rows"]:
    """Angle in [0, pi] between two vectors by atan2(|a x b|, a . b), accurate at 0 and at pi."""
    return signed_angle(norm(jnp.cross(a, b)), jnp.sum(a * b, axis=-1))

"""Vectors stored by component, as three arrays (structure of arrays): elements and poses fill the processor's vector lanes.

As in `numerics`, values and first and second derivatives are finite everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ncs_jax.geometry.numerics import least_length

__all__ = ["Vector", "cross", "direction", "dot", "length", "minus", "plus", "times"]

Vector = Sequence[Array] | Array  # three components: arrays of any one shape, or one array with them first


def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return [p + q for p, q in zip(a, b, strict=True)]


def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return [p - q for p, q in zip(a, b, strict=True)]


def times(scale: Array, a: Vector) -> Vector:
    """Return scale a."""
    return [scale * p for p in a]


def dot(a: Vector, b: Vector) -> Array:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def length(a: Vector) -> Array:
    """Return |a|; zero with zero derivatives where the vector vanishes."""
    square = dot(a, a)
    singular = square < least_length(square.dtype) ** 2
    return jnp.where(singular, 0, jnp.sqrt(jnp.where(singular, 1, square)))


def direction(a: Vector) -> Vector:
    """Return a / |a|; zero with zero derivatives where the vector vanishes."""
    # A direction does not depend on scale, so the scale is a constant to the derivative, and no power of it leaves the range.
    size = lax.stop_gradient(jnp.maximum(jnp.maximum(jnp.abs(a[0]), jnp.abs(a[1])), jnp.abs(a[2])))
    singular = size < least_length(size.dtype)
    a = [jnp.where(singular, 1, p) / jnp.where(singular, 1, size) for p in a]
    scale = jnp.where(singular, 0, dot(a, a) ** -0.5)
    return times(scale, a)

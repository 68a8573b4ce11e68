"""How many times a surface encloses a point: inside or outside, also where the surface has holes or its folds are crossed."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = ["winding_number"]


def winding_number(
    x: Float[Array | np.ndarray, "points 3"], triangles: Float[Array | np.ndarray, "faces 3 3"]
) -> Float[Array | np.ndarray, "points"]:
    """Return how many times a surface encloses each point: 1 within a closed one, 0 outside; where it is open, by how much.

    The sum of the triangles' solid angles, w = sum_f 2 atan2(a . (b x c), |a||b||c| + (a . b)|c| + (b . c)|a| + (c . a)|b|) /
    (4 pi), with a, b, c from the point to the corners. It jumps on the surface itself, and is not to be derived. All pairs of
    points and triangles are held at once. Arrays are of NumPy or of JAX; m.

    Sources: van Oosterom and Strackee 1983; Jacobson et al. 2013.
    """
    numbers = jnp if isinstance(x, jax.Array) else np
    dot = functools.partial(numbers.einsum, "pfi,pfi->pf")
    a, b, c = (triangles[None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = (numbers.sqrt(dot(p, p)) for p in (a, b, c))
    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return numbers.sum(numbers.arctan2(dot(a, numbers.cross(b, c)), below), axis=-1) / (2 * np.pi)

"""How deep cloth is inside a body: by a compiled program of many frames, and on the host, which compiles nothing, of a few."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.contact.distance import nearest_distance
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.geometry.surface_distance import border_of, signed_distance
from ncs_jax.geometry.winding_number import winding_number

__all__ = ["CLEAR", "depths_in", "depths_on_host"]

DEEPEST = 128  # points of a frame that are asked a second time whether they are inside
CLEAR = 0.02  # m; on the host, cloth that is farther outside the nearest vertex's tangent plane is taken to be so far outside


def depths_in(
    x: Float[Array, "points 3"], body: Float[Array, "body 3"], surface: Surface, layered: bool
) -> Float[Array, "points"]:
    """Return how deep points are inside a body, m, negative outside, by exact point-triangle distance.

    With garments worn below (`layered`) a crease may be folded by a little more than 180 degrees, and the pseudo-normal there
    points inward. The deepest points are therefore asked a second time: only what the body also encloses is inside.
    """
    depth = -nearest_distance(x, body, surface)
    if not layered:
        return depth
    deepest, at = lax.top_k(depth, min(DEEPEST, len(depth)))
    inside = winding_number(x[at], body[surface.faces]) > 0.5
    return depth.at[at].set(jnp.where(inside, deepest, -jnp.abs(deepest)))


def depths_on_host(x: np.ndarray, body: np.ndarray, faces: np.ndarray, *, layered: bool) -> np.ndarray:
    """Return what `depths_in` does for frames of points (frames, N, 3) and bodies (frames, B, 3), m: (frames, N).

    It is exact and in float64; what is `CLEAR` of the body is told to be just so far outside.
    """
    border, depths = border_of(faces, body.shape[1]), []
    for points, skin in zip(np.asarray(x, np.float64), np.asarray(body, np.float64), strict=True):
        depth = -signed_distance(points, skin, faces, border, CLEAR)
        if layered:
            at = np.argsort(-depth)[:DEEPEST]
            inside = winding_number(points[at], skin[faces]) > 0.5
            depth[at] = np.where(inside, depth[at], -np.abs(depth[at]))
        depths.append(depth)
    return np.stack(depths)

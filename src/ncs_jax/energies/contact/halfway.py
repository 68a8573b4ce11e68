"""The body's vertex half way between others, looked up in space as the body was built: what a point of cloth touches."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

__all__ = ["Halfway", "halfway_from", "looked_up"]

CELLS = 1 << 18  # of the table, at most
FINENESS = 0.7  # of a cell, in mean distances of a vertex of the body from the next


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Halfway:
    """The nearest of the resting body's vertices to every cell of space around it."""

    rest: Float[Array, "body 3"]  # m
    low: Float[Array, "3"]  # m: corner of the first cell
    size: Float[Array, ""]  # m: of a cell
    nearest: Int[Array, "columns rows layers"]


def halfway_from(body: np.ndarray) -> Halfway:
    """Return the table of a resting body (body, 3), m."""
    from scipy.spatial import cKDTree

    body = np.asarray(body, np.float64)
    tree, low, extent = cKDTree(body), body.min(axis=0), np.ptp(body, axis=0)
    apart = float(np.mean(tree.query(body, k=2)[0][:, 1])) if len(body) > 1 else 0.0
    size = max(FINENESS * apart, 1e-6)
    while np.prod(shape := (extent // size).astype(int) + 1) > CELLS:
        size *= 1.05
    centres = [low[i] + size * (np.arange(shape[i]) + 0.5) for i in range(3)]
    grid = np.stack(np.meshgrid(*centres, indexing="ij"), axis=-1)
    nearest = tree.query(grid)[1].astype(np.int32)
    rest, corner, width = (jnp.asarray(a, jnp.float32) for a in (body, low, size))
    return Halfway(rest, corner, width, jax.device_put(nearest))


def looked_up(table: Halfway, place: list[Float[Array, "points poses"]]) -> Int[Array, "points poses"]:
    """Return the resting body's vertex nearest to the cell of a place, three components, m; of the next one outside."""
    cell, shape = jnp.zeros(place[0].shape, jnp.int32), table.nearest.shape
    for i in range(3):
        at = ((place[i] - table.low[i]) / table.size).astype(jnp.int32)
        cell = cell * shape[i] + jnp.clip(at, 0, shape[i] - 1)
    return table.nearest.reshape(-1).at[cell].get(mode="promise_in_bounds")

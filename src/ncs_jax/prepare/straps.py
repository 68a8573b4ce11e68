"""How high straps and shoulder seams carry a garment: the cloth that lies over skin that faces up decides it."""

from __future__ import annotations

import numpy as np

from ncs_jax.geometry.mesh import topology, with_middles
from ncs_jax.geometry.surface_distance import border_of, distance_and_direction
from ncs_jax.io.records import BodyRecord

__all__ = ["lift_to_rest"]

UPPER = 0.3  # of the garment's height: straps are looked for in so much of it, from the top
UPWARD = 0.6  # least cosine between up and the direction away from the skin, where it carries cloth
REACH = 0.04  # of the body's height: cloth that is nearer may be carried
REST = 0.003  # of the body's height: cloth that is carried is so far from the skin where it is nearest
FEW = 4  # points of cloth over either shoulder, at least
ROUNDS, CLOSE = 12, 0.0003  # steps of the search, and of the body's height: to how much it is found


def lift_to_rest(x: np.ndarray, faces: np.ndarray, body: BodyRecord) -> float | None:
    """Return by how much a garment is lifted, m, negative for lowered, to rest on what faces up: on both shoulders.

    Vertices and middles of edges of its upper part are looked at, because a strap is narrow and its edges long. It rests where
    that which is nearest to skin that faces up, on either side of the body's middle, is `REST` from it.

    Args:
        x: vertices (V, 3) near their place, m. faces: triangles (F, 3).

    Returns: the lift; None where there is no cloth over such skin on both sides, or no such height nearby.
    """
    tall, middle = float(np.ptp(body.vertices, axis=0).max()), float(np.median(body.vertices[:, 0]))
    points = with_middles(x, topology(faces)[0])
    points = points[points[:, 1] > x[:, 1].max() - UPPER * np.ptp(x[:, 1])]
    rim, lift = border_of(body.faces, len(body.vertices)), 0.0
    for _ in range(ROUNDS):
        distance, away = distance_and_direction(points + [0, lift, 0], body.vertices, body.faces, rim)
        over = (away[:, 1] > UPWARD) & (np.abs(distance) < REACH * tall)
        left = points[:, 0] > middle
        if min((over & left).sum(), (over & ~left).sum()) < FEW:
            return None
        short = REST * tall - float(distance[over].min())
        if abs(short) < CLOSE * tall:
            return lift
        lift += short
        if abs(lift) > 2 * REACH * tall:
            return None
    return None

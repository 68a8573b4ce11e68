"""The curve skeleton of a mesh: lines in the middle of its limbs, for a body that has no bones of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ncs_jax.geometry.mesh import topology
from ncs_jax.io.records import BodyRecord

__all__ = ["with_curve_skeleton"]

BAND = 1 / 50  # of the mesh's size


def with_curve_skeleton(body: BodyRecord) -> BodyRecord:
    """Return a body whose joints are the middles of rings around its limbs, each vertex on the joint of its ring.

    From the top of the largest connected part, which is alike for both sides of a person, the distance along edges is cut into
    bands. What is connected within a band is a ring around a limb, or a slice of the trunk. Each is joined to those beside it,
    as in a Reeb graph.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra
    from scipy.spatial import cKDTree

    x, edges = body.vertices.astype(np.float64), topology(body.faces)[0]
    a, b = edges.T

    def graph(kept, ends=(a, b), count=None, lengths=None):
        weights = np.ones(int(kept.sum())) if lengths is None else lengths[kept]
        return coo_array((weights, tuple(end[kept] for end in ends)), shape=(count or len(x),) * 2).tocsr()

    whole, lengths = np.ones(len(edges), bool), np.linalg.norm(x[a] - x[b], axis=1)
    part = connected_components(graph(whole), directed=False)[1]
    largest = np.flatnonzero(part == np.bincount(part).argmax())
    end = largest[x[largest, 1].argmax()]
    far = dijkstra(graph(whole, lengths=np.maximum(lengths, 1e-12)), directed=False, indices=end)
    reached = np.isfinite(far)
    band = np.floor(np.where(reached, far, -1) / (BAND * np.ptp(x, axis=0).max())).astype(int)
    ring = connected_components(graph((band[a] == band[b]) & reached[a]), directed=False)[1]
    numbers, ring[reached] = np.unique(ring[reached], return_inverse=True)
    ring[~reached] = ring[reached][cKDTree(x[reached]).query(x[~reached])[1]] if (~reached).any() else 0
    size = np.bincount(ring[reached], minlength=len(numbers))
    middle = np.stack([np.bincount(ring[reached], x[reached, i]) for i in range(3)], axis=1) / size[:, None]
    beside = (ring[a] != ring[b]) & reached[a] & reached[b]
    order, above = breadth_first_order(graph(beside, (ring[a], ring[b]), len(numbers)), ring[end], directed=False)
    place = np.empty(len(numbers), int)
    place[order] = np.arange(len(order))
    parents = np.array([-1, *place[above[order[1:]]]], np.int32)
    weights = np.zeros((len(x), len(numbers)), np.float32)
    weights[np.arange(len(x)), place[ring]] = 1
    names = tuple(f"part {k}" for k in range(len(numbers)))
    return replace(body, joints=middle[order], parents=parents, weights=weights, joint_names=names, carriers=None)

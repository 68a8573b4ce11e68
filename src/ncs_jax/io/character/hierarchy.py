"""Trees of joints or nodes, given by the parent of each: -1 for a root."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["by_depth", "lowest_common", "nearest_parents", "path_to_root"]


def path_to_root(parents: Sequence[int] | np.ndarray, node: int) -> list[int]:
    """Return a node, its parent, and so on to the root."""
    path = [node]
    while (node := int(parents[node])) >= 0:
        path.append(node)
    return path


def lowest_common(parents: Sequence[int] | np.ndarray, nodes: Sequence[int]) -> int:
    """Return the lowest node that is each of these or above it; -1 where there is none."""
    shared = path_to_root(parents, nodes[0])
    for node in nodes[1:]:
        path = set(path_to_root(parents, node))
        shared = [n for n in shared if n in path]
    return shared[0] if shared else -1


def by_depth(parents: Sequence[int] | np.ndarray, nodes: Sequence[int]) -> list[int]:
    """Return nodes sorted so that parents come before children."""
    return sorted(nodes, key=lambda n: (len(path_to_root(parents, n)), n))


def nearest_parents(parents: Sequence[int] | np.ndarray, chosen: Sequence[int]) -> np.ndarray:
    """Return the parents of chosen nodes among these (chosen,) int32: the nearest one above each, -1 where there is none."""
    number = {n: j for j, n in enumerate(chosen)}
    return np.array([next((number[n] for n in path_to_root(parents, j)[1:] if n in number), -1) for j in chosen], np.int32)

"""Regions of a moving mesh that move almost rigidly: what carries a garment where a body has no joints.

A mesh over time, x_v(t), with x_v(0) its shape at rest, is written as one that is skinned linearly to K rigid regions,

    min sum_tv |sum_k w_vk (R_k(t) x_v(0) + t_k(t)) - x_v(t)|^2,    w_vk >= 0,   sum_k w_vk = 1,   at most `MOST` of them not 0.

Contact keeps to the mesh itself. The regions tell where cloth goes that lies on it: where the search of a frame begins, what
holds a pin, and how fast skin moves along cloth. Source: Le and Deng 2012, "Smooth skinning decomposition with rigid bones".
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

__all__ = ["find_regions"]

LARGEST = 40  # regions
MOST = 4  # regions of a vertex
SEEN, FEW = 24, 1500  # frames, and vertices, in which regions are looked for
ROUNDS, LAST = 4, 2  # of weights and motions in turn; and of motions in all frames, once the weights are known
CUTS = 12  # times that regions are cut
SMALL = 12  # vertices of a region, at least
EXACT = 1e-4  # of the mesh's size: what moves so nearly as its regions is not cut further


def find_regions(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights (V, K) of a mesh's vertices and the rigid motion [R_k | t_k] (T, K, 3, 4) of its regions from frame 0.

    frames: (T, V, 3), m. A mesh that is moved as a whole has one region.
    """
    few, some = _spread(frames.shape[0], SEEN), _spread(frames.shape[1], FEW)
    seen = frames[few][:, some].astype(np.float64)
    motions = _cut(seen)
    for _ in range(ROUNDS):
        motions = _moved(seen, _weights(seen, motions), 1)
    weights = _weights(frames[few].astype(np.float64), motions)
    weights = weights[:, weights[some].max(axis=0) > 0]
    weights /= weights.sum(axis=1, keepdims=True)
    return weights, _moved(frames[:, some].astype(np.float64), weights[some], LAST)


def _spread(count: int, most: int) -> np.ndarray:
    """Return at most so many numbers below a count, spread evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _cut(frames: np.ndarray) -> np.ndarray:
    """Return the motions (T, K, 3, 4) of regions that each vertex belongs to one of: the worst are cut until all fit."""
    rest, size = frames[0], np.ptp(frames[0], axis=0).max()
    owner = np.zeros(len(rest), int)
    for last in (*range(CUTS), -1):
        for _ in range(3):
            motions = _fitted(frames, np.eye(owner.max() + 1)[owner])
            misfit = _misfit(frames, motions)
            owner = misfit.argmin(axis=1)
            counts = np.bincount(owner, minlength=misfit.shape[1])
            kept = np.flatnonzero(counts >= min(SMALL, len(rest)))
            owner = misfit[:, kept].argmin(axis=1)
        own = misfit[:, kept][np.arange(len(rest)), owner]
        total = np.bincount(owner, own)
        wide = [k for k in np.argsort(-total) if own[owner == k].max() > (EXACT * size) ** 2 and (owner == k).sum() > 4 * SMALL]
        room = min(LARGEST - len(kept), max(1, len(kept) // 2))
        if not wide or room <= 0 or last < 0:
            break
        for k in wide[:room]:
            inner = np.flatnonzero(owner == k)
            worst = rest[inner[own[inner].argmax()]]
            near = inner[np.argsort(np.sum((rest[inner] - worst) ** 2, axis=1))[: max(SMALL, len(inner) // 4)]]
            owner[near] = owner.max() + 1
    return _fitted(frames, np.eye(owner.max() + 1)[owner])


def _fitted(frames: np.ndarray, weights: np.ndarray, targets: np.ndarray | None = None) -> np.ndarray:
    """Return the rigid motions (T, K, 3, 4) that take weighted vertices from rest nearest to their places (Kabsch 1976).

    weights: (V, K). targets: (T, V, 3), where there is one region: w^2 (place - others), with weights w^2.
    """
    rest = frames[0]
    total = weights.sum(axis=0)
    middle = weights.T @ rest / total[:, None]
    pulled = np.einsum("vk,tva->tka", weights, frames) if targets is None else targets.sum(axis=1)[:, None]
    place = pulled / total[:, None]
    if targets is None:
        spread = np.einsum("vk,va,tvb->tkab", weights, rest, frames, optimize=True)
    else:
        spread = np.einsum("va,tvb->tab", rest, targets)[:, None]
    spread = spread - np.einsum("ka,tkb->tkab", middle, pulled)
    left, _, right = np.linalg.svd(spread)
    flip = np.ones((*spread.shape[:2], 3))
    flip[..., 2] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    turn = np.einsum("tkca,tkc,tkbc->tkab", right, flip, left)
    return np.concatenate([turn, (place - np.einsum("tkab,kb->tka", turn, middle))[..., None]], axis=-1)


def _placed(rest: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Return where regions take all vertices (T, K, V, 3)."""
    return np.einsum("tkab,vb->tkva", motions[..., :3], rest, optimize=True) + motions[:, :, None, :, 3]


def _misfit(frames: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Return how far each region's motion takes each vertex from its place (V, K): the mean square over frames, m^2."""
    found = np.zeros((frames.shape[1], motions.shape[1]))
    for x, each in zip(frames, motions, strict=True):
        found += np.sum((np.einsum("kab,vb->vka", each[..., :3], frames[0]) + each[..., 3] - x[:, None]) ** 2, axis=-1)
    return found / len(frames)


def _weights(frames: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Return the weights (V, K) with which regions of known motion fit each vertex best.

    Of the `MOST` regions that fit best by themselves, all subsets are tried. With r_k(t) a region's residual, G = sum_t r r^T:
    min w^T G w with sum w = 1 is w = G^-1 1 / (1^T G^-1 1).
    """
    verts, count = frames.shape[1], motions.shape[1]
    near = np.argsort(_misfit(frames, motions), axis=1, kind="stable")[:, :MOST]
    most = near.shape[1]
    gram = np.zeros((verts, most, most))
    for x, each in zip(frames, motions, strict=True):
        there = np.einsum("vkab,vb->vka", each[near][..., :3], frames[0]) + each[near][..., 3] - x[:, None]
        gram += there @ np.swapaxes(there, 1, 2)
    gram += 1e-9 * np.ptp(frames[0], axis=0).max() ** 2 * np.eye(most)
    best, chosen = np.full(verts, np.inf), np.zeros((verts, most))
    for size in range(1, most + 1):
        for subset in map(list, combinations(range(most), size)):
            own = gram[:, subset][:, :, subset]
            w = np.linalg.solve(own, np.ones((verts, size, 1)))[..., 0]
            w /= w.sum(axis=1, keepdims=True)
            cost = np.einsum("vi,vij,vj->v", w, own, w)
            better = (w.min(axis=1) >= 0) & (cost < best)
            best[better], chosen[better] = cost[better], 0
            chosen[np.ix_(better, subset)] = w[better]
    weights = np.zeros((verts, count))
    np.put_along_axis(weights, near, chosen, axis=1)
    return weights


def _moved(frames: np.ndarray, weights: np.ndarray, rounds: int) -> np.ndarray:
    """Return the motions (T, K, 3, 4) of regions with known weights: one after the other is fitted to what the others leave."""
    rest, count = frames[0], weights.shape[1]
    motions = _fitted(frames, np.maximum(weights, 1e-12))
    parts = [w[:, None] * _placed(rest, motions[:, k : k + 1])[:, 0] for k, w in enumerate(weights.T)]
    left = frames - sum(parts, start=np.zeros_like(frames))
    for _ in range(rounds):
        for k in range(count):
            w = weights[:, k]
            if not w.any():
                continue
            left = left + parts[k]
            motions[:, k] = _fitted(frames, w[:, None] ** 2, left * w[:, None])[:, 0]
            parts[k] = w[:, None] * _placed(rest, motions[:, k : k + 1])[:, 0]
            left = left - parts[k]
    return motions

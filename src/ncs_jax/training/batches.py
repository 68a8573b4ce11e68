"""Which frames training takes at each step: pure functions of seed and step, so that a resumed run sees the same."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

__all__ = ["CHUNK", "batches", "chunks", "focused", "whole_chunks"]


CHUNK = 10  # steps in one compiled scan; checkpoints fall on its multiples


def batches(frames: int, batch: int, seed: int, first: int, count: int) -> np.ndarray:
    """Return the last frames of the windows of steps first .. first + count, (count, batch): each once a round, shuffled.

    A pure function of its arguments, so that a resumed run sees what an unbroken one would have seen.
    """
    wanted = np.arange(first * batch, (first + count) * batch)
    rounds = wanted // frames
    shuffled = {r: np.random.default_rng([seed, int(r)]).permutation(frames) for r in np.unique(rounds)}
    picked = np.stack([shuffled[r][i] for r, i in zip(rounds, wanted % frames, strict=True)])
    return picked.reshape(count, batch).astype(np.int32)


def focused(
    ends: np.ndarray, last: np.ndarray, weight: np.ndarray, share: float, seed: int, first: int, stream: int = 4
) -> np.ndarray:
    """Return the last frames of the windows of some steps (count, batch), a share of which are drawn anew by their weight.

    A pure function of its arguments, as `batches`. last, weight: (frames,) all of these frames, and how likely each is. stream:
    of random numbers; another one where others are drawn anew.
    """
    found, many = ends.copy(), round(share * ends.shape[1])
    for i, row in enumerate(found):
        rng = np.random.default_rng([seed, stream, first + i])
        row[rng.permutation(len(row))[:many]] = rng.choice(last, many, p=weight / weight.sum())
    return found


def whole_chunks(steps: int) -> int:
    """Return the next multiple of CHUNK."""
    return -(-steps // CHUNK) * CHUNK


def chunks(first: int, steps: int) -> Iterator[tuple[int, int]]:
    """Yield (first step, count) of every chunk up to `steps`, cut at the multiples of CHUNK wherever a run resumes."""
    while first < steps:
        upto = min((first // CHUNK + 1) * CHUNK, steps)
        yield first, upto - first
        first = upto

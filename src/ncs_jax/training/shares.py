"""Shares of many motions: as many frames as training looks at between two checkpoints, pure functions of seed and number.

Motions of more than `SHARE` frames in all are cut into pieces. A round deals all pieces out to shares of equal size, shuffled.
Training takes one share after another, and keeps features, bodies and swings of that share alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

__all__ = ["Shares", "Stretch", "shares_of"]

SHARE = 4096  # frames; the motions of a scene that has no more are kept whole
PIECE = 256  # frames of a piece, at most
LEAD = 30  # frames in front of a piece, at least, in which its windows and its swing begin


class Stretch(NamedTuple):
    """Frames first to stop - 1 of a motion, by its number; of these, no window ends at the first `lead`."""

    motion: int
    first: int
    stop: int
    lead: int


@dataclass(frozen=True)
class Shares:
    """Pieces of motions, and how many shares a round deals them out to. No share has more than `size` frames."""

    pieces: tuple[Stretch, ...]
    count: int
    size: int

    def share(self, seed: int, number: int) -> list[Stretch]:
        """Return the pieces of a share, in their order; shares number 0 to count - 1 are the first round."""
        turn, part = divmod(number, self.count)
        order = np.random.default_rng([seed, 2, turn]).permutation(len(self.pieces))
        frames = np.array([piece.stop - piece.first for piece in self.pieces])
        before = np.cumsum(frames[order]) - frames[order]
        return [self.pieces[i] for i in np.sort(order[before * self.count // frames.sum() == part])]

    def spread(self) -> list[Stretch]:
        """Return pieces that are evenly spread over all motions, from the first on, of about as many frames as a share."""
        some = np.linspace(0, len(self.pieces) - 1, max(1, len(self.pieces) // self.count)).round().astype(int)
        chosen = [self.pieces[i] for i in np.unique(some)]
        frames = np.cumsum([piece.stop - piece.first for piece in chosen])
        return chosen[: int(np.searchsorted(frames, self.size, side="right"))]


def shares_of(lengths: Sequence[int], window: int) -> Shares | None:
    """Return the shares of motions of so many frames each; None where they are few enough to be kept whole.

    Args:
        window: frames that a window looks back at.
    """
    lead = max(LEAD, window - 1)
    most = max(PIECE, 4 * lead)
    share = max(SHARE, 8 * (most + lead))
    if sum(lengths) <= share:
        return None
    pieces = []
    for motion, length in enumerate(lengths):
        cuts = np.linspace(0, length, -(-length // most) + 1).round().astype(int).tolist()
        pieces += [Stretch(motion, max(0, a - lead), b, min(lead, a)) for a, b in pairwise(cuts)]
    frames = [piece.stop - piece.first for piece in pieces]
    count = -(-sum(frames) // (share - max(frames)))
    return Shares(tuple(pieces), count, -(-sum(frames) // count) + max(frames))

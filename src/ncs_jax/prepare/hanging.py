"""Where a skirt or a strapless dress hangs: its upper opening beside the sections of the trunk, height by height."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_jax.io.records import BodyRecord

__all__ = ["ANGLES", "CENTRED", "RAYS", "SHAPED", "Opening", "Trunk", "opening_on", "trunk_of", "upper_opening"]

ANGLES = 48  # directions in which a section is measured
STEP = 1 / 300  # of the body's height: distance of the sections
SPAN = 0.25, 0.9  # of the body's height: they are looked for between
LEVEL = 0.3  # of its width: an opening that rises by more is not horizontal
BELOW = 1 / 20  # of the trunk's height: so far below it is wider where it carries
SLIT = 0.25  # of the longest opening: a shorter one is a buttonhole
EASE = -0.002, 0.02  # of the body's height: the waist of what hangs is wider than the trunk on all sides by between these,
SHAPED, CENTRED = 0.004, 0.006  # and so far, at most, are its shape from the trunk's and, if it stays, its middle from there
USUAL, LIKE = 0.006, 0.25  # of the body's height: it is most often wider by this, and how much less that counts than its shape
APART, EQUAL = 0.012, 0.00075  # of the body's height: another place is so far off, and fits as well up to so much more misfit

_ANGLE = 2 * np.pi * np.arange(ANGLES) / ANGLES
RAYS = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)  # x and z


class Trunk(NamedTuple):
    """Horizontal sections of a trunk, m: their heights (H,) and, in each, how far it reaches in `ANGLES` directions (H, A)."""

    heights: np.ndarray
    reach: np.ndarray

    def carries(self) -> np.ndarray:
        """Return at which heights (H,) it is wider below, so that what fits around it there does not slide down."""
        girth = self.reach.mean(axis=1)
        below = np.interp(self.heights - BELOW * np.ptp(self.heights), self.heights, girth)
        return below > girth


class Opening(NamedTuple):
    """An opening beside every section of a trunk, m: height (H,), what it is wider on all sides (H,), how far its shape is from
    such a wider section, r.m.s. (H,), and the horizontal shift (H, 2) that centres it."""

    heights: np.ndarray
    ease: np.ndarray
    misfit: np.ndarray
    shift: np.ndarray

    def cost(self, tall: float) -> np.ndarray:
        """Return how badly it fits around each section (H,), m, once it is centred there; infinite where it does not."""
        fits = (self.ease > EASE[0] * tall) & (self.ease < EASE[1] * tall) & (self.misfit < SHAPED * tall)
        return np.where(fits, self.misfit + LIKE * np.abs(self.ease - USUAL * tall), np.inf)

    def farther(self, near: int, tall: float) -> float:
        """Return how much farther up than the section `near` it fits as well or better straight above or below, m; 0: nowhere.

        What stays in line must be centred there as it is: the shift counts as misfit.
        """
        off = np.linalg.norm(self.shift, axis=1)
        cost = self.cost(tall) - self.misfit + np.hypot(self.misfit, off)
        up = self.heights - self.heights[near]
        there = np.where((np.abs(up) > APART * tall) & (off < CENTRED * tall), cost, np.inf)
        other = int(there.argmin())
        return float(up[other]) if there[other] < cost[near] + EQUAL * tall else 0.0


def trunk_of(body: BodyRecord) -> Trunk:
    """Return the sections of a body around its middle, from where the legs meet to where arms that are lifted join it."""
    x, faces = body.vertices.astype(np.float64), body.faces
    low, tall, middle = x[:, 1].min(), float(np.ptp(x, axis=0).max()), np.median(x[:, [0, 2]], axis=0)
    least, most = x[faces, 1].min(axis=1), x[faces, 1].max(axis=1)
    heights, reach = [], []
    for y in np.arange(low + SPAN[0] * tall, low + SPAN[1] * tall, STEP * tall):
        for section in _sections(x, faces[(least < y) & (most >= y)], y):
            if (section.min(axis=0) < middle).all() and (section.max(axis=0) > middle).all():
                heights.append(y)
                reach.append((section @ RAYS.T).max(axis=0))
                break
    return Trunk(np.array(heights), np.reshape(reach, (-1, ANGLES)))


def _sections(x: np.ndarray, faces: np.ndarray, y: float) -> list[np.ndarray]:
    """Return the connected sections (N, 2) of triangles with a horizontal plane, the one of most points first."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    cut = (x[ends[:, 0], 1] < y) != (x[ends[:, 1], 1] < y)
    key, edge = np.unique(ends[cut, 0] * len(x) + ends[cut, 1], return_inverse=True)
    count = len(faces) + len(key)
    graph = coo_array((np.ones(len(edge)), (owner[cut], len(faces) + edge)), shape=(count, count))
    label = connected_components(graph, directed=False)[1][len(faces) :]
    a, b = x[key // len(x)], x[key % len(x)]
    points = (a + ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None] * (b - a))[:, [0, 2]]
    return sorted((points[label == part] for part in np.unique(label)), key=len, reverse=True)


def upper_opening(loops: list[np.ndarray]) -> np.ndarray | None:
    """Return that of two openings, each (N, 3), from which a tube would hang; None where there are not just two, one below the
    other, or the upper one is not about level. Buttonholes do not count."""
    lengths = [float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum()) for loop in loops]
    large = [loop for loop, length in zip(loops, lengths, strict=True) if length > SLIT * max(lengths)]
    if len(large) != 2:
        return None
    lower, upper = sorted(large, key=lambda loop: loop[:, 1].mean())
    level = np.ptp(upper[:, 1]) < LEVEL * np.ptp(upper[:, [0, 2]], axis=0).max()
    return upper if level and upper[:, 1].min() > lower[:, 1].max() else None


def opening_on(trunk: Trunk, opening: np.ndarray) -> Opening:
    """Return how an opening (N, 3) lies around each section of a trunk.

        h(a) = h_section(a) + ease - shift . (cos a, sin a) + rest(a),     misfit^2 = mean of rest(a)^2,

    h(a) is how far it reaches in the direction a, the support function of its hull, whose mean is its girth over 2 pi.
    """
    gap = (opening[:, [0, 2]] @ RAYS.T).max(axis=0) - trunk.reach
    off = gap @ RAYS * 2 / ANGLES
    rest = gap - off @ RAYS.T
    return Opening(trunk.heights, rest.mean(axis=1), rest.std(axis=1), -off)

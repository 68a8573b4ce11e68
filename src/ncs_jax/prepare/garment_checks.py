"""What a garment's mesh is made of, and whether it lies on the body: if not, the unit and axis with which it would."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import LINE, relative_heights, topology
from ncs_jax.geometry.triangle_crossings import crossing_pairs
from ncs_jax.io.mesh.axes import TURNS, upright
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.scene.spec import PhysicsSpec

__all__ = [
    "FAR",
    "TOGETHER",
    "UNITS",
    "Hole",
    "SurfaceSummary",
    "check_apart",
    "check_body_size",
    "check_on_body",
    "distance_outside",
    "doubled",
    "fine_folds",
    "summarise_surface",
]

UNITS = {
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
    1.0: "metres",
    0.1: "decimetres",
    2.54: "inches taken for metres in cm",
    2.62128: "Poser units",
    10.0: "tens of metres",
    39.37: "metres taken for inches",
    100.0: "hundreds of metres",
}  # metres a unit of a file, and its name
FAR = 0.1  # of the body's size: a garment that stands out of the body's box by more is not on the body
NEAR = 0.03  # of the body's size: one that stands out by less is
LIKELY = 3  # units that are named
LOOSE, MUCH = 0.06, 0.2  # m; cloth that is farther from the skin is loose, and so much of a garment makes it a loose one
FINE, WIDE = 0.5, 0.8  # of an edge: shorter folds pass through each other, and so long ones do not
TOGETHER = 1e-5  # m: vertices that are nearer were one, and a format or its rounding has split them
NAMED = 2  # pairs of triangles that pass through each other
SMALL = 0.12  # m: no head, hand or foot passes through a shorter opening,
FEW, SHORT = 6, 0.25  # nor is one of so few edges meant that is so much shorter than the longest


@dataclass(frozen=True)
class Hole:
    """A loop of a surface's boundary: its edges, its length and mean height, m, and whether it is a small one."""

    edges: int
    length: float
    height: float
    small: bool

    def __str__(self) -> str:
        return f"{self.edges} edges, {100 * self.length:.0f} cm around, at a height of {self.height:.2f} m"


@dataclass(frozen=True)
class SurfaceSummary:
    """A surface's number of connected components, its openings, the highest first, and its number of triangles too slim to have
    a normal."""

    components: int
    openings: tuple[Hole, ...]
    degenerate: int


def check_apart(file: str | Path, garment: GarmentRecord) -> None:
    """Raise an InputError where a garment passes through itself at rest: which triangles, and where."""
    found = crossing_pairs(garment.vertices, garment.faces)
    if not len(found):
        return
    middles = garment.vertices[garment.faces[found]].mean(axis=(1, 2))
    places = [f"{a} and {b} at ({', '.join(f'{c:.2f}' for c in at)}) m" for (a, b), at in zip(found, middles, strict=True)]
    raise InputError(
        "a garment that does not pass through itself expected", file=file, field="faces",
        value=f"{len(found)} pairs: {'; '.join(places[:NAMED])}",
        mend="bring its layers apart there in a modeller; small folds ncs fit smooths by itself",
    )  # fmt: skip


class FineFolds(NamedTuple):
    """Folds finer than triangles: their length and that of an edge, m, and the bending stiffness, N m, that widens them."""

    length: float
    edge: float
    stiffness: float


def fine_folds(x: np.ndarray, faces: np.ndarray, away: np.ndarray, physics: PhysicsSpec) -> FineFolds | None:
    """Return how loose cloth (V, 3), so far from the skin (V,), m, would pass through itself; None where it does not.

    Under its weight cloth folds at a length of (k_b / (density g))^(1/3). Where that is less than `FINE` of an edge, two
    triangles fold onto each other, and nothing but contact of the cloth with itself keeps them apart.
    """
    weight = physics.density * float(np.linalg.norm(physics.gravity))
    edges = topology(faces)[0]
    edge = float(np.median(np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)))
    length = (physics.bending.stiffness / weight) ** (1 / 3) if weight else np.inf
    if length >= FINE * edge or physics.self_contact.stiffness > 0 or np.mean(away > LOOSE) < MUCH:
        return None
    return FineFolds(length, edge, float(f"{weight * (WIDE * edge) ** 3:.1g}"))


def doubled(x: np.ndarray, faces: np.ndarray) -> int:
    """Return how many vertices (V, 3), m, lie where another one is, or within `TOGETHER` of one with which they share no edge:
    cloth comes apart there, as in files that store a vertex once for each face.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    kept, place = np.unique(x, axis=0, return_inverse=True)  # first: any number of vertices may lie at one place
    edges = np.sort(place.reshape(-1)[topology(faces)[0]], axis=1).astype(np.int64) @ [len(kept), 1]
    pairs = np.sort(cKDTree(kept).query_pairs(TOGETHER, output_type="ndarray"), axis=1)
    a, b = pairs[~np.isin(pairs @ [len(kept), 1], edges)].T
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(len(kept), len(kept)))
    return len(x) - int(connected_components(graph, directed=False)[0])


def summarise_surface(x: np.ndarray, faces: np.ndarray) -> SurfaceSummary:
    """Return what a surface is made of that `check_surface` has passed: vertices (V, 3), m, and triangles (F, 3)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    graph = coo_array((np.ones(len(half), bool), tuple(half.T)), shape=(len(x), len(x)))
    components = int(connected_components(graph, directed=False)[0])
    return SurfaceSummary(components, _openings(x, boundary_loops(faces)), int((relative_heights(x, faces) <= LINE).sum()))


def _openings(x: np.ndarray, loops: list[np.ndarray]) -> tuple[Hole, ...]:
    lengths = [float(np.linalg.norm(x[loop] - np.roll(x[loop], 1, axis=0), axis=1).sum()) for loop in loops]
    found = []
    for loop, length in zip(loops, lengths, strict=True):
        small = length < SMALL or (len(loop) <= FEW and length < SHORT * max(lengths))
        found.append(Hole(len(loop), length, float(x[loop, 1].mean()), small))
    return tuple(sorted(found, key=lambda opening: -opening.height))


def check_body_size(file: str | Path, body: BodyRecord) -> None:
    """Raise an InputError unless the body has the size of a character in metres, or about that, of a moving mesh."""
    height = np.ptp(body.vertices, axis=0).max()
    if body.frames is not None:
        if not 0.03 < height < 50:
            raise InputError(
                "a body in metres expected, 0.03 to 50 m", file=file, field="vertices", value=f"{height:.3g} m",
                mend="state its unit: scale = 0.01 below [body] for centimetres, 0.001 for millimetres",
            )  # fmt: skip
        return
    if not 0.3 < height < 5:
        raise InputError(
            "a body in metres expected, 0.3 to 5 m tall", file=file, field="vertices", value=f"{height:.3g} m",
            mend="scale it to metres",
        )  # fmt: skip


def check_on_body(file: Path, garment: GarmentRecord, body: np.ndarray, *, axis_given: bool, scale_given: bool = False) -> None:
    """Raise an InputError unless a garment has about the size of the body, lies on it, and stands upright as it does.

    The message names the unit and the axis that would bring the garment onto the body, found by the boxes around both. They
    are not applied: a box cannot tell a garment in inches from a large one, nor a dress from a doll's at the thigh, and the
    whole training depends on them. A scene file that states them means the same with every body. What the scene states is not
    guessed at, but for a unit in which it has no size of clothes.

    Args:
        file: the garment's, for errors. garment: as read. body: vertices (V, 3), m. axis_given, scale_given: the scene states
            the axis that is up, the unit, so no other is looked for.
    """
    told = scale_given, axis_given
    size, tall = np.ptp(garment.vertices, axis=0).max(), np.ptp(body, axis=0).max()
    sides = garment.vertices.min(axis=0) - body.max(axis=0), body.min(axis=0) - garment.vertices.max(axis=0)
    gap = np.maximum(*sides).max()
    if size > 3 * tall or size < tall / 30:
        raise InputError(
            f"a garment about the size of the body ({tall:.2f} m) expected", file=file, field="vertices",
            value=f"{size:.3g} m",
            mend=_mend(garment, body, (False, axis_given))
            or ("it may have another unit: mend" if scale_given else "state its unit by")
            + " garment.scale in the scene file, or bring it there by ncs fit",
        )  # fmt: skip
    if gap > FAR * tall:
        raise InputError(
            "a garment that is on the body expected", file=file, field="vertices", value=f"{gap:.2f} m apart",
            mend=_mend(garment, body, told) or "bring it there by ncs fit, or move it into the body's coordinates"
            + (", or mend garment.up" if axis_given else ", or turn its axes to Y up: garment.up"),
        )  # fmt: skip
    if not axis_given and distance_outside(garment.vertices, body) > FAR:
        raw = garment.vertices @ TURNS[garment.up].T
        better = next((up for up in TURNS if distance_outside(upright(raw, 1.0, up), body) < NEAR), "")
        if better:
            raise InputError(
                f"a garment that stands upright as the body does expected: it would with {better.upper()} up", file=file,
                field="vertices", value=f"{garment.up.upper()} up",
                mend=f'write up = "{better}" below [garment] in the scene file, or up = "{garment.up}" if it is meant so',
            )  # fmt: skip


def _mend(garment: GarmentRecord, body: np.ndarray, told: tuple[bool, bool]) -> str:
    """Return what to write into the scene file so that the garment lies on the body; empty where nothing helps.

    told: the scene states the unit, the axis. In a unit that is stated the garment may merely be beside the body.
    """
    raw = garment.vertices / garment.scale @ TURNS[garment.up].T
    for up in (garment.up,) if told[1] else dict.fromkeys((garment.up, "y", "z", "x")):
        units = (garment.scale,) if told[0] else dict.fromkeys((garment.scale, *UNITS))
        scales = [scale for scale in units if _is_within(upright(raw, scale, up), body)]
        if not scales:
            continue
        axis = [] if up == garment.up else [f'up = "{up}"']
        if told[0]:
            return f"bring it there by ncs fit, or, if its axes are others, write {axis[0]} below [garment] in the scene file"
        # As clothes surround the body, the largest is the likeliest.
        scales = [] if garment.scale in scales else sorted(scales, reverse=True)[:LIKELY]
        words = [" or ".join(UNITS[scale] for scale in scales)] if scales else []
        fields = [f"scale = {' or '.join(f'{scale:g}' for scale in scales)}"] if scales else []
        suits = ", ".join([*words, *(f"{up.upper()} up" for _ in axis)])
        which = "whichever it is" if len(scales) > 1 else "if it is so"
        guess = f"its box would suit {suits}: {which}, write {' and '.join([*fields, *axis])} below [garment]"
        return f"let ncs fit find its unit, axes and place; {guess} in the scene file"
    return ""


def _is_within(x: np.ndarray, body: np.ndarray) -> bool:
    """Tell whether points (N, 3) lie in the box around a body (V, 3), or nearly, and are not tiny beside it."""
    return distance_outside(x, body) <= FAR and np.ptp(x, axis=0).max() >= FAR * np.ptp(body, axis=0).max()


def distance_outside(x: np.ndarray, body: np.ndarray) -> float:
    """Return how far points (N, 3) stand out of the box around a body (V, 3), in sizes of the body."""
    low, high = body.min(axis=0), body.max(axis=0)
    return float(np.maximum(x.max(axis=0) - high, low - x.min(axis=0)).max() / (high - low).max())

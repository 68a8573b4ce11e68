"""A body and a garment as they meet: the nearest skin, the bones inside the body, the openings that they pass through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ncs_jax.geometry.winding_number import winding_number
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.retarget import body_names

__all__ = ["Cloth", "Skin", "beside_middle", "cloth_of", "large_loops", "pierced", "skin_of", "threaded", "wearing_faults"]

POINTS = 20000  # that stand for the skin
STEP = 1 / 80  # of the body's height: bones are followed in such steps
PLACES = 1 / 32  # of the body's height: distance of the places at which a garment is tried
CELL = 1 / 40  # of the body's height: side of a cell of the grid
FAR = 1 / 8  # of the body's height: cloth that is farther from the skin is told to be infinitely far
NAMED = 6  # joints that a fault names
WORN = 0.99  # of the length of its openings has the body in it
SMALL = 1 / 12  # of the body's height: an opening that is shorter is a buttonhole
MOSTLY, ALIKE = 0.95, 1 / 160  # of a garment's vertices; and of the body's height, a mean: what is alike left and right
OFF = np.array([1.3e-4, 0.7e-4, 2.1e-4])  # m; a bone must not run along the symmetric edges of a mesh


@dataclass(frozen=True, eq=False)
class Skin:
    """A body: points (P, 3) on its skin with normals and their tree; the pieces (S, 2, 3) of its bones that lie inside it and
    their joints (S,); places (N, 3) along bones and trunk; its height, all in m; the lowest corner of a grid around it, and in
    each of its cells (X, Y, Z) the point that is nearest to the cell's middle."""

    tree: Any
    points: np.ndarray
    normals: np.ndarray
    bones: np.ndarray
    joints: np.ndarray
    places: np.ndarray
    height: float
    corner: np.ndarray
    grid: np.ndarray

    def nearest(self, x: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance to the skin, m, side (negative inside) and the normals' cosine of points (..., 3) with normals."""
        away, index = self.tree.query(x, distance_upper_bound=FAR * self.height)
        index = np.minimum(index, len(self.points) - 1)
        there = self.normals[index]
        side = np.where(np.isfinite(away), np.sum((x - self.points[index]) * there, axis=-1), np.inf)
        return away, side, np.sum(normals * there, axis=-1)

    def roughly(self, x: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the same, to that point of the skin which is nearest to the middle of a cell of the grid."""
        cell = ((x - self.corner) / (CELL * self.height)).astype(np.int32)
        index = self.grid[tuple(np.clip(cell, 0, np.array(self.grid.shape) - 1)[..., k] for k in range(3))]
        gap, there = x - self.points[index], self.normals[index]
        return (
            np.sqrt(np.einsum("...i,...i", gap, gap)),
            np.einsum("...i,...i", gap, there),
            np.einsum("...i,...i", normals, there),
        )


@dataclass(frozen=True, eq=False)
class Cloth:
    """A garment by points (N, 3) evenly on it with outward normals; its area, the middle of its box, the volume inside it with
    its openings closed, negative if it is inside out, and its openings: the vertices of each in turn."""

    points: np.ndarray
    normals: np.ndarray
    area: float
    middle: np.ndarray
    volume: float
    loops: list[np.ndarray]


def skin_of(body: BodyRecord) -> Skin:
    """Return a body as a garment meets it."""
    from scipy.spatial import cKDTree

    points, normals, _ = _even(body.vertices, body.faces, POINTS)
    triangles = body.vertices[body.faces].astype(np.float64)
    tree, tall = cKDTree(points), float(np.ptp(body.vertices, axis=0).max())
    pieces, joints = [np.zeros((0, 2, 3))], [np.zeros(0, int)]
    for joint, start, end in _bones(body):
        count = int(np.ceil(np.linalg.norm(end - start) / (STEP * tall))) + 1
        along = start + np.linspace(0, 1, max(count, 2))[:, None] * (end - start) + OFF
        nearest = tree.query(along)[1]
        within = np.sum((along - points[nearest]) * normals[nearest], axis=1) < 0
        other = np.flatnonzero(~within)  # where thighs touch, the nearest skin is the other one's
        within[other] = winding_number(along[other], triangles) > 0.5
        kept = within[1:] & within[:-1]
        pieces.append(np.stack([along[:-1], along[1:]], axis=1)[kept])
        joints.append(np.full(int(kept.sum()), joint))
    bones = np.concatenate(pieces)
    low, high, middle = body.vertices.min(axis=0), body.vertices.max(axis=0), np.median(body.vertices, axis=0)
    trunk = np.array([[middle[0], y, middle[2]] for y in np.arange(low[1], high[1], PLACES * tall)])
    places = _thinned(np.concatenate([trunk, bones.mean(axis=1)]), PLACES * tall)
    cell, corner = CELL * tall, low - 4 * CELL * tall
    shape = [int(n) for n in np.ceil((high - low) / cell) + 8]
    middles = corner + cell * (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5)
    return Skin(tree, points, normals, bones, np.concatenate(joints), places, tall, corner, tree.query(middles)[1])


def _thinned(points: np.ndarray, least: float) -> np.ndarray:
    """Return the points without those nearer than `least` to an earlier one."""
    kept = points[:1]
    for p in points:
        if np.linalg.norm(kept - p, axis=1).min() > least:
            kept = np.vstack([kept, p])
    return kept


def _bones(body: BodyRecord) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield joint, start and end of every bone; the last of a limb ends in the middle of its skin."""
    for j, parent in enumerate(body.parents.tolist()):
        if parent >= 0:
            yield parent, body.joints[parent], body.joints[j]
        if j not in body.parents:
            own = body.vertices[body.weights.argmax(axis=1) == j]
            if len(own):
                yield j, body.joints[j], own.mean(axis=0)


def cloth_of(garment: GarmentRecord, count: int) -> Cloth:
    """Return a garment by `count` points."""
    x, faces = garment.vertices.astype(np.float64), garment.faces
    points, normals, area = _even(x, faces, count)
    low, high = x.min(axis=0), x.max(axis=0)
    loops = boundary_loops(faces)
    closed = np.concatenate([x[faces], *(_fan(x[loop[::-1]]) for loop in loops)]) - (low + high) / 2
    volume = np.einsum("ti,ti->", closed[:, 0], np.cross(closed[:, 1], closed[:, 2])) / 6
    return Cloth(points, normals * np.sign(volume), area, (low + high) / 2, float(volume), loops)


def beside_middle(x: np.ndarray, faces: np.ndarray, skin: Skin) -> float | None:
    """Return how far aside of the body's middle that of a garment is, m, vertices (V, 3); None unless both are alike left and
    right: mirrored, most of its vertices have another one within an edge, and the skin lies on itself."""
    from scipy.spatial import cKDTree

    def middle(points: np.ndarray) -> float:
        return float(points[:, 0].min() + points[:, 0].max()) / 2

    def apart(points: np.ndarray, tree) -> np.ndarray:
        return tree.query(points * [-1, 1, 1] + [2 * middle(points), 0, 0])[0]

    edge = np.linalg.norm(x[faces[:, 0]] - x[faces[:, 1]], axis=1).mean()
    if np.quantile(apart(x, cKDTree(x)), MOSTLY) > edge or apart(skin.points, skin.tree).mean() > ALIKE * skin.height:
        return None
    return middle(x) - middle(skin.points)


def pierced(x: np.ndarray, faces: np.ndarray, skin: Skin) -> list[int]:
    """Return the joints whose bones pass through triangles (F, 3) of vertices (V, 3)."""
    return sorted({int(j) for j in skin.joints[_crossing(skin.bones, x[faces])]})


def threaded(loops: list[np.ndarray], skin: Skin) -> float:
    """Return the share, by length, of openings, each (N, 3), that a bone passes through; 1 where there is none."""
    large = large_loops(loops, skin)
    passed = sum(length for loop, length in large if len(_crossing(skin.bones, _fan(loop))))
    return passed / sum(length for _, length in large) if large else 1.0


def large_loops(loops: list[np.ndarray], skin: Skin) -> list[tuple[np.ndarray, float]]:
    """Return the openings that are no buttonholes, and their lengths, m."""
    lengths = [float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum()) for loop in loops]
    return [(loop, length) for loop, length in zip(loops, lengths, strict=True) if length > SMALL * skin.height]


def _fan(loop: np.ndarray) -> np.ndarray:
    """Return triangles (N, 3, 3) from the middle of a loop (N, 3) to its edges."""
    return np.stack([loop, np.roll(loop, -1, axis=0), np.broadcast_to(loop.mean(axis=0), loop.shape)], axis=1)


def _crossing(segments: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return which segments (S, 2, 3) cross some triangle (T, 3, 3): both ends apart, and one turn about all three edges."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    found = []
    ends = np.sort(segments, axis=1)
    for i in np.flatnonzero(((ends[:, 0] <= high.max(axis=0)) & (ends[:, 1] >= low.min(axis=0))).all(axis=1)):
        a, b = segments[i]
        near = ((low <= np.maximum(a, b)) & (high >= np.minimum(a, b))).all(axis=1)
        if not near.any():
            continue
        p, q, r = (triangles[near, k] for k in range(3))
        normal = np.cross(q - p, r - p)
        apart = np.einsum("ti,ti->t", normal, a - p) * np.einsum("ti,ti->t", normal, b - p) < 0
        turns = [np.cross(u - a, v - a) @ (b - a) > 0 for u, v in ((p, q), (q, r), (r, p))]
        if (apart & (turns[0] == turns[1]) & (turns[1] == turns[2])).any():
            found.append(i)
    return np.array(found, int)


def _even(x: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return `count` points (N, 3) evenly on a surface, the normals (N, 3) of their triangles, and the area.

    The places within the triangles are a sequence of low discrepancy: additive recurrence with the powers of 1.3247...
    """
    a, b, c = (x[faces[:, k]].astype(np.float64) for k in range(3))
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1)
    steps = np.arange(count)
    at = np.minimum(np.searchsorted(np.cumsum(double), (steps + 0.5) / count * double.sum()), len(faces) - 1)
    u, v = steps * 0.7548776662466927 % 1, steps * 0.5698402909980532 % 1
    u, v = np.where(u + v > 1, [1 - u, 1 - v], [u, v])
    points = a[at] + u[:, None] * (b - a)[at] + v[:, None] * (c - a)[at]
    return points, cross[at] / np.maximum(double[at], 1e-30)[:, None], float(double.sum() / 2)


def wearing_faults(garment: GarmentRecord, body: BodyRecord) -> Iterator[tuple[str, str, str, str]]:
    """Yield why a body at rest does not wear a garment, each as what, its value, what follows, and the mend: bones that pass
    through its cloth, and openings that do not have the body in them."""
    skin, x = skin_of(body), garment.vertices.astype(np.float64)
    names, mend = body_names(body), "ncs fit finds its unit, axes and place"
    if bones := pierced(x, garment.faces, skin):
        value = ", ".join(names[j] if names else f"joint {j}" for j in bones[:NAMED])
        more = f" and {len(bones) - NAMED} more" if len(bones) > NAMED else ""
        yield "bones through the cloth at rest", value + more, "contact can push it off on no side", mend
        return
    loops = [x[loop] for loop in boundary_loops(garment.faces)]
    large = len(large_loops(loops, skin))
    if large < 2 or not len(skin.bones) or (share := threaded(loops, skin)) > WORN:
        return
    if not share:
        value = f"none of its {large} has the body in it at rest"
        yield "openings of the garment", value, "it is beside the body, or across it, and not worn", mend
    else:
        value = f"the body passes through {100 * share:.0f} % of their length at rest, not through all"
        yield "openings of the garment", value, "it is of another size than this body, or not where it is worn", mend

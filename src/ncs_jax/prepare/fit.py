"""A garment fitted to a body: placed on it, pushed out of it, pinned where nothing carries it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import adjacency, topology, with_middles
from ncs_jax.geometry.surface_distance import border_of, distance_and_direction
from ncs_jax.geometry.triangle_crossings import crossing_pairs
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.contact_detail import pieces_of
from ncs_jax.prepare.covering import Cover, contact_for, sinking
from ncs_jax.prepare.garment_checks import FAR, check_apart
from ncs_jax.prepare.garment_placement import place
from ncs_jax.prepare.placement import Placement
from ncs_jax.scene.spec import CollisionSpec

__all__ = ["PINS", "Fitted", "Room", "bring_apart", "check_length", "fit", "pins_of", "push_out", "settle"]

PINS = "pins"  # the vertex group that is written
TRIES = 12  # of bringing cloth apart
PUSHES, RINGS = 200, 6  # most rounds of pushing out; rings of vertices that follow a pushed one
YIELDS, TURNS = 25, 2  # most rounds of giving way, and how often each finds the rotations anew
FIRM, LOOSE = 2.0, 1e-3  # how strongly a vertex is drawn out of the body and held where it was, beside its edges
SLACK = 5e-4  # m; a vertex that comes no farther from the body than this still lies on it
NEAR = 0.05  # m; cloth that is nearer to the body may be carried by it
OUTWARD = 0.5  # least cosine between the cloth's normal and the direction away from the body
UPWARD = 0.6  # least cosine between up and the direction away from the body, where it carries cloth
CARRIED = 0.01  # m^2; shoulders or straps offer at least so much
BAND = 0.02  # m; height of a waistband
OVER, STRAP = 0.08, 0.05  # m; from the top of a garment so far down it lies over shoulders; half the width of a wide strap
MOST = 0.1  # m; no clearance is larger, as no thickness of a scene's collision is, nor vertices that are one farther apart


@dataclass(frozen=True)
class Fitted:
    """A garment on a body, and what was done to bring it there.

    garment: in metres and Y up and, where nothing carries it, with the group `pins`. placement: where it was found to
    belong, before it was pushed out. depth: of every vertex inside the body, before and after the push, m, negative outside.
    carried: its area that lies on what faces up, m^2. straps: whether these are what is pinned. contact: the thickness and
    stiffness of a collision that keep the skin from showing through.
    """

    garment: GarmentRecord
    placement: Placement
    depth: tuple[np.ndarray, np.ndarray]
    carried: float
    straps: bool
    contact: Cover


def fit(file: str | Path, garment: GarmentRecord, body: BodyRecord, *, clearance: float | None = None, **known) -> Fitted:
    """Bring a garment onto a body: `place` it, with what is `known` of unit, axes and place, and `settle` it there."""
    return settle(file, place(file, garment, body, **known), body, clearance=clearance)


def check_length(field: str, length: float | None) -> None:
    """Raise an InputError where a clearance, or a distance to weld within, cannot be in metres; None is none given."""
    if length is None or 0 <= length <= MOST:
        return
    meant = f": {length:g} mm is {field} {length / 1000:g}" if 0 < length <= 1000 * MOST else ""
    raise InputError(f"metres, {MOST:g} at most, expected", field=field, value=length, mend=f"metres are meant{meant}")


def settle(
    file: str | Path, placement: Placement, body: BodyRecord, *, clearance: float | None = None, pins: str = "found"
) -> Fitted:
    """Push a placed garment out of the body, and pin it. Its own group `pins` and its own weights, if any, are kept.

    Args:
        file: the garment's, for errors. placement: from `place`. clearance: least distance of every vertex from the body, m;
            None: what keeps the skin from showing between vertices, see `covering.contact_for`. pins: see `pins_of`.

    Raises:
        InputError: the place is in doubt, or the garment cannot be pushed out of the body there, or passes through itself; or
            the clearance is more than `MOST`.
    """
    check_length("--clearance", clearance)
    placement.check(file)
    placed = placement.garment
    before = placed.vertices.astype(np.float64)
    pieces, usual = None, CollisionSpec()  # the scene's that is written
    if usual.points == "auto":
        pieces = pieces_of(before, placed.faces, [body.vertices], body.faces, clearance or usual.thickness)
    sunk = sinking(before, placed.faces, body.vertices, body.faces, pieces)
    contact = contact_for(before, placed.faces, sunk, clearance, pieces)
    room = Room(before, placed.faces, body, contact.thickness)
    inside = -room.distance[: len(before)].copy()
    x = _out_of(before, placed.faces, room)
    farthest = float(np.linalg.norm(x - before, axis=1).max())
    if farthest > FAR * np.ptp(body.vertices, axis=0).max():
        check_apart(file, placed)  # what else would be told follows from it
        raise InputError(
            f"a garment around the body expected: {100 * placement.inside:.0f} % of it are inside the body, and to come out "
            f"some of it must move by {farthest:.2f} m or more", file=file, field="vertices",
            value=f"as its place {placement.options}",
            mend="look at the picture; give it the pose and size of the body in a modeller, or another place with --move",
        )  # fmt: skip
    placed = replace(placed, vertices=x.astype(placed.vertices.dtype))
    check_apart(file, placed)
    away = _away_from(body, placed.vertices)
    held, carried, straps = pins_of(placed, *away, pins)
    own = pins == "found" and PINS in placed.groups
    groups = (
        placed.groups if own else {n: g for n, g in placed.groups.items() if n != PINS} | ({PINS: held} if len(held) else {})
    )
    return Fitted(replace(placed, groups=groups), placement, (inside, -away[0]), carried, straps and not own, contact)


# --- out of the body ------------------------------------------------------------------------------------------------


def _away_from(body: BodyRecord, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distance (V,) of points (V, 3) to the body, m, and the unit vectors (V, 3) that lead away from it."""
    return distance_and_direction(x, body.vertices, body.faces, border_of(body.faces, len(body.vertices)))


class Room:
    """What vertices lack to a clearance (m) from the body, themselves or at the middles of their edges.

    A point is looked at again only where it has moved by more than what it had to spare.
    """

    def __init__(self, x: np.ndarray, faces: np.ndarray, body: BodyRecord, clearance: float):
        self.edges, self.body, self.clearance = topology(faces)[0], body, clearance
        self.seen = with_middles(x, self.edges)
        self.distance, self.away = _away_from(body, self.seen)

    def lack(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far (V,) each vertex (V, 3) has to go, m, and the unit vectors (V, 3) that lead away from the body."""
        points, count = with_middles(x, self.edges), len(x)
        gone = np.linalg.norm(points - self.seen, axis=1)
        again = np.flatnonzero((gone > 0) & (self.distance - gone < self.clearance))
        if again.size:
            self.seen[again] = points[again]
            self.distance[again], self.away[again] = _away_from(self.body, points[again])
        lacks = np.maximum(self.clearance - self.distance, 0)
        short = lacks[:count].copy()
        np.maximum.at(short, self.edges, lacks[count:, None])
        return short, self.away[:count]


def _out_of(x: np.ndarray, faces: np.ndarray, room: Room) -> np.ndarray:
    """Return vertices (V, 3) out of the body and apart from each other: it gives way, unless that brings it through itself."""
    starts = [x]
    if not len(crossing_pairs(x, faces)):  # else its rest shape is no shape to keep
        starts.insert(0, give_way(x, room))
    for start in starts:
        out = push_out(start, room)
        apart = bring_apart(out, faces, room)
        if apart is not None:
            return apart
    return out


def give_way(x: np.ndarray, room: Room) -> np.ndarray:
    """Return vertices (V, 3) drawn towards the clearance from the body, by which cloth is strained as little as can be.

        min over y, R of   sum_edges |y_j - y_i - (R_i + R_j)/2 (x_j - x_i)|^2 + `FIRM` sum_near n_i |y_i - p_i|^2

    R_i are rotations, n_i the number of edges of a vertex, p_i where it is out of the body; near are those that had to go out
    and have not left it since. Rounds alternate between y, R and p. Not all comes out: `push_out` ends it. Where it had to be
    pushed alone, a shirt on a larger chest would be as a bowl there. Source: Sorkine and Alexa 2007, As-rigid-as-possible
    surface modeling.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu

    edges, count = room.edges, len(x)
    rows = np.arange(len(edges))
    signs = np.repeat([-1.0, 1.0], len(edges))
    along = coo_array((signs, (np.tile(rows, 2), edges.T.ravel())), shape=(len(edges), count)).tocsr()  # y_j - y_i
    ends, degree = abs(along).T.tocsr(), np.maximum(np.bincount(edges.ravel(), minlength=count), 1.0)
    laplacian, given = (along.T @ along).tocsc(), along @ x
    y, near, goal = x, np.zeros(count, bool), x.copy()
    for _ in range(YIELDS):
        short, away = room.lack(y)
        if short.max() <= 0.01 * room.clearance:
            break
        near = (near & (room.distance[:count] < room.clearance + SLACK)) | (short > 0)
        goal[near] = y[near] + short[near, None] * away[near]
        drawn = FIRM * degree * near
        solve = splu((laplacian + diags_array(drawn + LOOSE)).tocsc()).solve
        for _ in range(TURNS):
            turned = _rotations((ends @ (given[:, :, None] * (along @ y)[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3))
            wanted = np.einsum("eab,eb->ea", 0.5 * (turned[edges[:, 0]] + turned[edges[:, 1]]), given)
            y = solve(along.T @ wanted + drawn[:, None] * goal + LOOSE * y)
    return y


def _rotations(moments: np.ndarray) -> np.ndarray:
    """Return the rotation (V, 3, 3) that comes nearest to each map a -> b, of moments sum a b^T (V, 3, 3)."""
    u, _, vt = np.linalg.svd(moments)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return np.swapaxes(u @ vt, 1, 2)


def push_out(x: np.ndarray, room: Room) -> np.ndarray:
    """Return vertices (V, 3) moved so that they and the middles of edges keep the clearance from the body.

    Each round moves a vertex that is too near the body, or that ends an edge whose middle is, away from the body until it is
    not. The `RINGS` rings of vertices around it follow part of the way, so that the cloth stays smooth.
    """
    from scipy.sparse import diags_array

    around = adjacency(room.edges, len(x))
    mean = diags_array(1 / np.maximum(around.sum(axis=1), 1)) @ around
    held, own = np.zeros(len(x), bool), np.zeros(x.shape)
    far = FAR * np.ptp(room.body.vertices, axis=0).max()  # a garment pushed farther is not on the body
    for _ in range(PUSHES):
        moved = own
        for _ in range(RINGS):
            moved = np.where(held[:, None], own, mean @ moved)
        short, away = room.lack(x + moved)
        if short.max() <= 0.01 * room.clearance or np.linalg.norm(moved, axis=1).max() > far:
            break
        held |= short > 0
        own = np.where(held[:, None], moved + short[:, None] * away, 0)
    return x + moved


def bring_apart(x: np.ndarray, faces: np.ndarray, room: Room) -> np.ndarray | None:
    """Return vertices (V, 3) where cloth that passes through itself a little is smoothed until it does not.

    Each of `TRIES` rounds moves the vertices of such triangles and the rings around them to the mean of their neighbours, and
    then out of the body. Where none helps, whole parts are on each other's wrong side, and None is returned.
    """
    from scipy.sparse import diags_array

    found = crossing_pairs(x, faces)
    if not len(found):
        return x
    around = adjacency(room.edges, len(x))
    mean, moved = diags_array(1 / np.maximum(around.sum(axis=1), 1)) @ around, x
    for _ in range(TRIES):
        near = np.zeros(len(x))
        near[faces[found]] = 1
        for _ in range(RINGS // 2):
            near = np.maximum(near, (around @ near) > 0)
        for _ in range(RINGS // 2):
            moved = np.where(near[:, None] > 0, mean @ moved, moved)
        moved = push_out(moved, room)
        found = crossing_pairs(moved, faces)
        if not len(found):
            return moved
    return None


# --- pins -----------------------------------------------------------------------------------------------------------


def pins_of(
    garment: GarmentRecord, distance: np.ndarray, away: np.ndarray, where: str = "found"
) -> tuple[np.ndarray, float, bool]:
    """Return the vertices to pin so that a garment does not slide down, none if shoulders carry it; the area carried, m^2; and
    whether they are straps'.

    The body carries the upper half of the cloth where it lies on skin that faces up. If less than `CARRIED` is carried, the
    highest loop of the boundary is a waistband: it is pinned, and so is all within `BAND` of it. If all that is carried at the
    top is within `STRAP` of the boundary, it is of straps, which friction alone keeps on shoulders: they are pinned there.

    Args:
        distance, away: of the vertices (V,) to the body, m, and the unit vectors (V, 3) that lead away from it. where: what to
            pin: "found", as above, else "shoulders", "top" or "none".
    """
    from scipy.spatial import cKDTree

    x, faces = garment.vertices.astype(np.float64), garment.faces
    double = np.linalg.norm(np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]), axis=1)
    area = np.bincount(faces.ravel(), np.repeat(double / 6, 3), len(x))
    outward = vertex_normals(x, faces)
    outer = np.sum(outward * away, axis=1) > OUTWARD
    high = x[:, 1] > np.mean([x[:, 1].min(), x[:, 1].max()])
    lying = (distance < NEAR) & (away[:, 1] > UPWARD) & outer & high
    carried, loops = float(area[lying].sum()), boundary_loops(faces)
    over = np.flatnonzero(lying & (x[:, 1] > x[:, 1].max() - OVER))
    if where == "none" or not loops:
        return np.zeros(0, np.int32), carried, False
    if where == "shoulders" or (where == "found" and carried >= CARRIED):
        far, _ = cKDTree(x[np.concatenate(loops)]).query(x[over])
        narrow = where == "shoulders" or far.max(initial=0) < STRAP
        return (over if narrow else over[:0]).astype(np.int32), carried, narrow
    top = max(loops, key=lambda loop: x[loop, 1].mean())
    near, _ = cKDTree(x[top]).query(x)
    return np.flatnonzero(near <= BAND).astype(np.int32), carried, False

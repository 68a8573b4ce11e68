"""`ncs fit`: a garment brought onto a body, out of it, with pins to hang on and weights that follow the body."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.energies.contact.distance import triangle_distance
from ncs_jax.energies.contact.nearest import nearest_triangle
from ncs_jax.energies.contact.surface import Surface, surface_from
from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import topology
from ncs_jax.io.mesh.axes import TURNS, upright
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.garment_checks import FAR, UNITS, stray
from ncs_jax.prepare.skinning_weights import transfer_weights

__all__ = ["PINS", "Fitted", "fit", "pins_of", "place", "push_out", "spread_weights"]

PINS = "pins"
TURNS_OUT, RINGS = 200, 6
STAYS = 1.5  # times as ill as anywhere else a garment may fit and is not moved
NEAR = 0.05  # m from the body within which it carries cloth
LYING, SMOOTH, LEAST = 0.02, 0.03, 1e-6  # m, m, and what cloth that lies nowhere is trusted
ALIKE = 0.5  # cosine between the normals of cloth and body that face each other
UPWARD = 0.6  # cosine between the body's normal and up, where it carries cloth
CARRIED = 0.01  # m^2 that shoulders or straps offer at the least
BAND = 0.02  # m that a waistband is high


@dataclass(frozen=True)
class Fitted:
    """A garment on a body, and what was done so that it is.

    garment: in metres and Y up, with weights and, where nothing carries it, the group `pins`. before: its vertices (V, 3) in m
    when it was placed but not pushed. moved: how far it was moved, m. depth: (before, after), of every vertex in the body, m,
    negative outside. carried: m^2 of it that lie on what faces up. lying: share of the vertices that lie on the body.
    """

    garment: GarmentRecord
    before: np.ndarray
    moved: np.ndarray
    depth: tuple[np.ndarray, np.ndarray]
    carried: float
    lying: float


def fit(
    file: str | Path,
    garment: GarmentRecord,
    body: BodyRecord,
    *,
    clearance: float = 0.004,
    scale: float | None = None,
    up: str | None = None,
) -> Fitted:
    """Bring a garment onto a body; a group `pins` of its own, and its own weights, are kept.

    Args:
        file: the garment's, for errors. garment: as read. clearance: m that every vertex is kept off the body.
        scale, up: metres a unit of the file and the axis that is up in it, where they are known; else found out.

    Raises:
        InputError: no unit, no axes and no place make it lie on the body, or it cannot be pushed out of it.
    """
    placed, moved = place(file, garment, body, scale=scale, up=up)
    before = placed.vertices
    x = push_out(before, placed.faces, body, clearance)
    farthest = float(np.linalg.norm(x - before, axis=1).max())
    if farthest > FAR * np.ptp(body.vertices, axis=0).max():
        raise InputError(
            f"a garment that can be pushed out of the body expected, as placed with {placed.scale:g} m a unit and "
            f"{placed.up.upper()} up", file=file, field="vertices", value=f"{farthest:.2f} m out",
            mend="bring it onto the body by hand, or say its unit and axis with --scale and --up",
        )  # fmt: skip
    surface = surface_from(x, body.vertices, body.faces)
    placed = replace(placed, vertices=x)
    depth = tuple(-_distances(at, body, surface)[0] for at in (before, x))
    weights, lying = spread_weights(placed, body, surface)
    pins, carried = pins_of(placed, body, surface)
    groups = placed.groups if PINS in placed.groups or not len(pins) else {**placed.groups, PINS: pins}
    weights = weights if placed.weights is None else placed.weights
    return Fitted(replace(placed, groups=groups, weights=weights), before, moved, (depth[0], depth[1]), carried, lying)


# --- where it belongs -----------------------------------------------------------------------------------------------


def place(
    file: str | Path, garment: GarmentRecord, body: BodyRecord, *, scale: float | None = None, up: str | None = None
) -> tuple[GarmentRecord, np.ndarray]:
    """The garment in the unit, with the axis up and at the place where it lies on the body, and how far it was moved, m.

    What lies there as it is stays as it is. Else each unit and axis is tried, first in place, then moved to where it is
    least inside the body and nearest to it.

    Raises:
        InputError: in no unit has it the size of something worn.
    """
    found = list(_candidates(garment, body, scale, up, 5)) or list(_candidates(garment, body, scale, up, 10))
    there = [c for c in found if stray(c.vertices, body.vertices) <= FAR]
    if there:
        return there[0], np.zeros(3)
    if found:
        _, way, best = min(((*_settled(c, body), c) for c in found), key=lambda t: t[0])
        return replace(best, vertices=best.vertices + way.astype(best.vertices.dtype)), way
    raise InputError(
        "a garment about the size of the body expected, in any unit", file=file, field="vertices",
        value=f"{np.ptp(garment.vertices, axis=0).max():.3g} of its units", mend="say its unit with --scale, and --up",
    )  # fmt: skip


def _candidates(
    garment: GarmentRecord, body: BodyRecord, scale: float | None, up: str | None, least: float
) -> Iterator[GarmentRecord]:
    """In every unit and with every axis up in which it has the size of something worn, as given first.

    In another unit than that it has at least the body's size by `least`: a skirt in inches fits an arm in centimetres.
    """
    units = (scale,) if scale else dict.fromkeys((garment.scale, *UNITS))
    axes = (up,) if up else dict.fromkeys((garment.up, "y", "z", "x"))
    raw = garment.vertices / garment.scale @ TURNS[garment.up].T
    tall = np.ptp(body.vertices, axis=0).max()
    for unit in units:
        for axis in axes:
            x = upright(raw, unit, axis).astype(garment.vertices.dtype)
            given = unit == garment.scale and axis == garment.up
            if tall / (30 if given else least) <= np.ptp(x, axis=0).max() <= 1.1 * tall:
                yield replace(garment, vertices=x, scale=unit, up=axis)


def _settled(garment: GarmentRecord, body: BodyRecord) -> tuple[float, np.ndarray]:
    """How ill a garment fits the body where it fits it best, m, and how far it is moved to there, if at all.

    That is how far it is from the skin, five times as much within it, over how much the two face alike: a ring around chest and
    back may be near them, and faces elsewhere.
    """
    from scipy.optimize import minimize
    from scipy.spatial import cKDTree

    tree, normals = cKDTree(body.vertices), vertex_normals(body.vertices, body.faces)
    some = slice(None, None, max(1, len(garment.vertices) // 800))
    x, facing = garment.vertices[some], vertex_normals(garment.vertices, garment.faces)[some]
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    trunk = np.median(body.vertices, axis=0)

    def ill(way: np.ndarray) -> float:
        away, index = tree.query(x + way)
        side = np.sum((x + way - body.vertices[index]) * normals[index], axis=1)
        alike = abs(np.mean(np.sum(facing * normals[index], axis=1)))  # of one that faces inward, too
        return float(np.mean(np.where(side < 0, 5 * away, away)) / max(alike, 0.05))

    middle = (x.min(axis=0) + x.max(axis=0)) / 2
    heights = np.linspace(low[1], high[1], 25)
    starts = [np.zeros(3), *(np.array([trunk[0], y, trunk[2]]) - middle for y in heights)]
    first = min(starts, key=ill)
    best = minimize(ill, first, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6, "maxiter": 200})
    stays = ill(np.zeros(3))
    return (stays, np.zeros(3)) if stays <= STAYS * best.fun else (float(best.fun), np.asarray(best.x))


# --- out of the body ------------------------------------------------------------------------------------------------


@jax.jit
def _distance(x, body, surface: Surface):
    index, _ = nearest_triangle(x, body, surface)

    def total(x):
        distance = triangle_distance(x, body, surface, index)
        return jnp.sum(distance), distance

    (_, distance), away = jax.value_and_grad(total, has_aux=True)(x)
    return distance, away


def _distances(x: np.ndarray, body: BodyRecord, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance to the body of points (V, 3), m, and the unit vectors that lead away from it."""
    found = _distance(jnp.asarray(x, jnp.float32), jnp.asarray(body.vertices, jnp.float32), surface)
    return np.asarray(found[0], np.float64), np.asarray(found[1], np.float64)


def push_out(x: np.ndarray, faces: np.ndarray, body: BodyRecord, clearance: float) -> np.ndarray:
    """Vertices (V, 3) and middles of edges at least so far (m) from the body; the rest follows, so that it stays smooth.

    Each turn moves a vertex that is too near, or at one end of an edge that is, along the normal to where it is not, and the
    `RINGS` rings around it part of the way.
    """
    from scipy.sparse import coo_array, diags_array

    edges = topology(faces)[0]
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    around = coo_array((np.ones(len(i)), (i, j)), shape=(len(x), len(x))).tocsr()
    mean = diags_array(1 / np.maximum(around.sum(axis=1), 1)) @ around
    surface = surface_from(with_middles(x, edges), body.vertices, body.faces)
    rest, held, own = x.astype(np.float64), np.zeros(len(x), bool), np.zeros(x.shape)
    far = FAR * np.ptp(body.vertices, axis=0).max()  # beyond which it is not being pushed out of anything
    for _ in range(TURNS_OUT):
        moved = own
        for _ in range(RINGS):
            moved = np.where(held[:, None], own, mean @ moved)
        distance, away = _distances(with_middles(rest + moved, edges), body, surface)
        lacks = np.maximum(clearance - distance, 0)
        short, away = lacks[: len(x)].copy(), away[: len(x)]
        np.maximum.at(short, edges, lacks[len(x) :, None])
        if short.max() <= 0.01 * clearance or np.linalg.norm(moved, axis=1).max() > far:
            break
        held |= short > 0
        own = np.where(held[:, None], moved + short[:, None] * away, 0)
    return (rest + moved).astype(x.dtype)


def with_middles(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Vertices (V, 3), then the middles of edges (E, 2)."""
    return np.concatenate([x, x[edges].mean(axis=1)])


# --- what it hangs on, and what it follows --------------------------------------------------------------------------


def pins_of(garment: GarmentRecord, body: BodyRecord, surface: Surface) -> tuple[np.ndarray, float]:
    """Vertices to pin so that a garment does not slide down, none if it lies on shoulders; and the area that lies there, m^2.

    Cloth is carried where it lies on what faces up in its upper half. With less than `CARRIED` of it, the highest loop of
    the boundary is a waistband: it and what is within `BAND` below it are pinned.
    """
    x, faces = garment.vertices.astype(np.float64), garment.faces
    distance, away = _distances(x, body, surface)
    double = np.linalg.norm(np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]), axis=1)
    area = np.bincount(faces.ravel(), np.repeat(double / 6, 3), len(x))
    outward = vertex_normals(x, faces)
    outer = np.sum(outward * away, axis=1) > ALIKE
    high = x[:, 1] > np.mean([x[:, 1].min(), x[:, 1].max()])
    carried = float(area[(distance < NEAR) & (away[:, 1] > UPWARD) & outer & high].sum())
    loops = boundary_loops(faces)
    if carried >= CARRIED or not loops:
        return np.zeros(0, np.int32), carried
    top = max(loops, key=lambda loop: x[loop, 1].mean())
    from scipy.spatial import cKDTree

    near, _ = cKDTree(x[top]).query(x)
    return np.flatnonzero(near <= BAND).astype(np.int32), carried


def spread_weights(garment: GarmentRecord, body: BodyRecord, surface: Surface) -> tuple[np.ndarray, float]:
    """Skinning weights (V, J) that follow the body where cloth lies on it and are smooth; and the share of it that lies there.

        min_w  sum_v c_v (w_v - w_body(v))^2 + (L / l)^2 sum_(edges v-u) (w_v - w_u)^2,
        c_v = exp(-(d / L0)^2) max(n . n_body, 0)

    d is the distance to the body (m), l the mean edge, L = `SMOOTH` and L0 = `LYING`. So what hangs free between the legs goes
    along with what it hangs on and is not torn to either side. Weights are 0 to 1 and sum to 1, as a matrix of positive inverse
    makes them. Source: the matching of Abdrashitov et al. 2023, blended in here instead of cut off.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu

    x, edges = garment.vertices, topology(garment.faces)[0]
    own = transfer_weights(x, body.vertices, body.faces, body.weights)
    distance, away = _distances(x, body, surface)
    facing = np.maximum(np.sum(vertex_normals(x, garment.faces) * away, axis=1), 0)
    trust = np.exp(-((np.maximum(distance, 0) / LYING) ** 2)) * facing + LEAST
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    graph = coo_array((np.ones(len(i)), (i, j)), shape=(len(x), len(x))).tocsr()
    stiff = (SMOOTH / np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1).mean()) ** 2
    system = diags_array(trust) + stiff * (diags_array(graph.sum(axis=1)) - graph)
    weights = np.maximum(splu(system.tocsc()).solve(trust[:, None] * own), 0)
    return weights / weights.sum(axis=1, keepdims=True), float((trust > 0.5).mean())

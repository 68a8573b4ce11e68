"""A garment fitted to a body: placed on it, pushed out of it, pinned where nothing carries it, weighted to follow it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.energies.contact.distance import nearest_distance
from ncs_jax.energies.contact.surface import Surface, surface_from
from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import adjacency, topology, with_middles
from ncs_jax.io.mesh.axes import TURNS, upright
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.garment_checks import FAR, UNITS, distance_outside
from ncs_jax.prepare.skinning_weights import transfer_weights

__all__ = ["PINS", "Fitted", "fit", "pins_of", "place", "push_out", "spread_weights"]

PINS = "pins"  # the vertex group that is written
PUSHES, RINGS = 200, 6  # most rounds of pushing out; rings of vertices that follow a pushed one
KEEPS_PLACE = 1.5  # a garment is not moved unless its misfit is more than this many times that of the best place
NEAR = 0.05  # m; cloth that is nearer to the body may be carried by it
LYING, SMOOTH = 0.02, 0.03  # m; see `spread_weights`
LEAST = 1e-6  # how much the weights of cloth far from the body count
OUTWARD = 0.5  # least cosine between the cloth's normal and the direction away from the body
UPWARD = 0.6  # least cosine between up and the direction away from the body, where it carries cloth
CARRIED = 0.01  # m^2; shoulders or straps offer at least so much
BAND = 0.02  # m; height of a waistband


@dataclass(frozen=True)
class Fitted:
    """A garment on a body, and what was done to bring it there.

    garment: in metres and Y up, with weights and, where nothing carries it, the group `pins`. before: its vertices (V, 3), m,
    after it was placed and before it was pushed out. moved: by how much it was moved (3,), m. depth: of every vertex inside the
    body, before and after the push, m, negative outside. carried: its area that lies on what faces up, m^2. lying: share of its
    vertices that lie on the body.
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
    """Bring a garment onto a body. Its own group `pins` and its own weights, if it has them, are kept.

    Args:
        file: the garment's, for errors. garment: as read. clearance: least distance of every vertex from the body, m.
        scale, up: metres a unit of the file and the axis that is up in it; None: they are found.

    Raises:
        InputError: no unit, axis and place make it lie on the body, or it cannot be pushed out of the body.
    """
    placed, moved = place(file, garment, body, scale=scale, up=up)
    before = placed.vertices
    x = push_out(before, placed.faces, body, clearance)
    farthest = float(np.linalg.norm(x - before, axis=1).max())
    if farthest > FAR * np.ptp(body.vertices, axis=0).max():
        raise InputError(
            f"a garment that can be pushed out of the body expected, as placed with {placed.scale:g} m a unit and "
            f"{placed.up.upper()} up", file=file, field="vertices", value=f"{farthest:.2f} m out",
            mend="bring it onto the body by hand, or state its unit and axis with --scale and --up",
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
    """Return the garment in the unit, with the axis and at the place in which it lies on the body; and how far it moved, m.

    A garment that lies on the body as it is stays so. Else every unit and axis is tried, first without moving it, then moved to
    where it is least inside the body and nearest to it.

    Raises:
        InputError: in no unit has it the size of something worn.
    """
    found = list(_candidates(garment, body, scale, up, 5)) or list(_candidates(garment, body, scale, up, 10))
    in_place = [c for c in found if distance_outside(c.vertices, body.vertices) <= FAR]
    if in_place:
        return in_place[0], np.zeros(3)
    if found:
        _, shift, best = min(((*_best_place(c, body), c) for c in found), key=lambda t: t[0])
        return replace(best, vertices=best.vertices + shift.astype(best.vertices.dtype)), shift
    raise InputError(
        "a garment about the size of the body expected, in any unit", file=file, field="vertices",
        value=f"{np.ptp(garment.vertices, axis=0).max():.3g} of its units", mend="state unit and axis with --scale and --up",
    )  # fmt: skip


def _candidates(
    garment: GarmentRecord, body: BodyRecord, scale: float | None, up: str | None, least: float
) -> Iterator[GarmentRecord]:
    """Yield the garment in every unit and with every axis up in which it has the size of something worn; as given first.

    In a unit other than the given one it must have at least a `least`-th of the body's size: a skirt in inches would fit an arm
    if it were read in centimetres.
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


def _best_place(garment: GarmentRecord, body: BodyRecord) -> tuple[float, np.ndarray]:
    """Return the misfit of a garment where it fits the body best, m, and the shift (3,) to that place, zero if it may stay.

    The misfit is its mean distance from the skin, inside counted five times, divided by how well their normals agree: a ring
    may lie close to chest and back while it faces elsewhere.
    """
    from scipy.optimize import minimize
    from scipy.spatial import cKDTree

    tree, normals = cKDTree(body.vertices), vertex_normals(body.vertices, body.faces)
    some = slice(None, None, max(1, len(garment.vertices) // 800))
    x, facing = garment.vertices[some], vertex_normals(garment.vertices, garment.faces)[some]
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    trunk = np.median(body.vertices, axis=0)

    def misfit(shift: np.ndarray) -> float:
        away, index = tree.query(x + shift)
        side = np.sum((x + shift - body.vertices[index]) * normals[index], axis=1)
        agreement = abs(np.mean(np.sum(facing * normals[index], axis=1)))  # the garment's normals may also point inward
        return float(np.mean(np.where(side < 0, 5 * away, away)) / max(agreement, 0.05))

    middle = (x.min(axis=0) + x.max(axis=0)) / 2
    heights = np.linspace(low[1], high[1], 25)
    starts = [np.zeros(3), *(np.array([trunk[0], y, trunk[2]]) - middle for y in heights)]
    first = min(starts, key=misfit)
    best = minimize(misfit, first, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6, "maxiter": 200})
    here = misfit(np.zeros(3))
    return (here, np.zeros(3)) if here <= KEEPS_PLACE * best.fun else (float(best.fun), np.asarray(best.x))


# --- out of the body ------------------------------------------------------------------------------------------------


@jax.jit
def _distance(x, body, surface: Surface):
    def total(x):
        distance = nearest_distance(x, body, surface)
        return jnp.sum(distance), distance

    (_, distance), away = jax.value_and_grad(total, has_aux=True)(x)
    return distance, away


def _distances(x: np.ndarray, body: BodyRecord, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed distance (V,) of points (V, 3) to the body, m, and the unit vectors (V, 3) that lead away from it."""
    found = _distance(jnp.asarray(x, jnp.float32), jnp.asarray(body.vertices, jnp.float32), surface)
    return np.asarray(found[0], np.float64), np.asarray(found[1], np.float64)


def push_out(x: np.ndarray, faces: np.ndarray, body: BodyRecord, clearance: float) -> np.ndarray:
    """Return vertices (V, 3) moved so that they and the middles of edges keep the clearance (m) from the body.

    Each round moves a vertex that is too near the body, or that ends an edge whose middle is, away from the body until it is
    not. The `RINGS` rings of vertices around it follow part of the way, so that the cloth stays smooth.
    """
    from scipy.sparse import diags_array

    edges = topology(faces)[0]
    around = adjacency(edges, len(x))
    mean = diags_array(1 / np.maximum(around.sum(axis=1), 1)) @ around
    surface = surface_from(with_middles(x, edges), body.vertices, body.faces)
    rest, held, own = x.astype(np.float64), np.zeros(len(x), bool), np.zeros(x.shape)
    far = FAR * np.ptp(body.vertices, axis=0).max()  # a garment pushed farther is not on the body
    for _ in range(PUSHES):
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


# --- pins and weights -----------------------------------------------------------------------------------------------


def pins_of(garment: GarmentRecord, body: BodyRecord, surface: Surface) -> tuple[np.ndarray, float]:
    """Return the vertices to pin so that a garment does not slide down, none if shoulders carry it; and the area carried, m^2.

    The body carries the upper half of the cloth where it lies on skin that faces up. If less than `CARRIED` is carried, the
    highest loop of the boundary is a waistband: it is pinned, and so is all within `BAND` of it.
    """
    x, faces = garment.vertices.astype(np.float64), garment.faces
    distance, away = _distances(x, body, surface)
    double = np.linalg.norm(np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]), axis=1)
    area = np.bincount(faces.ravel(), np.repeat(double / 6, 3), len(x))
    outward = vertex_normals(x, faces)
    outer = np.sum(outward * away, axis=1) > OUTWARD
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
    """Return smooth skinning weights (V, J) that follow the body where cloth lies on it; and the share of vertices that do so.

        min_w  sum_v c_v (w_v - w_body(v))^2 + (L / l)^2 sum_(edges v-u) (w_v - w_u)^2,
        c_v = exp(-(d / L0)^2) max(n . n_body, 0)

    d is the distance to the body (m), l the mean edge, L = `SMOOTH` and L0 = `LYING`. So cloth that hangs free between the legs
    follows the cloth that it hangs on, and is not torn to either side. Weights are 0 to 1 and sum to 1, because the inverse of
    the system's matrix is positive. Source: the matching of Abdrashitov et al. 2023, with a smooth c_v instead of a threshold.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    x, edges = garment.vertices, topology(garment.faces)[0]
    own = transfer_weights(x, body.vertices, body.faces, body.weights)
    distance, away = _distances(x, body, surface)
    facing = np.maximum(np.sum(vertex_normals(x, garment.faces) * away, axis=1), 0)
    trust = np.exp(-((np.maximum(distance, 0) / LYING) ** 2)) * facing + LEAST
    graph = adjacency(edges, len(x))
    stiff = (SMOOTH / np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1).mean()) ** 2
    system = diags_array(trust) + stiff * (diags_array(graph.sum(axis=1)) - graph)
    weights = np.maximum(splu(system.tocsc()).solve(trust[:, None] * own), 0)
    return weights / weights.sum(axis=1, keepdims=True), float((trust > 0.5).mean())

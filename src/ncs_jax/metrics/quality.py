"""What an animation is worth, in physical quantities, frame by frame."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.bending import angles
from ncs_jax.energies.contact.intersections import intersecting
from ncs_jax.energies.contact.layers import Upper, layer_distances
from ncs_jax.energies.contact.pairs import Groups, groups_from
from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.contact.surface import Surface, surface_from
from ncs_jax.energies.elements import energies_and_gradient
from ncs_jax.energies.gravity import gravity
from ncs_jax.energies.inertia import out_of_balance
from ncs_jax.energies.membrane import deformation
from ncs_jax.energies.terms import Terms
from ncs_jax.energies.total import distances
from ncs_jax.errors import InputError, required, shaped
from ncs_jax.geometry.mesh import Mesh, corners, edge_strain, with_middles
from ncs_jax.geometry.numerics import angle_between
from ncs_jax.geometry.skinning import blend, unpose
from ncs_jax.metrics.penetration import depths_in, depths_on_host
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, resting_body, touched_body
from ncs_jax.scene.step_inputs import Past, step_inputs

__all__ = ["PARTS", "QUANTITIES", "measure", "measure_on_host", "summarise"]

# name: unit and what it is
QUANTITIES = {
    "strain_mean": ("%", "mean |l/l0 - 1| over the edges"),
    "strain_p99": ("%", "99th percentile of |l/l0 - 1| over the edges"),
    "shear_mean": ("deg", "mean deviation of warp and weft from a right angle, by area"),
    "hinge_mean": ("deg", "mean |phi - phi_rest| over the hinges"),
    "penetrating": ("%", "vertices inside the body, by exact point-triangle distance"),
    "within_1mm": ("%", "vertices inside the body or nearer to it than 1 mm"),
    "depth_max": ("mm", "deepest penetration"),
    "middle_penetrating": ("%", "edges whose middle is inside the body"),
    "middle_depth_max": ("mm", "deepest penetration of an edge's middle: skin that shows between vertices"),
    "centre_penetrating": ("%", "triangles whose centre is inside the body"),
    "centre_depth_max": ("mm", "deepest penetration of a triangle's centre"),
    "self_intersecting": ("%", "triangles that pass through another one of the garment"),
    "layer_penetrating": (
        "%",
        "vertices, and points of contact between them, of garments worn over others that are inside one of these",
    ),
    "layer_depth_max": ("mm", "deepest penetration of a garment into one that is worn below it"),
    "body_intersecting": ("%", "triangles of the garment that one of the body passes through"),
    "skin_pixels": ("px", "pixels of six views in which skin shows through the garment that covers it at rest"),
    "skin_share": ("%", "the same as a share of the pixels that show the garment, or skin through it"),
    "outside": ("%", "frames beyond the poses and speeds that the network was trained on"),
    "out_of_balance": ("g", "mass-weighted r.m.s. of M^-1 grad E, as a multiple of 9.81 m/s^2"),
    "gradient_norm": ("N", "mean length of a vertex's row of grad E"),
}

INSIDE = {"penetrating": 0.0, "within_1mm": -0.001}  # m of depth from which on a vertex counts
PARTS = ("", "middle_", "centre_")  # of a garment that may be inside: vertices, edges, triangles


class _Frames(NamedTuple):
    """Frames of an animation: the garment there and in the two frames before, m, and the joints there and before."""

    x: Float[Array, "frames verts 3"]
    previous: Float[Array, "frames verts 3"]
    before: Float[Array, "frames verts 3"]
    matrices: Float[Array, "frames joints 3 4"]
    matrices_before: Float[Array, "frames joints 3 4"]

    def seen_from_root(self) -> tuple[_Frames, Float[Array, "frames 3"]]:
        """Return the frames seen from the root joint, where single precision is finest, and where that is."""
        origin = self.matrices[:, 0, :, 3]
        x, previous, before = (a - origin[:, None] for a in self[:3])
        return _Frames(x, previous, before, *(m.at[..., 3].add(-origin[:, None]) for m in self[3:])), origin


def _shape(model: Model, x) -> dict[str, Float[Array, ""]]:
    """Strain, shear and folds of a garment."""
    mesh = model.garment.mesh
    strain = edge_strain(x, mesh)
    warp, weft = (jnp.stack(w, axis=-1) for w in deformation(x, mesh))
    shear = jnp.abs(angle_between(warp, weft) - np.pi / 2)
    bend = angles(corners(x, mesh.hinges), mesh)
    return {
        "strain_mean": 100 * jnp.mean(strain),
        "strain_p99": 100 * jnp.percentile(strain, 99),
        "shear_mean": jnp.degrees(jnp.sum(mesh.face_area * shear) / jnp.sum(mesh.face_area)),
        "hinge_mean": jnp.degrees(jnp.mean(jnp.abs(bend))),
    }


@jax.jit
def _energies_and_shape(model: Model, frames: _Frames) -> dict[str, Float[Array, "frames"]]:
    """Measure every energy, how far the garment is out of balance, and its shape."""
    mesh, terms = model.garment.mesh, model.terms

    def one(args):
        frame, origin = args
        unposed = unpose(blend(frame.matrices_before, model.blend), frame.previous) if terms.friction else None
        step = step_inputs(model, frame.matrices, Past(frame.previous, frame.before, unposed))
        parts, gradient, _ = energies_and_gradient(frame.x, model.garment, model.material, step, terms, model.surface)
        total = sum(parts.values(), start=jnp.zeros((), frame.x.dtype))
        mass = model.material.density * mesh.vertex_area
        if terms.gravity:
            lifted = gravity(origin[None], jnp.sum(mass, keepdims=True), model.material.gravity)
            total, parts = total + lifted, {**parts, "gravity": parts["gravity"] + lifted}
        left = {"out_of_balance": out_of_balance(gradient, mass), "gradient_norm": jnp.mean(jnp.linalg.norm(gradient, axis=1))}
        return {"total": total, **parts, **_shape(model, frame.x), **left}

    return lax.map(one, frames.seen_from_root())


@jax.jit
def _penetration(model: Model, surface: Surface | None, frames: _Frames) -> dict[str, Float[Array, "frames"]]:
    """Measure how much of a garment is inside the body.

    surface: the body as vertices and middles of edges and triangles look for it, by exact distance; None: by the scene's own
    query, of vertices.
    """
    mesh = model.garment.mesh
    verts, sides = len(mesh.rest), len(mesh.edges)

    def one(frame):
        x, (body, normals) = frame.x, touched_body(model, frame.matrices)
        if surface is None:
            own = required(model.surface, "model.surface")
            depth = -distances(with_points(x, own.points), body, own, model.terms, normals)[:verts]
        else:
            depth = depths_in(with_middles(x, mesh.edges, mesh.faces), body, surface, bool(model.under))
        found = {name: 100 * jnp.mean(depth[:verts] > least) for name, least in INSIDE.items()}
        for name, part in zip(PARTS, (depth[:verts], depth[verts:][:sides], depth[verts:][sides:]), strict=True):
            if part.size:
                found[f"{name}penetrating"] = 100 * jnp.mean(part > 0)
                found[f"{name}depth_max"] = 1000 * jnp.maximum(jnp.max(part), 0)
        return found

    return lax.map(one, frames.seen_from_root()[0])


@jax.jit
def _layer_depths(uppers: tuple[Upper, ...], frames: _Frames) -> dict[str, Float[Array, "frames"]]:
    """Measure how much of garments is inside others of the same mesh that are worn below them, by exact distance."""

    def one(x):
        depth = -jnp.concatenate([layer_distances(x, upper) for upper in uppers])
        return {"layer_penetrating": 100 * jnp.mean(depth > 0), "layer_depth_max": 1000 * jnp.maximum(jnp.max(depth), 0)}

    return lax.map(one, frames.seen_from_root()[0].x)


@jax.jit
def _intersections(mesh: Mesh, groups: Groups, frames: _Frames) -> dict[str, Float[Array, "frames"]]:
    """Measure how much of a garment passes through itself; NaN where the search ran out of room."""

    def one(x):
        through, overflow = intersecting(x, mesh, groups)
        return jnp.where(overflow, jnp.nan, 100 * jnp.mean(through, dtype=x.dtype))

    return {"self_intersecting": lax.map(one, frames.seen_from_root()[0].x)}


def _surface_of_all(model: Model) -> Surface:
    """Return the body as vertices and middles of edges and triangles look for it."""
    mesh = model.garment.mesh
    faces = np.asarray(required(model.surface, "model.surface").faces)
    return surface_from(np.asarray(with_middles(mesh.rest, mesh.edges, mesh.faces)), resting_body(model), faces)


_SUMMARY: dict[str, Callable[..., np.floating]] = {
    **{f"{name}depth_max": np.max for name in (*PARTS, "layer_")}, "out_of_balance": np.median,
}  # fmt: skip

BLOCK = 64  # frames measured at once, so that motions of every length share one compilation


def measure(
    model: Model,
    vertices: Float[Array | np.ndarray, "frames verts 3"],
    track: MotionFeatures,
    *,
    exact: bool = True,
    self_contact: bool | None = None,
) -> dict[str, np.ndarray]:
    """Return every quantity of `QUANTITIES` and every energy term in J, per frame, of any animation of the model's garment.

    Args:
        vertices: (frames, verts, 3) in m, from a network, a simulation or a file: of the motion's first frames, or of all.
        track: the motion it belongs to.
        exact: penetration by the exact signed distance to the body's triangles, also of the middles of edges and triangles;
            else by the scene's own query, which is faster.
        self_contact: whether to look for triangles that pass through each other; None: where the scene has self-contact.

    Energies use the scene's own terms; heights are measured from the track's origin. Before its first frame the garment is
    taken to have been at rest.

    Raises:
        InputError: the vertices are not the garment's, or there are more frames than the motion has.
    """
    count, frames = len(vertices), len(track.start)
    verts = len(model.garment.mesh.rest)
    shaped(vertices, (verts, 3), "vertices", f"the garment's {verts} vertices (frames, {verts}, 3), m,")
    if count > frames:
        raise InputError(f"at most the track's {frames} frames expected", field="vertices", value=f"{count} frames")
    positions = track.relative(np.asarray(vertices)).astype(model.basis.dtype, copy=False)
    programs: list[Callable] = [functools.partial(_energies_and_shape, model)]
    if model.surface is not None:
        # By exact distance it is the same program whatever the terms: compiled once for all scenes of these meshes.
        bare = replace(model, terms=Terms(), vibrations=None) if exact else model
        programs.append(functools.partial(_penetration, bare, _surface_of_all(model) if exact else None))
    if model.garment.uppers:
        programs.append(functools.partial(_layer_depths, model.garment.uppers))
    if model.terms.self_contact if self_contact is None else self_contact:
        mesh = model.garment.mesh
        programs.append(functools.partial(_intersections, mesh, model.garment.groups or groups_from(mesh)))

    def block(first: int) -> _Frames:
        t = np.minimum(np.arange(first, first + BLOCK), count - 1)
        x, previous, before = (jnp.asarray(positions[np.maximum(t - k, 0)]) for k in range(3))
        return _Frames(x, previous, before, track.matrices[t], track.matrices[np.maximum(t - 1, 0)])

    def measured(first: int) -> dict[str, np.ndarray]:
        rows: dict[str, np.ndarray] = {}
        frames = block(first)
        for program in programs:
            rows |= jax.device_get(program(frames))
        return rows

    first, *others = range(0, count, BLOCK)
    blocks = [measured(first)]  # compiles
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # a block keeps only one core busy
        blocks += pool.map(measured, others)
    return {name: np.concatenate([rows[name] for rows in blocks])[:count] for name in blocks[0]}


def measure_on_host(model: Model, vertices: np.ndarray, skin: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return `strain_mean`, and with a body what is inside of it, of each frame, as `measure` does; it compiles nothing.

    Args:
        vertices: (frames, verts, 3), m, such as a few frames of a motion. skin: what the garment may touch, as
            `model.surface` numbers it, in these frames (frames, body, 3), m.
    """
    mesh = model.garment.mesh
    edges, rest = np.asarray(mesh.edges), np.asarray(mesh.edge_length, np.float64)
    x = np.asarray(vertices, np.float64)
    lengths = np.linalg.norm(x[:, edges[:, 1]] - x[:, edges[:, 0]], axis=2)
    rows = {"strain_mean": 100 * np.abs(lengths / np.where(rest > 0, rest, 1) - 1).mean(axis=1)}
    if skin is None or model.surface is None:
        return rows
    depths = depths_on_host(x, skin, np.asarray(model.surface.faces), layered=bool(model.under))
    rows |= {name: 100 * (depths > least).mean(axis=1) for name, least in INSIDE.items()}
    return rows | {"penetrating": 100 * (depths > 0).mean(axis=1), "depth_max": 1000 * np.maximum(depths.max(axis=1), 0)}


def summarise(rows: dict[str, np.ndarray]) -> dict[str, float]:
    """Return means over frames or motions; the largest of depths, the median of `out_of_balance`."""
    return {name: float(_SUMMARY.get(name, np.mean)(values)) for name, values in rows.items()}

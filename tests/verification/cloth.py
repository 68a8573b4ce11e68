"""Materials, chains and sheets of the closed forms of this folder, and the minimum of their total energy."""

from __future__ import annotations

import dataclasses
from functools import cache

import jax.numpy as jnp
import numpy as np

from ncs_jax.energies.terms import Garment, Material, StepInputs, Terms
from ncs_jax.energies.total import total
from ncs_jax.geometry.mesh import Mesh, mesh_from

from .newton import minimiser

NOTHING = Terms(membrane=None, bending=False, collision=None, gravity=False, inertia=False)
DENSITY, GRAVITY = 0.15, 9.81


def material(membrane=(), bending=0.0, gravity=(0.0, -GRAVITY, 0.0), collision=0.0, thickness=0.0) -> Material:
    array = lambda a: jnp.asarray(a, jnp.float64)  # noqa: E731
    return Material(
        density=array(DENSITY),
        membrane=tuple(array(m) for m in membrane),
        bending=array(bending),
        collision=array(collision),
        thickness=array(thickness),
        friction=array(0.0),
        pinning=array(0.0),
        gravity=array(gravity),
    )


def garment(vertices, faces) -> Garment:
    return Garment(mesh_from(vertices, faces, dtype=jnp.float64), jnp.zeros(0, jnp.int32))


def chain(length: float, links: int, mass: float, *, lumped_ends: bool = True) -> Garment:
    """Springs end to end along x, of stiffness k links/length for a membrane number k, i.e. k is the tension at strain 1.

    mass: of the whole, in kg; each vertex carries that of half the links at it, or all of it the last one.
    """
    h = length / links
    triangle = mesh_from(np.eye(3), np.array([[0, 1, 2]]), dtype=jnp.float64)
    share = np.full(links + 1, 1.0 / links)
    share[[0, -1]] /= 2
    if not lumped_ends:
        share = np.zeros(links + 1)
        share[-1] = 1
    rest = np.zeros((links + 1, 3))
    rest[:, 0] = h * np.arange(links + 1)
    mesh: Mesh = dataclasses.replace(
        triangle,
        rest=jnp.asarray(rest),
        edges=jnp.stack([jnp.arange(links), jnp.arange(1, links + 1)], axis=1).astype(jnp.int32),
        edge_length=jnp.full(links, h),
        edge_weight=jnp.full(links, 1 / h),
        vertex_area=jnp.asarray(share * mass / DENSITY),
    )
    return Garment(mesh, jnp.zeros(0, jnp.int32))


@cache
def _settler(terms: Terms, places: tuple[int, ...]):
    """All that may differ from call to call is an operand, so that tests on meshes of one size share a compilation."""
    return minimiser(lambda x, cloth, numbers, frame, surface: total(x, cloth, numbers, frame, terms, surface), places)


def settle(terms: Terms, free, x, cloth: Garment, numbers: Material, frame=None, surface=None) -> np.ndarray:
    """Where the total energy is least, near x; `free` (verts, 3) or (verts, 1) bool says what may move."""
    places = tuple(np.flatnonzero(np.broadcast_to(free, np.shape(x))).tolist())
    return np.asarray(_settler(terms, places)(x, cloth, numbers, frame or StepInputs(), surface))

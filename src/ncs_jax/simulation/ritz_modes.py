"""Load-dependent Ritz vectors of a garment about its drape: the vibrations that a swing is made of."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.energies.terms import StepInputs
from ncs_jax.errors import required
from ncs_jax.geometry.laplacian_modes import modal_basis
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.numerics import normalize
from ncs_jax.geometry.skinning import blend, skin, unpose
from ncs_jax.scene.model import Model, RitzModes
from ncs_jax.scene.step_inputs import Past, step_inputs
from ncs_jax.simulation.solver.problem import (
    LEAST_STEP,
    TALL,
    Problem,
    accepts,
    evaluate,
    find_neighbours,
    share_outside_body,
    static_step,
    stiffness_blocks,
    with_neighbours,
)
from ncs_jax.simulation.solver.stiffness import Couplings, couplings_from
from ncs_jax.simulation.walk_in import FALL, SETTLE, walk_in

__all__ = ["AT_ONCE", "displacement_slopes", "softest_ritz_modes", "stiffness_in_poses"]

AT_ONCE = min(4, os.cpu_count() or 1)  # poses, each with a factor of its own in memory
AMPLITUDE = 0.05  # m: root mean square displacement of the softest direction
FREE = 5  # steps without friction, until the garment touches the body
STEPS = 60  # of Newton's method to the drape, at most
STILL = {np.dtype(np.float32): 1e-3, np.dtype(np.float64): 1e-5}  # m, r.m.s.: a Newton step this short ends the search
STICK = 30.0  # rad/s: of a vertex that is held on the body: under its own weight it slips by g / STICK^2, 11 mm
LOOSE = 1.0  # rad/s: of what nothing holds in a pose, such as a fold that slips
LEAST = 0.1  # cycles a second: what is softer than that hangs on nothing; of garments taller than `TALL` less, as of a pendulum


def _couplings(model: Model) -> Couplings:
    return couplings_from(model.garment.mesh, model.points)


def _still(model: Model, couplings: Couplings, matrices: Array) -> tuple[Problem, Array]:
    """The garment in a pose, seen from the root joint, which no past moves; and its skinning transforms."""
    model = replace(model, terms=replace(model.terms, inertia=True, friction=False, self_contact=False, layers=None))
    step, transforms = _posed(model, matrices)
    return Problem(model, couplings, None, step), transforms


@jax.jit
def _posed(model: Model, matrices: Array) -> tuple[StepInputs, Array]:
    matrices = matrices.at[:, :, 3].add(-matrices[0, :, 3])
    transforms, rest = blend(matrices, model.blend), model.garment.mesh.rest
    past = Past(rest, rest, moving=jnp.zeros((), rest.dtype))
    return step_inputs(model, matrices, past, transforms=transforms), transforms


@jax.jit
def _evaluated(problem: Problem, x, held, at):
    """The problem that knows what is near, what is known of the place, and the blocks of its stiffness and a mass.

    held (verts, 3, 3): the stiffness that holds the vertices `at` where they touched the body.
    """
    problem = with_neighbours(problem, find_neighbours(problem, x))
    point = evaluate(problem, x)
    diagonal, off = stiffness_blocks(problem, x, point)
    force = jnp.einsum("vij,vj->vi", held, x - at, precision="highest")
    point = point._replace(value=point.value + jnp.sum(force * (x - at)) / 2, gradient=point.gradient + force)
    return problem, point, (diagonal + held, off)


def _sticking(problem: Problem, point):
    """The stiffness (verts, 3, 3) of what holds touching vertices along the body, where no pins hold: m STICK^2 (I - n n^T)."""
    eye = jnp.eye(3, dtype=point.gradient.dtype)
    if point.contact is None or problem.terms.pinning:
        return jnp.zeros((len(point.gradient), 3, 3), eye.dtype)
    push = point.contact.gradient
    normal, touches = normalize(push), jnp.any(push != 0, axis=1)
    weight = jnp.where(touches, problem.mass * STICK**2, 0)
    return weight[:, None, None] * (eye[None] - normal[:, :, None] * normal[:, None, :])


@jax.jit
def _longest(problem: Problem, point, p):
    return jnp.min(share_outside_body(problem, point.contact, p))


_accepted, _least_step, _skin, _unpose = (jax.jit(f) for f in (accepts, static_step, skin, unpose))


def _matrix(problem: Problem, diagonal, off):
    """Of blocks, a sparse matrix (3 verts, 3 verts)."""
    from scipy.sparse import coo_matrix

    n, pairs = len(diagonal), np.asarray(problem.couplings.pairs)
    i, j = np.concatenate([np.stack([np.arange(n)] * 2, axis=1), pairs, pairs[:, ::-1]]).T
    values = np.concatenate([diagonal, off, np.swapaxes(off, 1, 2)])
    rows, columns = np.broadcast_arrays(3 * i[:, None, None] + np.arange(3)[:, None], 3 * j[:, None, None] + np.arange(3))
    matrix = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, 3 * n)).tocsc()
    return (matrix + matrix.T) / 2


def _stiff(problem: Problem, blocks, mass):
    """The stiffness of a place, sparse, without the mass that `stiffness_blocks` adds."""
    from scipy.sparse import diags

    added = mass / max(1 / problem.model.fps, float(_least_step(problem.model))) ** 2
    return _matrix(problem, *(np.asarray(block, np.float64) for block in blocks)) - diags(np.repeat(added, 3))


def _solved(matrix, right):
    """The solution of a positive definite system."""
    from scipy.sparse.linalg import splu

    return splu(matrix.tocsc(), "MMD_AT_PLUS_A", 0, options={"SymmetricMode": True}).solve(right)


class _Place(NamedTuple):
    """A garment in a pose: where it is, what is known there, and the blocks of its stiffness and a mass; and what holds it."""

    x: Array
    problem: Problem
    point: Any
    blocks: Any
    held: Array
    at: Array


def _place(problem: Problem, x, held=None, at=None) -> _Place:
    held, at = jnp.zeros((*x.shape, 3), x.dtype) if held is None else held, x if at is None else at
    here, point, blocks = _evaluated(replace(problem, neighbours=None), x, held, at)
    return _Place(x, here, point, blocks, held, at)


def _newton(place: _Place, mass, h: float):
    """The stiffness K of a place, sparse, and Newton's step from there, which a mass over h^2 damps."""
    from scipy.sparse import diags

    stiff = _stiff(place.problem, place.blocks, mass)
    p = _solved(stiff + diags(np.repeat(mass / h**2, 3)), -np.asarray(place.point.gradient, np.float64).ravel())
    return stiff, p.reshape(place.x.shape)


def _along(place: _Place, p) -> tuple[_Place | None, float, float]:
    """The first accepted place on the way p, the share of the way, and that with which the search began; None where none is."""
    p = jnp.asarray(p, place.x.dtype)
    longest = t = float(_longest(place.problem, place.point, p))
    while t >= LEAST_STEP:
        reached = _place(place.problem, place.x + t * p, place.held, place.at)
        if _accepted(place.point, reached.point, t, p):
            return reached, t, longest
        t /= 2
    return None, t, longest


def _walked(model: Model, matrices, mass, still: Callable) -> Array:
    """The garment in unposed space (verts, 3) that has followed the body from rest into a pose, but is not yet still there."""
    unposed, h = model.garment.mesh.rest, float(_least_step(model))
    for k, pose in enumerate(walk_in(model, matrices)):
        problem, transforms = still(pose)
        place = _place(problem, _skin(transforms, unposed))
        for _ in range(SETTLE if k else FALL):
            _, p = _newton(place, mass, h)
            reached, _, _ = _along(place, p)
            if reached is None:
                break
            place = reached
        unposed = _unpose(transforms, place.x)
    return unposed


def _drape(problem: Problem, x, mass):
    """The static equilibrium x_0 near x, and the stiffness K (3 verts, 3 verts) there; None where it comes to no rest.

    Without friction or pins a loose garment slides down the body or turns about it, as nothing resists: there is no equilibrium
    near, and those ways are no vibrations. So what touches the body after `FREE` steps is held there along the body, as
    friction holds it: see `_sticking`. Newton's method then converges. A mass over h^2 damps it, the less the farther it gets.
    """
    least = h = float(_least_step(problem.model))
    place = _place(problem, x)
    for count in range(STEPS):
        if count == FREE:
            place = _place(problem, place.x, _sticking(problem, place.point), place.x)
        stiff, p = _newton(place, mass, h)
        step = np.sqrt(mass @ np.square(p).sum(axis=1) / mass.sum())
        if count > FREE and step < STILL[x.dtype]:
            return place.x, stiff
        reached, t, longest = _along(place, p)
        if reached is None:  # as near as rounding lets it come, or lost
            return (place.x, stiff) if count > FREE and step < 10 * STILL[x.dtype] else None
        place = reached
        if count >= FREE:
            h = min(2 * h, 1 / (2 * np.pi * LEAST)) if t > 0.5 else h if t > 0.25 * longest else max(h / 2, least)
    return None


def softest_ritz_modes(model: Model, matrices: Float[Array, "joints 3 4"], count: int) -> RitzModes | None:
    """Return the `count` softest vibrations of a garment among those that smooth inertia forces excite.

    Such a force is a mass times a smooth mode b_j (`laplacian_modes.modal_basis`) along an axis e_i. What it does to the drape
    x_0, the static equilibrium in the pose of the joints' `matrices`, is a load-dependent Ritz vector u_ij. The vibrations are
    made of those:

        (K + s M) u_ij = M b_j e_i,   K V = M V w^2 on the span of all u_ij,   d_k = c_k R^-1 v_k

    K = d^2 E / dx^2 at x_0, as Newton's method has it, with what touches the body stuck to it (`_drape`). It holds the tension
    of the cloth that hangs and what contact presses; without them a garment would have no period of its own. s is `LEAST`'s. R
    are the blended rotations of skinning there: the directions d_k (m) are those of unposed space. Each is scaled so that it
    costs the same energy, d^T K d = E_0, the softest having a root mean square of `AMPLITUDE`. The softest vibrations of all
    would be those of single folds, which nothing excites. Source: Wilson, Yuan and Dickens 1982.

    Returns:
        None where the garment hangs on nothing: it comes to no rest, or a vibration is slower than `LEAST`.
    """
    from scipy.linalg import eigh
    from scipy.sparse import diags

    still = partial(_still, model, _couplings(model))
    problem, transforms = still(matrices)
    mesh, mass = model.garment.mesh, np.asarray(problem.mass, np.float64)
    n, mass = len(mass), np.where(mass > 0, mass, mass.mean())
    held = np.asarray(model.garment.pins) if model.terms.pinning else ()
    rest, area = (np.asarray(a, np.float64) for a in (mesh.rest, mesh.vertex_area))
    smooth = modal_basis(rest, np.asarray(mesh.faces), area, -(-count // 3), held=held)
    if not smooth.size:
        return None
    masses = diags(np.repeat(mass, 3))
    least = (2 * np.pi * LEAST) ** 2 / max(1.0, np.ptp(rest, axis=0).max() / TALL)

    worn, led = (_skin(transforms, x) for x in (mesh.rest, _walked(model, matrices, mass, still)))
    drape = _drape(problem, led, mass)
    if drape is None:
        return None
    x, stiff = drape
    u = _solved(stiff + least * masses, masses @ np.kron(smooth, np.eye(3)))
    squares, combined = eigh(u.T @ (stiff @ u), u.T @ (masses @ u))
    if squares[0] < least:
        return None
    squares, vectors = squares[:count], (u @ combined)[:, :count]
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(len(squares))] < 0, -1, 1)
    energy = AMPLITUDE**2 * mass.sum() * squares[0]
    directions = np.linalg.solve(
        np.asarray(transforms, np.float64)[..., :3], (vectors * np.sqrt(energy / squares)).reshape(n, 3, -1)
    )
    slopes = displacement_slopes(mesh, directions)
    found = (jnp.asarray(array, model.basis.dtype) for array in (directions, energy, slopes))
    return RitzModes(*found, drape=_unpose(transforms, x) - _unpose(transforms, worn))  # zeros where a blend is singular


def stiffness_in_poses(
    model: Model, matrices: Float[Array, "poses joints 3 4"], offsets: Float[Array, "verts 3 poses"]
) -> Float[np.ndarray, "poses modes modes"]:
    """Return how a garment in each pose opposes a displacement along its vibrations when all else of it gives way, J.

        K = (B^T H^-1 B)^-1,   B = M P G^-1,   G = P^T M P,   P = R D

    H is the stiffness there, as Newton's method has it, with what touches the body stuck to it where nothing is pinned. A load
    f on the vibrations moves the garment by y = H^-1 B f, and so by q = B^T y along them: f = K q. P^T H P in its place would
    be stiffer by far: the drape's vibrations stretch the cloth in other poses. `AT_ONCE` poses are worked at at once.

    Args:
        model: with vibrations D. matrices: joint transforms. offsets: of the static garment, m.
    """
    one, offsets = partial(_stiffness, model, _couplings(model)), jnp.moveaxis(offsets, -1, 0)
    first = one(matrices[0], offsets[0])  # which compiles
    with ThreadPoolExecutor(AT_ONCE) as pool:  # a factorisation keeps only one core busy
        return np.stack([first, *pool.map(one, matrices[1:], offsets[1:])])


def _stiffness(model: Model, couplings: Couplings, matrices: Array, offsets: Array) -> np.ndarray:
    """The same in one pose."""
    from scipy.sparse import diags

    problem, transforms = _still(model, couplings, matrices)
    x = _skin(transforms, model.garment.mesh.rest + offsets)
    free = jnp.zeros((*x.shape, 3), x.dtype)
    _, point, (diagonal, off) = _evaluated(problem, x, free, x)
    mass = np.asarray(problem.mass, np.float64)
    mass = np.where(mass > 0, mass, mass.mean())
    directions = required(model.vibrations, "model.vibrations").directions
    p = np.einsum("vij,vjk->vik", np.asarray(transforms, np.float64)[..., :3], np.asarray(directions, np.float64))
    p = p.reshape(-1, p.shape[-1])
    moved = np.repeat(mass, 3)[:, None] * p
    b = np.linalg.solve(p.T @ moved, moved.T).T
    stiff = _stiff(problem, (diagonal + _sticking(problem, point), off), mass) + diags(np.repeat(LOOSE**2 * mass, 3))
    return np.linalg.inv(b.T @ _solved(stiff, b))


def displacement_slopes(mesh: Mesh, directions: np.ndarray) -> np.ndarray:
    """Return the mean over the garment of grad d_k : grad d_l (modes, modes), gradients in the plane of the rest state."""
    corner = directions[np.asarray(mesh.faces)]
    edges = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)
    gradient = np.einsum("fiek,fea->fiak", edges, np.asarray(mesh.face_axes, np.float64))
    area = np.asarray(mesh.face_area, np.float64)
    return np.einsum("f,fiak,fial->kl", area / area.sum(), gradient, gradient, optimize=True)

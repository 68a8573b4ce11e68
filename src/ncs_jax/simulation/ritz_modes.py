"""Load-dependent Ritz vectors of a garment about its drape: the vibrations that a swing is made of."""

from __future__ import annotations

import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ncs_jax.energies.inertia import G, out_of_balance
from ncs_jax.errors import InputWarning
from ncs_jax.geometry.laplacian_modes import modal_basis
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.scene.features import MotionFeatures
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
from ncs_jax.simulation.solver.stiffness import couplings_from

__all__ = ["softest_ritz_modes"]

AMPLITUDE = 0.05  # m: root mean square displacement of the softest direction
STEPS = 200  # of Newton's method to the drape
ENOUGH = {np.dtype(np.float32): 0.3, np.dtype(np.float64): 0.01}  # m/s^2: the acceleration that may be left there
LEAST = 0.1  # cycles a second: what is softer than that hangs on nothing; of garments taller than `TALL` less, as of a pendulum


def _still(model: Model, track: MotionFeatures) -> tuple[Problem, Array]:
    """The garment in a track's first frame, seen from the root joint, which no past moves; and its skinning transforms."""
    matrices = track.matrices[0]
    matrices = matrices.at[:, :, 3].add(-matrices[0, :, 3])
    model = replace(model, terms=replace(model.terms, inertia=True, friction=False, self_contact=False))
    transforms, rest = blend(matrices, model.blend), model.garment.mesh.rest
    step = step_inputs(model, matrices, Past(rest, rest, moving=jnp.zeros((), rest.dtype)), transforms=transforms)
    return Problem(model, couplings_from(model.garment.mesh), None, step), transforms


@jax.jit
def _evaluated(problem: Problem, x):
    """The problem that knows what is near, what is known of the place, and the blocks of its stiffness and a mass."""
    problem = with_neighbours(problem, find_neighbours(problem, x))
    point = evaluate(problem, x)
    return problem, point, stiffness_blocks(problem, x, point)


@jax.jit
def _longest(point, p):
    return jnp.min(share_outside_body(point.contact, p))


_accepted = jax.jit(accepts)


def _matrix(problem: Problem, diagonal, off):
    """Of blocks, a sparse matrix (3 verts, 3 verts)."""
    from scipy.sparse import coo_matrix

    n, pairs = len(diagonal), np.asarray(problem.couplings.pairs)
    i, j = np.concatenate([np.stack([np.arange(n)] * 2, axis=1), pairs, pairs[:, ::-1]]).T
    values = np.concatenate([diagonal, off, np.swapaxes(off, 1, 2)])
    rows, columns = np.broadcast_arrays(3 * i[:, None, None] + np.arange(3)[:, None], 3 * j[:, None, None] + np.arange(3))
    matrix = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, 3 * n)).tocsc()
    return (matrix + matrix.T) / 2


def _solved(matrix, right):
    """The solution of a positive definite system."""
    from scipy.sparse.linalg import splu

    return splu(matrix.tocsc(), "MMD_AT_PLUS_A", 0, options={"SymmetricMode": True}).solve(right)


def _drape(problem: Problem, x):
    """The blocks at the static equilibrium x_0, found by Newton's method from x; warn where it is not reached.

    What `implicit_euler` does, on the host: that is slower a step, and has no factorisation of its own to compile. A loose
    garment without friction slides down the body for hundreds of steps. Its frequencies change little there, its modes do.
    """
    known = _evaluated(problem, x)
    for _ in range(STEPS):
        near, point, found = known
        diagonal, off = (np.asarray(block, np.float64) for block in found)
        if G * out_of_balance(point.gradient, near.mass) < ENOUGH[x.dtype]:
            return diagonal, off
        p = _solved(_matrix(problem, diagonal, off), -np.asarray(point.gradient, np.float64).ravel())
        p = jnp.asarray(p.reshape(x.shape), x.dtype)
        t = float(_longest(point, p))
        while not _accepted(point, (known := _evaluated(problem, x + t * p))[1], t, p):
            t /= 2
            if t < LEAST_STEP:
                break
        if t < LEAST_STEP:
            break
        x = x + t * p
    told = "the garment came to no rest on the body, so the periods that its swing is made of are rough"
    warnings.warn(f"{told}; if it swings too fast or too slowly, choose another network.cell", InputWarning, stacklevel=2)
    return diagonal, off


def softest_ritz_modes(model: Model, track: MotionFeatures, count: int) -> RitzModes | None:
    """Return the `count` softest vibrations of a garment among those that smooth inertia forces excite.

    Such a force is a mass times a smooth mode b_j (`laplacian_modes.modal_basis`) along an axis e_i. What it does to the drape
    x_0, the static equilibrium in the first frame of a track, is a load-dependent Ritz vector u_ij. The vibrations are made of
    those:

        (K + s M) u_ij = M b_j e_i,   K V = M V w^2 on the span of all u_ij,   d_k = c_k R^-1 v_k

    K = d^2 E / dx^2 at x_0, as Newton's method has it, holds the tension of the cloth that hangs and what contact presses;
    without them a garment would have no period of its own. s is `LEAST`'s. R are the blended rotations of skinning there: the
    directions d_k (m) are those of unposed space. Each is scaled so that it costs the same energy, d^T K d = E_0, the softest
    having a root mean square of `AMPLITUDE`. The softest vibrations of all would be those of single folds, which nothing
    excites. Source: Wilson, Yuan and Dickens 1982.

    Returns:
        None where the garment hangs on nothing: a vibration is slower than `LEAST`.
    """
    from scipy.linalg import eigh
    from scipy.sparse import diags

    problem, transforms = _still(model, track)
    mesh, mass = model.garment.mesh, np.asarray(problem.mass, np.float64)
    n, mass = len(mass), np.where(mass > 0, mass, mass.mean())
    held = np.asarray(model.garment.pins) if model.terms.pinning else ()
    rest, area = (np.asarray(a, np.float64) for a in (mesh.rest, mesh.vertex_area))
    smooth = modal_basis(rest, np.asarray(mesh.faces), area, -(-count // 3), held=held)
    if not smooth.size:
        return None
    added = mass / max(1 / model.fps, float(static_step(model))) ** 2  # by `blocks`
    masses = diags(np.repeat(mass, 3))
    least = (2 * np.pi * LEAST) ** 2 / max(1.0, np.ptp(rest, axis=0).max() / TALL)

    diagonal, off = _drape(problem, skin(transforms, mesh.rest))
    stiff = _matrix(problem, diagonal, off) - diags(np.repeat(added, 3))
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
    dtype = model.basis.dtype
    return RitzModes(jnp.asarray(directions, dtype), jnp.asarray(energy, dtype), jnp.asarray(_slope(mesh, directions), dtype))


def _slope(mesh: Mesh, directions: np.ndarray) -> np.ndarray:
    """Return the mean over the garment of grad d_k : grad d_l (modes, modes), gradients in the plane of the rest state."""
    corner = directions[np.asarray(mesh.faces)]
    edges = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)
    gradient = np.einsum("fiek,fea->fiak", edges, np.asarray(mesh.face_axes, np.float64))
    area = np.asarray(mesh.face_area, np.float64)
    return np.einsum("f,fiak,fial->kl", area / area.sum(), gradient, gradient, optimize=True)

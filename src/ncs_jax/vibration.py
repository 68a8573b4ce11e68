"""The softest vibrations of a garment about its drape: what a swing is made of."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.kinematics import blend, skin
from ncs_jax.model import Model, Vibrations, pose_body
from ncs_jax.motion import Track
from ncs_jax.solver.problem import STATIC, Problem, blocks, descended, energy, evaluated, imbalance, knowing, look
from ncs_jax.solver.stiffness import couplings_from

__all__ = ["softest"]

AMPLITUDE = 0.05  # m: root mean square displacement of the softest direction
STEPS = 200  # of Newton's method to the drape
ENOUGH = {np.dtype(np.float32): 0.3, np.dtype(np.float64): 0.01}  # m/s^2: the acceleration that may be left there
LEAST = 0.1  # cycles a second: what is softer than that hangs on nothing


def _still(model: Model, track: Track) -> Problem:
    """The garment in a track's first frame, seen from the root joint, which no past moves."""
    matrices = track.matrices[0]
    matrices = matrices.at[:, :, 3].add(-matrices[0, :, 3])
    terms = replace(model.terms, inertia=False, friction=False, self_contact=False)
    blended = blend(matrices, model.blend)
    body = None if model.surface is None else pose_body(model, matrices)
    rest = model.garment.mesh.rest
    nothing = jnp.zeros((), rest.dtype)
    couplings = couplings_from(model.garment.mesh)
    return Problem(replace(model, terms=terms), couplings, None, body, blended, rest, None, nothing)


@jax.jit
def _evaluated(problem: Problem, x):
    """The problem that knows what is near, what is known of the place, and the blocks of its stiffness and a mass."""
    problem = knowing(problem, look(problem, x))
    point = evaluated(problem, x)
    return problem, point, blocks(problem, x, point)


@jax.jit
def _descended(problem: Problem, x, point, p):
    seen = None if problem.seen is None else (problem.near, problem.pairs, problem.seen)
    x, *_, moved = descended(problem, seen, x, point, p)
    return x, moved


def _matrix(problem: Problem, diagonal, off):
    """Of blocks, a sparse matrix (3 verts, 3 verts)."""
    from scipy.sparse import coo_matrix

    n, pairs = len(diagonal), np.asarray(problem.couplings.pairs)
    i, j = np.concatenate([np.stack([np.arange(n)] * 2, axis=1), pairs, pairs[:, ::-1]]).T
    values = np.concatenate([diagonal, off, np.swapaxes(off, 1, 2)])
    rows, columns = np.broadcast_arrays(3 * i[:, None, None] + np.arange(3)[:, None], 3 * j[:, None, None] + np.arange(3))
    matrix = coo_matrix((values.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * n, 3 * n)).tocsc()
    return (matrix + matrix.T) / 2


def _drape(problem: Problem):
    """The static equilibrium x_0 by Newton's method, from cloth that is skinned; the problem and the blocks there.

    What `simulator` does, on the host: that is slower a step, and has no factorisation of its own to compile.
    """
    from scipy.sparse.linalg import splu

    x, mass = skin(problem.blended, problem.model.garment.mesh.rest), jnp.sum(problem.mass)
    for _ in range(STEPS):
        near, point, found = _evaluated(problem, x)
        diagonal, off = (np.asarray(block, np.float64) for block in found)
        if jnp.sqrt(jnp.sum(imbalance(near, point.gradient)) / mass) < ENOUGH[x.dtype]:
            break
        p = splu(_matrix(problem, diagonal, off), "MMD_AT_PLUS_A", 0, options={"SymmetricMode": True}).solve(
            -np.asarray(point.gradient, np.float64).ravel()
        )
        x, moved = _descended(near, x, point, jnp.asarray(p.reshape(x.shape), x.dtype))
        if not moved:
            break
    return near, x, (diagonal, off)


@jax.jit
def _stiffness(problem: Problem, x, u):
    """u^T K u of displacements (modes, verts, 3), with all that K has."""
    forces = jax.lax.map(lambda one: jax.jvp(lambda x: jax.grad(energy, argnums=1)(problem, x), (x,), (one,))[1], u)
    return jnp.einsum("kvi,lvi->kl", u, forces)


def softest(model: Model, track: Track, count: int) -> Vibrations | None:
    """The `count` softest vibrations about the drape x_0, the static equilibrium in the first frame of a track.

        K u_i = w_i^2 M u_i,   K = d^2 E / dx^2 at x_0,   d_i = c_i R^-1 u_i

    R are the blended rotations of skinning there: the directions d_i (m) are those of unposed space. Each is scaled so that it
    costs the same energy, d^T K d = E_0, the softest having a root mean square of `AMPLITUDE`. K holds the tension of the
    cloth that hangs and what contact presses; without them a garment would have no period of its own. The u_i span
    those of K made positive semi-definite, whose softest are no wrinkles but which is stiffer where cloth is compressed; K
    itself combines and weighs them (Rayleigh and Ritz).

    Returns:
        None where the garment hangs on nothing: a vibration is slower than `LEAST`.
    """
    from scipy.sparse import diags
    from scipy.sparse.linalg import eigsh

    problem, x, (diagonal, off) = _drape(_still(model, track))
    mass = np.asarray(problem.mass, np.float64)
    n, mass = len(mass), np.where(mass > 0, mass, mass.mean())
    added = mass / max(1 / model.fps, STATIC) ** 2  # by `blocks`
    matrix = _matrix(problem, diagonal, off) - diags(np.repeat(added, 3))
    start = np.random.default_rng(0).normal(size=3 * n)  # ARPACK's own is random
    masses = diags(np.repeat(mass, 3)).tocsc()
    _, vectors = eigsh(matrix.tocsc(), count, masses, sigma=-1.0, which="LM", v0=start)
    u = jnp.asarray(vectors.T.reshape(-1, n, 3), x.dtype)
    squares, combined = np.linalg.eigh(np.asarray(_stiffness(problem, x, u), np.float64))
    vectors = vectors @ combined
    if squares[0] < (2 * np.pi * LEAST) ** 2:
        return None
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)] < 0, -1, 1)
    energy = AMPLITUDE**2 * mass.sum() * squares[0]
    u = (vectors * np.sqrt(energy / squares)).reshape(n, 3, count)
    directions = np.linalg.solve(np.asarray(problem.blended, np.float64)[..., :3], u)
    dtype = model.basis.dtype
    return Vibrations(jnp.asarray(directions, dtype), jnp.asarray(energy, dtype))

"""Load-dependent Ritz vectors of a garment about its drape: the vibrations that a swing is made of."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ncs_jax.energies.inertia import G, out_of_balance
from ncs_jax.geometry.laplacian_modes import modal_basis
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, RitzModes
from ncs_jax.scene.step_inputs import Past, step_inputs
from ncs_jax.simulation.solver.problem import (
    TALL,
    Problem,
    evaluate,
    find_neighbours,
    line_search,
    static_step,
    stiffness_blocks,
    with_neighbours,
)
from ncs_jax.simulation.solver.stiffness import couplings_from

__all__ = ["softest_ritz_modes"]

AMPLITUDE = 0.05  # m: root mean square displacement of the softest direction
STEPS = 200  # of Newton's method to the drape
ENOUGH = {np.dtype(np.float32): 0.3, np.dtype(np.float64): 0.01}  # m/s^2: the acceleration that may be left there
LARGEST = 1 << 29  # bytes of a band; of a larger garment a sparse factor is smaller
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
def _descended(problem: Problem, x, point, p):
    x, *_, moved = line_search(problem, problem.neighbours, x, point, p)
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


def _solved(matrix, right):
    """The solution of a positive definite system."""
    from scipy.sparse.linalg import splu

    return splu(matrix.tocsc(), "MMD_AT_PLUS_A", 0, options={"SymmetricMode": True}).solve(right)


class _Band:
    """Matrices of blocks as a band about their diagonal, which LAPACK factorises in half the time that a sparse one takes."""

    def __init__(self, pairs: np.ndarray, verts: int):
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        graph = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(verts, verts))
        order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True)
        place = np.argsort(order)
        i, j = (3 * place[pairs[:, k], None, None] for k in (0, 1))
        rows, columns = np.broadcast_arrays(i + np.arange(3)[:, None], j + np.arange(3))
        own = 3 * place[:, None] + np.array([0, 1, 2, 1, 2, 2]), 3 * place[:, None] + np.array([0, 0, 0, 1, 1, 2])
        low = np.concatenate([np.maximum(rows, columns).ravel(), own[0].ravel()])
        high = np.concatenate([np.minimum(rows, columns).ravel(), own[1].ravel()])
        self._at, self._order = (low - high, high), (3 * order[:, None] + np.arange(3)).ravel()
        self._shape = int((low - high).max()) + 1, 3 * verts

    @property
    def size(self) -> int:
        """Return how many bytes a matrix takes."""
        return 8 * self._shape[0] * self._shape[1]

    def solved(self, diagonal, off, right) -> np.ndarray:
        """Return the solution of a positive definite system.

        Raises:
            LinAlgError: it is not.
        """
        from scipy.linalg import solveh_banded

        band = np.zeros(self._shape)
        lower = ((diagonal + np.swapaxes(diagonal, 1, 2)) / 2)[:, [0, 1, 2, 1, 2, 2], [0, 0, 0, 1, 1, 2]]
        band[self._at] = np.concatenate([off.ravel(), lower.ravel()])
        solution = np.empty_like(right)
        given = {"overwrite_ab": True, "lower": True, "check_finite": False}
        solution[self._order] = solveh_banded(band, right[self._order], **given)
        return solution


def _drape(problem: Problem, x):
    """The problem and the blocks at the static equilibrium x_0, found by Newton's method from x.

    What `implicit_euler` does, on the host: that is slower a step, and has no factorisation of its own to compile.
    """
    band = _Band(np.asarray(problem.couplings.pairs), len(x))
    for _ in range(STEPS):
        near, point, found = _evaluated(problem, x)
        diagonal, off = (np.asarray(block, np.float64) for block in found)
        if G * out_of_balance(point.gradient, near.mass) < ENOUGH[x.dtype]:
            break
        right = -np.asarray(point.gradient, np.float64).ravel()
        try:
            if band.size > LARGEST:
                raise np.linalg.LinAlgError
            p = band.solved(diagonal, off, right)
        except np.linalg.LinAlgError:  # not quite positive definite
            p = _solved(_matrix(problem, diagonal, off), right)
        x, moved = _descended(near, x, point, jnp.asarray(p.reshape(x.shape), x.dtype))
        if not moved:
            break
    return near, diagonal, off


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
    problem, diagonal, off = _drape(problem, skin(transforms, model.garment.mesh.rest))
    mesh, mass = model.garment.mesh, np.asarray(problem.mass, np.float64)
    n, mass = len(mass), np.where(mass > 0, mass, mass.mean())
    added = mass / max(1 / model.fps, float(static_step(model))) ** 2  # by `blocks`
    stiff, masses = _matrix(problem, diagonal, off) - diags(np.repeat(added, 3)), diags(np.repeat(mass, 3))
    held = np.asarray(model.garment.pins) if model.terms.pinning else ()
    rest, area = (np.asarray(a, np.float64) for a in (mesh.rest, mesh.vertex_area))
    smooth = modal_basis(rest, np.asarray(mesh.faces), area, -(-count // 3), held=held)
    if not smooth.size:
        return None
    least = (2 * np.pi * LEAST) ** 2 / max(1.0, np.ptp(rest, axis=0).max() / TALL)
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

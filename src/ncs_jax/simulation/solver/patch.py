"""The small part of a garment where most of the imbalance is: a model of it alone, the rest held, and its dense stiffness.

Cloth near its equilibrium is mostly at rest, while somewhere a fold still travels. Solved by itself, such a place costs a
hundredth of a step of the whole, and the whole no longer waits for it: nonlinear elimination (Lanzkron, Rose and Wilkes 1996).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.pairs import Pairs
from ncs_jax.scene.model import Model
from ncs_jax.simulation.solver.stiffness import Couplings

__all__ = ["SIZE", "Patch", "pairs_of", "patch_around", "solve_dense"]

SIZE = 128  # vertices
SEEDS = 16  # vertices that a patch is gathered around


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Patch:
    """Vertices that move, and the model and couplings of every element that they touch; padded elements weigh nothing."""

    verts: Int[Array, "size"]
    groups: Bool[Array, "blocks"]  # of the surface's `cloth_blocks`: whether something moves
    place: Int[Array, "verts"]  # in `verts`, or `size` for a vertex that is held
    inside: Int[Array, "pairs"]  # pairs of vertices that both move; padded with the number of all pairs
    model: Model
    couplings: Couplings
    whole: Bool[Array, ""]  # nothing had to be left out


def _rows(mask, size):
    """Numbers of the rows that are marked, padded, and whether they fit."""
    return jnp.nonzero(mask, size=size, fill_value=mask.shape[0])[0], jnp.sum(mask) <= size


def _take(array, rows, filling=0, axis=0):
    return jnp.take(array, rows, axis=axis, mode="fill", fill_value=filling)


def _groups(moves, model: Model, couplings: Couplings):
    """Which groups of cloth hold vertices that move, or points of contact that these carry."""
    if model.surface is None:
        return jnp.zeros(0, bool)
    points = couplings.points
    if points is not None:
        moves = jnp.concatenate([moves, jnp.any(moves[points.corners] & (points.weights > 0), axis=1)])
    return jnp.any(moves[model.surface.cloth_blocks], axis=1)


def patch_around(score: Float[Array, "verts"], model: Model, couplings: Couplings) -> Patch:
    """Return the patch near the vertices of the highest score: those that lie nearest to them at rest."""
    mesh = model.garment.mesh
    seeds = mesh.rest[jax.lax.top_k(score, SEEDS)[1]]
    square = jnp.sum((mesh.rest[:, None] - seeds[None]) ** 2, axis=-1)
    verts = jax.lax.top_k(-jnp.min(square, axis=1), SIZE)[1]
    place = jnp.full(score.shape, SIZE).at[verts].set(jnp.arange(SIZE))
    moves = place < SIZE

    faces, fits_faces = _rows(jnp.any(moves[mesh.faces], axis=1), 4 * SIZE)
    hinges, fits_hinges = _rows(jnp.any(moves[mesh.hinges], axis=1), 6 * SIZE)
    edges, fits_edges = _rows(jnp.any(moves[mesh.edges], axis=1), 5 * SIZE)
    inside, fits_pairs = _rows(jnp.all(moves[couplings.pairs], axis=1), 8 * SIZE)
    part = replace(
        mesh,
        faces=_take(mesh.faces, faces),
        face_area=_take(mesh.face_area, faces),
        face_axes=_take(mesh.face_axes, faces),
        hinges=_take(mesh.hinges, hinges),
        hinge_area=_take(mesh.hinge_area, hinges),
        hinge_angle=_take(mesh.hinge_angle, hinges),
        hinge_length=_take(mesh.hinge_length, hinges),
        edges=_take(mesh.edges, edges),
        edge_length=_take(mesh.edge_length, edges, 1),
        edge_weight=_take(mesh.edge_weight, edges),
        rings=None,
    )
    return Patch(
        verts=verts,
        groups=_groups(moves, model, couplings),
        place=place,
        inside=inside,
        model=replace(model, garment=replace(model.garment, mesh=part)),
        couplings=Couplings(
            couplings.pairs,
            _take(couplings.face_pairs, faces, axis=1),
            _take(couplings.face_flips, faces, False, axis=1),
            _take(couplings.hinge_pairs, hinges, axis=1),
            _take(couplings.hinge_flips, hinges, False, axis=1),
            _take(couplings.edge_pairs, edges),
            couplings.points,
            couplings.point_pairs,
        ),
        whole=fits_faces & fits_hinges & fits_edges & fits_pairs,
    )


def pairs_of(patch: Patch, pairs: Pairs) -> Pairs:
    """Return the pairs that have a vertex in the patch; `overflow` is set where they are too many."""
    moves = patch.place < SIZE

    def some(vertices, most):
        real = vertices[:, 0] != vertices[:, 1]  # the others fill the list
        rows, fits = _rows(jnp.any(moves[vertices], axis=1) & real, most)
        return rows, _take(vertices, rows), fits

    points, point_vertices, fits_points = some(pairs.points, 4 * SIZE)
    edges, edge_vertices, fits_edges = some(pairs.edges, 12 * SIZE)
    count = len(pairs.points)
    rest = jnp.concatenate([_take(pairs.rest[:count], points), _take(pairs.rest[count:], edges)])
    return Pairs(point_vertices, edge_vertices, rest, pairs.overflow | ~(fits_points & fits_edges))


def solve_dense(
    patch: Patch,
    diagonal: Float[Array, "verts 3 3"],
    off: Float[Array, "pairs 3 3"],
    right: Float[Array, "verts 3"],
    springs: tuple[Int[Array, "springs 4"], Float[Array, "springs 4 3"]] | None = None,
) -> Float[Array, "verts 3"]:
    """Return x with A x = right where the patch moves, and zero elsewhere.

    springs: vertices and vectors v of what A has beside the blocks, sum v v^T.
    """
    k = jnp.arange(SIZE)
    i, j = patch.place[_take(patch.couplings.pairs, patch.inside)].T
    i = jnp.where(patch.inside < patch.couplings.pairs.shape[0], i, SIZE)
    block = _take(off, patch.inside)
    matrix = jnp.zeros((SIZE, 3, SIZE, 3), right.dtype)
    matrix = matrix.at[i, :, j, :].add(block, mode="drop")
    matrix = matrix.at[j, :, i, :].add(jnp.swapaxes(block, 1, 2), mode="drop")
    matrix = matrix.at[k, :, k, :].add(diagonal[patch.verts]).reshape(3 * SIZE, 3 * SIZE)
    if springs is not None:
        vertices, vectors = springs
        rows = jnp.zeros((len(vertices), SIZE, 3), right.dtype)
        rows = rows.at[jnp.arange(len(vertices))[:, None], patch.place[vertices]].add(vectors, mode="drop")
        rows = rows.reshape(-1, 3 * SIZE)
        matrix = matrix + jnp.matmul(rows.T, rows, precision="highest")
    factor = jax.scipy.linalg.cho_factor(matrix, lower=True)
    found = jax.scipy.linalg.cho_solve(factor, right[patch.verts].reshape(-1)).reshape(-1, 3)
    return jnp.zeros_like(right).at[patch.verts].set(found)

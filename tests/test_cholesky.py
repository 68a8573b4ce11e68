"""The factorisation against NumPy on dense matrices: every shape of graph, every order, both types, and what has no factor."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.simulation.solver.cholesky import LEAF, elimination, factorise, solve
from ncs_jax.simulation.solver.stiffness import couplings_from

from .scenes import grid
from .shapes import sheet, tube


def coupled(vertices, faces):
    """Pairs that share a face or a hinge, and where the vertices lie."""
    return np.asarray(couplings_from(mesh_from(vertices, faces)).pairs), np.asarray(vertices)


def two_sheets_and_three_points():
    """Two sheets far apart, two vertices coupled with each other alone, and one with none."""
    pairs, points = coupled(*sheet(9, 10))
    n = len(points)
    apart = np.concatenate([points, points + [1.0, 0, 0], [[2.0, 0, 0], [2.1, 0, 0], [3.0, 0, 0]]])
    return np.concatenate([pairs, pairs + n, [[2 * n, 2 * n + 1]]]), apart


NONE = np.zeros((0, 2), np.int64)
ALL_OF_THIRTY = np.stack(np.triu_indices(30, 1), axis=1)
GRAPHS = {
    "grid": lambda: coupled(*grid(14, 13)),
    "tube": lambda: coupled(*tube(20, 14)),
    "disconnected": two_sheets_and_three_points,
    "triangle": lambda: coupled(np.eye(3), np.array([[0, 1, 2]])),
    "one vertex": lambda: (NONE, np.zeros((1, 3))),
    "no pairs": lambda: (NONE, np.random.default_rng(1).normal(size=(100, 3))),
    "all in one point": lambda: (coupled(*grid(12, 9))[0], np.zeros((108, 3))),
    "star": lambda: (np.stack([np.zeros(149, int), np.arange(1, 150)], 1), np.random.default_rng(2).normal(size=(150, 3))),
    "dense": lambda: (ALL_OF_THIRTY, np.random.default_rng(3).normal(size=(30, 3))),
    "dense, in a cloud": lambda: (ALL_OF_THIRTY, np.random.default_rng(4).normal(size=(120, 3))),
}
every_graph = pytest.mark.parametrize("graph", GRAPHS)


@cache
def problem(graph):
    """Pairs, points, and a matrix of condition about 100: Laplacian blocks of random directions, and a little mass."""
    pairs, points = GRAPHS[graph]()
    rng = np.random.default_rng(5)
    diagonal, off = np.tile(0.05 * np.eye(3), (len(points), 1, 1)), np.zeros((len(pairs), 3, 3))
    for k, (i, j) in enumerate(pairs):
        a, b = rng.normal(size=(2, 3, 3)) / np.sqrt(3)  # (a x_i - b x_j)^2, so that a block differs from its transpose
        diagonal[i] += a.T @ a
        diagonal[j] += b.T @ b
        off[k] = -a.T @ b
    return pairs, points, diagonal, off, rng.normal(size=points.shape)


def dense(pairs, diagonal, off):
    n = len(diagonal)
    a = np.zeros((n, 3, n, 3))
    a[np.arange(n), :, np.arange(n)] = diagonal
    for (i, j), block in zip(pairs, off, strict=True):
        a[i, :, j], a[j, :, i] = block, block.T
    return a.reshape(3 * n, 3 * n)


@jax.jit
def solved(order, diagonal, off, right):
    return solve(order, factorise(order, diagonal, off), right)


@cache
def order_of(graph):
    return elimination(*problem(graph)[:2])


def answer(graph, dtype=jnp.float64, order=None):
    _, _, *numbers = problem(graph)
    return solved(order_of(graph) if order is None else order, *(jnp.asarray(a, dtype) for a in numbers))


@pytest.mark.parametrize(
    ("graph", "dtype"), [*((g, jnp.float64) for g in GRAPHS), *((g, jnp.float32) for g in ("grid", "disconnected", "triangle"))]
)
def test_solution_equals_that_of_a_dense_matrix(graph, dtype):
    pairs, points, diagonal, off, right = problem(graph)
    x = answer(graph, dtype)
    assert x.dtype == dtype and x.shape == points.shape
    expected = np.linalg.solve(dense(pairs, diagonal, off), right.reshape(-1)).reshape(-1, 3)
    rounding = 1e-3 if dtype == jnp.float32 else 1e-11
    np.testing.assert_allclose(np.asarray(x), expected, rtol=0, atol=rounding * np.abs(expected).max())


def test_these_graphs_are_dissected():
    """Else the test above would try one dense matrix after another."""
    assert len(order_of("triangle").levels) == 1
    for graph in ("grid", "tube", "disconnected"):
        levels = order_of(graph).levels
        assert len(levels) >= 3
        largest = max(g.pivots.shape[1] for level in levels for g in level)
        assert largest < 2 * LEAF


@every_graph
def test_every_vertex_is_eliminated_once_and_every_pair_enters_once(graph):
    pairs, points, *_ = problem(graph)
    groups = [g for level in order_of(graph).levels for g in level]
    blocks = np.concatenate([np.asarray(g.blocks) for g in groups])
    np.testing.assert_array_equal(np.sort(blocks), np.arange(len(pairs)))
    pivots = np.concatenate([np.asarray(g.pivots).reshape(-1) for g in groups])
    np.testing.assert_array_equal(np.sort(pivots[pivots < len(points)]), np.arange(len(points)))


@pytest.mark.parametrize("graph", ["grid", "disconnected"])
def test_the_order_of_the_vertices_and_of_the_pairs_does_not_matter(graph, rng):
    pairs, points, diagonal, off, right = problem(graph)
    new = rng.permutation(len(points))  # vertex new[v] of the old order is vertex v
    place, listed, turned = np.argsort(new), rng.permutation(len(pairs)), rng.random(len(pairs)) < 0.5
    other = np.where(turned[:, None], place[pairs][:, ::-1], place[pairs])
    blocks = np.where(turned[:, None, None], np.swapaxes(off, 1, 2), off)
    numbers = (jnp.asarray(a) for a in (diagonal[new], blocks[listed], right[new]))
    x = solved(elimination(other[listed], points[new]), *numbers)
    here = np.asarray(answer(graph))
    np.testing.assert_allclose(x, here[new], rtol=0, atol=1e-12 * np.abs(here).max())


def test_where_the_points_lie_only_chooses_the_order(rng):
    pairs, points, *_ = problem("tube")
    other = answer("tube", order=elimination(pairs, rng.normal(size=points.shape)))
    here = np.asarray(answer("tube"))
    np.testing.assert_allclose(other, here, rtol=0, atol=1e-12 * np.abs(here).max())


@pytest.mark.parametrize("graph", ["grid", "disconnected", "triangle"])
@pytest.mark.parametrize("where", ["first", "middle", "last"])
def test_what_is_not_positive_definite_is_not_a_number(graph, where):
    """Never a finite answer to a question that has none, wherever in the order the negative pivot comes."""
    _, points, diagonal, off, right = problem(graph)
    groups = [g for level in order_of(graph).levels for g in level]
    order = np.concatenate([np.asarray(g.pivots).reshape(-1) for g in groups])
    order = order[order < len(points)]
    v = order[{"first": 0, "middle": len(order) // 2, "last": -1}[where]]
    wrong = diagonal.copy()
    wrong[v] -= 2 * np.abs(diagonal[v]).sum() * np.eye(3)
    assert np.diagonal(wrong[v]).max() < 0
    x = solved(order_of(graph), *(jnp.asarray(a) for a in (wrong, off, right)))
    assert jnp.any(jnp.isnan(x))


@pytest.mark.parametrize("place", ["diagonal", "off", "right"])
def test_what_is_not_a_number_comes_out_as_such(place):
    _, _, diagonal, off, right = problem("grid")
    numbers = {"diagonal": diagonal, "off": off, "right": right}
    broken = {
        k: np.where(np.arange(a.size).reshape(a.shape) == a.size // 2, np.nan, a) for k, a in numbers.items() if k == place
    }
    x = solved(order_of("grid"), *(jnp.asarray(broken.get(k, a)) for k, a in numbers.items()))
    assert jnp.any(jnp.isnan(x))


def test_a_batch_of_values_equals_the_loop(rng):
    _, _, diagonal, off, right = problem("disconnected")
    scale = jnp.array([0.5, 1.0, 3.0])
    extra = jnp.asarray(rng.uniform(0, 1, (3, len(diagonal))))[..., None, None] * jnp.eye(3)[None, None]
    diagonals = scale[:, None, None, None] * jnp.asarray(diagonal)[None] + extra
    offs = scale[:, None, None, None] * jnp.asarray(off)[None]
    rights = jnp.asarray(rng.normal(size=(3, *right.shape)))
    order = order_of("disconnected")
    together = jax.jit(jax.vmap(lambda d, o, r: solve(order, factorise(order, d, o), r)))(diagonals, offs, rights)
    for i in range(3):
        alone = solved(order, diagonals[i], offs[i], rights[i])
        np.testing.assert_allclose(together[i], alone, rtol=0, atol=1e-12 * float(jnp.max(jnp.abs(alone))))


def test_one_factor_serves_many_sides():
    """The factor is a pytree of its own: made once, used for each side, and each answer is its own."""
    pairs, _, diagonal, off, right = problem("grid")
    order = order_of("grid")
    factor = jax.jit(factorise)(order, jnp.asarray(diagonal), jnp.asarray(off))
    a = dense(pairs, diagonal, off)
    for side in (right, np.roll(right, 1, axis=0)):
        x = np.asarray(jax.jit(solve)(order, factor, jnp.asarray(side)))
        np.testing.assert_allclose(a @ x.reshape(-1), side.reshape(-1), rtol=0, atol=1e-11 * np.abs(side).max())

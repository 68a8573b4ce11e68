"""Sparse Cholesky factorisation of matrices with one small block a pair of coupled vertices, by nested dissection.

A garment's couplings never change, so the order of elimination is found once; the numbers then pass through dense fronts
(Duff and Reid 1983), one batch of equal fronts a level of the dissection tree. All of it is batched matrix products and small
dense factorisations: it is compiled, mapped over batches and runs wherever JAX does.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.errors import required

__all__ = ["Elimination", "Factor", "elimination", "factorise", "solve"]

LEAF = 24  # vertices that a dissection no longer divides


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Group:
    """Fronts of one depth of the dissection tree and of about one size, padded to the same.

    A front is a dense matrix over its pivots, which are eliminated here, and its border: vertices that are eliminated later.
    """

    pivots: Int[Array, "fronts pivots"]  # vertex, or `verts` where padded
    border: Int[Array, "fronts border"]
    blocks: Int[Array, "entries"]  # off-diagonal blocks that enter here
    places: Int[Array, "entries 3"]  # where: front, row, column
    flipped: Int[Array, "entries"]  # 1: the block couples them the other way round
    children: Int[Array, "fronts 2 local"] | None  # row in the updates of the depth below that a local row takes
    columns: Int[Array, "fronts 2 local"] | None  # and its place among the columns of that update


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Elimination:
    """In which order and where the blocks of a matrix are eliminated; levels from the leaves to the root."""

    levels: tuple[tuple[Group, ...], ...]
    verts: int = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Factor:
    """L L^T = A: of each level the inverse pivot factors L^-1 and the rows L^-1 A of the border."""

    inverse: tuple[Float[Array, "fronts p p"], ...]
    border: tuple[Float[Array, "fronts p b"], ...]


# --- order, once ----------------------------------------------------------------------------------------------------


def _separator(crossing: np.ndarray) -> np.ndarray:
    """Fewest vertices that touch every crossing pair (pairs, 2) from left to right: a minimum vertex cover (Koenig)."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import maximum_bipartite_matching

    a, i = np.unique(crossing[:, 0], return_inverse=True)
    b, j = np.unique(crossing[:, 1], return_inverse=True)
    graph = csr_matrix((np.ones(len(i), np.int8), (i, j)), shape=(len(a), len(b)))
    match_of_a = maximum_bipartite_matching(graph, perm_type="column")
    match_of_b = np.full(len(b), -1)
    match_of_b[match_of_a[match_of_a >= 0]] = np.flatnonzero(match_of_a >= 0)
    seen_a, seen_b = match_of_a < 0, np.zeros(len(b), bool)
    front = np.flatnonzero(seen_a)
    while front.size:  # alternating paths from the free ones
        reached = np.unique(graph[front].indices)
        reached = reached[~seen_b[reached]]
        seen_b[reached] = True
        front = match_of_b[reached]
        front = front[~seen_a[front]]
        seen_a[front] = True
    return np.concatenate([a[~seen_a], b[seen_b]])


def _halve(members: np.ndarray, points: np.ndarray, pairs: np.ndarray, verts: int):
    """Split vertices into two parts without a pair between them, and the separator; `pairs` are those inside `members`."""
    at = points[members] - points[members].mean(axis=0)
    axes = np.linalg.svd(at, full_matrices=False)[2]
    directions = np.concatenate([axes, [axes[0] + axes[1], axes[0] - axes[1]]])
    best = None
    for direction in directions:
        height = at @ direction
        order = np.argsort(height, kind="stable")
        for share in (0.45, 0.5, 0.55):
            side = np.zeros(verts, bool)
            side[members[order[: int(share * len(order))]]] = True
            crossing = pairs[side[pairs[:, 0]] != side[pairs[:, 1]]]
            if not len(crossing):
                separator = np.zeros(0, np.int64)
            else:
                crossing = np.where(side[crossing[:, :1]], crossing, crossing[:, ::-1])
                separator = _separator(crossing)
            parts = np.bincount(side[np.setdiff1d(members, separator)], minlength=2)
            cost = len(separator) * (1 + 4 * abs(parts[0] - parts[1]) / max(parts.sum(), 1))
            if best is None or cost < best[0]:
                best = cost, side.copy(), separator
    _, side, separator = best
    rest = np.setdiff1d(members, separator)
    return rest[side[rest]], rest[~side[rest]], np.sort(separator)


def elimination(pairs: np.ndarray, points: np.ndarray) -> Elimination:
    """Find a good order for vertices coupled in `pairs` (pairs, 2) that lie at `points` (verts, 3), m.

    Off-diagonal block k of a matrix then couples vertex pairs[k, 0] (rows) with pairs[k, 1] (columns).
    """
    pairs, points = np.asarray(pairs, np.int64), np.asarray(points, np.float64)
    verts = len(points)
    depth = max(0, int(np.round(np.log2(max(verts / LEAF, 1)))))
    nodes = [(np.arange(verts), pairs)]
    tree: list[list[np.ndarray]] = []
    for _ in range(depth):
        separators, below = [], []
        for members, inside in nodes:
            if len(members) < 2:
                left, right, separator = members[:0], members[:0], members
            else:
                left, right, separator = _halve(members, points, inside, verts)
            separators.append(separator)
            for part in (left, right):
                mask = np.zeros(verts, bool)
                mask[part] = True
                below.append((part, inside[mask[inside].all(axis=1)]))
        tree.append(separators)
        nodes = below
    tree.append([members for members, _ in nodes])
    return _symbolic(tree, pairs, verts)


class _Order(NamedTuple):
    """Where every vertex is in the tree, and where every block enters."""

    rank: np.ndarray  # (verts,) when it is eliminated
    depth: np.ndarray  # (verts,) of its node
    node: np.ndarray  # (verts,) its node among those of one depth
    place: np.ndarray  # (verts,) in its node
    early: np.ndarray  # (pairs,) the vertex of a pair that is eliminated first: there its block enters,
    late: np.ndarray  # (pairs,) and the other one
    flipped: np.ndarray  # (pairs,) whether the first is eliminated first


class _Deeper(NamedTuple):
    """The nodes one level deeper."""

    borders: list[np.ndarray]
    position: np.ndarray  # of a node among the updates
    widest: int  # of the borders


def _order(tree: list[list[np.ndarray]], pairs: np.ndarray, verts: int) -> _Order:
    rank, depth_of, node_of, place_of = (np.zeros(verts, np.int64) for _ in range(4))
    count = 0
    for depth in range(len(tree) - 1, -1, -1):
        for node, members in enumerate(tree[depth]):
            rank[members] = count + np.arange(len(members))
            depth_of[members], node_of[members], place_of[members] = depth, node, np.arange(len(members))
            count += len(members)
    first = rank[pairs].argmin(axis=1)
    early, late = pairs[np.arange(len(pairs)), first], pairs[np.arange(len(pairs)), 1 - first]
    return _Order(rank, depth_of, node_of, place_of, early, late, first == 0)


def _group(nodes, own, borders, entering, order: _Order, deeper: _Deeper) -> Group:
    """Some nodes of a level, padded to one size: their fronts, the blocks that enter there, and the updates from below."""
    verts = len(order.rank)
    p, b = max(len(own[n]) for n in nodes), max(len(borders[n]) for n in nodes)
    local = np.full((len(nodes), p + b), verts)
    place = np.zeros((len(nodes), verts + 1), np.int64)
    for i, n in enumerate(nodes):
        local[i, : len(own[n])] = own[n]
        local[i, p : p + len(borders[n])] = borders[n]
        place[i, local[i]] = np.arange(p + b)
    index = np.full(len(own), -1)
    index[nodes] = np.arange(len(nodes))
    mine = entering[index[order.node[order.early[entering]]] >= 0]
    front = index[order.node[order.early[mine]]]
    children = columns = None
    if deeper.borders:
        columns = np.full((len(nodes), 2, p + b), deeper.widest)
        for i, n in enumerate(nodes):
            for k in range(2):
                lookup = np.full(verts + 1, deeper.widest)
                lookup[deeper.borders[2 * n + k]] = np.arange(len(deeper.borders[2 * n + k]))
                columns[i, k] = lookup[local[i]]
        update = deeper.position[2 * np.asarray(nodes)[:, None] + np.arange(2)]
        children = update[:, :, None] * (deeper.widest + 1) + columns
    array = functools.partial(jnp.asarray, dtype=jnp.int32)
    return Group(
        pivots=array(local[:, :p]),
        border=array(local[:, p:]),
        blocks=array(mine),
        places=array(np.stack([front, place[front, order.late[mine]], order.place[order.early[mine]]], axis=1)),
        flipped=array(order.flipped[mine]),
        children=None if children is None else array(children),
        columns=None if columns is None else array(columns),
    )


def _symbolic(tree: list[list[np.ndarray]], pairs: np.ndarray, verts: int) -> Elimination:
    from scipy.sparse import csr_matrix

    both = np.concatenate([pairs, pairs[:, ::-1]])
    graph = csr_matrix((np.ones(len(both), np.int8), both.T), shape=(verts, verts))
    order = _order(tree, pairs, verts)
    levels: list[tuple[Group, ...]] = []
    deeper = _Deeper([], np.zeros(0, np.int64), 0)
    for depth in range(len(tree) - 1, -1, -1):
        own = tree[depth]
        borders = []
        for node, members in enumerate(own):
            below = [deeper.borders[c] for c in (2 * node, 2 * node + 1) if deeper.borders]
            border = np.unique(np.concatenate([np.unique(graph[members].indices), *below])).astype(np.int64)
            border = border[order.depth[border] < depth]
            borders.append(border[np.argsort(order.rank[border])])
        entering = np.flatnonzero(order.depth[order.early] == depth)
        parts = _groups([len(m) for m in own], [len(b) for b in borders])
        levels.append(tuple(_group(nodes, own, borders, entering, order, deeper) for nodes in parts))
        deeper = _Deeper(borders, np.argsort(np.concatenate(parts)), max(len(b) for b in borders))
    return Elimination(tuple(levels), verts)


def _groups(pivots: list[int], border: list[int], most: int = 3) -> list[list[int]]:
    """Split the fronts of a level into at most `most` groups of similar size, so that little work is spent on padding."""
    p, b = np.asarray(pivots), np.asarray(border)
    order = np.argsort(p + b, kind="stable")
    p, b = p[order], b[order]

    def cost(i, j):
        size, rim = p[i:j].max(), b[i:j].max()
        return (j - i) * size * (size + rim) ** 2 + 2e5  # in block products; the last: what a group costs by itself

    cuts = sorted({int(c) for c in np.linspace(0, len(p), 17)[1:-1]} - {0, len(p)})
    ways: list[tuple[int, ...]] = [()]
    for count in range(1, most):
        ways += itertools.combinations(cuts, count)
    ends = min(((0, *way, len(p)) for way in ways), key=lambda ends: sum(cost(i, j) for i, j in itertools.pairwise(ends)))
    return [sorted(order[i:j].tolist()) for i, j in itertools.pairwise(ends)]


# --- numbers --------------------------------------------------------------------------------------------------------


def _scalars(index: Array, size: int) -> Array:
    """Rows of scalars of rows of blocks."""
    return jnp.stack([size * index + i for i in range(size)], axis=-1).reshape(*index.shape[:-1], -1)


def factorise(order: Elimination, diagonal: Float[Array, "verts k k"], off: Float[Array, "pairs k k"]) -> Factor:
    """Factor a symmetric positive definite matrix of blocks of any one size; NaN where it is not."""
    dtype, k = diagonal.dtype, diagonal.shape[-1]
    inverses, borders = [], []
    updates = None
    token = jnp.zeros((), dtype)
    padded = jnp.concatenate([diagonal, jnp.eye(k, dtype=dtype)[None]])
    for level in order.levels:
        widest = max(g.border.shape[1] for g in level)
        count = sum(len(g.pivots) for g in level)
        left = jnp.zeros((count, k * (widest + 1), k * (widest + 1)), dtype)
        first = 0
        for group in level:
            fronts, p = group.pivots.shape
            b = group.border.shape[1]
            # One group after the other: LAPACK, called from two threads at once, hangs XLA's CPU client (jaxlib 0.10).
            rows = _entered(group, None if updates is None else _taken(group, updates, k, 0, p, 0), padded + 0 * token, off)
            # LAPACK reads by columns: of a symmetric matrix the transpose is the same one without a copy.
            lower = jnp.linalg.cholesky(jnp.swapaxes(rows[:, :, : k * p], 1, 2), symmetrize_input=False)
            eye = jnp.broadcast_to(jnp.eye(k * p, dtype=dtype), lower.shape)
            inverse = lax.linalg.triangular_solve(lower, eye, left_side=True, lower=True)
            row = jnp.einsum("fij,fjb->fib", inverse, rows[:, :, k * p :], precision="highest")
            inverses.append(inverse)
            borders.append(row)
            if b:
                token = row[0, 0, 0] if p else token
                update = -jnp.einsum("fpa,fpb->fab", row, row, precision="highest")
                if updates is not None:
                    update = _taken(group, updates, k, p, p + b, p) + update
                left = lax.dynamic_update_slice(left, update, (first, 0, 0))
            first += fronts
        updates = lax.optimization_barrier(left)
    return Factor(tuple(inverses), tuple(borders))


def _entered(group: Group, rows, diagonal, off):
    """Add the blocks of the matrix that enter at a group's fronts to the rows of their pivots, (fronts, k pivots, k local)."""
    (fronts, p), k = group.pivots.shape, off.shape[-1]
    m = p + group.border.shape[1]
    rows = (jnp.zeros((fronts, k * p, k * m), off.dtype) if rows is None else rows).reshape(fronts, p, k, m, k)
    if group.blocks.shape[0]:
        blocks = off[group.blocks]
        blocks = jnp.where(group.flipped[:, None, None] == 1, blocks, jnp.swapaxes(blocks, -1, -2))
        f, late, early = group.places.T
        rows = rows.at[f, early, :, late, :].add(blocks, mode="promise_in_bounds", unique_indices=True)
    own = jnp.arange(p)
    rows = rows.at[:, own, :, own, :].add(jnp.moveaxis(diagonal[group.pivots], 1, 0), unique_indices=True)
    return rows.reshape(fronts, k * p, k * m)


def _taken(group: Group, updates, k, top, bottom, left):
    """The sum of what the two children of every front leave to its rows from `top` to `bottom`, its columns from `left` on."""
    size = updates.shape[-1]
    rows = _scalars(required(group.children, "group.children")[:, :, top:bottom], k)
    columns = _scalars(required(group.columns, "group.columns")[:, :, left:], k)
    taken = updates.reshape(-1).at[rows[..., :, None] * size + columns[..., None, :]].get(mode="promise_in_bounds")
    taken = lax.optimization_barrier(taken)
    return taken[:, 0] + taken[:, 1]


def solve(order: Elimination, factor: Factor, right: Float[Array, "verts n"]) -> Float[Array, "verts n"]:
    """Return x with A x = right; where the blocks are numbers, of each of the n columns by itself."""
    groups = [g for level in order.levels for g in level]
    k = sum(inverse.shape[1] for inverse in factor.inverse) // sum(g.pivots.shape[1] for g in groups)
    columns = right.shape[1] // k
    x = jnp.concatenate([right, jnp.zeros_like(right[:1])])

    def product(equation, a, b):
        return jnp.einsum(equation, a, b, precision="highest")

    def rows(index):
        return x[index].reshape(len(index), k * index.shape[1], columns)

    halves = []
    for group, inverse, row in zip(groups, factor.inverse, factor.border, strict=True):
        y = product("fij,fjn->fin", inverse, rows(group.pivots))
        down = product("fpb,fpn->fbn", row, y)
        x = x.at[group.border].add(-down.reshape(*group.border.shape, right.shape[1]))
        halves.append(y)
    for group, inverse, row, y in zip(groups[::-1], factor.inverse[::-1], factor.border[::-1], halves[::-1], strict=True):
        y = y - product("fpb,fbn->fpn", row, rows(group.border))
        z = product("fij,fin->fjn", inverse, y)
        x = x.at[group.pivots].set(z.reshape(*group.pivots.shape, right.shape[1])).at[-1].set(0)
    return x[:-1]

"""Which parts of a garment are near each other, and which pass through each other: a search that misses nothing.

Vertices, edges and faces lie in compact groups of 32, found once in the rest shape. Boxes around the groups name the groups
that can touch; the box of every member of the one is then held against that of every member of the other, without a gather, and
the answers are the bits of a word, so that a list is made from words instead of from the table. What is left is looked at
exactly. A hash of cells (Teschner et al. 2003) would make the same list by a gather or two for each candidate, and its cells
would have to be as large as the longest edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.surface import compact_groups
from ncs_jax.geometry.closest_point import ratio, triangle_weights
from ncs_jax.geometry.mesh import Mesh, topology
from ncs_jax.geometry.numerics import norm
from ncs_jax.geometry.soa_vectors import cross, dot, minus

__all__ = [
    "CHUNK",
    "LEAST",
    "Groups",
    "Pairs",
    "candidate_room",
    "corners_of",
    "edge_weights",
    "groups_from",
    "keep_candidates",
    "nearby_pairs",
    "overlapping_members",
    "point_weights",
    "separation",
]


WORD = 32  # members of a group, bits of a word
CHUNK = 4096  # candidates looked at in one pass
TILES = 256  # pairs of groups looked at in one pass
TILES_EACH = 24  # room: pairs of groups for every group
CANDIDATES_EACH = 8  # and pairs of members for every member
POINTS_EACH, EDGES_EACH, LEAST = 2, 6, 4096  # pairs in the lists for every vertex, and in the shortest list


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Groups:
    """A mesh's vertices, edges and faces in compact groups of at most 32, the last member repeated where one is short."""

    verts: Int[Array, "vertex_groups 32"]
    edges: Int[Array, "edge_groups 32"]
    faces: Int[Array, "face_groups 32"]
    edge_sides: Int[Array, "edges 2"]  # the faces of each edge, -1 where there is none


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pairs:
    """Pairs of primitives by their vertices: point and triangle (p, a, b, c), edge and edge (a, b, c, d).

    `rest` is the pairs' distance in the rest shape in m, first of the points, then of the edges; where a list is not full, four
    times vertex 0 at distance zero, which no law feels. `overflow`: there are more pairs than the lists hold.
    """

    points: Int[Array, "*batch points 4"]
    edges: Int[Array, "*batch edges 4"]
    rest: Float[Array, "*batch pairs"]
    overflow: Bool[Array, "*batch"]


def groups_from(mesh: Mesh) -> Groups:
    """Group a mesh by its rest shape."""
    rest, faces, edges = (np.asarray(a) for a in (mesh.rest, mesh.faces, mesh.edges))

    def grouped(points):
        groups = compact_groups(points, WORD)
        return jnp.asarray(np.pad(groups, ((0, 0), (0, WORD - groups.shape[1])), mode="edge"))

    sides = topology(faces)[1]  # in the order of mesh.edges
    return Groups(
        grouped(rest), grouped(rest[edges].mean(axis=1)), grouped(rest[faces].mean(axis=1)), jnp.asarray(sides)
    )  # fmt: skip


def corners_of(x: Float[Array, "verts 3"], vertices: Int[Array, "pairs 4"]) -> Float[Array, "4 3 pairs"]:
    """Return positions of the pairs' vertices, the pairs on the last axis, where they fill the vector lanes."""
    return jnp.transpose(x[vertices], (1, 2, 0))


def point_weights(corners: Float[Array, "4 3 pairs"]) -> Float[Array, "4 pairs"]:
    """Return (1, -a, -b, -c) of a point and a triangle, whose closest point has the barycentric coordinates (a, b, c)."""
    weights = triangle_weights(*corners)
    return jnp.stack([jnp.ones_like(weights[0]), *(-w for w in weights)])


def edge_weights(corners: Float[Array, "4 3 pairs"]) -> Float[Array, "4 pairs"]:
    """Return (1 - s, s, t - 1, -t) of two edges with closest points x_0 + s (x_1 - x_0) and x_2 + t (x_3 - x_2).

    Where edges are parallel, one of their many closest pairs of points. Source: Ericson 2005, 5.1.9, with s of the two lines
    from cross products, s = (r x v) . (u x v) / |u x v|^2, which do not cancel.
    """
    a, b, c, d = corners
    u, v, r = minus(b, a), minus(d, c), minus(c, a)
    n = cross(u, v)
    square = dot(n, n)
    s = jnp.where(square > 0, ratio(dot(cross(r, v), n), square), 0.5)
    t = ratio(s * dot(u, v) - dot(r, v), dot(v, v))
    s = ratio(t * dot(u, v) + dot(r, u), dot(u, u))
    return jnp.stack([1 - s, s, t - 1, -t])


def separation(corners: Float[Array, "4 3 pairs"], weights: Float[Array, "4 pairs"]) -> Float[Array, "3 pairs"]:
    """Return the way from the second primitive's closest point to the first's, sum_i w_i x_i in m; weights add up to zero."""
    return jnp.sum(weights[1:, None] * (corners[1:] - corners[:1]), axis=0)


def _words(mask):
    """The last axis of 32 truth values as the bits of a word."""
    bits = jnp.left_shift(jnp.uint32(1), jnp.arange(WORD, dtype=jnp.uint32))
    return jnp.sum(jnp.where(mask, bits.reshape((1,) * (mask.ndim - 1) + (WORD,)), jnp.uint32(0)), axis=-1, dtype=jnp.uint32)


def _running(counts):
    """Sums of all up to and with each, by rows of 64: several times as fast as in one go."""
    rows = jnp.pad(counts, (0, -len(counts) % 64)).reshape(-1, 64)
    sums = jnp.cumsum(rows, axis=1, dtype=jnp.int32)
    before = jnp.cumsum(sums[:, -1], dtype=jnp.int32) - sums[:, -1]
    return (sums + before[:, None]).reshape(-1)[: len(counts)]


def _entries(words, most: int):
    """Word and bit of every set bit, in order, at most `most` of them, and how many there are."""
    counts = lax.population_count(words).astype(jnp.int32)
    ends = _running(counts)
    row = jnp.minimum(_running(jnp.zeros(most, jnp.int32).at[ends].add(1, mode="drop")), len(words) - 1)
    rank = jnp.arange(most, dtype=jnp.int32) - (ends - counts)[row]
    word, column = words[row], jnp.zeros(most, jnp.int32)
    for half in (16, 8, 4, 2, 1):  # is the bit of this rank in the upper half?
        below = lax.population_count(word & jnp.uint32(2**half - 1)).astype(jnp.int32)
        above = rank >= below
        word = jnp.where(above, word >> jnp.uint32(half), word)
        rank, column = rank - jnp.where(above, below, 0), column + jnp.where(above, half, 0)
    return row, column, ends[-1]


def _boxes(x, moved, corners, groups, radius):
    """Low and high corners of the boxes that lie `radius` around the members of the groups, there and where they are moved to,
    (groups, 6, 32).

    Empty where a group repeats a member.
    """
    p, q = x[corners], moved[corners]
    low = jnp.minimum(jnp.min(p, axis=1), jnp.min(q, axis=1)) - radius
    high = jnp.maximum(jnp.max(p, axis=1), jnp.max(q, axis=1)) + radius
    repeated = jnp.concatenate([jnp.zeros_like(groups[:, :1], bool), groups[:, 1:] == groups[:, :-1]], axis=1)[:, None]
    low, high = (jnp.swapaxes(k[groups], 1, 2) for k in (low, high))
    return jnp.concatenate([jnp.where(repeated, jnp.inf, low), jnp.where(repeated, -jnp.inf, high)], axis=1)


def _overlap(low, high, down, up):
    """Whether two boxes overlap, from their components."""
    meet = jnp.bool_(True)
    for c in range(3):
        meet = meet & (low[c] <= up[c]) & (down[c] <= high[c])
    return meet


def overlapping_members(x, first, second, radius, most: int, moved=None):
    """Find the members (i, j) whose boxes overlap and that share no vertex: at most `most` of them; how many there are; and
    whether that is more than there is room for.

    `first` and `second`: the vertices of the members, and their groups; where both are the same, every pair once. `moved`:
    where the vertices go; the boxes then hold the way.
    """
    same = first is second
    (corners, groups), (others, other_groups) = first, second
    moved = x if moved is None else moved
    mine, theirs = _boxes(x, moved, corners, groups, radius), _boxes(x, moved, others, other_groups, jnp.zeros_like(radius))
    names, other_names = (jnp.swapaxes(k[g], 1, 2) for k, g in (first, second))

    def bounds(boxes):
        return jnp.min(boxes[:, :3], axis=2).T, jnp.max(boxes[:, 3:], axis=2).T

    (low, high), (down, up) = bounds(mine), bounds(theirs)
    meet = _overlap(low[:, :, None], high[:, :, None], down[:, None], up[:, None])
    if same:
        meet = jnp.triu(meet)
    columns = -(-len(theirs) // WORD)
    meet = jnp.pad(meet, ((0, 0), (0, columns * WORD - len(theirs))))
    tiles = -(-TILES_EACH * max(len(mine), len(theirs)) // TILES) * TILES
    row, column, count = _entries(_words(meet.reshape(-1, WORD)), tiles)
    i, j = row // columns, row % columns * WORD + column

    lane = jnp.arange(WORD, dtype=jnp.uint32)
    later = jnp.where(lane < WORD - 1, ~(jnp.left_shift(jnp.uint32(2), lane) - jnp.uint32(1)), jnp.uint32(0))

    def look(state):
        start, words = state
        here, there = (lax.dynamic_slice(k, (start,), (TILES,)) for k in (i, j))
        a, a_names = (jnp.moveaxis(k[here], 1, 0) for k in (mine, names))

        def against(word, member):
            k, b, b_names = member
            meet = _overlap(a[:3], a[3:], b[:3], b[3:])
            for p in a_names:
                for q in b_names:
                    meet = meet & (p != q)
            return word | jnp.where(meet, jnp.left_shift(jnp.uint32(1), k), jnp.uint32(0)), None

        members = (lane, *(jnp.moveaxis(k[there], (2, 1), (0, 1))[..., None] for k in (theirs, other_names)))
        word = lax.scan(against, jnp.zeros((TILES, WORD), jnp.uint32), members)[0]
        if same:
            word = jnp.where((here == there)[:, None], word & later[None], word)
        word = jnp.where((start + jnp.arange(TILES, dtype=jnp.int32) < count)[:, None], word, jnp.uint32(0))
        return start + TILES, lax.dynamic_update_slice(words, word, (start, jnp.int32(0)))

    start = (jnp.int32(0), jnp.zeros((tiles, WORD), jnp.uint32))
    words = lax.while_loop(lambda state: state[0] < jnp.minimum(count, tiles), look, start)[1]
    row, column, found = _entries(words.reshape(-1), most)
    pair, place = row // WORD, row % WORD
    return groups[i[pair], place], other_groups[j[pair], column], found, (count > tiles) | (found > most)


def keep_candidates(keep, first, second, found, most: int):
    """Return the candidates that `keep` keeps, at most `most`; whether each is one; whether there are more."""

    def look(state):
        start, kept = state
        here, there = (lax.dynamic_slice(k, (start,), (CHUNK,)) for k in (first, second))
        good = keep(here, there) & (start + jnp.arange(CHUNK, dtype=jnp.int32) < found)
        return start + CHUNK, lax.dynamic_update_slice(kept, good, (start,))

    state = (jnp.int32(0), jnp.zeros(len(first), bool))
    kept = lax.while_loop(lambda state: state[0] < jnp.minimum(found, len(first)), look, state)[1]
    row, column, count = _entries(_words(kept.reshape(-1, WORD)), most)
    slot = row * WORD + column
    return first[slot], second[slot], jnp.arange(most, dtype=jnp.int32) < count, count > most


def candidate_room(count: int) -> int:
    """Return how many candidates of so many members there is room for."""
    return -(-max(CANDIDATES_EACH * count, 4 * LEAST) // CHUNK) * CHUNK


def nearby_pairs(x: Float[Array, "verts 3"], mesh: Mesh, groups: Groups, radius: Float[Array, ""] | float) -> Pairs:
    """Find all pairs of point and triangle, and of edge and edge, that are nearer than `radius` and share no vertex.

    Args:
        x: (verts, 3) positions in m, a constant to the derivative. mesh, groups: of the garment. radius: in m.

    The lists hold two points and six pairs of edges for every vertex: cloth that lies on cloth everywhere, with a radius of a
    sixth of its edges' length. Where that is not enough, or the cloth is so crumpled that the search itself runs out of room,
    `overflow` says so.
    """
    x = lax.stop_gradient(x)
    radius = lax.stop_gradient(jnp.asarray(radius, x.dtype))

    def listed(first, second, weigh, most):
        i, j, found, full = overlapping_members(x, first, second, radius, candidate_room(len(second[0])))
        corners, others = first[0], second[0]
        one, other = (x[k].reshape(len(k), -1) for k in (corners, others))  # a row each, so that one look is enough

        def keep(i, j):
            p = jnp.concatenate([one[i].T, other[j].T]).reshape(4, 3, -1)
            gap = separation(p, weigh(p))
            return dot(gap, gap) < radius**2

        i, j, real, fuller = keep_candidates(keep, i, j, found, most)
        vertices = jnp.where(real[:, None], jnp.concatenate([corners[i], others[j]], axis=1), 0)
        rest = corners_of(mesh.rest, vertices)
        return vertices, norm(separation(rest, weigh(rest)).T), full | fuller

    verts, edges = (jnp.arange(len(x), dtype=jnp.int32)[:, None], groups.verts), (mesh.edges, groups.edges)
    points, points_rest, full = listed(verts, (mesh.faces, groups.faces), point_weights, max(POINTS_EACH * len(x), LEAST))
    crossings, crossings_rest, fuller = listed(edges, edges, edge_weights, max(EDGES_EACH * len(x), LEAST))
    return Pairs(points, crossings, jnp.concatenate([points_rest, crossings_rest]), full | fuller)

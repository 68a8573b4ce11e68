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

from ncs_jax.energies.collision import compact_groups
from ncs_jax.mesh import Mesh, topology
from ncs_jax.numerics import norm

__all__ = [
    "Groups",
    "Pairs",
    "corners_of",
    "edge_weights",
    "free_share",
    "groups_from",
    "intersecting",
    "nearby_pairs",
    "point_weights",
    "separation",
    "swept_share",
    "yielding",
]

WORD = 32  # members of a group, bits of a word
CHUNK = 4096  # candidates looked at in one pass
TILES = 256  # pairs of groups looked at in one pass

TILES_EACH = 24  # room: pairs of groups for every group
CANDIDATES_EACH = 8  # and pairs of members for every member
PASSES = 16  # over the pairs until none is brought too near
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


# --- distances ----------------------------------------------------------------------------------------------------------


def corners_of(x: Float[Array, "verts 3"], vertices: Int[Array, "pairs 4"]) -> Float[Array, "4 3 pairs"]:
    """Positions of the pairs' vertices, the pairs on the last axis, where they fill the vector lanes."""
    return jnp.transpose(x[vertices], (1, 2, 0))


# A vector is three arrays, one a component: stacked, the compiler would not keep them in its registers.


def _minus(p, q):
    return [p[i] - q[i] for i in range(3)]


def _dot(p, q):
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _cross(p, q):
    return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]


def _ratio(p, q):
    return jnp.clip(p / jnp.where(q > 0, q, 1), 0, 1)


def point_weights(corners: Float[Array, "4 3 pairs"]) -> Float[Array, "4 pairs"]:
    """(1, -a, -b, -c): of a point and a triangle, whose closest point has the barycentric coordinates (a, b, c).

    The nearest of the three edges, unless the point lies over the inside. Source: Ericson 2005, 5.1.5.
    """
    p, a, b, c = corners
    ab, bc, ca = _minus(b, a), _minus(c, b), _minus(a, c)
    pa, pb, pc = _minus(p, a), _minus(p, b), _minus(p, c)
    n = _cross(bc, ca)
    square = _dot(n, n)
    whole = jnp.where(square > 0, square, 1)
    face = [_dot(_cross(e, q), n) / whole for e, q in ((bc, pb), (ca, pc), (ab, pa))]
    inside = (face[0] > 0) & (face[1] > 0) & (face[2] > 0) & (square > 0)

    def edge(q, e):
        t = _ratio(_dot(q, e), _dot(e, e))
        gap = [q[i] - t * e[i] for i in range(3)]
        return t, _dot(gap, gap)

    (s, first), (t, second), (u, third) = edge(pa, ab), edge(pb, bc), edge(pc, ca)
    on_first, on_second = (first <= second) & (first <= third), second <= third
    border = [
        jnp.where(on_first, 1 - s, jnp.where(on_second, 0, u)),
        jnp.where(on_first, s, jnp.where(on_second, 1 - t, 0)),
        jnp.where(on_first, 0, jnp.where(on_second, t, 1 - u)),
    ]
    closest = [jnp.where(inside, f, e) for f, e in zip(face, border, strict=True)]
    return jnp.stack([jnp.ones_like(s), *(-w for w in closest)])


def edge_weights(corners: Float[Array, "4 3 pairs"]) -> Float[Array, "4 pairs"]:
    """(1 - s, s, t - 1, -t): of two edges whose closest points are x_0 + s (x_1 - x_0) and x_2 + t (x_3 - x_2).

    Where edges are parallel, one of their many closest pairs of points. Source: Ericson 2005, 5.1.9, with s of the two lines
    from cross products, s = (r x v) . (u x v) / |u x v|^2, which do not cancel.
    """
    a, b, c, d = corners
    u, v, r = _minus(b, a), _minus(d, c), _minus(c, a)
    n = _cross(u, v)
    square = _dot(n, n)
    s = jnp.where(square > 0, _ratio(_dot(_cross(r, v), n), square), 0.5)
    t = _ratio(s * _dot(u, v) - _dot(r, v), _dot(v, v))
    s = _ratio(t * _dot(u, v) + _dot(r, u), _dot(u, u))
    return jnp.stack([1 - s, s, t - 1, -t])


def separation(corners: Float[Array, "4 3 pairs"], weights: Float[Array, "4 pairs"]) -> Float[Array, "3 pairs"]:
    """From the closest point of the second primitive to that of the first, sum_i w_i x_i in m; the weights add up to zero."""
    return jnp.sum(weights[1:, None] * (corners[1:] - corners[:1]), axis=0)


# --- search -------------------------------------------------------------------------------------------------------------


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


def _meeting(x, first, second, radius, most: int, moved=None):
    """Which members (i, j) have boxes that overlap and no vertex in common: at most `most` of them; how many there are; and
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


def _kept(keep, first, second, found, most: int):
    """Of the candidates those that `keep` keeps, at most `most`; whether each is one; whether there are more."""

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


def _room(count: int) -> int:
    """For the candidates of so many members."""
    return -(-max(CANDIDATES_EACH * count, 4 * LEAST) // CHUNK) * CHUNK


def nearby_pairs(x: Float[Array, "verts 3"], mesh: Mesh, groups: Groups, radius: Float[Array, ""] | float) -> Pairs:
    """All pairs of point and triangle, and of edge and edge, that are nearer than `radius` and share no vertex.

    Args:
        x: (verts, 3) positions in m, a constant to the derivative. mesh, groups: of the garment. radius: in m.

    The lists hold two points and six pairs of edges for every vertex: cloth that lies on cloth everywhere, with a radius of a
    sixth of its edges' length. Where that is not enough, or the cloth is so crumpled that the search itself runs out of room,
    `overflow` says so.
    """
    x = lax.stop_gradient(x)
    radius = lax.stop_gradient(jnp.asarray(radius, x.dtype))

    def listed(first, second, weigh, most):
        i, j, found, full = _meeting(x, first, second, radius, _room(len(second[0])))
        corners, others = first[0], second[0]
        one, other = (x[k].reshape(len(k), -1) for k in (corners, others))  # a row each, so that one look is enough

        def keep(i, j):
            p = jnp.concatenate([one[i].T, other[j].T]).reshape(4, 3, -1)
            gap = separation(p, weigh(p))
            return _dot(gap, gap) < radius**2

        i, j, real, fuller = _kept(keep, i, j, found, most)
        vertices = jnp.where(real[:, None], jnp.concatenate([corners[i], others[j]], axis=1), 0)
        rest = corners_of(mesh.rest, vertices)
        return vertices, norm(separation(rest, weigh(rest)).T), full | fuller

    verts, edges = (jnp.arange(len(x), dtype=jnp.int32)[:, None], groups.verts), (mesh.edges, groups.edges)
    points, points_rest, full = listed(verts, (mesh.faces, groups.faces), point_weights, max(POINTS_EACH * len(x), LEAST))
    crossings, crossings_rest, fuller = listed(edges, edges, edge_weights, max(EDGES_EACH * len(x), LEAST))
    return Pairs(points, crossings, jnp.concatenate([points_rest, crossings_rest]), full | fuller)


def _free(x, p, vertices, rest, weigh, split: int):
    """The share of the move p on which each pair stays apart; `split` vertices are its first primitive's.

        t = 0.9 d / max_ij n . (p_j - p_i),   i in the first primitive, j in the second

    Both are convex, so between them lies a slab of width d across n, which cannot shrink faster than the fastest two of their
    vertices approach along n. Pairs that touch, d = 0, or do in the rest shape, do not hinder. Source: Li et al. 2020, 5 (steps
    that keep apart), here by separating planes.
    """
    at, moves = corners_of(x, vertices), corners_of(p, vertices)
    gap = separation(at, weigh(at))
    distance = jnp.sqrt(_dot(gap, gap))
    along = jnp.sum(moves * gap[None], axis=1)  # times the distance
    closing = jnp.max(along[split:], axis=0) - jnp.min(along[:split], axis=0)
    hinders = (closing > 0) & (distance > 0) & (rest > 0)
    return jnp.where(hinders, 0.9 * distance**2 / jnp.where(hinders, closing, 1), 1)


def _relative(p):
    """Moves without what moves nothing against anything, the middle of their bounding box."""
    return p - (jnp.min(p, axis=0, keepdims=True) + jnp.max(p, axis=0, keepdims=True)) / 2


def free_share(x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], pairs: Pairs, radius) -> Float[Array, ""]:
    """Largest share t, at most 1, of the move p (m) on whose way no pair can pass through each other.

    The listed pairs by planes between them (see `_free`); all others are `radius` apart (m, of the search that found the
    pairs), of which no two vertices use up more than 0.9.
    """
    p = _relative(p)
    points, edges = pairs.rest[: len(pairs.points)], pairs.rest[len(pairs.points) :]
    listed = jnp.concatenate(
        [_free(x, p, pairs.points, points, point_weights, 1), _free(x, p, pairs.edges, edges, edge_weights, 2)]
    )
    far = 2 * jnp.sqrt(jnp.max(jnp.sum(p**2, axis=-1)))
    return jnp.minimum(jnp.min(listed, initial=1), 0.9 * radius / jnp.maximum(far, 0.9 * radius))


def yielding(x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], pairs: Pairs) -> Float[Array, "verts 3"]:
    """The move p (m) without what would bring the listed pairs of x nearer than a fifth of their distance, as far as it goes.

    A plane across n midway between the two goes with them, at the mean of their vertices' speeds along n. What carries a vertex
    nearer to it than allowed is taken off, the mean over its pairs, until nothing is left or `PASSES` times. So one pair that
    closes does not hold up the whole garment. Source: Mueller et al. 2007 (constraints one by one, on the places themselves).
    """

    def planes(vertices, rest, weigh, split):
        at = corners_of(x, vertices)
        gap = separation(at, weigh(at)).T
        distance = norm(gap)
        allowed = jnp.where((distance > 0) & (rest > 0), 0.4 * distance, jnp.inf)
        return vertices, gap / jnp.where(distance > 0, distance, 1)[:, None], allowed[:, None], split

    count = len(pairs.points)
    both = planes(pairs.points, pairs.rest[:count], point_weights, 1), planes(pairs.edges, pairs.rest[count:], edge_weights, 2)

    def one(state):
        p, _, passes = state
        table = jnp.zeros((len(p), 4), p.dtype)
        for vertices, n, allowed, split in both:
            speed = jnp.sum(p[vertices] * n[:, None], axis=-1)
            first, second = speed[:, :split], speed[:, split:]
            plane = (jnp.mean(first, axis=1, keepdims=True) + jnp.mean(second, axis=1, keepdims=True)) / 2
            off = jnp.maximum(plane - allowed - first, 0), jnp.minimum(plane + allowed - second, 0)
            off = jnp.concatenate(off, axis=1)
            each = jnp.concatenate([off[..., None] * n[:, None], (off != 0)[..., None].astype(p.dtype)], axis=-1)
            table = table.at[vertices.reshape(-1)].add(each.reshape(-1, 4))
        return p + table[:, :3] / jnp.maximum(table[:, 3:], 1), jnp.any(table[:, 3] > 0), passes + 1

    middle = p - _relative(p)
    state = (p - middle, jnp.bool_(True), jnp.int32(0))
    return lax.while_loop(lambda state: state[1] & (state[2] < PASSES), one, state)[0] + middle


def swept_share(
    x: Float[Array, "verts 3"], p: Float[Array, "verts 3"], mesh: Mesh, groups: Groups
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """As `free_share`, of all pairs whose ways' boxes overlap, however long the way; and whether the search that finds them ran
    out of room."""
    x, p = lax.stop_gradient(x), _relative(lax.stop_gradient(p))

    def share(first, second, weigh, most):
        i, j, found, full = _meeting(x, first, second, jnp.zeros((), x.dtype), most, x + p)
        corners, others = first[0], second[0]
        split = corners.shape[1]

        def look(state):
            start, least = state
            here, there = (lax.dynamic_slice(k, (start,), (CHUNK,)) for k in (i, j))
            vertices = jnp.concatenate([corners[here], others[there]], axis=1)
            rest = corners_of(mesh.rest, vertices)
            apart = separation(rest, weigh(rest))
            t = _free(x, p, vertices, _dot(apart, apart), weigh, split)
            t = jnp.where(start + jnp.arange(CHUNK, dtype=jnp.int32) < found, t, 1)
            return start + CHUNK, jnp.minimum(least, jnp.min(t))

        state = (jnp.int32(0), jnp.ones((), x.dtype))
        return lax.while_loop(lambda state: state[0] < jnp.minimum(found, most), look, state)[1], full

    verts, edges = (jnp.arange(len(x), dtype=jnp.int32)[:, None], groups.verts), (mesh.edges, groups.edges)
    room = 4 * _room(len(mesh.edges))  # ways are longer than what lies still
    points, full = share(verts, (mesh.faces, groups.faces), point_weights, room)
    crossings, fuller = share(edges, edges, edge_weights, room)
    return jnp.minimum(points, crossings), full | fuller


def intersecting(x: Float[Array, "verts 3"], mesh: Mesh, groups: Groups) -> tuple[Bool[Array, "faces"], Bool[Array, ""]]:
    """Which triangles pass through another that shares no vertex with them, and whether the search ran out of room.

    Two triangles pass through each other where an edge of one goes through the inside of the other; triangles in one plane, or
    that only touch, do not. An edge p q goes through a triangle a b c where p and q lie on different sides of it, and p q on
    one side of all three edges: signs of volumes. Source: Moeller and Trumbore 1997; Ericson 2005, 5.3.4.
    """
    x = lax.stop_gradient(x)
    ends, corners = (x[k].reshape(len(k), -1) for k in (mesh.edges, mesh.faces))

    rounding = 8 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x))  # m: so near to its plane, a point is on no side of a triangle

    def keep(i, j):
        p, q = ends[i].T.reshape(2, 3, -1)
        a, b, c = corners[j].T.reshape(3, 3, -1)
        n = _cross(_minus(b, a), _minus(c, a))
        above, below = _dot(_minus(p, a), n), _dot(_minus(q, a), n)
        a, b, c, along = (_minus(k, p) for k in (a, b, c, q))
        around = [_dot(along, _cross(f, g)) for f, g in ((a, b), (b, c), (c, a))]
        inside = (around[0] > 0) & (around[1] > 0) & (around[2] > 0) | (around[0] < 0) & (around[1] < 0) & (around[2] < 0)
        least = rounding * jnp.sqrt(_dot(n, n))
        return inside & ((above > least) & (below < -least) | (above < -least) & (below > least))

    first, second = (mesh.edges, groups.edges), (mesh.faces, groups.faces)
    i, j, found, full = _meeting(x, first, second, jnp.zeros((), x.dtype), _room(len(mesh.edges)))
    i, j, real, fuller = _kept(keep, i, j, found, max(4 * len(mesh.faces), LEAST))
    sides = groups.edge_sides[i]
    shared = jnp.any(mesh.faces[sides][:, :, :, None] == mesh.faces[j][:, None, None, :], axis=(2, 3))
    counts = (sides >= 0) & ~shared & real[:, None]
    sides = jnp.where(counts, sides, len(mesh.faces))
    hit = jnp.where(jnp.any(counts, axis=-1), j, len(mesh.faces))
    marked = jnp.zeros(len(mesh.faces), bool).at[sides.reshape(-1)].set(True, mode="drop").at[hit].set(True, mode="drop")
    return marked, full | fuller

"""Collision with the body, equation (12), from two signed distances, each with exact and with candidate search.

A distance is found in two parts. The *search* names the nearest body vertex or triangle of every cloth vertex; it works on
integers and carries no derivative. The *distance* is then a smooth function of the cloth and of that feature.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.mesh import corners, topology, vertex_rings
from ncs_jax.numerics import angle_between, normalize
from ncs_jax.vectors import cross, direction, dot, minus

__all__ = [
    "Surface",
    "closest_weights",
    "collision",
    "compact_groups",
    "face_normals",
    "nearest_groups",
    "nearest_triangle",
    "nearest_vertex",
    "plane_distance",
    "relisted",
    "surface_from",
    "triangle_distance",
    "vertex_normals",
]

NEAR = 32  # groups of the body's triangles that a group of cloth looks at in a pose of its own


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surface:
    """What collision needs to know once about the part of the body that a garment can touch.

    `cloth_blocks`, `vertex_blocks` and `face_blocks` are compact groups of cloth vertices, body vertices and body faces,
    the last entry repeated where a group is short; `cloth_place` finds a cloth vertex in its group. `vertex_lists` and
    `face_lists` name the body groups that each cloth group searches first.
    """

    faces: Int[Array, "faces 3"]
    rings: Int[Array, "body most"]
    face_edges: Int[Array, "faces 3"]
    edge_sides: Int[Array, "edges 2"]
    border: Bool[Array, "body"]  # on the rim where the touchable part was cut out of the body
    cloth_blocks: Int[Array, "blocks size"]
    cloth_place: Int[Array, "verts"]
    vertex_blocks: Int[Array, "clusters vertices"]
    vertex_lists: Int[Array, "near_clusters blocks"]
    face_blocks: Int[Array, "groups triangles"]
    face_lists: Int[Array, "near_groups blocks"]
    spacing: Float[Array, ""]  # mean edge length of the resting body, m
    groups: int = field(metadata={"static": True})  # how many body groups a cloth group looks at


def compact_groups(points: np.ndarray, size: int) -> np.ndarray:
    """Halve the points along their longest extent until no group is larger than `size`; (groups, largest) indices."""
    groups = [np.arange(len(points))]
    while max(len(g) for g in groups) > size:
        halves = []
        for g in groups:
            axis = np.ptp(points[g], axis=0).argmax()
            g = g[np.argsort(points[g, axis], kind="stable")]
            halves += [g[: (len(g) + 1) // 2], g[(len(g) + 1) // 2 :]]
        groups = [g for g in halves if len(g)]
    largest = max(len(g) for g in groups)
    return np.stack([np.pad(g, (0, largest - len(g)), mode="edge") for g in groups]).astype(np.int32)


def _boxed(points, blocks):
    """Lowest and highest corners (3, groups) of the boxes around groups of points (count, 3) or of triangles' corners."""
    grouped = np.asarray(points, np.float32)[blocks].reshape(len(blocks), -1, 3)
    return grouped.min(axis=1).T, grouped.max(axis=1).T


def _lists(posed, cloth_blocks, body_blocks, count) -> np.ndarray:
    """The `count` body groups that come nearest to each cloth group in any pose [(cloth, body)]: (count, cloth groups)."""
    least = np.full((len(cloth_blocks), len(body_blocks)), np.inf, np.float32)
    for cloth, body in posed:
        (low, high), (below, above) = _boxed(cloth, cloth_blocks), _boxed(body, body_blocks)
        apart = centres = np.zeros(())
        for i in range(3):
            gap = np.maximum(np.maximum(below[i] - high[i][:, None], low[i][:, None] - above[i]), 0)
            middle = (low[i] + high[i])[:, None] / 2 - (below[i] + above[i]) / 2
            apart, centres = apart + gap * gap, centres + middle * middle
        np.minimum(least, np.sqrt(apart) + 1e-3 * np.sqrt(centres), out=least)
    return np.argsort(least, axis=1, kind="stable")[:, :count].T.astype(np.int32)


def relisted(surface: Surface, posed: Sequence[tuple[np.ndarray, np.ndarray]]) -> Surface:
    """The same, its search for the nearest vertex prepared for what is near what in these poses [(cloth, body)]."""
    lists = _lists(posed, np.asarray(surface.cloth_blocks), np.asarray(surface.vertex_blocks), surface.groups)
    return replace(surface, vertex_lists=jax.device_put(lists))


def surface_from(
    cloth: np.ndarray,
    body: np.ndarray,
    faces: np.ndarray,
    *,
    smooth: bool = False,
    posed: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> Surface:
    """Group the cloth and the touchable body by their rest positions (verts, 3), (body, 3), m; faces (faces, 3) of the body.

    `posed`: the two in some poses of the motion, from which to tell what is usually near what; at rest where there is none.
    `smooth`: for `nearby_quadrics`, which takes smaller groups of the body; otherwise for the searches, where the sizes are a
    balance of what a group looks at, what it proves at once and what is left to be searched in full (a coarse garment: smaller
    groups that look at more, since its far corners leave less proved).
    """
    fine = (16, 8, 32) if len(cloth) >= 2048 else (8, 8, 64)
    cloth_size, body_size, groups = (24, 4, 40) if smooth else fine
    cloth_size = max(8, min(cloth_size, len(cloth) // (128 if smooth else 64)))
    cloth, body, faces = np.asarray(cloth), np.asarray(body), np.asarray(faces)
    cloth_blocks = compact_groups(cloth, cloth_size)
    vertex_blocks, face_blocks = compact_groups(body, body_size), compact_groups(body[faces].mean(axis=1), body_size)
    place = np.zeros(len(cloth), np.int32)
    place[cloth_blocks.reshape(-1)] = np.arange(cloth_blocks.size)
    posed = posed or [(cloth, body)]
    edges, sides, _ = topology(faces)
    key = np.sort(edges, axis=1) @ [len(body), 1]
    order = np.argsort(key)
    wanted = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1) @ [len(body), 1]
    face_edges = order[np.searchsorted(key[order], wanted)]
    border = np.zeros(len(body), bool)
    border[edges[sides[:, 1] < 0]] = True
    return Surface(
        faces=jax.device_put(faces.astype(np.int32)),
        rings=jax.device_put(vertex_rings(faces, len(body))),
        face_edges=jax.device_put(face_edges.astype(np.int32)),
        edge_sides=jax.device_put(sides),
        border=jax.device_put(border),
        cloth_blocks=jax.device_put(cloth_blocks),
        cloth_place=jax.device_put(place),
        vertex_blocks=jax.device_put(vertex_blocks),
        vertex_lists=jax.device_put(_lists(posed, cloth_blocks, vertex_blocks, groups)),
        face_blocks=jax.device_put(face_blocks),
        face_lists=jax.device_put(_lists(posed, cloth_blocks, faces[face_blocks], groups)),
        spacing=jnp.asarray(np.linalg.norm(body[edges[:, 0]] - body[edges[:, 1]], axis=1).mean(), jnp.float32),
        groups=groups,
    )


def face_normals(body: Float[Array, "body 3"], faces: Int[Array, "faces 3"]) -> Float[Array, "faces 3"]:
    """Unit normals; zero for a collapsed face."""
    a, b, c = body[faces[:, 0]], body[faces[:, 1]], body[faces[:, 2]]
    return normalize(jnp.cross(b - a, c - a))


def vertex_normals(body: Float[Array, "body 3 *poses"], surface: Surface) -> Float[Array, "body 3 *poses"]:
    """Area-weighted unit normals of the body's vertices."""
    a, b, c = corners(body, surface.faces)
    area = jnp.stack(cross(minus(b, a), minus(c, a)), axis=1)
    around = [jnp.take(area, at, axis=0, mode="fill", fill_value=0) for at in surface.rings.T]
    total = sum(around, start=jnp.zeros_like(body))
    return jnp.stack(direction([total[:, i] for i in range(3)]), axis=1)


# --- search ---------------------------------------------------------------------------------------------------------


def _squared_to_points(x, points):
    """|x - p|^2 with the components on the leading axis, kept apart so that the cloth fills the vector lanes."""
    return sum((x[i] - points[i]) ** 2 for i in range(3))


def _squared_to_triangles(x, triangle):
    """Exact squared distance to triangles, corner by corner and component by component."""
    a, b, c = triangle

    def to_segment(p, edge):
        length = dot(edge, edge)
        t = jnp.clip(dot(p, edge) / jnp.where(length > 0, length, 1), 0, 1)
        rest = [p[i] - t * edge[i] for i in range(3)]
        return dot(rest, rest)

    ab, bc, ca = minus(b, a), minus(c, b), minus(a, c)
    normal = cross(ab, minus(c, a))
    square = dot(normal, normal)
    pa, pb, pc = minus(x, a), minus(x, b), minus(x, c)
    inside = (dot(cross(ab, pa), normal) > 0) & (dot(cross(bc, pb), normal) > 0) & (dot(cross(ca, pc), normal) > 0)
    plane = dot(pa, normal) ** 2 / jnp.where(square > 0, square, 1)
    border = jnp.minimum(jnp.minimum(to_segment(pa, ab), to_segment(pb, bc)), to_segment(pc, ca))
    return jnp.where(inside & (square > 0), plane, border)


def _closer(x, item, name, best, squared):
    """The nearer of `best` and one more feature: squared distance and name as one complex number.

    XLA computes the distance once for one array, and twice for two. A float32 holds names up to 2^24.
    """
    d = squared(x, item)
    return jnp.where(d < best.real, lax.complex(d, jnp.broadcast_to(name, d.shape).astype(d.dtype)), best)


def _farthest(shape, dtype):
    return lax.complex(jnp.full(shape, jnp.inf, dtype), jnp.zeros(shape, dtype))


def _name(best):
    return best.imag.astype(jnp.int32)


def _fold(step, start, items, many):
    """`step(carried, item)` over the leading axis of every array in `items`, `many` of them in one turn of a scan.

    XLA makes one loop of a whole turn, ten times faster on a CPU than a turn for each, where `items` holds every number in an
    array of its own. The last item may come again.
    """
    count = len(jax.tree.leaves(items)[0])
    turns = np.minimum(np.arange(-(-count // many) * many), count - 1).reshape(-1, many)

    def turn(carried, several):
        for i in range(many):
            carried = step(carried, jax.tree.map(lambda a, i=i: a[i], several))
        return carried, None

    return lax.scan(turn, start, jax.tree.map(lambda a: a[turns], items))[0]


def _numbers(features):
    """Of points (count, 3, *poses) or triangles (count, 3 corners, 3, *poses), each number by itself, (count, *poses)."""
    return [_numbers(features[:, i]) for i in range(3)] if features.shape[1:2] == (3,) else features


def _all(x, features, squared, many):
    """Name of the nearest of all features (count, poses) to each of x, three components of (lanes, poses)."""
    names = jnp.arange(len(jax.tree.leaves(features)[0]), dtype=jnp.int32)

    def step(best, item):
        return _closer(x, *item, best, squared)

    items = (jax.tree.map(lambda a: a[:, None], features), names)
    return _name(_fold(step, _farthest(x[0].shape, x[0].dtype), items, many))


def _smallest(values, count):
    """Row numbers (count, columns) of the smallest entries of every column, and the next one's value.

    By `count` passes over the table, which on a CPU is ten times faster than sorting it.
    """
    rows = jnp.arange(len(values), dtype=jnp.int32)[:, None]

    def take(left, _):
        least = left.min(axis=0, keepdims=True)
        row = jnp.where(left == least, rows, len(values) - 1).min(axis=0, keepdims=True)
        return jnp.where(rows == row, jnp.inf, left), row[0]

    left, chosen = lax.scan(take, values, None, length=count)
    return chosen, left.min(axis=0)


def nearest_groups(cloth, grouped, count):
    """Of every cloth group, the squared gap of bounding boxes to the first group left out, and the `count` nearest groups."""
    corners = grouped.reshape(len(grouped), -1, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    gap = jnp.maximum(jnp.maximum(low[None] - cloth.max(axis=1)[:, None], cloth.min(axis=1)[:, None] - high[None]), 0)
    chosen, bound = _smallest(jnp.sum(gap * gap, axis=-1).T, min(count, len(grouped)))
    return bound, chosen.T


def _boxes(points):
    """Lowest and highest corners of boxes, by component (boxes, *poses), around three components (boxes, points, *poses)."""

    def extreme(pick, component):
        return functools.reduce(pick, [component[:, k] for k in range(component.shape[1])])

    return [[extreme(pick, component) for component in points] for pick in (jnp.minimum, jnp.maximum)]


def _least_gap(low, high, boxes, listed):
    """Squared distance from boxes, by component (lanes, *poses), to the nearest box that is not listed (boxes, lanes)."""

    def exclude(least, box):
        (below, above), skip = box
        apart = [jnp.maximum(jnp.maximum(below[i] - high[i], low[i] - above[i]), 0) for i in range(3)]
        return jnp.minimum(least, jnp.where(skip, jnp.inf, dot(apart, apart)))

    items = (jax.tree.map(lambda a: a[:, None], boxes), listed.reshape(listed.shape + (1,) * (low[0].ndim - 1)))
    return _fold(exclude, jnp.full_like(low[0], jnp.inf), items, 16)


def _candidates(x, features, blocks, lists, surface, squared):
    """Nearest feature in the lists of each cloth group, and whether no other group can hold a nearer one.

    The gap between the two bounding boxes bounds every distance between two groups from below: a vertex whose nearest
    candidate is closer than the gap to every group that is not listed has the right one for certain.
    """
    cloth = [component[surface.cloth_blocks] for component in x]  # (cloth groups, lanes, *poses)
    listed = jnp.zeros((len(blocks), lists.shape[1]), bool).at[lists, jnp.arange(lists.shape[1])].set(True)
    grouped = features[blocks]  # (groups, size, ..., 3, *poses)
    points = jnp.moveaxis(grouped, features.ndim - x[0].ndim + 1, 0).reshape(3, len(blocks), -1, *x[0].shape[1:])
    bound = _least_gap(*_boxes(cloth), _boxes(points), listed)
    names = blocks.reshape(blocks.shape + (1,) * (cloth[0].ndim - 1))

    def step(best, at):
        near, named = grouped[at], names[at]  # (cloth groups, size, ..., 3, *poses)
        for i in range(blocks.shape[1]):
            item = jax.tree.map(lambda a: a[:, None], _numbers(near[:, i]))
            best = _closer(cloth, item, named[:, i], best, squared)
        return best, None

    best = lax.scan(step, _farthest(cloth[0].shape, cloth[0].dtype), lists)[0]
    rows = (-1, *x[0].shape[1:])
    proven = best.real <= bound[:, None]
    return _name(best).reshape(rows)[surface.cloth_place], proven.reshape(rows)[surface.cloth_place]


def _repair(x, name, proven, features, squared, many, size=32):
    """Search everything for the vertices whose candidate is not proven, `size` of every pose at a time, until none is left.

    `name` and `proven` (verts, poses), the components of x likewise.
    """
    verts, poses = proven.shape
    size = min(size, verts)
    # The numbers of the vertices to do, in every pose those first; past its end a pose has nothing to do.
    place = jnp.where(proven, verts, jnp.cumsum(~proven, axis=0) - 1)
    pose = jnp.arange(poses)
    todo = jnp.full((verts + size, poses), verts, jnp.int32)
    todo = todo.at[place, pose].set(jnp.arange(verts, dtype=jnp.int32)[:, None], mode="drop")
    turns = -(-jnp.max(jnp.sum(~proven, axis=0)) // size)

    def mend(turn, name):
        rows = lax.dynamic_slice_in_dim(todo, turn * size, size)
        found = _all([component.at[rows, pose].get(mode="clip") for component in x], features, squared, many)
        return name.at[rows, pose].set(found, mode="drop")

    return lax.fori_loop(0, turns, mend, name)


def _search(x, features, blocks, lists, surface, squared, many, exact):
    poses = x.shape[2:]
    x, features = _numbers(lax.stop_gradient(x)), lax.stop_gradient(features)
    name, proven = _candidates(x, features, blocks, lists, surface, squared)
    if not exact:
        return name, proven
    one = jax.tree.map(lambda a: a.reshape(len(a), -1), (x, name, proven, _numbers(features)))
    return _repair(*one, squared, many).reshape(-1, *poses), proven


def nearest_vertex(
    x: Float[Array, "verts 3 *poses"], body: Float[Array, "body 3 *poses"], surface: Surface, *, exact: bool = True
) -> tuple[Int[Array, "verts *poses"], Bool[Array, "verts *poses"]]:
    """Nearest body vertex of every cloth vertex, and whether the candidates alone prove it.

    With `exact` the rest is searched in full, so the answer is that of a full search whatever the pose; without it the
    candidates' best stands, and the second result tells which answers are certain. At most one axis of poses.
    """
    return _search(x, body, surface.vertex_blocks, surface.vertex_lists, surface, _squared_to_points, 32, exact)


def nearest_triangle(
    x: Float[Array, "verts 3 *poses"], body: Float[Array, "body 3 *poses"], surface: Surface, *, exact: bool = True
) -> tuple[Int[Array, "verts *poses"], Bool[Array, "verts *poses"]]:
    """Nearest body triangle of every cloth vertex by exact point-triangle distance; results as in `nearest_vertex`.

    Of one pose, the candidates are the `NEAR` groups that are nearest there, which prove nearly all: it pays to look, as a
    triangle's distance costs so much more than a box's.
    """
    triangles, lists = body[surface.faces], surface.face_lists
    if x.ndim == 2 and exact:
        cloth, grouped = (lax.stop_gradient(a) for a in (x[surface.cloth_blocks], triangles[surface.face_blocks]))
        lists = nearest_groups(cloth, grouped, NEAR)[1].T
    return _search(x, triangles, surface.face_blocks, lists, surface, _squared_to_triangles, 2, exact)


# --- distance -------------------------------------------------------------------------------------------------------


def plane_distance(
    x: Float[Array, "verts 3 *poses"],
    body: Float[Array, "body 3 *poses"],
    normals: Float[Array, "body 3 *poses"],
    index: Int[Array, "verts *poses"],
) -> Float[Array, "verts *poses"]:
    """Signed distance in m to the tangent plane of the nearest vertex: d = n . (x - b), negative inside."""
    poses = index[:1].size
    at = index.reshape(-1, poses) * poses + jnp.arange(poses, dtype=index.dtype)[None]

    def near(table):  # each component by itself, which on a CPU is gathered several times faster than rows of three
        flat = [table[:, i].reshape(-1).at[at].get(mode="promise_in_bounds") for i in range(3)]
        return [component.reshape(index.shape) for component in flat]

    return dot(near(normals), minus([x[:, i] for i in range(3)], near(body)))


def triangle_distance(
    x: Float[Array, "verts 3"], body: Float[Array, "body 3"], surface: Surface, index: Int[Array, "verts"]
) -> Float[Array, "verts"]:
    """Exact signed distance in m to the nearest triangle `index`, negative inside.

        d = n . (x - c),  c the closest point, n = +-(x - c)/|x - c|

    The sign comes from the pseudo-normal of the feature that holds c (face, edge or vertex), which alone is right at
    edges and vertices; on the rim of a touchable part, where the body goes on unseen, everything counts as outside. The
    closest point and n are constants to the derivative, which is exact to first order; on the surface itself, and wherever c
    lies within a face, n is the pseudo-normal. Differences are formed from a corner of the triangle, so that it costs no
    accuracy to be far from the origin. Source: Baerentzen and Aanaes 2005; closest point after Ericson 2005, 5.1.5.
    """
    triangle = body[surface.faces[index]]
    weights = closest_weights(lax.stop_gradient(x), lax.stop_gradient(triangle))
    normal = _pseudo_normal(lax.stop_gradient(body), surface, index, weights)
    gap = _gap(x, triangle, weights)
    away = lax.stop_gradient(gap)
    length = jnp.sqrt(jnp.sum(away * away, axis=-1, keepdims=True))
    side = jnp.sign(jnp.sum(away * normal, axis=-1, keepdims=True))
    rim = jnp.all(surface.border[surface.faces[index]] | (weights <= 0), axis=-1, keepdims=True)
    side = jnp.where(rim, 1, side)
    touching = length < 1e-7  # m: the rounding of a float32 position at 1 m
    within = jnp.all(weights > 0, axis=-1, keepdims=True) & ~rim
    direction = jnp.where(touching | within | (side == 0), normal, side * away / jnp.where(touching, 1, length))
    return jnp.sum(direction * gap, axis=-1)


def _gap(x, corners, weights):
    """x - sum_k w_k c_k (..., 3) for weights that add up to 1, as differences from the first corner."""
    a, b, c = (corners[..., k, :] for k in range(3))
    return x - a - weights[..., 1:2] * (b - a) - weights[..., 2:] * (c - a)


def closest_weights(x, corners):
    """Barycentric coordinates (verts, 3) of the closest point of each triangle."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac, bc = b - a, c - a, c - b
    normal = jnp.cross(ab, ac)
    square = jnp.sum(normal * normal, axis=-1)

    def dot(p, q):
        return jnp.sum(p * q, axis=-1)

    def ratio(p, q):
        return jnp.clip(p / jnp.where(q > 0, q, 1), 0, 1)

    wa = dot(jnp.cross(bc, x - b), normal)
    wb = dot(jnp.cross(-ac, x - c), normal)
    wc = dot(jnp.cross(ab, x - a), normal)
    face = jnp.stack([wa, wb, wc], axis=-1) / jnp.where(square > 0, square, 1)[:, None]
    inside = (square > 0) & jnp.all(face > 0, axis=-1)
    s, t, u = (
        ratio(dot(x - a, ab), dot(ab, ab)),
        ratio(dot(x - b, bc), dot(bc, bc)),
        ratio(dot(x - c, -ac), dot(ac, ac)),
    )
    zero = jnp.zeros_like(s)
    edges = jnp.stack([jnp.stack(w, axis=-1) for w in ([1 - s, s, zero], [zero, 1 - t, t], [u, zero, 1 - u])], axis=1)
    gap = _gap(x[:, None], corners[:, None], edges)
    best = jnp.argmin(jnp.sum(gap * gap, axis=-1), axis=1)
    return jnp.where(inside[:, None], face, jnp.take_along_axis(edges, best[:, None, None], axis=1)[:, 0])


def _pseudo_normal(body, surface, index, weights):
    """Normal of the feature that holds the closest point: face, mean of an edge's two faces, or angle-weighted at a vertex."""
    normals = jnp.concatenate([face_normals(body, surface.faces), jnp.zeros_like(body[:1])])
    zero = weights <= 0
    count = jnp.sum(zero, axis=-1)
    # the edge opposite corner k lies between corners k+1 and k+2, which is edge k+1 of the face
    opposite = (jnp.argmax(zero, axis=-1) + 1) % 3
    edge = jnp.take_along_axis(surface.face_edges[index], opposite[:, None], axis=1)[:, 0]
    along = jnp.sum(normals[surface.edge_sides[edge]], axis=1)
    corner = jnp.take_along_axis(surface.faces[index], jnp.argmax(weights, axis=-1)[:, None], axis=1)[:, 0]
    ring = surface.rings[corner]  # (verts, most)
    at = jnp.concatenate([surface.faces, jnp.zeros_like(surface.faces[:1])])[ring]
    here = at == corner[:, None, None]
    p = body[at]
    first, second = jnp.roll(p, -1, axis=2), jnp.roll(p, -2, axis=2)
    angles = jnp.sum(jnp.where(here, angle_between(first - p, second - p), 0), axis=-1)
    tip = jnp.sum(angles[..., None] * normals[ring], axis=1)
    chosen = jnp.where((count == 0)[:, None], normals[index], jnp.where((count == 1)[:, None], along, tip))
    return normalize(chosen)


def collision(distance: Float[Array, "verts *poses"], thickness, stiffness) -> Float[Array, "*poses"]:
    """Collision energy in J.

        E = k_c sum_v min(d(x_v) - eps, 0)^2

    Args:
        distance: (verts, *poses) signed distance to the posed body in m. thickness: eps in m. stiffness: k_c in J/m^2 a vertex.

    Zero with zero derivative for cloth farther than eps; continuous in value and first derivative at eps.
    Source: slides, equation (12).
    """
    return stiffness * jnp.sum(jnp.minimum(distance - thickness, 0) ** 2, axis=0)

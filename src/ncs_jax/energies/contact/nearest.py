"""Search for the nearest body vertex or triangle of every cloth vertex; it works on integers and has no derivative."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.surface import Surface
from ncs_jax.geometry.closest_point import triangle_square
from ncs_jax.geometry.soa_vectors import Vector, dot

__all__ = [
    "boxes_around",
    "components",
    "nearest_groups",
    "nearest_of_few",
    "nearest_triangle",
    "nearest_vertex",
    "rows_at",
    "smallest",
]


NEAR = 32  # groups of the body's triangles that a group of cloth looks at in a pose of its own
WIDE = 4  # groups that are one box for a point by itself


def _squared_to_points(x, points):
    """|x - p|^2 with the components on the leading axis, kept apart so that the cloth fills the vector lanes."""
    return sum((x[i] - points[i]) ** 2 for i in range(3))


def _squared_to_triangles(x, triangle):
    """Exact squared distance to triangles, corner by corner and component by component."""
    return triangle_square(x, *triangle)


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


def components(features, levels: int):
    """Return each number of points (count, 3, *poses), one level, or triangles (count, 3, 3, *poses), two, by itself."""
    return features if levels == 0 else [components(features[:, i], levels - 1) for i in range(3)]


def _all(x, features, squared, many):
    """Name of the nearest of all features (count, poses) to each of x, three components of (lanes, poses)."""
    names = jnp.arange(len(jax.tree.leaves(features)[0]), dtype=jnp.int32)

    def step(best, item):
        return _closer(x, *item, best, squared)

    items = (jax.tree.map(lambda a: a[:, None], features), names)
    return _name(_fold(step, _farthest(x[0].shape, x[0].dtype), items, many))


def smallest(values, count):
    """Row numbers (count, columns) of the smallest entries of every column.

    By `count` passes over the table, which on a CPU is ten times faster than sorting it.
    """
    return _take_smallest(values, count)[1]


def _take_smallest(values, count):
    """Return the table with infinity in the place of the smallest entries of every column, and their rows (count, columns)."""
    rows = jnp.arange(len(values), dtype=jnp.int32)[:, None]

    def take(left, _):
        least = left.min(axis=0, keepdims=True)
        row = jnp.where(left == least, rows, len(values) - 1).min(axis=0, keepdims=True)
        return jnp.where(rows == row, jnp.inf, left), row[0]

    return lax.scan(take, values, None, length=count)


def nearest_groups(cloth, grouped, count):
    """Return the `count` groups whose bounding boxes are nearest, for every cloth group (cloth groups, count)."""
    corners = grouped.reshape(len(grouped), -1, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    gap = jnp.maximum(jnp.maximum(low[None] - cloth.max(axis=1)[:, None], cloth.min(axis=1)[:, None] - high[None]), 0)
    return smallest(jnp.sum(gap * gap, axis=-1).T, min(count, len(grouped))).T


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
    own = surface.cloth_blocks[: lists.shape[1]]
    cloth = [component[own] for component in x]  # (cloth groups, lanes, *poses)
    listed = jnp.zeros((len(blocks), lists.shape[1]), bool).at[lists, jnp.arange(lists.shape[1])].set(True)
    grouped = features[blocks]  # (groups, size, ..., 3, *poses)
    points = jnp.moveaxis(grouped, features.ndim - x[0].ndim + 1, 0).reshape(3, len(blocks), -1, *x[0].shape[1:])
    bound = _least_gap(*_boxes(cloth), _boxes(points), listed)
    names = blocks.reshape(blocks.shape + (1,) * (cloth[0].ndim - 1))

    def step(best, at):
        near, named = grouped[at], names[at]  # (cloth groups, size, ..., 3, *poses)
        for i in range(blocks.shape[1]):
            item = jax.tree.map(lambda a: a[:, None], components(near[:, i], features.ndim - x[0].ndim))
            best = _closer(cloth, item, named[:, i], best, squared)
        return best, None

    best = lax.scan(step, _farthest(cloth[0].shape, cloth[0].dtype), lists)[0]
    rows, place = (-1, *x[0].shape[1:]), surface.cloth_place[: len(x[0])]
    proven = best.real <= bound[:, None]
    return _name(best).reshape(rows)[place], proven.reshape(rows)[place]


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


class _Groups(NamedTuple):
    """Compact groups of the body's features, and those that every cloth group looks at."""

    blocks: Int[Array, "groups size"]
    lists: Int[Array, "near blocks"]


def _search(x, features, groups: _Groups, surface, squared, many, exact):
    poses = x.shape[2:]
    levels = features.ndim - 1 - len(poses)
    x, features = components(lax.stop_gradient(x), 1), lax.stop_gradient(features)
    name, proven = _candidates(x, features, *groups, surface, squared)
    if not exact:
        return name, proven
    x, name, flat, features = jax.tree.map(lambda a: a.reshape(len(a), -1), (x, name, proven, components(features, levels)))
    return _repair(x, name, flat, features, squared, many).reshape(-1, *poses), proven


def nearest_vertex(
    x: Float[Array, "verts 3 *poses"], body: Float[Array, "body 3 *poses"], surface: Surface, *, exact: bool = True
) -> tuple[Int[Array, "verts *poses"], Bool[Array, "verts *poses"]]:
    """Find the nearest body vertex of every cloth vertex, and whether the candidates alone prove it; of no points between them.

    With `exact` the rest is searched in full, so the answer is that of a full search whatever the pose; without it the
    candidates' best stands, and the second result tells which answers are certain. At most one axis of poses.
    """
    return _search(x, body, _Groups(surface.vertex_blocks, surface.vertex_lists), surface, _squared_to_points, 32, exact)


def nearest_triangle(
    x: Float[Array, "verts 3 *poses"], body: Float[Array, "body 3 *poses"], surface: Surface, *, exact: bool = True
) -> tuple[Int[Array, "verts *poses"], Bool[Array, "verts *poses"]]:
    """Find the nearest body triangle of every cloth vertex by exact point-triangle distance; results as in `nearest_vertex`.

    Of one pose, the candidates are the `NEAR` groups that are nearest there, which prove nearly all: it pays to look, as a
    triangle's distance costs so much more than a box's.
    """
    triangles, lists = body[surface.faces], surface.face_lists
    if x.ndim == 2 and exact:
        cloth, grouped = (lax.stop_gradient(a) for a in (x[surface.cloth_blocks], triangles[surface.face_blocks]))
        lists = nearest_groups(cloth, grouped, NEAR).T
    return _search(x, triangles, _Groups(surface.face_blocks, lists), surface, _squared_to_triangles, 2, exact)


class Boxes(NamedTuple):
    """Boxes around groups of the body's triangles in every pose, and the names of the triangles."""

    low: Float[Array, "groups 3 poses"]
    high: Float[Array, "groups 3 poses"]
    triangles: Int[Array, "groups size"]


def boxes_around(body: Float[Array, "body 3 poses"], surface: Surface) -> Boxes:
    """Return what `nearest_of_few` looks in: each box holds `WIDE` neighbouring groups of the surface."""
    blocks = surface.face_blocks
    blocks = jnp.pad(blocks, ((0, -len(blocks) % WIDE), (0, 0)), mode="edge").reshape(-1, WIDE * blocks.shape[1])
    corners = body[surface.faces[blocks].reshape(len(blocks), -1)]
    return Boxes(corners.min(axis=1), corners.max(axis=1), blocks)


def nearest_of_few(
    x: Vector, pose: Int[Array, "few"], body: Float[Array, "body 3 poses"], surface: Surface, boxes: Boxes
) -> Int[Array, "few"]:
    """Find the nearest body triangle of a few points, three components (few,), each in its pose.

    By exact distance to the triangles of the box that is nearest, then of the next one, until none that is left is nearer than
    what was found, for any point. Many boxes may hold a point, as groups that are compact at rest, of a hand and a thigh, are
    torn apart by a pose. For points that are few and far between this costs less than the groups of a whole garment.
    """
    x, every = [component[None] for component in x], jnp.arange(len(pose))
    low, high = boxes.low[:, :, pose], boxes.high[:, :, pose]
    apart = [jnp.maximum(jnp.maximum(low[:, i] - x[i], x[i] - high[:, i]), 0) for i in range(3)]

    def look(state):
        left, best, name = state
        left, nearest = _take_smallest(left, 1)
        names = boxes.triangles[nearest[0]].T  # (size, few)
        triangle = [rows_at(body, surface.faces[:, k][names], pose[None]) for k in range(3)]
        square = triangle_square(x, *triangle)
        at = jnp.argmin(square, axis=0)
        found, closer = square[at, every], square[at, every] < best
        return left, jnp.where(closer, found, best), jnp.where(closer, names[at, every], name)

    def may_be_nearer(state):
        left, best, _ = state
        return jnp.any(left.min(axis=0) < best)

    start = dot(apart, apart), jnp.full(len(pose), jnp.inf, x[0].dtype), jnp.zeros(len(pose), jnp.int32)
    return lax.while_loop(may_be_nearer, look, start)[2]


def rows_at(table: Float[Array, "rows 3 poses"], row: Int[Array, "*#some"], pose: Int[Array, "*#some"]) -> Vector:
    """Return three components of rows of a table in the poses named.

    Each by itself, which on a CPU is gathered several times faster than rows of three.
    """
    at = row * table.shape[2] + pose
    return [table[:, i].reshape(-1).at[at].get(mode="promise_in_bounds") for i in range(3)]

"""Contact with a smooth body: collision, equation (12), to a surface whose distance has no steps and no kinks."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ncs_jax.energies.contact.nearest import nearest_groups
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.geometry.numerics import norm, normalize

__all__ = ["BlendedContact", "Quadrics", "blended_contact", "contact_within_reach", "curvatures", "nearby_quadrics"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Quadrics:
    """The body near every group of cloth: one quadric a body vertex, seen from the group's centre, m; and how far that is."""

    centres: Float[Array, "*blocks 1 3"]
    points: Float[Array, "*blocks near 3"]  # the body's vertices
    squares: Float[Array, "*blocks 1 near"]  # of their distances from the centre; very great for one that is repeated
    normals: Float[Array, "*blocks near 3"]
    offsets: Float[Array, "*blocks 1 near"]  # n . (b - centre)
    bends: Float[Array, "*blocks near 10"]  # coefficients of (x - b) . S (x - b) / 2
    cloth: Float[Array, "*blocks size 3"]  # where the group was looked at
    clear: Float[Array, "*blocks"]  # how far from every vertex of the body it was at least; 0 where it may be inside


class BlendedContact(NamedTuple):
    """What the quadrics near a vertex say together."""

    shortfall: Float[Array, "*some"]  # m^2: square of what is missing of the distance to keep
    slope: Float[Array, "*some 3"]  # m: its derivative
    directions: Float[Array, "*some 3 3"]  # about half of its second derivative
    distance: Float[Array, "*some"]  # m, negative inside; of cloth that is not looked at, what it is at least


PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of the axes
ELSEWHERE = 0.15  # what a quadric counts, beside f, where another's sheet of the body is looked at; more than -min f = 1/8
TOGETHER = 16  # groups of cloth in one turn of a loop
REACH = 3.5  # mean edge lengths from a vertex: beyond and outside, d > 1.6 of them however sharp the bend (e pushes it off)
SHARPEST = 0.7  # curvature times the body's mean edge length: the tightest bend that its mesh can show


def _products(v):
    return jnp.stack([v[..., i] * v[..., j] for i, j in PAIRS], axis=-1)


def curvatures(body: Float[Array, "body 3"], normals: Float[Array, "body 3"], surface: Surface) -> Float[Array, "body 3 3"]:
    """Return the shape operators of the body's vertices in 1/m: how the normal turns along the surface, dn = S dx.

    The mean over the faces around, weighted by area, of the normals' gradient, symmetric and within the tangent plane; no
    greater than the mesh can show. Source: Rusinkiewicz 2004, by linear elements.
    """
    p, n = body[surface.faces], normals[surface.faces]
    face = jnp.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    # 2 area x the gradients of the barycentric coordinates
    slopes = jnp.cross(normalize(face)[:, None], jnp.roll(p, 1, axis=1) - jnp.roll(p, -1, axis=1))
    turn = jnp.sum(n[..., :, None] * slopes[..., None, :], axis=1)
    table = jnp.concatenate([turn.reshape(-1, 9), norm(face)[:, None]], axis=1)
    sums = jnp.sum(jnp.concatenate([table, jnp.zeros_like(table[:1])])[surface.rings], axis=1)
    area = sums[:, 9:, None]
    mean = sums[:, :9].reshape(-1, 3, 3) / jnp.where(area > 0, area, 1)
    across = jnp.eye(3, dtype=body.dtype)[None] - normals[:, :, None] * normals[:, None, :]
    flat = jnp.einsum("bij,bjk,bkl->bil", across, (mean + jnp.swapaxes(mean, 1, 2)) / 2, across, precision="highest")
    most = SHARPEST / surface.spacing.astype(body.dtype)
    size = norm(flat.reshape(-1, 9))[:, None, None]
    return flat * jnp.where(size > most, most / jnp.where(size > most, size, 1), 1)


def nearby_quadrics(x: Float[Array, "verts 3"], body: Float[Array, "body 3"], surface: Surface) -> Quadrics:
    """Return the quadrics of the groups of body vertices that lie nearest to every group of cloth vertices."""
    blocks = surface.vertex_blocks
    cloth = lax.stop_gradient(x)[surface.cloth_blocks]
    chosen = nearest_groups(cloth, lax.stop_gradient(body)[blocks], surface.groups)
    names = blocks[chosen].reshape(len(cloth), -1)
    first = jnp.concatenate([jnp.ones_like(blocks[:, :1], bool), blocks[:, 1:] != blocks[:, :-1]], axis=1)
    once = first[chosen].reshape(names.shape)
    normals = vertex_normals(body, surface)
    table = jnp.concatenate([body, normals, curvatures(body, normals, surface).reshape(-1, 9)], axis=1)[names]
    centres = jnp.mean(cloth, axis=1, keepdims=True)  # near it no product of `blended_contact` cancels
    points, n, bend = table[..., :3] - centres, table[..., 3:6], table[..., 6:].reshape(*names.shape, 3, 3)
    turn = jnp.sum(bend * points[..., None, :], axis=-1)
    second = jnp.stack([bend[..., i, j] * (0.5 if i == j else 1) for i, j in PAIRS], axis=-1)
    bends = jnp.concatenate([second, -turn, jnp.sum(turn * points, axis=-1, keepdims=True) / 2], axis=-1)
    squares = jnp.where(once, jnp.sum(points * points, axis=-1), 1e6)  # m^2: nothing weighs anything so far away
    offsets = jnp.sum(n * points, axis=-1)
    clear = _clear(cloth, lax.stop_gradient(body)[blocks[chosen[:, 0]]], lax.stop_gradient(squares), lax.stop_gradient(offsets))
    return Quadrics(centres, points, squares[:, None], n, offsets[:, None], bends, cloth, clear)


def _clear(cloth, nearest, squares, offsets):
    """How far groups of cloth (blocks, size, 3) are from the nearest ones of the body; 0 where the centre may be inside."""
    gap = jnp.maximum(nearest.min(axis=1) - cloth.max(axis=1), cloth.min(axis=1) - nearest.max(axis=1))
    row = jnp.argmin(squares, axis=1)[:, None]
    height, square = -jnp.take_along_axis(offsets, row, axis=1)[:, 0], jnp.take_along_axis(squares, row, axis=1)[:, 0]
    outside = 2 * height > jnp.sqrt(square)  # within 60 degrees of the nearest vertex's normal, and not past a rim
    return jnp.where(outside, norm(jnp.maximum(gap, 0)), 0)


def _blended(cloth, near, surface, thickness) -> BlendedContact:
    """Of one group of cloth."""
    product = functools.partial(jnp.matmul, precision="highest")
    cloth = cloth - near.centres
    one = jnp.ones_like(cloth[..., :1])
    length = jnp.sum(cloth * cloth, axis=-1, keepdims=True)
    far = jnp.concatenate([jnp.ones_like(near.points[..., :1]), -2 * near.points, near.squares.T], axis=-1)
    square = product(jnp.concatenate([length, cloth, one], axis=-1), far.T)  # |r|^2
    nearest = lax.stop_gradient(jnp.min(square, axis=-1, keepdims=True))
    h = surface.spacing.astype(cloth.dtype)
    width = h * h
    weight = jnp.exp(jnp.maximum((nearest - square) * (4 / width), -40))  # no weight so small that its products leave the range
    powers = jnp.concatenate([_products(cloth), cloth, one], axis=-1)
    ratio = square / (4 * width)
    shown = 1 / (1 + ratio * ratio)
    bend = product(powers, near.bends.T) * shown
    height = product(cloth, near.normals.T) - near.offsets
    past = jnp.maximum(ratio - height * height / (4 * width) - 1, 0)
    ended = past / (1 + ratio)
    distance = height + bend + 2 * h * past * ended
    squares = _products(near.normals)
    ones = jnp.ones_like(squares[..., :1])
    alike = jnp.concatenate([ones, near.normals, squares], axis=-1)
    twice = jnp.stack([squares[..., k] * (1 if i == j else 2) for k, (i, j) in enumerate(PAIRS)], axis=-1)
    facing = jnp.concatenate([ELSEWHERE * ones, 0.5 * near.normals, 0.5 * twice], axis=-1).T
    sums = product(weight, alike)
    around = product(sums, facing)
    share = (1 + ELSEWHERE) * weight / around
    short = jnp.minimum(distance - thickness, 0)
    directions = product(jnp.where(short < 0, share, 0), squares)
    full = jnp.stack([directions[..., PAIRS.index((min(i, j), max(i, j)))] for i in range(3) for j in range(3)], axis=-1)

    # the derivative by hand: by transposition it takes three times as long
    push = 2 * share * short
    lost = share * short * short
    own = lost - weight * product(product(lost / around, alike), facing)
    upward = push * (1 - 2 * height * ended / h)
    along = -4 / width * own + push * (ended * (2 - ended) / (2 * h) - bend * ratio * shown / (2 * width))
    pull = product(along, jnp.concatenate([ones, near.points], axis=-1))
    turn = product(push * shown, near.bends)
    slope = product(upward, near.normals) + 2 * (pull[..., :1] * cloth - pull[..., 1:]) + turn[..., 6:9]
    bent = [[turn[..., PAIRS.index((min(i, j), max(i, j)))] * (2 if i == j else 1) for j in range(3)] for i in range(3)]
    slope = slope + jnp.stack([sum(bent[i][j] * cloth[..., j] for j in range(3)) for i in range(3)], axis=-1)
    return BlendedContact(
        jnp.sum(lost, axis=-1),
        slope,
        full.reshape(*full.shape[:-1], 3, 3),
        jnp.minimum(jnp.sum(weight * distance, axis=-1) / sums[..., 0], jnp.sqrt(jnp.maximum(nearest[..., 0], 0))),
    )


def blended_contact(
    x: Float[Array, "verts 3"],
    quadrics: Quadrics,
    surface: Surface,
    thickness: Float[Array, ""] | float,
) -> BlendedContact:
    """Return the contact with a smooth body: with the second-order tangent surfaces of all its vertices near x, blended.

        shortfall = sum_i v_i min(d_i - thickness, 0)^2
        d_i = z_i + g_i r_i . S_i r_i / 2 + 2 h e_i^2 / (1 + q_i),   e_i = max(q_i - (z_i/2h)^2 - 1, 0)
        r_i = x - b_i,   z_i = n_i . r_i,   q_i = |r_i|^2 / 4h^2,   S_i the shape operator at b_i,   g_i = 1/(1 + q_i^2)
        v_i = (1 + c) w_i / sum_j w_j (f_ij + c),   w_i = exp(-4 |r_i|^2 / h^2),   f_ij = n_i . n_j (1 + n_i . n_j) / 2

    with c = 0.15 and h the mean edge length of the resting body. g keeps a bend from being taken for more than it shows; e is
    how far x lies beyond the end of a tangent surface, 2 h from its vertex, where there is no body: between two legs their
    surfaces would meet. On one sheet of the body v is a mean. Two sheets that face each other, as an arm and the torso, push
    each by itself: one mean of both would let what the one has to spare make good what the other misses. To the plane of the
    nearest vertex this is what a smooth hill is to a stair: that one jumps where the nearest vertex changes, so cloth that
    rests there has no equilibrium.

    The distance is the mean of d_i by w_i, and no greater than that of the nearest vertex. Source: Kolluri 2005 (implicit
    moving least squares), there for planes and one mean.
    """
    # a few groups at a time, so that what lies between stays in the cache
    parts = x[surface.cloth_blocks], quadrics
    result = lax.map(lambda part: _blended(part[0], part[1], surface, thickness), parts, batch_size=TOGETHER)
    return jax.tree.map(lambda table: table.reshape(-1, *table.shape[2:])[surface.cloth_place], result)


def contact_within_reach(
    x: Float[Array, "verts 3"],
    quadrics: Quadrics,
    surface: Surface,
    thickness: Float[Array, ""] | float,
    only: Bool[Array, "blocks"] | None = None,
) -> BlendedContact:
    """Return `blended_contact` without a look at cloth that is too far from the body to touch it; it has no derivative.

    There the distance is how far it is from every vertex of the body, at least; 0 where that is not known. only: groups of
    cloth that are looked at, and no others. `tests/test_collision.py` holds both equal.
    """
    blocks, count = surface.cloth_blocks, len(surface.cloth_blocks)
    cloth = x[blocks]
    left = quadrics.clear - jnp.sqrt(jnp.max(jnp.sum((cloth - quadrics.cloth) ** 2, axis=-1), axis=1))
    near = left < REACH * surface.spacing.astype(x.dtype) + thickness
    near = near if only is None else near & only
    todo = jnp.nonzero(near, size=count, fill_value=count)[0]

    def turn(k, every):
        at = todo.at[k * TOGETHER + jnp.arange(TOGETHER)].get(mode="fill", fill_value=count)
        some = jax.tree.map(lambda table: table.at[at].get(mode="clip"), (cloth, quadrics))
        found = jax.vmap(lambda cloth, near: _blended(cloth, near, surface, thickness))(*some)
        rows = blocks.at[at].get(mode="fill", fill_value=len(x))
        return jax.tree.map(lambda table, some: table.at[rows].set(some, mode="drop"), every, found)

    none = jnp.zeros_like(x)
    distance = none[:, 0].at[blocks].set(jnp.maximum(left, 0)[:, None])
    start = BlendedContact(none[:, 0], none, none[:, :, None] * none[:, None], distance)
    return lax.fori_loop(0, -(-jnp.sum(near) // TOGETHER), turn, start)

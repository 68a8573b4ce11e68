"""The touchable part of the body, and compact groups of what lies near each other, for the searches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.contact.halfway import Halfway, halfway_from
from ncs_jax.energies.contact.points import ContactPoints, with_points
from ncs_jax.geometry.mesh import corners, gathered, topology, vertex_rings
from ncs_jax.geometry.numerics import normalize
from ncs_jax.geometry.soa_vectors import cross, minus, plus

__all__ = ["Surface", "compact_groups", "face_normals", "moving_normals", "rebuild_lists", "surface_from", "vertex_normals"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surface:
    """What collision needs to know once about the part of the body that a garment can touch.

    `cloth_blocks`, `vertex_blocks` and `face_blocks` are compact groups of cloth vertices, body vertices and body faces,
    the last entry repeated where a group is short; `cloth_place` finds a cloth vertex in its group. `vertex_lists` and
    `face_lists` name the body groups that each cloth group searches first. Of cloth with `points` between its `verts` vertices
    these follow the vertices, as in `points.with_points`: in groups of their own, which the search for vertices leaves out; or,
    for smooth contact, among the vertices.
    """

    faces: Int[Array, "faces 3"]
    rings: Int[Array, "body most"]
    face_edges: Int[Array, "faces 3"]
    edge_sides: Int[Array, "edges 2"]
    border: Bool[Array, "body"]  # on the rim where the touchable part was cut out of the body
    cloth_blocks: Int[Array, "blocks size"]
    cloth_place: Int[Array, "verts"]
    vertex_blocks: Int[Array, "clusters vertices"]
    vertex_lists: Int[Array, "near_clusters own_blocks"]
    face_blocks: Int[Array, "groups triangles"]
    face_lists: Int[Array, "near_groups blocks"]
    spacing: Float[Array, ""]  # mean edge length of the resting body, m
    groups: int = field(metadata={"static": True})  # how many body groups a cloth group looks at
    verts: int = field(metadata={"static": True})  # of the cloth
    points: ContactPoints | None = None  # of the cloth, where contact looks between its vertices too
    halfway: Halfway | None = None  # of the body, where there are some


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


def _cloth_blocks(cloth, verts: int, size: int) -> tuple[np.ndarray, int]:
    """Groups of the first `verts` of the cloth, then of the others, as wide as the widest; and how many the first are."""
    own = compact_groups(cloth[:verts], size)
    if len(cloth) == verts:
        return own, len(own)
    both = own, verts + compact_groups(cloth[verts:], size)
    widest = max(blocks.shape[1] for blocks in both)
    return np.concatenate([np.pad(b, ((0, 0), (0, widest - b.shape[1])), mode="edge") for b in both]), len(own)


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


def rebuild_lists(surface: Surface, posed: Sequence[tuple[np.ndarray, np.ndarray]]) -> Surface:
    """Return the surface with new candidate lists for the nearest-vertex search, from poses [(cloth, body)]."""
    own = np.asarray(surface.cloth_blocks)[: surface.vertex_lists.shape[1]]
    lists = _lists(posed, own, np.asarray(surface.vertex_blocks), surface.groups)
    return replace(surface, vertex_lists=jax.device_put(lists))


def surface_from(
    cloth: np.ndarray,
    body: np.ndarray,
    faces: np.ndarray,
    *,
    smooth: bool = False,
    posed: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    points: ContactPoints | None = None,
) -> Surface:
    """Group the cloth and the touchable body by their rest positions (verts, 3), (body, 3), m; faces (faces, 3) of the body.

    `posed`: the two in some poses of the motion, from which to tell what is usually near what; at rest where there is none.
    `smooth`: for `nearby_quadrics`, which takes smaller groups of the body; otherwise for the searches, where the sizes are a
    balance of what a group looks at, what it proves at once and what is left to be searched in full (a coarse garment: smaller
    groups that look at more, since its far corners leave less proved). `points`: between the cloth's vertices.
    """
    verts, cloth = len(cloth), with_points(np.asarray(cloth), points)
    posed = [(with_points(np.asarray(x), points), skin) for x, skin in posed]
    cloth_size, body_size, groups = (24, 4, 40) if smooth else (16, 8, 32) if verts >= 2048 else (8, 8, 64)
    cloth_size = max(8, min(cloth_size, (len(cloth) if smooth else verts) // (128 if smooth else 64)))
    body, faces = np.asarray(body), np.asarray(faces)
    cloth_blocks, own = _cloth_blocks(cloth, len(cloth) if smooth else verts, cloth_size)
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
        vertex_lists=jax.device_put(_lists(posed, cloth_blocks[:own], vertex_blocks, groups)),
        face_blocks=jax.device_put(face_blocks),
        face_lists=jax.device_put(_lists(posed, cloth_blocks, faces[face_blocks], groups)),
        spacing=jnp.asarray(np.linalg.norm(body[edges[:, 0]] - body[edges[:, 1]], axis=1).mean(), jnp.float32),
        groups=groups,
        verts=verts,
        points=points,
        halfway=None if points is None else halfway_from(body),
    )


def face_normals(body: Float[Array, "body 3"], faces: Int[Array, "faces 3"]) -> Float[Array, "faces 3"]:
    """Return unit normals; zero for a collapsed face."""
    a, b, c = body[faces[:, 0]], body[faces[:, 1]], body[faces[:, 2]]
    return normalize(jnp.cross(b - a, c - a))


def vertex_normals(body: Float[Array, "body 3 *poses"], surface: Surface) -> Float[Array, "body 3 *poses"]:
    """Return area-weighted unit normals of the body's vertices."""
    return normalize(_areas(body, surface.faces, surface.rings), axis=1)


def moving_normals(body: Float[Array, "body 3 *poses"], surface: Surface) -> Float[Array, "body 3 *poses"]:
    """Return the same of a body that is differentiated: backward alone, by sums over neighbours that scatter nothing."""
    return normalize(_moving_areas(body, surface.faces, surface.rings), axis=1)


def _areas(body, faces, rings):
    """Twice the sum of the area vectors around each vertex."""
    a, b, c = corners(body, faces)
    area = jnp.stack(cross(minus(b, a), minus(c, a)), axis=1)
    around = [jnp.take(area, at, axis=0, mode="fill", fill_value=0) for at in rings.T]
    return sum(around, start=jnp.zeros_like(body))


_moving_areas = jax.custom_vjp(_areas)


def _areas_backward(saved, toward):
    """What the area vectors toward g tell each corner: sum of g over the triangle x the edge opposite to the corner."""
    body, faces, rings = saved
    a, b, c = corners(body, faces)
    ga, gb, gc = corners(toward, faces)
    g = plus(plus(ga, gb), gc)
    told = [cross(g, minus(c, b)), cross(g, minus(a, c)), cross(g, minus(b, a))]
    around = faces.at[rings].get(mode="fill", fill_value=-1)
    corner = jnp.argmax(around == jnp.arange(len(body), dtype=faces.dtype)[:, None, None], axis=-1).astype(faces.dtype)
    return gathered(told, jnp.where(rings < len(faces), corner * len(faces) + rings, 3 * len(faces))), None, None


_moving_areas.defvjp(lambda *given: (_areas(*given), given), _areas_backward)

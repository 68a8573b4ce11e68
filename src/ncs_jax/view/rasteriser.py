"""A small rasteriser in NumPy: triangle meshes with hidden surfaces, smooth shading, shadows and a floor.

No graphics card, display or browser is needed. Metres, Y up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ncs_jax.geometry.depth_buffer import rasterise
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.view.camera import Camera, Projection
from ncs_jax.view.ground import Ground, draw_ground
from ncs_jax.view.lighting import ShadowMap, linear, shade

__all__ = ["PAPER", "DrawnMesh", "render"]

PAPER = (247, 245, 241)
"""The background, sRGB."""

SQUARE, DARK = 0.04, 0.45  # of a checker: its cubes, m, and the share of light that the dark ones keep


@dataclass(frozen=True)
class DrawnMesh:
    """Hold a mesh to draw, and its colours.

    Attributes:
        vertices: (V, 3) in m. faces: (F, 3). colour: sRGB in 0..1, one or (V, 3). inside: of the back of the faces, if another.
        checker: where the vertices are at rest (V, 3), m: every other cube of `SQUARE` is drawn darker; else None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: Sequence[float] | np.ndarray
    inside: Sequence[float] | None = None
    checker: np.ndarray | None = None


def render(
    meshes: Sequence[DrawnMesh],
    camera: Camera,
    size: tuple[int, int] = (400, 500),
    *,
    ground: Ground | None = None,
    background: Sequence[int] = PAPER,
    samples: int = 2,
) -> np.ndarray:
    """Draw triangle meshes with hidden surfaces, smooth shading, shadows and a floor.

    Args:
        meshes: what to draw. camera: from where. size: width and height in pixels. ground: the floor, if there is one.
        background: sRGB in 0..255. samples: per pixel and axis, against jagged edges.

    Returns:
        (height, width, 3) uint8.

    Triangles with a vertex that is not finite, or behind the camera, are left out.
    """
    projection = camera.projection(size[0] * samples, size[1] * samples)
    surface = _joined(meshes)
    screen = projection.project(surface.vertices)
    in_front = screen[3][surface.faces].all(1)
    surface = surface._replace(faces=surface.faces[in_front], inside=surface.inside[in_front])
    sun = 0.45 * -projection.axes[2] - 0.72 * projection.axes[0] + np.array([0.0, 1.0, 0.0])
    shadows = ShadowMap(surface.vertices, surface.faces, sun / np.linalg.norm(sun))
    image = np.empty((size[1], size[0], 3), np.float32)
    image[:] = np.asarray(background, float) / 255
    if ground is not None:  # soft and with smooth lines, so once a pixel is enough
        draw_ground(image, ground, camera.projection(*size), shadows, surface.vertices, surface.faces)
    image = image.repeat(samples, 0).repeat(samples, 1)
    _draw_surface(image, surface, projection, screen[:3], shadows)
    if samples > 1:
        each = [image[i::samples, j::samples] for i in range(samples) for j in range(samples)]
        image = np.add.reduce(each) / samples**2
    return np.clip(image * 255 + 0.5, 0, 255).astype(np.uint8)


class _Surface(NamedTuple):
    """Hold all meshes of a picture as one; colours as light, outside by vertex, inside by face, NaN where it is the same.

    checker: in cubes of a checker, by vertex, NaN where there is none; None where no mesh has one.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    outside: np.ndarray
    inside: np.ndarray
    checker: np.ndarray | None = None


def _joined(meshes: Sequence[DrawnMesh]) -> _Surface:
    """Join meshes, without the faces that have a vertex which is not finite."""
    vertices, faces, normals, outside, inside, checker, count = [], [], [], [], [], [], 0
    for mesh in meshes:
        v, f = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
        good = np.isfinite(v).all(1) & (np.abs(np.nan_to_num(v)) < 1e6).all(1)
        v, f = np.where(good[:, None], v, 0.0), f[good[f].all(1)]
        vertices.append(v)
        normals.append(vertex_normals(v, f))
        faces.append(f + count)
        outside.append(np.broadcast_to(linear(mesh.colour), v.shape))
        hidden = np.full(3, np.nan) if mesh.inside is None else linear(mesh.inside)
        inside.append(np.broadcast_to(hidden, f.shape))
        # No wall of a cube lies in a plane of symmetry, where cloth may lie too.
        checker.append(np.full(v.shape, np.nan) if mesh.checker is None else mesh.checker / SQUARE + np.array([0.5, 0.31, 0.5]))
        count += len(v)
    if not vertices:
        return _Surface(np.zeros((1, 3)), np.zeros((0, 3), np.int64), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((0, 3)))
    joined = _Surface(*(np.concatenate(part) for part in (vertices, faces, normals, outside, inside)))
    return joined if all(mesh.checker is None for mesh in meshes) else joined._replace(checker=np.concatenate(checker))


def _draw_surface(image, surface: _Surface, projection: Projection, screen, shadows: ShadowMap) -> None:
    """Draw into a picture (height, width, 3) what is nearest at each pixel; screen has x, y and nearness of the vertices."""
    x, y, near = screen
    nearest, _ = rasterise(x, y, near, surface.faces, projection.width, projection.height)
    pixel = np.flatnonzero(nearest.ravel() >= 0)
    if not len(pixel):
        return
    face = nearest.ravel()[pixel]
    corner = surface.faces[face]
    px, py = pixel % projection.width + 0.5, pixel // projection.width + 0.5
    weights, front = _weights(x, y, near if projection.perspective else None, corner, px, py)
    values = (surface.vertices, surface.normals, surface.outside)
    position, normal, colour = (np.einsum("nk,nkc->nc", weights, v[corner]) for v in values)
    normal *= np.where(front, 1.0, -1.0)[:, None]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    tinted = ~front & np.isfinite(surface.inside[face, 0])
    colour = np.where(tinted[:, None], np.nan_to_num(surface.inside[face]), colour)
    if surface.checker is not None:
        cube = np.floor(np.einsum("nk,nkc->nc", weights, surface.checker[corner])).sum(1)
        colour = np.where((cube % 2 == 1)[:, None], DARK * colour, colour)  # NaN is neither
    view = projection.eye - position if projection.perspective else np.broadcast_to(-projection.axes[2], position.shape)
    view = view / np.linalg.norm(view, axis=1, keepdims=True)
    image.reshape(-1, 3)[pixel] = shade(position, normal, colour, view, projection.axes, shadows)


def _weights(x, y, near, corner, px, py):
    """Return barycentric weights (N, 3) of pixels, right in perspective where `near` is 1/z, and whether the front is seen."""
    ax, ay = x[corner], y[corner]
    e1x, e1y, e2x, e2y = ax[:, 1] - ax[:, 0], ay[:, 1] - ay[:, 0], ax[:, 2] - ax[:, 0], ay[:, 2] - ay[:, 0]
    dx, dy = px - ax[:, 0], py - ay[:, 0]
    area = e1x * e2y - e2x * e1y
    w1, w2 = (dx * e2y - e2x * dy) / area, (e1x * dy - dx * e1y) / area
    weights = np.clip(np.stack([1 - w1 - w2, w1, w2], 1), 0, 1)
    if near is not None:
        weights = weights * near[corner]
    # Rows run down the picture, so counter-clockwise triangles have a negative area.
    return weights / weights.sum(1, keepdims=True), area < 0

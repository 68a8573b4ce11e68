"""A small rasteriser in NumPy: triangle meshes with hidden surfaces, smooth shading, shadows and a floor.

No graphics card, display or browser is needed. Metres, Y up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageFilter

__all__ = ["PAPER", "Camera", "DrawnMesh", "Ground", "render"]

PAPER = (247, 245, 241)
"""The background, sRGB."""

FRAGMENTS = 30_000_000
"""Most pixels that one picture may touch; a sane garment touches a fiftieth of it."""


@dataclass(frozen=True)
class DrawnMesh:
    """Something to draw.

    Attributes:
        vertices: (V, 3) in m. faces: (F, 3). colour: sRGB in 0..1, one or (V, 3). inside: of the back of the faces, if another.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colour: Sequence[float] | np.ndarray
    inside: Sequence[float] | None = None


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from.

    Attributes:
        target: (3,) point in the middle of the picture, m. width, height: what must be in sight around it, m.
        azimuth: degrees, 0 looks from +Z and 90 from +X. elevation: degrees.
        fov: of the height in sight, degrees; 0 is orthographic.
    """

    target: Sequence[float] | np.ndarray
    height: float
    width: float = 0.0
    azimuth: float = 0.0
    elevation: float = 6.0
    fov: float = 18.0

    def axes(self) -> np.ndarray:
        """Rows: right, up and forward of the picture in the world."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        back = np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
        right = np.array([math.cos(a), 0.0, -math.sin(a)])
        return np.stack([right, np.cross(back, right), -back])


@dataclass(frozen=True)
class Ground:
    """A floor at `height` m with a square grid of `cell` m (0: none), that fades away `radius` m from `centre` (x, z)."""

    height: float
    centre: Sequence[float] | np.ndarray = (0.0, 0.0)
    radius: float = 1.5
    cell: float = 0.5


def _rasterise(x, y, near, faces, width, height):
    """The nearest face at every pixel, by a depth test per pixel.

    Args:
        x, y: (V,) in pixels, pixel centres at .5. near: (V,), > 0, larger is nearer, affine on the screen (1/z in perspective).
        faces: (F, 3), all finite.

    Returns:
        (height, width) face index, -1 where there is none, and nearness, 0 there.
    """
    keys = np.zeros(height * width, np.uint64)
    fx, fy, fn = x[faces], y[faces], near[faces]
    area = (fx[:, 1] - fx[:, 0]) * (fy[:, 2] - fy[:, 0]) - (fx[:, 2] - fx[:, 0]) * (fy[:, 1] - fy[:, 0])
    low = np.clip(np.ceil(fy.min(1) - 0.5), 0, height)
    rows = np.clip(np.floor(fy.max(1) - 0.5) + 1, 0, height) - low
    across = np.clip(fx.max(1), 0, width) - np.clip(fx.min(1), 0, width)
    seen = (rows > 0) & (across > 0) & (np.abs(area) > 1e-12)
    if not seen.any():
        return np.full((height, width), -1), np.zeros((height, width), np.float32)
    # A garment that has blown up can fill the picture a thousand times over: its largest triangles are left out.
    cost = np.where(seen, rows * (across + 1), 0)
    order = np.argsort(cost)
    seen[order[np.cumsum(cost[order]) > FRAGMENTS]] = False
    index = np.flatnonzero(seen)
    fx, fy, fn, area = fx[index], fy[index], fn[index], area[index]
    low, rows = low[index].astype(np.int64), rows[index].astype(np.int64)
    # Edge functions a x + b y + c, positive inside, and the plane of nearness.
    nx, ny = np.roll(fx, -1, 1), np.roll(fy, -1, 1)
    sign = np.sign(area)[:, None]
    a, b = (fy - ny) * sign, (nx - fx) * sign
    c = -(a * fx + b * fy)
    turned = np.roll(fn, -2, 1)  # the corner that faces edge i is i + 2
    plane = [(coefficient * turned).sum(1) / np.abs(area) for coefficient in (a, b, c)]
    # One span of pixels for each triangle and row.
    face = np.repeat(np.arange(len(index)), rows)
    row = np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows) + low[face]
    left, right = np.zeros(len(face)), np.full(len(face), width - 1.0)
    middle = row + 0.5
    for i in range(3):
        ai = a[face, i]
        rest = b[face, i] * middle + c[face, i]
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = -rest / ai - 0.5
        # 1e-4 pixel of overlap: neighbours leave no crack between them.
        left = np.where(ai > 0, np.maximum(left, np.ceil(bound - 1e-4)), left)
        right = np.where(ai < 0, np.minimum(right, np.floor(bound + 1e-4)), right)
        right = np.where((ai == 0) & (rest < 0), -1, right)
    count = (right - left + 1).astype(np.int64)
    keep = count > 0
    face, row, left, count = face[keep], row[keep], left[keep].astype(np.int64), count[keep]
    start = plane[1][face] * (row + 0.5) + plane[2][face]
    ends = np.cumsum(count)
    for first, last in _runs(ends, 2_000_000):
        n = count[first:last]
        span = np.repeat(np.arange(first, last), n)
        column = np.arange(len(span)) - np.repeat(ends[first:last] - n - (ends[first] - n[0]), n) + left[span]
        value = np.maximum(plane[0][face[span]] * (column + 0.5) + start[span], 1e-12).astype(np.float32)
        key = (value.view(np.uint32).astype(np.uint64) << np.uint64(32)) | (index[face[span]] + 1).astype(np.uint64)
        np.maximum.at(keys, row[span] * width + column, key)
    nearest = (keys & np.uint64(0xFFFFFFFF)).astype(np.int64) - 1
    nearness = (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)
    return nearest.reshape(height, width), nearness.reshape(height, width)


def _runs(ends, size):
    """Cut spans into runs of about `size` pixels, which bounds the memory."""
    first = 0
    while first < len(ends):
        base = ends[first - 1] if first else 0
        last = max(first + 1, int(np.searchsorted(ends, base + size)))
        yield first, last
        first = last


def _normals(vertices, faces):
    """Vertex normals (V, 3): face normals weighted by area; zero for a vertex without a face."""
    p = vertices[faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    corners = faces.ravel()
    total = np.stack([np.bincount(corners, np.repeat(n[:, i], 3), len(vertices)) for i in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def _linear(colour):
    """SRGB in 0..1 to light."""
    c = np.asarray(colour, float)
    return np.where(c <= 0.04045, c / 12.92, ((np.maximum(c, 0) + 0.055) / 1.055) ** 2.4)


def _display(light):
    """Light to sRGB in 0..1, by a table."""
    return _TABLE[np.clip(light * 4095 + 0.5, 0, 4095).astype(np.int32)]


_STEPS = np.arange(4096) / 4095
_TABLE = np.where(_STEPS <= 0.0031308, 12.92 * _STEPS, 1.055 * _STEPS ** (1 / 2.4) - 0.055).astype(np.float32)


class _Light:
    """The sun: what it reaches, from one picture of nearness taken along its direction."""

    def __init__(self, vertices, faces, direction, size=512):
        side = np.cross([0.0, 1.0, 0.0], direction)
        side /= np.linalg.norm(side)
        self.axes = np.stack([side, np.cross(direction, side), direction])
        v = vertices @ self.axes.T
        used = v[np.unique(faces)] if len(faces) else np.zeros((1, 3))
        # Far stray vertices must not cost the rest its resolution.
        low, high = np.quantile(used, 0.002, axis=0) - 0.06, np.quantile(used, 0.998, axis=0) + 0.06
        self.low, self.size = low, size
        self.scale = size / max(high[0] - low[0], high[1] - low[1])
        depth = np.maximum(v[:, 2] - low[2] + 1.0, 1e-3)
        _, self.map = _rasterise((v[:, 0] - low[0]) * self.scale, (v[:, 1] - low[1]) * self.scale, depth, faces, size, size)
        blurred = Image.fromarray(((self.map > 0) * 255).astype(np.uint8))
        self.shade = np.asarray(blurred.filter(ImageFilter.GaussianBlur(float(0.02 * self.scale))), np.float32) / 255

    def _look(self, points):
        p = points @ self.axes.T
        return (p[:, 0] - self.low[0]) * self.scale, (p[:, 1] - self.low[1]) * self.scale, p[:, 2] - self.low[2] + 1.0

    def on_ground(self, points):
        """Share of light that reaches (N, 3) points below everything, with soft edges."""
        x, y, _ = self._look(points)
        return 1 - _sample(self.shade, x, y)

    def on_surface(self, points, normals):
        """Share of light that reaches (N, 3) points of the drawn surfaces."""
        # Off the surface by about a texel, so that it does not shade itself.
        x, y, depth = self._look(points + normals * (0.004 + 1.0 / self.scale))
        depth = (depth + 0.006).astype(np.float32)
        reach = np.zeros(len(points), np.float32)
        flat, radius = self.map.ravel(), max(1.0, 0.005 * self.scale)
        for k in range(8):  # a spiral of taps, evenly dense
            r, angle = radius * math.sqrt((k + 0.5) / 8), 2.39996 * k
            i = np.clip(y + r * math.sin(angle), 0, self.size - 1).astype(np.int32)
            j = np.clip(x + r * math.cos(angle), 0, self.size - 1).astype(np.int32)
            reach += flat[i * self.size + j] <= depth
        return reach / 8


def _sample(image, x, y):
    """Bilinear look-up of a (H, W) image, 0 outside it."""
    height, width = image.shape
    x, y = x - 0.5, y - 0.5
    inside = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    i, j = y.astype(np.int32), x.astype(np.int32)
    u, v = x - j, y - i
    top = image[i, j] * (1 - u) + image[i, j + 1] * u
    low = image[i + 1, j] * (1 - u) + image[i + 1, j + 1] * u
    return np.where(inside, top * (1 - v) + low * v, 0)


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
    width, height = size[0] * samples, size[1] * samples
    vertices, faces, normals, outside, inside = _gather(meshes)
    axes = camera.axes()
    aspect = width / height
    tall = max(camera.height, camera.width / aspect)
    target = np.asarray(camera.target, float)
    if camera.fov > 0:
        distance = tall / 2 / math.tan(math.radians(camera.fov) / 2)
    else:
        distance = 50.0 * tall
    local = (vertices - target) @ axes.T
    z = distance + local[:, 2]
    focal = height / tall * distance
    if camera.fov > 0:
        faces_seen = (z[faces] > 0.05 * distance).all(1)
        near = 1 / np.maximum(z, 0.05 * distance)
        scale = focal * near
    else:
        faces_seen = (z[faces] > 0).all(1)
        near = np.maximum(2 * distance - z, 1e-6)
        scale = np.full(len(z), focal / distance)
    faces, outside, inside = faces[faces_seen], outside, inside[faces_seen]
    x, y = width / 2 + local[:, 0] * scale, height / 2 - local[:, 1] * scale
    nearest, _ = _rasterise(x, y, near, faces, width, height)

    away = -axes[2]
    key = 0.45 * away - 0.72 * axes[0] + np.array([0.0, 1.0, 0.0])
    key /= np.linalg.norm(key)
    light = _Light(vertices, faces, key)

    paper = np.asarray(background, float) / 255
    image = np.empty((size[1], size[0], 3), np.float32)
    image[:] = paper
    if ground is not None:  # soft and with smooth lines, so once a pixel is enough
        _draw_ground(image, ground, light, vertices, faces, axes, target, distance, focal / samples, camera.fov > 0)
    image = image.repeat(samples, 0).repeat(samples, 1)
    pixel = np.flatnonzero(nearest.ravel() >= 0)
    if len(pixel):
        face = nearest.ravel()[pixel]
        corner = faces[face]
        px, py = pixel % width + 0.5, pixel // width + 0.5
        weights, front = _weights(x, y, near if camera.fov > 0 else None, corner, px, py)
        position, normal, colour = (np.einsum("nk,nkc->nc", weights, v[corner]) for v in (vertices, normals, outside))
        normal *= np.where(front, 1.0, -1.0)[:, None]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        tinted = ~front & np.isfinite(inside[face, 0])
        colour = np.where(tinted[:, None], np.nan_to_num(inside[face]), colour)
        view = target - axes[2] * distance - position if camera.fov > 0 else np.broadcast_to(away, position.shape)
        view = view / np.linalg.norm(view, axis=1, keepdims=True)
        image.reshape(-1, 3)[pixel] = _shade(position, normal, colour, view, key, axes, light)
    if samples > 1:
        each = [image[i::samples, j::samples] for i in range(samples) for j in range(samples)]
        image = np.add.reduce(each) / samples**2
    return np.clip(image * 255 + 0.5, 0, 255).astype(np.uint8)


def _gather(meshes):
    """All meshes as one: vertices, finite faces, normals, linear outside colours by vertex, inside colours by face."""
    vertices, faces, normals, outside, inside, count = [], [], [], [], [], 0
    for mesh in meshes:
        v, f = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
        good = np.isfinite(v).all(1) & (np.abs(np.nan_to_num(v)) < 1e6).all(1)
        v, f = np.where(good[:, None], v, 0.0), f[good[f].all(1)]
        vertices.append(v)
        normals.append(_normals(v, f))
        faces.append(f + count)
        outside.append(np.broadcast_to(_linear(mesh.colour), v.shape))
        hidden = np.full(3, np.nan) if mesh.inside is None else _linear(mesh.inside)
        inside.append(np.broadcast_to(hidden, f.shape))
        count += len(v)
    if not vertices:
        return np.zeros((1, 3)), np.zeros((0, 3), np.int64), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((0, 3))
    return tuple(np.concatenate(part) for part in (vertices, faces, normals, outside, inside))


def _weights(x, y, near, corner, px, py):
    """Barycentric weights (N, 3) of pixels, right in perspective where `near` is 1/z, and whether the front is seen."""
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


def _shade(position, normal, colour, view, key, axes, light):
    """Colours (N, 3), sRGB: a key light with shadows, a fill, a sky, and a sheen at grazing angles."""
    dot = lambda direction: normal @ direction  # noqa: E731
    fill = 0.7 * axes[0] - 0.6 * axes[2] + np.array([0.0, 0.15, 0.0])
    fill /= np.linalg.norm(fill)
    facing = dot(key)
    lit = np.clip(facing, 0, 1)
    reach = np.zeros(len(lit))
    some = lit > 0
    reach[some] = light.on_surface(position[some], normal[some])
    sky = 0.5 + 0.5 * normal[:, 1]
    rim = (1 - np.clip((normal * view).sum(1), 0, 1)) ** 3
    warm, cool, above, below = (
        np.array(c) for c in ((1.0, 0.97, 0.92), (0.86, 0.93, 1.0), (0.93, 0.97, 1.0), (0.78, 0.70, 0.64))
    )
    energy = 0.84 * (lit * reach)[:, None] * warm + 0.15 * np.clip(dot(fill), 0, 1)[:, None] * cool
    energy += 0.31 * (sky[:, None] * above + (1 - sky[:, None]) * below)
    return _display(colour * energy + (0.05 * rim * (0.4 + 0.6 * sky))[:, None] * above)


def _draw_ground(image, ground, light, vertices, faces, axes, target, distance, focal, perspective):
    """Draw the floor: a faded grid, the sun's shadow, and the darkness where feet touch."""
    height, width = image.shape[:2]
    u = (np.arange(width) + 0.5 - width / 2) / focal
    v = (height / 2 - np.arange(height) - 0.5) / focal
    eye = target - axes[2] * distance
    if perspective:
        direction = axes[2] + v[:, None] * axes[1]  # its height is the same along a row
        slope = direction[:, 1]
    else:
        direction = np.broadcast_to(axes[2], (height, 3))
        slope = np.full(height, axes[2][1])
    rows = np.flatnonzero(slope < -1e-4)
    if not len(rows):
        return
    rise = 0.0 if perspective else v[rows] * distance * axes[1][1]
    t = (ground.height - eye[1] - rise) / slope[rows]
    start = eye + (0.0 if perspective else (v[rows] * distance)[:, None] * axes[1]) + t[:, None] * direction[rows]
    wide = (t if perspective else np.full(len(rows), distance))[:, None] * u[None, :]
    px = start[:, None, 0] + wide * axes[0][0]
    pz = start[:, None, 2] + wide * axes[0][2]
    far = np.hypot(px - ground.centre[0], pz - ground.centre[1]) / ground.radius
    r, c = np.nonzero((far < 1) & (t > 0)[:, None])
    if not len(r):
        return
    px, pz = px[r, c], pz[r, c]
    fade = (1 - far[r, c] ** 2) ** 2
    # Lines as wide as 5 mm but never thinner than a pixel, paler where a pixel covers more of them.
    across = (t if perspective else np.full(len(rows), distance)) / focal
    grazing = np.abs(axes[2][1])
    line = np.zeros(len(r))
    for p, axis in ((px, 0), (pz, 2)) if ground.cell > 0 else ():
        stretch = np.hypot(axes[0][axis], axes[1][axis] / max(grazing, 0.05))
        foot = np.maximum(across * stretch, 1e-6)[r]
        off = np.abs((p / ground.cell + 0.5) % 1 - 0.5) * ground.cell
        cover = np.clip((0.0035 + foot - off) / foot, 0, 1) * np.minimum(1, 0.010 / foot)
        line = np.maximum(line, cover)
    points = np.stack([px, np.full(len(px), ground.height), pz], 1)
    lit = light.on_ground(points)
    touch = _touch(vertices, faces, ground, px, pz)
    dark = 1 - (1 - 0.26 * (1 - lit)) * (1 - 0.34 * touch)
    dark = dark * np.clip(1.6 * (1 - far[r, c]), 0, 1)
    paper = image[rows[r], c] * (1 - 0.16 * (line * fade)[:, None])
    image[rows[r], c] = paper * (1 - dark[:, None] * np.array([0.92, 0.97, 1.0]))


def _touch(vertices, faces, ground, px, pz):
    """How much of the sky is hidden close above the floor: (N,) in 0..1, from a height map taken from below."""
    size, reach = 192, 0.30
    used = vertices[np.unique(faces)] if len(faces) else np.zeros((0, 3))
    used = used[used[:, 1] < ground.height + reach]
    if len(used) < 3:
        return np.zeros(len(px))
    low, high = used[:, [0, 2]].min(0) - 0.15, used[:, [0, 2]].max(0) + 0.15
    scale = size / min(max(high[0] - low[0], high[1] - low[1]), 4.0)
    lowest = vertices[faces][:, :, 1].max(1) < ground.height + 3 * reach
    near = np.maximum(10.0 - (vertices[:, 1] - ground.height), 1e-3)
    x, y = (vertices[:, 0] - low[0]) * scale, (vertices[:, 2] - low[1]) * scale
    _, nearness = _rasterise(x, y, near, faces[lowest], size, size)
    hidden = np.where(nearness > 0, np.exp(-np.clip(10.0 - nearness, 0, 50) / 0.07), 0)
    soft = Image.fromarray((hidden * 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(float(0.022 * scale)))
    return _sample(np.asarray(soft, np.float32) / 255, (px - low[0]) * scale, (pz - low[1]) * scale)

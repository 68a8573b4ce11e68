"""Pictures of an animated garment: a contact sheet and an animated GIF.

No graphics card, display or browser is needed. Everything is drawn in metres with Y up; what has another up is turned first.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import replacing
from ncs_jax.view.animation import Animation
from ncs_jax.view.camera import Camera
from ncs_jax.view.ground import Ground
from ncs_jax.view.heading import heading
from ncs_jax.view.rasteriser import PAPER, DrawnMesh, render

__all__ = ["FAINT", "INK", "VIEWS", "animation_gif", "contact_sheet", "drawn_frames", "garment_colours"]

_ROWS = ("front", "side")
VIEWS = {"front": 0.0, "three-quarter": 35.0, "side": 90.0, "back": 180.0}
"""Azimuth of a named view in degrees, turning from +Z, which characters face, towards +X."""

CLOTH, CLOTH_INSIDE = (0.90, 0.47, 0.33), (0.55, 0.25, 0.28)
OVER = (0.36, 0.53, 0.57), (0.85, 0.73, 0.45)  # of garments over it, in turn
BODY, WORN = (0.80, 0.765, 0.73), (0.50, 0.60, 0.70)
INK, FAINT = (46, 42, 40), (142, 135, 128)
TOGETHER = 16  # frames of an animation that are in memory, drawn


@dataclass(frozen=True)
class _Stage:
    """Hold an animation with Y up, the camera's path (frames, 3), half of what it must show (3,), and the floor, m."""

    animation: Animation
    path: np.ndarray
    half: np.ndarray
    floor: float

    @property
    def frames(self) -> int:
        return len(self.animation.garment)

    def meshes(self, frame: int) -> list[DrawnMesh]:
        garment, body = self.animation.garment[frame], self.animation.body
        colours = garment_colours(self.animation.layers, len(garment))
        drawn = [DrawnMesh(garment, self.animation.garment_faces, *colours, self.animation.checker)]
        if body is not None:
            x = body.vertices[frame]
            drawn.append(DrawnMesh(x, body.faces, np.repeat([BODY, WORN], [len(x) - body.worn, body.worn], axis=0)))
        return drawn

    def ground(self, frame: int, radius: float) -> Ground:
        return Ground(self.floor, (self.path[frame, 0], self.path[frame, 2]), radius)

    def heading(self, frame: int) -> float:
        """Return how far the character is turned about Y, degrees: by its trunk, else since the first frame, by its outline."""
        body = self.animation.body
        if body is not None and body.axes is not None:
            return heading(body.axes[frame])
        x = self.animation.garment if body is None else body.vertices
        first, now = x[0], x[frame]
        good = _drawable(first).all(1) & _drawable(now).all(1)
        if not good.any():
            return 0.0
        (x0, _, z0), (x1, _, z1) = (first[good] - first[good].mean(0)).T, (now[good] - now[good].mean(0)).T
        return math.degrees(math.atan2((x1 * z0 - z1 * x0).sum(), (x1 * x0 + z1 * z0).sum()))

    def bounds(self, frame: int, azimuth: float) -> tuple[np.ndarray, float, float, float]:
        """Return the middle (x, z) of a frame as seen from an azimuth, its lowest and highest y, and its width, m."""
        garment, body = self.animation.garment[frame], self.animation.body
        points = garment if body is None else np.concatenate([garment, body.vertices[frame]])
        points = points[_drawable(points).all(1)]
        if not len(points):
            return self.path[frame, [0, 2]], self.floor, self.floor + 1.0, 1.0
        a = math.radians(azimuth)
        turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])  # rows: right and back, in x and z
        across = points[:, [0, 2]] @ turn.T
        low, high = across.min(0), across.max(0)
        # A garment that has blown up must not shrink the rest to a dot.
        size = np.minimum(high - low, 6.0)
        y = np.clip(points[:, 1], self.floor - 1.0, self.floor + 6.0)
        return turn.T @ (low + high) / 2, min(float(y.min()), self.floor), float(y.max()), float(size[0])


def garment_colours(layers: Sequence[int], verts: int) -> tuple[Sequence[float] | np.ndarray, Sequence[float] | None]:
    """Return a garment's colours outside, of all or by vertex (verts, 3), and inside; None: as outside.

    layers: the first vertex of each garment that is over the innermost.
    """
    if not layers:
        return CLOTH, CLOTH_INSIDE
    ends = np.array([*layers, verts])
    shades = [CLOTH, *(OVER[k % len(OVER)] for k in range(len(layers)))]
    return np.repeat(shades, np.diff(ends, prepend=0), axis=0), None


def _drawable(vertices):
    """Tell which coordinates can be drawn: finite, and not blown up."""
    return np.abs(np.where(np.isfinite(vertices), vertices, np.inf)) < 1e3


def _stage(animation: Animation) -> _Stage:
    """Turn an animation upright, and find the camera's path."""
    animation = animation.y_up()
    garment, body, fps = animation.garment, animation.body, animation.fps
    path, low, high = _camera_path(garment if body is None else body.vertices, fps)
    # 5 % of the height more than the character, and room for what swings.
    relative_low, relative_high = (low - path).min(0), (high - path).max(0)
    if body is not None:
        _, cloth_low, cloth_high = _camera_path(garment, fps)
        relative_low = np.minimum(relative_low, np.maximum((cloth_low - path).min(0), -2.0))
        relative_high = np.maximum(relative_high, np.minimum((cloth_high - path).max(0), 2.0))
    middle = (relative_low[1] + relative_high[1]) / 2
    path = path + np.array([0.0, middle, 0.0])
    half = np.maximum((relative_high - relative_low) / 2, 0.05)
    half[[0, 2]] = np.maximum(np.abs(relative_low), np.abs(relative_high))[[0, 2]]
    return _Stage(animation, path, half, float(low[:, 1].min()))


def _camera_path(vertices, fps):
    """Return a smooth path (T, 3) that follows x and z of vertices (T, V, 3) at a steady height, and their bounds by frame."""
    good = _drawable(vertices)
    some = good.all(2).any(1)
    if not some.any():
        zero = np.zeros((len(vertices), 3))
        return zero, zero - 0.5, zero + 0.5
    low = np.where(good, vertices, np.inf).min(1)
    high = np.where(good, vertices, -np.inf).max(1)
    frames = np.arange(len(vertices))
    fit = lambda bound: np.stack([np.interp(frames, frames[some], bound[some, i]) for i in range(3)], 1)  # noqa: E731
    low, high = fit(low), fit(high)
    count = np.maximum(good.sum(1), 1)
    centre = fit(np.where(good, vertices, 0).sum(1, dtype=float) / count)
    centre[:, 1] = 0.0
    width = max(1, round(0.25 * fps))
    kernel = np.exp(-0.5 * (np.arange(-2 * width, 2 * width + 1) / width) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(centre, ((2 * width, 2 * width), (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, i], kernel, "valid") for i in range(3)], 1), low, high


def _font(size):
    return ImageFont.load_default(size)


def _moments(frames: int | Sequence[int], count: int) -> list[int]:
    """Return some moments of `count`, evenly spread, or those that are named."""
    if isinstance(frames, int):
        return np.unique(np.linspace(0, count - 1, max(1, frames)).round().astype(int)).tolist()
    chosen = [int(frame) for frame in frames]
    if not chosen or min(chosen) < 0 or max(chosen) >= count:
        raise InputError(f"moments from 0 to {count - 1} expected", field="frames", value=chosen)
    return chosen


def contact_sheet(
    path: str | Path,
    animation: Animation | Mapping[str, Animation],
    *,
    frames: int | Sequence[int] = 8,
    tile: int = 520,
    labels: Sequence[str] = (),
) -> None:
    """Write a PNG of several moments of an animation, from the character's front and side; the camera turns with it.

        contact_sheet("both.png", {"network": one, "simulation": other})

    Args:
        path: of the PNG. animation: to draw; or several by their names, each in a row, from the front. frames: how many
            moments, evenly spread; or which. tile: height of one picture in pixels. labels: of the moments; without them the
            time of each.

    Raises:
        InputError: animations have other frames, or not these moments, or there is not a label for each of them.
    """
    if isinstance(animation, Animation):
        stage = _stage(animation)
        rows = [(view, view, stage) for view in _ROWS]
    else:
        rows = [(name, "front", _stage(each)) for name, each in animation.items()]
    counts = {stage.frames for *_, stage in rows}
    if len(counts) != 1:
        raise InputError("animations of as many frames expected", field="animation", value=sorted(counts))
    chosen = _moments(frames, counts.pop())
    if labels and len(labels) != len(chosen):
        raise InputError(f"a label for each of {len(chosen)} moments expected", field="labels", value=len(labels))
    turned = [[stage.heading(frame) + VIEWS[view] for frame in chosen] for _, view, stage in rows]
    bounds = [
        [stage.bounds(frame, azimuth) for frame, azimuth in zip(chosen, azimuths, strict=True)]
        for (*_, stage), azimuths in zip(rows, turned, strict=True)
    ]
    low, high = min(each[1] for row in bounds for each in row), max(each[2] for row in bounds for each in row)
    tall = 1.10 * (high - low)
    wide = 1.10 * max(each[3] for row in bounds for each in row)
    width = round(tile * min(max(wide / tall, 0.40), 1.3))
    margin, label, fps = 56, 40, rows[0][2].animation.fps
    sheet = Image.new("RGB", (2 * margin + width * len(chosen), len(rows) * tile + 2 * label + margin), PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, (name, _, stage) in enumerate(rows):
        top = label + row * tile
        for column, (frame, azimuth, (middle, *_)) in enumerate(zip(chosen, turned[row], bounds[row], strict=True)):
            target = (middle[0], (low + high) / 2, middle[1])
            camera = Camera(target, tall, wide, azimuth, elevation=7.0)
            ground = Ground(stage.floor, middle, max(0.75, 0.55 * tall * width / tile), cell=0)
            picture = render(stage.meshes(frame), camera, (width, tile), ground=ground)
            sheet.paste(Image.fromarray(picture), (margin + column * width, top))
        text = Image.new("L", (tile, label), 0)
        ImageDraw.Draw(text).text((tile / 2, label / 2), name.upper(), 255, _font(17), "mm")
        sheet.paste(FAINT, (8, top), text.rotate(90, expand=True))
    for column, frame in enumerate(chosen):
        x = margin + (column + 0.5) * width
        below = labels[column] if labels else f"{frame / fps:.2f} s"
        draw.text((x, label + len(rows) * tile + 22), below, INK, _font(22), "mm")
    with replacing(path) as part:
        sheet.save(part, optimize=True)


def animation_gif(
    path: str | Path,
    animation: Animation,
    *,
    max_frames: int = 120,
    size: tuple[int, int] = (360, 450),
    view: str = "three-quarter",
    max_bytes: int = 6_000_000,
    report: Callable[[float], None] | None = None,
) -> None:
    """Write an animated GIF that follows the character over a fixed grid, at 15 frames per second or what comes closest.

    Args:
        path: of the GIF. animation: to draw. max_frames: of the GIF; a longer animation is cut there. size: width and height in
            pixels. view: one of `VIEWS`. max_bytes: colours and then frames are dropped until it is no larger.
        report: called with the share of the frames that are drawn.
    """
    fps = animation.fps
    stride = max(1, math.floor(fps / 15 + 0.5))
    chosen = range(0, len(animation.garment), stride)[: max(1, max_frames)]
    pictures = []
    for picture in drawn_frames(animation, chosen, size, view):
        pictures.append(Image.fromarray(picture))
        if report is not None:
            report(len(pictures) / len(chosen))
    colours, step = 255, 1
    while True:
        _write_gif(path, pictures[::step], stride * step / fps, colours)
        if Path(path).stat().st_size <= max_bytes or len(pictures) <= step:
            return
        colours, step = (128, step) if colours == 255 else (colours, step + 1)


def drawn_frames(animation: Animation, chosen: Sequence[int], size: tuple[int, int], view: str) -> Iterator[np.ndarray]:
    """Draw frames of an animation one after the other, each (height, width, 3) uint8; the camera follows the character.

    A few are drawn at a time, so that a long animation does not fill the memory.
    """
    if view not in VIEWS:
        raise InputError(f"one of {', '.join(VIEWS)} expected", field="view", value=view)
    stage = _stage(animation)
    half = math.hypot(stage.half[0], stage.half[2]) if view not in ("front", "back") else stage.half[0]
    camera = Camera(stage.path[0], 2 * stage.half[1] * 1.16, 2 * half * 0.92, VIEWS[view], elevation=12.0)

    def draw(frame: int) -> np.ndarray:
        at = replace(camera, target=stage.path[frame])
        return render(stage.meshes(frame), at, size, ground=stage.ground(frame, 2.6))

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for start in range(0, len(chosen), TOGETHER):
            yield from pool.map(draw, chosen[start : start + TOGETHER])


def _write_gif(path, pictures, seconds, colours):
    """Write the frames with one palette for all, chosen from several of them, so that nothing flickers."""
    few = np.concatenate([np.asarray(picture).reshape(-1, 3) for picture in pictures[:: max(1, len(pictures) // 6)]])
    # Each colour once: by area, the wide floor would take them all and leave the cloth flat.
    each = np.unique(few >> 2, axis=0) * 4 + 1
    few = Image.fromarray(each[None].astype(np.uint8)).quantize(colours - 1, Image.Quantize.MEDIANCUT).getpalette()
    palette = np.concatenate([np.reshape(few, (-1, 3))[: colours - 1], [PAPER]])  # and the background as it is
    # The nearest of them for each of 64^3 colours; Pillow's own look-up is only near, and tints the background.
    cells = np.stack(np.meshgrid(*[np.arange(64) * 4 + 1.5] * 3, indexing="ij"), -1)
    table = cKDTree(palette).query(cells)[1].astype(np.uint8)
    table[tuple(np.array(PAPER) >> 2)] = len(palette) - 1
    drawn = []
    for picture in pictures:
        r, g, b = np.moveaxis(np.asarray(picture) >> 2, 2, 0)
        drawn.append(Image.fromarray(table[r, g, b]))
        drawn[-1].putpalette(palette.astype(np.uint8).tobytes())
    # A GIF counts in hundredths of a second: the rounding must not add up.
    ends = np.maximum.accumulate(np.round(np.arange(1, len(drawn) + 1) * seconds * 100)).astype(int)
    durations = [max(20, int(d) * 10) for d in np.diff(ends, prepend=0)]
    with replacing(path) as part:
        drawn[0].save(part, save_all=True, append_images=drawn[1:], duration=durations, loop=0, optimize=False, disposal=1)

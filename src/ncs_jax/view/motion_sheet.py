"""A picture of motions as they were imported: the character with its garment above the skeleton that drives it.

Only NumPy and Pillow draw, and nothing is compiled: the picture is there in a second or two.
"""

from __future__ import annotations

import math
import os
import unicodedata
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ncs_jax.errors import required
from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.io.records import SkeletonPoses, shown_frames
from ncs_jax.io.tables.files import replacing
from ncs_jax.prepare.joint_names import side_and_rest
from ncs_jax.prepare.posing import carried, joint_transforms, skinned
from ncs_jax.prepare.setting import Setting
from ncs_jax.view.animation import upright, upright_axes
from ncs_jax.view.camera import Camera
from ncs_jax.view.ground import Ground
from ncs_jax.view.heading import heading, trunk_axes, up_of
from ncs_jax.view.pictures import BODY, FAINT, INK, WORN, garment_colours
from ncs_jax.view.rasteriser import PAPER, DrawnMesh, render

__all__ = ["motion_sheet", "posed"]

TILE = 150, 230  # pixels of one moment
TITLE, MARGIN = 30, 34  # pixels above the moments of a motion, and beside them
TURNED = 25.0  # degrees by which the camera looks from beside the front, so that no limb hides another
FINE = 3  # drawn so many times larger, then made smaller, for smooth lines
SIDES = {"left": (38, 110, 190), "right": (200, 72, 40), "": INK}


def posed(body: BodyRecord, motion: MotionRecord, frames: np.ndarray) -> np.ndarray:
    """Return what takes rest points to some frames by each joint (n, J, 3, 4), in m."""
    matrices = joint_transforms(body, motion.poses[frames])
    matrices[..., 3] += motion.translation[frames, None]
    return matrices


def motion_sheet(path: str | Path, setting: Setting, motions: Mapping[str, MotionRecord]) -> None:
    """Write a PNG of motions: above, the character with its garment skinned to it; below, the skeleton as it was recorded.

    The skeleton is drawn to the character's scale and from its side: where a motion was read rightly, both do the same. Blue is
    its left, red its right. A motion of the body's own joints has the body's own skeleton below.

    Args:
        path: of the PNG. setting: of a scene with a body. motions: to draw, each under its title.
    """
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        rows = list(pool.map(lambda title: _motion_row(title, setting, motions[title]), motions))
    sheet = Image.new("RGB", (rows[0].width, sum(row.height for row in rows)), PAPER)
    for number, row in enumerate(rows):
        sheet.paste(row, (0, number * row.height))
    with replacing(path) as part:
        sheet.save(part, format="PNG")


def _motion_row(title: str, setting: Setting, record: MotionRecord) -> Image.Image:
    """Return one motion: its title, the character and the skeleton in some frames, and their times."""
    body = required(setting.body, "body.file", "name a body")
    up = up_of(setting.scene.physics.gravity)
    frames = shown_frames(len(record.poses))
    matrices = posed(body, record, frames)
    joints = np.einsum("njab,jb->nja", matrices[..., :3], body.joints) + matrices[..., 3]
    rest, garment = upright(body.vertices, up), setting.garment
    skin = upright(np.array([skinned(body.vertices, body.weights, each) for each in matrices]), up)
    cloth = upright(np.array([skinned(garment.vertices, setting.prepared.weights, each) for each in matrices]), up)
    floor = float(rest[:, 1].min())
    source = record.source or SkeletonPoses(joints, body.parents, body.joint_names or ("",) * len(body.parents))
    bones = upright(source.places[: len(frames)], up)
    low, high = min(floor, float(skin[..., 1].min())), max(float(skin[..., 1].max()), floor + 0.5)
    (width, height), columns = TILE, len(frames)
    image = Image.new("RGB", (2 * MARGIN + width * 8, TITLE + 2 * height + 22), PAPER)
    axes = upright_axes(trunk_axes(body, matrices[..., :3]), up)
    tall, azimuths = 1.15 * (high - low), [TURNED + heading(each) for each in axes]
    wide = 1.1 * max(
        float(np.ptp(x @ (math.cos(a), 0.0, -math.sin(a)))) for x, a in zip(skin, np.radians(azimuths), strict=True)
    )
    colours = garment_colours(garment.layers, len(garment.vertices))
    for column in range(columns):
        middle = (skin[column].min(0) + skin[column].max(0)) / 2
        target = np.array([middle[0], (low + high) / 2, middle[2]])
        camera = Camera(target, tall, wide, azimuths[column], elevation=7.0)
        meshes = [DrawnMesh(skin[column], body.faces, BODY), DrawnMesh(cloth[column], garment.faces, *colours)]
        meshes += [DrawnMesh(upright(x, up), faces, WORN) for x, faces in _worn_below(setting, matrices[column])]
        ground = Ground(floor, (float(middle[0]), float(middle[2])), 0.3 * tall, cell=0)
        place = (MARGIN + column * width, TITLE)
        image.paste(Image.fromarray(render(meshes, camera, TILE, ground=ground, samples=1)), place)
        own = bones[column] - (bones[column].min(0) + bones[column].max(0)) / 2 * (1, 0, 1) + middle * (1, 0, 1)
        own[:, 1] += floor - float(bones[..., 1].min())
        image.paste(_stick_figure(own, source, camera, floor), (place[0], place[1] + height))
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(15)
    plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode()  # the font has no other letters
    draw.text((MARGIN, TITLE / 2), plain, INK, font, "lm")
    for column, frame in enumerate(frames.tolist()):
        at = MARGIN + (column + 0.5) * width, TITLE + 2 * height + 10
        draw.text(at, f"{frame / record.fps:.2f} s", FAINT, ImageFont.load_default(13), "mm")
    for row, words in enumerate(("ON THE CHARACTER", "AS RECORDED")):
        label = Image.new("L", (height, MARGIN), 0)
        ImageDraw.Draw(label).text((height / 2, MARGIN / 2), words, 255, ImageFont.load_default(12), "mm")
        image.paste(FAINT, (0, TITLE + row * height), label.rotate(90, expand=True))
    return image


def _worn_below(setting: Setting, matrices: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the vertices (V, 3) of each garment below, skinned to a pose, m, and its faces."""
    for layer in setting.model.under:
        own = matrices[list(layer.model.source_joints)]
        yield carried(np.asarray(layer.rest, np.float64), layer.model.blend, own), np.asarray(layer.model.garment.mesh.faces)


def _stick_figure(places: np.ndarray, source: SkeletonPoses, camera: Camera, floor: float) -> Image.Image:
    """Return the bones of a skeleton (J, 3), farther ones first, on a floor."""
    width, height = (FINE * n for n in TILE)
    projection = camera.projection(width, height)
    image = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(image)
    angle = np.linspace(0, 2 * np.pi, 49)
    circle = 0.3 * camera.height * np.stack([np.cos(angle), np.zeros(49), np.sin(angle)], axis=1)
    x, y, _, _ = projection.project(circle + np.asarray(camera.target) * (1, 0, 1) + (0, floor, 0))
    draw.polygon(list(zip(x.tolist(), y.tolist(), strict=True)), fill=(236, 232, 225))
    x, y, near, _ = projection.project(places)
    sides = [side for side, _ in side_and_rest(source.joint_names)]
    for j in np.argsort(near).tolist():
        parent = int(source.parents[j])
        if parent >= 0 and np.isfinite([x[j], y[j], x[parent], y[parent]]).all():
            draw.line([(x[parent], y[parent]), (x[j], y[j])], SIDES[sides[j]], 2 * FINE, "curve")
            r = 1.3 * FINE
            draw.ellipse([x[j] - r, y[j] - r, x[j] + r, y[j] + r], SIDES[sides[j]])
    return image.resize(TILE, Image.Resampling.LANCZOS)

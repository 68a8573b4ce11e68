"""Skin that shows through a garment, counted in pixels as a person sees it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ncs_jax.geometry.depth_buffer import Fragments, fragments

__all__ = ["REACH", "CoveredSkin", "covered_faces", "covered_skin", "skin_pixels"]

REACH = 0.1  # m; skin shows through cloth that lies so deep beneath it: half of a thigh
PIXELS = 256  # along the largest side of the garment at rest
MOST = 1024  # along a side of a view; a garment that is larger is seen in coarser pixels
DIRECTIONS = 96  # in which one looks out of the skin at rest
CONE = 0.5  # cosine of the angle to the normal within which a direction counts
HIDDEN = 0.4  # of these directions the garment must hide: half at the height of a hem, whatever the distance
TIGHT = 0.01  # m; a garment that lies so deep in the skin at rest covers it


class CoveredSkin(NamedTuple):
    """What is needed to count the pixels of a garment's frames.

    faces: (B, 3) triangles of the body, outward. cloth: (F, 3) of the garment. covered: (B,) which of the body's the garment
    covers at rest. pixel: its size, m.
    """

    faces: np.ndarray
    cloth: np.ndarray
    covered: np.ndarray
    pixel: float


def covered_skin(body: np.ndarray, faces: np.ndarray, garment: np.ndarray, cloth: np.ndarray) -> CoveredSkin:
    """Return what `skin_pixels` needs, of body (N, 3) and garment (V, 3) at rest, m, and their triangles."""
    pixel = float(np.ptp(garment, axis=0).max()) / PIXELS
    return CoveredSkin(faces, cloth, covered_faces(body, faces, garment, cloth, pixel), pixel)


def covered_faces(body: np.ndarray, faces: np.ndarray, garment: np.ndarray, cloth: np.ndarray, pixel: float) -> np.ndarray:
    """Return which triangles of a body (B,) a garment covers.

    A triangle is covered if of the directions within 60 degrees of its normal two in five meet the garment, and meet its inside
    first. At the height of a hem half of them do, however far the hem stands off. So what is beyond a hem, a neck or a sleeve's
    end is not covered, nor is an arm that hangs beside the garment. The inside is the side that most directions meet.

    Args:
        body (N, 3), garment (V, 3): m. faces: outward. cloth: all facing one way. pixel: how finely the garment is seen, m.
    """
    corners, sheet = np.asarray(body, np.float64)[faces], np.asarray(garment, np.float64)[cloth]
    normal, outward = _normals(corners), _normals(sheet)
    start, garment = corners.mean(axis=1) - TIGHT * normal, np.asarray(garment, np.float64)
    looked, met = np.zeros(len(faces)), []
    for axes in _frames_about(DIRECTIONS // 2):
        there, points = garment @ axes.T, start @ axes.T
        low = np.minimum(there.min(axis=0), points.min(axis=0))
        there, points = (there - low) / pixel, (points - low) / pixel
        size = (int(points[:, 0].max()) + 1, int(points[:, 1].max()) + 1)  # where no skin is, nobody looks
        layers = fragments(there[:, 0], there[:, 1], there[:, 2], cloth, size)
        for sign in (1, -1):
            some = np.flatnonzero(sign * (normal @ axes[2]) > CONE)
            looked[some] += 1
            hit, face = _beyond(layers, points[some], size, sign)
            met.append((some[hit], sign * (outward[face] @ axes[2])))
    side = np.sign(sum(facing.sum() for _, facing in met))
    hidden = np.zeros(len(faces))
    for some, facing in met:
        hidden[some] += side * facing > 0
    return (looked > 0) & (hidden >= HIDDEN * looked)


def _normals(corners: np.ndarray) -> np.ndarray:
    """Return unit normals of triangles (F, 3, 3); zero of one without an area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(size > 0, size, 1)


def _frames_about(count: int) -> np.ndarray:
    """Return orthonormal axes, rows (count, 3, 3), whose third ones are spread evenly over a half of the sphere."""
    k = np.arange(count) + 0.5
    y, turn = k / count, np.pi * (1 + np.sqrt(5)) * k  # a Fibonacci lattice
    out = np.sqrt(1 - y**2)
    third = np.stack([out * np.cos(turn), y, out * np.sin(turn)], axis=1)
    first = np.cross(third, np.eye(3)[np.abs(third).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _beyond(layers: Fragments, points: np.ndarray, size: tuple[int, int], sign: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which points (P, 3), in pixels, have a fragment beyond them, up the depth or down it, and the face of the next."""
    pixel = points[:, 1].astype(np.int64) * size[0] + points[:, 0].astype(np.int64)
    span = max(layers.depth.max(initial=0), points[:, 2].max(initial=0)) + 1
    at = np.searchsorted(layers.pixel + layers.depth / span, pixel + points[:, 2] / span) - (sign < 0)
    there = np.flatnonzero((at >= 0) & (at < len(layers.pixel)))
    there = there[layers.pixel[at[there]] == pixel[there]]
    return there, layers.face[at[there]]


def skin_pixels(skin: CoveredSkin, body: np.ndarray, garment: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the face of skin that shows through a garment in one frame, pixel by pixel, and in how many either is seen there.

    Six views are looked at, level ones from four sides, from above and from below, along the world's axes, without
    perspective. A pixel shows skin through the garment if, along its ray, in order of the distance s from the eye,

        s_skin < s_cloth < s_out   and   s_cloth - s_skin < REACH,

    s_skin: the first surface of all, which is one that the garment covers at rest, seen from outside; s_cloth: the garment;
    s_out: where the ray leaves the body again. So the garment lies beneath the skin that it should hide. What one sees through
    a neck or up a skirt has no cloth beneath it, and does not count; neither does a bare arm that is pressed into the garment.
    Of a limb that has come through the garment counts what has cloth beneath it, and not what is beyond.

    Args:
        body (N, 3), garment (V, 3): m, all finite, in this frame.
    """
    low, high = garment.min(axis=0), garment.max(axis=0)
    pixel = max(skin.pixel, float((high - low).max()) / MOST)
    both = (np.concatenate([body, garment]).astype(np.float64) - low) / pixel
    faces = np.concatenate([skin.faces, skin.cloth + len(body)])
    corners = both[faces]
    covered = np.concatenate([skin.covered, np.zeros(len(skin.cloth), bool)])
    shown, seen = [], 0
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        width, height = (int(np.ceil((high - low)[k] / pixel)) + 1 for k in (first, second))
        layers = fragments(both[:, first], both[:, second], both[:, axis], faces, (width, height))
        a, b = (corners[:, k] - corners[:, 0] for k in (1, 2))
        up = a[:, first] * b[:, second] - a[:, second] * b[:, first]
        for order, facing in ((slice(None, None, -1), up > 0), (slice(None), up < 0)):
            own = Fragments(*(part[order] for part in layers))
            some, every = _count(own, facing, covered, len(skin.faces), REACH / pixel)
            shown.append(some)
            seen += every
    return np.concatenate(shown), seen


def _count(layers: Fragments, facing: np.ndarray, covered: np.ndarray, bare: int, reach: float) -> tuple[np.ndarray, int]:
    """Return the face of skin that shows, pixel by pixel of a view, and in how many either is seen; fragments are by depth.

    facing: which faces look at the eye; the first `bare` ones are the body's. reach: as the depths are.
    """
    count = len(layers.pixel)
    if not count:
        return np.zeros(0, np.int64), 0
    start = np.flatnonzero(np.diff(layers.pixel, prepend=-1))
    skin = (layers.face < bare) & facing[layers.face]
    # the next fragment that is no skin: cloth, or where the ray leaves the body
    after = np.minimum.accumulate(np.where(skin, count, np.arange(count))[::-1])[::-1][start]
    then = np.minimum(after, count - 1)
    beneath = (after < count) & (layers.pixel[then] == layers.pixel[start]) & (layers.face[then] >= bare)
    beneath &= np.abs(layers.depth[then] - layers.depth[start]) < reach
    front = layers.face[start]
    shown = skin[start] & covered[front] & beneath
    return front[shown], int((shown | (front >= bare)).sum())

"""How far cloth must stay from the skin so that none shows between its vertices."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ncs_jax.geometry.surface_distance import border_of, closest_on_surface, signed_distance
from ncs_jax.scene.spec import CollisionSpec

__all__ = ["LOAD", "Cover", "contact_for", "least_thickness", "sinking", "vertex_share"]

LOAD = 100.0  # Pa; what presses cloth onto the skin where it carries or turns a garment
PRESSED = 0.00075  # m; contact is stiff enough to be pressed in by no more
SPARE = 2.0  # motion and what a network learns, as multiples of the least thickness
NEAR = 0.05  # m; cloth that is farther from the skin is not pressed onto it
STRETCH = 1.3  # a triangle whose edges become longer by more, pressed onto the skin, spans a gap of the body
SAMPLED = 1000  # triangles that stand for all
QUANTILE = 99.0  # per cent of them must keep the skin covered
# where a triangle is looked at: middles of edges, centre, and between it and the corners
PLACES = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 1], [1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]], float)


@dataclass(frozen=True)
class Cover:
    """What a scene's collision must be so that the skin stays covered.

    thickness: m. stiffness: J/m^2 a vertex. sinking: how deep triangles lie in the skin when their corners are on it, m.
    pressed: how deep their load presses them into the contact, m. edge: of their mean size, m.
    """

    thickness: float
    stiffness: float
    sinking: float
    pressed: float
    edge: float

    @property
    def least(self) -> float:
        """Return the thickness that the resting body asks for, m: `least_thickness`."""
        return self.sinking + self.pressed


def sinking(
    x: np.ndarray, faces: np.ndarray, skin: np.ndarray, skin_faces: np.ndarray, pieces: np.ndarray | None = None
) -> float:
    """Return how deep the triangles of a garment lie in the skin when what touches is on it, m; zero where none is near.

        s = the 99th percentile, over the triangles, of  max_p depth(sum_k p_k c(x_k)) / n^2,   c(x): the skin's closest point

    A flat triangle with edges l over a ball of radius R sinks by about l^2 / (6 R) in its middle and l^2 / (8 R) in those of
    its edges. Here the body's own mesh is asked, so that its facets and corners count as well.

    Args:
        x: (V, 3), faces (F, 3): the garment on the body, m. skin (B, 3), skin_faces: the body's, m.
        pieces: n, into how many contact cuts the edges of each triangle (F,); None, or empty: it looks at the corners alone.
    """
    x, every = np.asarray(x, np.float64), np.linspace(0, len(faces) - 1, min(SAMPLED, len(faces))).astype(int)
    corners = x[faces[every]]
    found = closest_on_surface(corners.reshape(-1, 3), skin, skin_faces)
    gap = found.gap.reshape(corners.shape)
    on_skin = corners - gap
    near = (np.linalg.norm(gap, axis=-1) < NEAR).all(axis=1)
    whole = (_edges(on_skin) <= STRETCH * _edges(corners)).all(axis=1)
    pieces = np.ones(len(faces)) if pieces is None or not pieces.size else pieces
    kept, cut = on_skin[near & whole], pieces[every[near & whole]]
    if not len(kept):
        return 0.0
    points = np.einsum("pk,fki->fpi", PLACES / PLACES.sum(axis=1, keepdims=True), kept)
    border = border_of(skin_faces, len(skin))
    depth = -signed_distance(points.reshape(-1, 3), skin, skin_faces, border).reshape(points.shape[:2])
    return float(max(np.percentile(depth.max(axis=1) / cut.astype(float) ** 2, QUANTILE), 0))


def _edges(corners: np.ndarray) -> np.ndarray:
    """Return the lengths (F, 3) of the edges of triangles (F, 3, 3), m."""
    return np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)


def vertex_share(x: np.ndarray, faces: np.ndarray, pieces: np.ndarray | None = None) -> float:
    """Return the mean area of a vertex, or of a vertex and a point where `pieces` say that contact cuts triangles, m^2."""
    double = np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]])
    share = np.linalg.norm(double, axis=1).sum() / 2 / len(np.unique(faces))
    return float(share if pieces is None or not pieces.size else share / np.mean(pieces.astype(float) ** 2))


def least_thickness(sunk: float, share: float, stiffness: float) -> float:
    """Return the thickness of contact, m, below which skin shows: what triangles sink, and what their load presses them in.

        eps = s + P a / (2 k),    of  k (eps - d)^2  a vertex (12), whose derivative holds the load  P a

    Args:
        sunk: s, of `sinking`, m. share: a, of a vertex, m^2. stiffness: k, J/m^2 a vertex; above zero. P is `LOAD`.
    """
    return sunk + LOAD * share / (2 * stiffness)


def contact_for(
    x: np.ndarray, faces: np.ndarray, sunk: float, thickness: float | None = None, pieces: np.ndarray | None = None
) -> Cover:
    """Return the contact that keeps the skin covered by a garment, in round numbers, and never below the defaults.

        k = P a / (2 p),    eps = 2 (s + P a / (2 k)),    p = `PRESSED`

    Args:
        x: (V, 3), faces (F, 3), m. sunk: of `sinking`, m. thickness: if given, this one is kept, m. pieces: as in `sinking`.
    """
    usual, share = CollisionSpec(), vertex_share(x, faces, pieces)
    stiffness = max(usual.stiffness, 5.0 * math.ceil(LOAD * share / (2 * PRESSED) / 5 - 1e-9))
    least = least_thickness(sunk, share, stiffness)
    if thickness is None:
        thickness = max(usual.thickness, math.ceil(1000 * SPARE * least - 1e-9) / 1000)
    return Cover(thickness, stiffness, sunk, least - sunk, float(_edges(x[faces]).mean()))

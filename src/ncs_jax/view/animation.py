"""The record that pictures and pages draw: a garment's vertices over time, on a posed body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["Animation", "PosedBody", "upright", "upright_axes"]


@dataclass(frozen=True, eq=False)
class PosedBody:
    """A posed body: what a garment is worn on, over a motion.

    Attributes:
        vertices: (frames, body, 3), m. faces: (faces, 3).
        worn: how many of the vertices, the last, are of garments worn below, whose faces come last too.
        axes: (frames, 3, 3) of the trunk, see `heading.trunk_axes`: a picture is taken from the front by them. None: by how the
            outline has turned since the first frame.

    Raises:
        InputError: the shapes do not fit together.
    """

    vertices: np.ndarray
    faces: np.ndarray
    worn: int = 0
    axes: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check what was given."""
        object.__setattr__(self, "vertices", _vertices(self.vertices, "body"))
        object.__setattr__(self, "faces", _faces(self.faces, self.vertices.shape[1], "body_faces"))
        if not 0 <= self.worn <= self.vertices.shape[1]:
            raise InputError(
                f"0 to {self.vertices.shape[1]} vertices of the body expected", field="worn", value=self.worn,
                mend="count the last vertices, those of the garments worn below",
            )  # fmt: skip
        if self.axes is not None and self.axes.shape != (expected := (len(self.vertices), 3, 3)):
            raise InputError(
                f"a matrix for each frame expected, {expected}", field="axes", value=self.axes.shape,
                mend="leave it out, or take `heading.trunk_axes`",
            )  # fmt: skip

    def turned(self, up: Sequence[float]) -> PosedBody:
        """Return this body turned so that `up` becomes +Y."""
        axes = None if self.axes is None else upright_axes(self.axes, up)
        return replace(self, vertices=upright(self.vertices, up), axes=axes)

    def at(self, frames: slice) -> PosedBody:
        """Return some of the frames."""
        return replace(self, vertices=self.vertices[frames], axes=None if self.axes is None else self.axes[frames])


@dataclass(frozen=True, eq=False)
class Animation:
    """An animation that pictures and pages draw: a garment over time, and the body that it is worn on.

    `view.character.animation_of` makes one from a run and a motion. Vertices may be NaN: a picture leaves them out.

    Attributes:
        garment: vertices (frames, verts, 3), m. garment_faces: (faces, 3). fps: frames per second.
        body: of as many frames, or None. up: the world's up, as three numbers; its length does not matter.
        layers: the first vertex of each garment but the innermost, of several worn together; each has a colour of its own.
        checker: the garment at rest (verts, 3), m: its cloth is drawn in squares, which show strain and sliding; else None.

    Raises:
        InputError: the shapes or frames do not fit together, or a number is not usable.
    """

    garment: np.ndarray
    garment_faces: np.ndarray
    fps: float
    body: PosedBody | None = None
    up: Sequence[float] = (0.0, 1.0, 0.0)
    checker: np.ndarray | None = None
    layers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check what was given."""
        object.__setattr__(self, "garment", _vertices(self.garment, "garment"))
        object.__setattr__(self, "garment_faces", _faces(self.garment_faces, self.garment.shape[1], "garment_faces"))
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise InputError(
                "frames per second above 0 expected", field="fps", value=self.fps, mend="give the frame rate of the motion"
            )
        if self.body is not None and len(self.body.vertices) != len(self.garment):
            raise InputError(
                f"{len(self.garment)} frames, as many as the garment has, expected", field="body",
                value=len(self.body.vertices), mend="pose the body by the motion that the garment was animated over",
            )  # fmt: skip
        _unit(self.up)
        if self.checker is not None and np.shape(self.checker) != self.garment.shape[1:]:
            raise InputError(
                f"the garment at rest, {self.garment.shape[1:]}, expected", field="checker", value=np.shape(self.checker),
                mend="give the vertices of the garment's own file, or None",
            )  # fmt: skip

    def y_up(self) -> Animation:
        """Return this animation turned so that +Y is up."""
        body = None if self.body is None else self.body.turned(self.up)
        return replace(self, garment=upright(self.garment, self.up), body=body, up=(0.0, 1.0, 0.0))

    def until(self, end: int | None) -> Animation:
        """Return the frames before `end`, all for None."""
        return self._at(slice(end))

    def every(self, step: int) -> Animation:
        """Return every `step`-th frame, from the first on, as fast as before."""
        return replace(self._at(slice(None, None, step)), fps=self.fps / step)

    def _at(self, frames: slice) -> Animation:
        return replace(self, garment=self.garment[frames], body=None if self.body is None else self.body.at(frames))


def upright(vertices: np.ndarray, up: Sequence[float] = (0.0, 1.0, 0.0)) -> np.ndarray:
    """Turn (..., 3) so that `up` becomes +Y, the shortest way: Z up facing -Y becomes Y up facing +Z."""
    u = _unit(up)
    if u[1] > 1 - 1e-12:
        return np.asarray(vertices)
    if u[1] < -1 + 1e-12:
        turn = np.diag([1.0, -1.0, -1.0])
    else:
        v = np.cross(u, [0.0, 1.0, 0.0])
        k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        turn = np.eye(3) + k + k @ k / (1 + u[1])
    return (np.asarray(vertices) @ turn.T).astype(np.asarray(vertices).dtype)


def upright_axes(axes: np.ndarray, up: Sequence[float]) -> np.ndarray:
    """Turn matrices (..., 3, 3) whose columns are directions, as `upright` turns vertices."""
    return np.swapaxes(upright(np.swapaxes(axes, -1, -2), up), -1, -2)


def _unit(up: Sequence[float]) -> np.ndarray:
    u = np.asarray(up, float)
    length = np.linalg.norm(u)
    if u.shape != (3,) or not np.isfinite(length) or length == 0:
        raise InputError("a direction of three numbers, not all zero, expected", field="up", value=up, mend="give (0, 1, 0)")
    return u / length


def _vertices(vertices, name: str) -> np.ndarray:
    vertices = np.asarray(vertices)
    if vertices.ndim != 3 or vertices.shape[2] != 3 or 0 in vertices.shape:
        raise InputError(
            "vertices of shape (frames, verts, 3) expected", field=name, value=vertices.shape,
            mend="give at least one frame and one vertex",
        )  # fmt: skip
    return vertices


def _faces(faces, count: int, name: str) -> np.ndarray:
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise InputError(
            "whole numbers of shape (faces, 3) expected", field=name, value=(faces.shape, str(faces.dtype)),
            mend="cut polygons into triangles, and give their vertices' numbers",
        )  # fmt: skip
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise InputError(
            f"vertex numbers from 0 to {count - 1} expected", field=name, value=(int(faces.min()), int(faces.max())),
            mend="counting starts at 0; give the faces of these vertices",
        )  # fmt: skip
    return faces

"""Records that the readers return: plain NumPy arrays, already checked, in metres and seconds unless a field says otherwise."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["AnimationRecord", "BodyRecord", "GarmentRecord", "MotionRecord", "SkeletonPoses", "shown_frames"]

SHOWN = 8  # frames of a motion that pictures show


def shown_frames(frames: int) -> np.ndarray:
    """Return the numbers of at most `SHOWN` frames, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, frames - 1, SHOWN).round().astype(int))


@dataclass(frozen=True, eq=False)
class BodyRecord:
    """A skinned character in its rest pose, or a moving mesh in its first frame.

    Attributes:
        vertices: (V, 3) rest positions, m. faces: (F, 3) int32. joints: (J, 3) global rest positions, m.
        parents: (J,) int32 with parents[j] < j, and -1 for joint 0, the root. weights: (V, J) skinning weights, not negative;
            every row sums to 1. joint_names: J names, or none. rest_rotations: (J, 3, 3) rotations of the joints in the rest
            pose, or None for the identity. posedirs: (V, 3, 9 (J - 1)) pose correctives of SMPL, m: what the entries of
            R_j - I of every joint but the root add to the vertices, before skinning; None: no correctives. bones: J names of
            a person's bones, "" for none, where the format says which joints they are; else none. notes: what was mended in
            the file.
        frames: all vertices in all frames (T, V, 3), m, of a body that is a moving mesh instead of a character; else None.
        carriers: (T, J, 3, 4) what takes each of its joints from rest, its first frame, to a frame; fps: frames per second.
    """

    vertices: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    parents: np.ndarray
    weights: np.ndarray
    joint_names: tuple[str, ...] = ()
    rest_rotations: np.ndarray | None = None
    posedirs: np.ndarray | None = None
    bones: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    frames: np.ndarray | None = None
    carriers: np.ndarray | None = None
    fps: float = 0.0


@dataclass(frozen=True, eq=False)
class GarmentRecord:
    """A garment in its rest shape on the resting body: an oriented manifold triangle mesh, usually with boundary.

    Attributes:
        vertices: (V, 3) rest positions, m. faces: (F, 3) int32. uv: (F, 3, 2) texture coordinates of the triangles' corners, v
            upward: at a seam a vertex has several; None where the file has none. groups: named vertex sets, each sorted int32.
            scale, up: the file's unit in metres and its axis that is up; both are already applied. welded: how many of the
            file's vertices were merged into another. weights: (V, J) skinning weights, not negative, every row sums to 1; None:
            the body's. joint_names: the J joints of the weights, none where they are the body's, in its order. notes: what was
            mended in the file.
        layers: the first vertex of each garment but the innermost, of several that are worn together; see `worn_together`.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    scale: float = 1.0
    up: str = "y"
    welded: int = 0
    weights: np.ndarray | None = None
    joint_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    layers: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class SkeletonPoses:
    """A skeleton in some frames of a motion, for pictures.

    Attributes:
        places: (n, J, 3) of the joints in frames spread evenly, m, in the world of the scene. parents: (J,) int32 as in a body.
        joint_names: J names.
    """

    places: np.ndarray
    parents: np.ndarray
    joint_names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class MotionRecord:
    """The motion of a skeleton.

    Attributes:
        poses: (T, J, 3) local rotations since rest, axis times angle, rad. translation: (T, 3) of the root since rest, m.
        fps: frames per second. joint_names: J names, or none.
        joints, parents, tips: the file's own skeleton, or None: (J, 3) global rest positions in the unit of the translation,
            (J,) int32 as in a body, and (J, 3) global rest positions of the ends of the last bones, NaN at other joints.
        rest_rotations: (J, 3, 3) as in a body: the axes that the poses are along; None: the world's. up: the axis of the world
            that points up, where the format says so, else "". notes: what was done so that the motion drives the body.
        source: the skeleton that drives this one, if it is another, in `SHOWN` frames.
        bones: as in a body.
        origin: the number in its file of the first frame, and how many of the file's frames make one of these.
        absent: names in `motion.joints` that are no joint of this motion, each with the likeliest that is one, or "".
        driven: of a motion that was retargeted, the source's joint for each joint of the body that one drives.
        undriven: limbs of the body that nothing drives, such as "left upper arm", each with what mends it.
        uncertain: parts of a person, such as "head", whose reference pose had to be built, and to how many degrees it is right;
            or "head of the zero pose", that is bent there as in no frame, and by how much.
    """

    poses: np.ndarray
    translation: np.ndarray
    fps: float
    joint_names: tuple[str, ...] = ()
    joints: np.ndarray | None = None
    parents: np.ndarray | None = None
    tips: np.ndarray | None = None
    rest_rotations: np.ndarray | None = None
    up: str = ""
    notes: tuple[str, ...] = ()
    source: SkeletonPoses | None = None
    bones: tuple[str, ...] = ()
    undriven: dict[str, str] = field(default_factory=dict)
    uncertain: dict[str, float] = field(default_factory=dict)
    origin: tuple[int, float] = (0, 1.0)
    driven: dict[str, str] = field(default_factory=dict)
    absent: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class AnimationRecord:
    """A moving mesh.

    Attributes:
        vertices: (T, V, 3) float32, m. faces: (F, 3) int32; no rows where the file has none. fps: frames per second.
    """

    vertices: np.ndarray
    faces: np.ndarray
    fps: float

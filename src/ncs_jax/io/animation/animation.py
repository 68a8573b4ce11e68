"""Animations to and from .npz, .h5, .pc2, .mdd, USD and folders of .obj files, and to .glb."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ncs_jax.errors import InputError
from ncs_jax.io.animation.glb import write_glb
from ncs_jax.io.animation.mdd import read_mdd, write_mdd
from ncs_jax.io.animation.obj_folder import read_obj_folder
from ncs_jax.io.animation.pc2 import read_pc2, write_pc2
from ncs_jax.io.mesh.obj import format_obj, obj_faces
from ncs_jax.io.mesh.objects import MovingObject, objects_of
from ncs_jax.io.mesh.usd import USD, check_installed, read_usd_animation, write_usd
from ncs_jax.io.records import AnimationRecord, BodyRecord, MotionRecord
from ncs_jax.io.tables.files import check_place, replacing, suffix_lacking
from ncs_jax.io.tables.hdf5 import read_hdf5, write_hdf5
from ncs_jax.io.tables.npz import read_npz, write_npz
from ncs_jax.io.tables.table import floats, indices

__all__ = ["animation_files", "animation_suffix", "read_animation", "write_animation"]

FIELDS = ("vertices", "faces", "fps")
READABLE = (".npz", ".h5", ".hdf5", ".pc2", ".mdd", *USD)
FORMATS = (*READABLE, ".glb")
ONE_OBJECT = (".pc2", ".mdd")


def write_animation(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    fps: float | int,
    *,
    rest: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    worn_by: tuple[BodyRecord, MotionRecord] | AnimationRecord | None = None,
    names: Sequence[str] = ("garment", "body"),
    layers: Sequence[int] = (),
) -> tuple[Path, ...]:
    """Write a moving mesh in the format of the suffix, and return the files; each file or folder appears whole or not at all.

    .npz and .h5 hold `vertices` (T, V, 3) float32, `faces` (F, 3) int32 and `fps`. .pc2 and .mdd hold the vertices only, in the
    given order, which is the garment file's: they can be put onto the mesh of that file. .glb plays in viewers, see
    `write_glb`. .usd, .usdc, .usda and .usdz hold the rest shape too, see `write_usd`. A path without a suffix, or one that
    ends in a slash, becomes a folder of frame_0000.obj and so on; it replaces only a folder of such files.

    Garments that are worn together are objects with names of their own in .glb, USD and .obj; a .pc2 or .mdd holds one object,
    so that NAME.pc2 becomes NAME_shirt.pc2 and NAME_coat.pc2; .npz and .h5 hold `layers` too.

    Args:
        path: the file to write; missing parent folders are made. vertices: (T, V, 3) m. faces: (F, 3). fps: frames per second.
        rest: (V, 3) m, the shape at rest, for USD; None: that of the first frame. uv: (F, 3, 2) texture coordinates of the
            triangles' corners, which .glb, USD and .obj hold and the other formats leave out. worn_by: the body and its motion
            of T frames, or a body that is a moving mesh, to be written into a .glb too. names: of the mesh, or of each
            garment, and of the body. layers: the first vertex of each garment but the first, as in a garment's record.

    Raises:
        InputError: the suffix is unknown or its format holds no body, the arrays do not fit together or are not finite, or the
            file cannot be written.
    """
    file, suffix = Path(path), animation_suffix(path, with_body=worn_by is not None)
    x = floats(file, "vertices", np.asarray(vertices), ("T", "V", 3), ("frame", "vertex")).astype(np.float32, copy=False)
    triangles = indices(file, "faces", np.asarray(faces), ("F", 3), x.shape[1], "vertices")
    if 0 in x.shape:
        raise InputError("at least one frame and one vertex expected", file=file, field="vertices", value=x.shape)
    if not 0 < float(fps) < np.inf:
        raise InputError("a number above 0 expected", file=file, field="fps", value=fps)
    if len(names) != len(layers) + 2:
        raise InputError(f"names of {len(layers) + 1} garments and the body expected", file=file, field="names", value=names)
    maps = None if uv is None else floats(file, "uv", np.asarray(uv), (len(triangles), 3, 2), ("face", "corner"))
    at_rest = x[0] if rest is None else floats(file, "rest", np.asarray(rest), (x.shape[1], 3), ("vertex",))
    objects = objects_of(names[:-1], layers, x, at_rest, triangles, maps)
    if suffix in (".npz", ".h5", ".hdf5"):
        more = {"layers": np.asarray(layers, np.int32)} if len(layers) else {}
        (write_npz if suffix == ".npz" else write_hdf5)(file, vertices=x, faces=triangles, fps=np.array(float(fps)), **more)
    elif suffix in ONE_OBJECT:
        files = animation_files(file, names[:-1])
        for own, each in zip(files, objects, strict=True):
            write_pc2(own, each.vertices) if suffix == ".pc2" else write_mdd(own, each.vertices, float(fps))
        return files
    elif suffix == ".glb":
        write_glb(file, objects, float(fps), worn_by=worn_by, body=names[-1])
    elif suffix in USD:
        write_usd(file, objects, float(fps))
    else:
        _write_folder(file, x, _obj_lines(objects, triangles, maps), float(fps))
    return (file,)


def animation_files(path: str | Path, garments: Sequence[str]) -> tuple[Path, ...]:
    """Return the files that an animation of garments becomes: one, but one each where the format holds a single object."""
    file = Path(path)
    if len(garments) == 1 or file.suffix.lower() not in ONE_OBJECT:
        return (file,)
    return tuple(file.with_name(f"{file.stem}_{name.replace(' ', '_')}{file.suffix}") for name in garments)


def _obj_lines(objects: Sequence[MovingObject], faces: np.ndarray, uv: np.ndarray | None) -> str:
    """Return the text of `obj_faces`; where there are several objects, the triangles of each after its name."""
    lines = obj_faces(faces, uv).splitlines(keepends=True)
    if len(objects) == 1:
        return "".join(lines)
    place = len(lines) - len(faces)  # after texture coordinates
    for each in objects:
        lines.insert(place, f"o {each.name}\n")
        place += 1 + len(each.faces)
    return "".join(lines)


def animation_suffix(path: str | Path, *, with_body: bool = False, also: tuple[str, ...] = ()) -> str:
    """Return the suffix of a file that an animation, perhaps with a body, can be written to, or nothing for a folder.

    `also` are suffixes that the caller writes by other means, for the error.

    Raises:
        InputError: no such format is written or it holds no body, a package for it is not there, a folder stands where the
            file shall be, something else is in the folder, or the place cannot be written to.
    """
    file = Path(path)
    suffix = "" if str(path).endswith(("/", "\\")) else file.suffix.lower()
    if suffix and suffix not in FORMATS:
        known = ", ".join((*FORMATS, *also))
        raise InputError(f"one of {known}, or a folder, expected", file=file, value=suffix, mend="end the name so")
    if suffix and file.expanduser().is_dir():
        raise InputError("a file expected", file=file, value="a folder", mend="give another name")
    if with_body and suffix != ".glb":
        mend = "end the name in .glb, or leave the body out"
        raise InputError(
            ".glb expected, as no other format here holds a body", file=file, value=suffix or "a folder", mend=mend
        )
    if suffix in USD:
        check_installed(file)
    there = check_place(file)
    if not suffix:
        _check_folder(file, there)
    return suffix


def _check_folder(path: Path, folder: Path) -> None:
    """Raise an InputError where a folder for frames is a file, or holds something else."""
    if folder.exists() and not folder.is_dir():
        raise InputError("a folder expected", file=path, value="a file", mend="give another name, or a suffix")
    names = (p.name for p in folder.iterdir()) if folder.exists() else ()
    other = next((name for name in names if not re.fullmatch(r"frame_\d+\.obj", name)), None)
    if other is not None:
        raise InputError("an empty or new folder expected", file=path, value=other, mend="give another name, or a suffix")


def _write_folder(path: Path, vertices: np.ndarray, faces: str, fps: float) -> None:
    """Write a file a frame; `faces` is text of `obj_faces`."""
    folder = path.expanduser()
    with replacing(folder) as part:
        _check_folder(path, folder)
        part.mkdir()
        for t, x in enumerate(vertices):
            (part / f"frame_{t:04}.obj").write_text(
                f"# frame {t} of {len(vertices)} at {fps:g} per second\n{format_obj(x, faces)}"
            )


def read_animation(path: str | Path, *, faces: ArrayLike | None = None, fps: float | int | None = None) -> AnimationRecord:
    """Read a moving mesh from .npz, .h5, .pc2, .mdd, USD or a folder of .obj, see `read_obj_folder`.

    Args:
        path: the file or folder. faces, fps: for a .pc2, which holds neither, and faces for an .mdd; without them there are no
            faces, and fps is NaN. A folder holds no fps, and with fps an .npz or .h5 needs none.

    Raises:
        InputError: the file cannot be read, its arrays do not fit together, or a number is not finite.
    """
    suffix = Path(path).suffix.lower()
    triangles = np.zeros((0, 3), np.int32) if faces is None else np.asarray(faces)
    rate = np.nan if fps is None else float(fps)
    if suffix not in FORMATS and Path(path).expanduser().is_dir():
        file, x, triangles = read_obj_folder(path)
    elif suffix == ".pc2":
        file, x = read_pc2(path)
    elif suffix == ".mdd":
        file, x, rate = read_mdd(path)
    elif suffix in USD:
        file, x, triangles, rate = read_usd_animation(path)
    elif suffix in READABLE:
        table = (read_npz if suffix == ".npz" else read_hdf5)(path, FIELDS.__contains__)
        file, x, triangles = table.file, table.array("vertices"), table.array("faces")
        rate = table.number("fps") if fps is None or "fps" in table else rate
    else:
        mend = "write it as one of these too" if suffix in FORMATS else "convert it"
        raise InputError(f"one of {', '.join(READABLE)} expected", file=path, value=suffix or suffix_lacking(path), mend=mend)
    x = floats(file, "vertices", x, ("T", "V", 3), ("frame", "vertex")).astype(np.float32, copy=False)
    if 0 in x.shape:
        raise InputError("at least one frame and one vertex expected", file=file, field="vertices", value=x.shape)
    return AnimationRecord(x, indices(file, "faces", triangles, ("F", 3), x.shape[1], "vertices"), rate)

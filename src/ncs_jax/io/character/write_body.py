"""Bodies at rest as .glb and .obj, to model clothes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.animation.glb import write_glb_body
from ncs_jax.io.mesh.obj import format_obj
from ncs_jax.io.records import BodyRecord
from ncs_jax.io.tables.files import replacing

__all__ = ["write_body"]


def write_body(path: str | Path, body: BodyRecord) -> None:
    """Write a body at rest, in metres and Y up; the file appears whole or not at all.

    A .glb holds its skin and joints, each joint with the world's axes, and is skinned linearly: pose correctives are not
    written. An .obj holds its mesh alone, vertices in the body's order.

    Raises:
        InputError: the file's name ends in something else, or it cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".glb":
        write_glb_body(path, body)
    elif suffix == ".obj":
        faces = "".join("f {} {} {}\n".format(*corners) for corners in (np.asarray(body.faces) + 1).tolist())
        with replacing(path) as part:
            part.write_text(format_obj(body.vertices, faces), encoding="utf-8")
    else:
        raise InputError(
            "a file name that ends in .glb or .obj expected", file=path, value=suffix or "no suffix", mend="name it so"
        )

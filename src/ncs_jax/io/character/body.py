"""Skinned bodies from .npz (this package's, the published cloth simulation's, or a SMPL family model), glTF and FBX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.fbx_character import fbx_body
from ncs_jax.io.character.gltf_character import gltf_body
from ncs_jax.io.character.smpl_model import pickle_refused, smpl_directions, smpl_fields, smpl_table
from ncs_jax.io.packaged import resolved
from ncs_jax.io.records import BodyRecord
from ncs_jax.io.tables.files import LARGEST, suffix_lacking
from ncs_jax.io.tables.npz import read_npz
from ncs_jax.io.tables.table import Table, checked_parents, indices, normalised_weights

__all__ = ["read_body"]

FIELDS = (
    "vertices", "faces", "joints", "parents", "blend_weights", "weight_joints", "weights", "joint_names", "rest_rotations",
    "rest_pose",
)  # fmt: skip
CHARACTERS = {".glb": gltf_body, ".vrm": gltf_body, ".gltf": gltf_body, ".fbx": fbx_body}
FORMATS = (".npz", *CHARACTERS)
MESHES = (".obj", ".ply", ".stl", ".usd", ".usda", ".usdc", ".usdz", ".abc", ".off", ".3mf")


def read_body(
    path: str | Path,
    *,
    betas: Sequence[float] = (),
    shapes: Mapping[str, float] | None = None,
    part: Sequence[str] = (),
    correctives: bool = True,
) -> BodyRecord:
    """Read a character in its rest pose, from .npz, .glb, .vrm, .gltf or .fbx.

    For glTF and .fbx, see `gltf_body` and `fbx_body`. An .npz holds `vertices` (V, 3) and `joints` (J, 3) in m, `faces`
    (F, 3), `parents` (J,), and skinning weights, either dense, `blend_weights` (V, J), or sparse, `weight_joints` (V, K) with
    `weights` (V, K). It may hold `joint_names` (J,), `rest_rotations` (J, 3, 3) and `posedirs`. The root's parent is -1; SMPL
    files write 0 or 4294967295. Rows of weights must sum to 1 within 1e-3, and are divided by their sum.

    A model file of SMPL, SMPL-H or SMPL-X is read as it is distributed, see `smpl_table`. A .pkl may run any code, so it is
    refused; the message has a command that makes an .npz.

    Args:
        path: the file, or ncs:NAME. betas: shape of an SMPL model, as many numbers as wanted; none: the mean shape.
        shapes: weights of blend shapes by name, for glTF and FBX; others keep the file's weights. part: names of the objects,
            meshes or materials that are the body, for glTF and FBX; none: all skinned meshes. correctives: whether to read an
            SMPL model's pose correctives.

    Raises:
        InputError: the file cannot be read; or shapes disagree, a number is not finite or names nothing, the joints are not one
            tree with parents before children, weights are negative or do not sum to 1, or what is asked for is not there.
    """
    path, suffix = resolved(path), Path(resolved(path)).suffix.lower()
    part = (part,) if isinstance(part, str) else tuple(part)
    if suffix in CHARACTERS:
        if len(betas):
            raise _not_there(path, "body.betas", list(betas)[:4], "an SMPL model as .npz", "use body.shapes")
        return CHARACTERS[suffix](path, part, shapes)
    for field, value, mend in (("body.part", part, "leave it out"), ("body.shapes", shapes, "use body.betas")):
        if value:
            raise _not_there(path, field, next(iter(value)), "a .glb, .vrm, .gltf or .fbx", mend)
    if suffix in (".pkl", ".pickle"):
        raise pickle_refused(path)
    if suffix != ".npz":
        mend = "convert it, as in Blender or Mixamo, and export .glb or .fbx"
        if suffix in MESHES:
            mend = "a mesh alone has none (a folder of one for each frame moves by itself). If these are clothes, they are the "
            mend += "garment, and the body is ncs:body or a character; else rig it, as in Mixamo, and export .glb or .fbx"
        raise InputError(
            f"a character with skeleton and skinning weights expected, {', '.join(FORMATS)}", file=path, field="body.file",
            value=suffix or suffix_lacking(path), mend=mend,
        )  # fmt: skip
    table = read_npz(path, {*FIELDS, *smpl_fields(len(betas) > 0, correctives)}.__contains__)
    if "v_template" in table:
        table = smpl_table(table, betas)
    elif len(betas):
        raise _not_there(path, "body.betas", list(betas)[:4], "an SMPL model with shapedirs", "leave it out")
    return _body_of(table)


def _not_there(path: str | Path, field: str, value: object, expected: str, mend: str) -> InputError:
    """Return the error of a field that a body of this format does not have."""
    return InputError(f"{expected} expected for this field", file=path, field=field, value=value, mend=mend)


def _body_of(table: Table) -> BodyRecord:
    """Return the body that arrays of this package's layout hold."""
    vertices = table.floats("vertices", ("V", 3), ("vertex",))
    joints = table.floats("joints", ("J", 3), ("joint",))
    faces = table.indices("faces", ("F", 3), len(vertices), "vertices")
    for name, array in (("vertices", vertices), ("joints", joints), ("faces", faces)):
        if len(array) == 0:
            raise InputError(
                "at least one row expected", file=table.file, field=name, value=array.shape, mend="write the body again"
            )
    names = table.joint_names(len(joints))
    if "rest_pose" in table and np.abs(table.floats("rest_pose", (len(joints), 3), ("joint",))).max() > 1e-6:
        raise InputError(
            "a rest pose of zeros expected", file=table.file, field="rest_pose", value="rotations that are not zero",
            mend="write vertices and joints unposed, and rest_pose as zeros",
        )  # fmt: skip
    return BodyRecord(
        vertices, faces, joints, checked_parents(table.file, "parents", table.array("parents"), len(joints), names),
        _weights(table, len(vertices), len(joints)), names, _rest_rotations(table, len(joints)),
        smpl_directions(table, "posedirs", len(vertices), 9 * (len(joints) - 1)) if "posedirs" in table else None,
    )  # fmt: skip


def _weights(table: Table, vertices: int, joints: int) -> np.ndarray:
    """Return skinning weights (vertices, joints) from the dense or the sparse arrays."""
    field = "blend_weights" if "blend_weights" in table or "weight_joints" not in table else "weights"
    if field == "blend_weights":
        table.first("blend_weights", "weight_joints and weights")
        weights = table.floats(field, (vertices, joints), ("vertex", "joint"))
    else:
        sparse = table.floats(field, (vertices, "K"), ("vertex",))
        owner = indices(table.file, "weight_joints", table.array("weight_joints"), sparse.shape, joints, "joints")
        if vertices * joints * sparse.itemsize > LARGEST:
            raise InputError(
                "a smaller body expected", file=table.file, field=field, value=f"{vertices} vertices, {joints} joints"
            )
        weights = np.zeros((vertices, joints), sparse.dtype)
        np.add.at(weights, (np.arange(vertices)[:, None], owner), sparse)
    return normalised_weights(table.file, field, weights)


def _rest_rotations(table: Table, joints: int) -> np.ndarray | None:
    """Return the joints' rotations in the rest pose (joints, 3, 3), None where the file has none."""
    if "rest_rotations" not in table:
        return None
    turns = table.floats("rest_rotations", (joints, 3, 3), ("joint",))
    wide = turns.astype(np.float64)
    with np.errstate(all="ignore"):
        error = np.abs(wide @ wide.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        bad = ~((error < 1e-3) & (np.linalg.det(wide) > 0))
    if bad.any():
        j = int(bad.argmax())
        raise InputError(
            "rotation matrices expected", file=table.file, field=f"rest_rotations, joint {j}", value=turns[j].tolist(),
            mend="remove scale and mirroring",
        )  # fmt: skip
    return turns

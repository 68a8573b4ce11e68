"""Skinned bodies from .npz, in this package's layout or that of SMPL and the published neural cloth simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.files import LARGEST
from ncs_jax.io.npz import read_npz
from ncs_jax.io.records import BodyRecord
from ncs_jax.io.table import Table, indices

__all__ = ["read_body"]

FIELDS = (
    "vertices", "faces", "joints", "parents", "blend_weights", "weight_joints", "weights", "joint_names", "rest_rotations",
    "rest_pose",
)  # fmt: skip


def read_body(path: str | Path) -> BodyRecord:
    """A character in its rest pose, from .npz.

    `vertices` (V, 3) and `joints` (J, 3) in m, `faces` (F, 3), `parents` (J,), and skinning weights either dense,
    `blend_weights` (V, J), or sparse, `weight_joints` (V, K) with `weights` (V, K). `joint_names` (J,) and `rest_rotations`
    (J, 3, 3) may be there. The root's parent is -1, or as SMPL files have it 0 or 4294967295. Rows of weights that sum to 1
    within 1e-3 are divided by their sum.

    Raises:
        InputError: the file cannot be read; or shapes disagree, a number is not finite or names nothing, the joints are not one
            tree with parents before children, or weights are negative or do not sum to 1.
    """
    table = read_npz(path, FIELDS.__contains__)
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
        vertices, faces, joints, _parents(table, len(joints), names), _weights(table, len(vertices), len(joints)), names,
        _rest_rotations(table, len(joints)),
    )  # fmt: skip


def _parents(table: Table, joints: int, names: tuple[str, ...]) -> np.ndarray:
    array = table.array("parents")
    if array.dtype.kind not in "iu" or array.shape != (joints,):
        raise InputError(
            f"whole numbers of shape ({joints},) expected, one for each of the joints", file=table.file, field="parents",
            value=f"{array.dtype} {array.shape}", mend="write the parent of each joint",
        )  # fmt: skip
    given = [int(p) for p in array]
    none = {-1, 2**32 - 1} | ({int(np.iinfo(array.dtype).max)} if array.dtype.kind == "u" else set())
    parents = [-1 if p in none or (j == 0 and p == 0) else p for j, p in enumerate(given)]
    for j, p in enumerate(parents):
        if (p == -1) != (j == 0) or p >= j:
            raise InputError(
                "one root, joint 0 with parent -1, and parents before their children expected", file=table.file,
                field=f"parents, joint {j}" + (f" {names[j]}" if names else ""), value=given[j],
                mend="sort the joints from the root outward",
            )  # fmt: skip
        if p < -1:
            raise InputError("a joint or -1 expected", file=table.file, field=f"parents, joint {j}", value=given[j])
    return np.array(parents, dtype=np.int32)


def _weights(table: Table, vertices: int, joints: int) -> np.ndarray:
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
    low, sums = weights.min(axis=1), weights.sum(axis=1, dtype=np.float64)
    for bad, text, value in (
        (low < -1e-6, "weights of 0 and above expected", low),
        (np.abs(sums - 1) > 1e-3, "weights that sum to 1 expected", sums),
    ):
        if bad.any():
            v = int(bad.argmax())
            raise InputError(
                text,
                file=table.file,
                field=f"{field}, vertex {v}",
                value=float(value[v]),
                mend="normalise the skinning weights",
            )
    weights = np.maximum(weights, 0)
    return weights / weights.sum(axis=1, keepdims=True)


def _rest_rotations(table: Table, joints: int) -> np.ndarray | None:
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

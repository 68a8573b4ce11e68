"""Skinned bodies from .npz (this package's, the published cloth simulation's, or a SMPL family model), .glb and .fbx."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.fbx_character import fbx_body
from ncs_jax.io.character.gltf_character import gltf_body
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.records import BodyRecord
from ncs_jax.io.tables.files import LARGEST
from ncs_jax.io.tables.npz import read_npz
from ncs_jax.io.tables.table import Table, checked_parents, indices, normalised_weights

__all__ = ["read_body"]

FIELDS = (
    "vertices", "faces", "joints", "parents", "blend_weights", "weight_joints", "weights", "joint_names", "rest_rotations",
    "rest_pose",
)  # fmt: skip
MODEL = ("v_template", "f", "weights", "kintree_table", "J_regressor")
SPARSE = ("J_regressor_data", "J_regressor_indices", "J_regressor_indptr")  # of a scipy.sparse matrix
CONVERT = """\
python -c "import pickle, numpy as np; m = pickle.load(open({old!r}, 'rb'), encoding='latin1'); \
np.savez({new!r}, **{{k: np.array(m[k].toarray() if hasattr(m[k], 'toarray') else m[k]) for k in {fields!r}}})\
\""""


def read_body(path: str | Path) -> BodyRecord:
    """Read a character in its rest pose, from .npz, .glb, .gltf or .fbx.

    For .glb, .gltf and .fbx, see `gltf_body` and `fbx_body`. An .npz holds `vertices` (V, 3) and `joints` (J, 3) in m, `faces`
    (F, 3), `parents` (J,), and skinning weights, either dense, `blend_weights` (V, J), or sparse, `weight_joints` (V, K) with
    `weights` (V, K). It may hold `joint_names` (J,) and `rest_rotations` (J, 3, 3). The root's parent is -1; SMPL files write 0
    or 4294967295. Rows of weights must sum to 1 within 1e-3, and are divided by their sum.

    A model file of SMPL, SMPL-H or SMPL-X is read as it is distributed: `v_template` (V, 3), `f` (F, 3), `weights` (V, J),
    `kintree_table` (2, J) and `J_regressor` (J, V), or instead of the last the three arrays of a sparse matrix, with `_data`,
    `_indices` and `_indptr` after its name. The body has the mean shape, and its joints are J_regressor v_template. Shape and
    pose correctives are not applied. A .pkl may run any code, so it is refused; the message has a command that makes an .npz.

    Raises:
        InputError: the file cannot be read; or shapes disagree, a number is not finite or names nothing, the joints are not one
            tree with parents before children, or weights are negative or do not sum to 1.
    """
    suffix = Path(path).suffix.lower()
    if suffix in (".glb", ".gltf", ".fbx"):
        return fbx_body(path) if suffix == ".fbx" else gltf_body(path)
    if suffix in (".pkl", ".pickle"):
        convert = CONVERT.format(old=str(path), new=str(Path(path).with_suffix(".npz")), fields=MODEL)
        raise InputError(
            "an .npz expected: a pickle may run any code, so none is ever loaded", file=path, value=suffix,
            mend=f"if you trust the file, make one (some of these files need `pip install chumpy`): {convert}",
        )  # fmt: skip
    table = read_npz(path, {*FIELDS, *MODEL, *SPARSE}.__contains__)
    if "v_template" in table:
        table = _model(table)
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
    )  # fmt: skip


def _model(table: Table) -> Table:
    """Return a model file of the SMPL family in this package's layout."""
    vertices = table.floats("v_template", ("V", 3), ("vertex",))
    kintree = table.array("kintree_table")
    if kintree.ndim != 2 or len(kintree) != 2:
        raise InputError("shape (2, J) expected", file=table.file, field="kintree_table", value=kintree.shape)
    parents = checked_parents(table.file, "kintree_table", kintree[0], kintree.shape[1])
    count = len(parents)
    if "J_regressor" in table:
        joints = table.floats("J_regressor", (count, len(vertices)), ("joint",)) @ vertices
    else:
        table.first("J_regressor", *SPARSE[:1])
        joints = _sparse_rows(table, count, len(vertices)) @ vertices
    names = smpl_names(count) if np.array_equal(parents, smpl_parents(count)) else ()
    arrays = {
        "vertices": vertices, "faces": table.array("f"), "joints": joints, "parents": parents,
        "blend_weights": table.floats("weights", (len(vertices), count), ("vertex", "joint")),
    }  # fmt: skip
    return Table(table.file, arrays | ({"joint_names": np.array(names)} if names else {}), table.names)


def _sparse_rows(table: Table, joints: int, vertices: int) -> np.ndarray:
    """Return the regressor (joints, vertices) from its parts, compressed by joint (CSR) or vertex (CSC): their lengths tell."""
    data = table.floats(SPARSE[0], ("N",))
    pointer = indices(table.file, SPARSE[2], table.array(SPARSE[2]), ("P",), len(data) + 1, "entries")
    by_joint = len(pointer) == joints + 1
    if not by_joint and len(pointer) != vertices + 1:
        raise InputError(
            f"{joints + 1} or {vertices + 1} numbers expected, one more than joints or vertices", file=table.file,
            field=SPARSE[2], value=len(pointer), mend="write J_regressor dense",
        )  # fmt: skip
    if pointer[0] != 0 or pointer[-1] != len(data) or np.any(np.diff(pointer) < 0):
        raise InputError(f"numbers that rise from 0 to {len(data)} expected", file=table.file, field=SPARSE[2])
    other, what = (vertices, "vertices") if by_joint else (joints, "joints")
    inner = indices(table.file, SPARSE[1], table.array(SPARSE[1]), data.shape, other, what)
    outer = np.repeat(np.arange(len(pointer) - 1), np.diff(pointer))
    if joints * vertices * data.itemsize > LARGEST:
        raise InputError("a smaller body expected", file=table.file, field=SPARSE[0], value=f"{vertices} vertices")
    dense = np.zeros((joints, vertices), data.dtype)
    np.add.at(dense, (outer, inner) if by_joint else (inner, outer), data)
    return dense


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

"""Model files of SMPL, SMPL-H and SMPL-X: shape, joints and pose correctives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.smpl import smpl_names, smpl_parents
from ncs_jax.io.tables.files import LARGEST
from ncs_jax.io.tables.hdf5 import read_hdf5
from ncs_jax.io.tables.npz import read_npz
from ncs_jax.io.tables.table import Table, checked_parents, indices

__all__ = ["pickle_refused", "read_betas", "smpl_directions", "smpl_fields", "smpl_table"]

MODEL = ("v_template", "f", "weights", "kintree_table", "J_regressor")
SPARSE = ("J_regressor_data", "J_regressor_indices", "J_regressor_indptr")  # of a scipy.sparse matrix
SMPLX = 55  # joints of the model whose last components are expressions: 100 of 400, else all but the first 10
CONVERT = """\
python -c "import pickle, numpy as np; m = pickle.load(open({old!r}, 'rb'), encoding='latin1'); \
np.savez({new!r}, **{{k: np.array(m[k].toarray() if hasattr(m[k], 'toarray') else m[k]) for k in {fields!r} if k in m}})\
\""""


def smpl_fields(shape: bool, correctives: bool) -> tuple[str, ...]:
    """Return the arrays to read of a model file: its largest, of shape and correctives, only where they are wanted."""
    return (*MODEL, *SPARSE, *(("shapedirs",) if shape else ()), *(("posedirs",) if correctives else ()))


def pickle_refused(path: str | Path) -> InputError:
    """Return the error of a .pkl, with the command that makes an .npz of it."""
    fields = (*MODEL, "shapedirs", "posedirs")
    convert = CONVERT.format(old=str(path), new=str(Path(path).with_suffix(".npz")), fields=fields)
    return InputError(
        "an .npz expected: a pickle may run any code, so none is ever loaded", file=path, value=Path(path).suffix.lower(),
        mend=f"if you trust the file, make one (some of these files need `pip install chumpy`): {convert}",
    )  # fmt: skip


def smpl_table(table: Table, betas: Sequence[float] = ()) -> Table:
    """Return a model file of the SMPL family in this package's layout, in the shape of some betas.

    The file holds `v_template` (V, 3), `f` (F, 3), `weights` (V, J), `kintree_table` (2, J) and `J_regressor` (J, V), or
    instead of the last the three arrays of a sparse matrix, with `_data`, `_indices` and `_indptr` after its name. It may hold
    `shapedirs` (V, 3, B) and `posedirs` (V, 3, 9 (J - 1)), both also flat: (B, 3 V) or (3 V, B). Then

        v(theta, beta) = W( v_template + shapedirs beta + posedirs vec(R_j - I), J_regressor (v_template + shapedirs beta) )

    with W linear blend skinning, and R_j the local rotation of every joint but the root (Loper et al. 2015, (6)-(10)). Of the
    components of SMPL-X the last are expressions (100 of 400, 10 of 20): betas do not reach them. Means and components of hand
    poses are not read: poses are whole rotations, and at zero a hand is flat.

    Raises:
        InputError: there are more betas than components, or arrays do not fit each other.
    """
    vertices = table.floats("v_template", ("V", 3), ("vertex",))
    kintree = table.array("kintree_table")
    if kintree.ndim != 2 or len(kintree) != 2:
        raise InputError("shape (2, J) expected", file=table.file, field="kintree_table", value=kintree.shape)
    parents = checked_parents(table.file, "kintree_table", kintree[0], kintree.shape[1])
    count = len(parents)
    if "J_regressor" in table:
        joints_of = table.floats("J_regressor", (count, len(vertices)), ("joint",))
    else:
        table.first("J_regressor", *SPARSE[:1])
        joints_of = _sparse_rows(table, count, len(vertices))
    shaped = _shaped(table, vertices, count, betas)
    names = smpl_names(count) if np.array_equal(parents, smpl_parents(count)) else ()
    arrays = {
        "vertices": shaped, "faces": table.array("f"), "joints": joints_of @ shaped, "parents": parents,
        "blend_weights": table.floats("weights", (len(vertices), count), ("vertex", "joint")),
    }  # fmt: skip
    if "posedirs" in table:
        arrays["posedirs"] = table.array("posedirs")
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


def _shaped(table: Table, vertices: np.ndarray, joints: int, betas: Sequence[float]) -> np.ndarray:
    """Return v_template + shapedirs beta (V, 3), m."""
    if not len(betas):
        return vertices
    if "shapedirs" not in table:
        raise InputError(
            "shapedirs expected in the file", file=table.file, field="body.betas", value=list(betas)[:4],
            mend="leave betas out, or convert the model again",
        )  # fmt: skip
    directions = smpl_directions(table, "shapedirs", len(vertices))
    count = directions.shape[2]
    if joints == SMPLX:
        count = 300 if count >= 400 else min(count, 10)
    if len(betas) > count:
        raise InputError(
            f"at most {count} numbers expected, as the model has", file=table.file, field="body.betas",
            value=f"{len(betas)} numbers", mend=f"write the first {count}, or take a model file with more components",
        )  # fmt: skip
    return vertices + directions[:, :, : len(betas)] @ np.asarray(betas, np.float64)


def read_betas(path: str | Path) -> np.ndarray:
    """Return the shape (B,) of the person in a motion of AMASS: `betas` (B,) of an .npz or .h5, or (T, B), all rows alike."""
    table = Table(Path(path), {}, ())
    if (suffix := Path(path).suffix.lower()) in (".npz", ".h5", ".hdf5"):
        table = (read_npz if suffix == ".npz" else read_hdf5)(path, ("betas",).__contains__)
    if "betas" not in table:
        raise InputError(
            "a motion with betas expected, as AMASS writes them", file=path, field="betas", value="none",
            mend="write the betas as numbers: body.betas = [0.5, -1.2]",
        )  # fmt: skip
    rows = np.atleast_2d(table.array("betas"))
    rows = Table(table.file, {"betas": rows}, table.names).floats("betas", ("T", "B"), ("frame",))
    if not len(rows) or np.abs(rows - rows[:1]).max(initial=0) > 1e-4:
        raise InputError(
            "one shape for the whole motion expected", file=path, field="betas", value=rows.shape,
            mend="write one row, or body.betas as numbers",
        )  # fmt: skip
    return rows[0].astype(np.float64)


def smpl_directions(table: Table, name: str, vertices: int, count: int | None = None) -> np.ndarray:
    """Return displacements (V, 3, B), m, of an array of that shape, or flat, (B, 3 V) or (3 V, B); count is B where known."""
    array = table.array(name)
    if array.ndim == 2 and array.shape[1] == 3 * vertices and count in (None, len(array)):
        array = array.T
    if array.ndim == 2 and len(array) == 3 * vertices:
        array = array.reshape(vertices, 3, -1)
    wanted = Table(table.file, {name: array}, table.names)
    return wanted.floats(name, (vertices, 3, "B" if count is None else count), ("vertex", "axis"))

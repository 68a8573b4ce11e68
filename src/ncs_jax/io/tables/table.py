"""Named arrays of one file; each is checked for type, shape and finite numbers when it is taken out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["Table", "checked_parents", "floats", "indices", "normalised_weights", "select"]

Shape = tuple[int | str, ...]


def _show(shape: tuple) -> str:
    return "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"


def _check_shape(file: Path, field: str, array: np.ndarray, shape: Shape) -> None:
    fits = array.ndim == len(shape) and all(isinstance(w, str) or w == n for w, n in zip(shape, array.shape, strict=True))
    if not fits:
        raise InputError(
            f"an array of shape {_show(shape)} expected", file=file, field=field, value=array.shape,
            mend="write it with that shape; a count that another array sets must agree",
        )  # fmt: skip


def floats(
    file: Path,
    field: str,
    array: np.ndarray,
    shape: Shape,
    axes: tuple[str, ...] = (),
    first: int = 0,
    labels: list[str] | None = None,
) -> np.ndarray:
    """Return a new float32 or float64 array, after a check that it has a shape (a letter is any size) and is finite.

    Args:
        file, field: what an error names. array: any numbers. axes: what the leading axes count, for the error ("frame",
            "joint"). first: number of the first entry along the first axis. labels: added to the numbers along the second.

    Raises:
        InputError: the array has another type or shape, or a number is not finite.
    """
    if array.dtype.kind not in "fiu":
        raise InputError("an array of numbers expected", file=file, field=field, value=str(array.dtype), mend="write floats")
    _check_shape(file, field, array, shape)
    single = array.dtype.kind == "f" and array.dtype.itemsize == 4
    with np.errstate(all="ignore"):
        values = np.array(array, dtype=np.float32 if single else np.float64, order="C")
        bad = ~(np.abs(values) < 1e30)  # also what single precision would turn into infinity
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        number = float(values[tuple(where)])
        names = [f"{a} {i}" for a, i in zip(axes, [where[0] + first, *where[1:]], strict=False)] if where else []
        if labels:
            names[1] += labels[where[1]]
        raise InputError(
            "finite numbers expected", file=file, field=", ".join([field, *names]), value=number,
            mend="mend it where the file was made, or " + ("choose other frames" if "frame" in axes else "leave it out"),
        )  # fmt: skip
    return values


def indices(file: Path, field: str, array: np.ndarray, shape: Shape, count: int, what: str) -> np.ndarray:
    """Return an int32 array, after a check that it has a shape and holds numbers from 0 to count - 1."""
    if array.dtype.kind not in "iu":
        raise InputError("whole numbers expected", file=file, field=field, value=str(array.dtype), mend="write int32")
    _check_shape(file, field, array, shape)
    bad = (array < 0) | (array >= count)
    if bad.any():
        where = [int(i) for i in np.argwhere(bad)[0]]
        raise InputError(
            f"numbers from 0 to {count - 1} expected, of the {count} {what}", file=file, field=f"{field}, entry {where}",
            value=int(array[tuple(where)]), mend="counting starts at 0; write only those that exist",
        )  # fmt: skip
    return array.astype(np.int32)


def normalised_weights(file: Path, field: str, weights: np.ndarray) -> np.ndarray:
    """Return skinning weights (V, J) divided by their sums, after a check: sums are 1 within 1e-3, no weight is negative."""
    low, sums = weights.min(axis=1, initial=0), weights.sum(axis=1, dtype=np.float64)
    for bad, text, value in (
        (low < -1e-6, "weights of 0 and above expected", low),
        (np.abs(sums - 1) > 1e-3, "weights that sum to 1 expected", sums),
    ):
        if bad.any():
            v = int(bad.argmax())
            raise InputError(
                text, file=file, field=f"{field}, vertex {v}", value=float(value[v]), mend="normalise the skinning weights"
            )
    weights = np.maximum(weights, 0)
    return weights / weights.sum(axis=1, keepdims=True)


def checked_parents(file: Path, field: str, array: np.ndarray, joints: int, names: tuple[str, ...] = ()) -> np.ndarray:
    """Return the parent of each joint (joints,) int32, after a check: one root, joint 0 with -1, parents before children."""
    if array.dtype.kind not in "iu" or array.shape != (joints,):
        raise InputError(
            f"whole numbers of shape ({joints},) expected, one for each of the joints", file=file, field=field,
            value=f"{array.dtype} {array.shape}", mend="write the parent of each joint",
        )  # fmt: skip
    given = [int(p) for p in array]
    none = {-1, 2**32 - 1} | ({int(np.iinfo(array.dtype).max)} if array.dtype.kind == "u" else set())
    parents = [-1 if p in none or (j == 0 and p == 0) else p for j, p in enumerate(given)]
    for j, p in enumerate(parents):
        if (p == -1) != (j == 0) or p >= j:
            raise InputError(
                "one root, joint 0 with parent -1, and parents before their children expected", file=file,
                field=f"{field}, joint {j}" + (f" {names[j]}" if names else ""), value=given[j],
                mend="sort the joints from the root outward",
            )  # fmt: skip
        if p < -1:
            raise InputError("a joint or -1 expected", file=file, field=f"{field}, joint {j}", value=given[j])
    return np.array(parents, dtype=np.int32)


def select(file: Path, frames: int, frame_range: tuple[int, int | None] | None) -> slice:
    """Return the slice of frames start to stop - 1, after a check that the file has them.

    A stop of None is the end, and a number below 0 counts from the end.
    """
    if frame_range is None:
        return slice(0, frames)
    start, stop = (frames if n is None else n + frames if n < 0 else n for n in frame_range)
    if not 0 <= start < stop <= frames:
        raise InputError(
            f"0 <= start < stop <= {frames} expected, the number of frames", file=file, field="frames",
            value=frame_range, mend="choose frames that are in the file",
        )  # fmt: skip
    return slice(start, stop)


@dataclass(frozen=True, eq=False)
class Table:
    """Arrays by name. `names` lists all that the file holds, also what was not read."""

    file: Path
    arrays: dict[str, np.ndarray]
    names: tuple[str, ...]

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def first(self, *aliases: str) -> str:
        """Return the first of some names for one thing that is in the file. Raise an InputError where none is."""
        for name in aliases:
            if name in self.arrays:
                return name
        held = ", ".join(self.names[:12]) or "nothing"
        others = f" (or {', '.join(aliases[1:])})" if len(aliases) > 1 else ""
        raise InputError(f"missing{others}", file=self.file, field=aliases[0], mend=f"add it; the file holds {held}")

    def array(self, name: str) -> np.ndarray:
        """Return an array as it was read."""
        return self.arrays[self.first(name)]

    def floats(self, name: str, shape: Shape, axes: tuple[str, ...] = ()) -> np.ndarray:
        """Return an array of finite numbers, see the function `floats`."""
        return floats(self.file, name, self.array(name), shape, axes)

    def indices(self, name: str, shape: Shape, count: int, what: str) -> np.ndarray:
        """Return an array of numbers from 0 to count - 1, see the function `indices`."""
        return indices(self.file, name, self.array(name), shape, count, what)

    def number(self, *aliases: str) -> float:
        """Return one positive number, which is written as a scalar or as an array of one."""
        name = self.first(*aliases)
        array = self.arrays[name]
        if array.dtype.kind not in "fiu" or array.size != 1 or not 0 < float(array.reshape(())) < np.inf:
            value = (
                array.reshape(-1)[0].item() if array.size == 1 and array.dtype.kind in "fiu" else f"{array.dtype} {array.shape}"
            )
            raise InputError("one number above 0 expected", file=self.file, field=name, value=value, mend="write a scalar")
        return float(array.reshape(()))

    def joint_names(self, joints: int) -> tuple[str, ...]:
        """Return the names of the joints, as many as there are and all different; none where the file has no names."""
        if "joint_names" not in self:
            return ()
        array = self.arrays["joint_names"]
        if array.dtype.kind not in "US":
            raise InputError("text expected", file=self.file, field="joint_names", value=str(array.dtype), mend="write names")
        _check_shape(self.file, "joint_names", array, (joints,))
        try:
            names = tuple(n.decode() if isinstance(n, bytes) else n for n in array.tolist())
        except ValueError as error:  # also UnicodeDecodeError
            raise InputError(f"text expected: {error}", file=self.file, field="joint_names", mend="write UTF-8") from None
        twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if twice is not None:
            raise InputError(
                "a different name for each joint expected", file=self.file, field="joint_names", value=twice, mend="rename one"
            )
        return names

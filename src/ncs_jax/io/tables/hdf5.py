"""HDF5 (.h5): the same named arrays as .npz, as datasets at the top of the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import readable, reading, replacing, unpackable
from ncs_jax.io.tables.table import Table

__all__ = ["read_hdf5", "write_hdf5"]


def read_hdf5(path: str | Path, wanted: Callable[[str], bool]) -> Table:
    """Read the datasets whose names are wanted; the others stay unread."""
    import h5py

    file = readable(path)
    with reading(file, "HDF5"), h5py.File(file, "r") as archive:
        names = tuple(n for n in archive if isinstance(n, str))  # h5py gives names that are not UTF-8 as bytes
        return Table(file, {n: _array(file, n, archive) for n in names if wanted(n)}, names)


def _array(file: Path, name: str, archive) -> np.ndarray:
    import h5py

    data = archive[name]
    if not isinstance(data, h5py.Dataset) or data.shape is None:
        raise InputError("a dataset expected", file=file, field=name, value=type(data).__name__, mend="write an array")
    unpackable(file, name, data.nbytes)
    if h5py.check_string_dtype(data.dtype):
        return np.array(data.asstr()[...], dtype=np.str_)
    if data.dtype.kind not in "biuf":
        raise InputError("plain numbers or text expected", file=file, field=name, value=f"dtype {data.dtype}")
    return data[...] if data.shape else np.asarray(data[()])


def write_hdf5(path: str | Path, **arrays: np.ndarray) -> None:
    """Write arrays under their names; the file appears whole or not at all."""
    import h5py

    with replacing(path) as part, h5py.File(part, "x") as archive:
        for name, array in arrays.items():
            archive[name] = array

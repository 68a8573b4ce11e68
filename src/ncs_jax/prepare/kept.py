"""Arrays that took long to find, kept beside JAX's compiled programs for the next process that asks for the same."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.npz import read_npz, write_npz

__all__ = ["kept"]

SOURCE = Path(__file__).parents[1]


def kept(names: tuple[str, ...], make: Callable[[], dict[str, np.ndarray] | None], *given) -> dict[str, np.ndarray] | None:
    """Return the arrays of these names that `make` finds, or those that it found before from the same things `given`.

    They lie in the folder where JAX keeps compiled programs; where it keeps none, neither does this. Their file is named after
    all that they depend on: what is given, array by array, the package's own source, the versions of what computes, the device.

    Args:
        make: returns the arrays, or None where there are none, which is not kept. given: pytrees, such as a model.
    """
    folder = jax.config.values["jax_compilation_cache_dir"]
    if not folder or "://" in folder:
        return make()
    file = Path(folder) / f"prepared-{_key(given)}.npz"
    with contextlib.suppress(InputError, OSError):
        if file.exists():
            table = read_npz(file, names.__contains__)
            return {name: table.array(name) for name in names}
    found = make()
    if found is not None:
        with contextlib.suppress(InputError, OSError):  # a folder that cannot be written to
            file.parent.mkdir(parents=True, exist_ok=True)
            write_npz(file, **found)
    return found


def _key(given) -> str:
    """Return a name for what arrays depend on."""
    leaves, structure = jax.tree.flatten(given)
    digest = hashlib.sha256(f"{structure} {jax.default_backend()} {[version(n) for n in ('jax', 'numpy', 'scipy')]}".encode())
    for path in sorted(SOURCE.rglob("*.py")):
        digest.update(path.read_bytes())
    for leaf in map(np.asarray, leaves):
        digest.update(f"{leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).data)
    return digest.hexdigest()

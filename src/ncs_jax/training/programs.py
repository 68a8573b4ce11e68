"""Programs that are compiled on threads, beside what else is done before they are needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Compiled
from jax.tree_util import PyTreeDef

__all__ = ["Programs"]

THREADS = 2


class Programs:
    """Programs, each compiled once for every kind of arguments.

    A program is traced where it is asked for, with the settings of JAX that hold there; XLA compiles it on a thread. It takes
    its arguments as their leaves, and may write into the memory of the first one where that is `reused`.
    """

    def __init__(self):
        self._threads = ThreadPoolExecutor(THREADS, "compile")
        self._begun: dict[tuple, Future[Compiled]] = {}

    def ready(self, name: str, program: Callable, *arguments, reused: bool = False) -> Compiled:
        """Return a program for arguments, compiled; it is begun now unless it was for others of their shapes and types."""
        return self.begin(name, program, *jax.tree.flatten(arguments), reused=reused).result()

    def begin(
        self, name: str, program: Callable, leaves: Sequence, structure: PyTreeDef, *, reused: bool = False
    ) -> Future[Compiled]:
        """Begin to compile a program, known by a name, for arguments whose leaves are given, or no more than their shapes."""
        kind = name, structure, *((np.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
        if kind not in self._begun:
            first = range(structure.children()[0].num_leaves) if reused else ()
            flat = jax.jit(lambda *leaves: program(*structure.unflatten(leaves)), donate_argnums=first)
            self._begun[kind] = self._threads.submit(flat.lower(*leaves).compile)
        return self._begun[kind]

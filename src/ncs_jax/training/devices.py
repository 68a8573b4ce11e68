"""Place training on devices: the batch divided among the devices of all hosts, everything else copied to each.

Where there is one device the mesh is None, and what is handed over comes back as it was.
"""

from __future__ import annotations

import contextlib
import ctypes
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jax.stages import Compiled

from ncs_jax.errors import InputError

__all__ = ["batch_mesh", "check_fits", "free_memory", "local", "replicate", "shard_batch", "trim_memory"]


def batch_mesh(batch: int) -> Mesh | None:
    """Return the most devices that divide the batch, as many on every host, along one axis "batch"; None for a single one.

    Raises:
        InputError: the hosts themselves do not divide it.
    """
    hosts = [[d for d in jax.devices() if d.process_index == p] for p in range(jax.process_count())]
    fit = [n for n in range(1, min(map(len, hosts)) + 1) if batch % (n * len(hosts)) == 0]
    if not fit:
        expected = f"a multiple of the number of hosts, {len(hosts)}, expected"
        raise InputError(expected, field="training.batch", value=batch, mend="change it, or use fewer hosts")
    chosen = [device for host in hosts for device in host[: fit[-1]]]
    return None if len(chosen) == 1 else Mesh(np.array(chosen), ("batch",))


def replicate(mesh: Mesh | None, tree):
    """Return the first process's arrays on every device."""
    if mesh is None:
        return tree
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import broadcast_one_to_all

        tree = broadcast_one_to_all(tree)
    return _spread(NamedSharding(mesh, P()), tree)


def shard_batch(mesh: Mesh | None, tree):
    """Return arrays (steps, batch), the same in every process, with each device's part of the batch on it."""
    return tree if mesh is None else _spread(NamedSharding(mesh, P(None, "batch")), tree)


def _spread(sharding: NamedSharding, tree):
    whole = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda a: jax.make_array_from_callback(a.shape, sharding, lambda part: a[part]), whole)


def local(mesh: Mesh | None, tree):
    """Return this process's first copy of arrays that every device has."""
    return tree if mesh is None else jax.tree.map(lambda a: a.addressable_data(0), tree)


def free_memory() -> int | None:
    """Return the bytes that a device of this process can still give, or the machine; None where neither tells."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats["bytes_in_use"]
    known = []
    for total, used in (("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"), ("/proc/meminfo", None)):
        try:
            words = Path(total).read_text().split()
            if used is None:
                known.append(1024 * int(words[words.index("MemAvailable:") + 1]))
            elif words[0] != "max":
                known.append(int(words[0]) - int(Path(used).read_text()))
        except (OSError, ValueError):
            continue
    return min(known, default=None)


def check_fits(program: Compiled, batch: int, there: int | None = None) -> None:
    """Check that a compiled training program of so many windows a step fits into memory.

    there: bytes of its arguments that are in memory already; None: all of them are.

    Raises:
        InputError: what else it needs is more than is free.
    """
    size, free = program.memory_analysis(), free_memory()
    needed = 0 if size is None else size.temp_size_in_bytes + size.output_size_in_bytes - size.alias_size_in_bytes
    needed += 0 if size is None or there is None else max(0, size.argument_size_in_bytes - there)
    if free is not None and needed > free:
        raise InputError(
            "training does not fit into memory", field="training.batch", value=batch,
            mend=f"it needs {needed / 1e9:.3g} GB where {free / 1e9:.3g} GB are free: lower it, or use a coarser garment",
        )  # fmt: skip


def trim_memory() -> None:
    """Return to the system what reading and compiling leave over, 200 MB that glibc would keep."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)

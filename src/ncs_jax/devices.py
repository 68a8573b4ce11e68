"""Where training runs: the batch divided among the devices of all hosts, everything else copied to each.

Where there is one device the mesh is None, and what is handed over comes back as it was.
"""

from __future__ import annotations

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from ncs_jax.errors import InputError

__all__ = ["batch_mesh", "copied", "divided", "local"]


def batch_mesh(batch: int) -> Mesh | None:
    """The most devices that divide the batch, as many on every host, along one axis "batch"; None for a single one.

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


def copied(mesh: Mesh | None, tree):
    """The first process's arrays on every device."""
    if mesh is None:
        return tree
    if jax.process_count() > 1:
        from jax.experimental.multihost_utils import broadcast_one_to_all

        tree = broadcast_one_to_all(tree)
    return _spread(NamedSharding(mesh, P()), tree)


def divided(mesh: Mesh | None, tree):
    """Arrays (steps, batch), the same in every process, with each device's part of the batch on it."""
    return tree if mesh is None else _spread(NamedSharding(mesh, P(None, "batch")), tree)


def _spread(sharding: NamedSharding, tree):
    whole = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda a: jax.make_array_from_callback(a.shape, sharding, lambda part: a[part]), whole)


def local(mesh: Mesh | None, tree):
    """This process's first copy of arrays that every device has."""
    return tree if mesh is None else jax.tree.map(lambda a: a.addressable_data(0), tree)

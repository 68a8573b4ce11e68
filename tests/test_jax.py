"""What JAX itself computes wrongly, which this package has to go round: a canary for each tells when it is mended."""

import jax
import numpy as np
import pytest


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the fault is XLA:CPU's")
def test_rows_moved_on_by_one_and_reshaped_are_still_wrong():
    """Warn of openxla/xla#49176: under jit on the CPU, never write `base.at[1:].set(base[:-1]).reshape(...)`.

    The copy is made in place, from front to back, and reads what it has just written. Use `jnp.concatenate` instead.
    """

    def moved(x):
        base = x + 1
        return base.at[1:].set(base[:-1]).reshape((1, *base.shape))

    x = np.arange(4, dtype=np.int32)
    np.testing.assert_array_equal(moved(jax.numpy.asarray(x)), [[1, 1, 2, 3]])  # step by step it is right
    found = np.asarray(jax.jit(moved)(x))
    assert not np.array_equal(found, [[1, 1, 2, 3]]), "openxla/xla#49176 is mended: delete this canary, and the warning in it"

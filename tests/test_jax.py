"""What JAX itself computes wrongly: a canary for each that this package goes round, and a check for each that it cannot."""

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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_large_sum_of_products_is_right(dtype):
    """Refuse a JAX with jax-ml/jax#39103, as 0.10.2 has it: from some 100,000 products on such a sum is wrong under jit."""
    rng = np.random.default_rng(0)
    w, c = (rng.normal(size=shape).astype(dtype) for shape in ((3, 40_000), (3, 3, 40_000)))
    found = jax.jit(lambda w, c: jax.numpy.sum(w[:, None] * c, axis=0))(w, c)
    np.testing.assert_allclose(found, np.sum(w[:, None] * c, axis=0), rtol=0, atol=1e-5)

"""What JAX itself computes wrongly, which this package has to go round: a canary for each tells when it is mended."""

from importlib.metadata import version

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


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the fault is XLA:CPU's")
def test_a_large_sum_of_products_is_still_wrong_in_jaxlib_0_10():
    """Warn: for jaxlib 0.10, do not write `jnp.sum(w[:, None] * c, axis=0)` of float32 arrays that may be large.

    Compiled for the CPU it becomes a fused reduction (`ynn_fusion`), which is wrong from some 100,000 products on.
    `jnp.einsum` is right, and so is a sum written out. jaxlib 0.12 is right.
    """
    rng = np.random.default_rng(0)
    w, c = (rng.normal(size=shape).astype(np.float32) for shape in ((3, 40_000), (3, 3, 40_000)))
    expected, f = np.sum(w[:, None] * c, axis=0), lambda w, c: jax.numpy.sum(w[:, None] * c, axis=0)
    wrong = np.abs(np.asarray(jax.jit(f)(w, c)) - expected).max() > 1e-3
    assert wrong == (version("jaxlib").split(".")[:2] == ["0", "10"]), "look where the package goes round this"
    assert np.abs(np.asarray(jax.jit(lambda w, c: jax.numpy.einsum("kn,kmn->mn", w, c))(w, c)) - expected).max() < 1e-4

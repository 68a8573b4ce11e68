"""Safe norms and angles: value, first and second derivative, in a batch whose other rows are ordinary."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.numerics import angle_between, norm, normalize, positive_part, signed_angle

# Lengths of the odd row in m: nothing, the least number, just under and over where each type is masked, cloth, large.
LENGTHS = [0.0, 1e-44, 0.9e-12, 1.1e-12, 1e-11, 1e-10, 1e-9, 1e-7, 1e-5, 1e-3, 1.0, 1e4]
FUNCTIONS = {
    "norm": norm,
    "normalize": lambda x: jnp.sum(normalize(x) * jnp.array([1, -2, 3], x.dtype)[None], axis=-1),
    "signed_angle": lambda x: signed_angle(x[:, 0], x[:, 1]),
    "angle_between": lambda x: angle_between(x, jnp.tile(jnp.array([[0.3, 0.1, -0.2]], x.dtype), (len(x), 1))),
}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_two_derivatives_are_finite_beside_a_singular_row(name, dtype):
    f = FUNCTIONS[name]

    @jax.jit
    def derivatives(x, v):
        def along(x):
            return jax.jvp(lambda x: jnp.sum(f(x)), (x,), (v,))[1]

        return f(x), jax.grad(lambda x: jnp.sum(f(x)))(x), jax.jvp(along, (x,), (v,))[1], jax.grad(along)(x)

    usual = jnp.array([[1, 2, -2], [0.3, -0.4, 1.2]], dtype)
    v = jnp.array([[0.3, -1, 0.5]] * 3, dtype)
    clean = derivatives(jnp.concatenate([usual, usual[:1]]), v)
    for direction in ([1, 2, -2], [0, 0, 1], [0, 1, 0], [-1, 0, 0], [1, -1, 1]):
        for length in LENGTHS:
            odd = jnp.array([direction], dtype) * dtype(length)
            values = derivatives(jnp.concatenate([usual, odd]), v)
            for got, expected in zip(values, clean, strict=True):
                assert jnp.all(jnp.isfinite(got)), (direction, length)
                if got.ndim:
                    np.testing.assert_array_equal(got[:2], expected[:2])
                    assert got.dtype == dtype
            if length == 0:
                assert not jnp.any(values[1][2]) and not jnp.any(values[3][2])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("scale", [1e-9, 1e-5, 1.0, 1e5])
def test_values_and_derivatives(dtype, scale, rng):
    x, y = rng.normal(size=(2, 20, 3))
    a, b = jnp.asarray(x * scale, dtype), jnp.asarray(y, dtype)
    x, y = np.asarray(a, np.float64), np.asarray(b, np.float64)
    length = np.linalg.norm(x, axis=1)
    unit = x / length[:, None]
    square = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length[:, None, None]

    @jax.jit
    def values(a, b):
        slopes = [jax.vmap(f)(a) for f in (jax.grad(norm), jax.hessian(norm), jax.jacobian(normalize))]
        return norm(a), normalize(a), signed_angle(a[:, 0], a[:, 1]), angle_between(a, b), *slopes

    # Hessian of a length and derivative of a direction: (1 - n n^T) / |x|
    expected = length, unit, np.arctan2(x[:, 0], x[:, 1]), np.arccos(np.sum(unit * y, axis=1) / np.linalg.norm(y, axis=1))
    for got, right in zip(values(a, b), (*expected, unit, square, square), strict=True):
        tolerance = 1e-5 if dtype == jnp.float32 else 1e-12
        np.testing.assert_allclose(np.asarray(got), right, rtol=tolerance, atol=tolerance * np.abs(right).max())


def test_angles_are_accurate_at_both_ends():
    # arccos of the cosine would give 0 here, and pi
    for small in (1e-3, 1e-6, 1e-9):
        near = angle_between(jnp.array([1.0, 0, 0]), jnp.array([1.0, small, 0]))
        far = angle_between(jnp.array([1.0, 0, 0]), jnp.array([-1.0, small, 0]))
        np.testing.assert_allclose(near, np.arctan(small), rtol=1e-12)
        np.testing.assert_allclose(np.pi - far, np.arctan(small), rtol=1e-6)
    assert signed_angle(jnp.array(-1e-9), jnp.array(1.0)) < 0 < signed_angle(jnp.array(1e-9), jnp.array(1.0))


def test_angle_is_free_of_a_common_scale():
    for k in (1e-10, 1e-3, 1e8):
        np.testing.assert_allclose(signed_angle(jnp.array(3 * k), jnp.array(-4 * k)), np.arctan2(3, -4), rtol=1e-14)


# --- the positive part of a matrix --------------------------------------------------------------------------------------

FAST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
positive = jax.jit(positive_part, compiler_options=FAST)
LANES = 240


def by_eigenvalues(a):
    """(n, n, lanes) in float64."""
    values, vectors = np.linalg.eigh(np.moveaxis(np.asarray(a, np.float64), -1, 0))
    return np.einsum("lik,lk,ljk->ijl", vectors, np.maximum(values, 0), vectors)


def symmetric(n, rng):
    """LANES matrices (n, n, lanes): ordinary ones, then all that an eigenvalue can be."""
    turns = np.linalg.qr(rng.normal(size=(LANES, n, n)))[0]
    values = rng.normal(size=(LANES, n))
    values[40:60] = np.abs(values[40:60])  # positive already
    values[60:80] = -np.abs(values[60:80])
    values[80:100] = np.sign(values[80:100])  # repeated, of both signs
    values[100:110] = values[100:110, :1]  # all equal
    values[110:120] = 0
    values[120:140] *= 10.0 ** -np.arange(n)[::-1]  # of very different size
    values[140:160, 1:] = 0  # rank one
    values[160:180] = np.array([1, -1] * n)[:n] * (1 + 1e-9 * values[160:180])  # nearly repeated
    turns[180:220] = np.eye(n)  # diagonal
    a = np.einsum("lik,lk,ljk->ijl", turns, values, turns)
    a[..., 200:220] += 1e-12 * rng.normal(size=(n, n, 20))  # and nearly
    return (a + a.transpose(1, 0, 2)) / 2


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_positive_part_against_eigenvalues(n, dtype, rng):
    a = jnp.asarray(symmetric(n, rng), dtype)
    got = positive(a)
    assert got.dtype == dtype and got.shape == a.shape
    right, rounding = by_eigenvalues(a), 1e-5 if dtype == jnp.float32 else 1e-13
    np.testing.assert_allclose(np.asarray(got), right, rtol=0, atol=rounding)
    # what is positive already stays, what is negative goes, and what is nothing stays nothing
    np.testing.assert_allclose(np.asarray(got[..., 40:60]), np.asarray(a[..., 40:60]), rtol=0, atol=rounding)
    np.testing.assert_allclose(np.asarray(got[..., 60:80]), 0, atol=rounding)
    np.testing.assert_array_equal(got[..., 110:120], 0)
    # every matrix of a batch is by itself
    np.testing.assert_array_equal(got[..., :120], positive(jnp.concatenate([a[..., :120], a[..., :120]], axis=-1))[..., 120:])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_positive_part_at_every_scale(dtype, rng):
    """A scale of the matrix is one of the result, down to where the type ends."""
    a = symmetric(4, rng)
    scales = (1e-30, 1e-12, 1e12, 1e30) if dtype == jnp.float32 else (1e-290, 1e-150, 1e150, 1e300)
    right = by_eigenvalues(a)
    for scale in scales:
        got = np.asarray(positive(jnp.asarray(a * scale, dtype)), np.float64) / scale
        np.testing.assert_allclose(got, right, rtol=0, atol=1e-5 if dtype == jnp.float32 else 1e-13)
    mixed = scales[0] * (np.arange(LANES) % 2) + scales[3] * (np.arange(LANES) % 2 == 0)  # side by side in one batch
    got = np.asarray(positive(jnp.asarray(a * mixed, dtype)), np.float64) / mixed
    np.testing.assert_allclose(got, right, rtol=0, atol=1e-5 if dtype == jnp.float32 else 1e-13)


def test_positive_part_of_what_is_not_a_number_spoils_no_neighbour(rng):
    a = symmetric(4, rng)
    clean = np.asarray(positive(jnp.asarray(a)))
    a[1, 2, 7] = a[2, 1, 7] = np.nan
    got = np.asarray(positive(jnp.asarray(a)))
    assert np.isnan(got[..., 7]).any()
    np.testing.assert_array_equal(np.delete(got, 7, axis=-1), np.delete(clean, 7, axis=-1))

"""Safe norms and angles: value, first and second derivative, in a batch whose other rows are ordinary."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.numerics import angle_between, norm, normalize, signed_angle

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

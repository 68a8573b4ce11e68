"""The closest point of a triangle: the fast paths say what the plain one says, and no point of the triangle is nearer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.closest_point import closest_weights, gap_to, triangle_square, triangle_weights

KINDS = ("all", "needle", "line", "one point")


def cases(rng, kind, count=3000):
    """Points around triangles, some of no area."""
    corners = rng.normal(size=(count, 3, 3))
    if kind == "needle":
        corners[:, 2] = corners[:, 1] + 1e-4 * corners[:, 2]
    if kind == "line":  # of no area exactly: where rounding leaves some, no path knows which way it faces
        corners = rng.integers(-8, 9, size=(count, 3, 3)).astype(float)
        corners[:, 2] = corners[:, 0] + rng.integers(-2, 4, (count, 1)) * (corners[:, 1] - corners[:, 0]) / 2
    if kind == "one point":
        corners[:] = corners[:, :1]
    return jnp.asarray(rng.normal(size=(count, 3))), jnp.asarray(corners)


def by_component(a):
    return [a[..., i] for i in range(3)]


@pytest.mark.parametrize("kind", KINDS)
def test_the_three_agree(rng, kind):
    x, corners = cases(rng, kind)
    lanes = by_component(x), *(by_component(corners[:, k]) for k in range(3))
    # Three edges on one line are equally near. Compiled, which of them is taken may be decided once for each coordinate.
    compiled = jax.jit if kind != "line" else lambda f: f
    plain = compiled(closest_weights)(x, corners)
    fast, square = jnp.stack(compiled(triangle_weights)(*lanes), axis=-1), compiled(triangle_square)(*lanes)
    gaps = [jnp.sum(gap_to(x, corners, w) ** 2, axis=-1) for w in (plain, fast)]
    np.testing.assert_allclose(gaps[1], gaps[0], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(square, gaps[0], rtol=1e-9, atol=1e-15)
    if kind == "all":  # elsewhere several points of the triangle are equally near
        np.testing.assert_allclose(fast, plain, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_no_point_of_the_triangle_is_nearer(rng, kind):
    x, corners = cases(rng, kind, 300)
    weights = closest_weights(x, corners)
    np.testing.assert_allclose(jnp.sum(weights, axis=-1), 1, atol=1e-12)
    assert float(weights.min()) >= -1e-12
    best = jnp.sum(gap_to(x, corners, weights) ** 2, axis=-1)
    for other in rng.dirichlet([0.5] * 3, size=200):
        there = jnp.sum(gap_to(x, corners, jnp.broadcast_to(jnp.asarray(other), weights.shape)) ** 2, axis=-1)
        assert bool(jnp.all(best <= there + 1e-12))

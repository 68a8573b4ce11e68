"""Friction: Coulomb's force where cloth slips, next to nothing where it sticks, and none that the body does not press."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.friction import SLIP, friction

DT, GRAVITY, MASS = 1 / 30, 9.81, 2e-4
ALONG, NORMAL = np.array([np.cos(0.4), -np.sin(0.4), 0.0]), np.array([np.sin(0.4), np.cos(0.4), 0.0])


def test_the_force_is_that_of_coulomb_once_it_slips(rng):
    pressed = jnp.asarray(rng.standard_normal((20, 3)))
    normal = pressed / jnp.linalg.norm(pressed, axis=1, keepdims=True)
    gap = jnp.asarray(rng.standard_normal((20, 3)))
    along = gap - jnp.sum(gap * normal, axis=1, keepdims=True) * normal
    along = along / jnp.linalg.norm(along, axis=1, keepdims=True)
    carried = jnp.asarray(rng.standard_normal((20, 3)))
    for size, share in ((5.0, 1.0), (0.25, 0.25), (0.0, 0.0)):  # in slips
        x = carried + size * SLIP * DT * along + 0.01 * normal  # how far off the body it is does not matter
        force = jax.grad(friction)(x, carried, pressed, 0.3, DT)
        expected = 0.3 * share * jnp.linalg.norm(pressed, axis=1, keepdims=True) * along
        np.testing.assert_allclose(force, expected, rtol=0, atol=1e-9)


def test_it_is_continuous_where_slip_begins_and_has_its_differences_as_derivative(rng):
    carried, pressed = jnp.zeros((1, 3)), jnp.asarray([[0.0, 2.0, 0.0]])
    value = lambda u: float(friction(jnp.asarray([[u, 0.0, 0.0]]), carried, pressed, 0.5, DT))  # noqa: E731
    slip = SLIP * DT
    assert value(slip * (1 - 1e-9)) == pytest.approx(value(slip * (1 + 1e-9)), rel=1e-8)
    for u in (0.3 * slip, 0.9 * slip, 1.1 * slip, 7 * slip):
        force = jax.grad(friction)(jnp.asarray([[u, 0.0, 0.0]]), carried, pressed, 0.5, DT)[0, 0]
        assert force == pytest.approx((value(u + 1e-8) - value(u - 1e-8)) / 2e-8, rel=1e-6)


def test_what_nothing_presses_is_free(rng):
    x = jnp.asarray(rng.standard_normal((5, 3)))
    value, force = jax.value_and_grad(friction)(x, jnp.zeros((5, 3)), jnp.zeros((5, 3)), 0.5, DT)
    assert value == 0 and not np.any(force)


@pytest.mark.parametrize("coefficient", [0.0, 0.2, 0.6])
def test_a_mass_on_a_slope_slides_or_sticks(coefficient):
    """Implicit Euler on a slope of 0.4 rad: v grows by dt g (sin - mu cos) a step, or, where mu > tan, it creeps."""
    pressed = jnp.asarray([-MASS * GRAVITY * np.cos(0.4) * NORMAL])

    def energy(s, last, speed):  # of a place on the slope
        x, before = s * ALONG, last * ALONG
        own = MASS / 2 * (s - last - DT * speed) ** 2 / DT**2 - MASS * GRAVITY * np.sin(0.4) * s
        return own + friction(x[None], before[None], pressed, coefficient, DT)

    slope = jax.jit(jax.grad(energy))
    place, speed = 0.0, 0.0
    for _ in range(10):
        low, high = place - 1.0, place + 1.0  # the energy is convex
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (low, middle) if slope(middle, place, speed) > 0 else (middle, high)
        place, speed = low, (low - place) / DT
    if coefficient > np.tan(0.4):
        assert 0 < speed < SLIP
    else:
        expected = 10 * DT * GRAVITY * (np.sin(0.4) - coefficient * np.cos(0.4))
        assert speed == pytest.approx(expected, rel=1e-6)

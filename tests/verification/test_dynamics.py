"""Implicit Euler by minimising the package's own objective, against motions that are known in closed form.

The step x_n = argmin E(x; x_{n-1}, x_{n-2}), with the inertia of equation (13), satisfies
M (x_n - 2 x_{n-1} + x_{n-2}) / dt^2 = F(x_n) (Martin et al. 2011).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.terms import StepInputs
from ncs_jax.energies.total import total

from ..shapes import rotation, sheet
from .cloth import DENSITY, GRAVITY, NOTHING, chain, garment, material, settle
from .newton import order


def simulate(cloth, numbers, terms, start, velocity, dt, steps, free=True):
    """Positions (steps + 2, verts, 3): two frames of the start, then what the minimiser makes of them."""
    frames = [start - dt * velocity, start]
    for _ in range(steps):
        frame = StepInputs(jnp.asarray(dt), *(jnp.asarray(x) for x in (frames[-1], frames[-2])))
        frames.append(settle(terms, free, 2 * frames[-1] - frames[-2], cloth, numbers, frame))
    return np.stack(frames)


# --- free fall ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [1 / 15, 1 / 240])
@pytest.mark.parametrize("elastic", [False, True])
def test_free_fall(dt, elastic):
    """From rest, y_n - y_0 = -g dt^2 n (n + 1) / 2: the discrete parabola of implicit Euler, exactly, at any step.

    From v_n = v_{n-1} - g dt and y_n = y_{n-1} + dt v_n. Elastic forces have no part in it: the cloth falls as one.
    """
    vertices, faces = sheet(3, 4, 0.02)
    cloth = garment(vertices @ rotation([1, 2, 0], 0.7).T, faces)
    terms = dataclasses.replace(NOTHING, gravity=True, inertia=True)
    if elastic:
        terms = dataclasses.replace(terms, membrane="stvk", bending=True)
    start = np.asarray(cloth.mesh.rest)
    numbers = material((41.8, 22.2) if elastic else (), 1e-5)
    frames = simulate(cloth, numbers, terms, start, 0 * start, dt, 8)
    n = np.arange(9)
    expected = start[None] + np.array([0, -GRAVITY, 0]) * (dt**2 * n * (n + 1) / 2)[:, None, None]
    np.testing.assert_allclose(frames[1:], expected, rtol=0, atol=1e-9 * abs(expected[-1]).max())


def test_a_throw_is_a_parabola_to_first_order_in_the_step():
    """x = v t + g t^2 / 2; the discrete one is g t dt / 2 ahead, so the error halves with the step."""
    cloth = chain(0.1, 1, 0.01)
    start, velocity, g = np.asarray(cloth.mesh.rest), np.array([1.0, 2.0, -0.5]), np.array([0.5, -3.0, 1.0])
    terms, errors = dataclasses.replace(NOTHING, gravity=True, inertia=True), []
    for steps in (10, 20):
        frames = simulate(cloth, material(gravity=g), terms, start, velocity + 0 * start, 0.4 / steps, steps)
        error = frames[-1] - (start + velocity * 0.4 + g * 0.4**2 / 2)
        np.testing.assert_allclose(error, np.broadcast_to(g * 0.4 * (0.4 / steps) / 2, error.shape), rtol=1e-8)
        errors.append(np.abs(error).max())
    assert abs(order(errors) - 1) < 0.2


# --- spring and pendulum ------------------------------------------------------------------------------------------------

MASS, LENGTH, STIFFNESS = 0.02, 0.3, 1.5  # kg, m, and the tension at strain 1, N: a spring of STIFFNESS / LENGTH N/m
SPRING = dataclasses.replace(NOTHING, membrane="mass_spring", gravity=True)
HELD = np.array([[False] * 3, [True] * 3])


def hung(angle=0.0, length=LENGTH):
    return np.array([[0.0, 0, 0], [length * np.sin(angle), -length * np.cos(angle), 0.0]])


@pytest.mark.parametrize("gravity", [(0.0, -9.81, 0.0), (3.0, -2.0, 1.0)])
def test_a_hanging_spring_is_longer_by_mg_over_k(gravity):
    """Hooke: k (l - l_0) = m |g|, along the gravity."""
    cloth = chain(LENGTH, 1, MASS, lumped_ends=False)
    g = np.array(gravity)
    extension = MASS * np.linalg.norm(g) / (STIFFNESS / LENGTH)
    expected = (LENGTH + extension) * g / np.linalg.norm(g)
    found = settle(SPRING, HELD, hung(), cloth, material((STIFFNESS,), gravity=gravity))
    np.testing.assert_allclose(found[1], expected, rtol=0, atol=1e-10)


def test_a_bouncing_spring_loses_what_implicit_euler_takes():
    """About its rest, u_n = A Re(c z^n) with z = (1 + i w dt) / (1 + w^2 dt^2): u_n (1 + w^2 dt^2) = 2 u_{n-1} - u_{n-2}.

    (Hairer and Wanner, Solving ODEs II, IV.3: the stability function 1 / (1 - z).) It approaches cos(w t) to first order.
    """
    cloth = chain(LENGTH, 1, MASS, lumped_ends=False)
    k = STIFFNESS / LENGTH
    w, rest = np.sqrt(k / MASS), LENGTH + MASS * GRAVITY / k
    terms, errors = dataclasses.replace(SPRING, inertia=True), []
    for steps in (50, 100):
        dt = 0.5 / steps
        frames = simulate(cloth, material((STIFFNESS,)), terms, hung(length=rest + 0.05), 0 * hung(), dt, steps, HELD)
        u = -frames[:, 1, 1] - rest
        z = (1 + 1j * w * dt) / (1 + (w * dt) ** 2)
        expected = np.linalg.solve([[1, 1], [z, z.conjugate()]], [0.05, 0.05])  # u_{-1} = u_0
        n = np.arange(steps + 2)
        np.testing.assert_allclose(u, np.real(expected[0] * z**n + expected[1] * z.conjugate() ** n), rtol=0, atol=1e-10)
        np.testing.assert_allclose(abs(z), (1 + (w * dt) ** 2) ** -0.5, rtol=1e-12)
        errors.append(np.abs(u[1:] - 0.05 * np.cos(w * dt * n[:-1])).max())
    assert abs(order(errors) - 1) < 0.2


def test_a_pendulum_swings_at_root_g_over_l():
    """theta'' = -(g/l) theta for small angles: a stiff spring, whose length is that at rest; first order in the step."""
    cloth = chain(LENGTH, 1, MASS, lumped_ends=False)
    stiff = 1000 * MASS * GRAVITY
    length = LENGTH * (1 + 1e-3)
    w, terms, errors = np.sqrt(GRAVITY / length), dataclasses.replace(SPRING, inertia=True), []
    quarter = np.pi / (2 * w)
    for steps in (20, 40):
        dt = quarter / steps
        frames = simulate(cloth, material((stiff,)), terms, hung(0.02, length), 0 * hung(), dt, 2 * steps, HELD)
        angle = np.arctan2(frames[1:, 1, 0], -frames[1:, 1, 1])
        errors.append(np.abs(angle - 0.02 * np.cos(w * dt * np.arange(2 * steps + 1))).max() / 0.02)
        z = (1 + 1j * w * dt) / (1 + (w * dt) ** 2)  # the spring's own oscillation is damped away within a step
        c = np.linalg.solve([[1, 1], [z, z.conjugate()]], [0.02, 0.02])
        n = np.arange(1, 2 * steps + 2)
        np.testing.assert_allclose(angle, np.real(c[0] * z**n + c[1] * z.conjugate() ** n), rtol=0, atol=2e-3 * 0.02)
    assert errors[-1] < 0.07 and abs(order(errors) - 1) < 0.2


# --- momentum -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("membrane", "numbers"),
    [("stvk", (41.8, 22.2)), ("mass_spring", (60.0,))],
)
def test_momentum_without_gravity(membrane, numbers, rng):
    """Cloth that tumbles and vibrates: sum m v is kept, and sum x_n x m (v_n - v_{n-1}) = 0 (Newton's third law, both forms).

    Implicit Euler does not keep the angular momentum sum x x m v itself; that identity is what it does keep.
    """
    vertices, faces = sheet(3, 4, 0.02)
    cloth = garment(vertices, faces)
    terms = dataclasses.replace(NOTHING, membrane=membrane, bending=True, gravity=True, inertia=True)
    start = vertices + 2e-3 * rng.normal(size=vertices.shape)
    spin = np.cross([3.0, -2.0, 5.0], start)
    velocity = np.array([0.4, 0.1, -0.2]) + spin + 0.05 * rng.normal(size=start.shape)
    dt = 1 / 120
    frames = simulate(cloth, material(numbers, 1e-4, (0.0, 0.0, 0.0)), terms, start, velocity, dt, 6)
    mass = np.asarray(DENSITY * cloth.mesh.vertex_area)[:, None]
    v = np.diff(frames, axis=0) / dt
    momentum = np.sum(mass * v, axis=1)
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), rtol=0, atol=1e-9 * abs(momentum).max())
    torque = np.sum(np.cross(frames[2:], mass * np.diff(v, axis=0)), axis=1)
    exchanged = np.sum(np.abs(np.cross(frames[2:], mass * np.diff(v, axis=0))), axis=1)
    assert np.abs(torque).max() < 1e-8 * exchanged.max()
    assert np.abs(np.diff(v, axis=0)).max() > 0.05  # there were forces


def test_gravity_gives_its_impulse(rng):
    """sum m v grows by m g dt a step whatever the cloth does meanwhile."""
    vertices, faces = sheet(3, 4, 0.02)
    cloth = garment(vertices, faces)
    terms = dataclasses.replace(NOTHING, membrane="stvk", bending=True, gravity=True, inertia=True)
    start, dt, g = vertices + 2e-3 * rng.normal(size=vertices.shape), 1 / 60, np.array([1.0, -9.0, 2.0])
    frames = simulate(cloth, material((41.8, 22.2), 1e-5, g), terms, start, 0 * start, dt, 5)
    mass = np.asarray(DENSITY * cloth.mesh.vertex_area)[:, None]
    momentum = np.sum(mass * np.diff(frames, axis=0) / dt, axis=1)
    np.testing.assert_allclose(np.diff(momentum, axis=0), np.tile(mass.sum() * g * dt, (5, 1)), rtol=1e-7)


@pytest.mark.parametrize("membrane", ["stvk", "neo_hookean", "baraff_witkin", "mass_spring", None])
def test_inner_forces_have_no_sum_and_no_torque(membrane, rng):
    vertices, faces = sheet(4, 5, 0.01)
    cloth = garment(vertices, faces)
    numbers = {"baraff_witkin": (40.0, 20.0), "mass_spring": (60.0,), None: ()}.get(membrane, (41.8, 22.2))
    terms = dataclasses.replace(NOTHING, membrane=membrane, bending=membrane is None)
    x = vertices + 3e-3 * rng.normal(size=vertices.shape) + [0.5, 1.0, -0.3]
    force = -jax.jit(jax.grad(lambda x: total(x, cloth, material(numbers, 1e-5), StepInputs(), terms)))(jnp.asarray(x))
    size = np.abs(force).sum()
    assert size > 1e-6
    np.testing.assert_allclose(np.sum(force, axis=0), 0, atol=1e-12 * size)
    np.testing.assert_allclose(np.sum(np.cross(x, force), axis=0), 0, atol=1e-11 * size)

"""Equilibria that the package's own objective finds, against elasticity and statics in closed form."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import total

from ..shapes import equilateral, sheet
from .cloth import DENSITY, GRAVITY, NOTHING, chain, garment, material, settle
from .newton import minimiser, order

# --- catenary -----------------------------------------------------------------------------------------------------------


def elastic_catenary(s, horizontal, weight, stiffness):
    """Place (x, y) of the material point at rest length s from the lowest one, under gravity -y.

    x = H s / EA + (H / w) asinh(w s / H),  y = w s^2 / (2 EA) + (H / w) (sqrt(1 + (w s / H)^2) - 1), with H the horizontal
    tension, w the weight per rest length and EA the tension at strain 1 (Irvine, Cable Structures, 1981, ch. 1).
    """
    slope = weight * s / horizontal
    x = horizontal * s / stiffness + horizontal / weight * np.arcsinh(slope)
    return x, weight * s**2 / (2 * stiffness) + horizontal / weight * (np.sqrt(1 + slope**2) - 1)


@pytest.mark.parametrize("stiffness", [0.5, 50.0])
def test_a_hanging_chain_is_a_catenary(stiffness):
    """Soft, it stretches by a fifth; stiff, it is the catenary y = a cosh(x / a). The error falls with the square of a link."""
    length, span, mass = 1.0, 0.8, 0.02
    weight = mass * GRAVITY / length
    half = lambda h: elastic_catenary(length / 2, h, weight, stiffness)[0] - span / 2  # noqa: E731
    horizontal = brentq(half, 1e-3 * weight, 50 * weight, xtol=1e-15, rtol=1e-14)
    terms, errors = dataclasses.replace(NOTHING, membrane="mass_spring", gravity=True), []
    for links in (8, 16, 32):
        cloth = chain(length, links, mass)
        s = np.linspace(-length / 2, length / 2, links + 1)
        x, y = elastic_catenary(s, horizontal, weight, stiffness)
        expected = np.stack([x, y - y[0], 0 * x], axis=1)
        free = np.ones((links + 1, 3), bool)
        free[[0, -1]] = False
        sag = -0.2 * (1 - (2 * s / length) ** 2)
        start = np.stack([span * s / length, sag, 0 * s], axis=1)
        found = settle(terms, free, start, cloth, material((stiffness,)))
        errors.append(np.abs(found - expected).max())
        assert np.abs(found[:, 2]).max() < 1e-9
    assert errors[-1] < 1e-3 and abs(order(errors) - 2) < 0.2


def test_hanging_cloth_is_a_catenary_too():
    """A strip of St. Venant-Kirchhoff cloth between two bars: y = a cosh(x / a), its length 2 a sinh(span / 2 a)."""
    length, span, columns = 0.4, 0.3, 21
    vertices, faces = sheet(2, columns, length / (columns - 1))
    s = vertices[:, 0] - length / 2
    cloth = garment(np.stack([s, 0 * s, vertices[:, 1]], axis=1), faces)
    a = brentq(lambda a: 2 * a * np.sinh(span / (2 * a)) - length, 0.05, 2)
    x, z = a * np.arcsinh(s / a), np.asarray(cloth.mesh.rest)[:, 2]
    y = np.sqrt(a**2 + s**2) - np.sqrt(a**2 + length**2 / 4)
    free = np.abs(s)[:, None] < 0.499 * length
    terms = dataclasses.replace(NOTHING, membrane="stvk", gravity=True)
    sag = -0.12 * (1 - (2 * s / length) ** 2)
    start = np.stack([span * s / length, sag, z], axis=1)
    found = settle(terms, free, start, cloth, material((2000.0, 1000.0)))
    np.testing.assert_allclose(found, np.stack([x, y, z], axis=1), rtol=0, atol=0.004 * length)


# --- membrane -----------------------------------------------------------------------------------------------------------

LAM, MU = 41.8, 22.2


def tension(model, s):
    """Force per rest width and the stretch across, at the stretch s along and free width, by d(density)/dt = 0.

    St. Venant-Kirchhoff: P = s Y (s^2 - 1) / 2 with Y = 4 mu (lambda + mu) / (lambda + 2 mu), t^2 = 1 - nu (s^2 - 1) with
    nu = lambda / (lambda + 2 mu) (Holzapfel, Nonlinear Solid Mechanics, 6.5, in the plane). Neo-Hookean, as its law has it:
    t = s (r + 2) / (1 + (r + 1) s^2) with r = lambda / mu, P = mu s - mu t + (lambda + mu) (s t - 1) t.
    """
    if model == "stvk":
        nu = LAM / (LAM + 2 * MU)
        return s * 4 * MU * (LAM + MU) / (LAM + 2 * MU) * (s**2 - 1) / 2, np.sqrt(1 - nu * (s**2 - 1))
    r = LAM / MU
    t = s * (r + 2) / (1 + (r + 1) * s**2)
    return MU * s - MU * t + (LAM + MU) * (s * t - 1) * t, t


@pytest.mark.parametrize("shape", [sheet(4, 6, 0.01), equilateral(4, 6)], ids=["sheet", "equilateral"])
@pytest.mark.parametrize("model", ["stvk", "neo_hookean"])
def test_a_patch_pulled_along_narrows_and_pulls_back_as_its_law_says(model, shape):
    """Exact on any mesh, since the deformation is even: every vertex's place and the force at the pulled end."""
    vertices, faces = shape
    cloth = garment(vertices, faces)
    terms = dataclasses.replace(NOTHING, membrane=model)
    # the ends of the sheet slide across; a slanted patch is held along its whole border, which the solution maps evenly
    border = np.zeros(len(vertices), bool)
    edges, counts = np.unique(
        np.sort(np.concatenate([faces[:, p] for p in ([0, 1], [1, 2], [2, 0])])), axis=0, return_counts=True
    )
    border[edges[counts == 1]] = True
    length, width = np.ptp(vertices[:, 0]), np.ptp(vertices[:, 1])
    upright = np.ptp(vertices[vertices[:, 1] == 0, 0]) == length
    left, right = vertices[:, 0] == vertices[:, 0].min(), vertices[:, 0] == vertices[:, 0].max()
    free = np.ones(vertices.shape, bool)
    free[:, 2] = False
    if upright:
        free[left | right, 0] = False
        free[np.flatnonzero(left)[0], 1] = False
    else:
        free[border] = False
    numbers = material((LAM, MU))
    pull = jax.jit(jax.grad(lambda x: total(x, cloth, numbers, StepInputs(), terms)))
    for s in (0.85, 1.05, 1.2):
        force, t = tension(model, s)
        expected = vertices * [s, t, 1]
        start = np.where(free, vertices * [s, 1, 1] + 5e-4 * np.sin(7 * np.arange(vertices.size).reshape(-1, 3)), expected)
        found = settle(terms, free, start * [1, 1, 0], cloth, numbers)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
        if upright:
            np.testing.assert_allclose(np.sum(np.asarray(pull(found))[right, 0]), force * width, rtol=1e-7)
        else:  # the derivative of the energy by the stretch along, at constant width
            slope = float(np.sum(np.asarray(pull(found)) * vertices * [1, 0, 0]))
            np.testing.assert_allclose(slope, force * float(jnp.sum(cloth.mesh.face_area)), rtol=1e-7)


# --- bending ------------------------------------------------------------------------------------------------------------

BEND = 2e-5
BENDING = dataclasses.replace(NOTHING, bending=True)


def rolled(columns, angle):
    """A strip of length 0.2 m laid on a curve whose tangent turns as `angle(s)`, in chords as long as at rest."""
    h = 0.2 / (columns - 1)
    vertices, faces = sheet(3, columns, h)
    middle = (np.arange(columns - 1) + 0.5) * h
    x = np.concatenate([[0], np.cumsum(h * np.cos(angle(middle)))])
    z = np.concatenate([[0], np.cumsum(h * np.sin(angle(middle)))])
    column = np.tile(np.arange(columns), 3)
    bent = np.stack([x[column], vertices[:, 1], z[column]], axis=1)
    cloth = garment(vertices, faces)
    return float(jax.jit(lambda x: total(x, cloth, material(bending=BEND), StepInputs(), BENDING))(jnp.asarray(bent))), 2 * h


def test_a_cylinder_costs_the_square_of_its_curvature():
    """E = k kappa^2 A / 8: of (11) on a grid, l = h, a = h^2, phi = h kappa (Grinspun et al. 2003); a plate of stiffness k / 4.

    Only hinges within the strip bend, so half a cell is lost at each end: first order, and exact but for that.
    """
    kappa, errors = 8.0, []
    for columns in (11, 21, 41):
        energy, width = rolled(columns, lambda s: kappa * s)
        plate = BEND * kappa**2 * 0.2 * width / 8
        np.testing.assert_allclose(energy, plate * (1 - 1 / (columns - 1)), rtol=1e-9)
        errors.append(energy / plate - 1)
    assert abs(order(errors) - 1) < 0.2


def test_a_wave_costs_the_integral_of_its_curvature_squared():
    """E = k / 8 width integral kappa(s)^2 ds with kappa = K sin(2 pi s / L), whose ends are flat: second order."""
    w, errors = 2 * np.pi / 0.2, []
    for columns in (11, 21, 41):
        energy, width = rolled(columns, lambda s: 12.0 * (1 - np.cos(w * s)) / w)
        errors.append(energy / (BEND / 8 * width * 12.0**2 * 0.1) - 1)
    assert abs(errors[-1]) < 5e-3 and abs(order(errors) - 2) < 0.2


def test_a_cantilever_sags_under_its_weight():
    """w(L) = q L^4 / (8 B) with B = k / 4 and q the weight per area (Timoshenko, Strength of Materials I, art. 39).

    In cylindrical bending: the vertices of a column move as one. (Free ones warp, and the hinges of a narrow strip are then
    softer than a plate.) A hinge bends the half cells on both its sides, so the clamp is half a cell before the last held
    column: second order.
    """
    length, errors = 0.1, []
    gravity = 0.002 * 8 * (BEND / 4) / (DENSITY * length**3)  # so that it sags by 0.2 % of its length
    terms, numbers = (
        dataclasses.replace(BENDING, membrane="stvk", gravity=True),
        material((200.0, 100.0), BEND, (0, 0, -gravity)),
    )
    for cells in (6, 12):
        h = length / (cells + 0.5)
        vertices, faces = sheet(3, cells + 2, h)
        vertices = vertices - [0.5 * h, 0, 0]  # the clamp at 0, between the two held columns
        cloth, column = garment(vertices, faces), np.tile(np.arange(cells + 2), 3)
        across = jnp.asarray(vertices * [0, 1, 0])

        def energy(columns, cloth=cloth, column=column, across=across):
            return total(columns[column] + across, cloth, numbers, StepInputs(), terms)

        start = vertices[: cells + 2] * [1, 0, 1]
        free = np.tile((start[:, 0] > h)[:, None], (1, 3)) & [True, False, True]
        found = minimiser(energy, tuple(np.flatnonzero(free)))(start - np.array([0, 0, 1e-4]) * free)
        errors.append(float(-found[-1, 2]) / (0.002 * length) - 1)
    assert abs(errors[-1]) < 0.01 and abs(order(errors) - 2) < 0.2


# --- contact ------------------------------------------------------------------------------------------------------------

STIFFNESS, THICKNESS = 10.0, 0.004
UP = np.array([False, False, True])


def laid_down(distance, gravity, membrane=(0.0, 0.0), bending=0.0):
    """Depths below the thickness and lumped masses, (verts,), of a sheet on a plate, free to move up and down."""
    body, triangles = sheet(13, 13, 0.01)
    vertices, faces = sheet(4, 5, 0.012)
    cloth = garment(vertices + [0.039, 0.043, 0], faces)
    start = np.asarray(cloth.mesh.rest) + [0, 0, 0.9 * THICKNESS]
    surface, terms = surface_from(start, body, triangles), Terms(collision=distance, inertia=False)
    numbers = material(membrane, bending, gravity, STIFFNESS, THICKNESS)
    found = settle(terms, UP, start, cloth, numbers, StepInputs(body=jnp.asarray(body)), surface)
    return THICKNESS - found[:, 2], np.asarray(DENSITY * cloth.mesh.vertex_area)


@pytest.mark.parametrize("distance", ["plane", "triangle"])
def test_cloth_on_a_floor_sinks_in_until_the_floor_carries_it(distance):
    """2 k_c (eps - d_v) = m_v g of (12) and (14): each vertex by itself, where nothing ties it to its neighbours."""
    depth, mass = laid_down(distance, (0, 0, -GRAVITY))
    expected = mass * GRAVITY / (2 * STIFFNESS)
    assert expected.min() > 1e-6
    np.testing.assert_allclose(depth, expected, rtol=0, atol=1e-12)


def test_elastic_cloth_on_a_slope_is_carried_along_the_normal():
    """sum_v 2 k_c (eps - d_v) = M g cos(tilt): membrane and bending only share the load out among the vertices."""
    gravity = GRAVITY * np.array([np.sin(0.5), 0, -np.cos(0.5)])
    loose, mass = laid_down("plane", gravity)
    depth, _ = laid_down("plane", gravity, (41.8, 22.2), 1e-2)
    np.testing.assert_allclose(2 * STIFFNESS * depth.sum(), mass.sum() * GRAVITY * np.cos(0.5), rtol=1e-9)
    np.testing.assert_allclose(2 * STIFFNESS * loose, mass * GRAVITY * np.cos(0.5), rtol=1e-7)
    assert np.ptp(depth) < 0.5 * np.ptp(loose) and (depth > 0).all()

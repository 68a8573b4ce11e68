"""One contract for every energy, then what each law promises beside it."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies import neo_hookean as neo
from ncs_jax.energies import stvk as saint
from ncs_jax.energies.baraff_witkin import baraff_witkin
from ncs_jax.energies.bending import bending
from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.distance import plane_distance, triangle_distance
from ncs_jax.energies.contact.nearest import nearest_triangle, nearest_vertex
from ncs_jax.energies.contact.surface import surface_from, vertex_normals
from ncs_jax.energies.gravity import gravity
from ncs_jax.energies.inertia import inertia, project
from ncs_jax.energies.mass_spring import mass_spring
from ncs_jax.energies.neo_hookean import neo_hookean
from ncs_jax.energies.pinning import pinning
from ncs_jax.energies.stvk import stvk
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.geometry.skinning import unpose

from .shapes import ball, equilateral, rotation, sheet, tube

LAM, MU, STRETCH, SHEAR, SPRING, BEND = 41.8, 22.2, 40.0, 20.0, 60.0, 1e-5
MESHED = {
    "mass_spring": lambda x, mesh: mass_spring(x, mesh, SPRING),
    "baraff_witkin": lambda x, mesh: baraff_witkin(x, mesh, STRETCH, SHEAR),
    "stvk": lambda x, mesh: stvk(x, mesh, LAM, MU),
    "neo_hookean": lambda x, mesh: neo_hookean(x, mesh, LAM, MU),
    "bending": lambda x, mesh: bending(x, mesh, BEND),
}
MEMBRANES = [name for name in MESHED if name != "bending"]
POINTWISE = ["collision_plane", "collision_triangle", "inertia", "gravity", "pinning"]
DTYPES = [jnp.float32, jnp.float64]


@cache
def case(name, dtype):
    """An energy of positions (16, 3) alone, its value and gradient compiled once for all tests, and ordinary positions."""
    rng = np.random.default_rng(7)
    rest, faces = sheet(4, 4, 0.01)
    x = rest + 1e-3 * rng.normal(size=rest.shape)
    mesh = mesh_from(rest, faces, dtype=dtype)
    mass = 0.15 * mesh.vertex_area
    array = lambda a: jnp.asarray(a, dtype)  # noqa: E731
    if name in MESHED:
        energy = lambda x: MESHED[name](x, mesh)  # noqa: E731
    elif name == "inertia":
        previous, before = array(rest), array(rest - 1e-3)
        energy = lambda x: inertia(x, project(previous, before), mass, 1 / 30)  # noqa: E731
    elif name == "gravity":
        energy = lambda x: gravity(x, mass, array([1.0, -9.81, 2.0]))  # noqa: E731
    elif name == "pinning":
        turn = np.stack([0.7 * rotation(rng.normal(size=3), 1) + 0.3 * rotation(rng.normal(size=3), 0.5) for _ in rest])
        blended = array(np.concatenate([turn, rng.normal(size=(len(rest), 3, 1))], axis=-1))
        energy = lambda x: pinning(unpose(blended, x), mesh.rest, 1000.0)  # noqa: E731
    else:
        body, triangles = ball(1, 0.05)
        x = rng.normal(size=rest.shape)
        x *= rng.uniform(0.04, 0.06, (len(x), 1)) / np.linalg.norm(x, axis=1, keepdims=True)
        surface, body = surface_from(x, body, triangles), array(body)

        def energy(x):
            if name == "collision_plane":
                d = plane_distance(x, body, vertex_normals(body, surface), nearest_vertex(x, body, surface)[0])
            else:
                d = triangle_distance(x, body, surface, nearest_triangle(x, body, surface)[0])
            return collision(d, 0.004, 10.0)

    compiled = jax.jit(jax.value_and_grad(energy))
    return energy, lambda x: compiled(x)[0], lambda x: compiled(x)[1], array(x)


every_energy = pytest.mark.parametrize("name", [*MESHED, *POINTWISE])
every_dtype = pytest.mark.parametrize("dtype", DTYPES)


@every_energy
@every_dtype
def test_scalar_and_force_keep_the_type(name, dtype):
    _, energy, grad, x = case(name, dtype)
    assert energy(x).shape == () and energy(x).dtype == dtype and energy(x) != 0
    assert grad(x).shape == x.shape and grad(x).dtype == dtype and jnp.all(jnp.isfinite(grad(x)))


@every_energy
def test_force_is_the_negative_gradient(name, rng):
    _, energy, grad, x = case(name, jnp.float64)
    for _ in range(3):
        v = jnp.asarray(rng.normal(size=x.shape))
        at = lambda t, v=v: energy(x + t * v)  # noqa: E731
        h = 1e-6  # m; the fourth-order difference
        difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
        np.testing.assert_allclose(jnp.vdot(grad(x), v), difference, rtol=1e-7)


@every_energy
def test_single_precision_agrees_with_double(name):
    energy, grad, x = case(name, jnp.float32)[1:]
    exact, exact_grad, _ = case(name, jnp.float64)[1:]
    np.testing.assert_allclose(float(energy(x)), float(exact(x.astype(jnp.float64))), rtol=1e-4)
    right = np.asarray(exact_grad(x.astype(jnp.float64)))
    np.testing.assert_allclose(np.asarray(grad(x)), right, atol=1e-3 * np.abs(right).max())


@pytest.mark.parametrize("name", [name for name in (*MESHED, *POINTWISE) if "collision" not in name])  # its search is compiled
def test_jit_equals_eager(name):
    eager, energy, _, x = case(name, jnp.float64)
    np.testing.assert_allclose(eager(x), energy(x), rtol=1e-12)


@every_energy
def test_vmap_equals_loop(name, rng):
    eager, energy, _, x = case(name, jnp.float64)
    batch = x[None] + 1e-4 * jnp.asarray(rng.normal(size=(3, *x.shape)))
    np.testing.assert_allclose(jax.jit(jax.vmap(eager))(batch), [energy(x) for x in batch], rtol=1e-12)


@pytest.mark.parametrize("name", MESHED)
def test_rigid_motion_costs_nothing(name):
    energy, scale = MESHED[name], SPRING if name != "bending" else BEND
    turn = rotation([1, -2, 0.5], 2.0).T
    compiled = jax.jit(energy)
    for vertices, faces in (sheet(), tube()):
        mesh = mesh_from(vertices, faces, dtype=jnp.float64)
        for x in (vertices, vertices @ turn + [0.3, 1.2, -0.4]):
            # quadratic in a strain whose rounding is 1e-14, but for neo-Hookean, where terms of the size of mu cancel
            assert abs(compiled(jnp.asarray(x), mesh)) < (1e-17 if name == "neo_hookean" else 1e-26) * scale
        bent = vertices + 2e-3 * np.random.default_rng(1).normal(size=vertices.shape)
        expected = compiled(jnp.asarray(bent), mesh)
        assert expected > 1e-7 * scale
        np.testing.assert_allclose(compiled(jnp.asarray(bent @ turn + 0.3), mesh), expected, rtol=1e-10)


# --- degenerate elements: two faces on one edge of 5 mm ---------------------------------------------------------------

EDGE: list = [[0, 0, 0], [1, 0, 0]]
FLAT = [*EDGE, [0.4, 1, 0], [0.6, -1, 0]]
DEGENERATE: dict[str, tuple[list, list]] = {  # rest, deformed
    "flat": (FLAT, FLAT),
    "flat and stretched": (FLAT, np.multiply(FLAT, 1.5).tolist()),
    "folded": (FLAT, [*EDGE, [0.4, 1, 0], [0.4, 1, 0]]),
    "folded, not mirrored": (FLAT, [*EDGE, [0.4, 1, 0], [0.7, 0.8, 0]]),
    "folded at rest, opened": ([*EDGE, [0.4, 1, 0], [0.4, 1, 0]], FLAT),
    "needle at rest": ([*EDGE, [0.4, 1e-5, 0], [0.6, -1, 0]], [*EDGE, [0.4, 2e-5, 0], [0.6, -0.8, 0.4]]),
    "needle at rest, opened": ([*EDGE, [0.4, 1e-5, 0], [0.6, -1e-5, 0]], [*EDGE, [0.4, 1e-2, 0], [0.6, 0, 1e-2]]),
    "a line but for rounding, stretched": ([*EDGE, [0.4, 1e-8, 0], [0.6, -1, 0]], np.multiply(FLAT, 100).tolist()),
    "needle made": (FLAT, [*EDGE, [0.4, 1e-6, 0], [0.6, -1e-6, 1e-6]]),
    "one face flattened to its edge": (FLAT, [*EDGE, [0.4, 0, 0], [0.6, -1, 0]]),
    "both faces flattened": (FLAT, [*EDGE, [0.4, 0, 0], [1.6, 0, 0]]),
    "edge collapsed": (FLAT, [[0, 0, 0], [0, 0, 0], [0.4, 1, 0], [0.6, -1, 0]]),
    "edge nearly collapsed": (FLAT, [[0, 0, 0], [1e-9, 0, 0], [0.4, 1, 0], [0.6, -1, 0]]),
    "all in one point": (FLAT, [[0, 0, 0]] * 4),
    "no area at rest": ([*EDGE, [0.4, 0, 0], [0.6, -1, 0]], FLAT),
    "no area at rest on either side": ([*EDGE, [0.4, 0, 0], [0.6, 0, 0]], [*EDGE, [0.4, 1, 0], [0.6, 0, 1]]),
    "doubled vertex at rest": ([[0, 0, 0], [0, 0, 0], [0.4, 1, 0], [0.6, -1, 0]], FLAT),
}


@cache
def derivatives(name):
    """Value, gradient and Hessian-vector product, compiled once for all the geometries."""

    def all_three(x, v, mesh):
        energy = lambda x: MESHED[name](x, mesh)  # noqa: E731
        gradient, curvature = jax.jvp(jax.grad(energy), (x,), (v,))
        return energy(x), gradient, curvature

    return jax.jit(all_three)


@every_dtype
@pytest.mark.parametrize("name", MESHED)
@pytest.mark.parametrize("geometry", DEGENERATE)
def test_two_derivatives_are_finite_on_degenerate_elements(name, dtype, geometry, rng):
    rest, deformed = (5e-3 * np.array(points) for points in DEGENERATE[geometry])
    mesh = mesh_from(rest, np.array([[0, 1, 2], [1, 0, 3]]), dtype=dtype)
    directions = [rng.normal(size=(4, 3)), np.eye(3)[[2, 2, 2, 2]] * [[0], [0], [1], [-1]]]
    for v in directions:
        for value in derivatives(name)(jnp.asarray(deformed, dtype), jnp.asarray(v, dtype), mesh):
            assert value.dtype == dtype and jnp.all(jnp.isfinite(value))


@every_dtype
@pytest.mark.parametrize("name", MESHED)
def test_second_derivative_at_garment_scale(name, dtype, rng):
    """Hessian-vector products against differences of float64 gradients; unscaled normals gave NaN in float32."""
    faces, rest = np.array([[0, 1, 2], [1, 0, 3]]), 5e-3 * np.array(FLAT)
    x = rest + 1e-3 * rng.normal(size=rest.shape)
    v = rng.normal(size=x.shape)
    exact = lambda x: derivatives(name)(jnp.asarray(x), jnp.asarray(v), mesh_from(rest, faces, dtype=jnp.float64))[1]  # noqa: E731
    right = np.asarray(exact(x + 1e-8 * v) - exact(x - 1e-8 * v)) / 2e-8
    got = derivatives(name)(jnp.asarray(x, dtype), jnp.asarray(v, dtype), mesh_from(rest, faces, dtype=dtype))[2]
    tolerance = 1e-6 if dtype == jnp.float64 else 1e-3
    np.testing.assert_allclose(np.asarray(got), right, atol=tolerance * np.abs(right).max())


# --- values, element by element ---------------------------------------------------------------------------------------


def by_element(name, x, rest, faces, warp):
    """The formula on one element after another, from the rest edges and a frame with the given warp direction."""
    total = 0.0
    if name == "mass_spring":
        owners: dict[tuple[int, int], float] = {}
        for face in faces.tolist():
            a, b, c = rest[face]
            area = np.linalg.norm(np.cross(b - a, c - a)) / 2
            for i in range(3):
                key = tuple(sorted((face[i], face[(i + 1) % 3])))
                owners[key] = owners.get(key, 0) + area
        for (i, j), area in owners.items():
            l0, length = np.linalg.norm(rest[i] - rest[j]), np.linalg.norm(x[i] - x[j])
            total += SPRING / 2 * (2 / np.sqrt(3) * area / l0**2) * (length - l0) ** 2
        return total
    for face in faces:
        p, q = rest[face], x[face]
        e, d = p[1:] - p[0], q[1:] - q[0]
        normal = np.cross(*e)
        area = np.linalg.norm(normal) / 2
        normal /= 2 * area
        u = warp - normal * (warp @ normal)
        u /= np.linalg.norm(u)
        frame = np.stack([u, np.cross(normal, u)])
        f = d.T @ np.linalg.inv(frame @ e.T)  # (3, 2)
        if name == "baraff_witkin":
            wu, wv = f.T
            stretch = (np.linalg.norm(wu) - 1) ** 2 + (np.linalg.norm(wv) - 1) ** 2
            total += area * (STRETCH * stretch + SHEAR * (wu @ wv) ** 2)
        elif name == "stvk":
            g = (f.T @ f - np.eye(2)) / 2
            total += area * (MU * np.sum(g * g) + LAM / 2 * np.trace(g) ** 2)
        else:
            j = np.sqrt(np.linalg.det(f.T @ f))
            total += area * (MU / 2 * (np.sum(f * f) - 2) - MU * (j - 1) + (LAM + MU) / 2 * (j - 1) ** 2)
    return total


@pytest.mark.parametrize("name", MEMBRANES)
def test_membranes_against_their_formula(name, rng):
    rest, faces = tube()
    x = rest + 2e-3 * rng.normal(size=rest.shape)
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    right = by_element(name, x, rest, faces, np.array([0.0, 1, 0]))
    np.testing.assert_allclose(jax.jit(MESHED[name])(jnp.asarray(x), mesh), right, rtol=1e-10)


@pytest.mark.parametrize("name", MEMBRANES)
def test_membranes_do_not_depend_on_the_resolution(name):
    """The same even stretch and shear of the same piece of cloth costs the same on a mesh twice as fine."""
    deform = np.array([[1.1, 0.05, 0], [0, 0.93, 0], [0.02, 0, 1]])
    for make in (sheet, equilateral):
        coarse, fine = (
            jax.jit(MESHED[name])(jnp.asarray(vertices @ deform.T), mesh_from(vertices, faces, dtype=jnp.float64))
            for vertices, faces in (make(5, 7, 0.01), make(9, 13, 0.005))
        )
        np.testing.assert_allclose(coarse, fine, rtol=1e-9)


def test_bending_does_not_depend_on_the_resolution():
    def rolled(rows, columns, spacing):
        vertices, faces = sheet(rows, columns, spacing)
        x, y = vertices[:, 0] / 0.03, vertices[:, 1]
        bent = np.stack([0.03 * np.sin(x), y, 0.03 * np.cos(x)], axis=-1)
        mesh = mesh_from(vertices, faces, dtype=jnp.float64)
        return jax.jit(bending)(jnp.asarray(bent), mesh, BEND)

    # halving the edges halves the change that is left: the border, whose edges are no hinges, is that much narrower
    values = [float(rolled(4 * n + 1, 4 * n + 1, 0.02 / n)) for n in (1, 2, 4)]
    assert abs(values[2] / values[1] - 1) < 0.6 * abs(values[1] / values[0] - 1) < 0.2


# --- springs ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strain", [[[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 0.5], [0.5, 0]], [[1, 0.2], [0.2, -0.6]]])
def test_springs_of_an_equilateral_mesh_are_an_isotropic_membrane(strain):
    """lambda = mu = sqrt(3)/4 k, for every small strain."""
    vertices, faces = equilateral()
    size = 1e-5
    stretched = vertices.copy()
    stretched[:, :2] = vertices[:, :2] @ (np.eye(2) + size * np.array(strain)).T
    mesh = mesh_from(vertices, faces, dtype=jnp.float64)
    modulus = np.sqrt(3) / 4 * SPRING
    x = jnp.asarray(stretched)
    np.testing.assert_allclose(jax.jit(mass_spring)(x, mesh, SPRING), jax.jit(stvk)(x, mesh, modulus, modulus), rtol=1e-4)


# --- St. Venant-Kirchhoff and neo-Hookean -----------------------------------------------------------------------------


def images(f):
    """Columns of a 2x2 deformation, of one face."""
    return [[*column[:, None]] for column in jnp.pad(f.T, ((0, 0), (0, 1)))]


@cache
def stiffness_along_u(density):
    def energy(s, t):
        return density(images(jnp.diag(jnp.stack([s, t]))), LAM, MU)[0]

    return jax.jit(jax.grad(jax.grad(energy)))


def test_stvk_loses_its_stiffness_below_one_over_root_three():
    stiffness = stiffness_along_u(saint.density)
    assert stiffness(0.999 / np.sqrt(3), 1.0) < 0 < stiffness(1.001 / np.sqrt(3), 1.0)


def test_neo_hookean_keeps_its_stiffness():
    stiffness = stiffness_along_u(neo.density)
    for s in (1e-3, 0.1, 0.3, 0.5, 1.0, 2.0):
        for t in (0.1, 1.0, 2.0):
            np.testing.assert_allclose(stiffness(s, t), MU + (LAM + MU) * t**2, rtol=1e-9)


@pytest.mark.parametrize("ratio", [0.1, 1.0, LAM / MU, 10.0])
def test_neo_hookean_resists_compression_with_free_width_down_to_half(ratio):
    def force(s):
        """Along the length, at the width whose own force vanishes."""
        t = s * (ratio + 2) / (1 + (ratio + 1) * s * s)
        f = jax.grad(lambda f: neo.density(images(f), ratio, 1.0)[0])(jnp.diag(jnp.stack([s, t])))
        return f[0, 0], f[1, 1]

    along, across = jax.jit(jax.vmap(force))(jnp.linspace(0.45, 2, 100))
    np.testing.assert_allclose(across, 0, atol=1e-12 * (1 + ratio))
    assert jnp.all(jnp.diff(along) > 0)


def test_neo_hookean_is_stvk_near_rest(rng):
    h = rng.normal(size=(2, 2))
    differences, energies = [], []
    for size in (1e-2, 1e-3):
        w = images(jnp.asarray(np.eye(2) + size * h))
        a, b = saint.density(w, LAM, MU)[0], neo.density(w, LAM, MU)[0]
        differences.append(float(abs(a - b)))
        energies.append(float(a))
    assert 90 < energies[0] / energies[1] < 110  # second order
    assert 700 < differences[0] / differences[1] < 1400  # third


# --- bending ----------------------------------------------------------------------------------------------------------


def hinge(angle):
    x = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -np.cos(angle), np.sin(angle)]]) * 0.01
    return x, np.array([[0, 1, 2], [1, 0, 3]])


@pytest.mark.parametrize(
    ("rest", "now", "change"),
    [
        (0, 0.7, 0.7),
        (0, -0.7, 0.7),
        (0.4, 0.4, 0),
        (0.4, -0.4, 0.8),  # its mirror image is not its rest shape
        (0, np.pi, np.pi),
        (3.0, -3.0, 2 * np.pi - 6),  # through itself, the short way
        (-3.0, 3.0, 2 * np.pi - 6),
        (-2.0, 2.0, 2 * np.pi - 4),
    ],
)
def test_bending_is_quadratic_in_the_signed_change_of_angle(rest, now, change):
    vertices, faces = hinge(rest)
    mesh = mesh_from(vertices, faces, dtype=jnp.float64)
    area = 2 * 0.5 * 0.01**2
    right = BEND * 0.01**2 / (8 * area) * change**2
    np.testing.assert_allclose(jax.jit(bending)(jnp.asarray(hinge(now)[0]), mesh, BEND), right, rtol=1e-9, atol=1e-30)


def test_bending_pulls_mirrored_folds_in_opposite_directions():
    vertices, faces = hinge(0.3)
    mesh = mesh_from(vertices, faces, dtype=jnp.float64)
    pull = [float(jax.jit(jax.grad(bending))(jnp.asarray(hinge(a)[0]), mesh, BEND)[3, 2]) for a in (0.1, 0.5)]
    assert pull[0] < 0 < pull[1]


# --- gravity, inertia, pinning ----------------------------------------------------------------------------------------


def test_gravity_in_any_direction(rng):
    mass = jnp.asarray(rng.uniform(1, 2, 5))
    g = jnp.asarray(rng.normal(size=3))
    x = jnp.asarray(rng.normal(size=(5, 3)))
    np.testing.assert_allclose(gravity(x, mass, g), -np.sum(np.asarray(mass)[:, None] * np.asarray(x) * np.asarray(g)[None]))
    np.testing.assert_allclose(-jax.grad(gravity)(x, mass, g), mass[:, None] * g[None], rtol=1e-14)


def test_inertia_is_the_mass_times_the_missing_acceleration(rng):
    x, previous, before = jnp.asarray(rng.normal(size=(3, 5, 3)))
    mass, dt = jnp.asarray(rng.uniform(1, 2, 5)), 0.02
    acceleration = (x - 2 * previous + before) / dt**2
    force = jax.grad(inertia)(x, project(previous, before), mass, dt)
    np.testing.assert_allclose(force, mass[:, None] * acceleration, rtol=1e-9)
    assert inertia(project(previous, before), project(previous, before), mass, dt) == 0
    # a step of another length than the last one
    np.testing.assert_allclose(project(previous, before, 0.5), 1.5 * previous - 0.5 * before, rtol=1e-12)


def test_pinning_is_zero_where_skinning_alone_would_put_the_pins(rng):
    rest = jnp.asarray(rng.normal(size=(4, 3)))
    assert pinning(rest, rest, 1000.0) == 0
    np.testing.assert_allclose(pinning(rest + 0.01, rest, 1000.0), 1000 * 12 * 1e-4, rtol=1e-9)

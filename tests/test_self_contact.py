"""Self-contact: distances against least squares, the search against every pair, the law against differences, and safe steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from ncs_jax.energies.contact.intersections import intersecting
from ncs_jax.energies.contact.pairs import corners_of, edge_weights, groups_from, nearby_pairs, point_weights, separation
from ncs_jax.energies.contact.safe_steps import free_share, limit_approach, swept_share
from ncs_jax.energies.contact.self_contact import barrier, blocks, energy, gradient, product, repulsion, self_contact
from ncs_jax.geometry.mesh import mesh_from

from .conftest import OPTIMISED
from .shapes import rotation, sheet

EPS, K = 0.003, 50.0
DTYPES = [jnp.float32, jnp.float64]
every_dtype = pytest.mark.parametrize("dtype", DTYPES)


def two(rows=9, columns=9, gap=0.002):
    """Two sheets, one over the other, their meshes shifted and turned so that nothing lies on anything."""
    x, faces = sheet(rows, columns, 0.01)
    over = (x - x.mean(axis=0)) @ rotation([0, 0, 1], 0.4).T + x.mean(axis=0) + [0.0023, 0.0031, gap]
    return np.concatenate([x, over]), np.concatenate([faces, faces + len(x)])


# Every shape is one of the two sheets' mesh, the second often a metre away, so that all of them run the same programs.
SHEETS, FACES = two()
UPPER = np.arange(len(SHEETS)) >= len(SHEETS) // 2
FLAT = SHEETS + UPPER[:, None] * [0, 0, 1.0]


def folded():
    """The lower sheet folded over itself across its middle, its halves 2 mm apart."""
    radius, middle = 0.001, FLAT[~UPPER, 0].mean() + 0.0012
    along = FLAT[:, 0] - middle
    angle = np.clip(along / radius, 0, np.pi)
    x = np.stack(
        [np.where(along < 0, along, np.where(angle < np.pi, radius * np.sin(angle), -along + np.pi * radius)),
         FLAT[:, 1], radius * (1 - np.cos(angle))], axis=1,
    )  # fmt: skip
    return np.where(UPPER[:, None], FLAT, x)


def pipe(flattened):
    """The lower sheet rolled up so that its columns are all the way round; its halves mirror each other."""
    angle, radius = 2 * np.pi * FLAT[:, 0] / 0.09, 0.09 / (2 * np.pi)
    x = np.stack([radius * np.cos(angle), FLAT[:, 1], flattened * radius * np.sin(angle)], axis=1)
    return np.where(UPPER[:, None], FLAT, x)


def poses():
    """Of cloth that rests flat."""
    rng = np.random.default_rng(3)
    return {
        "sheets 2 mm apart": SHEETS,
        "sheets that pass through each other": SHEETS @ np.diag([1, 1, 0]) + 0.001 * rng.normal(size=SHEETS.shape),
        "folded": folded() + 1e-4 * rng.normal(size=SHEETS.shape),  # nothing in it is parallel
        "at rest": FLAT,
        "crumpled": 0.6 * FLAT + 0.003 * rng.normal(size=SHEETS.shape),
        "flattened pipe": pipe(0.03),
        "far from the origin": SHEETS + [5.0, -3.0, 8.0],
    }


every_pose = pytest.mark.parametrize("pose", poses())


FUNCTIONS: dict[str, Callable] = {
    "pairs": nearby_pairs,
    "through": intersecting,
    "slope": jax.value_and_grad(self_contact),
    "curvature": lambda x, v, *others: jax.jvp(lambda x: jax.grad(self_contact)(x, *others), (x,), (v,))[1],
    "repulsion": repulsion,
    "free": free_share,
    "swept": swept_share,
    "limit_approach": limit_approach,
    "point": point_weights,
    "edge": edge_weights,
}
compiled = {name: jax.jit(function) for name, function in FUNCTIONS.items()}


@cache
def meshed(dtype=jnp.float64):
    mesh = mesh_from(FLAT, FACES, dtype=dtype)
    return mesh, groups_from(mesh)


def near(x, mesh, groups, radius):
    x = jnp.asarray(x)
    return compiled["pairs"](x, mesh, groups, np.asarray(radius, x.dtype))


def searched(pose, dtype=jnp.float64, radius=EPS):
    mesh, groups = meshed(dtype)
    x = jnp.asarray(poses()[pose], dtype)
    return x, mesh, groups, near(x, mesh, groups, radius)


# --- distances ----------------------------------------------------------------------------------------------------------


def distance(kind, corners):
    p = np.moveaxis(corners, 0, -1)
    weights = np.asarray(compiled[kind](p))
    assert np.isfinite(weights).all() and weights.dtype == p.dtype
    np.testing.assert_allclose(weights.sum(axis=0), 0, atol=1e-6 if p.dtype == np.float32 else 1e-14)
    return np.linalg.norm(np.einsum("wp,wcp->cp", weights[1:], p[1:] - p[:1]), axis=0)


def test_the_separation_of_many_pairs_in_single_precision():
    """As NumPy finds it: compiled, and of more pairs than a small garment has."""
    rng = np.random.default_rng(3)
    p, weights = (rng.normal(size=shape).astype(np.float32) for shape in ((4, 3, 40_000), (4, 40_000)))
    expected = np.einsum("wp,wcp->cp", weights[1:], p[1:] - p[:1])
    np.testing.assert_allclose(jax.jit(separation)(p, weights), expected, atol=1e-5)


def special():
    """Corners (cases, 4, 3): ordinary, parallel, crossing, collapsed, touching and far."""
    rng = np.random.default_rng(1)
    some = rng.normal(size=(300, 4, 3))
    flat = rng.normal(size=(50, 4, 3)) * [1, 1, 0]
    u = rng.normal(size=(50, 3))
    parallel = np.stack([0 * u, u, u * rng.normal(size=(50, 1)) + 0.3, 0 * u], axis=1)
    parallel[:, 3] = parallel[:, 2] + u * rng.normal(size=(50, 1))
    point = np.repeat(rng.normal(size=(5, 1, 3)), 4, axis=1)
    needle = some[:20].copy()
    needle[:, 3] = needle[:, 2]
    pins = some[20:40].copy()
    pins[:, 1] = pins[:, 0]
    touching = some[40:60].copy()
    touching[:, 0] = touching[:, 1:].mean(axis=1)
    line = np.cumsum(np.ones((3, 4, 3)), axis=1)
    return np.concatenate([some, flat, parallel, point, needle, pins, touching, line])


def test_the_distance_of_two_edges_is_the_least():
    corners = special()
    least = []
    for a, b, c, d in corners:
        found = lsq_linear(np.stack([b - a, c - d], axis=1), c - a, (0, 1), method="bvls", tol=1e-15)
        least.append(np.linalg.norm(found.fun))
    np.testing.assert_allclose(distance("edge", corners), least, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(distance("edge", corners.astype(np.float32)), least, rtol=1e-4, atol=1e-5)


def test_the_distance_of_a_point_and_a_triangle_is_the_least():
    corners = special()
    least = []
    for p, *triangle in corners:  # the weights are not negative, and add up to one
        columns = np.concatenate([np.transpose(triangle) - p[:, None], np.full((1, 3), 1e4)])
        weights = nnls(columns, np.array([0, 0, 0, 1e4]))[0]
        least.append(np.linalg.norm(weights / weights.sum() @ (np.array(triangle) - p)))
    np.testing.assert_allclose(distance("point", corners), least, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(distance("point", corners.astype(np.float32)), least, rtol=1e-4, atol=1e-5)


# --- search -------------------------------------------------------------------------------------------------------------


def every_pair(x, mesh, radius):
    """By holding everything against everything."""
    faces, edges = np.asarray(mesh.faces), np.asarray(mesh.edges)
    v, f = np.meshgrid(np.arange(len(x)), np.arange(len(faces)), indexing="ij")
    points = np.concatenate([v.reshape(-1, 1), faces[f.reshape(-1)]], axis=1)
    i, j = np.triu_indices(len(edges), 1)
    sides = np.concatenate([edges[i], edges[j]], axis=1)
    found = []
    for kind, pairs, k in (("point", points, 1), ("edge", sides, 2)):
        pairs = pairs[~np.any(pairs[:, :k, None] == pairs[:, None, k:], axis=(1, 2))]
        touching = distance(kind, x[pairs]) < radius
        found.append({name(row, k) for row in pairs[touching].tolist()})
    return found


def name(row, k):
    """Of a pair, whatever the order of its edges."""
    return (row[0], *row[1:]) if k == 1 else tuple(sorted([tuple(row[:2]), tuple(row[2:])]))


def listed(pairs, k):
    rows = np.asarray(pairs.points if k == 1 else pairs.edges)
    rows = rows[rows.any(axis=1)].tolist()
    names = {name(row, k) for row in rows}
    assert len(names) == len(rows), "a pair is there twice"
    return names


@every_pose
@every_dtype
@pytest.mark.parametrize("radius", [EPS, 0.008])
def test_the_search_finds_every_pair_once(pose, dtype, radius):
    x, mesh, _, pairs = searched(pose, dtype, radius)
    points, edges = every_pair(np.asarray(x), mesh, radius)
    assert bool(pairs.overflow) == (len(points) > len(pairs.points) or len(edges) > len(pairs.edges))
    if not pairs.overflow:
        assert listed(pairs, 1) == points and listed(pairs, 2) == edges
    if pose != "at rest":
        assert points and edges
    assert pairs.rest.dtype == dtype


def test_a_list_that_is_too_short_says_so():
    for shape, overflow in ((FLAT, False), (FLAT * 1e-3, True)):
        assert bool(near(shape, *meshed(), EPS).overflow) is overflow


def test_many_garments_at_once():
    x, mesh, groups, _ = searched("folded")
    batch = np.stack([x, 0.9 * np.asarray(x), mesh.rest])
    together = jax.jit(jax.vmap(lambda x: nearby_pairs(x, mesh, groups, EPS)))(batch)
    for i in range(3):
        alone = near(batch[i], mesh, groups, EPS)
        np.testing.assert_array_equal(together.points[i], alone.points)
        np.testing.assert_array_equal(together.edges[i], alone.edges)
        np.testing.assert_allclose(together.rest[i], alone.rest, rtol=1e-14)


# --- energy -------------------------------------------------------------------------------------------------------------

PRESSED = ["sheets 2 mm apart", "sheets that pass through each other", "folded", "crumpled"]


@pytest.mark.parametrize("pose", PRESSED)
def test_the_force_is_the_negative_gradient(pose, rng):
    x, mesh, groups, _ = searched(pose)
    pairs = near(x, mesh, groups, 1.1 * EPS)
    value, slope = compiled["slope"](x, pairs, EPS, K)
    assert value > 0
    for _ in range(3):
        v = rng.normal(size=x.shape)
        at = lambda t, v=v: compiled["slope"](np.asarray(x) + t * v, pairs, EPS, K)[0]  # noqa: E731
        h = 1e-8  # m; small against the distances of what passes through, where the law bends most
        np.testing.assert_allclose(np.vdot(slope, v), (at(h) - at(-h)) / (2 * h), rtol=1e-5)


@jax.jit  # in one program, so that both see the same rounding of the distances, which the barrier makes great
def by_hand_and_not(x, pairs):
    found = repulsion(x, pairs, EPS)
    return energy(found, K), gradient(found, x, K), *jax.value_and_grad(self_contact)(x, pairs, EPS, K)


@every_dtype
@every_pose
def test_what_a_newton_step_needs_is_what_the_energy_says(pose, dtype):
    x, _, _, pairs = searched(pose, dtype)
    by_hand, forces, value, slope = by_hand_and_not(x, pairs)
    assert slope.dtype == forces.dtype == value.dtype == by_hand.dtype == dtype
    tight = 1e-5 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(by_hand, value, rtol=tight)
    np.testing.assert_allclose(forces, slope, rtol=0, atol=tight * np.abs(slope).max())


@jax.jit
def barriers(s):
    """The barrier with its derivatives, and those of its value and slope by differentiation."""
    return *barrier(s), *(jax.vmap(jax.grad(lambda s, i=i: barrier(s)[i]))(s) for i in (0, 1))


@every_dtype
def test_the_barrier_and_its_derivatives(dtype):
    """The published function down to a hundredth, its parabola below; nothing from one on; and no steps in between."""
    s = np.concatenate([[0, 0.005, 0.01, 0.0101, 0.999, 1, 1.001, 50], np.linspace(0.02, 0.98, 49)])
    value, slope, curvature, by_value, by_slope = (np.asarray(a) for a in barriers(jnp.asarray(s, dtype)))
    law = np.where(s < 1, -((1 - s) ** 2) * np.log(np.maximum(s, 1e-9)), 0)
    tight = 1e-5 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(value[2:], law[2:], rtol=tight, atol=tight)
    np.testing.assert_allclose(slope, by_value, rtol=10 * tight, atol=tight)
    apart = np.abs(s - 0.01) > 1e-6
    np.testing.assert_allclose(curvature[apart], by_slope[apart], rtol=100 * tight, atol=10 * tight)
    assert np.all(slope <= 0) and np.all(curvature >= 0)
    inside = s < 1
    assert np.all(np.diff(value[inside][np.argsort(s[inside])]) < 0)
    assert not value[~inside].any() and not slope[~inside].any() and not curvature[~inside].any()


def test_the_product_is_that_of_the_second_derivative_along_the_distances(rng):
    """J^T diag(E'') J of the distances' derivatives J; the blocks are those on its diagonal."""
    x, _, _, pairs = searched("sheets 2 mm apart")
    second = jax.vmap(jax.grad(jax.grad(lambda d, e: K * e**2 * barrier(d / e)[0])))

    @jax.jit
    def both(x, p, pairs):
        found, keep = repulsion(x, pairs, EPS), jnp.minimum(EPS, pairs.rest)
        rows = jax.jacfwd(distances)(x, pairs).reshape(-1, x.size)
        curvature = jnp.where(keep > 0, second(distances(x, pairs), jnp.where(keep > 0, keep, 1.0)), 0)
        return rows, curvature, product(found, p, K), blocks(found, x, K)

    p = rng.normal(size=x.shape)
    rows, curvature, along, on_diagonal = jax.device_get(both(x, p, pairs))
    dense = rows.T @ (curvature[:, None] * rows)
    assert dense.max() > 10
    np.testing.assert_allclose(along.reshape(-1), dense @ p.reshape(-1), rtol=0, atol=1e-9 * dense.max())
    diagonal = np.einsum("vivj->vij", dense.reshape(len(x), 3, len(x), 3))
    np.testing.assert_allclose(on_diagonal, diagonal, rtol=0, atol=1e-9 * dense.max())


def distances(x, pairs):
    """Of all pairs, with the closest points held."""
    halves = []
    for weigh, vertices in ((point_weights, pairs.points), (edge_weights, pairs.edges)):
        p = corners_of(x, vertices)
        apart = separation(p, jax.lax.stop_gradient(weigh(p)))
        square = jnp.sum(apart * apart, axis=0)
        halves.append(jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0))
    return jnp.concatenate(halves)


@pytest.mark.parametrize("pose", PRESSED)
def test_action_is_reaction(pose):
    x, _, _, pairs = searched(pose)
    force = np.asarray(compiled["slope"](x, pairs, EPS, K)[1])
    scale = np.abs(force).sum()
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12 * scale)
    np.testing.assert_allclose(np.cross(x, force).sum(axis=0), 0, atol=1e-12 * scale)


def test_the_garment_rests_at_rest():
    """Even where it is thicker than its own mesh; and a smaller one feels its thickness."""
    x, mesh, groups, _ = searched("at rest")
    for thickness in (0.009, 0.012):
        pairs = near(x, mesh, groups, thickness)
        assert np.asarray(pairs.points).any() or thickness < 0.01
        found = compiled["repulsion"](x, pairs, thickness)
        assert np.max(found.value) < 1e-30
    smaller = 0.9 * np.asarray(x)
    pairs = near(smaller, mesh, groups, 0.012)
    assert compiled["slope"](smaller, pairs, 0.012, K)[0] > 0


def test_the_energy_has_no_steps():
    """Two sheets slide over and through each other: where it changes most abruptly, it is no steeper than springs."""
    x, faces = two(5, 5)
    half = len(x) // 2
    mesh = mesh_from(x + (np.arange(len(x)) >= half)[:, None], faces, dtype=jnp.float64)
    groups = groups_from(mesh)
    move = np.zeros_like(x)
    move[half:] = [0.008, 0.003, -0.0045]

    def value(t):
        there = jnp.asarray(x) + t * jnp.asarray(move)
        pairs = nearby_pairs(there, mesh, groups, EPS)
        return self_contact(there, pairs, EPS, K), jnp.sum(pairs.rest > 0), pairs.overflow

    compiled_along = jax.jit(partial(jax.lax.map, value), compiler_options=OPTIMISED)

    def along(path):
        """In pieces of 67, for which there is a program."""
        return [np.concatenate(found) for found in zip(*map(compiled_along, path.reshape(-1, 67)), strict=True)]

    path = np.linspace(0, 1, 201)
    values, counts, overflow = along(path)
    assert not overflow.any()
    assert len(np.unique(counts)) > 20  # pairs come and go on the way
    for start in path[np.argsort(-np.abs(np.diff(values, 2)))[:2]]:
        for length, points in ((2e-2, 201), (2e-4, 67), (6e-6, 67), (2e-7, 67)):  # ever closer: a step stays, a slope does not
            part = start + length * np.linspace(0, 1, points)
            values = along(part)[0]
            start = part[max(np.argmax(np.abs(np.diff(values))) - 1, 0)]
        # all pairs at once may pull with -B'(0) k eps; one that came or went with a step would make one of about k eps^2
        steepest = -float(barrier(jnp.zeros(1))[1][0]) * K * EPS * np.linalg.norm(move[-1]) * float(counts.max())
        assert np.abs(np.diff(values)).max() < steepest * length / 66 < K * EPS**2 / 100


@every_dtype
@pytest.mark.parametrize("shape", ["in one point", "in one plane", "on one line", "on itself"])
def test_degenerate_cloth_has_finite_forces(shape, dtype):
    squeeze = {"in one point": [0, 0, 0], "in one plane": [1, 1, 0], "on one line": [1, 0, 0], "on itself": [1, 1, 1]}[shape]
    x = SHEETS * squeeze
    if shape == "on itself":
        x[UPPER] = x[~UPPER]
    x = jnp.asarray(x, dtype)
    pairs = near(x, *meshed(dtype), EPS)
    assert np.asarray(pairs.points).any() and np.asarray(pairs.edges).any()
    value, slope = compiled["slope"](x, pairs, EPS, K)
    assert np.isfinite(value) and np.isfinite(slope).all()
    v = jnp.asarray(np.random.default_rng(4).normal(size=x.shape), dtype)
    assert np.isfinite(compiled["curvature"](x, v, pairs, EPS, K)).all()


def test_two_sheets_are_pushed_apart():
    x, _, _, pairs = searched("sheets 2 mm apart")
    force = -np.asarray(compiled["slope"](x, pairs, EPS, K)[1])
    assert force[UPPER, 2].sum() > 1 and force[~UPPER, 2].sum() < -1


# --- safe steps and intersections ---------------------------------------------------------------------------------------


def through(x, mesh, groups):
    marked, overflow = compiled["through"](jnp.asarray(x), mesh, groups)
    assert not overflow
    return np.asarray(marked)


@pytest.mark.parametrize("pose", ["sheets 2 mm apart", "folded", "flattened pipe"])
def test_no_step_that_is_let_through_makes_an_intersection(pose, rng):
    x, (mesh, groups), radius, harm, swept = poses()[pose], meshed(), 0.004, 0, 0
    assert not through(x, mesh, groups).any()
    for trial in range(12):
        here = x
        for _ in range(4):  # one after the other, so that cloth comes near cloth
            size = 10.0 ** rng.uniform(-3.5, -1)
            p = size * rng.normal(size=x.shape if trial % 2 else (1, 3)) * rng.normal(size=(len(x), 1))
            pairs = near(here, mesh, groups, radius)
            assert not pairs.overflow
            t = compiled["free"](here, p, pairs, radius)
            wide, full = compiled["swept"](here, p, mesh, groups)
            assert 0 < t <= 1 and 0 < wide <= 1
            if not full:  # a way across all cloth sweeps all of it
                swept += 1
                assert not through(here + float(wide) * p, mesh, groups).any()
            harm += bool(compiled["through"](here + p, mesh, groups)[0].any())
            here = here + float(t) * p
            assert not through(here, mesh, groups).any()
    assert harm > 10 and swept > 10  # of the whole moves


def test_a_step_is_not_shorter_than_it_must_be():
    """One vertex flies at the triangle under it; all cloth flies together; and nothing that is `radius` away is hit unseen."""
    x, vertex = FLAT.copy(), np.flatnonzero(UPPER)[0]
    x[vertex] = FLAT[FACES[0]].mean(axis=0) + [0, 0, 0.003]
    down = np.zeros_like(x)
    down[vertex, 2] = -1.0
    pairs, free = near(x, *meshed(), 0.01), compiled["free"]
    np.testing.assert_allclose(free(x, 0.004 * down, pairs, 0.01), 0.9 * 0.003 / 0.004, rtol=1e-12)
    np.testing.assert_allclose(free(x, 0.002 * down, pairs, 0.01), 1, rtol=1e-12)
    np.testing.assert_allclose(free(x, np.full_like(x, 7.0), pairs, 0.01), 1, rtol=1e-12)
    nothing = near(x, *meshed(), 0.002)
    assert not np.asarray(nothing.points).any()
    np.testing.assert_allclose(free(x, 0.004 * down, nothing, 0.002), 0.9 * 0.002 / 0.004, rtol=1e-12)


def test_only_cloth_that_would_collide_gives_way():
    """Both sheets fly to the side, and one corner of the upper one down through the lower."""
    x, (mesh, groups) = SHEETS, meshed()
    pairs = near(x, mesh, groups, 0.004)
    corner = np.exp(-np.sum((x[UPPER, :2] - x[UPPER][0, :2]) ** 2, axis=1) / 0.02**2)
    p = np.tile([0.3, -0.2, 0.1], (len(x), 1))
    np.testing.assert_allclose(compiled["limit_approach"](x, p, pairs), p, rtol=0, atol=1e-15)
    p[UPPER, 2] -= 0.02 * corner
    free = compiled["free"]
    assert free(x, p, pairs, 1.0) < 0.15 and through(x + p, mesh, groups).any()
    way = np.asarray(compiled["limit_approach"](x, p, pairs))
    assert free(x, way, pairs, 1.0) > 0.9 and not through(x + way, mesh, groups).any()
    far = np.flatnonzero(UPPER)[corner < 1e-3]
    assert len(far) > 20
    np.testing.assert_allclose(way[far], p[far], rtol=0, atol=1e-3)


def every_intersection(x, mesh):
    """Faces through which an edge goes, and the faces of that edge, where they share no vertex."""
    faces = np.asarray(mesh.faces)
    marked = np.zeros(len(faces), bool)
    volume = lambda a, b, c, d: np.sign(np.linalg.det(np.stack([b - a, c - a, d - a])))  # noqa: E731
    for i, f in enumerate(faces):
        for j, g in enumerate(faces):
            if set(f) & set(g):
                continue
            a, b, c = x[g]
            for p, q in zip(x[f], x[np.roll(f, -1)], strict=True):
                if volume(a, b, c, p) * volume(a, b, c, q) < 0:
                    around = {volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)}
                    marked[[i, j]] |= around in ({1.0}, {-1.0})
    return marked


def test_intersections_against_every_pair_of_triangles(rng):
    rest, faces = sheet(6, 6, 0.01)
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    for scale in (0.002, 0.005, 0.02):
        x = rest + scale * rng.normal(size=rest.shape)
        right = every_intersection(x, mesh)
        np.testing.assert_array_equal(through(x, mesh, groups_from(mesh)), right)
    assert right.sum() > 20


@pytest.mark.parametrize("dtype", DTYPES)
def test_sheets_that_cross_and_a_fold_that_does_not(dtype):
    """One sheet stands upright on the line x = 34 mm of another, which meets two triangles of each of eight cells of both."""
    flat, (mesh, groups) = FLAT[~UPPER], meshed(dtype)
    upright = np.stack([np.full(81, 0.034), flat[:, 1], flat[:, 0] - 0.0437], axis=1)
    count = lambda *x: through(jnp.asarray(np.concatenate(x), dtype), mesh, groups).sum()  # noqa: E731
    assert count(flat, upright) == 2 * 8 + 2 * 8
    assert count(flat, upright + [0, 0, 0.1]) == 0
    assert count(flat, flat + [0, 0, 1e-4]) == 0
    assert count(FLAT) == 0
    x = folded()
    assert count(x) == 0
    upper = (x[:, 2] > 1.5e-3) & ~UPPER
    x[upper, 2] += 0.1 * (x[upper, 0] + 0.0045)  # it now slopes down through the lower half, 24.5 mm from the fold
    x[upper, 1] += 3e-4
    assert count(x) == 2 * 8 + 2 * 8

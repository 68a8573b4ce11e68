"""Self-contact: distances against least squares, the search against every pair, the law against differences, and safe steps."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from ncs_jax.energies.contact.intersections import intersecting
from ncs_jax.energies.contact.pairs import corners_of, edge_weights, groups_from, nearby_pairs, point_weights, separation
from ncs_jax.energies.contact.safe_steps import free_share, swept_share, yielding
from ncs_jax.energies.contact.self_contact import barrier, blocks, energy, gradient, product, repulsion, self_contact
from ncs_jax.geometry.mesh import mesh_from

from .conftest import OPTIMISED
from .shapes import rotation, sheet, tube

EPS, K = 0.003, 50.0
DTYPES = [jnp.float32, jnp.float64]
every_dtype = pytest.mark.parametrize("dtype", DTYPES)


def two(rows=9, columns=9, gap=0.002):
    """Two sheets, one over the other, their meshes shifted and turned so that nothing lies on anything."""
    x, faces = sheet(rows, columns, 0.01)
    over = (x - x.mean(axis=0)) @ rotation([0, 0, 1], 0.4).T + x.mean(axis=0) + [0.0023, 0.0031, gap]
    return np.concatenate([x, over]), np.concatenate([faces, faces + len(x)])


def folded(rows=9, columns=14):
    """A sheet that is folded over itself across its middle, its halves 2 mm apart; in which shape it does not rest."""
    rest, faces = sheet(rows, columns, 0.01)
    radius, middle = 0.001, rest[:, 0].mean() + 0.0012
    along = rest[:, 0] - middle
    angle = np.clip(along / radius, 0, np.pi)
    x = np.stack(
        [np.where(along < 0, along, np.where(angle < np.pi, radius * np.sin(angle), -along + np.pi * radius)),
         rest[:, 1], radius * (1 - np.cos(angle))], axis=1,
    )  # fmt: skip
    return rest, x, faces


def poses():
    """Rest shape, positions and faces."""
    rng = np.random.default_rng(3)
    sheets, both = two()
    flat = sheets.copy()
    flat[81:, 2] += 1.0
    rest, bent, faces = folded()
    pipe, around = tube(16, 12, 0.03, 0.12)
    return {
        "sheets 2 mm apart": (flat, sheets, both),
        "sheets that pass through each other": (
            flat,
            sheets @ np.diag([1, 1, 0]) + 0.001 * rng.normal(size=sheets.shape),
            both,
        ),
        "folded": (rest, bent + 1e-4 * rng.normal(size=bent.shape), faces),  # nothing in it is parallel
        "at rest": (rest, rest, faces),
        "crumpled": (pipe, 0.6 * pipe + 0.003 * rng.normal(size=pipe.shape), around),
        "flattened pipe": (pipe, pipe * [1, 1, 0.03], around),
        "far from the origin": (flat, sheets + [5.0, -3.0, 8.0], both),
    }


every_pose = pytest.mark.parametrize("pose", poses())


@cache
def compiled(name):
    functions = {
        "pairs": lambda x, mesh, groups, radius: nearby_pairs(x, mesh, groups, radius),
        "through": intersecting,
        "point": point_weights,
        "edge": edge_weights,
        "energy": self_contact,
        "slope": jax.value_and_grad(self_contact),
        "repulsion": repulsion,
        "free": free_share,
        "swept": swept_share,
        "yielding": yielding,
    }
    return jax.jit(functions[name])


def searched(pose, dtype=jnp.float64, radius=EPS):
    rest, x, faces = poses()[pose]
    mesh = mesh_from(rest, faces, dtype=dtype)
    groups = groups_from(mesh)
    x = jnp.asarray(x, dtype)
    return x, mesh, groups, compiled("pairs")(x, mesh, groups, jnp.asarray(radius, dtype))


# --- distances ----------------------------------------------------------------------------------------------------------


def distance(kind, corners):
    p = jnp.asarray(np.moveaxis(corners, 0, -1))
    weights = compiled(kind)(p)
    assert jnp.all(jnp.isfinite(weights))
    np.testing.assert_allclose(jnp.sum(weights, axis=0), 0, atol=1e-6 if p.dtype == jnp.float32 else 1e-14)
    return np.linalg.norm(separation(p, weights), axis=0)


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
        p = corners_of(jnp.asarray(x), jnp.asarray(pairs))
        near = np.linalg.norm(separation(p, compiled(kind)(p)), axis=0) < radius
        found.append({name(row, k) for row in pairs[near].tolist()})
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
    rest, faces = sheet(12, 12, 0.01)
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    groups = groups_from(mesh)
    for shape, overflow in ((rest, False), (rest * 1e-3, True)):
        assert bool(compiled("pairs")(jnp.asarray(shape), mesh, groups, jnp.asarray(EPS)).overflow) is overflow


def test_many_garments_at_once():
    x, mesh, groups, _ = searched("folded")
    batch = jnp.stack([x, 0.9 * x, mesh.rest])
    together = jax.jit(jax.vmap(lambda x: nearby_pairs(x, mesh, groups, EPS)))(batch)
    for i in range(3):
        alone = compiled("pairs")(batch[i], mesh, groups, jnp.asarray(EPS))
        same = jax.tree.map(lambda a, i=i: a[i], together)
        np.testing.assert_array_equal(same.points, alone.points)
        np.testing.assert_array_equal(same.edges, alone.edges)
        np.testing.assert_allclose(same.rest, alone.rest, rtol=1e-14)


# --- energy -------------------------------------------------------------------------------------------------------------

PRESSED = ["sheets 2 mm apart", "sheets that pass through each other", "folded", "crumpled"]


@pytest.mark.parametrize("pose", PRESSED)
def test_the_force_is_the_negative_gradient(pose, rng):
    x, mesh, groups, _ = searched(pose)
    pairs = compiled("pairs")(x, mesh, groups, jnp.asarray(1.1 * EPS))
    value, slope = compiled("slope")(x, pairs, EPS, K)
    assert value > 0
    for _ in range(3):
        v = jnp.asarray(rng.normal(size=x.shape))
        at = lambda t, v=v: compiled("energy")(x + t * v, pairs, EPS, K)  # noqa: E731
        h = 1e-8  # m; small against the distances of what passes through, where the law bends most
        np.testing.assert_allclose(jnp.vdot(slope, v), (at(h) - at(-h)) / (2 * h), rtol=1e-5)


@every_dtype
@every_pose
def test_what_a_newton_step_needs_is_what_the_energy_says(pose, dtype):
    x, _, _, pairs = searched(pose, dtype)

    @jax.jit  # in one program, so that both see the same rounding of the distances, which the barrier makes great
    def both(x, pairs):
        found = repulsion(x, pairs, EPS)
        return energy(found, K), gradient(found, x, K), *jax.value_and_grad(self_contact)(x, pairs, EPS, K)

    by_hand, forces, value, slope = both(x, pairs)
    assert slope.dtype == forces.dtype == value.dtype == by_hand.dtype == dtype
    tight = 1e-5 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(by_hand, value, rtol=tight)
    np.testing.assert_allclose(forces, slope, rtol=0, atol=tight * float(jnp.max(jnp.abs(slope))))


@every_dtype
def test_the_barrier_and_its_derivatives(dtype):
    """The published function down to a hundredth, its parabola below; nothing from one on; and no steps in between."""
    s = np.concatenate([[0, 0.005, 0.01, 0.0101, 0.999, 1, 1.001, 50], np.linspace(0.02, 0.98, 49)])
    value, slope, curvature = jax.jit(barrier)(jnp.asarray(s, dtype))
    law = np.where(s < 1, -((1 - s) ** 2) * np.log(np.maximum(s, 1e-9)), 0)
    tight = 1e-5 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(value[2:], law[2:], rtol=tight, atol=tight)
    by_value = jax.jit(jax.vmap(jax.grad(lambda s: barrier(s)[0])))(jnp.asarray(s, dtype))
    np.testing.assert_allclose(slope, by_value, rtol=10 * tight, atol=tight)
    by_slope = jax.jit(jax.vmap(jax.grad(lambda s: barrier(s)[1])))(jnp.asarray(s, dtype))
    apart = np.abs(s - 0.01) > 1e-6
    np.testing.assert_allclose(curvature[apart], by_slope[apart], rtol=100 * tight, atol=10 * tight)
    assert jnp.all(slope <= 0) and jnp.all(curvature >= 0)
    inside = s < 1
    assert jnp.all(jnp.diff(value[inside][jnp.argsort(s[inside])]) < 0)
    assert not value[~inside].any() and not slope[~inside].any() and not curvature[~inside].any()


def test_the_product_is_that_of_the_second_derivative_along_the_distances(rng):
    """J^T diag(E'') J of the distances' derivatives J; the blocks are those on its diagonal."""
    x, _, _, pairs = searched("sheets 2 mm apart")
    found = compiled("repulsion")(x, pairs, EPS)
    rows = jax.jit(jax.jacfwd(distances))(x, pairs).reshape(-1, x.size)
    keep = jnp.minimum(EPS, pairs.rest)
    second = jax.jit(jax.vmap(jax.grad(jax.grad(lambda d, e: K * e**2 * barrier(d / e)[0]))))
    curvature = jnp.where(keep > 0, second(jax.jit(distances)(x, pairs), jnp.where(keep > 0, keep, 1.0)), 0)
    dense = rows.T @ (curvature[:, None] * rows)
    assert jnp.max(dense) > 10
    p = jnp.asarray(rng.normal(size=x.shape))
    np.testing.assert_allclose(product(found, p, K).reshape(-1), dense @ p.reshape(-1), rtol=0, atol=1e-9 * float(dense.max()))
    diagonal = jnp.moveaxis(jnp.diagonal(dense.reshape(len(x), 3, len(x), 3), axis1=0, axis2=2), -1, 0)
    np.testing.assert_allclose(blocks(found, x, K), diagonal, rtol=0, atol=1e-9 * float(dense.max()))


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
    force = compiled("slope")(x, pairs, EPS, K)[1]
    scale = float(jnp.sum(jnp.abs(force)))
    np.testing.assert_allclose(jnp.sum(force, axis=0), 0, atol=1e-12 * scale)
    np.testing.assert_allclose(jnp.sum(jnp.cross(x, force), axis=0), 0, atol=1e-12 * scale)


def test_the_garment_rests_at_rest():
    """Even where it is thicker than its own mesh; and a smaller one feels its thickness."""
    x, mesh, groups, _ = searched("at rest")
    for thickness in (0.009, 0.012):
        pairs = compiled("pairs")(x, mesh, groups, jnp.asarray(thickness))
        assert np.asarray(pairs.points).any() or thickness < 0.01
        found = compiled("repulsion")(x, pairs, thickness)
        assert jnp.max(found.value) < 1e-30
    smaller = 0.9 * x
    pairs = compiled("pairs")(smaller, mesh, groups, jnp.asarray(0.012))
    assert compiled("energy")(smaller, pairs, 0.012, K) > 0


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

    along = jax.jit(partial(jax.lax.map, value), compiler_options=OPTIMISED)
    path = np.linspace(0, 1, 201)
    values, counts, overflow = along(jnp.asarray(path))
    assert not overflow.any()
    assert len(np.unique(np.asarray(counts))) > 20  # pairs come and go on the way
    for start in path[np.argsort(-np.abs(np.diff(values, 2)))[:2]]:
        for length in (2e-2, 2e-4, 2e-6):  # looked at ever closer, a step stays and a slope does not
            part = start + length * np.linspace(0, 1, 201)
            values = np.asarray(along(jnp.asarray(part))[0])
            start = part[max(np.argmax(np.abs(np.diff(values))) - 1, 0)]
        # all pairs at once may pull with -B'(0) k eps; one that came or went with a step would make one of about k eps^2
        steepest = -float(barrier(jnp.zeros(1))[1][0]) * K * EPS * np.linalg.norm(move[-1]) * float(counts.max())
        assert np.abs(np.diff(values)).max() < steepest * length / 200 < K * EPS**2 / 100


@every_dtype
@pytest.mark.parametrize("shape", ["in one point", "in one plane", "on one line", "on itself"])
def test_degenerate_cloth_has_finite_forces(shape, dtype):
    rest, x, faces = poses()["sheets 2 mm apart"]
    squeeze = {"in one point": [0, 0, 0], "in one plane": [1, 1, 0], "on one line": [1, 0, 0], "on itself": [1, 1, 1]}[shape]
    x = x * squeeze
    if shape == "on itself":
        x[81:] = x[:81]
    mesh = mesh_from(rest, faces, dtype=dtype)
    pairs = compiled("pairs")(jnp.asarray(x, dtype), mesh, groups_from(mesh), jnp.asarray(EPS, dtype))
    assert np.asarray(pairs.points).any() and np.asarray(pairs.edges).any()
    value, slope = compiled("slope")(jnp.asarray(x, dtype), pairs, EPS, K)
    assert jnp.isfinite(value) and jnp.all(jnp.isfinite(slope))
    second = jax.jit(jax.jacfwd(lambda t: compiled("slope")(jnp.asarray(x, dtype) + t, pairs, EPS, K)[1]))(jnp.zeros((), dtype))
    assert jnp.all(jnp.isfinite(second))


def test_two_sheets_are_pushed_apart():
    x, _, _, pairs = searched("sheets 2 mm apart")
    force = -compiled("slope")(x, pairs, EPS, K)[1]
    assert jnp.sum(force[81:, 2]) > 1 and jnp.sum(force[:81, 2]) < -1


# --- safe steps and intersections ---------------------------------------------------------------------------------------


def through(x, mesh, groups):
    marked, overflow = compiled("through")(jnp.asarray(x), mesh, groups)
    assert not overflow
    return np.asarray(marked)


@pytest.mark.parametrize("pose", ["sheets 2 mm apart", "folded", "flattened pipe"])
def test_no_step_that_is_let_through_makes_an_intersection(pose, rng):
    rest, x, faces = poses()[pose]
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    groups, radius, harm, swept = groups_from(mesh), 0.004, 0, 0
    assert not through(x, mesh, groups).any()
    for trial in range(12):
        here = jnp.asarray(x)
        for _ in range(4):  # one after the other, so that cloth comes near cloth
            size = 10.0 ** rng.uniform(-3.5, -1)
            p = jnp.asarray(size * rng.normal(size=x.shape if trial % 2 else (1, 3)) * rng.normal(size=(len(x), 1)))
            pairs = compiled("pairs")(here, mesh, groups, jnp.asarray(radius))
            assert not pairs.overflow
            t = compiled("free")(here, p, pairs, radius)
            wide, full = compiled("swept")(here, p, mesh, groups)
            assert 0 < t <= 1 and 0 < wide <= 1
            if not full:  # a way across all cloth sweeps all of it
                swept += 1
                assert not through(here + wide * p, mesh, groups).any()
            harm += bool(compiled("through")(here + p, mesh, groups)[0].any())
            here = here + t * p
            assert not through(here, mesh, groups).any()
    assert harm > 10 and swept > 10  # of the whole moves


def test_a_step_is_not_shorter_than_it_must_be():
    """One vertex flies at the triangle under it; all cloth flies together; and nothing that is `radius` away is hit unseen."""
    x = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.02, 0.02, 0.003], [0.5, 0, 0.1], [0.5, 0.1, 0.1]])
    mesh = mesh_from(x, np.array([[0, 1, 2], [3, 4, 5]]), dtype=jnp.float64)
    x = jnp.asarray(x)
    pairs = compiled("pairs")(x, mesh, groups_from(mesh), jnp.asarray(0.01))
    down = jnp.zeros_like(x).at[3, 2].set(-1.0)
    free = compiled("free")
    np.testing.assert_allclose(free(x, 0.004 * down, pairs, 0.01), 0.9 * 0.003 / 0.004, rtol=1e-12)
    np.testing.assert_allclose(free(x, 0.002 * down, pairs, 0.01), 1, rtol=1e-12)
    np.testing.assert_allclose(free(x, jnp.full_like(x, 7.0), pairs, 0.01), 1, rtol=1e-12)
    nothing = compiled("pairs")(x, mesh, groups_from(mesh), jnp.asarray(0.002))
    assert not np.asarray(nothing.points).any()
    np.testing.assert_allclose(free(x, 0.004 * down, nothing, 0.002), 0.9 * 0.002 / 0.004, rtol=1e-12)


def test_only_cloth_that_would_collide_gives_way():
    """Both sheets fly to the side, and one corner of the upper one down through the lower."""
    rest, x, faces = poses()["sheets 2 mm apart"]
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    groups, x = groups_from(mesh), jnp.asarray(x)
    pairs = compiled("pairs")(x, mesh, groups, jnp.asarray(0.004))
    corner = np.exp(-np.sum((np.asarray(x)[81:, :2] - np.asarray(x)[81, :2]) ** 2, axis=1) / 0.02**2)
    p = np.tile([0.3, -0.2, 0.1], (len(x), 1))
    np.testing.assert_allclose(compiled("yielding")(x, jnp.asarray(p), pairs), p, rtol=0, atol=1e-15)
    p[81:, 2] -= 0.02 * corner
    free = compiled("free")
    assert free(x, jnp.asarray(p), pairs, 1.0) < 0.15 and through(x + p, mesh, groups).any()
    way = np.asarray(compiled("yielding")(x, jnp.asarray(p), pairs))
    assert free(x, jnp.asarray(way), pairs, 1.0) > 0.9 and not through(x + way, mesh, groups).any()
    far = 81 + np.flatnonzero(corner < 1e-3)
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
    flat, faces = sheet(9, 9, 0.01)
    upright = np.stack([np.full(81, 0.034), flat[:, 1], flat[:, 0] - 0.0437], axis=1)
    both = np.concatenate([faces, faces + 81])
    mesh = mesh_from(np.concatenate([flat, flat + [0, 0, 1]]), both, dtype=dtype)
    groups = groups_from(mesh)
    count = lambda upper: through(jnp.asarray(np.concatenate([flat, upper]), dtype), mesh, groups).sum()  # noqa: E731
    assert count(upright) == 2 * 8 + 2 * 8
    assert count(upright + [0, 0, 0.1]) == 0
    assert count(flat + [0, 0, 1e-4]) == 0
    rest, x, faces = folded()
    bent = mesh_from(rest, faces, dtype=dtype)
    assert through(jnp.asarray(rest, dtype), bent, groups_from(bent)).sum() == 0
    assert through(jnp.asarray(x, dtype), bent, groups_from(bent)).sum() == 0
    upper = x[:, 2] > 1.5e-3
    x[upper, 2] += 0.1 * (x[upper, 0] + 0.0045)  # it now slopes down through the lower half, 24.5 mm from the fold
    x[upper, 1] += 3e-4
    assert through(jnp.asarray(x, dtype), bent, groups_from(bent)).sum() == 2 * 8 + 2 * 8

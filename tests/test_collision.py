"""The search against every pair, and the distances and their signs against closed bodies."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.distance import plane_distance, triangle_distance
from ncs_jax.energies.contact.nearest import nearest_triangle, nearest_vertex
from ncs_jax.energies.contact.smooth import TOGETHER, blended_contact, contact_within_reach, curvatures, nearby_quadrics
from ncs_jax.energies.contact.surface import rebuild_lists, surface_from, vertex_normals
from ncs_jax.geometry.closest_point import closest_weights

from .shapes import ball, bracket, rotation, sheet, tube

# --- search -----------------------------------------------------------------------------------------------------------

CLOTH, _ = tube(24, 10, 0.12, 0.2)
CLOTH = CLOTH - [0, 0.1, 0]
BALL, TRIANGLES = ball(3)  # 642 vertices in 32 groups of at most 40: a cloth group looks at 3 of them


def poses():
    """Cloth and body: as they were grouped, and as no grouping foresaw."""
    rng = np.random.default_rng(5)
    scattered = CLOTH[rng.permutation(len(CLOTH))]
    far = rotation([1, 1, 0], 2.0).T
    crushed = BALL * [1, 0.01, 1]
    return {
        "rest": (CLOTH, BALL),
        "touching": (CLOTH * 0.84, BALL),
        "inside": (CLOTH * 0.2, BALL),
        "at the centre, all equally near": (CLOTH * 1e-3, BALL),
        "far away": (CLOTH + np.array([0, 30.0, 5.0]), BALL),
        "cloth turned against the body": (CLOTH @ far, BALL),
        "every vertex somewhere else": (scattered, BALL),
        "cloth in one point": (CLOTH * 0 + np.array([0.05, 0.11, 0.0]), BALL),
        "random cloud": (rng.normal(size=CLOTH.shape) * 0.1, BALL),
        "body crushed flat": (CLOTH, crushed),
        "body turned inside out": (CLOTH, -BALL),
        "body in one point": (CLOTH, BALL * 0),
    }


def distances_to(p, a, b, c):
    """Of points p to triangles abc, broadcast, by minimising over the barycentric coordinates: the plane, edges, corners."""
    dot = lambda u, v: np.einsum("...k,...k->...", u, v)  # noqa: E731
    normal = np.cross(b - a, c - a)
    square = dot(normal, normal)
    best, inside = np.inf, square > 0
    for q, r in ((a, b), (b, c), (c, a)):
        gap, edge = p - q, r - q
        inside = inside & (dot(gap, np.cross(normal, edge)) >= 0)
        length = dot(edge, edge)
        gap -= np.clip(dot(gap, edge) / np.where(length > 0, length, 1), 0, 1)[..., None] * edge
        best = np.minimum(best, dot(gap, gap))
    plane = np.abs(dot(p - a, normal)) / np.sqrt(np.where(square > 0, square, 1))
    best = np.sqrt(best)
    return np.where(inside, np.minimum(plane, best), best)


def all_triangle_distances(x, corners):
    """(points, triangles)"""
    return distances_to(x[:, None], *(corners[None, :, k] for k in range(3)))


def filled(points, count):
    """As many points as other tests have, the last one again and again, so that all of them run one compiled program."""
    assert len(points) <= count
    return np.concatenate([points, np.repeat(points[-1:], count - len(points), axis=0)])


@cache
def searches(kind, exact):
    function = nearest_vertex if kind == "vertex" else nearest_triangle
    return jax.jit(lambda x, body, surface: function(x, body, surface, exact=exact))


USUAL = surface_from(CLOTH, BALL, TRIANGLES)
SURFACE = replace(USUAL, vertex_lists=USUAL.vertex_lists[:14], face_lists=USUAL.face_lists[:14])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("kind", ["vertex", "triangle"])
@pytest.mark.parametrize("pose", poses())
def test_exact_search_equals_the_search_of_every_pair(kind, pose, dtype):
    x, body = (np.asarray(a, dtype).astype(np.float64) for a in poses()[pose])
    if kind == "vertex":
        distance = np.linalg.norm(x[:, None] - body[None], axis=-1)
    else:
        distance = all_triangle_distances(x, body[TRIANGLES])
    rows, best = np.arange(len(x)), distance.min(axis=1)
    # a tie may go either way, as far as the type can tell
    rounding = (2e-6 if dtype == jnp.float32 else 1e-14) * (1e-2 + np.abs(x).max())
    arrays = jnp.asarray(x, dtype), jnp.asarray(body, dtype), SURFACE
    index, _ = searches(kind, True)(*arrays)
    np.testing.assert_allclose(distance[rows, index], best, rtol=0, atol=rounding)
    if dtype == jnp.float32:
        return  # what a candidate proves in single precision, the exact search has just relied on
    # candidates alone may be wrong, but never where they say that they are proven right
    index, proven = searches(kind, False)(*arrays)
    proven = np.asarray(proven)
    np.testing.assert_allclose(distance[rows, index][proven], best[proven], rtol=0, atol=rounding)


def test_these_poses_do_defeat_the_candidates():
    """Else the test above would pass without the repair."""
    wrong, unproven = 0, 0
    for x, body in poses().values():
        index, proven = searches("vertex", False)(jnp.asarray(x), jnp.asarray(body), SURFACE)
        distance = np.linalg.norm(x[:, None] - body[None], axis=-1)
        wrong += np.sum(distance[np.arange(len(x)), index] > distance.min(axis=1) + 1e-9)
        unproven += np.sum(~np.asarray(proven))
    assert wrong > 50 and unproven > 200
    # and on the skin they are proven with the usual number of groups, or the fast query would never be fast
    assert np.mean(searches("vertex", False)(jnp.asarray(CLOTH * 0.84), jnp.asarray(BALL), USUAL)[1]) > 0.9


@pytest.mark.parametrize("kind", ["vertex", "triangle"])
def test_several_poses_at_once_are_searched_like_one(kind):
    x, body = (np.stack([pose[i] for pose in poses().values()], axis=-1) for i in (0, 1))
    together, proven = (np.asarray(a) for a in searches(kind, True)(jnp.asarray(x), jnp.asarray(body), SURFACE))
    for pose in range(x.shape[-1]):
        here, there = x[..., pose], body[..., pose]
        alone, sure = searches(kind, True)(jnp.asarray(here), jnp.asarray(there), SURFACE)
        if kind == "vertex":
            np.testing.assert_array_equal(together[:, pose], alone)
            np.testing.assert_array_equal(proven[:, pose], sure)
        else:  # whose candidates are found in another way, so that one of two triangles at one edge may be either
            corners = (there[TRIANGLES[index]].swapaxes(0, 1) for index in (together[:, pose], np.asarray(alone)))
            right, found = (distances_to(here, *abc) for abc in corners)
            np.testing.assert_allclose(right, found, rtol=1e-12, atol=1e-15)


def test_groups_are_listed_by_what_is_near_in_the_given_poses():
    moved = [(CLOTH, np.roll(BALL, 1, axis=1)), (-CLOTH, np.roll(-BALL, 1, axis=1))]
    surface = surface_from(CLOTH, BALL, TRIANGLES, posed=moved)
    assert np.any(np.asarray(surface.vertex_lists) != np.asarray(USUAL.vertex_lists))
    x, body = jnp.asarray(0.84 * CLOTH), jnp.asarray(moved[0][1])
    assert np.mean(searches("vertex", False)(x, body, surface)[1]) > np.mean(searches("vertex", False)(x, body, USUAL)[1])


def test_lists_of_where_cloth_is_now_prove_what_the_old_ones_do_not_and_find_the_same():
    """Cloth that has slid a quarter around the ball since it was grouped."""
    x, body = jnp.asarray(0.84 * CLOTH @ rotation([0, 1, 0], 1.5).T), jnp.asarray(BALL)
    new = rebuild_lists(USUAL, [(np.asarray(x), BALL)])
    new = replace(SURFACE, vertex_lists=new.vertex_lists[:14])
    (before, unproven), (after, proven) = (searches("vertex", True)(x, body, s) for s in (SURFACE, new))
    np.testing.assert_array_equal(before, after)
    assert not np.asarray(unproven).any() and np.asarray(proven).mean() > 0.9


def test_search_in_a_batch_where_one_pose_needs_repair():
    batch = np.stack([CLOTH, poses()["every vertex somewhere else"][0]])
    found = jax.jit(jax.vmap(nearest_vertex, (0, None, None)))(jnp.asarray(batch), jnp.asarray(BALL), SURFACE)[0]
    for x, index in zip(batch, np.asarray(found), strict=True):
        distance = np.linalg.norm(x[:, None] - BALL[None], axis=-1)
        np.testing.assert_allclose(distance[np.arange(len(x)), index], distance.min(axis=1), rtol=1e-12)


def test_search_ends_on_cloth_that_is_not_a_number():
    x = jnp.asarray(CLOTH).at[7].set(jnp.nan)
    index, _ = searches("vertex", True)(x, jnp.asarray(BALL), SURFACE)
    right, _ = searches("vertex", True)(jnp.asarray(CLOTH), jnp.asarray(BALL), SURFACE)
    others = np.delete(np.arange(len(CLOTH)), 7)
    np.testing.assert_array_equal(index[others], right[others])


def test_search_carries_no_derivative():
    def far(x):
        index, _ = nearest_vertex(x, jnp.asarray(BALL), SURFACE)
        return jnp.sum(index.astype(x.dtype))

    assert not jnp.any(jax.jit(jax.grad(far))(jnp.asarray(CLOTH)))


# --- distance ---------------------------------------------------------------------------------------------------------

BODIES = {"ball": ball(1), "bracket": bracket(), "bracket inside out": None}
vertices_, faces_ = bracket()
BODIES["bracket inside out"] = (vertices_, faces_[:, ::-1])  # a hollow: its one concave edge is convex, the others concave


def probes(vertices, faces, rng):
    """Points near faces, edges and vertices on both sides, and anywhere."""
    p = vertices[faces]
    weights = rng.dirichlet([1, 1, 1], len(faces))
    edges = rng.dirichlet([1, 1], len(faces))
    on = [np.einsum("fk,fkd->fd", weights, p), np.einsum("fk,fkd->fd", edges, p[:, :2]), p[:, 0]]
    near = [a + size * rng.normal(size=a.shape) for a in on for size in (1e-4, 1e-2)]
    return np.concatenate([*near, vertices.mean(axis=0) + 0.1 * rng.normal(size=(60, 3))])


def signed(vertices, faces, x):
    """Distance by every pair; the sign by the solid angle that the closed surface fills (van Oosterom and Strackee 1983)."""
    a, b, c = (vertices[faces][None, :, k] - x[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    dot = lambda p, q: np.sum(p * q, axis=-1)  # noqa: E731
    angle = 2 * np.arctan2(dot(a, np.cross(b, c)), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb)
    winding = angle.sum(axis=1) / (4 * np.pi)
    distance = all_triangle_distances(x, vertices[faces]).min(axis=1)
    inside = winding > 0.5 if winding.max() > 0.5 else winding > -0.5  # inside out: the solid is what is around
    return np.where(inside, -distance, distance)


@jax.jit
def exact_distance(x, body, surface):
    def distance(x, body):
        return triangle_distance(x, body, surface, nearest_triangle(x, body, surface)[0])

    d, pull = jax.vjp(distance, x, body)
    return d, *pull(jnp.ones_like(d))


@jax.jit
def to_first_plane(x, body, surface):
    """The normals of the body's vertices, and the distances to the plane of its first one."""
    normals = vertex_normals(body, surface)
    return normals, plane_distance(x, body, normals, jnp.zeros(len(x), jnp.int32))


PROBES = 540  # of one count on every body: then a body's tests run one program


@pytest.mark.parametrize("name", BODIES)
def test_distance_to_triangles_and_its_sign(name, rng):
    vertices, faces = BODIES[name]
    x = filled(probes(vertices, faces, rng), PROBES)
    d, gradient, on_body = exact_distance(jnp.asarray(x), jnp.asarray(vertices), surface_from(x, vertices, faces))
    right = signed(vertices, faces, x)
    assert (right < -1e-6).sum() > 20 and (right > 1e-6).sum() > 20
    np.testing.assert_allclose(d, right, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, rtol=1e-9)
    # stepping along the gradient changes the distance by the step
    step = 1e-7
    moved = x + step * np.asarray(gradient)
    np.testing.assert_allclose((signed(vertices, faces, moved) - right) / step, 1, atol=1e-2)
    # moving cloth and body together changes nothing
    np.testing.assert_allclose(np.sum(gradient, axis=0) + np.sum(on_body, axis=0), 0, atol=1e-9)


@pytest.mark.parametrize("first", [0, 1, 2])
def test_beyond_the_edge_of_a_thin_wedge_is_outside(first):
    """An edge's pseudo-normal is of its own two faces: with the base in the place of one of them, it would point inward."""
    section = np.array([[1, 0], [0, 0.05], [0, -0.05]])
    vertices = np.array([[*p, z] for z in (0.0, 1.0) for p in section])
    sides = [[a, b, b + 3, a, b + 3, a + 3] for a, b in ((0, 1), (1, 2), (2, 0))]
    faces = np.concatenate([np.reshape(sides, (-1, 3)), [[2, 1, 0], [3, 4, 5]]]).astype(np.int32)
    faces = np.roll(faces, first, axis=1)  # the edge between any two corners of its faces
    angle, z = (a.ravel() for a in np.meshgrid(np.radians([-60, -20, 0, 20, 60]), [0.2, 0.5, 0.8]))
    away = np.stack([np.cos(angle), np.sin(angle), 0 * z], axis=-1)
    x = [1, 0, 0] + 0.03 * away + z[:, None] * [0, 0, 1]
    d, *_ = exact_distance(jnp.asarray(x), jnp.asarray(vertices), surface_from(x, vertices, faces))
    np.testing.assert_allclose(d, 0.03, atol=1e-12)


def test_a_face_normal_alone_would_get_the_sign_wrong():
    """Beside the tip of a thin spike: the nearest faces disagree, so the test above is not passed by luck."""
    vertices, faces = ball(1)
    spike = vertices.copy()
    spike[0] *= 5
    x = spike[:1] * 1.01 + 0.004 * np.cross(spike[0], [1, 2, 3])[None] / np.linalg.norm(np.cross(spike[0], [1, 2, 3]))
    x = filled(x, PROBES)
    d = exact_distance(jnp.asarray(x), jnp.asarray(spike), surface_from(x, spike, faces))[0]
    p = spike[faces[np.any(faces == 0, axis=1)]]
    normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert d[0] > 0 and np.any(normals @ (x[0] - spike[0]) < 0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_on_the_surface_itself(dtype):
    vertices, faces = bracket()
    p = vertices[faces]
    x = filled(np.concatenate([vertices, p.mean(axis=1), p[:, :2].mean(axis=1)]), PROBES)
    surface = surface_from(x, vertices, faces)
    d, gradient, on_body = exact_distance(jnp.asarray(x, dtype), jnp.asarray(vertices, dtype), surface)
    np.testing.assert_allclose(np.asarray(d), 0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, rtol=1e-5)
    assert np.isfinite(on_body).all() and d.dtype == dtype


def test_single_precision_far_from_the_origin(rng):
    """Distance and gradient of the same rounded numbers in either precision, 1 km away and a micrometre from faces."""
    vertices, faces = bracket()
    p, away = vertices[faces], 1000 * np.array([0.6, 0.64, 0.48])
    for place, offset in ((away, 0.03), (0, 1e-6)):
        x = filled(p.mean(axis=1) + offset * rng.normal(size=(len(p), 3)), PROBES)
        x, body = np.float32(x + place), np.float32(vertices + place)
        surface = surface_from(x, body, faces)
        one, two = (exact_distance(jnp.asarray(x, t), jnp.asarray(body, t), surface) for t in (jnp.float32, jnp.float64))
        np.testing.assert_allclose(one[0], two[0], atol=2e-8)
        np.testing.assert_allclose(one[1], two[1], atol=2e-5)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_body_with_collapsed_triangles_gives_finite_distances(dtype):
    vertices, faces = bracket()
    vertices[:6] = vertices[0]
    p = vertices[faces]
    assert (np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) == 0).sum() == 10
    cloth = filled(CLOTH, PROBES)
    surface = surface_from(cloth, vertices, faces)
    x, body = jnp.asarray(np.concatenate([cloth[:-2], vertices[[0, 6]]]), dtype), jnp.asarray(vertices, dtype)
    for value in exact_distance(x, body, surface):
        assert np.isfinite(value).all()
    for value in to_first_plane(x, body, surface):
        assert np.isfinite(value).all()


def test_the_rim_of_a_touchable_part_counts_as_outside():
    """Half a ball: below its rim the body goes on unseen, and a point there is not inside it."""
    vertices, faces = ball(2)
    upper = faces[np.all(vertices[faces][..., 1] > -1e-9, axis=1)]
    used, small = np.unique(upper, return_inverse=True)
    vertices, faces = vertices[used], small.reshape(-1, 3)
    x = np.array([[0.12, -0.05, 0.0], [0.0, -0.2, 0.0], [0.06, -0.05, 0], [0.0, 0.12, 0.0], [0.0, 0.09, 0.0]])
    nearest = all_triangle_distances(x, vertices[faces]).argmin(axis=1).astype(np.int32)
    d = np.asarray(jax.jit(triangle_distance)(x, vertices, surface_from(x, vertices, faces), nearest))
    assert np.all(d[:4] > 0) and d[4] < 0


def test_closest_point_minimises(rng):
    corners = rng.normal(size=(300, 3, 3))
    corners[:10, 2] = corners[:10, 0] * 0.3 + corners[:10, 1] * 0.7  # needles
    x = rng.normal(size=(300, 3)) * 1.5
    weights = np.asarray(jax.jit(closest_weights)(jnp.asarray(x), jnp.asarray(corners)))
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-9)
    assert weights.min() >= 0
    got = np.linalg.norm(x - np.einsum("vk,vkd->vd", weights, corners), axis=1)
    right = distances_to(x, *corners.swapaxes(0, 1))
    np.testing.assert_allclose(got, right, rtol=1e-9)


def test_vertex_normals_and_plane_distance_on_a_ball():
    vertices, faces = ball(3, 0.1)
    surface = surface_from(CLOTH, vertices, faces)
    normals = np.asarray(jax.jit(vertex_normals)(jnp.asarray(vertices), surface))
    np.testing.assert_allclose(normals, vertices / 0.1, atol=0.02)
    index = np.arange(len(vertices), dtype=np.int32)
    for offset in (0.01, -0.01):
        found = jax.jit(plane_distance)(vertices + offset * normals, vertices, normals, index)
        np.testing.assert_allclose(found, offset, rtol=1e-9)


# --- smooth contact ---------------------------------------------------------------------------------------------------

THICKNESS = 0.004


def packaged(name):
    """Vertices and faces of what comes with the package."""
    import ncs_jax

    with np.load(Path(ncs_jax.__file__).parent / "assets" / f"{name}.npz", allow_pickle=False) as file:
        return file["vertices"].astype(np.float64), file["faces"]


POINTS = 2000  # of one count near the ball, so that its tests run one program


@jax.jit
def compiled_contact(x, there, body, surface):
    """What the body says to cloth at x that looked for what is near it from `there`.

    And the shortfalls' derivatives by x, by `there` and by the body, by transposition.
    """

    def shortfalls(x, there, body):
        found = blended_contact(x, nearby_quadrics(there, body, surface), surface, THICKNESS)
        return found.shortfall, found

    shortfall, pull, found = jax.vjp(shortfalls, x, there, body, has_aux=True)
    return found, pull(jnp.ones_like(shortfall))


def contact(x, there, body, surface, dtype=jnp.float64):
    return compiled_contact(*(jnp.asarray(a, dtype) for a in (x, there, body)), surface)


def smooth(x, body, surface, dtype=jnp.float64):
    """Of every vertex shortfall and distance, and the shortfalls' derivatives by cloth and body."""
    found, (by_x, by_search, by_body) = contact(x, x, body, surface, dtype)
    return found.shortfall, found.distance, by_x + by_search, by_body


def mean_edge(vertices, faces):
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).mean()


def normals_of(vertices, faces):
    p = vertices[faces]
    area = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    total = np.zeros_like(vertices)
    np.add.at(total, faces.reshape(-1), np.repeat(area, 3, axis=0))
    return total / np.linalg.norm(total, axis=1, keepdims=True)


curved = jax.jit(curvatures)


def by_the_formula(x, vertices, faces):
    """Shortfall and distance over all the vertices of the body; only the curvatures are taken as found."""
    h, normals = mean_edge(vertices, faces), normals_of(vertices, faces)
    bend = np.asarray(curved(jnp.asarray(vertices), jnp.asarray(normals), surface_from(x, vertices, faces)))
    result = []
    for point in x:
        gap = point - vertices
        square = np.sum(gap**2, axis=1)
        w = np.exp(4 * (square.min() - square) / h**2)
        heavy = w > 1e-12
        w, gap, n = w[heavy], gap[heavy], normals[heavy]
        z = np.sum(gap * n, axis=1)
        q = square[heavy] / (4 * h**2)
        d = z + np.einsum("vi,vij,vj->v", gap, bend[heavy], gap) / 2 / (1 + q**2)
        d = d + 2 * h * np.maximum(q - (z / (2 * h)) ** 2 - 1, 0) ** 2 / (1 + q)
        cosine = n @ n.T
        share = 1.15 * w / ((cosine * (1 + cosine) / 2) @ w + 0.15 * w.sum())
        result.append([np.sum(share * np.minimum(d - THICKNESS, 0) ** 2), min(np.sum(w * d) / w.sum(), np.sqrt(square.min()))])
    return np.array(result).T


@cache
def near_skin(name):
    """A body and cloth that lies together as cloth does, within 2 h of its vertices, outside and inside."""
    rng = np.random.default_rng(9)
    if name == "ball":
        vertices, faces = ball(3)
        cloth = rng.normal(size=(POINTS, 3))
        cloth *= 0.1 / np.linalg.norm(cloth, axis=1, keepdims=True)
    else:
        vertices, faces = packaged("body")
        cloth = packaged("tshirt")[0]
    h = mean_edge(vertices, faces)
    nearest = cKDTree(vertices).query(cloth)[1]
    height = h * rng.uniform(-1.5, 1.9, (len(cloth), 1))
    x = vertices[nearest] + height * normals_of(vertices, faces)[nearest]
    return np.where(rng.random((len(x), 1)) < 0.8, x, vertices[nearest] + 0.5 * h * rng.normal(size=x.shape)), vertices, faces


@pytest.mark.parametrize("name", ["ball", "body"])
def test_smooth_contact_is_the_formula_over_all_vertices(name):
    """What is left out weighs nothing; nor where the cloth has moved on by half an edge since the body was looked at."""
    x, vertices, faces = near_skin(name)
    shortfall, distance = by_the_formula(x, vertices, faces)
    assert (shortfall > 0).sum() > 50 and (shortfall == 0).sum() > 50
    surface, h = surface_from(x, vertices, faces, smooth=True), mean_edge(vertices, faces)
    assert len(surface.vertex_blocks) > surface.groups  # or nothing would be left out
    for come in (0.0, 0.5 * h):
        found, (by_transposition, *_) = contact(x, x - come * np.array([0.6, 0, 0.8]), vertices, surface)
        close = np.abs(distance) < h  # deeper or farther off, more vertices weigh alike
        np.testing.assert_allclose(found.distance[close], distance[close], rtol=0, atol=5e-3 * h)
        np.testing.assert_allclose(np.sqrt(found.shortfall)[close], np.sqrt(shortfall)[close], rtol=0, atol=5e-3 * h)
        if come == 0:
            wrong = np.maximum(np.abs(found.distance - distance), np.abs(np.sqrt(found.shortfall) - np.sqrt(shortfall)))
            assert (wrong < 5e-3 * h).mean() > 0.99 and wrong.max() < 0.02 * h
        np.testing.assert_allclose(found.slope, by_transposition, rtol=0, atol=1e-10 * np.abs(found.slope).max())


@jax.jit
def contact_of_some(x, body, surface, some):
    return contact_within_reach(x, nearby_quadrics(x, body, surface), surface, THICKNESS, some)


def test_smooth_contact_of_some_groups_is_theirs():
    """Of more groups than are looked at in one turn; no other touches anything."""
    x, vertices, faces = near_skin("ball")
    surface = surface_from(x, vertices, faces, smooth=True)
    count = len(surface.cloth_blocks)
    some = np.random.default_rng(1).permutation(count)[: TOGETHER + 3]
    assert len(some) < count
    rows = np.unique(surface.cloth_blocks[some])
    others = np.setdiff1d(np.arange(len(x)), rows)
    found = contact_of_some(x, vertices, surface, np.isin(np.arange(count), some))
    for part, every in zip(found, contact(x, x, vertices, surface)[0], strict=True):
        np.testing.assert_allclose(part[rows], np.asarray(every)[rows], rtol=1e-9, atol=1e-15)
    assert not any(np.asarray(part)[others].any() for part in found[:3])


def test_cloth_that_is_too_far_to_touch_is_not_looked_at():
    """Nothing is lost by it: neither deep inside, nor where cloth has come near since the body was looked at."""
    vertices, faces = ball(4)
    rng, h = np.random.default_rng(3), mean_edge(vertices, faces)
    way = np.array([[0.0, 0.6, 0.8], [0.6, 0.8, 0.0], [-0.8, 0.0, 0.6], [0.0, -1.0, 0.0]])
    height = np.array([1e-3, 6 * h, 6 * h, -8 * h])  # on the skin, far twice, deep inside
    x = ((0.1 + height[:, None]) * way)[:, None] + rng.uniform(-0.01, 0.01, (4, POINTS, 3))
    come = np.where(np.arange(4) == 2, 5 * h, 0)[:, None, None] * way[:, None]
    x, now = x.reshape(-1, 3), (x - come).reshape(-1, 3)
    surface = surface_from(x, vertices, faces, smooth=True)

    @jax.jit
    def both(x, now):
        near = nearby_quadrics(x, jnp.asarray(vertices), surface)
        return [find(now, near, surface, THICKNESS) for find in (blended_contact, contact_within_reach)]

    whole, some = both(x, now)
    for part, every in zip(some[:3], whole[:3], strict=True):
        np.testing.assert_allclose(part, every, rtol=1e-9, atol=1e-15)
    skipped = np.asarray(some.distance) != np.asarray(whole.distance)
    assert skipped[POINTS : 2 * POINTS].mean() > 0.9 and not np.delete(skipped, np.s_[POINTS : 2 * POINTS]).any()
    assert (some.distance[skipped] > 3 * h).all() and (some.distance <= whole.distance + 1e-12).all()
    assert (np.asarray(whole.shortfall).reshape(4, -1).max(axis=1) > 0).tolist() == [True, False, True, True]


def test_curvatures_of_a_ball_and_of_a_tube_and_of_a_floor():
    for vertices, faces in (ball(3, 0.2), tube(48, 24, 0.2, 0.6)):
        surface = surface_from(vertices, vertices, faces)
        found = np.asarray(curved(jnp.asarray(vertices), jnp.asarray(normals_of(vertices, faces)), surface))
        n = normals_of(vertices, faces)
        inner = np.abs(vertices[:, 1]) < 0.15
        right = (np.eye(3)[None] - n[:, :, None] * n[:, None, :]) / 0.2
        if len(faces) != len(ball(3)[1]):
            right = right - np.diag([0, 1, 0])[None] / 0.2  # a tube is straight along its axis
        np.testing.assert_allclose(found[inner], right[inner], rtol=0, atol=0.1 / 0.2)
    vertices, faces = sheet(9, 9, 0.1)
    surface = surface_from(vertices, vertices, faces)
    flat = curved(jnp.asarray(vertices), jnp.asarray(normals_of(vertices, faces)), surface)
    np.testing.assert_allclose(flat, 0, atol=1e-12)


def test_smooth_distance_to_a_ball():
    """Outside and inside by its sign; the bend of the surface is in it, which planes would put h^2/16 x 2/R farther out."""
    vertices, faces = ball(3, 0.1)
    directions = np.random.default_rng(2).normal(size=(POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surface, h = surface_from(0.1 * directions, vertices, faces, smooth=True), mean_edge(vertices, faces)
    far = smooth(10 * directions, vertices, surface)[1]
    np.testing.assert_allclose(far, 9.9, rtol=0.01)
    for height in (-h, -h / 2, 0, h / 2, h, 2 * h):
        d = smooth((0.1 + height) * directions, vertices, surface)[1]
        np.testing.assert_allclose(d, height, rtol=0, atol=max(0.3 * h / 16 * 2 * h / 0.1, 0.05 * abs(height)))


def test_there_is_no_wall_between_two_legs():
    """Two sheets like the sides of a roof whose ridge is missing: where they would meet, 3 to 4 h away, nothing is touched."""
    plate, triangles = sheet(21, 21, 0.01)
    side = (plate - plate.mean(axis=0) + [0.135, 0, 0]) @ rotation([0, 1, 0], 0.5).T
    vertices = np.concatenate([side, side * [-1, 1, 1]])
    faces = np.concatenate([triangles, triangles[:, ::-1] + len(side)])
    ridge = np.stack([np.zeros(100), np.linspace(-0.03, 0.03, 100), np.zeros(100)], axis=1)
    ridge = np.concatenate([ridge, ridge + [0, 0, -0.002]])
    assert not smooth(ridge, vertices, surface_from(ridge, vertices, faces, smooth=True))[0].any()
    on_it = side[: 2 * len(ridge) : 2]
    assert np.all(smooth(on_it, vertices, surface_from(on_it, vertices, faces, smooth=True))[0] > 0)


def test_smooth_contact_does_not_jump_where_the_nearest_vertex_changes():
    """Along a path round a ball: the push of the tangent planes jumps from one to the next, that of their blend does not."""
    vertices, faces = ball(3, 0.1)
    t = np.linspace(0, 1, 12000)[:, None]
    x = 0.102 * np.concatenate([np.cos(t), np.sin(t) * np.cos(0.4), np.sin(t) * np.sin(0.4)], axis=1)
    parts = [smooth(p, vertices, surface_from(p, vertices, faces, smooth=True)) for p in x.reshape(-1, POINTS, 3)]
    d, push = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
    index = cKDTree(vertices).query(x)[1]
    normals = normals_of(vertices, faces)
    stairs = np.sum((x - vertices[index]) * normals[index], axis=1)
    assert len(np.unique(index)) > 8
    step = 0.102 / 12000
    assert np.abs(np.diff(stairs)).max() > 10 * step
    assert np.abs(np.diff(d)).max() < 0.5 * step
    jump = 2 * np.diff(np.minimum(stairs - THICKNESS, 0)[:, None] * normals[index], axis=0)
    assert np.abs(np.diff(push, axis=0)).max() < 0.1 * np.abs(jump).max()


@pytest.mark.parametrize("name", ["ball", "body"])
def test_slope_of_smooth_contact(name, rng):
    """By central differences, for the cloth and for the body."""
    x, vertices, faces = near_skin(name)
    surface, step = surface_from(x, vertices, faces, smooth=True), 1e-6
    value = lambda x, body: np.asarray(smooth(x, body, surface)[0])  # noqa: E731
    *_, gradient, on_body = smooth(x, vertices, surface)
    size = np.abs(gradient).max()
    along = rng.normal(size=x.shape)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    difference = (value(x + step * along, vertices) - value(x - step * along, vertices)) / (2 * step)
    wrong = np.abs(np.sum(gradient * along, axis=1) - difference) > 1e-5 * size
    assert wrong.mean() < 2e-3  # where a group comes in and another goes out on the way
    v = rng.normal(size=vertices.shape)
    difference = (value(x, vertices + 1e-8 * v) - value(x, vertices - 1e-8 * v)).sum() / 2e-8
    np.testing.assert_allclose(np.sum(np.asarray(on_body) * v), difference, rtol=1e-4)
    # moving cloth and body together changes nothing
    np.testing.assert_allclose(np.sum(on_body, axis=0) + np.sum(gradient, axis=0), 0, atol=1e-8 * len(x))


@pytest.mark.parametrize("gap", [0.004, 0.0, -0.004])
def test_two_sheets_that_face_each_other_push_each_by_itself(gap):
    """Cloth between an arm and the torso, where there is no room for both: it comes to rest in the middle, held firmly."""
    floor, faces = sheet(21, 21, 0.015)
    floor = floor - floor.mean(axis=0)
    turned = floor @ np.diag([1.0, 1, -1]) + [0.006, 0.004, gap]  # its vertices are not over those of the floor
    body, triangles = np.concatenate([floor, turned]), np.concatenate([faces, faces[:, ::-1] + len(floor)])
    assert (normals_of(body, triangles)[:, 2] * np.repeat([1, -1], len(floor)) > 0.99).all()
    sideways = 0.05 * np.random.default_rng(0).uniform(-1, 1, (200, 2))

    def push(height):
        x = np.column_stack([sideways, np.full(200, height)])
        return -np.asarray(smooth(x, body, surface_from(x, body, triangles, smooth=True))[2])[:, 2]

    assert (push(gap / 2 + 0.002) < 0).all() and (push(gap / 2 - 0.002) > 0).all()
    stiffness = (push(gap / 2 - 1e-4) - push(gap / 2 + 1e-4)) / 2e-4
    assert (stiffness > 2.5).all()  # of 2 for each sheet


@pytest.mark.parametrize("pose", ["far away", "at the centre, all equally near", "body crushed flat", "body in one point"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_smooth_contact_is_finite_anywhere(pose, dtype):
    """Far from the body no weight may underflow to nothing over nothing."""
    x, body = poses()[pose]
    surface = surface_from(filled(CLOTH, POINTS), BALL, TRIANGLES, smooth=True)
    for value in smooth(filled(x, POINTS), body, surface, dtype):
        assert value.dtype == dtype and np.isfinite(value).all()


def test_second_derivatives_of_smooth_contact_are_finite_and_its_own():
    """Forward over reverse, as a Newton step takes them, against differences of the slope."""
    vertices, faces = ball(2, 0.1)
    x, body = jnp.asarray(CLOTH * 0.9), jnp.asarray(vertices)
    surface = surface_from(CLOTH, vertices, faces, smooth=True)

    def value(x):
        return jnp.sum(blended_contact(x, nearby_quadrics(x, body, surface), surface, THICKNESS).shortfall)

    both = jax.jit(lambda x, v: jax.jvp(jax.grad(value), (x,), (v,)))
    v = np.random.default_rng(6).normal(size=x.shape)
    difference = (both(x + 1e-6 * v, v)[0] - both(x - 1e-6 * v, v)[0]) / 2e-6
    np.testing.assert_allclose(both(x, v)[1], difference, rtol=0, atol=1e-4 * np.abs(difference).max())


# --- energy -----------------------------------------------------------------------------------------------------------


def test_energy_and_force_begin_at_the_thickness():
    thickness, stiffness = 0.004, 10.0
    both = jax.jit(jax.value_and_grad(collision))
    for d, right in [(0.0041, 0.0), (0.004, 0.0), (1.0, 0.0), (0.003, 1e-3), (-0.01, 14e-3)]:
        value, slope = both(jnp.array([d, 1.0]), thickness, stiffness)
        np.testing.assert_allclose(value, stiffness * right**2, atol=1e-18)
        np.testing.assert_allclose(slope, [-2 * stiffness * right, 0], atol=1e-15)

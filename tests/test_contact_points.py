"""Contact of the surface and not of its vertices alone: points between them, what they count, and where they are needed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.between import with_between
from ncs_jax.energies.contact.nearest import nearest_vertex
from ncs_jax.energies.contact.points import MOST, contact_points, on_vertices, with_points
from ncs_jax.energies.contact.surface import rebuild_lists, surface_from
from ncs_jax.energies.elements import energies_and_gradient
from ncs_jax.energies.terms import Garment, StepInputs, Terms
from ncs_jax.energies.total import body_collision, energy_terms
from ncs_jax.geometry.mesh import mesh_from, topology, with_middles
from ncs_jax.geometry.surface_distance import border_of, signed_distance
from ncs_jax.metrics.quality import measure
from ncs_jax.prepare.contact_detail import FINEST, SPARE, bent_most, pieces_of, sags
from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import pose_body
from ncs_jax.scene.spec import load_scene, scene_from
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.solver.contact import Contact, evaluate_contact
from ncs_jax.simulation.solver.minimise import Settings
from ncs_jax.simulation.solver.problem import Problem, share_outside_body
from ncs_jax.simulation.solver.stiffness import couplings_from, stiffness
from ncs_jax.training.loss import physics

from .materials import material
from .scenes import grid, post, swing, write_scene
from .shapes import ball, sheet, tube
from .simulators import dense

NOTHING = Terms(membrane=None, bending=False, collision=None, gravity=False, inertia=False)
THICKNESS, STIFFNESS = 0.004, 10.0


def cut(faces, pieces):
    return contact_points(faces, np.broadcast_to(np.asarray(pieces), len(faces)))


@cache
def uneven():
    """A sheet of unlike triangles, each cut into another number of pieces than its neighbours."""
    rng = np.random.default_rng(11)
    x, faces = sheet(5, 6, 0.02)
    x = x + 4e-3 * rng.normal(size=x.shape) * [1, 1, 0]
    return x, faces, rng.integers(1, MOST + 1, len(faces))


# --- where the points are -------------------------------------------------------------------------------------------------


def test_no_triangle_that_is_cut_has_no_points():
    x, faces, _ = uneven()
    assert cut(faces, 1) is None and with_points(x, None) is x


@pytest.mark.parametrize("n", [2, 3, 4])
def test_every_point_is_there_once_and_carried_by_its_own_triangle(n):
    x, faces, _ = uneven()
    found = cut(faces, n)
    count = (n - 1) * len(topology(faces)[0]) + (n - 1) * (n - 2) // 2 * len(faces)
    places = with_points(x, found)[len(x) :]
    assert len(places) == count == len(np.unique(np.round(places, 9), axis=0))
    np.testing.assert_allclose(np.asarray(found.weights).sum(axis=1), 1, rtol=1e-12)
    own = {tuple(sorted(f)) for f in faces.tolist()}
    assert {tuple(sorted(c)) for c in np.asarray(found.corners).tolist()} <= own


def test_two_pieces_are_the_middles_of_the_edges():
    x, faces = grid(7, 7, 0.01)
    found = cut(faces, 2)
    middles = with_middles(x, topology(faces)[0])[len(x) :]
    order = [np.lexsort(np.round(a, 9).T) for a in (middles, with_points(x, found)[len(x) :])]
    np.testing.assert_allclose(with_points(x, found)[len(x) :][order[1]], middles[order[0]], atol=1e-12)


def test_only_triangles_that_are_cut_have_points_and_a_point_between_two_is_there_once():
    _, faces, _ = uneven()
    found = cut(faces, np.where((faces == 14).any(axis=1), 3, 1))
    around = np.unique(faces[(faces == 14).any(axis=1)])
    own = (np.asarray(found.corners) == 14) & (np.asarray(found.weights) > 0)
    assert set(np.asarray(found.corners)[np.asarray(found.weights) > 0].tolist()) == set(around.tolist())
    ring = (faces == 14).any(axis=1).sum()
    assert len(found.corners) == 5 * ring and own.any(axis=1).sum() == 3 * ring  # two on 2 x 6 edges, one in each of 6


# --- the law ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plane", "triangle", "smooth"])
def test_a_flat_sheet_pressed_into_a_plane_costs_what_each_of_its_points_and_vertices_does(kind):
    x, faces, pieces = uneven()
    body, triangles = sheet(21, 21, 0.012)
    x, terms = x + [0.06, 0.06, THICKNESS - 0.0015], replace(NOTHING, collision=kind)
    for points in (None, cut(faces, pieces), cut(faces, 3)):
        surface = surface_from(x, body, triangles, smooth=kind == "smooth", points=points)
        law = jax.jit(lambda x, body, surface: body_collision(x, body, surface, terms, material()))
        energy = float(law(jnp.asarray(x), jnp.asarray(body), surface))
        count = len(x) + (0 if points is None else len(points.corners))
        assert energy == pytest.approx(STIFFNESS * count * 0.0015**2, rel=1e-7)


@cache
def on_a_ball(kind):
    """The uneven sheet in the skin of a ball, with its points, and what an energy takes."""
    x, faces, pieces = uneven()
    body, triangles = ball(3, 0.05)
    rest = x - x.mean(axis=0) + [0, 0, 0.05]
    x = rest + 1e-3 * np.random.default_rng(4).normal(size=rest.shape)
    surface = surface_from(rest, body, triangles, smooth=kind == "smooth", points=cut(faces, pieces))
    return (
        jnp.asarray(x),
        Garment(mesh_from(rest, faces, dtype=jnp.float64), jnp.zeros(0, jnp.int32)),
        jnp.asarray(body),
        surface,
    )


@pytest.mark.parametrize("kind", ["plane", "triangle", "smooth"])
def test_the_gradient_is_that_of_differences_and_the_solver_has_both(kind, rng):
    x, _, body, surface = on_a_ball(kind)
    terms, numbers = replace(NOTHING, collision=kind), material()
    energy = jax.jit(lambda x: body_collision(x, body, surface, terms, numbers))
    value, slope = jax.value_and_grad(energy)(x)
    contact = jax.jit(lambda x: evaluate_contact(x, StepInputs(body=body), surface, numbers, terms))(x)
    np.testing.assert_allclose(contact.energy, value, rtol=1e-12)
    np.testing.assert_allclose(contact.gradient, slope, rtol=0, atol=1e-12 * float(jnp.abs(slope).max()))
    way = jnp.asarray(rng.normal(size=x.shape))
    h = 1e-7
    difference = float(energy(x + h * way) - energy(x - h * way)) / (2 * h)
    tolerance = 1e-2 if kind == "plane" else 1e-5  # a plane jumps where another vertex is nearest
    assert float(jnp.vdot(slope, way)) == pytest.approx(difference, rel=tolerance)


def test_the_vertex_between_those_of_its_corners_is_looked_up_whatever_the_pose(rng):
    """On a ball that is fine beside the cloth: next to the nearest, and the same where all is turned and bent."""
    x, _, body, surface = on_a_ball("plane")
    nearest, _ = jax.jit(nearest_vertex)(x, body, surface)
    both, verts = with_points(x, surface.points), len(x)
    found = np.asarray(jax.jit(with_between)(both, body, nearest, surface))
    np.testing.assert_array_equal(found[:verts], nearest)
    away = np.linalg.norm(np.asarray(both)[verts:, None] - np.asarray(body)[None], axis=-1)
    taken = away[np.arange(len(away)), found[verts:]]
    spacing = float(surface.spacing)
    assert np.mean(found[verts:] == away.argmin(axis=1)) > 0.5
    assert (taken - away.min(axis=1) < 0.6 * spacing).all()
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]

    def bent(p):
        return (p + 2 * p**2) @ turn + 3.0

    moved = jnp.stack([both, bent(both)], axis=-1), jnp.stack([body, bent(body)], axis=-1)
    again = np.asarray(jax.jit(with_between)(*moved, jnp.stack([nearest, nearest], axis=-1), surface))
    np.testing.assert_array_equal(again[..., 0], found)
    assert np.mean(again[..., 1] == found) > 0.8  # what is nearer of a corner's and of the one between may be another


def test_between_two_limbs_the_nearer_ones_vertex_counts():
    """Half way between two posts as they were built lies a third; moved apart, the third is farther than either."""
    posts, triangles = zip(*(tube(12, 9, 0.02, 0.2) for _ in range(3)), strict=True)
    rest = np.concatenate([p + [0.1 * k, 0, 0] for k, p in enumerate(posts)])
    triangles = np.concatenate([len(posts[0]) * k + f for k, f in enumerate(triangles)])
    body = rest.copy()
    body[len(posts[0]) : 2 * len(posts[0])] += [0, 0, 0.5]
    x = np.array([[0.0, 0.1, 0.024], [0.2, 0.1, 0.024], [0.1, 0.12, 0.024]])
    surface = surface_from(x, rest, triangles, points=contact_points(np.array([[0, 1, 2]]), np.array([2])))
    both = with_points(jnp.asarray(x), surface.points)
    for skin, post_of in ((rest, {1}), (body, {0, 2})):
        nearest = np.linalg.norm(x[:, None] - skin[None], axis=-1).argmin(axis=1).astype(np.int32)
        found = np.asarray(with_between(both, jnp.asarray(skin), jnp.asarray(nearest), surface))[len(x) :]
        on_edge = np.flatnonzero(np.abs(np.asarray(both)[len(x) :] - [0.1, 0.1, 0.024]).max(axis=1) < 1e-9)
        assert len(on_edge) == 1 and found[on_edge[0]] // len(posts[0]) in post_of


def test_many_poses_beside_each_other_are_one_by_one(rng):
    x, garment, body, surface = on_a_ball("plane")
    terms, numbers = replace(NOTHING, collision="plane"), material()
    xs = x[..., None] + 1e-3 * jnp.asarray(rng.normal(size=(*x.shape, 3)))
    bodies = jnp.stack([body, 1.01 * body, 0.99 * body], axis=-1)
    together = jax.jit(lambda x, b: energies_and_gradient(x, garment, numbers, StepInputs(body=b), terms, surface))(xs, bodies)
    for i in range(3):
        step = StepInputs(body=bodies[..., i])
        alone = energy_terms(xs[..., i], garment, numbers, step, terms, surface)["collision"]
        slope = jax.grad(lambda x, step=step: energy_terms(x, garment, numbers, step, terms, surface)["collision"])(xs[..., i])
        np.testing.assert_allclose(together[0]["collision"][i], alone, rtol=1e-12)
        np.testing.assert_allclose(together[1][..., i], slope, rtol=0, atol=1e-12 * float(jnp.abs(slope).max()))


def test_the_blocks_are_the_hessian_on_planes():
    x, garment, body, surface = on_a_ball("plane")
    terms, numbers = replace(NOTHING, collision="plane"), material()
    couplings = couplings_from(garment.mesh, surface.points)
    blocks = evaluate_contact(x, StepInputs(body=body), surface, numbers, terms).blocks
    found = dense(couplings, *stiffness(x, couplings, garment, numbers, StepInputs(body=body), terms, blocks))
    slope = jax.jit(jax.grad(lambda x: body_collision(x, body, surface, terms, numbers)))
    column = jax.jit(lambda v: jax.jvp(slope, (x,), (v.reshape(x.shape),))[1].reshape(-1))
    right = np.stack([column(jnp.asarray(v)) for v in np.eye(x.size)], axis=1)
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-9)
    apart = np.abs(right.reshape(len(x), 3, len(x), 3)).max(axis=(1, 3))
    assert (apart[~np.eye(len(x), dtype=bool)] > 0.1).sum() > 20  # points couple their corners
    assert np.linalg.eigvalsh(found).min() > -1e-9


def test_some_of_smooth_contact_is_part_of_all():
    """With what a patch takes as far away: all but the groups of its own vertices and of the points that they carry."""
    x, _, body, surface = on_a_ball("smooth")
    terms, numbers, points = replace(NOTHING, collision="smooth"), material(), surface.points
    own = np.array([7, 8, 13, 14])
    carried = np.flatnonzero((np.isin(points.corners, own) & (np.asarray(points.weights) > 0)).any(axis=1))
    blocks, rows = np.asarray(surface.cloth_blocks), np.concatenate([own, len(x) + carried])
    groups = np.flatnonzero(np.isin(blocks, rows).any(axis=1))
    only = jnp.zeros(len(blocks), bool).at[groups].set(True)
    whole, some = (evaluate_contact(x, StepInputs(body=body), surface, numbers, terms, only=rows) for rows in (None, only))
    np.testing.assert_allclose(some.gradient[own], whole.gradient[own], rtol=0, atol=1e-9)
    np.testing.assert_allclose(some.blocks[rows], whole.blocks[rows], rtol=0, atol=1e-6)
    others = np.setdiff1d(np.arange(len(x) + len(points.corners)), blocks[groups])
    assert len(others) and not np.asarray(some.blocks)[others].any()
    assert np.abs(whole.gradient[own]).max() > 1e-3


def test_forces_at_points_are_shared_out_so_that_they_do_the_same_work(rng):
    x, _, _, surface = on_a_ball("plane")
    forces = jnp.asarray(rng.normal(size=(surface.verts + len(surface.points.corners), 3)))
    way = jnp.asarray(rng.normal(size=x.shape))
    work = float(jnp.vdot(forces, with_points(way, surface.points)))
    assert float(jnp.vdot(on_vertices(forces, surface.points), way)) == pytest.approx(work, rel=1e-12)


def test_new_lists_for_the_search_know_the_points():
    x, _, body, surface = on_a_ball("plane")
    moved = [(np.asarray(x) + [0.02, 0, 0], np.asarray(body))]
    found = rebuild_lists(surface, moved)
    assert found.points is surface.points and not np.array_equal(found.vertex_lists, surface.vertex_lists)


# --- where they are needed ----------------------------------------------------------------------------------------------


def cylinder(radius, length=0.4, around=64, rings=41):
    x, faces = tube(around, rings, radius, length)
    return x - [0, x[:, 1].mean(), 0], faces


def outward(x, faces):
    normal = np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]])
    return faces if np.sum(normal * x[faces[:, 0]] * [1, 0, 1]) > 0 else faces[:, ::-1]


@pytest.mark.parametrize("radius", [0.04, 0.08])
def test_what_a_triangle_sinks_is_that_of_a_ball_of_the_same_curve(radius):
    x, faces = ball(4, radius)
    edge = 0.03
    np.testing.assert_allclose(sags(x, faces, edge), edge**2 / (6 * radius), rtol=0.06)


def test_flat_hollow_and_thin_bodies_need_nothing():
    flat = sheet(21, 21, 0.01)
    assert sags(*flat, 0.03).max() < 1e-12
    x, faces = ball(4, 0.05)
    assert sags(x, faces[:, ::-1], 0.03).max() == 0
    finger, around = cylinder(0.006)
    middle = np.abs(finger[:, 1]) < 0.1
    assert sags(finger, outward(finger, around), 0.04)[middle].max() < 0.006  # and not L^2 / (6 R), 44 mm
    assert sags(*sheet(2, 2, 0.5), 0.01).max() == 0  # a facet larger than the triangle


def test_pieces_are_as_few_as_leave_half_of_the_thickness_and_none_of_a_fine_garment():
    radius = 0.05
    body, triangles = ball(4, radius)
    for divisions, most in ((1, 4), (2, 3), (3, 2), (4, 1)):
        x, faces = ball(divisions, radius + THICKNESS)
        found = pieces_of(x, faces, [body], triangles, THICKNESS)
        edge = np.linalg.norm(x[faces] - np.roll(x[faces], 1, axis=1), axis=2).max(axis=1)
        right = np.clip(np.ceil(np.sqrt(edge**2 / (6 * radius) / (SPARE * THICKNESS))), 1, FINEST)
        assert found.max() <= most and np.abs(found - right).max() <= 1 and np.mean(found == right) > 0.5
    assert found.max() == 1
    thicker = pieces_of(*ball(1, radius), [body], triangles, 4 * THICKNESS)
    assert thicker.max() < pieces_of(*ball(1, radius), [body], triangles, THICKNESS).min()


def test_a_bent_pose_asks_for_more(rng):
    x, faces = sheet(9, 9, 0.025)
    flat, triangles = sheet(41, 41, 0.01)
    flat, x = flat - flat.mean(axis=0), x - x.mean(axis=0) + [0, 0, 0.01]
    angle = flat[:, 0] / 0.05
    bent = np.stack([0.05 * np.sin(angle), flat[:, 1], 0.05 * np.cos(angle)], axis=1)
    poses = np.zeros((30, 3, 3))
    poses[:, 1, 0], poses[:, 2, 2] = np.sin(np.arange(30)), 1.5 * np.cos(np.arange(30))
    chosen = bent_most(poses)
    assert len(chosen) == 2 and np.abs(chosen).max(axis=0).max(axis=1) == pytest.approx(np.abs(poses).max(axis=0).max(axis=1))
    assert pieces_of(x, faces, [flat], triangles, THICKNESS).max() == 1
    assert pieces_of(x, faces, [flat, bent], triangles, THICKNESS).min() >= 2


# --- a scene ------------------------------------------------------------------------------------------------------------


def scene(folder, points, distance="smooth"):
    """A coarse sleeve of six columns round a post: its vertices are outside, the middles of its edges are not."""
    path = write_scene(folder)
    vertices, faces = tube(6, 6, 0.084, 0.25)
    np.savez(folder / "cloth.npz", vertices=vertices + [0, 0.4, 0], faces=faces, group_pins=np.arange(0, dtype=np.int32))
    np.savez(folder / "body.npz", **post(rings=24, around=24))
    np.savez(folder / "swing.npz", **{k: v[:3] if v.ndim else v for k, v in swing(frames=10, size=0.0).items()})
    tables = load_scene(path).to_dict()
    tables["garment"]["pins"] = ""
    tables["physics"]["gravity"] = [0.0, 0.0, 0.0]
    tables["physics"]["collision"] |= {"points": points, "distance": distance, "stiffness": 100.0}
    return assemble(scene_from(tables), dtype=jnp.float64)


def deepest(model, x, body):
    mesh, faces = model.garment.mesh, np.asarray(model.surface.faces)
    points = with_middles(np.asarray(x), np.asarray(mesh.edges), np.asarray(mesh.faces))
    return -signed_distance(points, np.asarray(body), faces, border_of(faces, len(body))).min()


@pytest.mark.parametrize(("points", "count"), [("0", 0), (1, 1), ("auto", 1)])
def test_a_scene_says_where_contact_looks(tmp_path, points, count):
    assembly = scene(tmp_path, points)
    found = assembly.model.surface.points
    assert (found is None) == (count == 0) == (not assembly.prepared.pieces.size)
    if points == 1:
        assert (assembly.prepared.pieces == 2).all()


def test_the_simulator_pushes_out_what_sinks_between_vertices(tmp_path):
    depths = {}
    for points in ("0", "auto"):
        model = scene(tmp_path, points).model
        track = scene(tmp_path, points).track
        run = jax.jit(lambda simulator, track: simulate(simulator, track, Settings(tolerance=1e-2)))
        x, solution = run(simulator_from(model), jax.tree.map(lambda a: a[:2], track))
        assert (np.asarray(solution.status) == 0).all()
        depths[points] = deepest(model, x[-1], pose_body(model, track.matrices[1]))
        rows = measure(model, np.asarray(track.absolute(x))[:2], track)
        assert 1000 * max(depths[points], 0) == pytest.approx(
            max(rows[f"{part}depth_max"][1] for part in ("", "middle_", "centre_")), abs=1e-3
        )
    assert depths["0"] > 0.004 and depths["auto"] < 0.001


@jax.jit
def descended(model, matrices):
    """The garment after descent of the loss itself, by the offsets that a network would give."""

    def step(offsets, _):
        _, slope, _ = physics(model, model.blend, [offsets], matrices, jnp.ones(1))
        return offsets - 5e-4 * slope, None

    offsets, _ = jax.lax.scan(step, jnp.zeros((*model.garment.mesh.rest.shape, 1)), None, length=400)
    return model.garment.mesh.rest + offsets[..., 0]


def test_training_pushes_it_out_too(tmp_path):
    depths = {}
    for points in ("0", "auto"):
        assembly = scene(tmp_path, points, "plane")
        model, track = assembly.model, assembly.track
        model = replace(model, terms=replace(model.terms, inertia=False, gravity=False))
        x = descended(model, track.matrices[:1][..., None])
        depths[points] = deepest(model, x, pose_body(model, track.matrices[0]))
    assert depths["0"] > 0.004 and depths["auto"] < 0.001


def test_a_step_takes_no_point_through_the_body():
    x, garment, _, surface = on_a_ball("plane")
    couplings = couplings_from(garment.mesh, surface.points)
    held = Problem(None, couplings, None, StepInputs())
    distance = jnp.full(surface.verts + len(surface.points.corners), 1.0)
    inside = np.flatnonzero((np.asarray(surface.points.weights) > 0).all(axis=1))[0]
    contact = Contact(
        jnp.zeros(()), jnp.zeros_like(x), jnp.zeros((len(distance), 3, 3)), distance.at[len(x) + inside].set(-1.0)
    )
    share = np.asarray(share_outside_body(held, contact, jnp.zeros_like(x).at[:, 2].set(0.1)))
    corners = np.asarray(surface.points.corners)[inside]
    np.testing.assert_allclose(share[corners], 0.1, rtol=1e-6)  # CLEARANCE, 10 mm of 100
    assert (np.delete(share, corners) == 1).all()


def test_grids_of_tests_are_fine_enough_to_need_none(tmp_path):
    """So that what other tests say of vertices is of vertices."""
    x, faces = grid(25, 25, 0.012, (0, 0.4, 0.082))
    body = post(rings=24, around=20)
    assert pieces_of(x, faces, [body["vertices"]], body["faces"], THICKNESS).max() == 1

"""A swing: the garment's own vibrations, what implicit Euler makes of them, and how a network is trained for them."""

import re
import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax import InputError, assemble, load_run, train
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import total
from ncs_jax.geometry.skinning import blend, skin, unpose
from ncs_jax.network.methods.method import decode
from ncs_jax.network.methods.swing import FEW, QUIET, Swing, _product, stiffness
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import BEYOND, features_from_records
from ncs_jax.prepare.setting import with_cell
from ncs_jax.runs.pose_stiffness import FEWEST, fitted, poses_of
from ncs_jax.runs.train import IDLE
from ncs_jax.scene.model import RitzModes, local_rotations, pose_body
from ncs_jax.scene.spec import load_scene, scene_from
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.ritz_modes import LOOSE, STICK, _sticking, displacement_slopes, softest_ritz_modes, stiffness_in_poses
from ncs_jax.training.loss import gradients
from ncs_jax.training.step import Task, initial_state, windows_of

from .ready import animated, edited, prepared, ready, run
from .scenes import SCENE, grid, write_scene

swings = jax.jit(lambda network, *inputs: network.swings(*inputs), static_argnums=0)
codes_of = jax.jit(lambda network, *inputs: network.codes(*inputs), static_argnums=0)
blends = jax.jit(jax.vmap(blend, (0, None)))

SWING = {"network.cell": "swing", "network.vibrations": 3, "garment.pins": "pins", "training.motion_augmentation": 0.5}


def hanging(tmp_path, rows=12, columns=3, size=0.05):
    """A strip of cloth with nothing beside it that hangs from its upper edge."""
    vertices, faces = grid(rows, columns, size)
    top = np.arange(len(vertices))[-columns:]
    np.savez(tmp_path / "cloth.npz", vertices=vertices, faces=faces, group_pins=top)
    np.savez(tmp_path / "still.npz", poses=np.zeros((2, 1, 3)), trans=np.zeros((2, 3)), fps=np.array(30.0))
    (tmp_path / "scene.toml").write_text(
        '[body]\nfile = "none"\n[garment]\nfile = "cloth.npz"\npins = "pins"\n[motion]\nfiles = ["still.npz"]\n'
        "[network]\nmodes = 0\n[physics.bending]\nstiffness = 0\n[physics.pinning]\nstiffness = 1e6\n"
    )
    return assemble(load_scene(tmp_path / "scene.toml"), dtype=jnp.float64)


def test_a_hanging_strip_swings_as_a_chain_does(tmp_path):
    """Forward: its threads are chains side by side, w = j_01 / 2 sqrt(g / L), j_01 the Bessel function's zero."""
    assembly = hanging(tmp_path, 23, 5, 0.025)
    model = assembly.model  # of cloth that does not stretch, as chains do not
    model = replace(model, material=replace(model.material, membrane=tuple(30 * k for k in model.material.membrane)))
    found = softest_ritz_modes(model, assembly.track.matrices[0], 3)
    mass = np.asarray(model.material.density * model.garment.mesh.vertex_area)
    moved = np.einsum("v,vik->ik", mass, np.square(found.directions))[:, 0]
    assert moved[2] > 0.999 * moved.sum()
    frequency = np.sqrt(float(found.energy) / moved.sum())
    np.testing.assert_allclose(frequency, 2.404826 / 2 * np.sqrt(9.81 / np.ptp(model.garment.mesh.rest[:, 1])), rtol=0.01)


def test_a_garment_that_comes_to_no_rest_has_no_vibrations(tmp_path, monkeypatch):
    assembly = hanging(tmp_path, 8)
    given = assembly.model, assembly.track.matrices[0], 3
    assert softest_ritz_modes(*given) is not None
    monkeypatch.setattr("ncs_jax.simulation.ritz_modes.STEPS", 1)
    assert softest_ritz_modes(*given) is None


def test_what_touches_the_body_is_held_along_it():
    """By m STICK^2 against any way along the surface, by nothing against the normal, nor where no contact pushes."""
    push = jnp.asarray([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0], [1.0, -2.0, 2.0]])
    contact = SimpleNamespace(contact=SimpleNamespace(gradient=push), gradient=push)
    loose, pinned = (SimpleNamespace(mass=jnp.asarray([2.0, 2.0, 0.5]), terms=Terms(pinning=p)) for p in (False, True))
    held = np.asarray(_sticking(loose, contact))
    np.testing.assert_allclose(held[0], 2 * STICK**2 * np.diag([1.0, 1.0, 0.0]), atol=1e-9)
    assert not held[1].any()
    np.testing.assert_allclose(held[2] @ push[2], 0, atol=1e-9)
    np.testing.assert_allclose(held[2] @ [2.0, 2.0, 1.0], 0.5 * STICK**2 * np.array([2.0, 2.0, 1.0]))
    bare = SimpleNamespace(contact=None, gradient=push)
    assert not _sticking(loose, bare).any() and not _sticking(pinned, contact).any()


def test_vibrations_are_those_of_the_energy_about_the_drape(tmp_path):
    """Orthogonal in mass and in stiffness, each of the same energy, as the second derivative of all terms has it."""
    assembly = hanging(tmp_path, 8)
    model, track, terms = assembly.model, assembly.track, replace(assembly.model.terms, inertia=False)
    found = softest_ritz_modes(model, track.matrices[0], 3)
    (x,), _ = jax.jit(simulate)(simulator_from(model), jax.tree.map(lambda a: a[:1], track))
    (blended,) = blends(track.matrices[:1], model.blend)
    frame = StepInputs(1 / model.fps, vertex_transforms=blended)
    u = np.einsum("vij,vjk->vik", blended[:, :, :3], found.directions)

    @jax.jit
    def product(u):
        """Of the second derivative with a field."""
        force = jax.grad(lambda x: total(x, model.garment, model.material, frame, terms))
        return jax.jvp(force, (x,), (u,))[1]

    hessian = [[np.vdot(v, product(w)) for w in np.moveaxis(u, 2, 0)] for v in np.moveaxis(u, 2, 0)]
    np.testing.assert_allclose(hessian, float(found.energy) * np.eye(3), rtol=0.02, atol=0.02 * float(found.energy))
    mass = model.material.density * model.garment.mesh.vertex_area
    moved = np.einsum("v,vik,vil->kl", mass, u, u)
    np.testing.assert_allclose(moved - np.diag(np.diag(moved)), 0, atol=1e-9 * moved.max())
    assert np.all(np.diff(np.diag(moved)) < 0)  # softest first


def test_a_swing_is_implicit_euler_along_the_vibrations():
    """Every frame of a small swing minimises inertia about its own two frames before, and the energy of the vibrations."""
    assembly, params, motion = ready(method="swing")
    flat = replace(assembly.model.vibrations, slope=0 * assembly.model.vibrations.slope)  # so that no swing is large
    model, network, track = (
        replace(assembly.model, vibrations=flat),
        replace(assembly.network, damping=0.0),
        features_from_records(assembly.model, motion),
    )
    q = np.asarray(swings(network, params, model, track))
    static = np.asarray(animated(model, network, params, track, None))
    mass = np.asarray(model.material.density * model.garment.mesh.vertex_area)
    turned = np.asarray(blends(track.matrices, model.blend))[..., :3]
    p = np.einsum("fvij,vjk->fvik", turned, model.vibrations.directions)
    x = static + np.einsum("fvik,fk->fvi", p, q)
    assert not q[0].any() and np.abs(q).max() > 0.05
    for t in range(1, len(q)):
        away = x[t] - 2 * x[t - 1] + x[max(t - 2, 0)]
        force = np.einsum("vik,v,vi->k", p[t], mass, away) * model.fps**2 + float(model.vibrations.energy) * q[t]
        np.testing.assert_allclose(force, 0, atol=1e-9 * float(model.vibrations.energy))


def rms_slope(model, q):
    """Return sqrt(q^T S q) of swings (frames, modes)."""
    return np.sqrt(np.einsum("tk,kl,tl->t", q, model.vibrations.slope, q))


def test_the_slope_is_that_of_the_garment_as_it_moves(tmp_path):
    """A field u = A x has the gradient A everywhere, of which a flat sheet sees the two columns of its plane."""
    mesh = hanging(tmp_path).model.garment.mesh
    fields = np.random.default_rng(0).normal(size=(3, 3, 2))
    found = displacement_slopes(mesh, np.einsum("ijk,vj->vik", fields, mesh.rest))
    np.testing.assert_allclose(found, np.einsum("ijk,ijl->kl", fields[:, :2], fields[:, :2]), rtol=1e-6)


@pytest.mark.parametrize("size", [1.0, 10.0, 100.0, 1e6])
def test_no_acceleration_brings_a_swing_beyond_its_range(size):
    """Every frame thrown about by up to so many g: r.m.s. displacement gradients stay below one, and all is finite."""
    assembly, params, motion = ready(method="swing")
    model, network = assembly.model, assembly.network
    thrown = np.random.default_rng(1).uniform(-1, 1, motion.translation.shape) * size * 9.81 / model.fps**2
    track = features_from_records(model, edited(motion, translation=motion.translation + thrown))
    q = np.asarray(swings(network, params, model, track))
    assert np.isfinite(q).all() and rms_slope(model, q).max() < 1 + 1e-12
    assert size < 10 or rms_slope(model, q).max() > 0.7
    free = replace(model, vibrations=replace(model.vibrations, slope=0 * model.vibrations.slope))
    assert size < 100 or rms_slope(model, np.asarray(swings(network, params, free, track))).max() > 2


def test_the_range_of_a_swing_is_that_of_its_training_and_half_as_much_more():
    """W of the training's largest swing, without W, is 1 / 1.5^2; no motion is swung beyond the range."""
    assembly, _, motion = ready(method="swing")
    model, network = assembly.model, assembly.network
    params, given = initial_state(model, network, 0).params, model.vibrations
    strains = displacement_slopes(model.garment.mesh, np.asarray(given.directions))
    linear = replace(model, vibrations=replace(given, slope=jnp.asarray(strains)))
    q = np.asarray(swings(network, params, linear, assembly.track))
    largest = np.sqrt(np.einsum("tk,kl,tl->t", q, given.slope - strains, q)).max()
    np.testing.assert_allclose(BEYOND * largest, 1, rtol=1e-4)
    q = np.asarray(swings(network, params, model, assembly.track))
    faster = features_from_records(model, edited(motion, translation=10 * motion.translation))
    assert rms_slope(model, q).max() < rms_slope(model, np.asarray(swings(network, params, model, faster))).max() < 1


def test_a_small_swing_is_linear_and_a_large_one_only_loses_energy():
    assembly, _, _ = ready(method="swing")
    model, network = assembly.model, assembly.network
    q = jnp.asarray(np.random.default_rng(2).normal(size=(3, 20)))
    q = q / rms_slope(model, q.T)[None]
    for size, most in ((0.01, 1e-8), (0.5, 0.016)):
        np.testing.assert_allclose(network.bounded(model, size * q), size * q, rtol=most)
    for size in (1.0, 3.0, 100.0):
        shorter = network.bounded(model, size * q)
        ratio = np.asarray(shorter / (size * q))  # one of all modes
        np.testing.assert_allclose(ratio, ratio[:1].repeat(3, axis=0), rtol=1e-12)
        assert np.all(ratio > 0) and np.all(ratio < 1)
        assert np.all(rms_slope(model, shorter.T) < 1)


def test_a_fresh_network_swings_next_to_nothing():
    """So training begins at the static garment, and goes along with a swing as far as that pays."""
    assembly, _, motion = ready(method="swing")
    params = initial_state(assembly.model, assembly.network, 0).params
    fast = edited(motion, translation=30 * motion.translation)
    assert np.abs(swings(assembly.network, params, assembly.model, features_from_records(assembly.model, fast))).max() > 0.1
    assert np.abs(run(assembly, params, fast, 1.0) - run(assembly, params, fast, 0.0)).max() < 1e-3


def test_a_swing_of_an_earlier_version_is_animated_as_it_was():
    """It has no slope: nothing bounds it, and the garment moves along the vibrations beside what the decoder says."""
    assembly, params, motion = ready(method="swing")
    model = replace(assembly.model, vibrations=replace(assembly.model.vibrations, slope=None))
    track = features_from_records(model, motion)
    codes = codes_of(assembly.network, params, model, track)
    turned = np.asarray(blends(track.matrices, model.blend))[..., :3]
    beside = np.einsum("fvij,vjk,fk->fvi", turned, model.vibrations.directions, codes.swing)
    bare = replace(model, vibrations=replace(model.vibrations, slope=0 * assembly.model.vibrations.slope))
    x, without = (np.asarray(animated(m, assembly.network, params, track, 1.0)) for m in (model, bare))
    assert np.abs(beside).max() > 0.01
    np.testing.assert_allclose(x - without, beside, atol=1e-12)


def test_it_rings_at_its_own_period_and_decays_faster_where_it_is_damped():
    assembly, params, motion = ready(method="swing")
    still = 300
    poses, places = (np.concatenate([a, np.repeat(a[-1:], still, axis=0)]) for a in (motion.poses, motion.translation))
    track, model = features_from_records(assembly.model, edited(motion, poses, places)), assembly.model
    left = []
    for damping in (0.0, 2.0):
        q = np.asarray(swings(replace(assembly.network, damping=damping), params, model, track))[-still:, 0]
        crossings = np.flatnonzero(np.diff(np.sign(q[:60])))
        assert len(crossings) > 2
        left.append(np.abs(q[60:90]).max() / np.abs(q[:30]).max())
        assert np.abs(q[-30:]).max() < 1e-3 * np.abs(q).max()
    assert left[1] < 0.5 * left[0] < 0.5


def test_no_motion_no_swing_and_motions_end_to_end_know_nothing_of_each_other():
    assembly, params, motion = ready(method="swing")
    model, network = assembly.model, assembly.network
    still = edited(motion, np.repeat(motion.poses[3:4], 40, axis=0), np.repeat(motion.translation[3:4], 40, axis=0))
    codes = codes_of(network, params, model, features_from_records(model, still))
    assert np.abs(codes.swing).max() < 1e-12 and np.abs(codes.dynamic).max() < 1e-12
    once = swings(network, params, model, features_from_records(model, motion))
    every = swings(network, params, model, features_from_records(model, motion, still, motion))
    np.testing.assert_allclose(every, jnp.concatenate([once, jnp.zeros((40, 3)), once]), rtol=0, atol=1e-12)


def test_alpha_scales_the_swing_and_the_code_that_goes_with_it():
    assembly, params, motion = ready(method="swing")
    network, model = assembly.network, assembly.model
    codes = codes_of(network, params, model, features_from_records(model, motion))
    np.testing.assert_allclose(network._dynamic(params, 3.0 * codes.swing), 3.0 * codes.dynamic, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(codes.swung(3.0), 3.0 * codes.swing)
    moved = [np.abs(run(assembly, params, motion, alpha) - run(assembly, params, motion, 0.0)).max() for alpha in (1.0, 2.0)]
    assert moved[1] > 1.3 * moved[0] > 1e-3


def test_the_mass_of_many_poses_is_that_of_each(rng):
    directions, mass, transforms = (rng.standard_normal(size) for size in ((5, 3, 4), 5, (5, 3, 4, FEW)))
    each = [_product(directions, mass, transforms[..., k : k + 1])[..., 0] for k in range(FEW)]
    np.testing.assert_allclose(_product(directions, mass, transforms), np.stack(each, axis=-1), rtol=1e-11, atol=1e-12)


def test_far_from_the_origin_a_stream_in_single_precision_swings_as_near_it():
    assembly, params, motion = ready(method="swing")  # in double precision: one that the other tests have, too
    single = lambda a: a.astype(jnp.float32) if jnp.issubdtype(a.dtype, jnp.floating) else a  # noqa: E731
    model, params = jax.tree.map(single, (assembly.model, params))
    init, step = stepper(model, assembly.network, params)
    local, step = local_rotations(model, jnp.asarray(motion.poses, jnp.float32)), jax.jit(step)
    ends = []
    for far in (0.0, 1024.0):
        state = init()
        for rotations, place in zip(local, motion.translation.astype(np.float32), strict=True):
            state, x = step(state, rotations, jnp.asarray(place + np.float32(far)))
        ends.append(np.asarray(x, np.float64) - far)
    assert np.abs(ends[1] - ends[0]).max() < 1e-3  # 1,024 m has no places finer than 0.06 mm


def test_the_gradient_is_that_of_the_energy_and_of_what_holds():
    """Of all that a step computes in pieces, in one: with other frames' swings too."""
    assembly, spec, ends, _ = prepared(SWING, jnp.float64)
    model, network, ends = assembly.model, assembly.network, ends[0]
    params = initial_state(model, network, 0).params
    params["dynamic"]["read"]["kernel"] = params["dynamic"]["read"]["kernel"] * 100
    params["decoder"]["coefficients"]["kernel"] = params["decoder"]["coefficients"]["kernel"] + 0.01
    pairs = jnp.asarray([2, 0, 3, 1], jnp.int32)
    track = replace(assembly.track, swing=swings(network, params, model, assembly.track))
    vibrations = assembly.model.vibrations
    some = 0.1 * np.random.default_rng(3).standard_normal((len(vibrations.by_pose) - 3, vibrations.by_pose.shape[1]))
    wide = np.stack([0 * some[0], 0 * some[0] - 1, 0 * some[0] + 1])
    vibrations = replace(vibrations, by_pose=jnp.asarray(np.vstack([some, wide])))
    model = replace(model, vibrations=vibrations)
    stiff = np.moveaxis(stiffness(vibrations, track.static[ends]), -1, 0)
    assert np.linalg.eigvalsh(stiff).min() > 0 and np.ptp(stiff, axis=0).max() > 1e-3 * float(vibrations.energy)
    others = jnp.concatenate([ends[pairs[:1]], ends[1:]])
    size = np.linalg.norm(track.swing, axis=1)
    spec = replace(spec, motion_augmentation=1.0)  # two of four stand still, and of the others' swings the second is enlarged
    others = jnp.concatenate([ends[pairs[:2]], ends[2:]])
    share = jnp.asarray([0.0, size.max() / max(size[others[1]], QUIET * size.max()), 0.0, 0.0])
    mass, d = model.material.density * model.garment.mesh.vertex_area, model.vibrations.directions
    moved, swing = jnp.einsum("vik,v,vik->k", d, mass, d), np.asarray(share[:, None] * track.swing[others])
    long = np.sqrt(np.einsum("tk,kl,tl->t", swing, vibrations.slope, swing))
    assert long[1] > 0.5  # so far beyond what the motions show that it is shortened
    swing = jnp.asarray(swing / (1 + long**4)[:, None] ** 0.25)

    def decoded(params, z):
        return network.decoder.apply({"params": params["decoder"]}, z, model.basis)

    def static(params):
        return network.static.apply({"params": params["static"]}, track.static[ends])

    def loss(params, first):
        still = decoded(first, static(first))
        y = decoded(params, static(params) + network.dynamic.apply({"params": params["dynamic"]}, swing))

        def of_one(sample):
            m, y, still, q, k = sample
            blended = blend(m, model.blend)
            body = None if model.body is None else pose_body(model, m)
            frame = StepInputs(1 / model.fps, body=body, vertex_transforms=blended)
            x = skin(blended, model.garment.mesh.rest + y)
            r = jnp.einsum("vik,v,vi->k", d, mass, y - still) / moved - q
            held = jnp.sum(0.5 * model.fps**2 * moved * r**2 - (k @ q) * r)
            return total(x, model.garment, model.material, frame, terms, model.surface) + held

        samples = track.matrices[ends], jnp.moveaxis(y, -1, 0), jnp.moveaxis(still, -1, 0), swing, jnp.asarray(stiff)
        return jnp.mean(jax.lax.map(of_one, samples))

    terms = network.loss(model.terms)
    value, expected = jax.jit(jax.value_and_grad(loss))(params, params)
    windows = partial(windows_of, Task(model, network, spec))
    found, parts, _ = jax.jit(lambda p: gradients(model, network, p, track, windows(ends, pairs)))(params)
    assert set(parts) == {"bending", "collision", "gravity", "hold", "membrane", "pinning"} and abs(parts["hold"]).max() > 1e-9
    np.testing.assert_allclose(sum(parts.values()).mean(), value, rtol=1e-10)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-9 * (1 + np.abs(b).max())), found, expected)


def test_the_stiffness_in_a_pose_is_of_a_garment_that_gives_way(tmp_path):
    """Forward: the least energy of all displacements that go so far along the vibrations, by the second derivative itself."""
    assembly = hanging(tmp_path, 8)
    model, track, terms = assembly.model, assembly.track, replace(assembly.model.terms, inertia=False)
    vibrations = softest_ritz_modes(model, track.matrices[0], 3)
    height = model.garment.mesh.rest[:, 1] / jnp.ptp(model.garment.mesh.rest[:, 1])
    stretch = 0.05 * jnp.sin(jnp.pi * height[:, None] * jnp.arange(1.0, 4.0)[None])
    crooked = vibrations.directions.at[:, 1].add(stretch)
    model = replace(model, vibrations=replace(vibrations, directions=crooked))
    (x,), _ = jax.jit(simulate)(simulator_from(model), jax.tree.map(lambda a: a[:1], track))
    rest, size = model.garment.mesh.rest, 3 * len(model.garment.mesh.rest)
    (blended,) = blends(track.matrices[:1], model.blend)
    frame = StepInputs(1 / model.fps, vertex_transforms=blended)
    hessian = jax.jit(jax.hessian(lambda x: total(x.reshape(-1, 3), model.garment, model.material, frame, terms)))(x.ravel())
    mass = np.repeat(model.material.density * model.garment.mesh.vertex_area, 3)
    p = np.einsum("vij,vjk->vik", blended[:, :, :3], crooked).reshape(size, 3)
    b = (mass[:, None] * p) @ np.linalg.inv(p.T @ (mass[:, None] * p))
    stiff = np.asarray(hessian) + np.diag(LOOSE**2 * mass)
    expected = np.linalg.inv(b.T @ np.linalg.solve(stiff, b))
    offsets = np.linalg.solve(blended[:, :, :3], (x - blended[:, :, 3])[..., None])[..., 0] - rest
    (found,) = stiffness_in_poses(model, track.matrices[:1], jnp.asarray(offsets)[..., None])
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01 * abs(expected).max())
    locked = p.T @ stiff @ p
    assert np.trace(found) < 0.5 * np.trace(locked)


def test_the_drape_is_the_simulations_and_a_fresh_network_hangs_so(tmp_path):
    assembly = hanging(tmp_path, 8)
    model, track = assembly.model, assembly.track
    (x,), _ = jax.jit(simulate)(simulator_from(model), jax.tree.map(lambda a: a[:1], track))
    (blended,) = blends(track.matrices[:1], model.blend)
    vibrations = softest_ritz_modes(model, track.matrices[0], 3)
    np.testing.assert_allclose(vibrations.drape, unpose(blended, x) - model.garment.mesh.rest, atol=1e-4)

    assembly, _, _ = ready(method="swing")
    network, model = assembly.network, assembly.model
    drape = jnp.asarray(np.random.default_rng(0).standard_normal(model.garment.mesh.rest.shape) / 10)
    model = replace(model, vibrations=replace(model.vibrations, drape=drape))
    params = initial_state(model, network, 0).params
    codes = network.static.apply({"params": params["static"]}, assembly.track.static)
    offsets = np.moveaxis(np.asarray(decode(network, params, model, codes)), -1, 0)
    assert 0 < np.linalg.norm(offsets - np.asarray(drape), axis=-1).mean() < 0.003


def test_what_is_fitted_is_a_map_of_the_descriptors_and_keeps_to_what_was_found():
    rng, modes, poses = np.random.default_rng(1), 3, 60
    d, a = rng.uniform(-1, 1, (poses, 5)), rng.standard_normal((5, 6)) / 3

    def told(by_pose, d):
        vibrations = RitzModes(jnp.zeros((4, 3, modes)), jnp.asarray(2.0), by_pose=by_pose)
        return np.moveaxis(stiffness(vibrations, jnp.asarray(d)[:, None]), -1, 0) / 2

    wide = np.stack([np.full(6, 0.1), np.full(6, -9.0), np.full(6, 9.0)])
    given = told(jnp.asarray(np.vstack([a, wide])), d)
    by_pose = fitted(d, given)
    np.testing.assert_allclose(by_pose[:6], np.vstack([a, wide[:1]]), atol=1e-3)
    np.testing.assert_allclose(told(jnp.asarray(by_pose), d), given, rtol=5e-3, atol=5e-3)
    bad = np.array(given)
    bad[3], bad[4] = np.nan, -bad[4]
    np.testing.assert_allclose(fitted(d, bad)[:5], a, atol=1e-3)
    assert fitted(d[: FEWEST + 1], bad[: FEWEST + 1]) is None  # two are of no use
    far = told(jnp.asarray(by_pose), 100 * d)  # what no training has shown is no softer and no stiffer than what it has
    entries = np.linalg.cholesky(far)
    diagonal = np.log(entries[:, range(modes), range(modes)])
    rows = [0, 2, 5]  # of the diagonal
    assert np.all(diagonal > by_pose[6, rows] - 1e-9) and np.all(diagonal < by_pose[7, rows] + 1e-9)
    np.testing.assert_array_equal(told(None, d), np.tile(np.eye(modes), (poses, 1, 1)))


@pytest.mark.parametrize("noise", [0, 1e-7])
def test_poses_that_are_all_alike_have_one_stiffness(noise):
    """A body that only turns about gravity has one pose: the descriptors differ by rounding, which tells nothing."""
    rng, poses = np.random.default_rng(2), 20
    d = np.tile(rng.uniform(-1, 1, 5), (poses, 1)) + noise * rng.standard_normal((poses, 5))
    found = np.tile(np.diag([1.0, 2.0, 3.0]), (poses, 1, 1)) * rng.uniform(0.9, 1.1, (poses, 1, 1))
    by_pose = fitted(d, found)
    assert not by_pose[:5].any() and np.isfinite(by_pose).all()
    vibrations = RitzModes(jnp.zeros((4, 3, 3)), jnp.asarray(1.0), by_pose=jnp.asarray(by_pose))
    middle = np.exp(np.mean(np.log(found[:, range(3), range(3)]), axis=0))
    told = stiffness(vibrations, jnp.asarray(d)[:, None])
    np.testing.assert_allclose(np.moveaxis(told, -1, 0), np.tile(np.diag(middle), (poses, 1, 1)), rtol=1e-6, atol=1e-12)


def test_in_how_many_poses_a_training_looks():
    assert [poses_of(steps) for steps in (250, 256, 1000, 2000, 100_000)] == [0, 16, 16, 31, 128]


def test_training_resuming_and_coming_back(tmp_path, plain_jax, monkeypatch):
    """Stopped at a checkpoint and resumed is the same as never stopped; the swing makes a difference, and is told."""
    tables = load_scene(write_scene(tmp_path)).to_dict()
    tables["network"] |= {"cell": "swing", "vibrations": 3}
    tables["training"] |= {"motion_augmentation": 0.5, "validate_every": 40, "learning_rate": 0.02}
    tables["garment"]["pins"], tables["physics"]["collision"]["search"] = "pins", "candidates"
    scene, reports = scene_from(tables, source=str(tmp_path / "scene.toml")), []

    for name, number in {"STEPS": 2, "FEWEST": 4}.items():
        monkeypatch.setattr(f"ncs_jax.runs.pose_stiffness.{name}", number)
    with monkeypatch.context() as patch:
        patch.setattr("ncs_jax.runs.train.ALONG", 0)
        patch.setattr("ncs_jax.runs.train.IDLE", np.inf)
        made = train(scene, tmp_path / "run", steps=40, report=reports.append)
    assert np.ptp(made.assembly.model.vibrations.by_pose[-2:], axis=0).max() > 0.01  # the pose tells how stiff it is
    moved = np.mean([r.moved for r in reports])
    assert reports[-1].message == f"the dynamic branch is idle: alpha = 0 and alpha = 1 differ by {moved:.2g} mm"
    fresh = replace(made, params=initial_state(made.assembly.model, made.assembly.network, 0).params)
    before, after = (run.evaluate(scene.motion.files[0], exact=False)["total"].mean() for run in (fresh, made))
    assert after < before and reports[-1].moved > IDLE and not any(r.dropped for r in reports)
    again = load_run(tmp_path / "run")
    assert isinstance(again.assembly.network, Swing)
    motion = scene.motion.files[0]
    np.testing.assert_array_equal(again.animate(motion), made.animate(motion))
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "40")
    resumed = train(scene, tmp_path / "run", resume=True, report=reports.append)
    assert reports[-1].step == 40
    assert re.fullmatch(r"the cloth goes along with [1-9] % of its swing, [01]\.\d+ of \d\d mm: .*", reports[-1].message)
    jax.tree.map(np.testing.assert_array_equal, resumed.params, made.params)
    np.testing.assert_array_equal(resumed.assembly.model.vibrations.by_pose, made.assembly.model.vibrations.by_pose)
    _begin_with_its_vibrations(scene, tmp_path, monkeypatch)
    _refuse_an_earlier_swing(scene, tmp_path / "run")


def _begin_with_its_vibrations(scene, folder, monkeypatch):
    """Those of the same garment are not looked for again, also where its path is relative; of another material they are."""
    scene = replace(scene, garment=replace(scene.garment, file="cloth.npz"))
    with monkeypatch.context() as patch:
        patch.setattr("ncs_jax.prepare.build.kept", lambda *_: pytest.fail("looked for"))
        begun = train(scene, None, steps=10, start=folder / "run")
        assert begun.assembly.model.vibrations.by_pose is not None
        heavier = replace(scene, physics=replace(scene.physics, density=0.3))
        with pytest.raises(pytest.fail.Exception):
            train(heavier, None, steps=10, start=folder / "run")


def _refuse_an_earlier_swing(scene, folder):
    """Without a slope it was trained to add its swing to the cloth: it is animated, and neither resumed nor begun from."""
    for made in folder.glob("prepared-*.npz"):
        made.unlink()
    with np.load(folder / "prepared.npz") as kept:
        arrays = {name: kept[name] for name in kept if name != "slope"}
    np.savez(folder / "prepared.npz", **arrays)
    assert load_run(folder).assembly.model.vibrations.slope is None
    for how in ({"out": folder, "resume": True}, {"start": folder}):
        with pytest.raises(InputError, match="a swing of this version expected") as fault:
            train(scene, steps=80, **how)
        assert fault.value.file == str(folder) and "slope" in fault.value.field and "anew" in fault.value.mend


def test_a_run_of_an_earlier_version_still_loads(tmp_path, plain_jax):
    tables = load_scene(write_scene(tmp_path)).to_dict()
    tables["physics"]["collision"]["search"], tables["motion"]["validation"] = "candidates", []
    train(scene_from(tables, source=str(tmp_path / "scene.toml")), tmp_path / "run", steps=10)
    with np.load(tmp_path / "run" / "prepared.npz") as kept:
        arrays = {name: kept[name] for name in kept if name not in ("vibrations", "energy")}
    np.savez(tmp_path / "run" / "prepared.npz", **arrays)
    assert load_run(tmp_path / "run").assembly.model.vibrations is None


def test_cloth_that_hangs_on_nothing_is_refused(tmp_path):
    tables = load_scene(write_scene(tmp_path)).to_dict()
    tables["network"]["cell"], tables["body"]["file"] = "swing", "none"
    np.savez(tmp_path / "still.npz", poses=np.zeros((3, 1, 3)), trans=np.arange(9.0).reshape(3, 3) / 100, fps=np.array(30.0))
    tables["motion"] |= {"files": ["still.npz"], "validation": []}
    scene = scene_from(tables, source=str(tmp_path / "scene.toml"))
    with pytest.raises(InputError, match="hangs on something"):
        assemble(scene)
    model = assemble(scene.without_network()).model  # a simulation asks for no vibrations, and for no modes
    assert model.vibrations is None and not model.basis.size


def test_the_default_cell_is_gated_where_no_vibration_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr("ncs_jax.prepare.build.kept", lambda *_: None)
    scene = load_scene(write_scene(tmp_path, SCENE.replace('cell = "gated"\n', "")))
    found = assemble(scene)
    assert scene.network.cell == "auto" and with_cell(scene).network.cell == "swing"
    assert found.scene.network.cell == "gated" and found.model.vibrations is None and not isinstance(found.network, Swing)

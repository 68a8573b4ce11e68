"""The training step: what it differentiates, what it leaves out, and what it does with numbers that are not finite."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.between import with_between
from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.contact.surface import vertex_normals
from ncs_jax.energies.terms import StepInputs
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import InputError
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.scene.model import pose_body
from ncs_jax.scene.spec import load_scene
from ncs_jax.scene.step_inputs import step_inputs
from ncs_jax.training.batches import CHUNK, batches, chunks, focused
from ncs_jax.training.loss import physics, with_bodies
from ncs_jax.training.metrics import diagnose, training_metrics
from ncs_jax.training.step import chunk_runner, initial_state, step_size

from .ready import TERMS, lowered, one_gradient, prepared, scopes
from .scenes import write_scene

NEAR = {"physics.collision.search": "candidates"}  # a search that compiles several times as fast
runner = cache(chunk_runner)


def test_single_precision_energies_agree_with_a_plain_double_precision_reference(rng):
    """The batched path in float32 against every term of one pose after the other in float64, with every pair searched."""
    assembly, _, ends, _ = prepared({"physics.collision.points": "auto"})
    model, track, poses = assembly.model, assembly.track, np.asarray(ends[0])
    back = np.maximum(poses[None] - np.arange(3)[:, None], 0)
    matrices = jnp.moveaxis(track.matrices[back], 1, -1)
    rest = model.garment.mesh.rest
    offsets = [(0.01 * rng.normal(size=(*rest.shape, len(poses)))).astype(np.float32) for _ in range(3)]
    share = jnp.ones(len(poses), jnp.float32)
    fast = jax.jit(lambda model, m, *offsets: physics(model, model.blend, offsets, m, share)[0])(model, matrices, *offsets)

    def double(tree):
        return jax.tree.map(lambda a: jnp.asarray(a, jnp.float64) if a.dtype == jnp.float32 else a, tree)

    @jax.jit
    def one(model, matrices, offsets):
        rest = model.garment.mesh.rest
        x, previous, before = (skin(blend(m, model.blend), rest + offset) for m, offset in zip(matrices, offsets, strict=True))
        terms = dataclasses.replace(model.terms, collision=None)
        body = pose_body(model, matrices[0])
        parts = energy_terms(x, model.garment, model.material, StepInputs(1 / model.fps, previous, before), terms)
        return parts, x, body, vertex_normals(body, model.surface)

    exact = double(model)
    for i in range(len(poses)):
        at = ([np.float64(table)[..., i] for table in group] for group in (matrices, offsets))
        expected, x, body, normals = jax.device_get(one(exact, *at))
        surface, verts = exact.surface, len(x)
        nearest = np.argmin(np.linalg.norm(x[:, None] - body[None], axis=-1), axis=1).astype(np.int32)
        x = with_points(x, surface.points)
        nearest = np.asarray(with_between(jnp.asarray(x), jnp.asarray(body), jnp.asarray(nearest), surface))
        assert len(x) > verts
        distance = np.sum(normals[nearest] * (x - body[nearest]), axis=-1)
        short = np.minimum(distance - float(exact.material.thickness), 0)
        expected["collision"] = float(exact.material.collision) * np.sum(short**2)
        assert expected.keys() == fast.keys() and expected["collision"] > 0
        for name, value in expected.items():
            np.testing.assert_allclose(fast[name][i], value, rtol=1e-5, err_msg=name)


@pytest.mark.parametrize("method", ["ncs", "pbns", "snug"])
def test_the_step_is_the_derivative_of_the_mean_energy(method):
    """Against automatic differentiation of the whole chain: x_{t-1} and x_{t-2} are constants to NCS, and not to SNUG."""
    from ncs_jax.energies.terms import StepInputs
    from ncs_jax.energies.total import total
    from ncs_jax.geometry.skinning import blend, skin
    from ncs_jax.network.methods.method import decode
    from ncs_jax.scene.model import pose_body

    assembly, spec, ends, pairs = prepared({"network.method": method, **NEAR}, dtype=jnp.float64)
    model, network, track = assembly.model, assembly.network, assembly.track
    hold = (lambda x: x) if method == "snug" else jax.lax.stop_gradient
    terms = network.loss(model.terms)
    assert (terms.inertia, terms.through_time) == (method != "pbns", method == "snug")
    params = initial_state(model, network, 3).params
    params = jax.tree.map(lambda p: p + 0.02 * np.cos(np.arange(p.size, dtype=p.dtype)).reshape(p.shape), params)
    ends = ends[0]

    def loss(params):
        codes = network.windows(params, track, ends, spec.window, 3)
        assert (codes.dynamic is None) == (method != "ncs")
        offsets = decode(network, params, model, codes.together())

        def one(sample):
            end, offset = sample
            matrices = [track.matrices[jnp.maximum(end - back, 0)] for back in (2, 1, 0)]
            x = [skin(blend(m, model.blend), model.garment.mesh.rest + offset[:, :, k]) for k, m in enumerate(matrices)]
            frame = StepInputs(1 / model.fps, hold(x[1]), hold(x[0]), body=pose_body(model, matrices[2]))
            return total(x[2], model.garment, model.material, frame, terms, model.surface)

        return jnp.mean(jax.lax.map(one, (ends, jnp.moveaxis(offsets, -1, 0))))

    value, expected = jax.jit(jax.value_and_grad(loss))(params)
    found, parts, _ = one_gradient(assembly, spec, params, ends, pairs[0])
    np.testing.assert_allclose(sum(np.mean(p) for p in parts.values()), value, rtol=1e-12)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-12 * (np.abs(b).max() + 1))
    assert all(np.abs(b).max() > 0 for b in jax.tree.leaves(expected))


@pytest.mark.parametrize(
    ("changes", "absent"),
    [
        ({"garment.pins": "pins"}, set()),
        ({}, {"pinning"}),
        ({"physics.bending.stiffness": 0}, {"bending", "pinning"}),
        ({"physics.membrane.model": "none"}, {"membrane", "pinning"}),
        ({"physics.membrane.lam": 0, "physics.membrane.mu": 0}, {"membrane", "pinning"}),
        ({"physics.gravity": [0, 0, 0]}, {"gravity", "pinning"}),
        ({"physics.collision.stiffness": 0}, {"collision", "pinning"}),
        ({"physics.inertia": False}, {"inertia", "pinning"}),
        ({"motion.files": [], "motion.validation": []}, {"inertia", "pinning"}),
        ({"body.file": "none", "motion.files": [], "motion.validation": []}, {"collision", "inertia", "pinning"}),
    ],
)
def test_what_a_scene_lacks_is_not_traced(plain_jax, changes, absent):
    assembly, spec, ends, pairs = prepared({**NEAR, **changes})
    text = lowered(assembly, spec, ends, pairs)
    assert scopes(text) == set(TERMS) - absent
    still = changes.get("motion.files") == []
    assert ("DynamicEncoder" in text) == (not still)
    made = jax.eval_shape(lambda model: initial_state(model, assembly.network, 0), assembly.model)
    assert ("dynamic" in made.params) == (not still)


def test_friction_asks_for_a_past():
    assembly = prepared(NEAR)[0]
    model = dataclasses.replace(assembly.model, terms=dataclasses.replace(assembly.model.terms, friction=True))
    with pytest.raises(InputError, match=r"past\.unposed: missing"):
        step_inputs(model, assembly.track.matrices[0])


def test_a_body_posed_once_for_all_frames_gives_the_same_step(monkeypatch):
    assembly, spec, ends, pairs = prepared({"network.method": "ncs", **NEAR}, dtype=jnp.float64)
    params = initial_state(assembly.model, assembly.network, 3).params
    track = with_bodies(assembly.model, assembly.track, 3)
    assert track.bodies.shape == (len(track.start), len(assembly.model.body), 6)
    expected, energies, _ = one_gradient(assembly, spec, params, ends[0], pairs[0])
    found, parts, _ = one_gradient(dataclasses.replace(assembly, training_features=track), spec, params, ends[0], pairs[0])
    monkeypatch.setattr("ncs_jax.training.loss.BODIES", track.bodies.nbytes - 1)
    assert with_bodies(assembly.model, assembly.track, 3) is assembly.track
    for name, energy in energies.items():
        np.testing.assert_allclose(parts[name], energy, rtol=1e-5, err_msg=name)
    size = max(np.abs(leaf).max() for leaf in jax.tree.leaves(expected))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * size)


def test_energy_falls(plain_jax):
    assembly, spec, _, _ = prepared(NEAR)
    run = runner(assembly.network, spec)
    state, energy = initial_state(assembly.model, assembly.network, 0), []
    for first, count in chunks(0, 60):
        ends = jnp.asarray(batches(assembly.track.start.shape[0], spec.batch, 0, first, count))
        state, logs = run(state, ends, jnp.zeros_like(ends), 60, assembly.model, assembly.track)
        energy.append(float(sum(np.mean(v) for k, v in logs.items() if k != "gravity")))
    assert energy[-1] < 0.6 * energy[0]
    assert int(state.dropped) == 0 and int(state.step) == 60
    look = jax.jit(lambda *given: training_metrics(assembly.model, assembly.network, spec.window, *given))
    seen = look(state.params, assembly.track, ends[-1])
    assert np.all((seen["strain"] >= 0) & (seen["strain"] < 20)) and seen["strain"].shape == ends[-1].shape
    assert 0 <= float(seen["penetrating"]) <= 100


def test_a_step_that_is_not_finite_is_dropped_counted_and_named(plain_jax):
    assembly, spec, ends, pairs = prepared(NEAR)
    model = assembly.model
    run = runner(assembly.network, spec)
    state = initial_state(model, assembly.network, 0)
    before = jax.tree.map(np.asarray, state.params)
    length = model.garment.mesh.hinge_angle.at[7].set(jnp.nan)
    mesh = dataclasses.replace(model.garment.mesh, hinge_angle=length)
    broken = dataclasses.replace(model, garment=dataclasses.replace(model.garment, mesh=mesh))
    state, _ = run(state, ends, pairs, 100, broken, assembly.track)
    assert int(state.dropped) == CHUNK and int(state.step) == CHUNK
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(state.params), strict=True):
        assert np.array_equal(a, b)
    message = diagnose(broken, assembly.network, state.params, assembly.track, state.fault)
    assert "bending" in message and f"step {CHUNK - 1}" in message
    vertex = int(message.split("vertex ")[1].split()[0])
    assert vertex in np.asarray(mesh.hinges[7])
    state, _ = run(state, ends, pairs, 100, model, assembly.track)
    assert int(state.dropped) == CHUNK
    assert not all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(state.params), strict=True))


def test_cloth_that_comes_too_near_itself_is_pushed_apart(plain_jax):
    """A sheet folded over itself in unposed space; and a training step of a scene that has self-contact is finite."""
    changes = {"physics.self_contact.stiffness": 50.0, "physics.self_contact.thickness": 0.02, "physics.collision.stiffness": 0}
    assembly, spec, ends, pairs = prepared(changes)
    model = assembly.model
    rest = np.asarray(model.garment.mesh.rest)
    fold = np.where(rest[:, :1] > 0.02, -2 * rest[:, :1] * [1, 0, 0] + [0.013, 0.017, 0.01], 0)
    matrices = assembly.track.matrices[ends[0][0]]

    def value(offsets):
        x = skin(blend(matrices, model.blend), jnp.asarray(rest, jnp.float32) + offsets)
        terms = dataclasses.replace(
            model.terms, membrane=None, bending=False, collision=None, gravity=False, inertia=False, pinning=False
        )
        return energy_terms(x, model.garment, model.material, StepInputs(), terms)["self_contact"]

    offsets = jnp.asarray(fold, jnp.float32)
    before, slope = jax.jit(jax.value_and_grad(value))(offsets)
    assert before > 1e-4
    upper = rest[:, 0] > 0.02
    slope = np.asarray(slope)
    assert np.sum(slope[upper, 2]) < -1e-3 and np.sum(slope[~upper, 2]) > 1e-3  # down the gradient, the halves part
    params = initial_state(model, assembly.network, 0).params
    gradient, parts, _ = one_gradient(assembly, spec, params, ends[0], pairs[0])
    assert parts["self_contact"].shape == (spec.batch,)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves((gradient, parts)))


def test_motion_augmentation_leaves_the_encoders_and_inertia_alone(plain_jax):
    assembly, spec, ends, _ = prepared({"training.motion_augmentation": 1.0, **NEAR})
    params = initial_state(assembly.model, assembly.network, 0).params
    grads, parts, _ = one_gradient(assembly, spec, params, ends[0], np.roll(np.arange(spec.batch, dtype=np.int32), 1))
    for name in ("static", "dynamic"):
        assert all(np.all(np.asarray(g) == 0) for g in jax.tree.leaves(grads[name]))
    assert any(np.any(np.asarray(g) != 0) for g in jax.tree.leaves(grads["decoder"]))
    assert np.all(np.asarray(parts["inertia"]) == 0)


def test_learned_skinning_weights_get_a_gradient_and_stay_weights(plain_jax):
    from ncs_jax.network.methods.method import garment_blend

    assembly, spec, ends, pairs = prepared({"garment.learn_weights": True, **NEAR})
    run = runner(assembly.network, spec)
    state, _ = run(initial_state(assembly.model, assembly.network, 0), ends, pairs, 100, assembly.model, assembly.track)
    learned = np.asarray(jax.jit(lambda p: garment_blend(assembly.network, p, assembly.model).weights)(state.params))
    assert np.abs(learned - assembly.model.blend.weights).max() > 1e-5
    np.testing.assert_allclose(learned.sum(axis=1), 1, atol=1e-6)
    assert np.array_equal(learned == 0, assembly.model.blend.weights == 0)


def test_batches_are_a_function_of_the_step():
    whole = batches(17, 4, 5, 0, 12)
    assert np.array_equal(whole[7:], batches(17, 4, 5, 7, 5))
    assert np.array_equal(np.sort(whole.reshape(-1)[:17]), np.arange(17))
    assert not np.array_equal(whole, batches(17, 4, 6, 0, 12))


def test_chunks_cut_at_the_same_steps_wherever_they_begin():
    assert list(chunks(0, 25)) == [(0, 10), (10, 10), (20, 5)]
    assert list(chunks(10, 25)) == [(10, 10), (20, 5)]


def test_step_size_falls_to_two_percent(tmp_path):
    spec = load_scene(write_scene(tmp_path)).training
    assert float(step_size(spec, 0, 100)) == pytest.approx(spec.learning_rate)
    assert float(step_size(spec, 100, 100)) == pytest.approx(0.02 * spec.learning_rate)


def test_a_share_of_a_batch_is_drawn_where_contact_costs_most():
    ends = batches(40, 20, 0, 0, 30)
    weight = np.where(np.arange(40) == 7, 1000.0, 1.0)
    more = focused(ends, np.arange(40), weight, 0.5, 0, 0)
    assert ((more == 7).sum(axis=1) >= 8).all() and ((more != ends).sum(axis=1) <= 10).all()
    np.testing.assert_array_equal(more[10:], focused(ends[10:], np.arange(40), weight, 0.5, 0, 10))  # as a resumed run sees it
    assert set(focused(ends, np.arange(100, 140), weight, 0.9, 0, 0)[more != ends]) <= set(range(100, 140)) | set(range(40))

"""Terms and a network of one's own: trained, simulated, measured, resumed, and refused where they are not those of the run."""

from __future__ import annotations

import re
import tomllib
import warnings
from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ncs_jax
from ncs_jax import InputError
from ncs_jax.cli import main
from ncs_jax.energies.terms import MEASURED, NAMES, StepInputs, Terms
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import InputWarning
from ncs_jax.metrics.motion import MEASURES
from ncs_jax.metrics.quality import QUANTITIES
from ncs_jax.network.encoders import DynamicEncoder
from ncs_jax.network.methods.choose import network_from
from ncs_jax.training.step import chunk_runner, initial_state

from .scenes import SCENE, write_scene

PUSH = 0.4  # N


def push(x, step):
    return -PUSH * jnp.mean(x[:, 0])


def hook(x, step):
    return 2.0 * jnp.sum((x[0] - step.body[0]) ** 2)


class Plain(nn.Module):
    """A decoder of one layer."""

    verts: int

    @nn.compact
    def __call__(self, code, basis):
        offsets = nn.Dense(3 * self.verts, kernel_init=nn.initializers.normal(1e-4))(code)
        return jnp.moveaxis(offsets.reshape(*code.shape[:-1], self.verts, 3), (-2, -1), (0, 1))


def plain(scene, model):
    return replace(network_from(scene, model), decoder=Plain(len(model.garment.mesh.rest)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    write_scene(folder)
    return folder


def scene(folder, **tables):
    return ncs_jax.scene_from(tomllib.loads(SCENE) | tables, source=str(folder / "scene.toml"))


@pytest.fixture(scope="module")
def trained(folder):
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return ncs_jax.train(scene(folder), folder / "run", steps=20, terms=[push, hook])


@pytest.mark.parametrize(
    "name", ["membrane", "total", "strain", "speed", "out_of_balance", "validation_total", "push", "no name"]
)
def test_a_term_is_refused_whose_name_is_taken(name):
    def mine(x, step):
        return jnp.sum(x)

    mine.__name__ = name
    with pytest.raises(ValueError, match=f"no other term or measure has, not '{name}'"):
        Terms(own=(push, mine))


@pytest.mark.parametrize("value", [None, {}, "x", jnp.zeros(3), jnp.zeros((1,))], ids=["None", "dict", "str", "3", "1"])
def test_a_term_that_returns_no_energy_is_named(trained, value):
    def mine(x, step):
        return value

    model = trained.assembly.model
    alone = Terms(None, bending=False, collision=None, gravity=False, inertia=False, own=(mine,))
    with pytest.raises(InputError, match="terms: mine: a scalar expected, the energy in J"):
        energy_terms(model.garment.mesh.rest, model.garment, model.material, StepInputs(), alone)


def test_terms_are_logged_and_measured_by_their_names(folder, trained, plain_jax):
    with (folder / "run" / "log.csv").open() as file:
        logged = set(file.readline().strip().split(","))
    assert {"push", "hook"} <= logged
    told = {name.removeprefix("validation_") for name in logged} - {"push", "hook", *NAMES}
    assert told | {*QUANTITIES, *MEASURES} == set(MEASURED)  # none of which a term may be called
    motion = str(folder / "swing.npz")
    x, found = trained.animate(motion), trained.evaluate(motion)
    np.testing.assert_allclose(found["push"], -PUSH * x[:, :, 0].mean(axis=1), rtol=1e-4, atol=1e-6)
    parts = [found[name] for name in ("membrane", "bending", "collision", "gravity", "inertia", "push", "hook")]
    np.testing.assert_allclose(found["total"], sum(parts), rtol=1e-5)


def test_a_run_asks_for_its_terms(folder, trained, plain_jax, capsys):
    motion = str(folder / "swing.npz")
    np.testing.assert_array_equal(ncs_jax.load_run(folder / "run").animate(motion), trained.animate(motion))
    with pytest.raises(InputError, match="own terms are needed"):
        ncs_jax.load_run(folder / "run").evaluate(motion)
    assert main(["evaluate", str(folder / "run"), "--motion", motion]) == 2
    assert "own terms are needed" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"push.*hook"):
        ncs_jax.load_run(folder / "run", terms=[push])
    with pytest.raises(InputError, match=r"push.*hook"):
        ncs_jax.train(scene(folder), folder / "run", resume=True)
    again = ncs_jax.load_run(folder / "run", terms=[push, hook]).evaluate(motion)
    np.testing.assert_array_equal(again["push"], trained.evaluate(motion)["push"])
    assert ncs_jax.train(scene(folder), folder / "run", resume=True, terms=[push, hook]).steps == 20


def test_names_that_are_taken_are_refused(folder):
    def membrane(x, step):
        return jnp.sum(x)

    for terms in ([push, push], [membrane], [lambda x, step: jnp.sum(x)]):
        with pytest.raises(InputError, match="terms"):
            ncs_jax.train(scene(folder), None, steps=10, terms=terms)


def test_a_term_that_breaks_is_named(folder, plain_jax):
    def broken(x, step):
        return jnp.sum(jnp.sqrt(x[4] - x[4]))

    reports = []
    with pytest.warns(
        InputWarning, match=r"10 of 10 steps were dropped.*nothing was learned.*broken is not finite at vertex 4"
    ):
        ncs_jax.train(scene(folder), None, steps=10, terms=[broken], report=reports.append)
    assert reports[-1].dropped == 10 and "broken is not finite at vertex 4" in reports[-1].message


def test_without_them_the_program_is_the_same(folder, plain_jax):
    text = []
    for terms, network in (((), None), ((push,), None), ((), network_from)):
        a = ncs_jax.assemble(scene(folder), terms=terms, network=network)
        state, spec = initial_state(a.model, a.network, 0), a.scene.training
        ends = jnp.zeros((1, spec.batch), jnp.int32)
        program = jax.make_jaxpr(chunk_runner(a.network, spec))(state, ends, ends, 10, a.model, a.track)
        text.append(re.sub(r"0x[0-9a-f]+", "", str(program)))
    assert text[0] == text[2] and text[0] != text[1]


def test_a_network_of_ones_own(folder, tmp_path, plain_jax):
    run = ncs_jax.train(scene(folder), tmp_path / "run", steps=10, network=plain)
    motion = str(folder / "swing.npz")
    with pytest.raises(InputError, match=r"plain .*in Python, give network=\.\.\."):
        ncs_jax.load_run(tmp_path / "run")
    with pytest.raises(InputError, match=r"network: weights of the shapes of a run .*in Python, network=\.\.\."):
        ncs_jax.train(scene(folder), None, steps=10, start=run)
    again = ncs_jax.load_run(tmp_path / "run", network=plain)
    np.testing.assert_array_equal(again.animate(motion), run.animate(motion))


def test_a_term_of_the_velocity_is_told_that_there_is_no_past(trained, plain_jax):
    """A swing and PBNS train on static energies: what subtracts the past there would be a TypeError of JAX's."""

    def drag(x, step):
        return jnp.sum((x - step.previous) ** 2)

    model = trained.assembly.model
    alone = Terms(None, bending=False, collision=None, gravity=False, inertia=False, own=(drag,))
    rest = model.garment.mesh.rest
    with pytest.raises(InputError, match=r"terms: drag: .*step\.previous.*network\.cell = 'gated'"):
        energy_terms(rest, model.garment, model.material, StepInputs(), alone)
    parts = energy_terms(rest, model.garment, model.material, StepInputs(1 / 30, rest, rest), alone)
    assert float(parts["drag"]) == 0

    def wrong(x, step):
        return None - x

    with pytest.raises(TypeError):  # a mistake of another kind stays what it is
        energy_terms(rest, model.garment, model.material, StepInputs(1 / 30, rest, rest), replace(alone, own=(wrong,)))


def test_arrays_of_another_shape_are_refused_before_they_give_numbers(folder, trained, plain_jax):
    """Indices beyond an array are clipped in JAX: each of these would give finite, wrong numbers."""
    model, network = trained.assembly.model, trained.assembly.network
    init, step = ncs_jax.stepper(model, network, trained.params)
    track = trained.track(str(folder / "swing.npz"))
    joints, frames, verts = len(model.skeleton.parents), len(track.start), len(model.basis)
    eye, root = jnp.broadcast_to(jnp.eye(3), (joints, 3, 3)), jnp.zeros(3)
    pair, two = jnp.stack([eye, eye]), jnp.zeros((2, 3))
    step(init(), eye, root)
    step(init(2), pair, two, jnp.array([0.0, 1.0]))
    garment = np.zeros((frames, verts, 3))
    for wrong, match in {
        lambda: step(init(), eye[:-1], root): "rotations",
        lambda: step(init(), eye[None], root[None]): r"rotations.*init\(number of characters\)",
        lambda: step(init(2), eye, root): r"rotations.*init\(\) for one",
        lambda: step(init(), eye[..., 0], root): "rotations",
        lambda: step(init(), eye.astype(int), root): "rotations: floating-point",
        lambda: step(init(), eye, root[:1]): "translation",
        lambda: step(init(), eye, root, jnp.ones(1)): r"alpha: one number expected \(found 'shape \(1,\)'",
        lambda: step(init(2), pair, two, jnp.ones((2, 1))): r"alpha: one number, or one for every character, \(2,\), expected",
        lambda: step(init(2), pair, two, jnp.ones(3)): "alpha: one number, or one for every",
        lambda: ncs_jax.local_rotations(model, jnp.zeros((4, max(model.source_joints), 3))): "poses",
        lambda: ncs_jax.frame_inputs(model, track, frames): "frame: a frame from 0",
        lambda: ncs_jax.measure(model, garment[:, 1:], track): "vertices",
        lambda: ncs_jax.measure(model, np.zeros((frames + 1, verts, 3)), track): "vertices",
        lambda: ncs_jax.total(
            jnp.zeros((verts + 1, 3)), model.garment, model.material, StepInputs(), Terms()
        ): "x: positions.*jax.vmap",
        lambda: trained.animate(track, float("nan")): "alpha",
    }.items():
        with pytest.raises(InputError, match=match):
            wrong()


def test_a_decoder_with_axes_in_another_order_is_named(folder, plain_jax):
    class Turned(Plain):
        @nn.compact
        def __call__(self, code, basis):
            return nn.Dense(3 * self.verts)(code).reshape(*code.shape[:-1], self.verts, 3)

    def turned(scene, model):
        return replace(network_from(scene, model), decoder=Turned(len(model.basis)))

    with pytest.raises(InputError, match=r"decoder: offsets .* vertices, axes, poses"):
        ncs_jax.train(scene(folder), None, steps=10, network=turned)


class Encoder(nn.Module):
    """A static encoder that has no `sizes`."""

    code: int
    frames: bool = True

    @nn.compact
    def __call__(self, descriptors):
        flat = descriptors.reshape(*descriptors.shape[:-2], -1) if self.frames else descriptors.reshape(-1)
        return nn.tanh(nn.Dense(self.code)(flat))


def test_an_encoder_of_ones_own_is_measured_and_not_asked(folder, plain_jax):
    def encoded(scene, model):
        made = network_from(scene, model)
        return replace(made, static=Encoder(made.dynamic.state))

    run = ncs_jax.train(scene(folder), None, steps=10, network=encoded)
    kernel = run.params["static"]["Dense_0"]["kernel"]
    assert kernel.shape[1] == run.assembly.network.code_size(run.assembly.model) == run.assembly.network.dynamic.state
    assert np.isfinite(run.animate(str(folder / "swing.npz"))).all()


class Lacking(DynamicEncoder):
    """A dynamic encoder that asks for what it has not."""

    def by_frame(self, descriptor):
        return self.nothing(descriptor)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda made: replace(made, static=Encoder(made.dynamic.state + 1)), r"dynamic encoder: codes as long as the static"),
        (
            lambda made: replace(made, static=Encoder(8, frames=False)),
            r"static encoder: codes \(\*frames, code\).*leading axes",
        ),
        (lambda made: replace(made, dynamic=Lacking((8,), (16,), 16)), r"network: .*has no attribute .*own_network\.ipynb"),
    ],
)
def test_an_encoder_that_does_not_fit_is_refused_at_once(folder, plain_jax, change, match):
    def wrong(scene, model):
        return change(network_from(scene, model))

    with pytest.raises(InputError, match=match):
        ncs_jax.assemble(scene(folder), network=wrong)


def test_a_term_of_the_velocity_is_refused_before_vibrations_are_looked_for(folder, plain_jax, monkeypatch):
    def drag(x, step):
        return jnp.sum((x - step.previous) ** 2)

    def looked(*_):
        raise AssertionError("vibrations were looked for")

    monkeypatch.setattr("ncs_jax.simulation.ritz_modes.softest_ritz_modes", looked)
    pinned = tomllib.loads(SCENE)["garment"] | {"pins": "pins"}
    swings = scene(folder, garment=pinned, network={"cell": "swing"})
    with pytest.raises(InputError, match=r"terms: drag: .*network\.cell = 'gated'"):
        ncs_jax.assemble(swings, terms=[push, drag])
    with pytest.raises(AssertionError, match="looked for"):  # by terms that do without
        ncs_jax.assemble(swings, terms=[push, hook])


@pytest.mark.parametrize(
    ("term", "match"),
    [
        (lambda x, step: x.sum(axis=1), "a scalar expected"),
        (lambda x, step: float(np.asarray(x).sum()), r"a term of jax\.numpy expected.*use jax\.numpy in the place of NumPy"),
        (lambda x, step: x.sum() if x.sum() > 0 else 0.0, r"a term of jax\.numpy expected.*jnp\.where in that of if"),
    ],
    ids=["vector", "NumPy", "if"],
)
def test_a_term_that_no_training_can_take_is_refused_at_once(folder, plain_jax, term, match):
    term.__name__ = "mine"
    with pytest.raises(InputError, match=f"terms: mine: {match}"):
        ncs_jax.assemble(scene(folder), terms=[push, term])


def test_a_run_begun_from_one_with_own_terms_says_that_it_is_without(folder, trained, plain_jax):
    with pytest.warns(
        InputWarning, match=r"run was trained with terms of one's own, push, hook, and this run is trained without"
    ):
        ncs_jax.train(scene(folder), None, steps=10, start=folder / "run")
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        ncs_jax.train(scene(folder), None, steps=10, terms=[push, hook], start=trained)


def test_a_motion_as_arrays_is_animated(folder, trained, plain_jax):
    name = str(folder / "swing.npz")
    np.testing.assert_array_equal(trained.animate(trained.motion(name)), trained.animate(name))

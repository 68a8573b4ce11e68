"""The networks: what holds exactly because the dynamic encoder has no bias, and the decoder's one linear map."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.network.decoder import Decoder, merge
from ncs_jax.network.encoders import DynamicEncoder, LinearEncoder, StaticEncoder, recurrence

JOINTS, NUMBERS, STATE = 5, 12, 24
every_dtype = pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
every_cell = pytest.mark.parametrize("cell", [DynamicEncoder, LinearEncoder])


@cache
def encoder(dtype, cell=DynamicEncoder):
    network = cell(joint_sizes=(8, 8), sizes=(16, 16), state=STATE, dtype=dtype)
    params = network.init(jax.random.key(0), jnp.zeros((1, JOINTS, NUMBERS), dtype), jnp.zeros(STATE, dtype))
    return network, params, jax.jit(network.apply)


def descriptors(rng, frames, dtype=jnp.float64):
    return jnp.asarray(rng.normal(size=(frames, JOINTS, NUMBERS)), dtype)


@every_dtype
def test_no_bias_anywhere_and_types_are_kept(dtype):
    params = encoder(dtype)[1]["params"]
    names = ["/".join(str(k.key) for k in path) for path, _ in jax.tree_util.tree_leaves_with_path(params)]
    assert names and all(name.endswith("kernel") or name == "recurrent" for name in names), names
    assert all(leaf.ndim == 2 and leaf.dtype == dtype for leaf in jax.tree.leaves(params))


@every_dtype
@every_cell
def test_no_motion_is_exactly_no_code(dtype, cell):
    _, params, apply = encoder(dtype, cell)
    codes = apply(params, jnp.zeros((7, JOINTS, NUMBERS), dtype), jnp.zeros(STATE, dtype))
    assert codes.shape == (7, STATE) and codes.dtype == dtype
    np.testing.assert_array_equal(codes, 0)


@every_dtype
@every_cell
def test_rest_before_a_motion_changes_nothing(rng, dtype, cell):
    _, params, apply = encoder(dtype, cell)
    moving = descriptors(rng, 9, dtype)
    rest = jnp.zeros((6, JOINTS, NUMBERS), dtype)
    start = jnp.zeros(STATE, dtype)
    alone, after = apply(params, moving, start), apply(params, jnp.concatenate([rest, moving]), start)
    assert jnp.any(alone)
    np.testing.assert_array_equal(after[6:], alone)
    np.testing.assert_array_equal(after[:6], 0)


def test_the_recurrence_and_its_derivatives_are_those_of_its_steps(rng):
    n = 7
    recurrent, features, state = (jnp.asarray(rng.normal(size=s)) for s in ((n, 3 * n), (9, 4, 3 * n), (4, n)))
    toward = jnp.asarray(rng.normal(size=(9, 4, n)))
    step = DynamicEncoder(state=n, dtype=jnp.float64).apply

    def stepwise(recurrent, features, state):
        states = []
        for f in features:
            state = step({"params": {"recurrent": recurrent}}, state, f, method="step")
            states.append(state)
        return jnp.sum(toward * jnp.stack(states)), jnp.stack(states)

    def whole(*given):
        states = recurrence(*given)
        return jnp.sum(toward * states), states

    (_, expected), slopes = jax.jit(jax.value_and_grad(stepwise, (0, 1, 2), has_aux=True))(recurrent, features, state)
    (_, found), gradients = jax.jit(jax.value_and_grad(whole, (0, 1, 2), has_aux=True))(recurrent, features, state)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    for a, b in zip(gradients, slopes, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


def test_when_motion_stops_the_code_decays(rng):
    _, params, apply = encoder(jnp.float64)
    moving = 10 * descriptors(rng, 20)
    rest = jnp.zeros((100, JOINTS, NUMBERS))
    codes = np.linalg.norm(apply(params, jnp.concatenate([moving, rest]), jnp.zeros(STATE)), axis=1)
    assert codes[19] > 0.5
    # Near zero every gate is 1/2: h' = h/2 + (h/2) W/2, at most 3/4 of h with the orthogonal W of the start.
    ratios = codes[60:] / codes[59:-1]
    assert ratios.max() <= 0.75 + 1e-6
    assert codes[19 + 60] < 1e-6


@every_dtype
@every_cell
def test_a_sequence_equals_its_steps(rng, dtype, cell):
    network, params, apply = encoder(dtype, cell)
    moving = descriptors(rng, 6, dtype)
    codes = apply(params, moving, jnp.zeros(STATE, dtype))

    @jax.jit
    def step(state, descriptor):
        features = network.apply(params, descriptor, method="features")
        return network.apply(params, state, features, method="step")

    state = jnp.zeros(STATE, dtype)
    for descriptor, code in zip(moving, codes, strict=True):
        state = step(state, descriptor)
        np.testing.assert_allclose(state, code, atol=1e-6 if dtype == jnp.float32 else 1e-14)
    # and continues from any state
    np.testing.assert_allclose(apply(params, moving[3:], codes[2]), codes[3:], atol=1e-6 if dtype == jnp.float32 else 1e-14)


def test_step_is_a_gated_recurrent_unit(rng):
    network, params, _ = encoder(jnp.float64)
    w = np.asarray(params["params"]["recurrent"])
    wr, wu, wc = w[:, :STATE], w[:, STATE : 2 * STATE], w[:, 2 * STATE :]
    h, f = rng.normal(size=STATE), rng.normal(size=3 * STATE)
    sigmoid = lambda a: 1 / (1 + np.exp(-a))  # noqa: E731
    reset, update = sigmoid(f[:STATE] + h @ wr), sigmoid(f[STATE : 2 * STATE] + h @ wu)
    expected = update * h + (1 - update) * np.tanh(f[2 * STATE :] + (reset * h) @ wc)
    got = network.apply(params, jnp.asarray(h), jnp.asarray(f), method="step")
    np.testing.assert_allclose(got, expected, rtol=1e-12)


@every_cell
def test_a_batch_is_its_members(rng, cell):
    _, params, apply = encoder(jnp.float64, cell)
    batch = jnp.asarray(rng.normal(size=(6, 3, JOINTS, NUMBERS)))
    codes = apply(params, batch, jnp.zeros((3, STATE)))
    for b in range(3):
        np.testing.assert_allclose(codes[:, b], apply(params, batch[:, b], jnp.zeros(STATE)), atol=1e-14)


@every_dtype
def test_a_linear_cell_cannot_grow(rng, dtype):
    _, params, apply = encoder(dtype, LinearEncoder)
    own = params["params"]
    wild = {"params": own | {"nu": 10 * own["nu"], "angle": 100 * own["angle"]}}  # time constants up to 1e13 frames
    state = jnp.asarray(rng.normal(size=STATE), dtype)
    codes = apply(wild, jnp.zeros((1000, JOINTS, NUMBERS), dtype), state)
    sizes = np.hypot(*np.split(np.concatenate([state[None], codes]).astype(float), 2, axis=1))
    assert np.all(sizes[1:] <= sizes[:-1] * (1 + 1e-6)) and sizes[-1].max() > 0.1 * sizes[0].max() > sizes[-1].min()
    moving = apply(wild, jnp.ones((1000, JOINTS, NUMBERS), dtype), state)
    assert np.isfinite(moving).all() and np.abs(moving[500:]).max() < 1e3


def test_step_of_a_linear_cell(rng):
    network, params, _ = encoder(jnp.float64, LinearEncoder)
    nu, angle = (np.asarray(params["params"][name]) for name in ("nu", "angle"))
    h, f = rng.normal(size=STATE), rng.normal(size=STATE)
    number = (
        np.exp(-np.exp(nu) + 1j * angle) * (h[: STATE // 2] + 1j * h[STATE // 2 :]) + f[: STATE // 2] + 1j * f[STATE // 2 :]
    )
    got = network.apply(params, jnp.asarray(h), jnp.asarray(f), method="step")
    np.testing.assert_allclose(got, np.concatenate([number.real, number.imag]), rtol=1e-12)


@every_dtype
def test_static_code_of_each_frame_by_itself(rng, dtype):
    network = StaticEncoder(sizes=(8, 6), dtype=dtype)
    frames = jnp.asarray(rng.normal(size=(4, JOINTS, 9)), dtype)
    params = network.init(jax.random.key(1), frames[0])
    codes = jax.jit(network.apply)(params, frames)
    assert codes.shape == (4, 6) and codes.dtype == dtype
    np.testing.assert_allclose(codes[2], network.apply(params, frames[2]), atol=1e-6 if dtype == jnp.float32 else 1e-14)


@every_dtype
@pytest.mark.parametrize("modes", [0, 4])
def test_the_merged_decoder_is_the_same_function(rng, dtype, modes):
    network = Decoder(verts=7, sizes=(10, 8), modes=modes, dtype=dtype)
    basis = jnp.asarray(rng.normal(size=(7, modes)), dtype)
    code = jnp.asarray(rng.normal(size=(3, 6)), dtype)
    params = network.init(jax.random.key(2), code, basis)["params"]
    # biases and mode coefficients start at zero: give every parameter a part
    params = jax.tree.map(lambda a: a + jnp.asarray(0.1 * rng.normal(size=a.shape), dtype), params)
    offsets = network.apply({"params": params}, code, basis)
    assert offsets.shape == (7, 3, 3) and offsets.dtype == dtype
    one, one_params = merge(network, params, basis)
    assert "coefficients" not in one_params
    got = one.apply({"params": one_params}, code, basis)
    np.testing.assert_allclose(
        got, offsets, rtol=1e-4 if dtype == jnp.float32 else 1e-11, atol=1e-6 if dtype == jnp.float32 else 0
    )


def test_one_optimiser_step_moves_vertices_by_millimetres(rng):
    """A step of 1e-3 in every parameter of the last layer, all in the worst direction; hidden features are about 1."""
    network = Decoder(verts=50, sizes=(512,), modes=0)
    code = jnp.asarray(rng.normal(size=(4, 64)), jnp.float32)
    basis = jnp.zeros((50, 0), jnp.float32)
    params = network.init(jax.random.key(3), code, basis)["params"]
    moved = {**params, "offsets": jax.tree.map(lambda a: a + jnp.float32(1e-3), params["offsets"])}
    apply = jax.jit(network.apply)
    change = jnp.abs(apply({"params": moved}, code, basis) - apply({"params": params}, code, basis))
    assert 2e-4 < jnp.max(change) < 5e-3

"""A GPU gives what the CPU gives: the gradient of a training step, a motion, a stream, a simulated frame."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import features_from_records
from ncs_jax.scene.model import local_rotations
from ncs_jax.simulation.implicit_euler import simulator_from
from ncs_jax.simulation.implicit_euler import stepper as simulation
from ncs_jax.simulation.solver.minimise import CONVERGED, Settings
from ncs_jax.training.step import initial_state

from .ready import animated, one_gradient, prepared, ready
from .simulators import advance, sleeve

GPU = "gpu"
pytestmark = pytest.mark.gpu
WIDE = {"network.decoder": [256, 256]}  # products that a GPU gives to its matrix units, which keep 10 bits of a float32


@pytest.fixture(autouse=True, scope="module")
def _there():
    if jax.default_backend() != GPU:
        pytest.skip("there is no GPU")


def on(kind, tree):
    """Return a tree of arrays on the first device of a kind."""
    return jax.device_put(tree, jax.devices(kind)[0])


def apart(a, b):
    """Return how far two trees are from each other, relative to the second."""
    a, b = (np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(tree)]) for tree in (a, b))
    return np.linalg.norm(a - b) / np.linalg.norm(b)


@pytest.mark.parametrize(("dtype", "error"), [(jnp.float64, 1e-9), (jnp.float32, 3e-3)])
def test_the_gradient_of_a_training_step(dtype, error):
    assembly, spec, ends, pairs = prepared(WIDE, dtype)
    params = jax.tree.map(lambda p: p.astype(dtype), initial_state(assembly.model, assembly.network, 0).params)

    def gradient(kind):
        model, track, *given = on(kind, (assembly.model, assembly.track, params, ends[0], pairs[0]))
        return one_gradient(replace(assembly, model=model, training_features=track), spec, *given)[:2]

    (slope, energies), (expected, terms) = gradient(GPU), gradient("cpu")
    assert next(iter(jax.tree.leaves(slope)[0].devices())).platform == GPU
    assert apart(slope, expected) < error and apart(energies, terms) < error


def test_a_motion_and_its_stream(plain_jax):
    """With float32 products, which a GPU does not compute unless it is told to: see `docs/devices.md`."""
    assembly, params, motion = ready(jnp.float32)
    track = features_from_records(assembly.model, motion)
    with jax.default_matmul_precision("highest"):
        x, expected = (
            animated(model, assembly.network, *given)
            for model, *given in (on(kind, (assembly.model, params, track)) for kind in (GPU, "cpu"))
        )
        np.testing.assert_allclose(x, expected, rtol=0, atol=2e-6)
        init, step = stepper(assembly.model, assembly.network, params)
        local = local_rotations(assembly.model, jnp.asarray(motion.poses))
        step, state = jax.jit(step, donate_argnums=0), init()
        for at, frame in enumerate(zip(list(local), list(jnp.asarray(motion.translation)), strict=True)):
            with jax.transfer_guard("disallow" if at else "allow"):  # a frame sends nothing to and fro
                state, one = step(state, *frame)
            np.testing.assert_allclose(one, x[at], rtol=0, atol=2e-6)


def test_a_simulated_frame(tmp_path):
    assembly = sleeve(tmp_path)
    motion, settings = next(iter(assembly.motions.values())), Settings(tolerance=1e-4)

    def second(kind):
        simulator = on(kind, simulator_from(assembly.model))
        state = on(kind, simulation(simulator, settings).init())
        poses, places = (jnp.asarray(a, jnp.float64) for a in (motion.poses, motion.translation))
        rotations = local_rotations(assembly.model, poses)
        for at in range(2):
            state, x = advance(simulator, settings, state, *on(kind, (rotations[at], places[at])))
            assert int(state.solution.status) == CONVERGED
        return x

    np.testing.assert_allclose(second(GPU), second("cpu"), rtol=0, atol=1e-6)

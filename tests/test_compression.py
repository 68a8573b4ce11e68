"""A smaller decoder: what it costs in millimetres, and that everything else stays as it was."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.network.compression import compress
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import features_from_records
from ncs_jax.scene.model import local_rotations

from .ready import animated, ready, run


def error(whole, smaller):
    return np.linalg.norm(smaller - whole, axis=-1)


@pytest.fixture
def garment():
    assembly, params, motion = ready()
    return assembly, params, motion, features_from_records(assembly.model, motion)


def smaller(garment, **options):
    assembly, params, _, track = garment
    network, params = compress(assembly.network, params, assembly.model, track, **options)
    return network, params, np.asarray(animated(assembly.model, network, params, track))


def test_the_full_rank_is_the_whole_decoder_on_that_motion(garment):
    assembly, params, motion, track = garment
    whole = run(assembly, params, motion)
    most = min(len(track.start), assembly.network.decoder.sizes[-1])
    np.testing.assert_allclose(smaller(garment, rank=most)[2], whole, rtol=0, atol=1e-10)
    np.testing.assert_allclose(smaller(garment)[2], whole, rtol=0, atol=1e-12)


def test_the_error_falls_with_the_rank_and_is_the_least_there_is(garment):
    assembly, params, motion, _track = garment
    whole = run(assembly, params, motion)
    errors = [np.sqrt(np.mean(error(whole, smaller(garment, rank=r)[2]) ** 2)) for r in (1, 3, 6)]
    assert errors[0] > errors[1] > errors[2] > 0
    # skinning turns offsets but hardly stretches them: the error is the tail of their singular values, nearly
    zero = jax.tree.map(jnp.zeros_like, params["decoder"])
    offsets = whole - run(assembly, {**params, "decoder": zero}, motion)
    assert errors[2] < 0.5 * np.sqrt(np.mean(np.sum((offsets - offsets.mean(axis=0)) ** 2, axis=-1)))


def test_a_smaller_decoder_holds_fewer_numbers_and_streams_what_it_animates(garment):
    assembly, _params, motion, _track = garment
    network, fewer, vertices = smaller(garment, rank=3)
    assert fewer["decoder"]["offsets"]["kernel"].shape == (vertices[0].size, 3)
    init, step = stepper(assembly.model, network, fewer)
    state, step = init(), jax.jit(step, donate_argnums=0)
    rotations = local_rotations(assembly.model, jnp.asarray(motion.poses, jnp.float64))
    for frame in range(4):
        state, x = step(state, rotations[frame], jnp.asarray(motion.translation[frame], jnp.float64))
        np.testing.assert_allclose(x, vertices[frame], rtol=0, atol=1e-10)


def test_sixteen_bits_cost_a_rounding_of_the_offsets():
    assembly, params, motion = ready(jnp.float32)
    track = features_from_records(assembly.model, motion)
    network, short = compress(assembly.network, params, assembly.model, track, bfloat16=True)
    assert short["decoder"]["offsets"]["kernel"].dtype == jnp.bfloat16
    whole = run(assembly, params, motion)
    x = np.asarray(animated(assembly.model, network, short, track))
    assert x.dtype == np.float32
    zero = jax.tree.map(jnp.zeros_like, params["decoder"])
    size = error(whole, run(assembly, {**params, "decoder": zero}, motion)).max()
    assert 0 < error(whole, x).max() < 0.01 * size


@pytest.mark.parametrize("rank", [-1, 1000])
def test_a_rank_that_cannot_be_is_refused(garment, rank):
    with pytest.raises(ValueError, match=f"rank is {rank}; from .* it can be 1 to"):
        smaller(garment, rank=rank)

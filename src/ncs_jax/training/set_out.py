"""Weights that give wanted static offsets in some poses, where a training is to begin."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.network.methods.method import Method
from ncs_jax.network.rollout import animate
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["set_out"]

STEPS, BATCH, RATE = 400, 32, 1e-3  # of Adam


def set_out(
    model: Model, network: Method, params: dict, poses: MotionFeatures, offsets: Float[np.ndarray, "frames verts 3"]
) -> dict:
    """Return the weights of a network that has learned to give such static offsets, m, in unposed space, in these poses.

        min over the weights of  sum_f |x_f - skin(rest + offsets_f)|^2,   x_f the garment at alpha = 0

    It is geometry alone and takes seconds. Half of what a step sees are the poses whose offsets are the farthest from the mean.
    """
    frames = len(offsets)
    away = np.abs(offsets - np.median(offsets, axis=0)).max(axis=(1, 2))
    rare = np.argsort(-away)[: max(1, int((away > 0.5 * away.max()).sum()))]
    rng = np.random.default_rng(0)
    order = np.concatenate([rng.choice(rare, (STEPS, BATCH // 2)), rng.integers(frames, size=(STEPS, BATCH // 2))], axis=1)
    return _fitted(model, network, params, poses, jnp.asarray(offsets), jnp.asarray(order, jnp.int32))


@partial(jax.jit, static_argnums=1)
def _fitted(
    model: Model, network: Method, params: dict, poses: MotionFeatures, offsets: Array, order: Int[Array, "steps batch"]
) -> dict:
    adam = optax.adam(RATE)

    def lost(params, some, wanted):
        x = animate(model, network, params, some, None)
        right = jax.vmap(lambda at, y: skin(blend(at, model.blend), model.garment.mesh.rest + y))(some.matrices, wanted)
        return jnp.mean(jnp.sum((x - right) ** 2, axis=-1))

    def step(carried, at):
        params, state = carried
        slope = jax.grad(lost)(params, jax.tree.map(lambda a: a[at], poses), offsets[at])
        change, state = adam.update(slope, state)
        return (optax.apply_updates(params, change), state), None

    return lax.scan(step, (params, adam.init(params)), order)[0][0]

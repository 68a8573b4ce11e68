"""One optimiser step, and several compiled as one."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int

from ncs_jax.network.methods.method import Method, Windows, initial_parameters
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model
from ncs_jax.scene.spec import TrainingSpec
from ncs_jax.training.loss import gradients

__all__ = ["Fault", "Task", "TrainState", "chunk_runner", "initial_state", "refreshed", "step_size", "windows_of"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fault:
    """The last dropped step: what its first bad sample looked like, enough to find the term and the element again."""

    step: Int[Array, ""]
    frame: Int[Array, ""]
    offsets: Float[Array, "3 verts 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything that training carries from step to step."""

    params: dict
    optimiser: optax.OptState
    step: Int[Array, ""]
    dropped: Int[Array, ""]
    fault: Fault


BETAS = (0.9, 0.999)
ADAM = optax.scale_by_adam(*BETAS)


def step_size(spec: TrainingSpec, step, steps) -> Float[Array, ""]:
    """Return a rate that falls from the learning rate down to 2 % of it along a cosine, at the last of `steps`."""
    fall = jnp.clip(step / jnp.maximum(steps, 1), 0, 1)
    return spec.learning_rate * (0.02 + 0.98 * (1 + jnp.cos(jnp.pi * fall)) / 2)


@functools.partial(jax.jit, static_argnums=1)
def initial_state(model: Model, network: Method, seed: int) -> TrainState:
    """Return fresh parameters and a fresh optimiser."""
    params = initial_parameters(network, jax.random.PRNGKey(seed), model)
    zero = jnp.zeros((), jnp.int32)
    fault = Fault(zero, zero, jnp.zeros((3, *model.garment.mesh.rest.shape), model.garment.mesh.rest.dtype))
    return TrainState(params, ADAM.init(params), zero, zero, fault)


@functools.partial(jax.jit, static_argnums=0)
def refreshed(network: Method, params: dict, model: Model, motions: MotionFeatures) -> dict[str, Array]:
    """Return the fields that `Method.refresh` changes, and no others: a compiled program would copy them."""
    new = network.refresh(params, model, motions)
    return {f.name: getattr(new, f.name) for f in fields(new) if getattr(new, f.name) is not getattr(motions, f.name)}


def _sample(share, index, axis: str | None):
    """Entry `index` of the whole batch, along the last axis, which within a `shard_map` over `axis` one device has."""
    if axis is None:
        return share[..., index]
    size = share.shape[-1]
    return lax.psum(jnp.where(lax.axis_index(axis) == index // size, share[..., index % size], 0), axis)


class Task(NamedTuple):
    """What is trained, and how: constant over a training."""

    model: Model
    network: Method
    spec: TrainingSpec
    axis: str | None = None  # of the devices that share the batch, within a `shard_map` over it


def windows_of(task: Task, ends, pairs) -> Windows:
    """Return the windows of a step that end at frames `ends`, augmented by those that `pairs` names, both (batch,)."""
    spec, axis = task.spec, task.axis
    history = 3 if task.network.loss(task.model.terms).inertia else 1
    moved = spec.batch - round(task.network.still * spec.batch)
    augmented = round(spec.motion_augmentation * moved) if task.network.controlled else 0
    number = jnp.arange(ends.shape[0], dtype=ends.dtype)
    if axis is not None:
        number = number + lax.axis_index(axis) * ends.shape[0]
    return Windows(ends, pairs, number, augmented, spec.window, history, axis, moved)


def step(task: Task, steps, state: TrainState, track: MotionFeatures, indices) -> tuple[TrainState, dict]:
    """Take one optimiser step; one with any number that is not finite leaves the weights as they were and is counted.

    Args:
        steps: how many the training has. indices: (ends, pairs) of the batch, see `windows_of`.

    Within a `shard_map` they are this device's share of the batch and the rest is every device's.
    """
    (ends, _), axis = indices, task.axis
    windows, untangling = windows_of(task, *indices), task.spec.untangling
    grads, parts, (g, offsets) = gradients(task.model, task.network, state.params, track, windows, untangling)
    sample_good = jnp.all(jnp.isfinite(g), axis=(0, 1)) & jnp.isfinite(sum(parts.values()))
    if axis is not None:
        sample_good = lax.all_gather(sample_good, axis, tiled=True)
    # Columns first, which adds in vector lanes; a sum is finite only if everything in it is.
    sums = [jnp.sum(jnp.sum(leaf, axis=0)) for leaf in jax.tree.leaves(grads)]
    good = lax.optimization_barrier(jnp.all(sample_good) & jnp.isfinite(sum(sums)))

    def choose(new, old):  # a select where a branch would copy what it returns
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)

    # The barrier has the moments written in place before they are read: otherwise XLA copies the old ones, 100 MB a step.
    opt = lax.optimization_barrier(choose(ADAM.update(grads, state.optimiser)[1], state.optimiser))
    count = jnp.maximum(opt.count, 1)
    mean, square = optax.tree.bias_correction(opt.mu, BETAS[0], count), optax.tree.bias_correction(opt.nu, BETAS[1], count)
    size = step_size(task.spec, state.step, steps)
    params = jax.tree.map(lambda p, m, v: jnp.where(good, p - size * m / (jnp.sqrt(v) + 1e-8), p), state.params, mean, square)

    def first_bad():
        worst = jnp.argmin(sample_good)
        kept = state.fault.offsets.at[: len(offsets)].set(jnp.stack([_sample(frame, worst, axis) for frame in offsets]))
        return Fault(state.step, _sample(ends, worst, axis), kept)

    fault = lax.cond(good, lambda: state.fault, first_bad)
    logs = {name: jnp.mean(value) for name, value in parts.items()}
    logs = logs if axis is None else lax.pmean(logs, axis)
    return TrainState(params, opt, state.step + 1, state.dropped + ~good, fault), logs


def chunk_runner(network: Method, spec: TrainingSpec, mesh: Mesh | None = None):
    """Compile several steps as one: f(state, ends (n, batch), pairs (n, batch), steps, model, track) -> state, logs.

    `steps` is how many the whole training has, for the schedule. The state's buffers are reused. The track is that of
    `with_bodies`. With a mesh of several devices (`devices.batch_mesh`), each works on its part of the batch and takes the same
    step as the others.
    """
    axis = None if mesh is None else mesh.axis_names[0]

    def run(state, ends, pairs, steps, model, track):
        def body(state, indices):
            return step(Task(model, network, spec, axis), steps, state, track, indices)

        return lax.scan(body, state, (ends, pairs))

    if mesh is not None:
        whole, share = P(), P(None, axis)
        given = whole, share, share, whole, whole, whole
        run = jax.shard_map(run, mesh=mesh, in_specs=given, out_specs=whole, check_vma=False)
    return jax.jit(run, donate_argnums=0)

"""One step of a trained garment, its state one vector in and out.

    next_state, vertices = step(state, rotations, translation, alpha)

    state (S,)                 zeros at a motion's start, else `next_state` of the frame before; its parts are the file's own
    rotations (joints, 3, 3)   local rotations of the joints that the facts name, as the body's motions have them
    translation (3,)           of the root from where it rests, m
    alpha (1,)                 0 is static, 1 as trained
    vertices (verts, 3)        m, in the garment file's order

All float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ncs_jax.geometry.skinning import to_rest_axes
from ncs_jax.network.methods.method import Method
from ncs_jax.network.rollout import stepper
from ncs_jax.scene.model import Model

__all__ = ["RESULTS", "Step", "flat_step", "rounded"]

RESULTS = ("next_state", "vertices")


class Step(NamedTuple):
    """Hold `call(state, rotations, translation, alpha) -> (next_state, vertices)`, and its arguments' shapes by name."""

    call: Callable
    arguments: dict[str, tuple[int, ...]]


def flat_step(model: Model, network: Method, params: dict) -> Step:
    """Return the step of `rollout.stepper` with its state in one vector; zeros are what `init()` gives.

    float16 parameters are widened when they are used. The state holds what the vertices of this or a later frame depend on and
    no more: codes, joints and, where it matters, whether there was a frame. A garment that needs none of it has one zero.
    """
    init = stepper(model, network, params).init
    leaves, tree = jax.tree.flatten(init())
    joints, dtype = len(model.skeleton.parents), leaves[0].dtype
    arguments = {"rotations": (joints, 3, 3), "translation": (3,), "alpha": (1,)}

    def step(state, rotations, translation, alpha):
        wide = jax.tree.map(lambda a: a.astype(dtype) if a.dtype == jnp.float16 else a, params)
        if model.rest_rotations is not None:
            rotations = to_rest_axes(rotations, model.rest_rotations)
        return stepper(model, network, wide).step(state, rotations, translation, alpha[0])

    frame_shapes = [jax.ShapeDtypeStruct(shape, dtype) for shape in arguments.values()]
    needed = _needed_state(step, init(), *frame_shapes)
    sizes = [math.prod(leaves[i].shape) for i in needed]

    def call(state, *frame):
        parts, arrays = jnp.split(state, np.cumsum(sizes)[:-1]) if sizes else (), list(leaves)
        for i, part in zip(needed, parts, strict=True):
            arrays[i] = part.reshape(leaves[i].shape) if leaves[i].dtype == dtype else part[0] > 0
        new, vertices = step(jax.tree.unflatten(tree, arrays), *frame)
        kept = [jnp.asarray(jax.tree.leaves(new)[i], dtype).reshape(-1) for i in needed]
        return (jnp.concatenate(kept) if kept else state), vertices

    return Step(call, {"state": (max(sum(sizes), 1),), **arguments})


def _needed_state(step: Callable, state, *frame) -> list[int]:
    """Return the places of the arrays of a state that the vertices depend on, in this frame or a later one."""
    trace = jax.make_jaxpr(step)(state, *frame).jaxpr
    count, wanted = len(jax.tree.leaves(state)), {trace.outvars[-1]}
    while True:
        read = set(wanted)
        for eqn in reversed(trace.eqns):
            if not read.isdisjoint(eqn.outvars):
                read |= {v for v in eqn.invars if not isinstance(v, core.Literal)}
        needed = [i for i, v in enumerate(trace.invars[:count]) if v in read]
        more = wanted | {v for i in needed if not isinstance(v := trace.outvars[i], core.Literal)}
        if more == wanted:
            return needed
        wanted = more


def rounded(params: dict) -> dict:
    """Round the networks' matrices to float16; biases, and factors of the skinning weights, stay as they are."""
    return {
        name: jax.tree.map(lambda a: a.astype(jnp.float16) if a.ndim > 1 else a, part) if name != "blend" else part
        for name, part in params.items()
    }

"""The network: static encoder, bias-free recurrent dynamic encoder, decoder; equations (6), (7), (15) and (16)."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

__all__ = ["Decoder", "DynamicEncoder", "StaticEncoder", "merge", "recurrence"]


class StaticEncoder(nn.Module):
    """z_S from the static descriptors of one frame: a multilayer perceptron."""

    sizes: Sequence[int] = (64, 128, 256, 512)
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, descriptor: Float[Array, "*batch joints numbers"]) -> Float[Array, "*batch code"]:
        """Code of `(..., joints, numbers)` descriptors; each frame by itself."""
        h = descriptor.reshape(*descriptor.shape[:-2], -1)
        for i, size in enumerate(self.sizes):
            layer = nn.Dense(size, param_dtype=self.dtype, kernel_init=nn.initializers.he_normal(), name=f"layer_{i}")
            h = nn.relu(layer(h))
        return h


def _cell(recurrent, state, features):
    """One step of a gated recurrent unit without bias: the new state, the reset and update gates and the candidate."""
    n = state.shape[-1]
    gates = nn.sigmoid(features[..., : 2 * n] + state @ recurrent[:, : 2 * n])
    reset, update = gates[..., :n], gates[..., n:]
    candidate = jnp.tanh(features[..., 2 * n :] + (reset * state) @ recurrent[:, 2 * n :])
    return update * state + (1 - update) * candidate, reset, update, candidate


def _states(recurrent, features, state):
    def step(h, f):
        new, *inside = _cell(recurrent, h, f)
        return new, (new, h, *inside)

    return jax.lax.scan(step, state, features)[1]


@jax.custom_vjp
def recurrence(
    recurrent: Float[Array, "code gates"], features: Float[Array, "frames *batch gates"], state: Float[Array, "*batch code"]
) -> Float[Array, "frames *batch code"]:
    """States of a gated recurrent unit, time leading: its steps in order, its weights' derivative as one product over all."""
    return _states(recurrent, features, state)[0]


def _recurrence_forward(recurrent, features, state):
    states, *kept = _states(recurrent, features, state)
    return states, (recurrent, *kept)


def _recurrence_backward(saved, toward):
    recurrent, before, reset, update, candidate = saved
    n = before.shape[-1]

    def step(later, frame):
        slope, h, r, u, c = frame
        slope = slope + later
        to_candidate = slope * (1 - u) * (1 - c * c)
        to_reset_state = to_candidate @ recurrent[:, 2 * n :].T
        to_gates = jnp.concatenate([to_reset_state * h * r * (1 - r), slope * (h - c) * u * (1 - u)], axis=-1)
        earlier = slope * u + to_reset_state * r + to_gates @ recurrent[:, : 2 * n].T
        return earlier, jnp.concatenate([to_gates, to_candidate], axis=-1)

    to_state, to_features = jax.lax.scan(
        step, jnp.zeros_like(before[0]), (toward, before, reset, update, candidate), reverse=True
    )

    def product(a, b):
        return a.reshape(-1, n).T @ b.reshape(-1, b.shape[-1])

    to_gates, to_candidate = to_features[..., : 2 * n], to_features[..., 2 * n :]
    to_recurrent = jnp.concatenate([product(before, to_gates), product(reset * before, to_candidate)], axis=1)
    return to_recurrent, to_features, to_state


recurrence.defvjp(_recurrence_forward, _recurrence_backward)


class DynamicEncoder(nn.Module):
    """z_D from the dynamic descriptors of a sequence: no bias anywhere, so no motion gives exactly zero.

    Every layer maps zero to zero, and a gated recurrent unit without bias halves its state when its input is zero: z_D decays
    to zero when the motion stops. The gates' reset-before-product form is Cho et al. 2014.
    """

    joint_sizes: Sequence[int] = (32, 32)
    sizes: Sequence[int] = (512, 512)
    state: int = 512
    dtype: DTypeLike = jnp.float32

    def setup(self):
        """Create the layers."""
        dense = functools.partial(nn.Dense, use_bias=False, param_dtype=self.dtype)
        he = nn.initializers.he_normal()
        self.per_joint = [dense(n, kernel_init=he) for n in self.joint_sizes]
        self.joined = [dense(n, kernel_init=he) for n in self.sizes]
        self.gates_in = dense(3 * self.state)
        self.recurrent = self.param("recurrent", nn.initializers.orthogonal(), (self.state, 3 * self.state), self.dtype)

    def features(self, descriptor: Float[Array, "*batch joints numbers"]) -> Float[Array, "*batch gates"]:
        """What the recurrence reads, frame by frame: everything that needs no state."""
        h = descriptor
        for layer in self.per_joint:
            h = nn.relu(layer(h))
        h = h.reshape(*h.shape[:-2], -1)
        for layer in self.joined:
            h = nn.relu(layer(h))
        return self.gates_in(h)

    def step(self, state: Float[Array, "*batch code"], features: Float[Array, "*batch gates"]) -> Float[Array, "*batch code"]:
        """One step of the gated recurrent unit."""
        return _cell(self.recurrent, state, features)[0]

    def __call__(
        self, descriptors: Float[Array, "frames *batch joints numbers"], state: Float[Array, "*batch code"]
    ) -> Float[Array, "frames *batch code"]:
        """Codes of a sequence, time leading, from a state."""
        features = self.features(descriptors)
        if self.is_initializing():
            return self.step(state, features[0])[None]
        return recurrence(self.recurrent, features, state)


class Decoder(nn.Module):
    """Vertex offsets in unposed space from a code: a perceptron and a linear map, (6) and (7).

    The linear map has two parts that add: one moves each vertex by itself, in units of `local` (m); the other moves the smooth
    modes of the garment (see `modes`), so that drape and swing, soft and global, are learned as readily as strain, stiff and
    local. Together they are one linear map, see `merge`. The units are such that an optimiser step of 1e-3 moves vertices by
    about a millimetre, not by decimetres.
    """

    verts: int
    sizes: Sequence[int] = (512, 512, 512)
    modes: int = 128
    local: float = 0.005
    dtype: DTypeLike = jnp.float32

    def setup(self):
        """Create the layers."""
        dense = functools.partial(nn.Dense, param_dtype=self.dtype)
        self.layers = [dense(n, kernel_init=nn.initializers.he_normal()) for n in self.sizes]
        self.offsets = dense(3 * self.verts, kernel_init=nn.initializers.normal(0.3 / self.sizes[-1] ** 0.5))
        if self.modes:
            self.coefficients = dense(3 * self.modes, kernel_init=nn.initializers.zeros)

    def __call__(self, code: Float[Array, "*batch code"], basis: Float[Array, "verts modes"]) -> Float[Array, "*batch verts 3"]:
        """Offsets (..., verts, 3) in m to add to the rest garment."""
        h = code
        for layer in self.layers:
            h = nn.relu(layer(h))
        offsets = self.local * self.offsets(h).reshape(*h.shape[:-1], self.verts, 3)
        if self.modes:
            c = self.coefficients(h).reshape(*h.shape[:-1], self.modes, 3)
            offsets = offsets + jnp.einsum("vm,...mk->...vk", basis, c)
        return offsets


def merge(decoder: Decoder, params: dict, basis: Float[Array, "verts modes"]) -> tuple[Decoder, dict]:
    """The same decoder with one linear map, for inference."""
    if not decoder.modes:
        return decoder, params
    local, modal = params["offsets"], params["coefficients"]

    def whole(a, c):
        modal_part = jnp.einsum("vm,...mk->...vk", basis, c.reshape(*c.shape[:-1], decoder.modes, 3), precision="highest")
        return decoder.local * a + modal_part.reshape(a.shape)

    offsets = {name: whole(local[name], modal[name]) for name in ("kernel", "bias")}
    kept = {name: value for name, value in params.items() if name != "coefficients"}
    return Decoder(decoder.verts, decoder.sizes, 0, 1.0, decoder.dtype), {**kept, "offsets": offsets}

"""The encoders: static, and recurrent dynamic ones without bias; equations (6) and (15)."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

__all__ = ["DynamicEncoder", "LinearEncoder", "StaticEncoder", "SwingEncoder", "recurrence"]


class StaticEncoder(nn.Module):
    """z_S from the static descriptors of one frame: a multilayer perceptron."""

    sizes: Sequence[int] = (64, 128, 256)
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, descriptor: Float[Array, "*batch joints numbers"]) -> Float[Array, "*batch code"]:
        """Return the code of `(..., joints, numbers)` descriptors; each frame by itself."""
        h = descriptor.reshape(*descriptor.shape[:-2], -1)
        for i, size in enumerate(self.sizes):
            layer = nn.Dense(size, param_dtype=self.dtype, kernel_init=nn.initializers.he_normal(), name=f"layer_{i}")
            h = nn.relu(layer(h))
        return h


def _cell(recurrent, state, features):
    """One step of a gated recurrent unit without bias: the new state, the reset and update gates and the candidate.

    `recurrent` are the two parts of its matrix, for the gates and for the candidate.
    """
    n = state.shape[-1]
    gates = nn.sigmoid(features[..., : 2 * n] + state @ recurrent[0])
    reset, update = gates[..., :n], gates[..., n:]
    candidate = jnp.tanh(features[..., 2 * n :] + (reset * state) @ recurrent[1])
    return update * state + (1 - update) * candidate, reset, update, candidate


def _parts(recurrent):
    n = len(recurrent)
    return recurrent[:, : 2 * n], recurrent[:, 2 * n :]


def _states(recurrent, features, state):
    parts = lax.optimization_barrier(_parts(recurrent))  # else every step would copy them out again

    def step(h, f):
        new, *inside = _cell(parts, h, f)
        return new, (new, h, *inside)

    return lax.scan(step, state, features)[1]


@jax.custom_vjp
def recurrence(
    recurrent: Float[Array, "code gates"], features: Float[Array, "frames *batch gates"], state: Float[Array, "*batch code"]
) -> Float[Array, "frames *batch code"]:
    """Return the states of a gated recurrent unit, time leading: its weights' derivative as one product over all."""
    return _states(recurrent, features, state)[0]


def _recurrence_forward(recurrent, features, state):
    states, *kept = _states(recurrent, features, state)
    return states, (recurrent, *kept)


def _recurrence_backward(saved, toward):
    recurrent, before, reset, update, candidate = saved
    n = before.shape[-1]
    for_gates, for_candidate = lax.optimization_barrier(tuple(part.T for part in _parts(recurrent)))

    def step(later, frame):
        slope, h, r, u, c = frame
        slope = slope + later
        to_candidate = slope * (1 - u) * (1 - c * c)
        to_reset_state = to_candidate @ for_candidate
        to_gates = jnp.concatenate([to_reset_state * h * r * (1 - r), slope * (h - c) * u * (1 - u)], axis=-1)
        earlier = slope * u + to_reset_state * r + to_gates @ for_gates
        return earlier, jnp.concatenate([to_gates, to_candidate], axis=-1)

    to_state, to_features = lax.scan(step, jnp.zeros_like(before[0]), (toward, before, reset, update, candidate), reverse=True)

    def product(a, b):
        return a.reshape(-1, n).T @ b.reshape(-1, b.shape[-1])

    to_gates, to_candidate = to_features[..., : 2 * n], to_features[..., 2 * n :]
    to_recurrent = jnp.concatenate([product(before, to_gates), product(reset * before, to_candidate)], axis=1)
    return to_recurrent, to_features, to_state


recurrence.defvjp(_recurrence_forward, _recurrence_backward)


class DynamicEncoder(nn.Module):
    """Codes of a sequence of descriptors. z_D has no bias anywhere, so no motion gives exactly zero.

    Every layer maps zero to zero, and a gated recurrent unit without bias halves its state when its input is zero: z_D decays
    to zero when the motion stops. The gates' reset-before-product form is Cho et al. 2014.
    """

    joint_sizes: Sequence[int] = (32, 32)
    sizes: Sequence[int] = (256, 256)
    state: int = 256
    dtype: DTypeLike = jnp.float32
    bias: bool = False

    def setup(self):
        """Create the layers."""
        dense = functools.partial(nn.Dense, use_bias=self.bias, param_dtype=self.dtype)
        he = nn.initializers.he_normal()
        self.per_joint = [dense(n, kernel_init=he) for n in self.joint_sizes]
        self.joined = [dense(n, kernel_init=he) for n in self.sizes]
        self.cell(dense)

    def cell(self, dense: Callable[[int], nn.Module]) -> None:
        """Create what the recurrence needs."""
        self.gates_in = dense(3 * self.state)
        self.recurrent = self.param("recurrent", nn.initializers.orthogonal(), (self.state, 3 * self.state), self.dtype)

    def features(self, descriptor: Float[Array, "*batch joints numbers"]) -> Float[Array, "*batch gates"]:
        """Return what the recurrence reads, frame by frame: everything that needs no state."""
        return self.gates_in(self.by_frame(descriptor))

    def by_frame(self, descriptor: Float[Array, "*batch joints numbers"]) -> Float[Array, "*batch size"]:
        """Apply the layers of each joint by itself, then those of all."""
        h = descriptor
        for layer in self.per_joint:
            h = nn.relu(layer(h))
        h = h.reshape(*h.shape[:-2], -1)
        for layer in self.joined:
            h = nn.relu(layer(h))
        return h

    def step(self, state: Float[Array, "*batch code"], features: Float[Array, "*batch gates"]) -> Float[Array, "*batch code"]:
        """Take one step of the gated recurrent unit."""
        return _cell(_parts(self.recurrent), state, features)[0]

    def __call__(
        self, descriptors: Float[Array, "frames *batch joints numbers"], state: Float[Array, "*batch code"]
    ) -> Float[Array, "frames *batch code"]:
        """Return the codes of a sequence, time leading, from a state."""
        features = self.features(descriptors)
        if self.is_initializing():
            return self.step(state, features[0])[None]
        return self.states(features, state)

    def states(
        self, features: Float[Array, "frames *batch gates"], state: Float[Array, "*batch code"]
    ) -> Float[Array, "frames *batch code"]:
        """Return the codes of a sequence from its features, time leading."""
        return recurrence(self.recurrent, features, state)


class LinearEncoder(DynamicEncoder):
    """A diagonal linear recurrence h_t = lambda h_{t-1} + sqrt(1 - |lambda|^2) f_t, complex, in place of the gated unit.

    |lambda| = exp(-exp(nu)) < 1 whatever is learned, so the state cannot grow: each number of it is a decaying oscillation,
    the real parts first. Source: Orvieto et al. 2023, with no skip or normalisation.
    """

    def cell(self, dense: Callable[[int], nn.Module]) -> None:
        """Start with time constants from 1 to 20 frames, periods from 6 frames on."""
        half = self.state // 2
        self.read = dense(2 * half)
        self.nu = self.param("nu", lambda key: -jnp.log(20.0) * jax.random.uniform(key, (half,), self.dtype))
        self.angle = self.param("angle", lambda key: jax.random.uniform(key, (half,), self.dtype, 0, jnp.pi / 3))

    def features(self, descriptor: Float[Array, "*batch joints numbers"]) -> Float[Array, "*batch code"]:
        """Return what the recurrence adds, frame by frame: everything that needs no state."""
        h = self.read(self.by_frame(descriptor))
        return h * jnp.broadcast_to(jnp.tile(jnp.sqrt(-jnp.expm1(-2 * jnp.exp(self.nu))), 2), h.shape)

    def step(self, state: Float[Array, "*batch code"], features: Float[Array, "*batch code"]) -> Float[Array, "*batch code"]:
        """Take one step of the recurrence."""
        a, b = jnp.split(state, 2, axis=-1)
        size = jnp.exp(-jnp.exp(self.nu))
        real, imaginary = (jnp.broadcast_to(size * f(self.angle), a.shape) for f in (jnp.cos, jnp.sin))
        return jnp.concatenate([real * a - imaginary * b, imaginary * a + real * b], axis=-1) + features

    def states(
        self, features: Float[Array, "frames *batch code"], state: Float[Array, "*batch code"]
    ) -> Float[Array, "frames *batch code"]:
        """Return the codes of a sequence from its features, time leading."""
        return self.of_motions(features, state, jnp.zeros(len(features), bool))

    def of_motions(
        self, features: Float[Array, "frames *batch code"], state: Float[Array, "*batch code"], begins: Bool[Array, "frames"]
    ) -> Float[Array, "frames *batch code"]:
        """Return the codes of motions end to end, from rest wherever one begins."""

        def step(h, frame):
            f, begin = frame
            h = self.step(jnp.where(begin, 0, h), f)
            return h, h

        return lax.scan(step, state, (features, begins), unroll=8)[1]


class SwingEncoder(nn.Module):
    """z_D of a swing: a perceptron without bias, so that no swing gives zero and z_D(alpha q) = alpha z_D(q) for alpha >= 0."""

    sizes: Sequence[int] = (256, 256)
    code: int = 256
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, swing: Float[Array, "*batch modes"]) -> Float[Array, "*batch code"]:
        """Return the code of each swing by itself, at first next to nothing."""
        h = swing
        dense = functools.partial(nn.Dense, use_bias=False, param_dtype=self.dtype)
        for i, size in enumerate(self.sizes):
            h = nn.relu(dense(size, kernel_init=nn.initializers.he_normal(), name=f"layer_{i}")(h))
        return dense(self.code, kernel_init=nn.initializers.normal(1e-3), name="read")(h)

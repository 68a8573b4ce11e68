"""Self-supervised neural dynamic garments: one recurrent network, and inertia that is differentiated through time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Int

from ncs_jax.energies.terms import Terms
from ncs_jax.network.encoders import DynamicEncoder
from ncs_jax.network.methods.method import Codes, FromCodes, descriptor_sizes
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["SNUG"]


@dataclass(frozen=True)
class SNUG(FromCodes):
    """A recurrent encoder, with bias, of the pose and of the root's motion; and the decoder. See `methods.method.Method`.

    Nothing tells what the pose gives from what motion adds: alpha scales nothing.
    Source: Santesteban, Otaduy, Casas 2022, with the descriptors, sizes and decoder of the other methods here.
    """

    recurrent: DynamicEncoder
    decoder: nn.Module
    learn_weights: bool = False
    controlled = False

    @property
    def state(self) -> int:
        """Return how many numbers are carried from frame to frame: the code's."""
        return self.recurrent.state

    def code_size(self, model: Model) -> int:
        """Return how many numbers a code has: the state's."""
        return self.recurrent.state

    def init(self, keys: tuple[Array, Array], model: Model) -> dict:
        """Return fresh parameters of the encoder."""
        static, dynamic = (jnp.zeros((1, *size), model.basis.dtype) for size in descriptor_sizes(model))
        state = jnp.zeros(self.state, model.basis.dtype)
        return {"recurrent": self.recurrent.init(keys[0], self._read(static, dynamic), state)["params"]}

    def loss(self, terms: Terms) -> Terms:
        """Return all of them, inertia's target differentiated too."""
        return replace(terms, through_time=terms.inertia)

    def step(self, params: dict, model: Model, state: Array, static: Array, dynamic: Array | None, matrices: Array):
        """Return the code of the frame, which is the new state."""
        variables = {"params": params["recurrent"]}
        features = self.recurrent.apply(variables, self._read(static, dynamic), method="features")
        state = jnp.asarray(self.recurrent.apply(variables, state, features, method="step"))
        return state, Codes(state)

    def codes(self, params: dict, model: Model, track: MotionFeatures) -> Codes:
        """Return the codes from a state of zero at the motion's start."""
        rest = jnp.zeros(self.state, track.static.dtype)
        inputs = self._read(track.static, track.dynamic)
        return Codes(jnp.asarray(self.recurrent.apply({"params": params["recurrent"]}, inputs, rest)))

    def windows(self, params: dict, track: MotionFeatures, ends: Int[Array, "batch"], length: int, last: int) -> Codes:
        """Return codes, time leading, from a state of zero at a window's start.

        Frames before a motion's start are its first, at rest.
        """
        start = track.start[ends]
        back = ends[None] - jnp.arange(length - 1, -1, -1, dtype=ends.dtype)[:, None]
        inside = jnp.maximum(back, start[None])
        moving = jnp.where((back >= start[None])[..., None, None], track.dynamic[inside], 0)
        rest = jnp.zeros((ends.shape[0], self.state), track.static.dtype)
        inputs = self._read(track.static[inside], moving)
        codes = jnp.asarray(self.recurrent.apply({"params": params["recurrent"]}, inputs, rest))
        return Codes(codes[length - last :])

    def _read(self, static, dynamic):
        """All joints' poses and the root's motion, as the numbers of one joint (..., 1, numbers)."""
        pose = static.reshape(*static.shape[:-2], 1, -1)
        return jnp.concatenate([pose, dynamic[..., :1, :]], axis=-1)

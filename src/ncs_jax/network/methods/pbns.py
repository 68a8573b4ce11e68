"""Physically based neural simulator: a pose gives a shape, and nothing has mass times acceleration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Int

from ncs_jax.energies.terms import Terms
from ncs_jax.network.methods.method import Codes, FromCodes, descriptor_sizes, static_code_size
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["PBNS"]


@dataclass(frozen=True)
class PBNS(FromCodes):
    """An encoder of the pose and the decoder. See `methods.method.Method`.

    Source: Bertiche, Madadi, Escalera 2021, with the descriptors, sizes and decoder of the other methods here.
    """

    static: nn.Module
    decoder: nn.Module
    learn_weights: bool = False
    state = 0
    controlled = False

    def code_size(self, model: Model) -> int:
        """Return how many numbers a code has: the static encoder's."""
        return static_code_size(self.static, model)

    def init(self, keys: tuple[Array, Array], model: Model) -> dict:
        """Return fresh parameters of the encoder."""
        return {"static": self.static.init(keys[0], jnp.zeros(descriptor_sizes(model)[0], model.basis.dtype))["params"]}

    def loss(self, terms: Terms) -> Terms:
        """Return all but inertia, and friction, which knows of a frame before."""
        return replace(terms, inertia=False, friction=False)

    def step(self, params: dict, model: Model, state: Array, static: Array, dynamic: Array | None, matrices: Array):
        """Return the code of the frame's pose; nothing is carried."""
        return state, self._of(params, static)

    def codes(self, params: dict, model: Model, track: MotionFeatures) -> Codes:
        """Return the code of every frame by itself."""
        return self._of(params, track.static)

    def windows(self, params: dict, track: MotionFeatures, ends: Int[Array, "batch"], length: int, last: int) -> Codes:
        """Return the codes of the last frames, time leading; a window begins at its motion's start at the earliest."""
        back = ends[None] - jnp.arange(last - 1, -1, -1, dtype=ends.dtype)[:, None]
        return self._of(params, track.static[jnp.maximum(back, track.start[ends][None])])

    def _of(self, params, descriptors):
        return Codes(jnp.asarray(self.static.apply({"params": params["static"]}, descriptors)))

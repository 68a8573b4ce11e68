"""Neural cloth simulation: static and dynamic codes that add, z = z_S + alpha z_D (15), decoded and skinned (16)."""

from __future__ import annotations

from dataclasses import dataclass

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ncs_jax.energies.terms import Terms
from ncs_jax.network.encoders import DynamicEncoder, LinearEncoder
from ncs_jax.network.methods.method import Codes, FromCodes, descriptor_sizes, static_code_size
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["NCS"]


@dataclass(frozen=True)
class NCS(FromCodes):
    """The three networks; `dynamic` is None for a character that never moves. See `methods.method.Method`.

    Source: Bertiche, Madadi, Escalera 2022.
    """

    static: nn.Module
    dynamic: DynamicEncoder | None
    decoder: nn.Module
    learn_weights: bool = False

    @property
    def state(self) -> int:
        """Return how many numbers are carried from frame to frame: the dynamic code's."""
        return 0 if self.dynamic is None else self.dynamic.state

    @property
    def controlled(self) -> bool:
        """Return whether alpha scales anything."""
        return self.dynamic is not None

    def code_size(self, model: Model) -> int:
        """Return how many numbers a code has: the static encoder's."""
        return static_code_size(self.static, model)

    def init(self, keys: tuple[Array, Array], model: Model) -> dict:
        """Return fresh parameters of both encoders."""
        static, dynamic = (jnp.zeros(size, model.basis.dtype) for size in descriptor_sizes(model))
        params = {"static": self.static.init(keys[0], static)["params"]}
        if self.dynamic is not None:
            params["dynamic"] = self.dynamic.init(keys[1], dynamic[None], jnp.zeros(self.state, dynamic.dtype))["params"]
        return params

    def loss(self, terms: Terms) -> Terms:
        """Return all of them, inertia's target a constant: a minimum is a step of implicit Euler."""
        return terms

    def step(self, params: dict, model: Model, state: Array, static: Array, dynamic: Array | None, matrices: Array):
        """Return z_S of the frame, and z_D, which is the new state."""
        fixed = self._static(params, static)
        if self.dynamic is None:
            return state, Codes(fixed)
        variables = {"params": params["dynamic"]}
        features = self.dynamic.apply(variables, dynamic, method="features")
        state = jnp.asarray(self.dynamic.apply(variables, state, features, method="step"))
        return state, Codes(fixed, state)

    def codes(self, params: dict, model: Model, track: MotionFeatures) -> Codes:
        """Return z_S of every frame by itself, and z_D from rest at the motion's start."""
        fixed = self._static(params, track.static)
        if self.dynamic is None:
            return Codes(fixed)
        rest = jnp.zeros(self.state, track.dynamic.dtype)
        return Codes(fixed, jnp.asarray(self.dynamic.apply({"params": params["dynamic"]}, track.dynamic, rest)))

    def windows(self, params: dict, track: MotionFeatures, ends: Int[Array, "batch"], length: int, last: int) -> Codes:
        """Return codes, time leading. Frames before a motion's start are rest: zero dynamic descriptors.

        Of few motions (fewer frames than all windows together) a linear cell knows the whole motion before.
        """
        start = track.start[ends]
        back = ends[None] - jnp.arange(length - 1, -1, -1, dtype=ends.dtype)[:, None]
        inside = jnp.maximum(back, start[None])
        fixed = self._static(params, track.static[inside[length - last :]])
        if self.dynamic is None:
            return Codes(fixed)
        variables, begun = {"params": params["dynamic"]}, back >= start[None]
        frames = len(track.dynamic)
        if frames < back.size:  # windows overlap: what each frame gives by itself is computed once, and picked by a product
            every = jnp.asarray(self.dynamic.apply(variables, track.dynamic, method="features"))
            if isinstance(self.dynamic, LinearEncoder):  # so cheap that all motions are gone through from their starts
                begins = track.start == jnp.arange(frames, dtype=track.start.dtype)
                rest = jnp.zeros(self.state, every.dtype)
                states = jnp.asarray(self.dynamic.apply(variables, every, rest, begins, method="of_motions"))
                return Codes(fixed, jnp.where(begun[length - last :, :, None], states[inside[length - last :]], 0))
            pick = jax.nn.one_hot(inside, frames, dtype=every.dtype) * begun[..., None].astype(every.dtype)
            features = jnp.einsum("lbf,fg->lbg", pick, every, precision="highest")
        else:
            moving = jnp.where(begun[..., None, None], track.dynamic[inside], 0)
            features = jnp.asarray(self.dynamic.apply(variables, moving, method="features"))
        rest = jnp.zeros((ends.shape[0], self.state), features.dtype)
        states = jnp.asarray(self.dynamic.apply(variables, features, rest, method="states"))
        return Codes(fixed, states[length - last :])

    def _static(self, params, descriptors):
        return jnp.asarray(self.static.apply({"params": params["static"]}, descriptors))

"""What a method of animating a garment has to offer, and what all that learn have in common: decoder and skinning weights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ncs_jax.energies.terms import Terms
from ncs_jax.geometry.skinning import Blend
from ncs_jax.network.decoder import Decoder, merge
from ncs_jax.scene.descriptors import DESCRIPTORS
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["Codes", "Method", "decode", "descriptor_sizes", "for_inference", "garment_blend", "initial_parameters"]


class Codes(NamedTuple):
    """z_S, z_D where there is one, and q, how far a garment swings along its vibrations, where it does."""

    static: Array
    dynamic: Array | None = None
    swing: Array | None = None

    def together(self, alpha: float | Array | None = 1.0) -> Array:
        """z_S + alpha z_D (15); None leaves z_D out."""
        return self.static if self.dynamic is None or alpha is None else self.static + alpha * self.dynamic

    def swung(self, alpha: float | Array | None = 1.0) -> Array | None:
        """alpha q; None leaves it out."""
        return None if self.swing is None or alpha is None else alpha * self.swing


@runtime_checkable
class Method(Protocol):
    """Networks that give codes to the decoder: a frozen dataclass, with its parameters apart.

    What sets methods apart is how they begin, what a frame does to what they carry, and which energy trains them: `init`,
    `step` and `loss`. Energies, kinematics, decoder, training loop and evaluation are the same for all.
    """

    @property
    def decoder(self) -> Decoder:
        """From codes to offsets."""

    @property
    def learn_weights(self) -> bool:
        """Whether the skinning weights are trained too."""

    @property
    def code(self) -> int:
        """How many numbers a code has."""

    @property
    def state(self) -> int:
        """How many numbers are carried from frame to frame."""

    @property
    def controlled(self) -> bool:
        """Whether alpha scales anything."""

    def init(self, keys: tuple[Array, Array], model: Model) -> dict:
        """Fresh parameters of all but the decoder."""

    def step(
        self, params: dict, model: Model, state: Array, static: Array, dynamic: Array | None, matrices: Array
    ) -> tuple[Array, Codes]:
        """One frame of any number of characters, its descriptors and joint transforms: the new state, and the codes."""

    def loss(self, terms: Terms) -> Terms:
        """Of a scene's terms those that train it, and whether inertia's target carries a gradient."""

    def codes(self, params: dict, model: Model, track: MotionFeatures) -> Codes:
        """Of every frame (frames, code) of one motion, from rest at its start."""

    def windows(self, params: dict, track: MotionFeatures, ends: Int[Array, "batch"], length: int, last: int) -> Codes:
        """Of the `last` frames (last, batch, code) of windows of `length` frames, from rest, that end at `ends`."""


def descriptor_sizes(model: Model) -> tuple[tuple[int, int], tuple[int, int]]:
    """Shapes (joints, numbers) of a frame's static and dynamic descriptors."""
    joints, numbers = len(model.inputs), DESCRIPTORS[model.descriptor]
    return (joints, numbers + 3), (joints, numbers + 6)


def initial_parameters(network: Method, key: Array, model: Model) -> dict:
    """Fresh parameters: a plain pytree of arrays."""
    first, second, third = jax.random.split(key, 3)
    code = jnp.zeros(network.code, model.basis.dtype)
    params = network.init((first, second), model)
    params["decoder"] = network.decoder.init(third, code, model.basis)["params"]
    if network.learn_weights:
        params["blend"] = jnp.zeros_like(model.blend.weights)
    return params


def garment_blend(network: Method, params: dict, model: Model) -> Blend:
    """The garment's skinning weights: given, or scaled by learned factors w exp(s) / sum, which keep zeros zero."""
    if not network.learn_weights:
        return model.blend
    scaled = model.blend.weights * jnp.exp(params["blend"])
    return Blend(scaled / jnp.sum(scaled, axis=-1, keepdims=True), model.blend.joints)


def decode(
    network: Method,
    params: dict,
    model: Model,
    code: Float[Array, "*frames code"],
    swing: Float[Array, "*frames modes"] | None = None,
) -> Float[Array, "verts 3 *frames"]:
    """Offsets in unposed space, m: those of the code, and those of a swing along the model's vibrations."""
    offsets = jnp.asarray(network.decoder.apply({"params": params["decoder"]}, code, model.basis))
    if swing is None:
        return offsets
    return offsets + jnp.tensordot(model.vibrations.directions, swing, (-1, -1))


def for_inference(network: Any, params: dict, model: Model) -> tuple[Any, dict]:
    """The same network with the decoder's two linear maps made one."""
    decoder, decoder_params = merge(network.decoder, params["decoder"], model.basis)
    return replace(network, decoder=decoder), {**params, "decoder": decoder_params}

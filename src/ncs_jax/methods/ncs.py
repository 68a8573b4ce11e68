"""Neural cloth simulation: static and dynamic codes that add, z = z_S + alpha z_D (15), decoded and skinned (16)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ncs_jax.descriptors import DESCRIPTORS
from ncs_jax.kinematics import Blend
from ncs_jax.model import Model
from ncs_jax.motion import Track
from ncs_jax.networks import Decoder, DynamicEncoder, StaticEncoder, merge

__all__ = ["NCS", "decode", "for_inference", "garment_blend", "initial_parameters", "static_codes", "window_codes"]


@dataclass(frozen=True)
class NCS:
    """The three networks; `dynamic` is None for a character that never moves."""

    static: StaticEncoder
    dynamic: DynamicEncoder | None
    decoder: Decoder
    learn_weights: bool = False


def initial_parameters(network: NCS, key: Array, model: Model) -> dict:
    """Fresh parameters: a plain pytree of arrays."""
    a, b, c = jax.random.split(key, 3)
    joints, numbers = len(model.inputs), DESCRIPTORS[model.descriptor]
    dtype = model.basis.dtype
    code = jnp.zeros(network.static.sizes[-1], dtype)
    params = {
        "static": network.static.init(a, jnp.zeros((joints, numbers + 3), dtype))["params"],
        "decoder": network.decoder.init(c, code, model.basis)["params"],
    }
    if network.dynamic is not None:
        params["dynamic"] = network.dynamic.init(b, jnp.zeros((1, joints, numbers + 6), dtype), code)["params"]
    if network.learn_weights:
        params["blend"] = jnp.zeros_like(model.blend.weights)
    return params


def garment_blend(network: NCS, params: dict, model: Model) -> Blend:
    """The garment's skinning weights: given, or scaled by learned factors w exp(s) / sum, which keep zeros zero."""
    if not network.learn_weights:
        return model.blend
    scaled = model.blend.weights * jnp.exp(params["blend"])
    return Blend(scaled / jnp.sum(scaled, axis=-1, keepdims=True), model.blend.joints)


def static_codes(
    network: NCS, params: dict, descriptors: Float[Array, "*frames joints numbers"]
) -> Float[Array, "*frames code"]:
    """z_S of single frames."""
    return jnp.asarray(network.static.apply({"params": params["static"]}, descriptors))


def decode(network: NCS, params: dict, model: Model, code: Float[Array, "*frames code"]) -> Float[Array, "verts 3 *frames"]:
    """Offsets in unposed space, m."""
    return jnp.asarray(network.decoder.apply({"params": params["decoder"]}, code, model.basis))


def for_inference(network: NCS, params: dict, model: Model) -> tuple[NCS, dict]:
    """The same network with the decoder's two linear maps made one."""
    decoder, decoder_params = merge(network.decoder, params["decoder"], model.basis)
    return replace(network, decoder=decoder), {**params, "decoder": decoder_params}


def window_codes(
    network: NCS, params: dict, track: Track, ends: Int[Array, "batch"], length: int, last: int
) -> tuple[Float[Array, "last batch code"], Float[Array, "last batch code"] | None]:
    """Codes z_S and z_D of the `last` frames of windows of `length` frames that end at `ends`, time leading.

    Frames before a motion's start are rest: zero dynamic descriptors.
    """
    start = track.start[ends]
    back = ends[None] - jnp.arange(length - 1, -1, -1, dtype=ends.dtype)[:, None]
    inside = jnp.maximum(back, start[None])
    z_static = static_codes(network, params, track.static[inside[length - last :]])
    if network.dynamic is None:
        return z_static, None
    variables, begun = {"params": params["dynamic"]}, back >= start[None]
    frames = len(track.dynamic)
    if frames < back.size:  # windows overlap: what each frame gives by itself is computed once, and picked by a product
        every = jnp.asarray(network.dynamic.apply(variables, track.dynamic, method="features"))
        pick = jax.nn.one_hot(inside, frames, dtype=every.dtype) * begun[..., None]
        features = jnp.einsum("lbf,fg->lbg", pick, every)
    else:
        moving = jnp.where(begun[..., None, None], track.dynamic[inside], 0)
        features = jnp.asarray(network.dynamic.apply(variables, moving, method="features"))
    rest = jnp.zeros((ends.shape[0], network.dynamic.state), features.dtype)
    z_dynamic = jnp.asarray(network.dynamic.apply(variables, features, rest, method="states"))
    return z_static, z_dynamic[length - last :]

"""A trained decoder made smaller for inference: fewer numbers or shorter ones, for an error stated in millimetres."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ncs_jax.network.decoder import Decoder
from ncs_jax.network.methods.method import Method, for_inference
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = ["compress"]


def compress(
    network: Method, params: dict, model: Model, track: MotionFeatures, *, rank: int = 0, bfloat16: bool = False
) -> tuple[Method, dict]:
    """Return the same network with a smaller decoder, for `rollout.stepper` and `rollout.animate`.

        offsets = b + K h  ~  (b + K m) + V (V^T K) (h - m)

    with m the mean of the decoder's last features h over the frames of `track`, and V the `rank` leading singular vectors of
    the offsets there, K (h - m): of all linear maps of that rank the one with the least squared error on the motion.
    `bfloat16` stores the largest kernel in 16 bits and sums in float32; codes, skinning and positions stay as they are.

    Args:
        track: the motion to be good at. rank: at most the number of its frames; 0 keeps the map whole.

    Raises:
        ValueError: the rank is negative, or above what the motion or the decoder can tell apart.
    """
    smaller, params = for_inference(network, params, model)
    decoder = dict(params["decoder"])
    if rank:
        z = smaller.codes(params, model, track).together()
        features = smaller.decoder.apply({"params": decoder}, z, method=Decoder.features)
        h, kernel, bias = (np.asarray(a, np.float64) for a in (features, *map(decoder["offsets"].get, ("kernel", "bias"))))
        if not 0 < rank <= min(h.shape):
            raise ValueError(f"rank is {rank}; from {h.shape[0]} frames of {h.shape[1]} features it can be 1 to {min(h.shape)}")
        mean = h.mean(axis=0)
        _, _, directions = np.linalg.svd((h - mean) @ kernel.T, full_matrices=False)
        basis = directions[:rank]
        inward = kernel.T @ basis.T
        dtype = decoder["offsets"]["kernel"].dtype
        decoder["reduced"] = {"kernel": jnp.asarray(inward, dtype), "bias": jnp.asarray(-mean @ inward, dtype)}
        decoder["offsets"] = {"kernel": jnp.asarray(basis.T, dtype), "bias": jnp.asarray(bias + kernel @ mean, dtype)}
        smaller = replace(smaller, decoder=replace(smaller.decoder, rank=rank, parent=None, name=None))
    if bfloat16:
        decoder["offsets"] = {**decoder["offsets"], "kernel": decoder["offsets"]["kernel"].astype(jnp.bfloat16)}
    return smaller, {**params, "decoder": decoder}

"""The decoder: vertex offsets in unposed space from a code, equations (6), (7) and (16)."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

__all__ = ["Decoder", "begun_at", "merge"]


@jax.custom_vjp
def outward(kernel: Float[Array, "outside inside"], x: Float[Array, "batch inside"]) -> Float[Array, "outside batch"]:
    """Return K x^T: a linear map whose many results lie first, so that poses stay beside each other in memory.

    All three products of its derivative then read and write rows; on a CPU they run twice as fast as those of x W. A kernel in
    bfloat16 is multiplied in that type and summed in float32.
    """
    return jnp.einsum("oi,bi->ob", kernel, x.astype(kernel.dtype), preferred_element_type=x.dtype)


def _outward_backward(saved, toward):
    kernel, x = saved
    parts = math.gcd(len(kernel), 4)  # XLA's product with a sum this long is faster in parts
    rows, columns = (a.reshape(parts, -1, a.shape[-1]) for a in (kernel, toward))
    return jnp.einsum("ob,bi->oi", toward, x), jnp.sum(jnp.einsum("pob,poi->pbi", columns, rows), axis=0)


outward.defvjp(lambda kernel, x: (outward(kernel, x), (kernel, x)), _outward_backward)


class Outward(nn.Module):
    """A dense layer for `outward`, with its bias; its kernel lies (outside, inside)."""

    size: int
    kernel_init: nn.initializers.Initializer
    dtype: DTypeLike = jnp.float32

    @nn.compact
    def __call__(self, x: Float[Array, "batch inside"]) -> Float[Array, "outside batch"]:
        """Return one column for every row of x."""
        kernel = self.param("kernel", self.kernel_init, (self.size, x.shape[-1]), self.dtype)
        bias = self.param("bias", nn.initializers.zeros, (self.size,), self.dtype)
        return outward(kernel, x) + bias[:, None]


class Decoder(nn.Module):
    """Vertex offsets in unposed space from a code: a perceptron and a linear map, (6) and (7).

    The linear map has two parts that add: one moves each vertex by itself, in units of `local` (m); the other moves the smooth
    modes of the garment (see `laplacian_modes.modal_basis`), so that drape and swing, soft and global, are learned as readily
    as strain, stiff and local. Together they are one linear map, see `merge`. The units are such that an optimiser step of 1e-3
    moves vertices by about a millimetre, not by decimetres.
    """

    verts: int
    sizes: Sequence[int] = (256, 256, 256)
    modes: int = 128
    local: float = 0.005
    dtype: DTypeLike = jnp.float32
    rank: int = 0  # numbers that the linear map goes through, in a decoder made smaller; 0: as it was trained

    def setup(self):
        """Create the layers."""
        dense = functools.partial(nn.Dense, param_dtype=self.dtype)
        self.layers = [dense(n, kernel_init=nn.initializers.he_normal()) for n in self.sizes]
        small = nn.initializers.normal(0.3 / self.sizes[-1] ** 0.5)
        self.offsets = Outward(3 * self.verts, small, self.dtype)
        if self.rank:
            self.reduced = dense(self.rank)
        if self.modes:
            self.coefficients = Outward(3 * self.modes, nn.initializers.zeros, self.dtype)

    def features(self, code: Float[Array, "*poses code"]) -> Float[Array, "*poses features"]:
        """Return what the linear map reads."""
        h = code
        for layer in self.layers:
            h = nn.relu(layer(h))
        return h

    def __call__(self, code: Float[Array, "*poses code"], basis: Float[Array, "verts modes"]) -> Float[Array, "verts 3 *poses"]:
        """Return offsets (verts, 3, *poses) in m to add to the rest garment."""
        h = self.features(code.reshape(-1, code.shape[-1]))
        if self.rank:
            h = self.reduced(h)
        offsets = self.local * self.offsets(h)
        if self.modes:
            coefficients = self.coefficients(h).reshape(self.modes, -1)
            offsets = offsets + jnp.matmul(basis, coefficients, precision="highest").reshape(offsets.shape)
        return offsets.reshape(self.verts, 3, *code.shape[:-1])


def begun_at(decoder: Decoder, params: dict, offsets: Float[Array, "verts 3"]) -> dict:
    """Return parameters of a fresh decoder that gives such offsets, m, but for the little that chance adds."""
    before = params["offsets"]
    return {**params, "offsets": {**before, "bias": (offsets / decoder.local).reshape(-1).astype(before["bias"].dtype)}}


def merge(decoder: Decoder, params: dict, basis: Float[Array, "verts modes"]) -> tuple[Decoder, dict]:
    """Return the same decoder with one linear map, for inference."""
    if not decoder.modes:
        return decoder, params

    offsets = _merged(decoder, params["offsets"], params["coefficients"], basis)
    kept = {name: value for name, value in params.items() if name != "coefficients"}
    return Decoder(decoder.verts, decoder.sizes, 0, 1.0, decoder.dtype), {**kept, "offsets": offsets}


@functools.partial(jax.jit, static_argnums=0)  # one program to compile, not one an operation
def _merged(decoder: Decoder, local: dict, modal: dict, basis) -> dict:
    def added(a, c):
        modal_part = jnp.matmul(basis, c.reshape(decoder.modes, -1), precision="highest")
        return decoder.local * a + modal_part.reshape(a.shape)

    return {name: added(local[name], modal[name]) for name in ("kernel", "bias")}

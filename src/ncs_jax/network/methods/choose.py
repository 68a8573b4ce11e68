"""The network that a scene asks for."""

from __future__ import annotations

from ncs_jax.network.decoder import Decoder
from ncs_jax.network.encoders import DynamicEncoder, LinearEncoder, StaticEncoder, SwingEncoder
from ncs_jax.network.methods.method import Method
from ncs_jax.network.methods.ncs import NCS
from ncs_jax.network.methods.pbns import PBNS
from ncs_jax.network.methods.snug import SNUG
from ncs_jax.network.methods.swing import Swing
from ncs_jax.scene.model import Model
from ncs_jax.scene.spec import Scene

__all__ = ["network_from"]


def network_from(scene: Scene, model: Model) -> Method:
    """Return the network that a scene's [network] describes, sized for a model."""
    spec, (verts, modes), dtype = scene.network, model.basis.shape, model.basis.dtype
    decoder, learned, state = Decoder(verts, spec.decoder, modes, dtype=dtype), scene.garment.learn_weights, spec.static[-1]
    if spec.method == "snug":
        return SNUG(DynamicEncoder((), spec.dynamic, state, dtype, bias=True), decoder, learned)
    static = StaticEncoder(spec.static, dtype)
    if spec.method == "pbns":
        return PBNS(static, decoder, learned)
    if model.vibrations is not None:
        modes = model.vibrations.directions.shape[-1]
        return Swing(static, SwingEncoder(spec.dynamic, state, dtype), decoder, verts, modes, spec.damping, learned)
    encoder = {"linear": LinearEncoder}.get(spec.cell, DynamicEncoder)
    return NCS(static, encoder(spec.joint, spec.dynamic, state, dtype) if model.moves else None, decoder, learned)

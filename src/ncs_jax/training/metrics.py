"""What training looks at between steps, and why a step was dropped."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.total import body_collision, distances
from ncs_jax.errors import required
from ncs_jax.geometry.mesh import edge_strain
from ncs_jax.geometry.numerics import norm
from ncs_jax.network.methods.method import Method, decode, garment_blend
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_garment, touched_body
from ncs_jax.training.loss import physics
from ncs_jax.training.step import Fault

__all__ = ["contact_energies", "diagnose", "training_metrics"]


def training_metrics(
    model: Model, network: Method, window: int, params, track: MotionFeatures, ends
) -> dict[str, Float[Array, "..."]]:
    """Return mean edge strain of each of a few frames, and the penetrating share of vertices (by the scene's own query), in %.

    Where alpha scales anything also `moved`: how far alpha = 1 is from alpha = 0, mean over the vertices in mm. With a
    swing also `swung`: how far that is by itself.
    """
    codes = network.windows(params, track, ends, window, 1)
    z, q = codes.together(), codes.swung()
    offsets = decode(network, params, model, z[-1], None if q is None else q[-1])
    weights = garment_blend(network, params, model)
    mesh = model.garment.mesh

    def one(args):
        offset, matrices = args
        x = pose_garment(model, offset, matrices, weights)
        result = {"strain": 100 * jnp.mean(edge_strain(x, mesh))}
        if model.terms.collision is not None:
            surface = required(model.surface, "model.surface")
            body, normals = touched_body(model, matrices)
            d = distances(with_points(x, surface.points), body, surface, model.terms, normals)
            result["penetrating"] = 100 * jnp.mean(d[: len(x)] < 0)
        return result

    each = (jnp.moveaxis(offsets, -1, 0), track.matrices[ends])
    found = {k: v if k == "strain" else jnp.mean(v) for k, v in lax.map(one, each).items()}
    if codes.dynamic is not None:
        moved = offsets - decode(network, params, model, codes.static[-1])
        found["moved"] = 1000 * jnp.mean(norm(jnp.moveaxis(moved, 1, -1)))
    if q is not None:
        directions = required(model.vibrations, "model.vibrations").directions
        free = jnp.tensordot(directions, q[-1], (-1, -1), precision="highest")
        found["swung"] = 1000 * jnp.mean(norm(jnp.moveaxis(free, 1, -1)))
    return found


def contact_energies(model: Model, network: Method, window: int, params, track: MotionFeatures, ends) -> Float[Array, "frames"]:
    """Return the energy of collision with the body (12), J, of some frames at alpha = 1."""
    codes = network.windows(params, track, ends, window, 1)
    z, q = codes.together(), codes.swung()
    offsets = decode(network, params, model, z[-1], None if q is None else q[-1])
    weights, surface = garment_blend(network, params, model), required(model.surface, "surface")

    def one(args):
        offset, matrices = args
        x = pose_garment(model, offset, matrices, weights)
        body, normals = touched_body(model, matrices)
        return body_collision(x, body, surface, model.terms, model.material, normals)

    return lax.map(one, (jnp.moveaxis(offsets, -1, 0), track.matrices[ends]))


def diagnose(model: Model, network: Method, params, track: MotionFeatures, fault: Fault) -> str:
    """Find which term of a dropped step went non-finite, in which frame, and at which vertex first."""
    model, frame = replace(model, terms=network.loss(model.terms)), int(fault.frame)
    history = 3 if model.terms.inertia else 1
    back = jnp.maximum(frame - jnp.arange(history), track.start[frame])
    weights = garment_blend(network, params, model)
    matrices, share = track.matrices[back][..., None], jnp.ones(1, fault.offsets.dtype)
    last = fault.offsets[0]

    def value(last):
        offsets = [frame[..., None] for frame in (last, *fault.offsets[1:history])]
        return {name: energy[0] for name, energy in physics(model, weights, offsets, matrices, share)[0].items()}

    if not bool(jnp.all(jnp.isfinite(last))):
        return f"step {int(fault.step)}, frame {frame}: the network's own output is not finite"
    parts = jax.jit(value)(last)
    for name, energy in parts.items():
        gradient = jax.jit(jax.grad(lambda o, n=name: value(o)[n]))(last)
        bad = ~np.isfinite(np.asarray(gradient)).all(axis=1)
        if not np.isfinite(float(energy)) or bad.any():
            vertex = int(bad.argmax()) if bad.any() else -1
            faces = np.flatnonzero((np.asarray(model.garment.mesh.faces) == vertex).any(axis=1))
            where = f"vertex {vertex}" + (f" (face {faces[0]})" if faces.size else "") if vertex >= 0 else "an unknown element"
            return f"step {int(fault.step)}, frame {frame}: {name} is not finite at {where}"
    return f"step {int(fault.step)}, frame {frame}: the gradient of the parameters is not finite"

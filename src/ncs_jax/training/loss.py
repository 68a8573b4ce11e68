"""The loss of a batch, the total energy (10), and its gradient by the network's parameters."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax

from ncs_jax.energies.elements import elastic
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import contact_force, energies
from ncs_jax.geometry.skinning import Blend, blend, skin
from ncs_jax.network.methods.method import Method, decode, garment_blend
from ncs_jax.network.methods.swing import Swing
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body, posed_bodies
from ncs_jax.scene.spec import TrainingSpec

__all__ = ["gradients", "physics", "pose_lanes", "with_bodies"]


BODIES = 1 << 28  # bytes of posed bodies that are kept, at most


def with_bodies(model: Model, track: MotionFeatures, batch: int) -> MotionFeatures:
    """The same motions with the bodies of all frames posed, `batch` at a time, where collision is by planes.

    A motion fixes them; a step looks them up. Where they take more than `BODIES` bytes, each step poses those it sees.
    """
    if model.terms.collision != "plane" or 2 * len(track.start) * model.body.nbytes > BODIES:
        return track
    return replace(track, bodies=jax.jit(posed_bodies, static_argnums=2)(model, track.matrices, batch))


def pose_lanes(model: Model, weights: Blend, offsets, matrices):
    """Vertices (verts, 3, *poses) in m from offsets, in m, and joint transforms (joints, 3, 4, *poses)."""
    rest = model.garment.mesh.rest
    return skin(blend(matrices, weights), rest.reshape(rest.shape + (1,) * (offsets.ndim - 2)) + offsets)


def _alone(model: Model, terms: Terms, weights: Blend, x, earlier, matrices, inertia_share):
    """The terms that look at one pose by itself: energies by name and derivatives by x and, with pins, by the weights."""
    body = None if model.body is None else pose_body(model, matrices)
    carried = pressed = None
    if terms.friction:
        carried = pose_lanes(model, weights, earlier, matrices)
        pressed = contact_force(carried, body, model.surface, terms, model.material)
    frame = StepInputs(1 / model.fps, body=body, carried=carried, pressed=pressed)

    def value(x, weights):
        at = replace(frame, blended=blend(matrices, weights)) if terms.pinning else frame
        parts = energies(x, model.garment, model.material, at, terms, model.surface)
        if terms.friction:
            parts["friction"] = parts["friction"] * inertia_share
        return sum(parts.values()), parts

    if not terms.pinning:
        slope, parts = jax.grad(value, has_aux=True)(x, weights)
        return parts, slope, None
    (slope, to_weights), parts = jax.grad(value, argnums=(0, 1), has_aux=True)(x, weights)
    return parts, slope, to_weights.weights


def physics(model: Model, weights: Blend, offsets, matrices, inertia_share, body=None):
    """Energies by term (poses,), and the gradients of their sum by the last frame's offsets and by the skinning weights.

    Args:
        offsets: (verts, 3, poses) in m of each frame, the last first. matrices: (history, joints, 3, 4, poses).
        inertia_share: (poses,) 1, or 0 where a pose has no past of its own. body: (body, 6, poses) of `posed_bodies`, if known.

    The poses lie beside each other in the vector lanes, but for the terms that look for what is near.
    """
    terms = model.terms
    x, back = jax.vjp(lambda last, weights: pose_lanes(model, weights, last, matrices[0]), offsets[0], weights)
    parts, gradient = elastic(x, model.garment, model.material, terms)

    previous = before = None
    if terms.inertia:
        previous, before = (pose_lanes(model, weights, offsets[k], matrices[k]) for k in (1, 2))
    plane = "plane" if terms.collision == "plane" else None
    together = Terms(None, bending=False, collision=plane, exact=terms.exact, gravity=terms.gravity, inertia=terms.inertia)
    posed = normals = None
    if body is not None:
        posed, normals = body[:, :3], body[:, 3:]
    elif plane is not None:
        posed = pose_body(model, matrices[0])
    frame = StepInputs(1 / model.fps, previous, before, posed, normals=normals)

    def simple(x):
        some = energies(x, model.garment, model.material, frame, together, model.surface)
        if terms.inertia:
            some["inertia"] = some["inertia"] * inertia_share
        return jnp.sum(sum(some.values(), start=jnp.zeros((), x.dtype))), some

    slope, some = jax.grad(simple, has_aux=True)(x)
    parts, gradient = parts | some, gradient + slope
    collision = None if plane else terms.collision
    alone = replace(terms, membrane=None, bending=False, collision=collision, gravity=False, inertia=False)
    if alone.collision is None and not (alone.friction or alone.pinning or alone.self_contact):
        return parts, *back(gradient)

    each = (x, offsets[1] if terms.friction else None, matrices[0], inertia_share)
    each = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), each)
    some, slope, to_weights = lax.map(lambda one: _alone(model, alone, weights, *one), each)
    to_offsets, to_all = back(gradient + jnp.moveaxis(slope, 0, -1))
    if to_weights is not None:
        to_all = replace(to_all, weights=to_all.weights + jnp.sum(to_weights, axis=0))
    return parts | some, to_offsets, to_all


def _through_time(model: Model, weights: Blend, offsets, matrices, inertia_share):
    """The gradients of inertia by the offsets of the two frames before, and by the skinning weights that pose them."""
    x = pose_lanes(model, weights, offsets[0], matrices[0])
    terms = Terms(None, bending=False, collision=None, gravity=False, through_time=True)

    def value(earlier, weights):
        frame = StepInputs(1 / model.fps, *(pose_lanes(model, weights, earlier[k], matrices[1 + k]) for k in (0, 1)))
        return jnp.sum(inertia_share * energies(x, model.garment, model.material, frame, terms)["inertia"])

    return jax.grad(value, argnums=(0, 1))(list(offsets[1:]), weights)


def gradients(
    model: Model, network: Method, spec: TrainingSpec, params, track: MotionFeatures, ends, pairs, axis: str | None = None
):
    """One step's gradient: the network's transposed derivative applied to the physics' gradient at the vertices.

    Returns gradients of the parameters, the batch's energies by term (batch,), and what `Fault` needs of every sample.
    Positions before the last frame enter as constants, so only that frame is differentiated through the decoder; unless the
    method's loss goes through time.
    Within a `shard_map` over `axis`, `ends`, `pairs` and what is returned of samples are this device's share of the batch.
    """
    model = replace(model, terms=network.loss(model.terms))
    history = 3 if model.terms.inertia else 1
    swapped = round(spec.motion_augmentation * spec.batch) if network.controlled else 0
    augmented = 0 if isinstance(network, Swing) else swapped  # no inertia of theirs
    number = jnp.arange(ends.shape[0], dtype=ends.dtype)  # in the whole batch
    if axis is not None:
        number = number + lax.axis_index(axis) * ends.shape[0]
    own = number >= augmented

    def codes(params):
        z_static, z_dynamic, _ = network.windows(params, track, ends, max(spec.window, history), history)
        if z_dynamic is None:
            return z_static
        if not augmented:
            return z_static + z_dynamic
        # Motion augmentation: another window's dynamic code on this one's static code, both constants.
        if axis is not None:  # any number of this device's windows are such, and the others' codes may be elsewhere
            everyone = lax.all_gather(lax.stop_gradient(z_dynamic), axis, axis=1, tiled=True)
            return jnp.where(own[:, None], z_static + z_dynamic, lax.stop_gradient(z_static) + everyone[:, pairs])
        mixed = lax.stop_gradient(z_static[:, :augmented]) + lax.stop_gradient(z_dynamic[:, pairs[:augmented]])
        return jnp.concatenate([mixed, (z_static + z_dynamic)[:, augmented:]], axis=1)

    def swung(network, params):
        """Offsets with a swing, its own or any size of another frame's, and what they are beyond the static ones."""
        everyone = ends if axis is None else lax.all_gather(ends, axis, tiled=True)
        at = jnp.where(number < swapped, everyone[pairs], ends)
        share = number.astype(track.swing.dtype) / max(swapped - 1, 1)
        share = jnp.where(number < swapped, share * network.enlargement(track, at), 1)
        found = network.mixed(params, track, ends, at, share)
        z = found.together()
        offsets = decode(network, params, model, jnp.concatenate([z, lax.stop_gradient(found.static)]))
        offsets, static = jnp.split(offsets, 2, axis=-1)
        moved = offsets - lax.stop_gradient(static)
        return [offsets + jnp.tensordot(model.vibrations.directions, found.swing, (-1, -1)), moved], (z[None], found.swing)

    def decoded(params):
        if isinstance(network, Swing):
            return swung(network, params)
        z = codes(params)
        if not model.terms.through_time:
            return [decode(network, params, model, z[-1])], (z, None)
        every = decode(network, params, model, z)
        return [every[:, :, k] for k in (2, 1, 0)], (z, None)

    offsets, transpose, (z, swing) = jax.vjp(decoded, params, has_aux=True)
    if isinstance(network, Swing):
        *offsets, moved = offsets
    if history > len(offsets):
        earlier = decode(network, params, model, z[:-1])
        offsets = [*offsets, earlier[:, :, 1], earlier[:, :, 0]]
    back = jnp.maximum(ends[None] - jnp.arange(history, dtype=ends.dtype)[:, None], track.start[ends][None])
    matrices = jnp.moveaxis(track.matrices[back], 1, -1)
    weights, pull = jax.vjp(lambda p: garment_blend(network, p, model), params)
    body = None if track.bodies is None else jnp.moveaxis(track.bodies[ends], 0, -1)
    share = own.astype(offsets[0].dtype)
    parts, g, to_weights = physics(model, weights, offsets, matrices, share, body)
    by_frame = [g]
    if isinstance(network, Swing):
        held, to_moved = network.hold(model, moved, swing)
        parts, by_frame = parts | {"hold": held}, [g, to_moved]
    if model.terms.through_time:
        past, more = _through_time(model, weights, offsets, matrices, share)
        by_frame, to_weights = by_frame + past, jax.tree.map(jnp.add, to_weights, more)
    (result,) = transpose([g / ends.shape[0] for g in by_frame])
    if network.learn_weights:
        (more,) = pull(jax.tree.map(lambda w: w / ends.shape[0], to_weights))
        result = jax.tree.map(jnp.add, result, more)
    return result if axis is None else lax.pmean(result, axis), parts, (g, offsets)

"""The loss of a batch, the total energy (10), and its gradient by the network's parameters."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ncs_jax.energies.contact.intersections import contour_length, crossings
from ncs_jax.energies.elements import energies_and_gradient
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import required
from ncs_jax.geometry.skinning import Blend, blend
from ncs_jax.network.methods.method import Method, Offsets, Windows, decode, garment_blend
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_garment, posed_bodies
from ncs_jax.scene.step_inputs import Past, step_inputs

__all__ = ["gradients", "physics", "tangle", "with_bodies"]

More = Callable[[Array], tuple[dict[str, Array], Array]]

BODIES = 1 << 29  # bytes of posed bodies that are kept, at most: about what compiling takes and gives back before them
UNTANGLED = 16  # poses of a batch for each in which it is looked where the garment passes through itself


def with_bodies(model: Model, track: MotionFeatures, batch: int, known: Array | None = None, same: int = 0) -> MotionFeatures:
    """Return the motions with the bodies of all frames posed, `batch` at a time, where collision is by planes.

    A motion fixes them; a step looks them up. Where they take more than `BODIES` bytes, each step poses those it sees.
    `known`: the bodies of an earlier call, which are used up; the first `same` frames are those of then.
    """
    body = model.body
    if body is None or model.terms.collision != "plane" or 2 * len(track.start) * body.nbytes > BODIES:
        return track
    bodies = jax.jit(posed_bodies, static_argnums=2)(model, track.matrices[same:], batch)
    return replace(track, bodies=bodies if known is None else _with_last(known, bodies))


@functools.partial(jax.jit, donate_argnums=0)
def _with_last(frames: Array, last: Array) -> Array:
    return frames.at[len(frames) - len(last) :].set(last)


def physics(model: Model, weights: Blend, offsets, matrices, moving, body=None, more: More | None = None):
    """Return energies by term (poses,) in J, and the gradients of their sum by the last frame's offsets and by the weights.

    Args:
        offsets: (verts, 3, poses) in m of each frame, the last first. matrices: (history, joints, 3, 4, poses).
        moving: (poses,) 1, or 0 where a pose has no past of its own. body: (body, 6, poses) of `posed_bodies`, if known.
        more: returns other energies of positions (verts, 3, poses), by name, and their slope.
    """
    terms, rest = model.terms, model.garment.mesh.rest
    needs_transforms = terms.pinning or terms.friction or bool(terms.own)

    def by_pose(weights):  # as one product of all poses it would round otherwise than where one is evaluated
        each = lax.map(lambda m: blend(m, weights), jnp.moveaxis(matrices[0], -1, 0))
        return jnp.moveaxis(each, 0, -1)

    def posed(last, weights):
        return pose_garment(model, last, matrices[0], weights), by_pose(weights) if needs_transforms else None

    (x, transforms), back = jax.vjp(posed, offsets[0], weights)
    previous = before = None
    if terms.inertia:
        previous, before = (pose_garment(model, offsets[k], matrices[k], weights) for k in (1, 2))
    past = Past(previous, before, rest[..., None] + offsets[1] if terms.friction else None, moving)
    step = step_inputs(model, matrices[0], past, transforms=transforms, body=body)
    parts, to_x, to_transforms = energies_and_gradient(x, model.garment, model.material, step, terms, model.surface)
    if more is not None:
        others, slope = more(x)
        parts, to_x = parts | others, to_x + slope
    if needs_transforms and to_transforms is None:
        to_transforms = jnp.zeros_like(transforms)
    return parts, *back((to_x, to_transforms))


def tangle(model: Model, untangling: float, turn, x) -> tuple[dict[str, Array], Array]:
    """Return what the curves along which the garment passes through itself cost (poses,), J, and its slope, N.

        E = k_u L,   L of `intersections.contour_length`

    It is looked at in one pose in `UNTANGLED`, others from step to step, which count for all: the mean is that of all poses.
    Of cloth so crumpled that the search runs out of room, the curves that it found count.

    Args:
        untangling: k_u, J/m. turn: any whole number; it chooses the poses. x: (verts, 3, poses), m.
    """
    poses, count = x.shape[-1], -(-x.shape[-1] // UNTANGLED)
    chosen = (turn + UNTANGLED * jnp.arange(count, dtype=turn.dtype)) % poses
    mesh, groups, scale = model.garment.mesh, required(model.garment.groups, "garment.groups"), untangling * poses / count

    def one(x):
        x = x - lax.stop_gradient(jnp.mean(x, axis=0, keepdims=True))
        return scale * contour_length(x, mesh, crossings(x, mesh, groups))

    value, slope = lax.map(jax.value_and_grad(one), jnp.moveaxis(x[..., chosen], -1, 0))
    none = jnp.zeros_like(x)
    return {"untangling": none[0, 0].at[chosen].add(value)}, none.at[..., chosen].add(jnp.moveaxis(slope, 0, -1))


def _through_time(model: Model, weights: Blend, offsets, matrices, moving):
    """The gradients of inertia by the offsets of the two frames before, and by the skinning weights that pose them."""
    x = pose_garment(model, offsets[0], matrices[0], weights)
    terms = Terms(None, bending=False, collision=None, gravity=False, through_time=True)

    def value(earlier, weights):
        past = (pose_garment(model, earlier[k], matrices[1 + k], weights) for k in (0, 1))
        step = StepInputs(1 / model.fps, *past, moving=moving)
        return jnp.sum(energy_terms(x, model.garment, model.material, step, terms)["inertia"])

    return jax.grad(value, argnums=(0, 1))(list(offsets[1:]), weights)


def gradients(model: Model, network: Method, params, track: MotionFeatures, windows: Windows, untangling: float = 0.0):
    """Return one step's gradient: the network's transposed derivative applied to the physics' gradient at the vertices.

    Returns gradients of the parameters, the batch's energies by term (batch,), and what `Fault` needs of every sample: the
    gradient at the last frame's offsets, and the offsets of all frames.
    Positions before the last frame enter as constants, so only that frame is differentiated through the decoder; unless the
    method's loss goes through time. `untangling`: of `tangle`, J/m; 0: that is not looked at.
    """
    model = replace(model, terms=network.loss(model.terms))
    (offsets, extra), transpose, kept = jax.vjp(
        lambda params: network.offsets(params, model, track, windows), params, has_aux=True
    )
    ends, size, history = windows.ends, windows.ends.shape[0], windows.history
    if history > len(offsets):
        earlier = decode(network, params, model, kept.codes[:-1])
        offsets = [*offsets, earlier[:, :, 1], earlier[:, :, 0]]
    back = jnp.maximum(ends[None] - jnp.arange(history, dtype=ends.dtype)[:, None], track.start[ends][None])
    matrices = jnp.moveaxis(track.matrices[back], 1, -1)
    weights, pull = jax.vjp(lambda p: garment_blend(network, p, model), params)
    body = None if track.bodies is None else jnp.moveaxis(track.bodies[ends], 0, -1)
    moving = windows.own.astype(offsets[0].dtype)
    tangled = functools.partial(tangle, model, untangling, jnp.sum(ends)) if untangling else None
    parts, g, to_weights = physics(model, weights, offsets, matrices, moving, body, tangled)
    by_frame, to_extra = [g], None
    if extra is not None:
        more, to_extra = network.coupling(model, extra, kept)
        parts, to_extra = parts | more, to_extra / size
    if model.terms.through_time:
        past, more = _through_time(model, weights, offsets, matrices, moving)
        by_frame, to_weights = by_frame + past, jax.tree.map(jnp.add, to_weights, more)
    (result,) = transpose(Offsets([g / size for g in by_frame], to_extra))
    if network.learn_weights:
        (more,) = pull(jax.tree.map(lambda w: w / size, to_weights))
        result = jax.tree.map(jnp.add, result, more)
    return result if windows.axis is None else lax.pmean(result, windows.axis), parts, (g, offsets)

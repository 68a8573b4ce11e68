"""What one step needs of a model and a frame, prepared once for training, simulation and evaluation alike."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.terms import StepInputs
from ncs_jax.energies.total import contact_force
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.skinning import blend, skin, unpose
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, touched_body

__all__ = ["Past", "frame_inputs", "step_inputs"]


class Past(NamedTuple):
    """The garment before this step; `None` where no term asks for it.

    Attributes:
        previous, before: x_{t-1} and x_{t-2} in m, which inertia reads.
        unposed: x_{t-1} in m taken back through the skinning of its own frame, which friction advects:
            `unpose(blend(matrices_before, model.blend), previous)`, both of `geometry.skinning`.
        moving: what inertia and friction count, 0 in a pose without a past; None: 1.
    """

    previous: Float[Array, "verts 3 *poses"] | None = None
    before: Float[Array, "verts 3 *poses"] | None = None
    unposed: Float[Array, "verts 3 *poses"] | None = None
    moving: Float[Array, "*poses"] | None = None


def step_inputs(
    model: Model,
    matrices: Float[Array, "joints 3 4 *poses"],
    past: Past | None = None,
    *,
    transforms: Float[Array, "verts 3 4 *poses"] | None = None,
    body: Float[Array, "body 6 *poses"] | None = None,
    force: Float[Array, "verts 3 *poses"] | None = None,
) -> StepInputs:
    """Return what the model's terms read in one frame, or in several poses beside each other, and nothing else.

    Friction reads where the body alone carries the last positions, x_adv = R_t R_{t-1}^-1 x_{t-1}, and the contact force there.

    Args:
        matrices: joint transforms from rest to pose. past: the garment before; None where no term asks for it.
        transforms: skinning transforms of the garment's vertices, where they are known; else from the model's weights.
        body: positions (m) and normals of `model.posed_bodies`, where they are known. force: external, N.
    """
    terms, past = model.terms, past or Past()
    posed = normals = None
    if model.surface is not None and (terms.collision is not None or terms.own):
        posed, normals = touched_body(model, matrices) if body is None else (body[:, :3], body[:, 3:])
    if not (terms.pinning or terms.friction or terms.own):
        transforms = None
    elif transforms is None:
        transforms = blend(matrices, model.blend)
    advected = lagged = None
    if terms.friction:
        advected = skin(required(transforms, "transforms"), required(past.unposed, "past.unposed"))
        lagged = _lagged_normal_force(model, advected, posed, normals)
    inertia = terms.inertia or bool(terms.own)
    return StepInputs(
        1 / model.fps,
        past.previous if inertia else None,
        past.before if inertia else None,
        posed,
        transforms if terms.pinning or terms.own else None,
        advected,
        lagged,
        normals,
        force,
        past.moving if terms.inertia or terms.friction else None,
    )


def frame_inputs(
    model: Model,
    track: MotionFeatures,
    frame: int | Int[Array, ""],
    previous: Float[Array, "verts 3"] | None = None,
    before: Float[Array, "verts 3"] | None = None,
) -> StepInputs:
    """Return what the energies of a frame of a motion read, all that the model's terms ask for.

        step = frame_inputs(model, track, 12, previous, before)
        parts = energy_terms(x, model.garment, model.material, step, model.terms, model.surface)

    Args:
        model: of a scene, such as `assembly.model`.
        track: a motion, `assembly.track` or `run.track(name)`. Positions are seen from its origin: `track.relative(x)`.
        frame: which of the track's.
        previous: the garment in the frame before, x_{t-1}, m; needed with inertia or friction. It and `before` are constants to
            the derivative of the energies, unless the model's `terms.through_time`: a gradient through frames needs that.
        before: the garment two frames before, x_{t-2}, m; else that of the frame before, a garment that was at rest.

    Raises:
        InputError: a term asks for the past, and there is none; or the track has no such frame.
    """
    frames = len(track.start)
    if not isinstance(frame, jax.core.Tracer) and not 0 <= int(frame) < frames:
        raise InputError(f"a frame from 0 to {frames - 1} expected", field="frame", value=int(frame))
    unposed, terms = None, model.terms
    if terms.inertia or terms.friction or terms.own:
        previous = required(previous, "previous", "give the garment in the frame before, seen from track.origin, m")
        before = previous if before is None else before
    if terms.friction:
        last = jnp.maximum(jnp.asarray(frame) - 1, track.start[frame])
        unposed = unpose(blend(track.matrices[last], model.blend), required(previous, "previous"))
    return step_inputs(model, track.matrices[frame], Past(previous, before, unposed))


def _lagged_normal_force(model: Model, advected, body, normals) -> Float[Array, "verts 3 *poses"]:
    def one(pose):
        x, body, normals = pose
        return contact_force(x, body, model.surface, model.terms, model.material, normals)

    given = advected, body, normals
    if advected.ndim == 2:
        return one(given)
    return jnp.moveaxis(lax.map(one, jax.tree.map(lambda each: jnp.moveaxis(each, -1, 0), given)), 0, -1)

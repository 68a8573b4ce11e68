"""The posed character that a garment is drawn on: its body, and the garments worn below."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.errors import required
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import (
    Blend,
    Correctives,
    Skeleton,
    blend,
    blend_from,
    corrected,
    correctives_from,
    forward,
    skin,
    to_rest_axes,
    transforms,
)
from ncs_jax.network.rollout import animated
from ncs_jax.prepare.build import Assembly, features_from_records
from ncs_jax.prepare.posing import world_axes, world_turns
from ncs_jax.view.animation import Animation, PosedBody
from ncs_jax.view.heading import trunk_axes, up_of

__all__ = ["animation_of", "body_vertices", "posed_body"]


def animation_of(assembly: Assembly, motion: io.MotionRecord | None, vertices: np.ndarray) -> Animation:
    """Return a garment as pictures and pages draw it, on the character that wears it.

        contact_sheet("sheet.png", animation_of(run.assembly, run.motion(name), run.animate(name)))

    Args:
        assembly: of the garment, such as `run.assembly`. motion: that the garment was animated over; None
            for a body that is a moving mesh.
        vertices: of the garment over the motion (frames, verts, 3), m.

    Raises:
        InputError: the vertices do not fit: see `Animation`.
    """
    up = up_of(assembly.scene.physics.gravity)
    body = assembly.body
    if body is not None and body.frames is not None:
        every = max(1, round(len(body.frames) / len(vertices)))  # of the substeps
        worn_on = PosedBody(body.frames[::every], body.faces)
        return Animation(
            vertices, assembly.garment.faces, assembly.model.fps / every, worn_on, up, layers=assembly.garment.layers
        )
    given = required(motion, "motion", "give the one that the garment was animated over")
    garment, fps = assembly.garment, assembly.model.fps
    return Animation(vertices, garment.faces, fps, posed_body(assembly, given), up, layers=garment.layers)


def posed_body(assembly: Assembly, motion: io.MotionRecord) -> PosedBody | None:
    """Return the body and the garments worn below over a motion as one mesh, the garments last; None without a body."""
    if assembly.body is None:
        return None
    vertices, faces = [body_vertices(assembly.body, motion)], [assembly.body.faces]
    for layer in assembly.model.under:
        faces.append(np.asarray(layer.model.garment.mesh.faces) + sum(v.shape[1] for v in vertices))
        vertices.append(animated(layer.model, layer.network, layer.params, features_from_records(layer.model, motion)))
    worn = sum(v.shape[1] for v in vertices[1:])
    turns = world_turns(world_axes(motion.poses, assembly.body.rest_rotations), assembly.body.parents)
    return PosedBody(np.concatenate(vertices, axis=1), np.concatenate(faces), worn, trunk_axes(assembly.body, turns))


def body_vertices(body: io.BodyRecord, motion: io.MotionRecord) -> np.ndarray:
    """Return the whole body's vertices over a motion, (frames, body, 3) in m."""
    skeleton = Skeleton(jnp.asarray(body.joints, jnp.float32), tuple(int(p) for p in body.parents))
    weights, rest = blend_from(body.weights), jnp.asarray(body.vertices, jnp.float32)
    local = axis_angle_to_matrix(jnp.asarray(motion.poses, jnp.float32))
    if body.rest_rotations is not None:
        local = to_rest_axes(local, jnp.asarray(body.rest_rotations, jnp.float32))
    more = None if body.posedirs is None else correctives_from(body.posedirs)
    return np.asarray(_skinned(skeleton, weights, more, rest, local, jnp.asarray(motion.translation, jnp.float32)))


@jax.jit
def _skinned(skeleton: Skeleton, weights: Blend, more: Correctives | None, rest, local, translation) -> jax.Array:
    """Return vertices over a motion, m, from those at rest, local rotations and the root's places."""
    matrices = transforms(skeleton, forward(skeleton, local, translation))
    return jax.lax.map(lambda m: skin(blend(m, weights), corrected(rest, more, m, skeleton.parents)), matrices)

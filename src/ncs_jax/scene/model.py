"""Everything about a scene that does not change while it runs: the character, the garment on it, and what they are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.contact.beside import Beside, turned_inwards
from ncs_jax.energies.contact.points import ContactPoints
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.energies.terms import Garment, Material, OwnTerm, Terms
from ncs_jax.errors import InputError, required, shaped
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import Blend, Correctives, Skeleton, blend, corrected, skin, to_rest_axes

__all__ = [
    "Layer",
    "Model",
    "RitzModes",
    "body_normals",
    "local_rotations",
    "pose_body",
    "pose_garment",
    "pose_rest",
    "posed_bodies",
    "resting_body",
    "touched_body",
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RitzModes:
    """Movements of a garment about its drape, in unposed space: see `ritz_modes.softest_ritz_modes`.

    directions: displacements (verts, 3, modes), m. energy: twice what moving by one of them takes, the same for all, J.
    slope: what bounds a swing q, by q^T slope q: the garment's mean of the displacement gradients' products, grad d_k : grad
    d_l, of which the root is how much it turns and strains, r.m.s.; and what training shows of it, see `methods.swing`. None
    in a run of an earlier version, whose swing has no bounds. by_pose: how stiff the garment is along them in a pose, a linear
    map of its descriptors, its constant, and between what it was seen, see `runs.pose_stiffness`; None: as about the drape.
    drape: offsets (verts, 3) in unposed space of the garment as it hangs in the training's middle pose, m, where that begins.
    """

    directions: Float[Array, "verts 3 modes"]
    energy: Float[Array, ""]
    slope: Float[Array, "modes modes"] | None = None
    by_pose: Float[Array, "rows entries"] | None = None
    drape: Float[Array, "verts 3"] | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Layer:
    """A garment worn below, which collides as a part of the body: what animates it."""

    model: Model
    params: dict
    network: Any = field(metadata={"static": True})

    @property
    def rest(self) -> Float[Array, "verts 3"]:
        """Return its place at rest, m."""
        return self.model.garment.mesh.rest


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """Constants of a scene. The skeleton holds only the joints that matter, the `source_joints` of the motion's.

    `inputs` are the joints that the network reads, the root first. `body` and its `surface` are the part of the body that the
    garment can touch, `None` in a scene without a body or without collision; `correctives` are those of the part, `None` for a
    body without. Of a moving mesh `body` is the first frame and `body_blend` is None: a track has the places of its vertices
    after the transforms of the joints. To the surface also belong the garments `under` this one, after the body: each of their
    vertices goes by a transform of its own, which a track has after those of the joints.
    """

    skeleton: Skeleton
    rest_rotations: Float[Array, "joints 3 3"] | None
    garment: Garment
    blend: Blend
    material: Material
    basis: Float[Array, "verts modes"]  # smooth modes that the decoder works with, m
    body: Float[Array, "body 3"] | None
    body_blend: Blend | None
    surface: Surface | None
    terms: Terms = field(metadata={"static": True})
    inputs: tuple[int, ...] = field(metadata={"static": True})
    source_joints: tuple[int, ...] = field(metadata={"static": True})
    descriptor: str = field(metadata={"static": True})
    fps: float = field(metadata={"static": True})
    moves: bool = field(default=True, metadata={"static": True})  # False: nothing dynamic is traced
    vibrations: RitzModes | None = None  # where the network swings along them
    under: tuple[Layer, ...] = ()  # garments worn below this one
    correctives: Correctives | None = None
    beside: Beside | None = None  # of the body, where contact is by planes

    @property
    def points(self) -> ContactPoints | None:
        """Return the points between the garment's vertices at which contact looks too, where there are some."""
        return None if self.surface is None else self.surface.points

    def with_terms(self, terms: Sequence[OwnTerm]) -> Model:
        """Return the model with terms of one's own beside the scene's: see `energies.terms.OwnTerm`.

        Raises:
            InputError: a term has no name of its own.
        """
        try:
            return replace(self, terms=replace(self.terms, own=tuple(terms)))
        except ValueError as fault:
            raise InputError(
                str(fault), field="terms", mend="define it with `def name(x, step)`, and give it another name"
            ) from None


def pose_garment(
    model: Model,
    offsets: Float[Array, "verts 3 *poses"],
    matrices: Float[Array, "joints 3 4 *poses"],
    weights: Blend | None = None,
) -> Float[Array, "verts 3 *poses"]:
    """Return the garment posed, equation (16): x = sum_j w_j (R_j (rest + offset) + t_j), m.

    Args:
        offsets: in unposed space, m. matrices: joint transforms. weights: skinning weights, where they are learned; else the
            model's.
    """
    rest = model.garment.mesh.rest
    rest = rest.reshape(rest.shape + (1,) * (offsets.ndim - 2))
    return skin(blend(matrices, model.blend if weights is None else weights), rest + offsets)


def pose_rest(model: Model, matrices: Float[Array, "joints 3 4"]) -> Float[Array, "verts 3"]:
    """Return the garment as the body alone carries it, equation (16) without offsets, m."""
    return skin(blend(matrices, model.blend), model.garment.mesh.rest)


def resting_body(model: Model) -> np.ndarray:
    """Return the touchable body at rest and the garments under this one, (body, 3) in m, as `model.surface` numbers them."""
    return np.concatenate([required(model.body, "model.body"), *(layer.rest for layer in model.under)])


def pose_body(model: Model, matrices: Float[Array, "joints 3 4 *poses"]) -> Float[Array, "body 3 *poses"]:
    """Return the touchable body in one frame or several, and the garments under this one, m.

    A body is skinned linearly, after its pose correctives where it has some: see `skinning.corrected`. A moving mesh is
    where its file says.
    """
    if model.body_blend is None and model.body is not None:
        return matrices[len(model.skeleton.parents) :, :, 3]
    lanes = (1,) * (matrices.ndim - 3)
    body, weights = required(model.body, "model.body"), required(model.body_blend, "model.body_blend")
    carried = blend(matrices, weights)
    body = skin(carried, corrected(body.reshape(body.shape + lanes), model.correctives, matrices, model.skeleton.parents))
    if not model.under:
        return body
    rest = jnp.concatenate([layer.rest for layer in model.under])
    return jnp.concatenate([body, rest.reshape(rest.shape + lanes) + matrices[len(model.skeleton.parents) :, :, 3]])


def body_normals(
    model: Model, body: Float[Array, "body 3 *poses"], matrices: Float[Array, "joints 3 4 *poses"]
) -> Float[Array, "body 3 *poses"]:
    """Return the normals by which contact by planes goes: of the posed touchable body, `turned_inwards` beside the garment."""
    surface = required(model.surface, "model.surface")
    normals = vertex_normals(body, surface)
    return normals if model.beside is None else turned_inwards(normals, body, matrices, model.beside)


def touched_body(
    model: Model, matrices: Float[Array, "joints 3 4 *poses"]
) -> tuple[Float[Array, "body 3 *poses"], Float[Array, "body 3 *poses"] | None]:
    """Return the posed touchable body, m, and `body_normals` where contact reads them and they are not the body's own."""
    body = pose_body(model, matrices)
    turned = model.terms.collision == "plane" and model.beside is not None
    return body, body_normals(model, body, matrices) if turned else None


def posed_bodies(model: Model, matrices: Float[Array, "frames joints 3 4"], lanes: int) -> Float[Array, "frames body 6"]:
    """Return positions in m and normals of the touchable body in many frames, `lanes` of them at a time."""
    frames = len(matrices)
    lanes = min(lanes, frames)
    firsts = np.minimum(np.arange(0, frames, lanes), frames - lanes)  # the last ones may be posed twice

    def some(bodies, first):
        at = jnp.moveaxis(lax.dynamic_slice_in_dim(matrices, first, lanes), 0, -1)
        body = pose_body(model, at)
        posed = jnp.moveaxis(jnp.concatenate([body, body_normals(model, body, at)], axis=1), -1, 0)
        return lax.dynamic_update_slice_in_dim(bodies, posed, first, 0), None  # in place: a second copy of all is large

    body = jax.eval_shape(pose_body, model, matrices[0])
    return lax.scan(some, jnp.zeros((frames, body.shape[0], 6), body.dtype), firsts)[0]


@jax.jit
def local_rotations(model: Model, poses: Float[Array, "*frames all 3"]) -> Float[Array, "*frames joints 3 3"]:
    """Return local rotation matrices of the joints that matter, along the axes at rest.

    Args:
        poses: axis-angle (rad) of all joints of the body's file, as a `MotionRecord` of the body has them.

    Raises:
        InputError: they are of another skeleton.
    """
    least = max(model.source_joints) + 1
    if poses.shape[-2:-1] < (least,):
        what = f"poses (*frames, joints, 3) of all joints of the body's file, {least} or more, expected"
        raise InputError(what, field="poses", value=f"shape {poses.shape}")
    shaped(poses, (3,), "poses", "axis-angle (*frames, joints, 3), rad,")
    local = axis_angle_to_matrix(poses[..., np.asarray(model.source_joints), :])
    return local if model.rest_rotations is None else to_rest_axes(local, model.rest_rotations)

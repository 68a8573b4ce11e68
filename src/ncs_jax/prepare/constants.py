"""The constants of a scene, as the energies and the network use them: skeleton, material, terms that are on."""

from __future__ import annotations

import jax
import numpy as np

from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.energies.terms import MEMBRANES, Garment, Material, Terms
from ncs_jax.geometry.skinning import Skeleton, blend_from, correctives_from
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.prepare.prepared import Prepared, SceneFiles
from ncs_jax.prepare.skinning_weights import used_joints
from ncs_jax.scene.model import Model
from ncs_jax.scene.spec import PhysicsSpec

__all__ = ["model_from"]


def model_from(files: SceneFiles, prepared: Prepared, dtype) -> Model:
    """Return the constants of a scene, without the body's surface and without vibrations, which need the motions.

    The skeleton keeps the joints that move the garment or the touchable body, those that the network
    reads or that correct the body, and all above.
    """
    scene, body, physics = files.scene, files.body, files.scene.physics
    parents, joints, rest_rotations, body_weights = np.array([-1]), np.zeros((1, 3)), None, np.zeros((0, 1))
    if body is not None:
        parents, joints, rest_rotations = np.asarray(body.parents), body.joints, body.rest_rotations
        body_weights = body.weights[prepared.part]
    collides = len(prepared.part) > 0 and physics.collision.stiffness > 0
    posedirs = body.posedirs[prepared.part] if collides and body is not None and body.posedirs is not None else None
    kept = _kept_joints(prepared, parents, body_weights, () if posedirs is None else correctives_from(posedirs).joints)
    number = {j: i for i, j in enumerate(kept)}  # of the body's joint in the model's skeleton
    kept_parents = tuple(number[int(parents[j])] if parents[j] >= 0 else -1 for j in kept)
    body_points = body_blend = None
    if collides and body is not None:
        body_points = jax.device_put(np.asarray(body.vertices[prepared.part], dtype))
        body_blend = blend_from(body_weights[:, kept], dtype=dtype) if body.frames is None else None
    looks = physics.self_contact.stiffness > 0 or scene.training.untangling > 0  # at where the garment meets itself
    pins, groups = jax.device_put(files.pins), groups_from(files.mesh) if looks else None
    return Model(
        skeleton=Skeleton(jax.device_put(np.asarray(joints[kept], dtype)), kept_parents),
        rest_rotations=None if rest_rotations is None else jax.device_put(np.asarray(rest_rotations[kept], dtype)),
        garment=Garment(files.mesh, pins, groups),
        blend=blend_from(prepared.weights[:, kept], dtype=dtype),
        material=_material(physics, dtype),
        basis=jax.device_put(np.asarray(prepared.basis, dtype)),
        body=body_points,
        body_blend=body_blend,
        surface=None,
        terms=_terms(files, collides=collides, moves=bool(prepared.moves)),
        inputs=tuple(number[j] for j in prepared.inputs.tolist()),
        source_joints=tuple(kept),
        descriptor=scene.network.descriptor,
        fps=scene.motion.fps,
        moves=bool(prepared.moves),
        under=files.layers if collides else (),
        correctives=None if posedirs is None else correctives_from(posedirs, number, dtype),
    )


def _kept_joints(prepared: Prepared, parents: np.ndarray, body_weights: np.ndarray, correcting: tuple[int, ...]) -> list[int]:
    """Return the body's joints that the model's skeleton keeps, parents before children."""
    skinning = used_joints(parents.tolist(), np.concatenate([prepared.weights, body_weights]), least=1e-4)
    return sorted(set(skinning).union(*(path_to_root(parents, j) for j in (*prepared.inputs.tolist(), *correcting))))


def _membrane(physics: PhysicsSpec) -> tuple[str | None, tuple[float, ...]]:
    """Return the membrane model, None for none, and its stiffnesses, N/m."""
    name = None if physics.membrane.model == "none" else physics.membrane.model
    return name, tuple(getattr(physics.membrane, n) for n in MEMBRANES[name][1]) if name else ()


def _material(physics: PhysicsSpec, dtype) -> Material:
    """Return the numbers of the physics as arrays."""

    def array(value):  # without a program for every shape
        return jax.device_put(np.asarray(value, dtype))

    keeps_apart = physics.self_contact.stiffness > 0
    return Material(
        density=array(physics.density),
        membrane=tuple(array(n) for n in _membrane(physics)[1]),
        bending=array(physics.bending.stiffness),
        collision=array(physics.collision.stiffness),
        thickness=array(physics.collision.thickness),
        friction=array(physics.collision.friction),
        pinning=array(physics.pinning.stiffness),
        gravity=array(physics.gravity),
        self_contact=array(physics.self_contact.stiffness) if keeps_apart else None,
        self_thickness=array(physics.self_contact.thickness) if keeps_apart else None,
    )


def _terms(files: SceneFiles, *, collides: bool, moves: bool) -> Terms:
    """Return which terms of the energy the scene has; the others are not traced."""
    physics = files.scene.physics
    membrane, stiffnesses = _membrane(physics)
    touching = collides and files.garment.layers and not physics.self_contact.stiffness  # which sees all cloth
    return Terms(
        membrane=membrane if any(stiffnesses) else None,
        bending=physics.bending.stiffness > 0 and len(files.mesh.hinges) > 0,
        collision=physics.collision.distance if collides else None,
        exact=physics.collision.search == "exact",
        friction=collides and physics.inertia and moves and physics.collision.friction > 0,
        gravity=any(physics.gravity),
        inertia=physics.inertia and moves,
        pinning=len(files.pins) > 0 and physics.pinning.stiffness > 0,
        self_contact=physics.self_contact.stiffness > 0,
        layers=None if not touching else "plane" if physics.collision.distance == "plane" else "triangle",
    )

"""The fast path of the total energy: values and forces together, by elements, in lanes of poses.

Training, simulation and evaluation all call `energies_and_gradient`. `total` is what it is tested against.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.bending import fold_gradient
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.energies.mass_spring import per_edge
from ncs_jax.energies.membrane import per_face
from ncs_jax.energies.terms import DENSITIES, Garment, Material, StepInputs, Terms
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import required
from ncs_jax.geometry.mesh import corners, gathered
from ncs_jax.geometry.soa_vectors import plus

__all__ = ["elastic", "energies_and_gradient"]


def energies_and_gradient(
    x: Float[Array, "verts 3 *poses"],
    garment: Garment,
    material: Material,
    step: StepInputs,
    terms: Terms,
    surface: Surface | None = None,
) -> tuple[dict[str, Float[Array, "*poses"]], Float[Array, "verts 3 *poses"], Float[Array, "verts 3 4 *poses"] | None]:
    """Return every term of `total.energy_terms` by name in J, and the derivatives of their sum.

    Returns:
        The energies; their gradient by x in N; and that by the vertex transforms, which pins and own terms read, else None.

    One pose (verts, 3) is differentiated whole. Several poses (verts, 3, poses) lie beside each other in the vector lanes:
    membrane and bending by `elastic`, the terms that look at vertices one by one all poses at once, and those that look for
    what is near a pose at a time.
    """
    if x.ndim == 2:
        return _one_pose(x, garment, material, step, terms, surface)
    parts, gradient = elastic(x, garment, material, terms)
    lanes, alone = _beside_and_alone(terms)

    def value(x):
        some = energy_terms(x, garment, material, step, lanes, surface)
        return jnp.sum(sum(some.values(), start=jnp.zeros((), x.dtype))), some

    slope, some = jax.grad(value, has_aux=True)(x)
    parts, gradient = parts | some, gradient + slope
    if alone.collision is None and not (alone.friction or alone.pinning or alone.self_contact or alone.own or alone.layers):
        return parts, gradient, None

    step = replace(step, force=None)
    if not alone.own:  # which may read all of it
        step = _needed(step, alone)
    given = {name: value for name, value in vars(step).items() if value is not None and name != "dt"}

    def each(one):
        x, given = one
        return _one_pose(x, garment, material, StepInputs(step.dt, **given), alone, surface)

    some, slope, to_transforms = lax.map(each, jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), (x, given)))
    to_transforms = None if to_transforms is None else jnp.moveaxis(to_transforms, 0, -1)
    return parts | some, gradient + jnp.moveaxis(slope, 0, -1), to_transforms


def _beside_and_alone(terms: Terms) -> tuple[Terms, Terms]:
    """Return the terms but membrane and bending: those of poses beside each other, and those of a pose at a time."""
    rest = replace(terms, membrane=None, bending=False)
    plane, planes = (how == "plane" for how in (terms.collision, terms.layers))
    lanes = replace(
        rest,
        collision=terms.collision if plane else None,
        layers=terms.layers if planes else None,
        friction=False,
        pinning=False,
        self_contact=False,
        own=(),
    )
    contact = None if plane else terms.collision
    return lanes, replace(rest, collision=contact, layers=None if planes else terms.layers, gravity=False, inertia=False)


def _needed(step: StepInputs, terms: Terms) -> StepInputs:
    """What some terms read, so that nothing else is copied pose by pose."""
    friction = terms.friction
    return StepInputs(
        step.dt,
        body=None if terms.collision is None else step.body,
        vertex_transforms=step.vertex_transforms if terms.pinning else None,
        advected=step.advected if friction else None,
        lagged_normal_force=step.lagged_normal_force if friction else None,
        moving=step.moving if friction else None,
    )


def _one_pose(x, garment, material, step: StepInputs, terms: Terms, surface):
    """The same of one pose: the sum of its terms, differentiated."""

    def value(x, transforms):
        parts = energy_terms(x, garment, material, replace(step, vertex_transforms=transforms), terms, surface)
        return sum(parts.values(), start=jnp.zeros((), x.dtype)), parts

    transforms = step.vertex_transforms
    if not (terms.pinning or terms.own) or transforms is None:
        gradient, parts = jax.grad(value, has_aux=True)(x, transforms)
        return parts, gradient, None
    (gradient, to_transforms), parts = jax.grad(value, argnums=(0, 1), has_aux=True)(x, transforms)
    return parts, gradient, to_transforms


def elastic(
    x: Float[Array, "verts 3 *poses"], garment: Garment, material: Material, terms: Terms
) -> tuple[dict[str, Float[Array, "*poses"]], Float[Array, "verts 3 *poses"]]:
    """Return membrane and bending of any number of poses at once: their energies as in `energies`, in J, and the gradient in N.

    The elements are differentiated by themselves and their forces gathered at the vertices, so that nothing is scattered; with
    poses beside each other (verts, 3, poses) every corner is one run of memory.
    """
    mesh = garment.mesh
    parts, gradient = {}, jnp.zeros_like(x)
    face = corners(x, mesh.faces) if terms.bending or terms.membrane in DENSITIES else []
    on_faces = [[jnp.zeros_like(face[0][0])] * 3] * 3 if face else []
    if terms.membrane is not None:
        with jax.named_scope("membrane"):
            if terms.membrane in DENSITIES:
                density = DENSITIES[terms.membrane]
                energy, pull = jax.vjp(lambda face: per_face(density, face, mesh, *material.membrane), face)
                (on_faces,) = pull(jnp.ones_like(energy))
            else:
                energy, pull = jax.vjp(lambda edge: per_edge(edge, mesh, *material.membrane), corners(x, mesh.edges))
                (on_edges,) = pull(jnp.ones_like(energy))
                gradient = gathered(on_edges, required(mesh.rings, "mesh.rings").edges)
            parts["membrane"] = jnp.sum(energy, axis=0)
    if terms.bending:
        with jax.named_scope("bending"):
            energy, folds = fold_gradient(x, face, mesh, material.bending)
            on_faces = [plus(a, b) for a, b in zip(on_faces, folds, strict=True)]
            parts["bending"] = jnp.sum(energy, axis=0)
    if face:
        gradient = gradient + gathered(on_faces, required(mesh.rings, "mesh.rings").faces)
    return parts, gradient

"""The total energy, equation (10): the one place that knows every term."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ncs_jax.energies.bending import bending
from ncs_jax.energies.contact.between import touched
from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.distance import nearest_distance, plane_distance
from ncs_jax.energies.contact.friction import friction
from ncs_jax.energies.contact.layers import layers
from ncs_jax.energies.contact.pairs import nearby_pairs
from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.contact.self_contact import self_contact
from ncs_jax.energies.contact.smooth import blended_contact, nearby_quadrics
from ncs_jax.energies.contact.surface import Surface, vertex_normals
from ncs_jax.energies.gravity import gravity
from ncs_jax.energies.inertia import inertia, project
from ncs_jax.energies.pinning import pinning
from ncs_jax.energies.terms import MEMBRANES, Garment, Material, OwnTerm, StepInputs, Terms
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.mesh import Mesh
from ncs_jax.geometry.skinning import unpose

__all__ = ["body_collision", "contact_force", "distances", "energy_terms", "total"]


def distances(
    x: Float[Array, "points 3 *poses"],
    body: Float[Array, "body 3 *poses"],
    surface: Surface,
    terms: Terms,
    normals: Float[Array, "body 3 *poses"] | None = None,
) -> Float[Array, "points *poses"]:
    """Return the signed distance to the posed body in m by the scene's query; of several poses at once by "plane" alone.

    `x`: all that the surface groups, `points.with_points` of the vertices. `normals`: of the body's vertices, where they are
    known; "plane" works them out otherwise.
    """
    if terms.collision == "triangle":
        return nearest_distance(x, body, surface, exact=terms.exact)
    if terms.collision == "smooth":
        return blended_contact(x, nearby_quadrics(x, body, surface), surface, 0.0).distance
    index = touched(x, body, surface, exact=terms.exact)
    return plane_distance(x, body, vertex_normals(body, surface) if normals is None else normals, index)


def body_collision(x, body, surface: Surface, terms: Terms, material: Material, normals=None) -> Float[Array, "*poses"]:
    """Return the energy of collision with the body (12) in J, by the scene's query; x (verts, 3, *poses), m."""
    if surface.points is not None:  # worked out once, and not again by each of what reads it
        x = lax.optimization_barrier(with_points(x, surface.points))
    if terms.collision == "smooth":
        near = nearby_quadrics(x, body, surface)
        return material.collision * jnp.sum(blended_contact(x, near, surface, material.thickness).shortfall)
    return collision(distances(x, body, surface, terms, normals), material.thickness, material.collision)


def contact_force(
    x: Float[Array, "verts 3"],
    body: Float[Array, "body 3"],
    surface: Surface,
    terms: Terms,
    material: Material,
    normals: Float[Array, "body 3"] | None = None,
) -> Float[Array, "verts 3"]:
    """Return how the body's contact resists: the derivative of `body_collision` in N, towards the body."""
    return jax.grad(body_collision)(x, body, surface, terms, material, normals)


def _self_contact(x, garment: Garment, material: Material):
    thickness = required(material.self_thickness, "material.self_thickness")
    pairs = nearby_pairs(x, garment.mesh, required(garment.groups, "garment.groups"), thickness)
    value = self_contact(x, pairs, thickness, required(material.self_contact, "material.self_contact"))
    return jnp.where(pairs.overflow, jnp.nan, value)


def _counted(energy, moving):
    """An energy that only a pose with a past has."""
    return energy if moving is None else energy * moving


def _friction(x, step: StepInputs, material: Material):
    advected = required(step.advected, "step.advected")
    pressed = required(step.lagged_normal_force, "step.lagged_normal_force")
    return _counted(friction(x, advected, pressed, material.friction, step.dt), step.moving)


def _pinning(x, garment: Garment, step: StepInputs, material: Material):
    pins = garment.pins
    unposed = unpose(required(step.vertex_transforms, "step.vertex_transforms")[pins], x[pins])
    return pinning(unposed, garment.mesh.rest[pins], material.pinning)


def _inertia(x, step: StepInputs, mass, *, through_time: bool):
    target = project(required(step.previous, "step.previous"), required(step.before, "step.before"))
    target = target if through_time else lax.stop_gradient(target)
    return _counted(inertia(x, target, mass, step.dt), step.moving)


def _mesh_of(x, mesh: Mesh) -> Mesh:
    """Return the mesh of positions, after a check that they are of it."""
    if x.shape[:2] != mesh.rest.shape:
        what, mend = f"positions {mesh.rest.shape} or ({len(mesh.rest)}, 3, poses) expected", "use jax.vmap over a leading axis"
        raise InputError(what, field="x", value=f"shape {x.shape}", mend=mend)
    return mesh


def energy_terms(
    x: Float[Array, "verts 3 *poses"],
    garment: Garment,
    material: Material,
    step: StepInputs,
    terms: Terms,
    surface: Surface | None = None,
) -> dict[str, Float[Array, "*poses"]]:
    """Return every term of the total energy (10) by name, in J.

        L = membrane + bending + collision + friction + gravity + pinning + own terms - f . x + inertia + self-contact + layers

    Args:
        x: (verts, 3) positions in m; (verts, 3, *poses) for membrane, bending, gravity, inertia and contact by "plane".
        garment, material: what is constant. step: what this step brings, from `scene.step_inputs`.
        terms: which terms exist. surface: the touchable body, where there is collision.

    Self-contact is NaN where more pairs are near each other than its lists hold: an energy without some of them would be wrong.
    The target of inertia is a constant to the derivative: forces then balance mass times acceleration, as in implicit Euler;
    but for `through_time`. `elements.energies_and_gradient` is the fast path, equal to this one for every combination of terms.
    Source: slides, equation (10).
    """
    mesh, parts = _mesh_of(x, garment.mesh), {}
    mass = material.density * mesh.vertex_area
    if terms.membrane is not None:
        with jax.named_scope("membrane"):
            parts["membrane"] = MEMBRANES[terms.membrane][0](x, mesh, *material.membrane)
    if terms.bending:
        with jax.named_scope("bending"):
            parts["bending"] = bending(x, mesh, material.bending)
    if terms.collision is not None:
        with jax.named_scope("collision"):
            body = required(step.body, "step.body"), required(surface, "surface")
            parts["collision"] = body_collision(x, *body, terms, material, step.normals)
    if terms.friction:
        with jax.named_scope("friction"):
            parts["friction"] = _friction(x, step, material)
    if terms.gravity:
        with jax.named_scope("gravity"):
            parts["gravity"] = gravity(x, mass, material.gravity)
    if terms.pinning:
        with jax.named_scope("pinning"):
            parts["pinning"] = _pinning(x, garment, step, material)
    for term in terms.own:
        with jax.named_scope(term.__name__):
            parts[term.__name__] = _own_energy(term, x, step)
    if step.force is not None:
        with jax.named_scope("external"):
            parts["external"] = -jnp.sum(step.force * x, axis=(0, 1))
    if terms.inertia:
        with jax.named_scope("inertia"):
            parts["inertia"] = _inertia(x, step, mass, through_time=terms.through_time)
    if terms.self_contact:
        with jax.named_scope("self_contact"):
            parts["self_contact"] = _self_contact(x, garment, material)
    if terms.layers is not None:
        with jax.named_scope("layers"):
            parts["layers"] = layers(x, garment.uppers, material.thickness, material.collision, planes=terms.layers == "plane")
    return parts


def _own_energy(term: OwnTerm, x, step: StepInputs):
    """Return the energy by a term of one's own, J, after a check that it is a scalar."""
    try:
        value = term(x, step)
    except jax.errors.JAXTypeError as fault:  # such as NumPy on what is traced
        reason = str(fault).strip().splitlines()[0]
        raise InputError(
            f"a term of jax.numpy expected, which can be traced: {reason}", field=f"terms: {term.__name__}",
            mend="use jax.numpy in the place of NumPy, and jnp.where in that of if",
        ) from fault  # fmt: skip
    except (TypeError, AttributeError) as fault:
        if step.previous is not None and step.before is not None:
            raise
        raise InputError(
            f"a term expected that does without step.previous and step.before, which are None here: {fault}",
            field=f"terms: {term.__name__}", mend="a swing and PBNS train without a past: network.cell = 'gated' has one",
        ) from fault  # fmt: skip
    if not isinstance(value, int | float | np.generic | np.ndarray | jax.Array) or jnp.shape(value) != ():
        found = type(value).__name__ if value is None or not hasattr(value, "shape") else f"an array of shape {value.shape}"
        raise InputError("a scalar expected, the energy in J", field=f"terms: {term.__name__}", value=found, mend="sum it")
    return value


def total(*arguments, **options) -> Float[Array, ""]:
    """Return the total energy (10) in J: the sum of `energy_terms`, called alike."""
    return sum(energy_terms(*arguments, **options).values(), start=jnp.zeros(()))

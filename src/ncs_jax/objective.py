"""The total energy (10): the one place that knows every term, and the one place that stops a gradient in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies import baraff_witkin as _baraff_witkin
from ncs_jax.energies import neo_hookean as _neo_hookean
from ncs_jax.energies import stvk as _stvk
from ncs_jax.energies.baraff_witkin import baraff_witkin
from ncs_jax.energies.bending import bending, fold_gradient
from ncs_jax.energies.collision import (
    Surface,
    collision,
    nearest_triangle,
    nearest_vertex,
    plane_distance,
    triangle_distance,
    vertex_normals,
)
from ncs_jax.energies.friction import friction
from ncs_jax.energies.gravity import gravity
from ncs_jax.energies.inertia import inertia, project
from ncs_jax.energies.mass_spring import mass_spring, per_edge
from ncs_jax.energies.membrane import per_face
from ncs_jax.energies.neo_hookean import neo_hookean
from ncs_jax.energies.pinning import pinning
from ncs_jax.energies.proximity import Groups, nearby_pairs
from ncs_jax.energies.self_contact import self_contact
from ncs_jax.energies.smooth_contact import blended, nearby_quadrics
from ncs_jax.energies.stvk import stvk
from ncs_jax.kinematics import unpose
from ncs_jax.mesh import Mesh, corners
from ncs_jax.vectors import plus

__all__ = [
    "DENSITIES",
    "MEMBRANES",
    "Frame",
    "Garment",
    "Material",
    "Terms",
    "distances",
    "elastic",
    "energies",
    "pressure",
    "total",
]

MEMBRANES: dict[str, tuple[Callable[..., Array], tuple[str, ...]]] = {
    "stvk": (stvk, ("lam", "mu")),
    "neo_hookean": (neo_hookean, ("lam", "mu")),
    "baraff_witkin": (baraff_witkin, ("stretch", "shear")),
    "mass_spring": (mass_spring, ("stiffness",)),
}

DENSITIES: dict[str, Callable[..., Array]] = {  # energy per rest area of the membranes that are made of faces
    "stvk": _stvk.density,
    "neo_hookean": _neo_hookean.density,
    "baraff_witkin": _baraff_witkin.density,
}


@dataclass(frozen=True)
class Terms:
    """Which terms a scene has. What is not named here is not traced."""

    membrane: str | None = "stvk"
    bending: bool = True
    collision: str | None = "plane"  # "plane", "smooth", "triangle" or None
    exact: bool = True  # exact search; otherwise candidates alone
    friction: bool = False
    gravity: bool = True
    inertia: bool = True
    through_time: bool = False  # inertia's target carries a gradient
    pinning: bool = False
    self_contact: bool = False


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Material:
    """The numbers of the energies, in SI units; any of them may be differentiated or batched."""

    density: Float[Array, ""]  # kg/m^2
    membrane: tuple[Float[Array, ""], ...]  # in the order of MEMBRANES
    bending: Float[Array, ""]  # N m
    collision: Float[Array, ""]  # J/m^2 a vertex
    thickness: Float[Array, ""]  # m
    friction: Float[Array, ""]  # its coefficient
    pinning: Float[Array, ""]  # N/m
    gravity: Float[Array, 3]  # m/s^2
    self_contact: Float[Array, ""] | None = None  # J/m^2 a pair
    self_thickness: Float[Array, ""] | None = None  # m


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Garment:
    """What a garment is to the energies: its mesh, which vertices are pinned, and its groups where there is self-contact."""

    mesh: Mesh
    pins: Int[Array, "pins"]
    groups: Groups | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """What one frame brings to the energies; `None` where no term asks for it."""

    dt: float | Float[Array, ""] = field(default=1 / 30)  # s
    previous: Float[Array, "verts 3 *poses"] | None = None  # x_{t-1}
    before: Float[Array, "verts 3 *poses"] | None = None  # x_{t-2}
    body: Float[Array, "body 3 *poses"] | None = None  # posed
    blended: Float[Array, "verts 3 4"] | None = None  # skinning transforms of the garment
    carried: Float[Array, "verts 3"] | None = None  # where the body alone would carry x_{t-1}, m
    pressed: Float[Array, "verts 3"] | None = None  # `pressure` there, N
    normals: Float[Array, "body 3 *poses"] | None = None  # of the body, where they are known already


def distances(
    x: Float[Array, "verts 3 *poses"],
    body: Float[Array, "body 3 *poses"],
    surface: Surface,
    terms: Terms,
    normals: Float[Array, "body 3 *poses"] | None = None,
) -> Float[Array, "verts *poses"]:
    """Signed distance to the posed body in m by the scene's query; of several poses at once by "plane" alone.

    `normals`: of the body's vertices, where they are known; "plane" works them out otherwise.
    """
    if terms.collision == "triangle":
        index, _ = nearest_triangle(x, body, surface, exact=terms.exact)
        return triangle_distance(x, body, surface, index)
    if terms.collision == "smooth":
        return blended(x, nearby_quadrics(x, body, surface), surface, 0.0).distance
    index, _ = nearest_vertex(x, body, surface, exact=terms.exact)
    return plane_distance(x, body, vertex_normals(body, surface) if normals is None else normals, index)


def _collision(x, body, surface, terms, material, normals=None):
    if terms.collision == "smooth":
        near = nearby_quadrics(x, body, surface)
        return material.collision * jnp.sum(blended(x, near, surface, material.thickness).shortfall)
    return collision(distances(x, body, surface, terms, normals), material.thickness, material.collision)


def pressure(
    x: Float[Array, "verts 3"], body: Float[Array, "body 3"], surface: Surface, terms: Terms, material: Material
) -> Float[Array, "verts 3"]:
    """How the body's contact resists: its energy's derivative in N, towards the body."""
    return jax.grad(_collision)(x, body, surface, terms, material)


def _self_contact(x, garment, material):
    pairs = nearby_pairs(x, garment.mesh, garment.groups, material.self_thickness)
    value = self_contact(x, pairs, material.self_thickness, material.self_contact)
    return jnp.where(pairs.overflow, jnp.nan, value)


def energies(
    x: Float[Array, "verts 3 *poses"],
    garment: Garment,
    material: Material,
    frame: Frame,
    terms: Terms,
    surface: Surface | None = None,
) -> dict[str, Float[Array, "*poses"]]:
    """Every term of the total energy (10) by name, in J.

    Args:
        x: (verts, 3) positions in m; (verts, 3, *poses) for membrane, bending, gravity, inertia and the "plane" collision.
        garment, material: what is constant. frame: what this frame brings.
        terms: which terms exist. surface: the touchable body, where there is collision.

    Self-contact is NaN where more pairs are near each other than its lists hold: an energy without some of them would be wrong.
    The target of inertia is a constant to the derivative: forces then balance mass times acceleration, as in implicit Euler;
    but for `through_time`.
    """
    mesh = garment.mesh
    mass = material.density * mesh.vertex_area
    parts = {}
    if terms.membrane is not None:
        with jax.named_scope("membrane"):
            parts["membrane"] = MEMBRANES[terms.membrane][0](x, mesh, *material.membrane)
    if terms.bending:
        with jax.named_scope("bending"):
            parts["bending"] = bending(x, mesh, material.bending)
    if terms.collision is not None:
        with jax.named_scope("collision"):
            parts["collision"] = _collision(x, frame.body, surface, terms, material, frame.normals)
    if terms.friction:
        with jax.named_scope("friction"):
            parts["friction"] = friction(x, frame.carried, frame.pressed, material.friction, frame.dt)
    if terms.gravity:
        with jax.named_scope("gravity"):
            parts["gravity"] = gravity(x, mass, material.gravity)
    if terms.inertia:
        with jax.named_scope("inertia"):
            target = project(frame.previous, frame.before)
            target = target if terms.through_time else lax.stop_gradient(target)
            parts["inertia"] = inertia(x, target, mass, frame.dt)
    if terms.pinning:
        with jax.named_scope("pinning"):
            pins = garment.pins
            parts["pinning"] = pinning(unpose(frame.blended[pins], x[pins]), mesh.rest[pins], material.pinning)
    if terms.self_contact:
        with jax.named_scope("self_contact"):
            parts["self_contact"] = _self_contact(x, garment, material)
    return parts


def elastic(
    x: Float[Array, "verts 3 *poses"], garment: Garment, material: Material, terms: Terms
) -> tuple[dict[str, Float[Array, "*poses"]], Float[Array, "verts 3 *poses"]]:
    """Membrane and bending of any number of poses at once: their energies as in `energies`, in J, and the gradient in N.

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
                gradient = _gathered(on_edges, mesh.rings.edges)
            parts["membrane"] = jnp.sum(energy, axis=0)
    if terms.bending:
        with jax.named_scope("bending"):
            energy, folds = fold_gradient(x, face, mesh, material.bending)
            on_faces = [plus(a, b) for a, b in zip(on_faces, folds, strict=True)]
            parts["bending"] = jnp.sum(energy, axis=0)
    if face:
        gradient = gradient + _gathered(on_faces, mesh.rings.faces)
    return parts, gradient


def _gathered(forces, ring):
    """Sum at every vertex (verts, 3, *poses) of the forces on the corners around it."""
    forces = jnp.stack([jnp.stack(corner, axis=1) for corner in forces])
    forces = forces.reshape(-1, *forces.shape[2:])
    start = jnp.zeros((len(ring), *forces.shape[1:]), forces.dtype)
    return sum((jnp.take(forces, at, axis=0, mode="fill", fill_value=0) for at in ring.T), start=start)


def total(*arguments, **options) -> Float[Array, ""]:
    """Total energy (10) in J: the sum of `energies`, called alike."""
    return sum(energies(*arguments, **options).values(), start=jnp.zeros(()))

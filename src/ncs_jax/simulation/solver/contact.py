"""Contact with the body as a Newton step needs it: energy, derivative and blocks from one look at the body."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ncs_jax.energies.contact.collision import collision
from ncs_jax.energies.contact.points import on_vertices, with_points
from ncs_jax.energies.contact.smooth import Quadrics, contact_within_reach, nearby_quadrics
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.energies.terms import Material, StepInputs, Terms
from ncs_jax.energies.total import distances
from ncs_jax.errors import required

__all__ = ["Contact", "evaluate_contact"]


class Contact(NamedTuple):
    """How a garment touches the body. The blocks are those of Gauss and Newton: positive semi-definite."""

    energy: Float[Array, ""]  # J
    gradient: Float[Array, "verts 3"]  # N
    blocks: Float[Array, "points 3 3"]  # N/m, of vertices, then of the points between them
    distance: Float[Array, "points"]  # m, of both; what it is at least where smooth contact has not looked


def evaluate_contact(
    x: Float[Array, "verts 3"],
    step: StepInputs,
    surface: Surface,
    material: Material,
    terms: Terms,
    near: Quadrics | None = None,
    only: Bool[Array, "blocks"] | None = None,
) -> Contact:
    """Return the contact of all vertices and of the points between them, each of which touches the body by itself.

    Args:
        x: positions in m. step: where the body is. near: the body near the garment, where contact is smooth and that is known.
        only: of smooth contact, the groups of cloth that are looked at; the others touch nothing.
    """
    stiffness, points, body = material.collision, surface.points, required(step.body, "step.body")
    x = with_points(x, points)
    if terms.collision != "smooth":
        distance, back = jax.vjp(lambda x: distances(x, body, surface, terms, step.normals), x)
        (normal,) = back(jnp.ones_like(distance))
        energy, slope = jax.value_and_grad(collision)(distance, material.thickness, stiffness)
        pushing = jnp.where(distance < material.thickness, 2 * stiffness, 0)
        blocks = pushing[:, None, None] * normal[:, :, None] * normal[:, None, :]
        return Contact(energy, on_vertices(slope[:, None] * normal, points), blocks, distance)
    near = nearby_quadrics(x, body, surface) if near is None else near

    found = contact_within_reach(x, near, surface, material.thickness, only)
    gradient = on_vertices(stiffness * found.slope, points)
    return Contact(stiffness * jnp.sum(found.shortfall), gradient, 2 * stiffness * found.directions, found.distance)

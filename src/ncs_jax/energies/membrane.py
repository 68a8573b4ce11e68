"""What the membranes that are made of faces share: the deformation gradient of a triangle in its material axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from jaxtyping import Array, Float

from ncs_jax.geometry.mesh import Mesh, corners, spread
from ncs_jax.geometry.soa_vectors import Vector, minus, plus, times

__all__ = ["Columns", "columns", "deformation", "per_face"]

Columns = Sequence[Vector]  # w_u and w_v


def columns(face: Sequence[Vector], mesh: Mesh) -> Columns:
    """Return the images w_u, w_v of the unit material axes of every face: the two columns of F = dx/du (3x2), dimensionless."""
    e1, e2 = minus(face[1], face[0]), minus(face[2], face[0])

    def part(k, i, edge):
        return times(spread(mesh.face_axes[:, k, i], edge[0]), edge)

    return [plus(part(0, i, e1), part(1, i, e2)) for i in (0, 1)]


def deformation(x: Float[Array, "verts 3 *poses"], mesh: Mesh) -> Columns:
    """Return the columns of every face's deformation gradient at x, in m."""
    return columns(corners(x, mesh.faces), mesh)


def per_face(density: Callable[..., Array], face: Sequence[Vector], mesh: Mesh, *numbers) -> Float[Array, "faces *poses"]:
    """Return the energy of every face in J: its rest area times the density; nothing where that area is zero."""
    energy = density(columns(face, mesh), *numbers)
    return spread(mesh.face_area, energy) * energy

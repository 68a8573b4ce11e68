"""Membrane and bending of many poses at once, by elements: the fast path of `total`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ncs_jax.energies.bending import fold_gradient
from ncs_jax.energies.mass_spring import per_edge
from ncs_jax.energies.membrane import per_face
from ncs_jax.energies.terms import DENSITIES, Garment, Material, Terms
from ncs_jax.geometry.mesh import corners
from ncs_jax.geometry.soa_vectors import plus

__all__ = ["elastic"]


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

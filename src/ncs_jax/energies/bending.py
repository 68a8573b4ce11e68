"""Bending of hinges by their signed dihedral angle, equation (11)."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.errors import required
from ncs_jax.geometry.mesh import Mesh, corners, dihedral, spread
from ncs_jax.geometry.numerics import arctan2, least_length
from ncs_jax.geometry.soa_vectors import Vector, cross, dot, length, minus, times

__all__ = ["angles", "bending", "fold_gradient", "hinge_weight", "per_hinge"]


def _wrapped(angle, mesh):
    change = angle - spread(mesh.hinge_angle, angle)
    return change - 2 * np.pi * jnp.round(change / (2 * np.pi))


def hinge_weight(mesh: Mesh, stiffness: Float[Array, ""] | float = 1.0) -> Float[Array, "hinges"]:
    """Return k l^2 / (8 (A0 + A1)) of every hinge, J; zero beside a face of zero area."""
    solid = jnp.all(mesh.hinge_area > 0, axis=-1)
    areas = jnp.sum(jnp.where(mesh.hinge_area > 0, mesh.hinge_area, 1), axis=-1)
    return jnp.where(solid, stiffness * mesh.hinge_length**2 / (8 * areas), 0)


def angles(hinge: Sequence[Vector], mesh: Mesh) -> Float[Array, "hinges *poses"]:
    """Return how far every hinge is folded from its rest, phi - phi_rest wrapped to (-pi, pi]."""
    areas = [spread(jnp.where(a > 0, a, 1), hinge[0][0]) for a in (mesh.hinge_area[:, 0], mesh.hinge_area[:, 1])]
    return _wrapped(dihedral(hinge, areas), mesh)


def per_hinge(hinge: Sequence[Vector], mesh: Mesh, stiffness) -> Float[Array, "hinges *poses"]:
    """Return the energy of every hinge, J; none beside a face of zero area."""
    change = angles(hinge, mesh)
    return stiffness * spread(hinge_weight(mesh), change) * change * change


def fold_gradient(
    x: Float[Array, "verts 3 *poses"], face: Sequence[Vector], mesh: Mesh, stiffness
) -> tuple[Float[Array, "hinges *poses"], list[Vector]]:
    """Return the energy of every hinge, J, and its gradient face by face, N: a vector (faces, *poses) for each corner.

        dE/dx_k = q_k n/|n|^2,  q_k = -s_k + (1 - t_i) s_i + t_j s_j,  s_k = dE/dphi_k |e_k| / (2 A),  i = k - 1, j = k + 1

    with phi_k the fold over the edge e_k opposite corner k, t_k where the height from there stands on it, 0 at corner k + 1,
    and the normal n in units of the rest area: a face takes the bending of its three edges as one force along its normal, see
    `mesh.dihedral`. `face` are the corners of the faces at x.
    """
    area = spread(jnp.where(mesh.face_area > 0, mesh.face_area, 1), face[0][0])
    e = [minus(face[(k + 2) % 3], face[(k + 1) % 3]) for k in range(3)]
    normal = times(0.5 / area, cross(e[2], minus(face[2], face[0])))

    rings, around = required(mesh.rings, "mesh.rings"), jnp.stack(normal, axis=1)
    n0, second = ([p[:, i] for i in range(3)] for p in (around[rings.sides[:, k]] for k in (0, 1)))
    n1 = times(spread(rings.behind, second[0]), second)
    a, b = corners(x, mesh.hinges[:, :2])
    edge = minus(b, a)
    long = length(edge)
    sine = dot(cross(n0, n1), edge) / jnp.where(long > 0, long, 1)
    change = _wrapped(arctan2(sine, dot(n0, n1)), mesh)
    weight = stiffness * spread(hinge_weight(mesh), change)

    moment = jnp.concatenate([2 * weight * change, jnp.zeros_like(change[:1])])
    squares = [dot(v, v) for v in e]
    s, t = [], []
    for k in range(3):
        turn = spread(rings.turned[:, k], area)
        s.append(turn * moment[rings.folds[:, k]] * length(e[k]) * 0.5 / area)
        t.append(-dot(e[(k + 2) % 3], e[k]) / jnp.where(squares[k] > 0, squares[k], 1))
    size = dot(normal, normal)
    solid = size > least_length(size.dtype)
    along = times(jnp.where(solid, 1 / jnp.where(solid, size, 1), 0), normal)
    q = [(1 - t[k - 1]) * s[k - 1] + t[(k + 1) % 3] * s[(k + 1) % 3] - s[k] for k in range(3)]
    return weight * change * change, [times(q[k], along) for k in range(3)]


def bending(x: Float[Array, "verts 3 *poses"], mesh: Mesh, stiffness: Float[Array, ""] | float) -> Float[Array, "*poses"]:
    """Return the bending energy in J.

        E = sum_hinges k l^2 / (8 (A0 + A1)) (phi - phi_rest)^2,  the difference wrapped to (-pi, pi]

    Args:
        x: (verts, 3, *poses) positions in m. mesh: rest state. stiffness: k in N m.

    Source: slides, equation (11); Grinspun et al. 2003. Wrapping is where the fold passes through itself: one-sided there.
    """
    return jnp.sum(per_hinge(corners(x, mesh.hinges), mesh, stiffness), axis=0)

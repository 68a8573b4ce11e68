"""Second derivatives of the total energy, made positive semi-definite element by element (Teran et al. 2005).

The matrix is one 3x3 block a vertex and one a pair of vertices that share a face or a hinge, as `cholesky` takes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ncs_jax.energies.bending import hinge_weight
from ncs_jax.energies.contact.friction import SLIP, slipping
from ncs_jax.energies.contact.points import ContactPoints
from ncs_jax.energies.membrane import deformation
from ncs_jax.energies.terms import DENSITIES, Garment, Material, StepInputs, Terms
from ncs_jax.errors import required
from ncs_jax.geometry.mesh import Mesh, corners, dihedral
from ncs_jax.geometry.numerics import norm, normalize, positive_part

__all__ = ["Couplings", "couplings_from", "multiply", "stiffness"]

FACE = ((0, 1), (1, 2), (2, 0))
HINGE = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Couplings:
    """Which pairs of vertices share an element, and where every element's blocks go.

    Block k couples pairs[k, 0] (rows) with pairs[k, 1] (columns); an element that holds them the other way round adds its
    block transposed.
    """

    pairs: Int[Array, "pairs 2"]
    face_pairs: Int[Array, "3 faces"]
    face_flips: Bool[Array, "3 faces"]
    hinge_pairs: Int[Array, "6 hinges"]
    hinge_flips: Bool[Array, "6 hinges"]
    edge_pairs: Int[Array, "edges"]  # its block is symmetric: it has no flips
    points: ContactPoints | None = None  # of contact, between the vertices
    point_pairs: Int[Array, "3 points"] | None = None  # in the order of `FACE`; symmetric too


def couplings_from(mesh: Mesh, points: ContactPoints | None = None) -> Couplings:
    """Return all pairs of vertices that a face or a hinge couples; `points` of contact couple no others."""
    faces, hinges = np.asarray(mesh.faces), np.asarray(mesh.hinges)
    of_faces = np.stack([faces[:, p] for p in FACE])
    of_hinges = np.stack([hinges[:, p] for p in HINGE])
    every = np.sort(np.concatenate([of_faces.reshape(-1, 2), of_hinges.reshape(-1, 2)]), axis=1)
    pairs = np.unique(every, axis=0)
    size = [len(mesh.rest), 1]

    def place(p):
        index = np.searchsorted(pairs @ size, np.sort(p, axis=-1) @ size)
        return jax.device_put((index.astype(np.int32), p[..., 0] > p[..., 1]))

    edges, _ = place(np.asarray(mesh.edges))
    found = Couplings(jax.device_put(pairs.astype(np.int32)), *place(of_faces), *place(of_hinges), edge_pairs=edges)
    if points is None:
        return found
    corners = np.asarray(points.corners)
    return replace(found, points=points, point_pairs=place(np.stack([corners[:, p] for p in FACE]))[0])


def _membrane(x, mesh: Mesh, density, numbers):
    """Blocks (6, faces, 3, 3) of the faces' Hessians, each made positive semi-definite: of the corners, then of `FACE`.

    A density depends on lengths and angles only, so seen in the face's own frame (t, s, n) its Hessian has two parts: that of
    the material within the plane, 4x4, and the stress, 2x2, which acts alike on all three axes. Each loses its negative part.
    """
    w = jnp.stack([jnp.stack(column, axis=-1) for column in deformation(x, mesh)])
    t, s = _plane(w)
    zero = jnp.zeros_like(w[..., 0])
    flat = jnp.stack([jnp.sum(w * t[None], axis=-1), jnp.sum(w * s[None], axis=-1), zero], axis=1)
    _, along = jax.linearize(jax.grad(lambda w: jnp.sum(density([[*w[0]], [*w[1]]], *numbers))), flat)

    # Every column is one row of a batch: the program has the derivative once. (j, b, i, a, faces)
    unit = jnp.eye(6, dtype=x.dtype).reshape(6, 2, 3, 1)
    columns = jax.vmap(along)(jnp.broadcast_to(unit, (6, *flat.shape))).reshape(2, 3, *flat.shape)
    stress = columns[:, 2, :, 2].swapaxes(0, 1)
    inner = columns[:, :2, :, :2].transpose(2, 3, 0, 1, 4)  # (i, a, j, b, faces)
    inner = inner - stress[:, None, :, None] * jnp.eye(2, dtype=x.dtype)[None, :, None, :, None]
    material = positive_part(inner.reshape(4, 4, -1)).reshape(2, 2, 2, 2, -1)
    pull = positive_part(stress)
    area = mesh.face_area
    axes = jnp.stack([t, s])
    eye = jnp.eye(3, dtype=x.dtype)
    shape = jnp.stack([-mesh.face_axes[:, 0] - mesh.face_axes[:, 1], mesh.face_axes[:, 0], mesh.face_axes[:, 1]])
    k, other = np.array([(corner, corner) for corner in range(3)] + [*FACE]).T
    # w_i = sum_k shape_ki x_k
    weight = {(i, j): area[None] * shape[k, :, i] * shape[other, :, j] for i in range(2) for j in range(2)}
    even = sum((weight[i, j] * pull[i, j][None] for i, j in weight), start=jnp.zeros_like(weight[0, 0]))
    blocks = even[..., None, None] * eye[None, None]
    for a in range(2):
        for b in range(2):
            within = sum((weight[i, j] * material[i, a, j, b][None] for i, j in weight), start=jnp.zeros_like(even))
            blocks = blocks + within[..., None, None] * (axes[a, :, :, None] * axes[b, :, None, :])[None]
    return blocks


def _plane(w):
    """Two orthogonal unit vectors (faces, 3) in the plane of every face; any two where it is collapsed."""
    longer = jnp.sum(w[0] * w[0], axis=-1) >= jnp.sum(w[1] * w[1], axis=-1)
    t = normalize(jnp.where(longer[:, None], w[0], w[1]))
    t = jnp.where(jnp.any(t != 0, axis=-1, keepdims=True), t, jnp.eye(3, dtype=w.dtype)[0])
    n = normalize(jnp.cross(w[0], w[1]))
    least = jnp.eye(3, dtype=w.dtype)[jnp.argmin(jnp.abs(t), axis=-1)]
    n = jnp.where(jnp.any(n != 0, axis=-1, keepdims=True), n, normalize(jnp.cross(t, least)))
    return t, normalize(jnp.cross(n, t))


def _springs(x, mesh: Mesh, stiffness):
    """The block (edges, 3, 3) of every spring, its pull across taken as zero where it is compressed."""
    gap = x[mesh.edges[:, 1]] - x[mesh.edges[:, 0]]
    length = norm(gap)
    safe = jnp.where(length > 0, length, 1)
    along = gap / safe[:, None]
    across = jnp.where(length > 0, jnp.maximum(1 - mesh.edge_length / safe, 0), 0)
    outer = along[:, :, None] * along[:, None, :]
    eye = jnp.eye(3, dtype=x.dtype)
    return (stiffness * mesh.edge_weight)[:, None, None] * (across[:, None, None] * (eye[None] - outer) + outer)


def _bending(x, mesh: Mesh, stiffness):
    """Gradients of the angles (hinges, 4, 3) and weights (hinges,): the Gauss-Newton part, which is what is definite."""
    areas = jnp.where(mesh.hinge_area > 0, mesh.hinge_area, 1)
    gradient = jax.grad(lambda hinge: jnp.sum(dihedral(hinge, [areas[:, 0], areas[:, 1]])))(corners(x, mesh.hinges))
    gradient = jnp.stack([jnp.stack(corner, axis=-1) for corner in gradient], axis=1)
    return gradient, hinge_weight(mesh, 2 * stiffness)


def _friction(x, step: StepInputs, coefficient):
    """The blocks (verts, 3, 3) of friction, which is convex."""
    pressed = required(step.lagged_normal_force, "step.lagged_normal_force")
    along, normal = slipping(x, required(step.advected, "step.advected"), pressed)
    length, slip = norm(along), SLIP * step.dt
    within = jnp.eye(3, dtype=x.dtype)[None] - normal[:, :, None] * normal[:, None, :]
    way = jnp.where((length < slip)[:, None], 0, normalize(along))
    push = coefficient * norm(pressed) / jnp.maximum(length, slip)
    push = push if step.moving is None else step.moving * push
    return push[:, None, None] * (within - way[:, :, None] * way[:, None, :])


def _own(x, step: StepInputs, terms: Terms):
    """Blocks (verts, 3, 3) of own terms, made positive semi-definite: their derivative when the cloth moves as a whole.

    It is exact for a term that looks at vertices one by one, as an attachment spring. A term that couples vertices is known by
    the line search alone.
    """
    gradient = jax.grad(lambda x: sum((term(x, step) for term in terms.own), start=jnp.zeros((), x.dtype)))

    axes = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype)[:, None], (3, *x.shape))
    block = lax.map(lambda way: jax.jvp(gradient, (x,), (way,))[1], axes)  # (columns, verts, rows), one after the other
    return jnp.transpose(positive_part((block + jnp.swapaxes(block, 0, 2)).transpose(0, 2, 1) / 2), (2, 0, 1))


def _with_contact(diagonal, off, couplings: Couplings, contact):
    """The blocks with those of contact (points, 3, 3), a point's shared out to its corners k and l as w_k w_l."""
    points, verts = couplings.points, len(diagonal)
    diagonal = diagonal + contact[:verts]
    if points is None:
        return diagonal, off
    w, between = points.weights.astype(contact.dtype), contact[verts:]
    both = jnp.stack([w[:, i] * w[:, j] for i, j in FACE])
    diagonal = diagonal.at[points.corners].add((w * w)[..., None, None] * between[:, None])
    return diagonal, off.at[couplings.point_pairs].add(both[..., None, None] * between[None])


def stiffness(
    x: Float[Array, "verts 3"],
    couplings: Couplings,
    garment: Garment,
    material: Material,
    step: StepInputs,
    terms: Terms,
    contact: Float[Array, "points 3 3"] | None = None,
) -> tuple[Float[Array, "verts 3 3"], Float[Array, "pairs 3 3"]]:
    """Return blocks of a positive semi-definite Hessian of the total energy without inertia, N/m; arguments as of `energies`.

    contact: the blocks of collision, where there is any, from `contact.evaluate_contact`.

    The membrane's element Hessians are projected; springs lose their negative part in closed form; bending
    enters by the squares of its first derivatives (Gauss-Newton), exact where the angle is at its rest value.
    """
    mesh = garment.mesh
    diagonal = jnp.zeros((*x.shape, 3), x.dtype)
    off = jnp.zeros((couplings.pairs.shape[0], 3, 3), x.dtype)

    def turned(block, flip):
        return jnp.where(flip[:, None, None], jnp.swapaxes(block, -1, -2), block)

    if terms.membrane == "mass_spring":
        block = _springs(x, mesh, *material.membrane)
        diagonal = diagonal.at[mesh.edges].add(block[:, None])
        off = off.at[couplings.edge_pairs].add(-block)
    elif terms.membrane is not None:
        blocks = _membrane(x, mesh, DENSITIES[terms.membrane], material.membrane)
        diagonal = diagonal.at[mesh.faces.T].add(blocks[:3])
        parts = jnp.stack([turned(block, flip) for block, flip in zip(blocks[3:], couplings.face_flips, strict=True)])
        off = off.at[couplings.face_pairs].add(parts)
    if terms.bending:
        gradient, weight = _bending(x, mesh, material.bending)
        scaled = gradient * weight[:, None, None]
        diagonal = diagonal.at[mesh.hinges].add(scaled[..., :, None] * gradient[..., None, :])
        sides = [scaled[:, k, :, None] * gradient[:, other, None, :] for k, other in HINGE]
        off = off.at[couplings.hinge_pairs].add(jnp.stack([turned(p, couplings.hinge_flips[i]) for i, p in enumerate(sides)]))
    if contact is not None:
        diagonal, off = _with_contact(diagonal, off, couplings, contact)
    if terms.friction:
        diagonal = diagonal + _friction(x, step, material.friction)
    if terms.own:
        diagonal = diagonal + _own(x, step, terms)
    if terms.pinning:
        pins = garment.pins
        linear = required(step.vertex_transforms, "step.vertex_transforms")[pins][..., :3]
        inverse = jnp.linalg.inv(linear)
        square = jnp.einsum("pia,pib->pab", inverse, inverse, precision="highest")
        diagonal = diagonal.at[pins].add(2 * material.pinning * square)
    return diagonal, off


def multiply(
    couplings: Couplings,
    diagonal: Float[Array, "verts 3 3"],
    off: Float[Array, "pairs 3 3"],
    p: Float[Array, "verts 3"],
) -> Float[Array, "verts 3"]:
    """Return the matrix times a field of vectors."""
    i, j = couplings.pairs.T
    result = jnp.sum(diagonal * p[:, None, :], axis=-1)
    result = result.at[i].add(jnp.sum(off * p[j][:, None, :], axis=-1))
    return result.at[j].add(jnp.sum(off * p[i][:, :, None], axis=-2))

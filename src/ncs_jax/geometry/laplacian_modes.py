"""Smooth modes of a garment: the large, soft movements that a decoder should find easy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

__all__ = ["laplacian", "modal_basis"]


def laplacian(vertices: np.ndarray, faces: np.ndarray):
    """Return the cotangent Laplacian of a mesh, a sparse (verts, verts) matrix: x^T L x = sum_f A |grad x|^2."""
    from scipy.sparse import coo_matrix

    rows, columns, values = [], [], []
    for k in range(3):
        i, j, o = faces[:, (k + 1) % 3], faces[:, (k + 2) % 3], faces[:, k]
        a, b = vertices[i] - vertices[o], vertices[j] - vertices[o]
        sine = np.linalg.norm(np.cross(a, b), axis=1)
        weight = np.where(sine > 0, np.sum(a * b, axis=1) / np.where(sine > 0, 2 * sine, 1), 0)
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        values += [-weight, -weight, weight, weight]
    shape = (len(vertices), len(vertices))
    return coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape).tocsc()


def modal_basis(
    vertices: np.ndarray,
    faces: np.ndarray,
    area: np.ndarray,
    count: int,
    amplitude: float = 0.02,
    held: np.ndarray | Sequence[int] = (),
) -> Float[np.ndarray, "verts modes"]:
    """Return the `count` smoothest modes of a garment, scaled so that all cost about the same membrane energy.

        b_i = amplitude u_i / sqrt(1 + lambda_i / lambda_ref),  L u_i = lambda_i M u_i,  mean square of u_i = 1 over the area

    Args:
        vertices: (verts, 3) rest positions in m. faces: (faces, 3). area: (verts,) lumped areas in m^2.
        amplitude: displacement of the smoothest modes per unit of coefficient, m. lambda_ref is (2 pi / garment size)^2.
        held: numbers of vertices that do not move, such as pins: the modes are zero there.

    Adam takes steps of one size in all coefficients. With this scale its noise has the same energy in every mode: in drape and
    swing, which are soft and global, as in strain, which is stiff and local.
    """
    from scipy.sparse import diags
    from scipy.sparse.linalg import eigsh

    vertices, area = np.asarray(vertices, np.float64), np.asarray(area, np.float64)
    mass = np.maximum(area, 1e-3 * area.mean())  # a vertex without faces has no area of its own
    free = np.setdiff1d(np.arange(len(vertices)), np.asarray(held, int))
    matrix, mass = laplacian(vertices, np.asarray(faces))[free][:, free], mass[free]
    reference = (2 * np.pi) ** 2 / max(float(np.sum(np.ptp(vertices, axis=0) ** 2)), 1e-12)
    count = max(min(count, len(free) - 1), 0)
    basis = np.zeros((len(vertices), count), np.float32)
    if not count:
        return basis
    if len(free) <= 4 * count + 64:
        from scipy.linalg import eigh

        values, vectors = eigh(matrix.toarray(), np.diag(mass), subset_by_index=(0, count - 1))
    else:  # a fixed start vector: ARPACK's own is random
        start = np.random.default_rng(0).normal(size=len(free))
        values, vectors = eigsh(matrix, count, diags(mass).tocsc(), sigma=-reference / 10, which="LM", v0=start)
    vectors *= np.where(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)] < 0, -1, 1)
    scale = amplitude * np.sqrt(area.sum()) / np.sqrt(1 + np.maximum(values, 0) / reference)
    basis[free] = vectors * scale
    return basis

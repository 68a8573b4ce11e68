"""Small meshes: vertices (verts, 3) in m and faces (faces, 3), int32, facing outward."""

from __future__ import annotations

import numpy as np


def sheet(rows: int = 4, columns: int = 5, spacing: float = 0.01):
    """A flat rectangle in the plane z = 0, its diagonals alternating."""
    y, x = np.mgrid[:rows, :columns] * spacing
    faces = []
    for i in range(rows - 1):
        for j in range(columns - 1):
            a, b, c, d = (
                i * columns + j,
                i * columns + j + 1,
                (i + 1) * columns + j,
                (i + 1) * columns + j + 1,
            )
            faces += [[a, b, d], [a, d, c]] if (i + j) % 2 else [[a, b, c], [b, d, c]]
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), np.array(faces, np.int32)


def equilateral(rows: int = 5, columns: int = 5, spacing: float = 0.01):
    """A flat patch of equilateral triangles in the plane z = 0."""
    j, i = np.mgrid[:rows, :columns]
    vertices = np.stack([(i + j / 2) * spacing, j * spacing * np.sqrt(3) / 2, 0.0 * i], axis=-1).reshape(-1, 3)
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    b, c, d = a + 1, a + columns, a + columns + 1
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.int32)


def tube(around: int = 8, rings: int = 4, radius: float = 0.03, height: float = 0.05):
    """An open cylinder about the y axis."""
    angle = np.arange(around) * 2 * np.pi / around
    y = np.linspace(0, height, rings)[:, None] + 0 * angle
    vertices = np.stack([radius * np.sin(angle) + 0 * y, y, radius * np.cos(angle) + 0 * y], axis=-1).reshape(-1, 3)
    faces = []
    for i in range(rings - 1):
        for j in range(around):
            a, b = i * around + j, i * around + (j + 1) % around
            faces += [[a, b, a + around], [b, b + around, a + around]]
    return vertices, np.array(faces, np.int32)


def ball(divisions: int = 2, radius: float = 0.1):
    """A subdivided icosahedron, closed: 12, 42, 162, ... vertices."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=divisions, radius=radius)
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int32)


def bracket(size: float = 0.1):
    """A closed L-shaped block: one concave edge at x = y = size, along z from 0 to size; arms twice as long."""
    outline = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]) * size
    vertices = np.concatenate([np.pad(outline, ((0, 0), (0, 1))), np.pad(outline, ((0, 0), (0, 1)), constant_values=size)])
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    side = [[[i, j, j + 6], [i, j + 6, i + 6]] for i, j in ((k, (k + 1) % 6) for k in range(6))]
    vertices[:, 2] = np.repeat([0, size], 6)
    return vertices, np.concatenate([cap[:, ::-1], cap + 6, np.reshape(side, (-1, 3))]).astype(np.int32)


def rotation(axis, angle: float) -> np.ndarray:
    """Matrix of a turn by `angle` (rad) about `axis`."""
    from scipy.spatial.transform import Rotation

    axis = np.asarray(axis, np.float64)
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()

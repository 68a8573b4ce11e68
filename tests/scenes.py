"""Scenes small enough for a test: a strip of cloth on a post of two joints, or on no body at all."""

import numpy as np


def grid(rows=6, columns=5, spacing=0.05, origin=(0.0, 0.3, 0.09)):
    """A flat sheet facing +z: vertices (rows * columns, 3) and faces."""
    y, x = np.mgrid[:rows, :columns] * spacing
    vertices = np.stack([x - x.mean(), y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + origin
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + columns, corner + columns + 1
    return vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)


def post(height=1.0, radius=0.08, rings=16, around=12):
    """A closed post of two joints, the second halfway up: a body file's arrays."""
    angle = 2 * np.pi * np.arange(around) / around
    ring = np.stack([radius * np.cos(angle), np.zeros(around), radius * np.sin(angle)], axis=1)
    levels = np.linspace(0, height, rings)
    vertices = np.concatenate([*(ring + [0, y, 0] for y in levels), [[0, 0, 0], [0, height, 0]]])
    i, j = np.meshgrid(np.arange(rings - 1) * around, np.arange(around), indexing="ij")
    a, b = (i + j).ravel(), (i + (j + 1) % around).ravel()
    side = np.concatenate([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1)])
    this, after, top = np.arange(around), (np.arange(around) + 1) % around, (rings - 1) * around
    lids = [np.stack([this, after, np.full(around, len(vertices) - 2)], 1)]
    lids += [np.stack([after + top, this + top, np.full(around, len(vertices) - 1)], 1)]
    upper = np.clip((vertices[:, 1] - 0.4 * height) / (0.2 * height), 0, 1)
    return {
        "vertices": vertices,
        "faces": np.concatenate([side, *lids]).astype(np.int32),
        "joints": np.array([[0, 0.1, 0], [0, height / 2, 0]]),
        "parents": np.array([-1, 0]),
        "blend_weights": np.stack([1 - upper, upper], axis=1),
    }


def swing(frames=24, joints=2, fps=30.0, size=0.5):
    """The upper joint nods and stops halfway through; the root walks along z and stops with it."""
    t = np.minimum(np.arange(frames), frames // 2) / fps
    poses = np.zeros((frames, joints, 3), np.float32)
    poses[:, -1, 0] = size * np.sin(2 * np.pi * t)
    poses[:, 0, 1] = 0.3 * t
    trans = np.zeros((frames, 3), np.float32)
    trans[:, 2] = 0.8 * t
    return {"poses": poses, "trans": trans, "fps": np.array(fps)}


SCENE = """
[body]
file = "body.npz"
[garment]
file = "cloth.npz"
smoothing = 2
[motion]
files = ["swing.npz"]
validation = ["swing.npz"]
fps = 30
[network]
cell = "gated"
static = [16, 16]
joint = [8]
dynamic = [16]
decoder = [16]
modes = 6
[training]
steps = 40
batch = 4
window = 5
validate_every = 20
checkpoint_every = 10
"""

FREE = SCENE + "[physics.collision]\nstiffness = 0\n"  # the body is not touched: compiles in half the time


def write_scene(folder, text=SCENE):
    """Write a whole scene into a folder; returns the scene file's path."""
    vertices, faces = grid()
    np.savez(folder / "cloth.npz", vertices=vertices, faces=faces, group_pins=np.arange(25, 30))
    np.savez(folder / "body.npz", **post())
    np.savez(folder / "swing.npz", **swing())
    path = folder / "scene.toml"
    path.write_text(text)
    return path

"""Scenes small enough for a test: a strip of cloth on a post of two joints, or on no body at all."""

import numpy as np


def grid(rows=6, columns=5, spacing=0.05, origin=(0.0, 0.3, 0.09)):
    """A flat sheet facing +z: vertices (rows * columns, 3) and faces."""
    y, x = np.mgrid[:rows, :columns] * spacing
    vertices = np.stack([x - x.mean(), y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + origin
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + columns, corner + columns + 1
    return vertices, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)


def post(height=1.0, radius=0.08, rings=11, around=10):
    """A closed post of two joints, the second halfway up: a body record's arrays."""
    import trimesh

    mesh = trimesh.creation.capsule(height=height - 2 * radius, radius=radius, count=[around, around])
    vertices = np.asarray(mesh.vertices)[:, [0, 2, 1]] * [1, 1, -1]
    vertices = vertices - [0, vertices[:, 1].min(), 0]
    upper = np.clip((vertices[:, 1] - 0.4 * height) / (0.2 * height), 0, 1)
    return {
        "vertices": vertices,
        "faces": np.asarray(mesh.faces, np.int32),
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


def write_scene(folder, text=SCENE):
    """Write a whole scene into a folder; returns the scene file's path."""
    vertices, faces = grid()
    np.savez(folder / "cloth.npz", vertices=vertices, faces=faces, group_pins=np.arange(25, 30))
    np.savez(folder / "body.npz", **post())
    np.savez(folder / "swing.npz", **swing())
    path = folder / "scene.toml"
    path.write_text(text)
    return path

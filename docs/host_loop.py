"""A host's loop: onnxruntime and NumPy play a garment that `ncs export` wrote over a motion file.

    python host_loop.py tshirt.onnx walk.npz vertices.npy [ALPHA]

The motion has what `tshirt.onnx.json` asks for: `poses` (frames, joints, 3), axis-angle, and `trans` (frames, 3) in metres, at
the file's frame rate. An engine takes matrices from its own skeleton instead; one with left-handed axes mirrors them first.
"""

import json
import sys

import numpy as np
import onnxruntime


def matrices(poses):
    """Rotation matrices (..., 3, 3) of axis-angle vectors (..., 3)."""
    angle = np.linalg.norm(poses, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(poses / np.maximum(angle[..., 0], 1e-12), -1, 0)
    zero = np.zeros_like(x)
    k = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def main(model, motion, out, alpha="1"):
    """Play a motion and save the vertices (frames, verts, 3)."""
    session = onnxruntime.InferenceSession(model)
    facts = json.loads(session.get_modelmeta().custom_metadata_map["ncs_jax"])
    recording = np.load(motion)
    if float(recording["fps"]) != facts["fps"]:
        raise SystemExit(f"{motion}: {recording['fps']} frames per second; the garment was trained at {facts['fps']}")
    rotations = matrices(recording["poses"])[:, [joint["number"] for joint in facts["joints"]]].astype(np.float32)
    given = {"alpha": np.array([alpha], np.float32), "state": np.zeros(facts["inputs"]["state"]["shape"], np.float32)}
    frames = []
    for given["rotations"], given["translation"] in zip(rotations, recording["trans"].astype(np.float32), strict=True):
        given["state"], vertices = session.run(["next_state", "vertices"], given)
        frames.append(vertices)
    np.save(out, frames)
    print(f"{out}: {len(frames)} frames of {facts['vertices']} vertices")


if __name__ == "__main__":
    main(*sys.argv[1:])

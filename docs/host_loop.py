"""Play an exported garment over a motion, with NumPy and onnxruntime alone: what a game engine does, in Python.

    pip install numpy onnxruntime
    ncs export runs/tshirt --out tshirt.onnx
    python docs/host_loop.py tshirt.onnx src/ncs_jax/assets/walk.npz vertices.npy

The motion file holds three arrays:

    poses  (frames, joints, 3)  how each joint of the body is turned: axis times angle, radians
    trans  (frames, 3)          where the root has moved from its place at rest, metres
    fps    ()                   frames per second
    joint_names  (joints,)      if it is there, joints are found by name; else they are in the order of the body's file

The result, vertices.npy, has shape (frames, vertices, 3) and is in metres. A fourth argument is alpha: 0 is static, 1 as
trained.

An engine has rotation matrices already, so it needs no motion file and no `matrix`. An engine with left-handed axes mirrors
rotations and translation before the step, and the vertices after it.
"""

import json
import sys

import numpy as np
import onnxruntime


def matrix(turn):
    """Return the rotation matrix (3, 3) of axis times angle (3,), by Rodrigues' formula."""
    angle = np.linalg.norm(turn)
    if angle == 0:
        return np.eye(3)
    x, y, z = turn / angle  # the axis, of length 1
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # cross @ v is the cross product of the axis and v
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def main(model, motion, out, alpha="1"):
    """Play a motion and save the vertices (frames, vertices, 3)."""
    session = onnxruntime.InferenceSession(model)

    # What a host has to know is inside the file, as JSON text. The same text lies beside it in tshirt.onnx.json.
    facts = json.loads(session.get_modelmeta().custom_metadata_map["ncs_jax"])
    numbers = [joint["number"] for joint in facts["joints"]]  # the body's joints that the garment reads, in this order

    recording = np.load(motion)
    if "joint_names" in recording:  # a file may have the body's joints in another order than the body's own
        names = [str(name) for name in recording["joint_names"]]
        if lacking := [joint["name"] for joint in facts["joints"] if joint["name"] not in names]:
            raise SystemExit(f"{motion}: a motion of the garment's own body expected; it has no {', '.join(lacking)}")
        numbers = [names.index(joint["name"]) for joint in facts["joints"]]
    fps = float(recording["fps"])
    if fps != facts["fps"]:
        raise SystemExit(f"{motion}: {fps} frames per second; the garment was trained at {facts['fps']}")

    # The state is what the garment remembers of the frames before: one vector, zeros at the start of a motion.
    state = np.zeros(facts["inputs"]["state"]["shape"], np.float32)

    frames = []
    for pose, place in zip(recording["poses"], recording["trans"], strict=True):
        inputs = {
            "state": state,  # (S,)
            "rotations": np.array([matrix(pose[j]) for j in numbers], np.float32),  # (joints, 3, 3)
            "translation": place.astype(np.float32),  # (3,), metres
            "alpha": np.array([alpha], np.float32),  # (1,)
        }
        state, vertices = session.run(["next_state", "vertices"], inputs)  # the state goes into the next frame
        frames.append(vertices)  # (vertices, 3), metres, in the order of the garment's own file

    np.save(out, frames)
    print(f"{out}: {len(frames)} frames of {facts['vertices']} vertices")


if __name__ == "__main__":
    if not 4 <= len(sys.argv) <= 5:
        raise SystemExit(__doc__)
    main(*sys.argv[1:])

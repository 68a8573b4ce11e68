"""A trained garment for another program, frame by frame through two pipes: poses in, vertices out, both plain float32."""

from __future__ import annotations

import json
from typing import BinaryIO

import jax
import numpy as np

from ncs_jax.errors import check_alpha
from ncs_jax.geometry.skinning import forward, to_rest_axes, transforms
from ncs_jax.network.rollout import stepper
from ncs_jax.runs.outside import outside, pushing
from ncs_jax.runs.run import Run

__all__ = ["AGAIN", "BEGIN", "NEXT", "serve_frames"]

BEGIN, NEXT, AGAIN = 0, 1, 2  # a frame without a past, the one after the last, the last one once more
HEAD = 5  # numbers before the rotations


def serve_frames(run: Run, source: BinaryIO, sink: BinaryIO) -> int:
    """Answer frames until the source ends; return how many.

    First a line of JSON is written: `joints`, the names of the body's joints (numbers where it has none), `vertices`, how many
    the garment has, `numbers`, how many a frame has, and `fps`. Then a frame is read as float32, little-endian:

        kind, alpha, translation (3), rotations (joints, 3, 3) by rows

    and its vertices (verts, 3) in m are written, float32 too. Rotations are those of all joints of the body's file, local and
    since rest, as its motions have them; the translation is the root's since rest, m. `kind` is `BEGIN`, `NEXT` or `AGAIN`.
    Frames that begin with `BEGIN` and go on with `NEXT` give what `animate(outside=True)` gives, of a garment over others what
    `animate` gives. `AGAIN` takes the last frame back first. The program is compiled before the line is written.
    """
    model, body = run.assembly.model, run.assembly.body
    names = [] if body is None else list(body.joint_names)
    names = names or [str(j) for j in range(max(model.source_joints) + 1 if body is None else len(body.parents))]
    chosen, dtype = np.array(model.source_joints), model.garment.mesh.rest.dtype
    rollout = stepper(model, run.assembly.network, run.params)
    by = None if model.under else pushing(model)  # where the garments below are, a stream does not know

    @jax.jit
    def step(state, rotations, translation, alpha):
        if model.rest_rotations is not None:
            rotations = to_rest_axes(rotations, model.rest_rotations)
        state, x = rollout.step(state, rotations, translation, alpha)
        if by is not None:
            matrices = transforms(model.skeleton, forward(model.skeleton, rotations, translation))
            x = outside(model, by, matrices, x)
        return state, x

    def answer(state, frame: np.ndarray):
        check_alpha(float(frame[1]))
        rotations = frame[HEAD:].reshape(len(names), 3, 3)[chosen]
        state, vertices = step(state, rotations.astype(dtype), frame[2:HEAD].astype(dtype), float(frame[1]))
        return state, np.asarray(vertices, "<f4")

    size = HEAD + 9 * len(names)
    still = np.concatenate([np.zeros(HEAD), np.tile(np.eye(3).ravel(), len(names))]).astype("<f4")
    begin = rollout.init()
    before = now = answer(begin, still)[0]  # the program is compiled here
    facts = {"joints": names, "vertices": len(model.garment.mesh.rest), "numbers": size, "fps": model.fps}
    sink.write(json.dumps(facts).encode() + b"\n")
    sink.flush()
    count = 0
    while len(data := source.read(4 * size)) == 4 * size:
        frame = np.frombuffer(data, "<f4")
        before = {BEGIN: begin, NEXT: now, AGAIN: before}[int(frame[0])]
        now, vertices = answer(before, frame)
        sink.write(vertices.data)
        sink.flush()
        count += 1
    return count

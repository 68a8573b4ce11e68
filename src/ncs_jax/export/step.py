"""A trained garment as a file that a host runs without this package: one step, its state one vector in and out.

    next_state, vertices = step(state, rotations, translation, alpha)

    state (S,)                 zeros at a motion's start, else `next_state` of the frame before; its parts are the file's own
    rotations (joints, 3, 3)   local rotations of the joints that the facts name, as the body's motions have them
    translation (3,)           of the root from where it rests, m
    alpha (1,)                 0 is static, 1 as trained
    vertices (verts, 3)        m, in the garment file's order

All float32. The facts (JSON, in FILE.json and in an ONNX model's metadata under `ncs_jax`) say what a host has to know.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ncs_jax.errors import InputError
from ncs_jax.export.onnx_lowering import onnx_model
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import to_rest_axes
from ncs_jax.io.records import MotionRecord
from ncs_jax.io.tables.files import replacing
from ncs_jax.network.methods.method import Method, for_inference
from ncs_jax.network.rollout import stepper
from ncs_jax.prepare.build import Assembly
from ncs_jax.scene.model import Model, local_rotations

__all__ = ["FORMATS", "Check", "Exported", "Step", "export", "flat_step", "rounded"]

FORMATS = ("onnx", "stablehlo")
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")  # that a stablehlo file is made for
INTERFACE = 1  # of the step and the facts: a change that breaks a host gives the next number
FRAMES = 240  # of a motion that a file is checked on
THREADS = 2
RESULTS = ("next_state", "vertices")


class Step(NamedTuple):
    """`call(state, rotations, translation, alpha) -> (next_state, vertices)`, and the shapes of its arguments by name."""

    call: Callable
    arguments: dict[str, tuple[int, ...]]


class Check(NamedTuple):
    """A written file beside the step it was made from, over a motion.

    apart: the largest distance of a vertex, m. milliseconds: median of a frame on two threads. frames: how many. error: of the
    file from the garment as trained, mean and largest, mm, where the file has a smaller or a rounded network.
    """

    apart: float
    milliseconds: float
    frames: int
    error: tuple[float, float] | None


@dataclass(frozen=True)
class Exported:
    """What was written: the facts beside it, and the check, None where there was nothing to run it with or no motion."""

    file: Path
    facts: dict
    check: Check | None

    def __str__(self) -> str:
        """All of it in two lines."""
        size = f"{self.file.stat().st_size / 1e6:.2g} MB"
        text = f"{self.file}: {self.facts['format']}, {size}; {self.file}.json says how to run it\n  "
        if self.check is None:
            return text + "not checked: that takes a motion, and of an ONNX file the package onnxruntime"
        apart, milliseconds, frames, error = self.check
        text += f"{frames} frames, {milliseconds:.2g} ms each; at most {apart:.1e} m from the network that it was made from"
        return text if error is None else f"{text}; {error[0]:.2g} mm from the whole network, {error[1]:.2g} at most"


def export(
    assembly: Assembly,
    params: dict,
    file: str | Path,
    *,
    format: str = "onnx",
    float16: bool = False,
    opset: int = 15,
    motion: MotionRecord | None = None,
    trained: tuple[Method, dict] | None = None,
) -> Exported:
    """Write a garment's step, and its facts into FILE.json.

    `onnx` has operators of `lowering.RULES` only, with static shapes. `stablehlo` is an artifact of `jax.export`, which JAX can
    load that is up to three weeks older or six months newer than the one that wrote it, on any of `PLATFORMS`.

    Args:
        float16: store the network's matrices in 16 bits. They are widened when loaded: the arithmetic is float32.
        opset: of the ONNX operators. motion: to check the file on, its first `FRAMES`. trained: network and parameters that the
            error is measured from, where those of the file are smaller or rounded.

    Raises:
        InputError: the format is unknown or its package missing, the network does what ONNX cannot, or the place is unwritable.
    """
    file, model = Path(file), assembly.model
    if format not in FORMATS:
        raise InputError(f"one of {', '.join(FORMATS)} expected", field="--format", value=format)
    network, params = for_inference(assembly.network, params, model)
    if float16:
        params = rounded(params)
    step = flat_step(model, network, params)
    facts = _facts(assembly, step, file, format, float16, opset)
    text = json.dumps(facts, indent=2)
    if format == "onnx":
        data = onnx_model(step.call, step.arguments, RESULTS, opset=opset, facts=text).SerializeToString()
    else:
        data = _stablehlo(step)
    for path, content in ((file, data), (Path(f"{file}.json"), text.encode() + b"\n")):
        with replacing(path) as part:
            part.write_bytes(content)
    run = _player(file, format) if motion is not None else None
    if run is None:
        return Exported(file, facts, None)
    return Exported(file, facts, _check(model, network, params, motion, step, run, trained))


def flat_step(model: Model, network: Method, params: dict) -> Step:
    """The step of `rollout.stepper` with its state in one vector, of which zeros are what `init()` gives.

    float16 parameters are widened when they are used. The state holds what the vertices of some later frame depend on and no
    more: `whether there was a frame` where that matters, codes, joints. A garment that needs none of it carries one zero.
    """
    init = stepper(model, network, params).init
    leaves, tree = jax.tree.flatten(init())
    joints, dtype = len(model.skeleton.parents), leaves[0].dtype
    arguments = {"rotations": (joints, 3, 3), "translation": (3,), "alpha": (1,)}

    def step(state, rotations, translation, alpha):
        wide = jax.tree.map(lambda a: a.astype(dtype) if a.dtype == jnp.float16 else a, params)
        if model.rest_rotations is not None:
            rotations = to_rest_axes(rotations, model.rest_rotations)
        return stepper(model, network, wide).step(state, rotations, translation, alpha[0])

    spare = [jax.ShapeDtypeStruct(shape, dtype) for shape in arguments.values()]
    carried = _carried(step, init(), *spare)
    sizes = [math.prod(leaves[i].shape) for i in carried]

    def call(state, *frame):
        parts, known = jnp.split(state, np.cumsum(sizes)[:-1]) if sizes else (), list(leaves)
        for i, part in zip(carried, parts, strict=True):
            known[i] = part.reshape(leaves[i].shape) if leaves[i].dtype == dtype else part[0] > 0
        new, vertices = step(jax.tree.unflatten(tree, known), *frame)
        kept = [jnp.asarray(jax.tree.leaves(new)[i], dtype).reshape(-1) for i in carried]
        return (jnp.concatenate(kept) if kept else state), vertices

    return Step(call, {"state": (max(sum(sizes), 1),), **arguments})


def _carried(step: Callable, state, *frame) -> list[int]:
    """Which arrays of a state the vertices depend on, in this frame or a later one."""
    trace = jax.make_jaxpr(step)(state, *frame).jaxpr
    count, wanted = len(jax.tree.leaves(state)), {trace.outvars[-1]}
    while True:
        read = set(wanted)
        for eqn in reversed(trace.eqns):
            if not read.isdisjoint(eqn.outvars):
                read |= {v for v in eqn.invars if not isinstance(v, core.Literal)}
        carried = [i for i, v in enumerate(trace.invars[:count]) if v in read]
        more = wanted | {v for i in carried if not isinstance(v := trace.outvars[i], core.Literal)}
        if more == wanted:
            return carried
        wanted = more


def rounded(params: dict) -> dict:
    """Parameters with the matrices of the networks in float16; biases, and factors of the skinning weights, as they are."""
    return {
        name: jax.tree.map(lambda a: a.astype(jnp.float16) if a.ndim > 1 else a, part) if name != "blend" else part
        for name, part in params.items()
    }


def _stablehlo(step: Step) -> bytes:
    if find_spec("flatbuffers") is None:  # which jax.export needs, there and here
        raise InputError(
            "the package flatbuffers is needed", field="--format", value="stablehlo", mend="pip install flatbuffers"
        )
    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in step.arguments.values()]
    return bytes(jax.export.export(jax.jit(step.call), platforms=PLATFORMS)(*shapes).serialize())


def _facts(assembly: Assembly, step: Step, file: Path, format: str, float16: bool, opset: int) -> dict:
    """What a host has to know, as JSON has it."""
    model, body, verts = assembly.model, assembly.body, len(assembly.garment.vertices)
    names = body.joint_names if body is not None else ()
    alpha = "0 is static, 1 as trained; more exaggerates, the further the less sure" if assembly.network.controlled else "idle"
    told = {
        "state": "zeros at a motion's start, else next_state of the frame before",
        "rotations": "local rotations of the joints below, in this order, as the body's motions have them; columns are axes",
        "translation": "of the root from where it rests, m",
        "alpha": alpha,
    }
    return {
        "file": file.name,
        "format": format if format != "onnx" else f"onnx, opset {opset}",
        "interface": INTERFACE,
        "written_by": f"ncs-jax {version('ncs-jax')}, jax {jax.__version__}",
        "fps": float(model.fps),
        "vertices": verts,
        "units": "metres, rotation matrices, float32",
        "axes": "right-handed, those of the body file: a host with left-handed ones mirrors what goes in and what comes out",
        "gravity": np.asarray(model.material.gravity, np.float64).round(6).tolist(),
        "weights": "float16, computed in float32" if float16 else "float32",
        "alpha": {"from": 0.0, "trained": 1.0} if assembly.network.controlled else None,
        "inputs": {name: {"shape": list(shape), "what": told[name]} for name, shape in step.arguments.items()},
        "outputs": {
            "next_state": {"shape": list(step.arguments["state"]), "what": "the state of the next frame"},
            "vertices": {"shape": [verts, 3], "what": "in the garment file's order, m"},
        },
        "joints": [
            {
                "name": names[source] if names else str(source),
                "number": int(source),
                "parent": parent,
                "rest": np.asarray(rest, np.float64).round(6).tolist(),
            }
            for source, parent, rest in zip(
                model.source_joints, model.skeleton.parents, np.asarray(model.skeleton.joints), strict=True
            )
        ],
    }


def _player(file: Path, format: str) -> Callable | None:
    """What runs a written file; None where onnxruntime is not installed."""
    if format == "stablehlo":
        loaded = jax.jit(jax.export.deserialize(bytearray(file.read_bytes())).call)
        return lambda **arguments: loaded(*arguments.values())
    try:
        import onnxruntime
    except ImportError:
        return None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    return lambda **arguments: session.run(None, arguments)


def _check(model, network, params, motion, step: Step, run: Callable, trained) -> Check:
    poses = np.asarray(motion.poses[:FRAMES], np.float32)
    # Near the origin, as a track is: what single precision loses far from it is not the file's fault.
    places = np.asarray(motion.translation[:FRAMES] - motion.translation[:1], np.float32)
    given = np.asarray(axis_angle_to_matrix(jnp.asarray(poses[:, np.asarray(model.source_joints)])))
    alpha, state, seconds, found = np.ones(1, np.float32), np.zeros(step.arguments["state"], np.float32), [], []
    for rotations, translation in zip(given, places, strict=True):
        start = time.perf_counter()
        state, x = run(state=state, rotations=rotations, translation=translation, alpha=alpha)
        found.append(np.asarray(x))
        seconds.append(time.perf_counter() - start)

    def streamed(network, params):
        wide = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == jnp.float16 else a, params)
        init, frame = stepper(model, network, wide)
        frame, state, every = jax.jit(frame, donate_argnums=0), init(), []
        for rotations, translation in zip(local_rotations(model, jnp.asarray(poses)), jnp.asarray(places), strict=True):
            state, x = frame(state, rotations, translation)
            every.append(np.asarray(x))
        return np.stack(every)

    def apart(other):
        return np.linalg.norm(np.stack(found) - other, axis=-1)

    error = None
    if trained is not None:
        far = 1000 * apart(streamed(*trained))
        error = float(far.mean()), float(far.max())
    far = apart(streamed(network, params))
    # A comparison with NaN is false: what is not finite must not pass for near.
    worst = float(far.max()) if np.all(np.isfinite(far)) else math.inf
    return Check(worst, 1000 * float(np.median(seconds)), len(found), error)

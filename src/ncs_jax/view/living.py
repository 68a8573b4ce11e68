"""One page in which a browser runs a trained garment: motions, alpha, and joints to drag, without a server."""

from __future__ import annotations

import html
import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.export.check import Check, check_file, load_step
from ncs_jax.export.onnx_lowering import onnx_model
from ncs_jax.export.step import RESULTS, Step, flat_step, rounded
from ncs_jax.geometry.skinning import blend_from
from ncs_jax.io.mesh.joined import garment_names
from ncs_jax.network.methods.method import Method, for_inference
from ncs_jax.runs.run import Run
from ncs_jax.scene.model import Model
from ncs_jax.view.animation import upright
from ncs_jax.view.browser_runtime import BrowserRuntime
from ncs_jax.view.heading import up_of
from ncs_jax.view.page import Encoded, deflated, fill_page, stored_faces, stored_track

__all__ = ["LivingPage", "write_living_page"]

STEP = 2.0**-20
"""The grid that a motion is rounded to, in radians and m."""

MANTISSA = 16  # bits of a matrix's numbers that are kept: three bytes of four carry something, and the page is smaller
FLOAT = 1  # how ONNX names float32
LARGE = 256  # numbers from which on a constant of a graph is a matrix


@dataclass(frozen=True)
class LivingPage:
    """Say what was written: the file, the motions in it, and how its network does over the first of them; None: not checked."""

    file: Path
    motions: tuple[str, ...]
    check: Check | None

    def __str__(self) -> str:
        """Return all of it in two lines."""
        count = len(self.motions)
        text = (
            f"{self.file}: {self.file.stat().st_size / 1e6:.1f} MB, {count} motion{'s' * (count > 1)}; open it in a browser\n  "
        )
        if self.check is None:
            return text + "its network was not checked: that takes pip install onnxruntime"
        mean, most = self.check.error or (0.0, 0.0)
        return text + f"{self.check.frames} frames of its network: {mean:.2g} mm from the trained one, {most:.2g} at most"


def write_living_page(
    file: str | Path,
    run: Run,
    motions: Mapping[str, io.MotionRecord],
    runtime: BrowserRuntime,
    *,
    rank: int = 0,
    float16: bool = False,
    refined: tuple[int, np.ndarray] | None = None,
) -> LivingPage:
    """Write one HTML file in which a browser runs the network of a run, as `export.step` has it, and draws it on its body.

    The network's matrices are rounded to `MANTISSA` bits after the first; `float16` to 10. The body is skinned linearly.

    Args:
        motions: of the run's own body, by name; the first is shown first. rank: of a smaller decoder, for the first motion.
        refined: iterations, and the vertices (frames, verts, 3), m, of the first motion after them, to be compared with.

    Raises:
        InputError: there is no motion, the name does not end in .html, or the network does what ONNX cannot.
    """
    file, record = Path(file), next(iter(motions.values()), None)
    if record is None:
        raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
    check_name(file)
    garment, model = run.assembly.garment, run.assembly.model
    scene: dict[str, object] = {"fps": float(model.fps), "frames": len(record.poses), "labels": []}
    scene["garment"] = {"verts": len(garment.vertices), "layers": garment.layers}
    parts = {"script": runtime.script, "module": runtime.module, "wasm": runtime.wasm}
    data = {"garment-faces": stored_faces(garment.faces)} | {
        f"runtime-{name}": deflated(part, 9) for name, part in parts.items()
    }
    smaller = run.compressed(record, rank=rank) if rank else run
    steps, check = _steps(smaller, float16, record, (run.assembly.network, run.params), data)
    for step, place in zip(steps, _body(run, scene, data), strict=True):
        step["first"] = place
    listed = [_motion(number, name, each, run, data) for number, (name, each) in enumerate(motions.items())]
    up = up_of(run.assembly.scene.physics.gravity)
    if refined is not None:
        count, vertices = refined
        track, data["refined-0"] = stored_track(upright(vertices - np.asarray(record.translation[0]), up))
        listed[0]["refined"] = {**track, "name": f"after {count} iterations of the solver"}
    turned = upright(np.eye(3), up).T
    scene["live"] = {
        "controlled": bool(run.assembly.network.controlled),
        "step": STEP,
        "skeleton": _skeleton(run),
        "motions": listed,
        "steps": steps,
        "turned": None if np.array_equal(turned, np.eye(3)) else turned.ravel().tolist(),
    }
    notices = f"<details><summary>Parts by others</summary><pre>{html.escape(runtime.notice)}</pre></details>"
    facts = _facts(run, runtime, check)
    fill_page(file, Encoded(scene, data), "live", title=_title(run), facts=facts, notices=notices)
    return LivingPage(file, tuple(motions), check)


def check_name(file: Path) -> None:
    """Raise an InputError where a page's name does not end in .html."""
    if file.suffix.lower() not in (".html", ".htm"):
        raise InputError("a name in .html expected for web", file=file, value=file.suffix, mend="end the name in .html")


def _steps(
    run: Run, float16: bool, motion: io.MotionRecord, trained: tuple[Method, dict], data: dict[str, str]
) -> tuple[list[dict], Check | None]:
    """Store the steps of a garment and of those below; return what the page knows of them, and the check of the first."""
    model = run.assembly.model
    network, params = for_inference(run.assembly.network, run.params, model)
    graphs = [(model, *_graph(model, network, rounded(params) if float16 else params))]
    for layer in model.under:
        graphs.append((layer.model, *_graph(layer.model, *for_inference(layer.network, layer.params, layer.model))))
    facts = []
    for number, (own, step, graph) in enumerate(graphs):
        data[f"step-{number}"] = deflated(_by_place(np.frombuffer(graph + bytes(-len(graph) % 4), "<i4")), 9)
        joints = own.source_joints if run.assembly.body is not None else range(len(own.source_joints))
        size = {"bytes": len(graph), "state": step.arguments["state"][0]}
        facts.append({"id": f"step-{number}", "joints": list(joints), **size})
    _, step, graph = graphs[0]
    return facts, _checked(graph, step.arguments["state"][0], model, motion, trained)


def _graph(model: Model, network: Method, params: dict) -> tuple[Step, bytes]:
    """Return a step and its ONNX graph, the matrices of which are rounded."""
    step = flat_step(model, network, params)
    made = onnx_model(step.call, step.arguments, RESULTS)
    for constant in made.graph.initializer:
        if constant.data_type == FLOAT and math.prod(constant.dims) >= LARGE:
            constant.raw_data = _shortened(np.frombuffer(constant.raw_data, "<f4")).tobytes()
    return step, made.SerializeToString()


def _shortened(x: np.ndarray) -> np.ndarray:
    """Round float32 numbers to the nearest of which the last bits, all but `MANTISSA`, are 0."""
    lost = 23 - MANTISSA
    bits = x.view("<u4").astype(np.uint64) + (1 << (lost - 1))
    return (bits >> lost << lost).astype("<u4").view("<f4")


def _checked(graph: bytes, state: int, model: Model, motion: io.MotionRecord, trained: tuple[Method, dict]) -> Check | None:
    """Run a graph over a motion beside the network as trained."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "step.onnx")
        file.write_bytes(graph)
        loaded = load_step(file, "onnx")
        check = None if loaded is None else check_file(loaded, state, model, trained, motion, trained)
    if check is not None and not math.isfinite(check.max_difference):
        raise InputError("finite vertices expected", field="--motion", mend="see ncs check, or train it on such motion")
    return check


def _by_place(numbers: np.ndarray) -> bytes:
    """Return int32 numbers as bytes, all the first ones before all the second ones, and so on: they deflate better."""
    return np.ascontiguousarray(numbers.astype("<i4").reshape(-1, 1).view(np.uint8).T).tobytes()


def _body(run: Run, scene: dict, data: dict) -> list[int]:
    """Store the body at rest and its skinning weights; return where the numbers of each garment below begin in its mesh."""
    body, under = run.assembly.body, run.assembly.model.under
    if body is None:
        return [0] * (1 + len(under))
    count, faces, places = len(body.vertices), [np.asarray(body.faces)], [0]
    for layer in under:
        places.append(3 * count)
        faces.append(np.asarray(layer.model.garment.mesh.faces) + count)
        count += len(layer.rest)
    blended = blend_from(body.weights)
    weights = np.asarray(blended.weights)
    influences = int((weights > 0).sum(axis=1).max())
    most = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    data["body-faces"] = stored_faces(np.concatenate(faces))
    data["body-rest"] = deflated(np.asarray(body.vertices).astype("<f4").tobytes())
    data["body-joints"] = deflated(np.asarray(blended.joints, "<u2")[most].tobytes())
    data["body-weights"] = deflated(np.take_along_axis(weights, most, axis=1).astype("<f4").tobytes())
    scene["body"] = {"verts": count, "worn": count - len(body.vertices), "influences": influences}
    return places


def _skeleton(run: Run) -> dict:
    """Return the joints: of the body, else those that the garment reads."""
    body, model = run.assembly.body, run.assembly.model
    known = model.skeleton if body is None else body
    axes = model.rest_rotations if body is None else body.rest_rotations
    names = tuple(map(str, model.source_joints)) if body is None else body.joint_names
    return {
        "parents": [int(parent) for parent in known.parents],
        "joints": np.asarray(known.joints, float).tolist(),
        "axes": None if axes is None else np.asarray(axes, float).reshape(-1, 9).tolist(),
        "names": list(names or map(str, range(len(known.parents)))),
    }


def _motion(number: int, name: str, motion: io.MotionRecord, run: Run, data: dict) -> dict:
    """Store a motion: turns of the joints and the root's way from its start, as second differences in time."""
    poses, start = np.asarray(motion.poses, float), np.asarray(motion.translation[0], float)
    if run.assembly.body is None:
        poses = poses[:, np.asarray(run.assembly.model.source_joints)]
    rows = np.concatenate([poses.reshape(len(poses), -1), motion.translation - start], axis=1)
    grid = np.round(rows / STEP).astype(np.int64)
    for _ in range(2):
        grid = np.diff(grid, axis=0, prepend=np.zeros_like(grid[:1]))
    data[f"motion-{number}"] = deflated(_by_place(grid))
    return {"name": name, "frames": len(poses), "start": start.tolist()}


def _title(run: Run) -> str:
    """Return the names of the garments, of their files."""
    spec = run.assembly.scene.garment
    return ", ".join(garment_names((spec.file, *spec.layers))).replace("_", " ").capitalize()


def _facts(run: Run, runtime: BrowserRuntime, check: Check | None) -> dict[str, str]:
    """Return what the page says of itself."""
    body = run.assembly.body
    facts = {
        "garment": f"{len(run.assembly.garment.vertices)} vertices, by a network that runs here",
        "trained": f"{run.steps} steps",
        "runtime": f"onnxruntime-web {runtime.version}; its licence is under ?",
    }
    if check is not None and check.error is not None:
        facts["rounded"] = f"up to {check.error[1]:.2g} mm from the trained network"
    if body is not None and body.posedirs is not None:
        facts["body"] = "without its pose correctives: skin may show by as much as they move it"
    return facts

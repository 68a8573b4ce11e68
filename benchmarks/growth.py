"""How time and peak memory of a streamed frame and of a training step grow with a scene, one size at a time.

    python -m benchmarks.growth [SCENE] [--repeats 3] [--timeout 300] [--quick] [--json FILE]

Every triangle of the garment is divided in 4, 16 and 64, as long as it has at most 80,000 vertices, every one of the body in
4 and 16; batch and window are a quarter of the scene's and four times that. Each size is a process of its own, so that its peak
of memory is its own: `ready` of reading and preparing the scene, `frame` and `step` of compiling and running those. One that
does not fit into memory, or not into the time, says so. The least is that of `benchmarks/work.py`.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import work
from benchmarks.inference import stream
from benchmarks.measure import apart, clocks, forget_peak, peak_memory, read, run, timed
from benchmarks.training import batch, ready, steps
from ncs_jax import InputError, Run, io
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.network.methods.method import for_inference
from ncs_jax.scene.spec import Scene
from ncs_jax.training.step import initial_state

MOST = 80_000  # vertices of a garment
PAIR = 2  # steps in a program
FRAMES = 60


def finer(scene: Scene, folder: Path, garment: int = 1, body: int = 1) -> Scene:
    """The scene with every triangle of its garment and of its body divided into so many, powers of four."""
    from trimesh.remesh import subdivide

    if garment > 1:
        record = io.read_garment(scene.path(scene.garment.file))
        points, faces = record.vertices, record.faces
        for _ in range(round(np.log(garment) / np.log(4))):
            points, faces = subdivide(points, faces)
        file = folder / f"garment{garment}.npz"
        write_npz(file, vertices=points, faces=faces.astype(np.int32))
        scene = replace(scene, garment=replace(scene.garment, file=str(file), pins=""))
    if body > 1:
        skinned = io.read_body(scene.path(scene.body.file))
        points, faces, weights = skinned.vertices, skinned.faces, skinned.weights
        for _ in range(round(np.log(body) / np.log(4))):
            points, faces, at = subdivide(points, faces, vertex_attributes={"weights": weights})
            weights = at["weights"]
        optional = {"joint_names": np.array(skinned.joint_names), "rest_rotations": skinned.rest_rotations}
        given = {name: value for name, value in optional.items() if value is not None and len(value)}
        file = folder / f"body{body}.npz"
        write_npz(
            file, vertices=points, faces=faces.astype(np.int32), joints=skinned.joints, parents=skinned.parents,
            blend_weights=weights, **given,
        )  # fmt: skip
        scene = replace(scene, body=replace(scene.body, file=str(file)))
    return scene


def point(scene: str, repeats: int, garment: int = 1, body: int = 1, **training: int) -> dict:
    """One size, measured in this process."""
    spec = read(scene)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        assembly = ready(finer(replace(spec, training=replace(spec.training, **training)), Path(folder), garment, body))
        reading = time.perf_counter() - start
    model, peaks = assembly.model, {"ready": peak_memory()}
    params = initial_state(model, assembly.network, 0).params
    forget_peak()
    frame = timed(stream(Run(assembly, params)), FRAMES if repeats > 1 else 2)
    peaks["frame"] = peak_memory()
    merged = for_inference(assembly.network, params, model)[1]
    needed = {"frame": work.inference(model, merged, 1)}
    needed["step"] = work.training(assembly, params, np.asarray(batch(assembly, 1)[0][0]))["step"]
    del merged, params
    forget_peak()
    seconds = {"frame": frame, "step": timed(steps(assembly, PAIR)[0], repeats, PAIR)}
    peaks["step"] = peak_memory()
    sizes = {"vertices": len(model.garment.mesh.rest), "body": 0 if model.body is None else len(model.body)}
    sizes |= {name: getattr(assembly.scene.training, name) for name in ("batch", "window")}
    named = {name: {"seconds": seconds[name], "work": needed[name]} for name in seconds}
    return {"sizes": sizes, "ready": reading, "peak": peaks, "rows": named}


def benchmark(options) -> dict:
    """Measure every size."""
    spec = read(options.scene)
    verts = len(io.read_garment(spec.path(spec.garment.file)).vertices)
    wanted: list[dict[str, int]] = [{}]
    if not options.quick:
        wanted += [{"garment": times} for times in (4, 16, 64) if times * verts <= MOST]
        wanted += [{"body": times} for times in (4, 16) if spec.body.file not in ("", "none")]
        for name in ("batch", "window"):
            size = getattr(spec.training, name)
            wanted += [{name: max(3, size // 4)}, {name: 4 * size}]
    where = options.scene if options.scene.startswith("ncs:") else str(Path(options.scene).absolute())
    rows, points = {}, []
    for changed in wanted:
        found = apart("benchmarks.growth", [POINT, where, str(1 if options.quick else options.repeats), json.dumps(changed)],
                      options.timeout)  # fmt: skip
        points.append({"changed": changed, **found})
        name = ", ".join(f"{k} {v}" if k in ("batch", "window") else f"{k} x {v}" for k, v in changed.items()) or "the scene"
        if "failed" in found:
            rows[name] = {"failed": found["failed"]}
            continue
        for stage, row in found.pop("rows").items():
            memory = {"peak MB": found["peak"][stage] >> 20, "ready MB": found["peak"]["ready"] >> 20}
            rows[f"{stage}, {name}"] = row | found["sizes"] | memory | {"ready s": found["ready"]}
    return {"points": points, "rows": dict(sorted(rows.items(), key=lambda row: row[0].split(",")[0]))}


def show(figures: dict) -> str:
    """The table."""
    return clocks(figures["rows"], ("vertices", "body", "batch", "window", "peak MB", "ready s", "ready MB"))


POINT = "--point"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == [POINT]:
        try:
            print(json.dumps(point(given[1], int(given[2]), **json.loads(given[3]))))
        except InputError as error:
            print(f"growth: {error}", file=sys.stderr)
            return 2
        return 0
    return run(
        __doc__, benchmark, show, given,
        repeats=(3, "timed calls of two training steps"), timeout=(300, "seconds that a size may take"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

"""What the experiments share: scenes changed field by field, references by simulation, a process for each point, tables."""

from __future__ import annotations

import csv
import hashlib
import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ncs_jax import Run, Scene, scene_from, simulate, summarise
from ncs_jax.dynamics import compare, dynamics
from ncs_jax.evaluation import measure
from ncs_jax.io.npz import write_npz


def changed(scene: Scene, **tables: dict) -> Scene:
    """The scene with some fields of some tables replaced, one table within another by a dict in a dict."""

    def merged(old: dict, new: dict) -> dict:
        inner = {key: merged(old[key], value) for key, value in new.items() if isinstance(value, dict)}
        return old | new | inner

    return scene_from(merged(scene.to_dict(), tables), source=scene.source)


def reference(scene: Scene, motion: str, kept: Path) -> np.ndarray:
    """The scene's garment simulated over a motion, (frames, verts, 3) in m: made once, and read from the folder after that.

    With smooth contact, as it does not converge with any other.
    """
    smooth = changed(scene, physics={"collision": {"distance": "smooth"}}, network={"modes": 0})
    tables = smooth.to_dict()
    told = [motion, scene.motion.fps, *(tables[name] for name in ("body", "garment", "physics", "simulation"))]
    file = kept / f"{hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]}.npz"
    if not file.exists():
        kept.mkdir(parents=True, exist_ok=True)
        write_npz(file, vertices=simulate(smooth, motion).vertices)
    with np.load(file, allow_pickle=False) as arrays:
        return arrays["vertices"]


def judged(run: Run, motion: str, vertices: np.ndarray, simulated: np.ndarray) -> dict[str, float]:
    """Every quantity, and every measure of motion beside the simulation, of an animation of a run's garment."""
    model, track = run.assembly.model, run.track(motion)
    found = summarise(measure(model, vertices, track)) | dynamics(model, vertices, track)
    return found | compare(model, vertices, simulated, track)


def apart(job: Callable, *arguments: Any) -> Any:
    """What a function of a module returns, from a process of its own: its memory and its programs are gone afterwards."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as alone:
        return alone.submit(job, *arguments).result()


def write(out: Path, name: str, rows: Sequence[dict], columns: dict[str, str]) -> None:
    """All of the rows as NAME.csv, and some columns {key: heading} of them as a Markdown table NAME.md."""
    out.mkdir(parents=True, exist_ok=True)
    keys = list(dict.fromkeys(key for row in rows for key in row))
    with (out / f"{name}.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, keys)
        table.writeheader()
        table.writerows(rows)

    def shown(value: Any) -> str:
        return f"{value:.3g}" if isinstance(value, float) else str(value)

    lines = ["| " + " | ".join(columns.values()) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(shown(row.get(key, "")) for key in columns) + " |" for row in rows]
    (out / f"{name}.md").write_text("\n".join(lines) + "\n")

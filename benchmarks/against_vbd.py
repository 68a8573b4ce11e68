"""A simulation's scene for NVIDIA Newton's vertex block descent (VBD), and what that makes of it.

VBD runs in a process of its own, `benchmarks/vbd.py`, by a Python that has the package `newton`; nothing here needs it.
These correspond, which `tests/test_benchmarks_vbd.py` measures: masses, gravity, implicit Euler of one step a frame, stable
neo-Hookean triangles, bending by the dihedral angle, pins that the body carries, and the force of contact at a vertex by its
distance to the nearest triangle of the touchable body. These do not:

- Newton knows no St. Venant-Kirchhoff membrane, and only exact distance to triangles, of vertices alone: `comparable` changes
  a scene to that, with no friction and no self-contact, for all who are compared.
- Between two looks for what is near, VBD's contact is with a plane. Here it looks before every iteration, which costs time;
  by default it would look once a step.
- A fold that passes through itself is not wrapped; triangles below 0.5 mm^2 do not bend; contact is lost 5 cm deep.
- Everything is float32, and seen from the motion's origin, not from the root joint of every frame.
- On a CPU, Warp runs on one core.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from ncs_jax import InputError
from ncs_jax.energies.bending import hinge_weight
from ncs_jax.errors import required
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.scene.model import Model, pose_body
from ncs_jax.scene.spec import Scene

TIMEOUT = 3600  # s
HOW = "pip install newton, and name that Python: --vbd-python PATH"


class Rolled(NamedTuple):
    """What VBD made of a scene with some iterations a frame."""

    vertices: np.ndarray  # (frames - 1, verts, 3), m: all but the start
    seconds: np.ndarray  # of each
    compiling: float  # s


def comparable(scene: Scene) -> tuple[Scene, str]:
    """Return the scene with the laws that both have, and in words what was changed.

    Raises:
        InputError: garments are worn together.
    """
    if scene.garment.layers:
        raise InputError("one garment alone expected", file=scene.source, field="garment.layers", mend="leave them out")
    physics = scene.physics
    new = {
        "membrane.model": "neo_hookean",
        "collision.distance": "triangle",
        "collision.search": "exact",
        "collision.points": "0",
        "collision.friction": 0.0,
        "self_contact.stiffness": 0.0,
    }
    changed = []
    for name, value in new.items():
        table, field = name.split(".")
        spec = getattr(physics, table)
        if getattr(spec, field) != value:
            changed.append(f"{name} = {value!r} in place of {getattr(spec, field)!r}")
            physics = replace(physics, **{table: replace(spec, **{field: value})})
    if not physics.inertia:
        changed.append("inertia = true in place of false")
    return replace(scene, physics=replace(physics, inertia=True)), "; ".join(changed) or "nothing"


def problem_of(model: Model, matrices, start: np.ndarray, **options) -> dict[str, np.ndarray]:
    """Return what `benchmarks/vbd.py` reads: the model's numbers, where body and pins are in every frame, the start at rest.

    options: iterations, and `detect`, how often it looks for contact: each "iteration", or each "frame".
    """
    mesh, material, pins = model.garment.mesh, model.material, model.garment.pins
    lam, mu = material.membrane
    touched = model.surface is not None and model.terms.collision is not None
    body = jax.lax.map(lambda m: pose_body(model, m), matrices) if touched else np.zeros((0, 0, 3))
    pinned = jax.lax.map(lambda m: skin(blend(m, model.blend), mesh.rest)[pins], matrices)
    bends = model.terms.bending
    given = {
        "rest": mesh.rest, "faces": mesh.faces, "hinges": mesh.hinges if bends else np.zeros((0, 4), np.int32),
        "hinge_weight": hinge_weight(mesh, material.bending) if bends else np.zeros(0),
        "mass": material.density * mesh.vertex_area, "lam": lam, "mu": mu, "pins": pins, "pinned": pinned, "body": body,
        "body_faces": required(model.surface, "model.surface").faces if touched else np.zeros((0, 3), np.int32),
        "stiffness": material.collision, "thickness": material.thickness, "gravity": material.gravity, "fps": model.fps,
        "frames": len(matrices), "start": start, "velocity": np.zeros_like(start), **options,
    }  # fmt: skip
    return {name: np.asarray(value) for name, value in given.items()}


def roll(python: str, problem: dict[str, np.ndarray]) -> tuple[list[Rolled], str]:
    """Return what VBD makes of a problem, by each of its numbers of iterations, and what ran it.

    Args:
        python: the path of a Python that has `newton`; empty: this one.

    Raises:
        InputError: there is none, or it failed.
    """
    if not python and find_spec("newton") is None:
        raise InputError("NVIDIA Newton is not installed here, so VBD is left out", mend=HOW)
    with tempfile.TemporaryDirectory() as folder:
        given, answer = (Path(folder) / name for name in ("problem.npz", "answer.npz"))
        write_npz(given, **problem)
        command = [python or sys.executable, str(Path(__file__).with_name("vbd.py")), str(given), str(answer)]
        apart = os.environ | {"PYTHONSAFEPATH": "1"}  # modules here are not to be taken for Newton's
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, env=apart)
        except (OSError, subprocess.TimeoutExpired) as fault:
            raise InputError(f"VBD did not run: {fault}", field="--vbd-python", value=python, mend=HOW) from None
        if done.returncode:
            said = (done.stderr.splitlines() or [f"exit code {done.returncode}"])[-1]
            raise InputError(f"VBD failed: {said}", field="--vbd-python", value=python, mend=HOW)
        with np.load(answer) as file:
            rows = zip(file["vertices"], file["seconds"], file["compiling"], strict=True)
            return [Rolled(x, seconds, float(compiling)) for x, seconds, compiling in rows], str(file["versions"])

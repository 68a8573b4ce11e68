"""The residual of any trajectory, seconds against it in one picture, and vertex block descent on the scene of a simulation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import against_vbd, simulator
from benchmarks.residual import residuals
from ncs_jax import InputError, load_scene
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.solver.minimise import Settings

from .scenes import write_scene
from .simulators import SLEEVE, sleeve, written

NEWTON = os.environ.get("NCS_NEWTON", "")  # a Python that has it
needs_newton = pytest.mark.skipif(not NEWTON and find_spec("newton") is None, reason="needs newton: NCS_NEWTON names a Python")


def test_a_residual_is_what_the_solver_reports(tmp_path):
    """Of its own trajectory, with contact, friction and pins; and more of another one."""
    assembly = sleeve(tmp_path, collision={"distance": "triangle", "friction": 0.3})
    simulation = simulator_from(assembly.model)
    track = jax.tree.map(lambda a: a[:4], assembly.track)
    x, solution = simulate(simulation, track, Settings(tolerance=0.01, exact_pins=True, iterations=3))
    x = np.array(track.relative(x))
    left = residuals(simulation, track.matrices, x, exact_pins=True)
    np.testing.assert_allclose(left, solution.residual[1:], rtol=1e-5)
    x[2, 0, 1] += 1e-3
    other = residuals(simulation, track.matrices, x, exact_pins=True)
    assert other[0] == left[0] and other[1] > left[1] + 1 and other[2] != left[2]  # of that frame, and of the next one's past


def test_a_scene_is_made_comparable(tmp_path):
    scene = load_scene(write_scene(tmp_path))
    same, told = against_vbd.comparable(scene)
    assert told == "membrane.model = 'neo_hookean' in place of 'stvk'; collision.distance = 'triangle' in place of 'plane'"
    assert same.physics.bending == scene.physics.bending and same.physics.membrane.lam == scene.physics.membrane.lam
    assert against_vbd.comparable(same) == (same, "nothing")
    with pytest.raises(InputError, match="one garment alone"):
        against_vbd.comparable(replace(scene, garment=replace(scene.garment, layers=("coat.npz",))))


def comparable_sleeve(folder, bending):
    """A sleeve round a post that nods, of a material that both can have."""
    physics = {"membrane": {"model": "neo_hookean"}, "collision": {"distance": "triangle"}, "bending": {"stiffness": bending}}
    vertices, faces = SLEEVE
    return written(folder, vertices * [0.85, 1, 0.85] + [0, 0.5, 0], faces, range(60, 72), jnp.float32, **physics)


def problem(assembly, **options):
    start = np.asarray(assembly.model.garment.mesh.rest)
    return against_vbd.problem_of(assembly.model, assembly.track.matrices[:3], start, **options)


@needs_newton
@pytest.mark.parametrize("bending", [1e-3, 1e-5])
def test_vbd_comes_to_our_equilibrium(tmp_path, plain_jax, bending):
    """Its residual by our energies falls to next to nothing: membrane, bending, contact and inertia are the same."""
    assembly = comparable_sleeve(tmp_path, bending)
    given = problem(assembly, iterations=np.array([5, 1000]), detect="iteration")
    (few, many), versions = against_vbd.roll(NEWTON, given)
    assert versions.startswith("newton") and few.seconds.shape == (2,) and few.vertices.dtype == np.float32
    simulation = simulator_from(assembly.model)
    left = [
        residuals(
            simulation, assembly.track.matrices[:3], np.concatenate([given["start"][None], rolled.vertices]), exact_pins=True
        )
        for rolled in (few, many)
    ]
    assert (left[0] > 1).all() and (left[1] < 0.02).all(), left


def test_without_newton_vbd_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(against_vbd, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"not installed here.*pip install newton"):
        against_vbd.roll("", {})
    with pytest.raises(InputError, match="did not run"):
        against_vbd.roll(str(tmp_path / "python"), {})
    if find_spec("newton") is None:
        with pytest.raises(InputError, match=r"VBD failed: .*newton"):
            against_vbd.roll(sys.executable, {"iterations": np.array([1])})


def answering(verts, frames):
    """A process that has moved the garment by 1 cm a frame."""

    def process(command, **_):
        moved = 0.01 * np.arange(1, frames)[:, None, None] * np.ones((1, verts, 3))
        runs = len(np.load(command[2])["iterations"])
        times = np.full((runs, frames - 1), 0.5)
        np.savez(
            command[3], vertices=np.tile(moved, (runs, 1, 1, 1)), seconds=times, compiling=np.ones(runs), versions="newton 0"
        )
        return subprocess.CompletedProcess(command, 0, "", "")

    return process


def test_rows_of_vbd(tmp_path, monkeypatch):
    """As the table and the picture show them, beside ours."""
    assembly = sleeve(tmp_path, membrane={"model": "neo_hookean"}, collision={"stiffness": 0.0})
    simulation, matrices = simulator_from(assembly.model), assembly.track.matrices[:3]
    exact = np.zeros((3, *assembly.model.garment.mesh.rest.shape))
    monkeypatch.setattr(against_vbd, "find_spec", lambda name: name)
    monkeypatch.setattr(subprocess, "run", answering(exact.shape[1], 3))
    ours = {"seconds": simulator.spread([1.0, 2.0]) | {"compile": 3.0, "min": 1.0}, "residual": simulator.spread([0.1, 0.2])}
    ours |= {"iterations": {"median": 4.0}, "each": 0.3, "unsolved": 1, "frames": 3, "mm": 0.0}
    rows = {"newton, 0.1 g": ours, "quasi_newton, 9 iterations": ours}
    options = SimpleNamespace(vbd_python="")
    monkeypatch.setattr(simulator, "residuals", lambda *_, **__: np.array([1.0, 2.0]))
    assert simulator.vbd_rows(rows, options, simulation, matrices, exact) == {"vbd": "newton 0"}
    assert list(rows)[2:] == [f"VBD, {n} iterations" for n in (2, 5, 10, 20)]
    last = rows["VBD, 20 iterations"]
    assert last["mm"] == pytest.approx(10 * np.sqrt(3 * 2.5)) and last["each"] == 0.5 / 20 and last["residual"]["max"] == 2
    simulator.draw(rows, "a title", tmp_path / "new" / "x.png")
    assert (tmp_path / "new" / "x.png").stat().st_size > 10_000
    text = simulator.show({"rows": rows | {"VBD": {"failed": "why"}}, "changed": "nothing"})
    assert "VBD: why" in text and "1 of 2" in text and len(text.splitlines()) == 8


@pytest.mark.slow  # nearly all of it is compiling
def test_the_picture(tmp_path, plain_jax, monkeypatch, capsys):
    """One run gives the table and the picture, without VBD where that cannot run."""
    monkeypatch.setattr(simulator, "TOLERANCES", (0.1, 1.0))
    monkeypatch.setattr(simulator, "ITERATIONS", (3,))
    picture, figures = tmp_path / "x.png", tmp_path / "x.json"
    given = [str(write_scene(tmp_path)), "--frames", "3", "--picture", str(picture), "--json", str(figures)]
    assert simulator.main([*given, "--motion", str(tmp_path / "swing.npz"), "--vbd-python", str(tmp_path / "none")]) == 0
    rows = json.loads(figures.read_text())["rows"]
    assert list(rows) == ["newton, 0.1 g", "newton, 1 g", "quasi_newton, 3 iterations", "VBD"] and picture.exists()
    assert rows["newton, 0.1 g"]["mm"] == 0 < rows["newton, 1 g"]["mm"] and rows["newton, 1 g"]["residual"]["max"] <= 1
    assert "did not run" in rows["VBD"]["failed"] and "neo_hookean" in capsys.readouterr().out

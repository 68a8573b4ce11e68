"""What a user waits for before anything happens: help without JAX, a check without programs, kept programs and preparations."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.cli import parser
from ncs_jax.energies.contact.distance import nearest_distance
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.geometry.surface_distance import closest_on_surface, distance_and_direction, signed_distance
from ncs_jax.prepare.kept import kept
from ncs_jax.runs.begin import assemble_run
from ncs_jax.runs.run import Run, assemble
from ncs_jax.scene.model import RitzModes
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.programs import Programs
from ncs_jax.training.step import initial_state

from .scenes import SCENE, swing, write_scene

SOURCE = str(Path(__file__).parents[1] / "src")
WORDS = (["--help"], ["train", "--help"], ["train", "--wrong"], ["nothing"], ["check", "--fields"], ["check", "no.toml"])
MISSING = (
    ["train", "no.toml", "--out", "r"], ["simulate", "no.toml", "--out", "r.npz"], ["evaluate", "no"],
    ["animate", "no", "--out", "a.npz"], ["export", "no", "--out", "a.onnx"], ["preview", "no"], ["view", "no"],
    ["fit", "no.obj", "--out", "a.npz"],
)  # fmt: skip
LIGHT = f"""
import contextlib, json, sys
from ncs_jax.cli.parser import main
for words in {[*WORDS, *MISSING]}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(None):
        main(words)
    print(json.dumps([words, sorted({{"jax", "numpy"}} & set(sys.modules))]))
"""
COUNTED = """
import json, sys
import jax
count = []
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: count.append(name))
from ncs_jax.cli.parser import main
assert main(["check", sys.argv[1]]) == 0
heavy = {"flax", "optax", "orbax"} & set(sys.modules)
print(json.dumps([sum("backend_compile" in name for name in count), sorted(heavy)]))
"""


def printed(script, *arguments, folder):
    line = [sys.executable, "-c", script, *map(str, arguments)]
    done = subprocess.run(
        line, env={**os.environ, "PYTHONPATH": SOURCE}, capture_output=True, text=True, cwd=folder, check=True
    )
    return [json.loads(row) for row in done.stdout.splitlines() if row.startswith("[")]


def test_words_and_missing_files_do_not_wait_for_jax(tmp_path):
    rows = printed(LIGHT, folder=tmp_path)
    assert len(rows) == len(WORDS) + len(MISSING)
    assert not [row for row in rows if row[1]]


def test_a_check_compiles_next_to_nothing_and_loads_no_network(tmp_path):
    """Each program takes 20 ms, or seconds: of the check of a swing there were a hundred, nine of them large."""
    scene = write_scene(tmp_path, SCENE.replace('cell = "gated"', 'cell = "swing"'))
    ((programs, heavy),) = printed(COUNTED, scene, folder=tmp_path)
    assert 0 < programs <= 10 and not heavy


def found_anew(names, make, *given):
    """In the place of `kept`: what a process before has found is not taken."""
    return make()


@pytest.mark.parametrize("person", ["terminal", "notebook", "nobody"])
def test_what_takes_long_is_told_to_a_person(tmp_path, plain_jax, monkeypatch, capsys, person):
    """No vibration is really looked for, and the gated cell replaces the swing. A loaded IPython is no notebook yet."""
    monkeypatch.setattr("ncs_jax.simulation.ritz_modes.softest_ritz_modes", lambda *_: None)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: person == "terminal", raising=False)
    shell = types.SimpleNamespace(get_ipython=lambda: object() if person == "notebook" else None)
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setitem(sys.modules, "ipykernel", shell)
    monkeypatch.setattr("ncs_jax.prepare.build.kept", found_anew)
    scene = load_scene(write_scene(tmp_path, SCENE.replace('cell = "gated"', "")))  # "auto": a swing, if there is one
    assemble(scene)
    said = capsys.readouterr().err
    assert ("ncs_jax: finding the garment's vibrations" in said) == bool(said) == (person != "nobody"), said


def test_a_program_is_compiled_once_and_ahead_for_arguments_of_which_the_shapes_are_known():
    traced = []

    def program(a, b):
        traced.append(a["x"].shape)
        return a["x"] + b

    programs, two, three = Programs(), ({"x": jnp.ones(2)}, 1.0), ({"x": jnp.ones(3)}, 1.0)
    leaves, structure = jax.tree.flatten(two)
    programs.begin("sum", program, [jax.ShapeDtypeStruct((2,), leaves[0].dtype), 1.0], structure, reused=True)
    assert traced == [(2,)]
    found = programs.ready("sum", program, *two, reused=True)
    assert programs.ready("sum", program, *two, reused=True) is found and traced == [(2,)]
    np.testing.assert_array_equal(found(*leaves), [2, 2])
    assert leaves[0].is_deleted()
    np.testing.assert_array_equal(programs.ready("sum", program, *three)(*jax.tree.leaves(three)), [2, 2, 2])
    assert traced == [(2,), (3,)]


def test_what_is_expected_while_vibrations_are_looked_for_is_what_comes(tmp_path, plain_jax, monkeypatch):
    """No vibration is really looked for. Else training would compile its steps twice. They are those of the middle pose."""
    poses = []

    def found(model, matrices, count):
        poses.append(np.asarray(matrices))
        draw = np.random.default_rng(0).normal(size=(len(model.basis), 3, count)) / 100
        slope, drape = jnp.eye(count, dtype=jnp.float32), jnp.asarray(draw[:, :, 0], jnp.float32)
        return RitzModes(jnp.asarray(draw, jnp.float32), jnp.float32(0.01), slope, drape=drape)

    monkeypatch.setattr("ncs_jax.simulation.ritz_modes.softest_ritz_modes", found)
    monkeypatch.setattr("ncs_jax.prepare.build.kept", found_anew)
    scene, begun = load_scene(write_scene(tmp_path, SCENE.replace('cell = "gated"', 'cell = "swing"'))), []
    whole = assemble(scene, ahead=begun.append)
    assert not np.any(begun[0].model.vibrations.directions) and whole.model.vibrations.directions.size
    assert (begun[0].network, begun[0].scene) == (whole.network, whole.scene)
    flat = [jax.tree.flatten((a.model, a.training_features)) for a in (begun[0], whole)]
    kinds = [([(leaf.shape, leaf.dtype) for leaf in leaves], structure) for leaves, structure in flat]
    assert kinds[0] == kinds[1]
    assert whole.track.middle() > 0
    np.testing.assert_array_equal(poses, whole.track.matrices[whole.track.middle()][None])


def test_a_run_from_anothers_weights_looks_for_no_vibrations_where_garment_and_physics_are_the_same(tmp_path, plain_jax):
    """They are that run's, and so is the network. With another material they are looked for."""
    looked, draw = [], np.random.default_rng(0)

    def found(model, matrices, count):
        looked.append(model)
        directions = jnp.asarray(draw.normal(size=(len(model.basis), 3, count)) / 100, jnp.float32)
        return RitzModes(directions, jnp.float32(0.01), jnp.eye(count, dtype=jnp.float32), drape=directions[:, :, 0])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ncs_jax.simulation.ritz_modes.softest_ritz_modes", found)
        patch.setattr("ncs_jax.prepare.build.kept", found_anew)
        first = assemble(load_scene(write_scene(tmp_path, SCENE.replace('cell = "gated"', 'cell = "swing"'))))
        start = Run(first, initial_state(first.model, first.network, 0).params)
        moving = swing()
        moving["trans"][:, 0] += 0.1 * np.arange(len(moving["trans"]))
        np.savez(tmp_path / "walk.npz", **moving)
        other = replace(first.scene, motion=replace(first.scene.motion, files=(str(tmp_path / "walk.npz"),)))
        assembly, _ = assemble_run(other, None, None, start, None, assemble)
        assert len(looked) == 1
        denser = replace(other, physics=replace(other.physics, density=0.3))
        assembled, _ = assemble_run(denser, None, None, start, None, assemble)
        assert len(looked) == 2
    for a, b in zip(jax.tree.leaves(first.model.vibrations), jax.tree.leaves(assembly.model.vibrations), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(assembly.prepared.vibrations, first.prepared.vibrations)
    assert np.any(assembled.prepared.vibrations != first.prepared.vibrations)
    assert (assembly.network, assembly.scene.network) == (first.network, first.scene.network)
    assert not np.array_equal(assembly.track.matrices, first.track.matrices)


def ball(rows=9, around=14):
    """A ball without its lowest cap: a surface with a rim."""
    up, turn = np.linspace(0, 2.4, rows)[1:, None], 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.sin(up) * np.cos(turn), np.cos(up) + 0 * turn, np.sin(up) * np.sin(turn)], axis=-1)
    x = np.concatenate([[[0, 1, 0]], ring.reshape(-1, 3)])
    k, after = np.arange(around), (np.arange(around) + 1) % around
    faces = [np.stack([0 * k, 1 + after, 1 + k], axis=1)]
    for r in range(rows - 2):
        low, high = 1 + r * around, 1 + (r + 1) * around
        faces += [np.stack([low + k, low + after, high + k], axis=1), np.stack([low + after, high + after, high + k], axis=1)]
    return 0.2 * x, np.concatenate(faces).astype(np.int32)


def test_distances_on_the_host_are_those_of_the_program():
    body, faces = ball()
    x = np.random.default_rng(0).normal(size=(400, 3)) * 0.2
    surface = surface_from(x, body, faces)
    border = np.asarray(surface.border)
    expected = np.asarray(jax.jit(nearest_distance)(jnp.asarray(x), jnp.asarray(body), surface))
    assert (expected < -0.02).sum() > 30 and border.any()
    found = signed_distance(x, body, faces, border)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    near = signed_distance(x, body, faces, border, 0.05)
    far = near == 0.05
    assert 50 < far.sum() < 350 and (expected[far] > 0).all()
    np.testing.assert_allclose(near[~far], expected[~far], atol=1e-12)
    away = np.asarray(jax.jit(jax.grad(lambda x: nearest_distance(x, jnp.asarray(body), surface).sum()))(jnp.asarray(x)))
    same, lead = distance_and_direction(x, body, faces, border)
    np.testing.assert_array_equal(same, found)
    np.testing.assert_allclose(lead, away, atol=1e-9)
    ahead = distance_and_direction(body[faces].mean(axis=1), body, faces, border)[1]
    corner = body[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    size = np.linalg.norm(normal, axis=1)
    assert (np.sum(ahead * normal, axis=1) > 0.999 * size)[size > 0].all()  # on the surface itself


def test_the_closest_point_is_on_its_triangle():
    body, faces = ball()
    x = np.random.default_rng(1).normal(size=(50, 3))
    points = closest_on_surface(x, body, faces)
    there = np.einsum("nk,nkd->nd", points.weights, body[faces[points.face]])
    np.testing.assert_allclose(points.weights.sum(axis=1), 1)
    assert (points.weights >= 0).all()
    np.testing.assert_allclose(x - there, points.gap, atol=1e-12)


@pytest.fixture
def folder_of_programs(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "programs"))
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


def test_what_was_found_is_found_again_and_only_that(folder_of_programs):
    calls = []

    def found():
        calls.append(1)
        return {"a": np.arange(3.0) + len(calls)}

    first = kept(("a",), found, np.ones(2), 3)
    assert kept(("a",), found, np.ones(2), 3)["a"].tolist() == first["a"].tolist() and len(calls) == 1
    for other in ((np.ones(2), 4), (np.ones(2, np.float32), 3), (np.ones((2, 1)), 3), ([np.ones(2)], 3)):
        kept(("a",), found, *other)
    assert len(calls) == 5
    (file, *_) = folder_of_programs.iterdir()
    for file in folder_of_programs.iterdir():
        file.write_bytes(file.read_bytes()[:50])
    assert kept(("a",), found, np.ones(2), 3)["a"].tolist() == [6, 7, 8]  # a damaged file is made again
    assert kept(("a",), lambda: None, np.zeros(1)) is None
    assert len(list(folder_of_programs.iterdir())) == 5


VARIABLES = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "TF_CPP_MIN_LOG_LEVEL")


def test_commands_keep_programs_in_a_folder_of_bounded_size(tmp_path, monkeypatch):
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # so that what the function sets goes again
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(parser, "KEPT", 25)
    (tmp_path / "ncs-jax").mkdir()
    for age, name in enumerate("abcd"):
        (tmp_path / "ncs-jax" / name).write_bytes(bytes(10))
        os.utime(tmp_path / "ncs-jax" / name, (1000 - age, 1000 - age))
    parser._keep_compiled_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(tmp_path / "ncs-jax")
    assert sorted(os.listdir(tmp_path / "ncs-jax")) == ["a", "b"]
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "ncs-jax" / "a"))  # a file: no folder can be made in it
    parser._keep_compiled_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_what_jaxlib_logs_without_consequence_is_hidden_before_jax_is_there(monkeypatch):
    for found, level in (("0.10.1", "3"), ("0.11.0", None)):
        monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "")
        monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
        monkeypatch.setattr(parser, "version", lambda _, found=found: found)
        parser.quieten_jaxlib()
        assert os.environ.get("TF_CPP_MIN_LOG_LEVEL") == level
    code = "import experiments, sys; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])

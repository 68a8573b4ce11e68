"""Run folders: a run killed at any moment and resumed ends at the weights of the unbroken one."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import jax
import numpy as np
import pytest

from ncs_jax.errors import InputError
from ncs_jax.network.rollout import stepper
from ncs_jax.runs.checkpoint import Checkpoints, write_run
from ncs_jax.runs.run import load_run
from ncs_jax.runs.train import train
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.devices import free_memory
from ncs_jax.training.step import initial_state

from .scenes import FREE, write_scene

STEPS = 60
SOURCE = Path(__file__).parents[1] / "src"


def command(scene, out, *more):
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    line = [sys.executable, "-m", "ncs_jax.cli", "train", str(scene), "--out", str(out), "--steps", str(STEPS), *more]
    return subprocess.Popen(line, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process):
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output


def leaves(out):
    return [np.asarray(p) for p in jax.tree.leaves(load_run(out).params)]


def same(a, b):
    return all(np.array_equal(p, q) for p, q in zip(leaves(a), leaves(b), strict=True))


def writing(out):
    """Whether a checkpoint is being written right now."""
    folder = out / "checkpoints"
    return folder.is_dir() and any("tmp" in p.name for p in folder.iterdir())


def kill_while(process, out, when, limit=120):
    """SIGKILL as soon as `when()` holds; whether it came to that."""
    end = time.monotonic() + limit
    while process.poll() is None and time.monotonic() < end:
        if when():
            process.send_signal(signal.SIGKILL)
            process.communicate()
            return True
        time.sleep(0.0005)
    process.communicate()
    return False


def killed_and_resumed(folder, scene, kills):
    """Kill a run by each of `kills` in turn (seconds after its start, or "write"), then let it finish."""
    out, done = folder / "killed", []
    for kill in kills:
        process = command(scene, out, *(["--resume"] if (out / "run.json").exists() else []))
        start = time.monotonic()
        when = (lambda: writing(out)) if kill == "write" else (lambda s=start, k=kill: time.monotonic() - s > k)
        done.append(kill_while(process, out, when))
    if (out / "run.json").exists():
        finish(command(scene, out, "--resume"))
    else:
        finish(command(scene, out))
    return out, done


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    scene = write_scene(folder, FREE)
    out = folder / "run"
    start = time.monotonic()
    finish(command(scene, out))
    return scene, out, time.monotonic() - start


def test_a_seed_makes_a_run_repeatable_bit_for_bit(unbroken, plain_jax):
    """In another process too."""
    scene, out, _ = unbroken
    again, other = (jax.tree.leaves(train(scene, None, steps=STEPS, seed=seed).params) for seed in (0, 1))
    assert all(np.array_equal(a, b) for a, b in zip(leaves(out), again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(leaves(out), other, strict=True))


def test_killed_within_a_write_and_resumed(unbroken, tmp_path, plain_jax):
    scene, reference, seconds = unbroken
    out, done = killed_and_resumed(tmp_path, scene, ["write", 0.8 * seconds])
    assert done[0]
    assert same(out, reference)
    with (out / "log.csv").open() as file:
        steps = [int(row["step"]) for row in csv.DictReader(file)]
    assert steps == list(range(10, STEPS + 1, 10))


@pytest.mark.slow
def test_killed_at_ten_moments_and_resumed(unbroken, tmp_path, plain_jax):
    scene, reference, seconds = unbroken
    moments = np.random.default_rng(7).uniform(0.1, 0.95, 8) * seconds
    kills = [*moments[:3], "write", *moments[3:6], "write", *moments[6:]]
    out, done = killed_and_resumed(tmp_path, scene, kills)
    print("killed:", [(k if k == "write" else round(float(k), 2), d) for k, d in zip(kills, done, strict=True)])
    assert sum(d for k, d in zip(kills, done, strict=True) if k == "write") == 2
    assert same(out, reference)


def test_a_run_is_not_overwritten(tmp_path, plain_jax):
    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    train(scene, out, steps=10)
    with pytest.raises(InputError, match="--resume"):
        train(scene, out, steps=10)
    with pytest.raises(InputError, match="no run to resume"):
        train(scene, tmp_path / "other", steps=10, resume=True)
    run = load_run(out)
    assert run.steps == 10
    vertices = run.animate(str(tmp_path / "swing.npz"), alpha=1)
    assert vertices.shape == (24, 30, 3) and np.isfinite(vertices).all()
    with pytest.raises(InputError, match=r"track: .*assemble its scene"):
        _ = run.assembly.track


def test_a_checkpoint_of_orbax_0_is_read_and_gone_on_with(tmp_path, plain_jax):
    """Runs of version 0.1 were written so: with the first of Orbax's two APIs, and its own folder of checkpoints."""
    import orbax.checkpoint as orbax_0

    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    whole = train(scene, out, steps=20)
    folder = out / "checkpoints"
    assert sorted(p.name for p in folder.iterdir()) == ["10", "20"]
    shutil.rmtree(folder / "20")
    state = Checkpoints(out).restore(initial_state(whole.assembly.model, whole.assembly.network, 0))
    assert int(state.step) == 10
    shutil.rmtree(folder / "10")
    options = orbax_0.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False, create=False)
    with orbax_0.CheckpointManager(folder, options=options) as manager:
        manager.save(10, args=orbax_0.args.StandardSave(jax.tree.map(np.asarray, state)))
    assert (folder / "10" / "default").is_dir()
    old = load_run(out)
    assert old.steps == 10 and all(map(np.array_equal, jax.tree.leaves(old.params), jax.tree.leaves(state.params)))
    resumed = train(scene, out, resume=True)
    assert all(map(np.array_equal, jax.tree.leaves(resumed.params), jax.tree.leaves(whole.params)))


def test_two_checkpoints_are_kept_and_what_a_kill_left_is_removed(tmp_path, plain_jax):
    checkpoints, folder = Checkpoints(tmp_path), tmp_path / "checkpoints"
    assert checkpoints.latest() is None
    (folder / "9.orbax-checkpoint-tmp").mkdir()
    (folder / "9.orbax-checkpoint-tmp" / "half").write_text("")
    for step in (9, 10, 100):
        checkpoints.save(step, {"a": np.full(3, step, np.float32)})
        assert checkpoints.latest() == step
    assert sorted(p.name for p in folder.iterdir()) == ["10", "100"]
    like = {"a": jax.ShapeDtypeStruct((3,), np.float32)}
    np.testing.assert_array_equal(checkpoints.restore(like)["a"], np.full(3, 100))
    with pytest.raises(InputError, match=r"100: the checkpoint cannot be read: .*shape"):
        checkpoints.restore({"a": jax.ShapeDtypeStruct((4,), np.float32)})


@pytest.mark.parametrize("damaged", [False, True])
def test_reading_a_checkpoint_gives_pythons_hook_back(tmp_path, plain_jax, monkeypatch, damaged):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": np.ones(3, np.float32)})
    if damaged:
        shutil.rmtree(tmp_path / "checkpoints" / "1" / "default")

    def hook(what):
        raise AssertionError(what)

    monkeypatch.setattr(sys, "unraisablehook", hook)
    with pytest.raises(InputError, match="cannot be read") if damaged else nullcontext():
        checkpoints.restore({"a": jax.ShapeDtypeStruct((3,), np.float32)})
    assert sys.unraisablehook is hook


def test_killed_before_anything_was_prepared_a_run_goes_on(tmp_path, plain_jax):
    """Between its first two files: run.json is there, prepared.npz is not."""
    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    write_run(out, {"steps": 0, "seed": 0, "scene": load_scene(scene).to_dict()})
    train(scene, out, steps=10, resume=True)
    assert load_run(out).steps == 10


def test_minutes_choose_the_steps(tmp_path, plain_jax):
    scene, seen = write_scene(tmp_path, FREE), []
    began = time.monotonic()
    run = train(scene, tmp_path / "run", minutes=0.1, report=seen.append)
    assert seen[-1].step == seen[-1].steps == run.steps and run.steps % 10 == 0
    assert time.monotonic() - began < 4 * 15  # an estimate, on a machine that may be doing other things
    assert seen[-1].validation is not None and seen[-1].left == 0


def test_what_does_not_fit_into_memory_is_said_before_anything_is_written(tmp_path, plain_jax, monkeypatch):
    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    monkeypatch.setattr("ncs_jax.training.devices.free_memory", lambda: 1000)
    with pytest.raises(InputError, match=r"training.batch: training does not fit into memory.*1e-06 GB are free"):
        train(scene, out, steps=10)
    assert not out.exists() or not any(out.iterdir())
    monkeypatch.undo()
    assert free_memory() > 10**6
    train(scene, out, steps=10)


def test_a_first_frame_takes_few_programs(tmp_path, plain_jax):
    """Each costs a process that starts some 10 ms, cached or not; array by array, loading would compile over fifty."""
    train(write_scene(tmp_path, FREE), tmp_path / "run", steps=10)
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: compiled.append(name))
    jax.clear_caches()
    compiled.clear()
    run = load_run(tmp_path / "run")
    init, step = stepper(run.assembly.model, run.assembly.network, run.params)
    eye = np.broadcast_to(np.eye(3, dtype=np.float32), (2, 3, 3))
    jax.block_until_ready(jax.jit(step)(init(), eye, np.zeros(3, np.float32), 1.0))
    count = compiled.count("/jax/core/compile/backend_compile_duration")
    assert 2 <= count <= 12

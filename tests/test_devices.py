"""Training on several devices and in several processes ends where one device does, and goes on from its checkpoints."""

import csv
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from ncs_jax.errors import InputError
from ncs_jax.runs.run import load_run
from ncs_jax.runs.train import train
from ncs_jax.training.devices import batch_mesh
from ncs_jax.training.step import initial_state

from .scenes import SCENE, write_scene

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1] / "src"), "JAX_PLATFORMS": "cpu"}
MIXED = SCENE.replace("window = 5", "window = 5\nmotion_augmentation = 0.3")  # a device has windows of both kinds
BARE = MIXED.replace('validation = ["swing.npz"]', "") + "[physics.collision]\nstiffness = 0"  # compiles in half the time

EIGHT = """
import dataclasses, json, sys
import jax, jax.numpy as jnp, numpy as np
from ncs_jax.runs.run import assemble
from ncs_jax.training.devices import batch_mesh, local, replicate, shard_batch
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.batches import batches
from ncs_jax.training.step import chunk_runner, initial_state

jax.config.update("jax_enable_x64", sys.argv[2] == "float64")
assembly = assemble(load_scene(sys.argv[1]), dtype=jnp.dtype(sys.argv[2]))
model, network, track, spec = assembly.model, assembly.network, assembly.track, assembly.scene.training
frames = track.start.shape[0]
ends = batches(frames, spec.batch, 0, 0, 10)[:, ::-1].copy()
pairs = np.stack([np.random.default_rng(s).permutation(spec.batch) for s in range(10)]).astype(np.int32)
broken = dataclasses.replace(track, matrices=track.matrices.at[frames - 1].set(jnp.nan))
seen = []
for mesh in (None, batch_mesh(spec.batch)):
    run, state = chunk_runner(network, spec, mesh), replicate(mesh, initial_state(model, network, 0))
    for motion in (track, broken):
        state, logs = run(state, *shard_batch(mesh, (ends, pairs)), 100, *replicate(mesh, (model, motion)))
        seen.append(jax.tree.map(np.asarray, (state, logs)))
        for leaf in jax.tree.leaves(state):
            assert leaf.is_fully_replicated
            copies = [np.asarray(shard.data) for shard in leaf.addressable_shards]
            assert len(copies) == (8 if mesh else 1) and all(np.array_equal(c, copies[0]) for c in copies)
    assert isinstance(local(mesh, state).step.sharding, jax.sharding.SingleDeviceSharding)
one, broken_one, eight, broken_eight = seen

def error(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(np.abs(p - q).max() / (np.abs(p).max() + 1e-30)) for p, q in pairs)

print(json.dumps({
    "size": [mesh and mesh.size for mesh in map(batch_mesh, (1, 6, 8, 11, 12))],
    "params": error(one[0].params, eight[0].params),
    "logs": error(one[1], eight[1]),
    "after": error(broken_one[0].params, broken_eight[0].params),
    "dropped": [int(s[0].dropped) for s in seen],
    "bad": int(np.sum(np.any(ends == frames - 1, axis=1))),
    "column": int(np.argwhere(ends == frames - 1)[-1, 1]),
    "fault": [[int(s[0].fault.step), int(s[0].fault.frame)] for s in seen],
    "offsets": error(broken_one[0].fault.offsets, broken_eight[0].fault.offsets),
}))
"""


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-4), ("float64", 1e-11)])
def test_eight_devices_take_the_steps_of_one(tmp_path, dtype, tolerance):
    """In float64 too, which tells rounding from another result: of a gradient that is pure rounding Adam makes full steps."""
    scene = write_scene(tmp_path, MIXED.replace("batch = 4", "batch = 16"))
    environment = {**ENVIRONMENT, "JAX_NUM_CPU_DEVICES": "8"}
    line = [sys.executable, "-c", EIGHT, str(scene), dtype]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["size"] == [None, 6, 8, None, 6]
    assert max(found["logs"], found["params"] / 50, found["after"] / 50, found["offsets"] / 50) < tolerance, found
    assert found["dropped"] == [0, found["bad"]] * 2 and 0 < found["bad"] < 10
    assert found["column"] >= 2  # what the fault is about lies on another device than the first
    assert found["fault"][:2] == found["fault"][2:] and found["fault"][1][1] == 23


def command(rank, scene, out, port, *more):
    """One of two processes that train together."""
    line = [sys.executable, "-m", "ncs_jax.cli", "train", str(scene), "--out", str(out), "--steps", "20", *more]
    line += ["--hosts", f"127.0.0.1:{port},2,{rank}"]
    return subprocess.Popen(line, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@contextmanager
def started(scene, out, *more):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    processes = [command(rank, scene, out, port, *more) for rank in range(2)]
    try:
        yield processes
    finally:
        for p in processes:
            p.kill()
            p.communicate()


def together(scene, out, *more):
    with started(scene, out, *more) as processes:
        outputs = [p.communicate(timeout=300)[0] for p in processes]
    return [p.returncode for p in processes], outputs


def test_two_processes_train_what_one_does_and_resume(tmp_path, plain_jax):
    scene = write_scene(tmp_path, BARE)
    out = tmp_path / "run"
    codes, (first, second) = together(scene, out)
    assert codes == [0, 0], first + second
    assert "training on 2 of 2 devices" in first and "step 20/20" in first
    assert "step" not in second and "training" not in second
    run = load_run(out)
    both = jax.tree.leaves(run.params)
    shutil.rmtree(out / "checkpoints" / "20")
    codes, (first, second) = together(scene, out, "--resume")
    assert codes == [0, 0], first + second
    assert all(np.array_equal(a, b) for a, b in zip(both, jax.tree.leaves(load_run(out).params), strict=True))
    with (out / "log.csv").open() as file:
        rows = [(int(row["step"]), float(row["total"])) for row in csv.DictReader(file)]
    reports = []
    one = jax.tree.leaves(train(scene, None, steps=20, report=reports.append).params)
    np.testing.assert_allclose(rows, [(r.step, sum(r.energies.values())) for r in reports], rtol=1e-5)
    start = jax.tree.leaves(initial_state(run.assembly.model, run.assembly.network, 0).params)
    # Of the way from the start: what no energy depends on moves by Adam's steps along pure rounding.
    error, way = (np.sqrt(sum(np.sum((a - b) ** 2) for a, b in zip(one, c, strict=True))) for c in (both, start))
    assert error < 0.01 * way


def test_where_one_process_dies_the_other_says_so_and_ends(tmp_path):
    scene, out = write_scene(tmp_path, BARE), tmp_path / "run"
    with started(scene, out, "--steps", "100000") as (first, second):
        limit = time.monotonic() + 200
        while not (out / "checkpoints" / "10").exists() and time.monotonic() < limit and first.poll() is None:
            time.sleep(0.1)
        second.kill()
        said = first.communicate(timeout=30)[0]
    assert first.returncode == 2, said
    assert "ncs: --hosts: training with the other hosts broke off" in said and "--resume" in said and "Traceback" not in said
    assert load_run(out).steps >= 10


@pytest.mark.parametrize(
    ("batch", "devices", "size"), [(32, (4, 4), 8), (12, (4, 4), 6), (4, (4, 4), 4), (6, (3, 4), 6), (2, (1, 1), 2)]
)
def test_every_host_has_as_many_devices_of_the_mesh(monkeypatch, batch, devices, size):
    every = [SimpleNamespace(process_index=p) for p, n in enumerate(devices) for _ in range(n)]
    monkeypatch.setattr(jax, "devices", lambda: every)
    monkeypatch.setattr(jax, "process_count", lambda: len(devices))
    monkeypatch.setattr("ncs_jax.training.devices.Mesh", lambda chosen, axes: chosen)
    chosen = batch_mesh(batch)
    assert len(chosen) == size
    assert [sum(d.process_index == p for d in chosen) for p in range(2)] == [size // 2, size // 2]


def test_hosts_that_do_not_divide_the_batch(monkeypatch):
    every = [SimpleNamespace(process_index=p) for p in range(2)]
    monkeypatch.setattr(jax, "devices", lambda: every)
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    with pytest.raises(InputError, match=r"training.batch: a multiple of the number of hosts, 2, expected \(found 5\)"):
        batch_mesh(5)

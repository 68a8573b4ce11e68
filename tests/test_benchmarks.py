"""Benchmarks at their smallest size, and what they share."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import growth, inference, quality, scale, simulator, start, training, work
from benchmarks.cost import counted
from benchmarks.measure import COPIES, Limits, Work, apart, looped, nudged, table, timed
from experiments import seeds
from ncs_jax import assemble, io, load_scene, scene_from, train
from ncs_jax.network.methods.method import decode, for_inference
from ncs_jax.simulation.solver.cholesky import elimination
from ncs_jax.training.step import initial_state

from .scenes import FREE, SCENE, write_scene


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def figures(benchmark, folder, *options):
    """Run a benchmark as from the command line."""
    out = folder / "figures.json"
    assert benchmark.main([str(write_scene(folder)), "--quick", "--json", str(out), *options]) == 0
    result = json.loads(out.read_text())
    assert result["machine"]["processor"] and result["machine"]["cores"] >= 1 and result["versions"]["jax"] == jax.__version__
    for row in result["rows"].values():
        t = row["seconds"]
        assert 0 < t["min"] <= t["median"] <= t["p99"] <= t["max"] and t["compile"] >= 0 and t["repeats"] >= 1
        assert row["share"] == pytest.approx(row["least"] / t["median"]) and row["share"] > 0
    assert benchmark.main([str(folder / "nowhere.toml")]) == 2  # which is no scene
    return result


def test_start(tmp_path, capsys):
    train(write_scene(tmp_path, FREE), tmp_path / "run", steps=10)
    assert start.main([str(tmp_path / "run"), "--repeats", "1", "--json", str(tmp_path / "x.json")]) == 0
    rows = json.loads((tmp_path / "x.json").read_text())
    assert list(rows) == ["import jax", "import ncs_jax", "load_run", "first frame", "all"]
    assert all(row["wall"] > 0 and row["cpu"] > 0 for row in rows.values())
    assert rows["all"]["wall"] == pytest.approx(sum(row["wall"] for row in list(rows.values())[:4]))
    assert "first frame" in capsys.readouterr().out
    assert start.main([str(tmp_path), "--repeats", "1"]) == 2
    assert "no run there" in capsys.readouterr().err


def test_training(tmp_path, capsys):
    result = figures(training, tmp_path, "--repeats", "1")
    absent = {"friction", "pinning", "self_contact"}
    assert set(result["rows"]) == set(work.training(*_fresh(tmp_path))) - absent
    assert result["vertices"] == 30 and result["peak memory MB"] > 100
    out = capsys.readouterr().out
    assert "\n      contact query" in out and "the parts of a step come to" in out and "Gflop/s" in out
    assert training.main([str(tmp_path / "scene.toml"), "--json", str(tmp_path / "none" / "x.json")]) == 2
    assert "no such folder" in capsys.readouterr().err


def test_training_by_batch(tmp_path, capsys):
    rows = figures(training, tmp_path, "--repeats", "1", "--batches", "6")["rows"]
    assert list(rows) == ["step, batch 6"]
    row = rows["step, batch 6"]
    assert row["windows/s"] == pytest.approx(6 / row["seconds"]["median"])
    assert "windows/s" in capsys.readouterr().out


def _fresh(folder, text=SCENE):
    assembly = assemble(load_scene(write_scene(folder, text)))
    ends = np.arange(min(4, len(assembly.track.start)), dtype=np.int32)
    return assembly, initial_state(assembly.model, assembly.network, 0).params, ends


EVERY = SCENE + '[physics.collision]\nfriction = 0.3\ndistance = "smooth"\n[physics.self_contact]\nstiffness = 20\n'
STILL = SCENE.replace('files = ["swing.npz"]', "files = []").replace('validation = ["swing.npz"]', "")

SWINGING = FREE.replace('cell = "gated"', 'cell = "swing"').replace("[garment]", '[garment]\npins = "pins"')


@pytest.mark.parametrize(
    ("text", "there"),
    [
        (EVERY.replace("smoothing = 2", 'smoothing = 2\npins = "pins"'), {"friction", "pinning", "self_contact"}),
        (STILL, {"network", "contact query"}),
        (SWINGING, {"network", "membrane"}),
    ],
)
def test_training_with_other_terms(tmp_path, text, there):
    """Every part can be traced, its derivative too. A swing is told to the motions, and inertia is its own."""
    assembly = training.ready(load_scene(write_scene(tmp_path, text)))
    state, ends = initial_state(assembly.model, assembly.network, 0), np.zeros(1, np.int32)
    parts = training.parts(assembly, state, jnp.asarray(ends), jnp.zeros_like(ends))
    for function, *arguments in parts.values():
        jax.eval_shape(lambda *a, f=function: jax.tree.leaves(f(*a)), *arguments)
    assert there <= set(parts) and ("inertia" in parts) == (text not in (STILL, SWINGING))


def test_the_work_of_a_network_is_that_of_its_products(tmp_path):
    """As XLA counts it of the layers alone."""
    assembly, _, ends = _fresh(tmp_path, SCENE.replace("[16, 16]", "[256, 256]").replace("decoder = [16]", "decoder = [512]"))
    model, network = assembly.model, assembly.network
    params = initial_state(model, network, 0).params
    network, merged = for_inference(network, params, model)
    needed = work.inference(model, merged, 1)

    def layers(static, dynamic, code):
        return decode(
            network, merged, model, network.step(merged, model, code, static, dynamic, track.matrices[0])[1].together()
        )

    track = assembly.track
    lowered = jax.jit(layers).lower(track.static[0], track.dynamic[0], jnp.zeros(network.dynamic.state))
    products = needed.flops - 24 * work.weights(model.blend)
    assert products < counted(lowered)["flops"] < 1.05 * products
    assert work.inference(model, merged, 4).flops == 4 * needed.flops
    assert work.inference(model, merged, 4).bytes < 1.1 * needed.bytes
    step = work.training(assembly, params, ends)
    assert step["network"].flops < step["step"].flops and step["step"].bytes == 24 * sum(map(jnp.size, jax.tree.leaves(params)))


def test_frames_that_windows_share_count_once(tmp_path):
    assembly, params, _ = _fresh(tmp_path)
    far, close = (work.training(assembly, params, np.asarray(e))["network"].flops for e in ([8, 23], [22, 23]))
    assert close < far


def test_inference(tmp_path, capsys):
    rows = figures(inference, tmp_path, "--repeats", "2", "--rank", "2", "--characters", "1", "3")["rows"]
    smaller = rows["streamed, rank 2, bfloat16"]
    assert {
        "whole motion, float32, a frame",
        "whole motion, rank 2, bfloat16, a frame",
        "3 at once, float32, each",
        "3 at once, rank 2, bfloat16, each",
    } < set(rows)
    assert rows["streamed, float32"]["mm max"] == 0 < smaller["mm mean"] < smaller["mm max"] < 20
    assert "frames/s" in capsys.readouterr().out


def test_quality(tmp_path, capsys):
    result = figures(quality, tmp_path, "--energies", "1e9", "-1000")
    first, second = result["snapshots"]
    assert (first["step"], second["step"], result["dropped"]) == (10, 20, 0)
    assert 0 < first["seconds"] < second["seconds"] and first["total"] != second["total"]
    easy, never = result["reached"]
    assert easy["step"] == 10 and easy["seconds"] == first["seconds"] and "step" not in never
    assert "not" in capsys.readouterr().out
    same = seeds.measure(train(load_scene(tmp_path / "scene.toml"), steps=20, seed=1))
    assert second["total"] == pytest.approx(same["total"], rel=1e-5)


def test_growth(tmp_path, capsys):
    result = figures(growth, tmp_path)
    assert set(result["rows"]) == {"frame, the scene", "step, the scene"}
    (point,) = result["points"]
    assert point["sizes"] == {"vertices": 30, "body": 92, "batch": 4, "window": 5} and point["peak"]["step"] > 1e8
    assert "peak MB" in capsys.readouterr().out
    assert "no such scene file" in apart("benchmarks.growth", ["--point", str(tmp_path / "no.toml"), "1", "{}"], 100)["failed"]
    assert "longer than" in apart("benchmarks.growth", ["--point", str(tmp_path / "scene.toml"), "1", "{}"], 0.1)["failed"]


def test_motions_are_made_as_amass_lays_them_out(tmp_path):
    assert scale.make_motions(tmp_path, 0.2, 12) == 360
    found = scene_from({"motion": {"files": [str(tmp_path)]}}).motion
    assert len(found.files) == 12 and "12 shape.npz" in found.found[0]
    records = [io.read_motion(name) for name in found.files]
    assert sum(len(r.poses) for r in records) == 360 and {r.poses.shape[1] for r in records} == {31}
    assert max(np.abs(np.diff(r.poses[:, 1:], axis=0)).max(initial=0) for r in records) < 0.5  # rad; none jumps


def test_finer_scenes_have_more_of_the_same(tmp_path):
    scene = load_scene(write_scene(tmp_path))
    fine = growth.finer(scene, tmp_path, garment=16, body=4)
    coarse, cloth = (io.read_garment(s.path(s.garment.file)) for s in (scene, fine))
    assert len(cloth.faces) == 16 * len(coarse.faces)
    before, body = (io.read_body(s.path(s.body.file)) for s in (scene, fine))
    assert len(body.faces) == 4 * len(before.faces) and np.allclose(body.weights.sum(axis=1), 1)
    assert assemble(fine).model.garment.mesh.rest.shape == (357, 3)
    assert growth.finer(scene, tmp_path) == scene and replace(fine, garment=scene.garment, body=scene.body) == scene


@pytest.mark.slow  # nearly all of it is compiling
def test_the_simulator(tmp_path, capsys):
    (row,) = figures(simulator, tmp_path)["rows"].values()
    assert row["iterations"]["max"] <= 9 and "quasi_newton" in capsys.readouterr().out
    assert simulator.main([str(tmp_path / "scene.toml"), "--frames", "4", "--json", str(tmp_path / "both.json")]) == 0
    newton, quasi = json.loads((tmp_path / "both.json").read_text())["rows"].values()
    assert newton["residual"]["max"] < 0.1 and newton["work"]["flops"] > quasi["work"]["flops"] > 0


def test_the_work_of_a_factor_is_that_of_a_dense_one_where_all_are_coupled():
    n = 12
    order = elimination(np.stack(np.triu_indices(n, 1), axis=1), np.random.default_rng(0).normal(size=(n, 3)))
    factor, solve = work.factor(order, 3, 4)
    assert factor.flops == pytest.approx((3 * n) ** 3 / 3) and factor.bytes == 4 * 3 * n * (3 * n + 1) / 2
    assert solve.bytes == 2 * factor.bytes


# --- the clock and the limits -------------------------------------------------------------------------------------------


def test_a_loop_does_the_work_every_round():
    """Sixteen times the rounds take far longer: nothing is hoisted, and nothing that nobody reads is left out."""
    a = jnp.ones((256, 256))
    seconds = {}
    for rounds in (4, 64):
        t = looped(lambda x, a: (jnp.sin(x @ a), x @ x), a, a, repeats=5, rounds=rounds)
        seconds[rounds] = rounds * t["min"]
    assert seconds[64] > 6 * seconds[4]


def test_a_loop_gives_what_its_function_gives(monkeypatch):
    seen = []
    monkeypatch.setattr(jax, "block_until_ready", lambda x: seen.append(jax.tree.map(np.asarray, x)))
    looped(lambda x: {"y": x**2, "index": jnp.arange(3)}, jnp.array([3.0, 4.0]), repeats=1, rounds=2)
    inputs, (index, y) = seen[-1]
    np.testing.assert_array_equal(inputs, [3, 4])  # the nudge is far below their precision
    np.testing.assert_array_equal(y, [9, 16])
    np.testing.assert_array_equal(index, [0, 1, 2])
    tree = nudged({"a": jnp.zeros((2, 2)), "i": jnp.zeros(2, jnp.int32)}, jnp.ones(()))
    np.testing.assert_array_equal(tree["a"], [[1, 0], [0, 0]])
    assert not tree["i"].any()


def test_compiling_is_apart(monkeypatch):
    now = iter([0.0, 10.0, 10.0, 11.0, 11.0, 13.0, 13.0, 16.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(now))
    t = timed(lambda: None, repeats=3, count=2)
    assert (t["min"], t["median"], t["max"], t["compile"], t["repeats"]) == (0.5, 1.0, 1.5, 8.0, 3)


def test_the_least_time_is_the_longer_of_two():
    limits = Limits(flops=1e9, copies={COPIES[0]: 4e9, COPIES[2]: 1e9})
    assert limits.least(Work(2e9, 1e6)) == 2
    assert limits.least(Work(0, 2e9)) == 2  # beyond every cache
    assert limits.least(Work(0, 4e3)) == 1e-6  # fits into one
    assert limits.best(Limits(2e9, {COPIES[0]: 1e9, COPIES[2]: 2e9})) == Limits(2e9, {COPIES[0]: 4e9, COPIES[2]: 2e9})


def test_a_table_is_aligned():
    lines = table(["", "x", "y"], [["a", 1.23456, None], ["long", 12345.6, "no"]], 6).splitlines()
    assert lines == ["          x      y", "a      1.23", "long  12346     no"]

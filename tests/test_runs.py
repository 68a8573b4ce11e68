"""Run folders: a run killed at any moment and resumed ends at the weights of the unbroken one."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from ncs_jax.errors import InputError, InputWarning
from ncs_jax.network.rollout import stepper
from ncs_jax.runs import train as runs_train
from ncs_jax.runs.begin import assemble_run, resumed_scene
from ncs_jax.runs.checkpoint import Checkpoints, read_run, write_run
from ncs_jax.runs.plan import EARLY, Costs, Minutes, steps_within
from ncs_jax.runs.pose_stiffness import poses_of
from ncs_jax.runs.run import Run, assemble, load_run
from ncs_jax.runs.train import train
from ncs_jax.scene.spec import PRESETS, load_scene
from ncs_jax.training.devices import free_memory
from ncs_jax.training.step import initial_state

from .scenes import FREE, SCENE, grid, post, swing, write_scene

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


def test_a_process_with_64_bits_trains_too(tmp_path, plain_jax):
    """A notebook may have them: the numbers of a batch's frames stay of 32."""
    with jax.enable_x64(True):
        run = train(write_scene(tmp_path, FREE), steps=10)
    assert run.steps == 10 and np.isfinite(run.animate(run.assembly.scene.motion.files[0])).all()


def test_a_run_is_not_overwritten(tmp_path, plain_jax):
    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    train(scene, out, steps=10)
    with pytest.raises(InputError, match=r"add resume=True, or choose another out$"):
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
def test_reading_a_checkpoint_leaves_pythons_hook_all_else(tmp_path, plain_jax, monkeypatch, damaged):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": np.ones(3, np.float32)})
    if damaged:
        shutil.rmtree(tmp_path / "checkpoints" / "1" / "default")

    told = []
    hook = told.append
    monkeypatch.setattr(sys, "unraisablehook", hook)
    with pytest.raises(InputError, match="cannot be read") if damaged else nullcontext():
        checkpoints.restore({"a": jax.ShapeDtypeStruct((3,), np.float32)})
    assert damaged or sys.unraisablehook is hook
    late, other = (SimpleNamespace(exc_value=RuntimeError(words)) for words in ("Event loop is closed", "another"))
    sys.unraisablehook(late)  # of an array that was still being read
    sys.unraisablehook(other)
    assert told == ([other] if damaged else [late, other])


def test_killed_before_anything_was_prepared_a_run_goes_on(tmp_path, plain_jax):
    """Between its first two files: run.json is there, prepared.npz is not."""
    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    write_run(out, {"steps": 0, "seed": 0, "scene": load_scene(scene).to_dict()})
    train(scene, out, steps=10, resume=True)
    assert load_run(out).steps == 10


def steps_of_log(out):
    with (out / "log.csv").open() as file:
        return [int(row["step"]) for row in csv.DictReader(file)]


def test_minutes_choose_the_steps_and_too_few_are_warned_of(tmp_path, plain_jax):
    scene, seen, out = write_scene(tmp_path, FREE), [], tmp_path / "run"
    with pytest.warns(InputWarning, match=r"0.001 minutes hold about 10 .*: too few .*; 300 steps in all take about \d+ m"):
        run = train(scene, out, minutes=0.001, report=seen.append)
    assert [r.step for r in seen] == [10] and run.steps == seen[-1].steps == 10
    assert seen[-1].validation is not None and seen[-1].left == 0
    with pytest.raises(InputError, match="minutes: either steps or minutes"):
        train(scene, out, minutes=1, steps=20, resume=True)
    with pytest.warns(InputWarning, match="10 steps on this machine, up to step 20"):
        assert train(scene, out, minutes=0.001, resume=True).steps == 20
    assert steps_of_log(out) == [10, 20]


def test_steps_within_a_time_count_everything_that_takes_time():
    """Beside a count step by step of what `_Loop` does."""

    def seconds(costs, first, last):
        total = 0.0
        for done in range(first + 10, last + 1, 10):
            total += 10 * costs.step + (done % costs.validate_every == 0 or done == last) * costs.validation
            total += (done % costs.checkpoint_every == 0 or done == last) * costs.checkpoint
            total += (done % costs.checkpoint_every == 0 or done in EARLY) * costs.lists
            total += (done in (-(-(last // 2) // 10) * 10, last)) * poses_of(last) * costs.stiffness
        return total

    quick, slow = Costs(0.01, 3.0, 1.0, 0.2, 200, 150), Costs(10.0, 60.0, 5.0, 1.0, 20, 200)
    swings = quick._replace(stiffness=0.02)
    assert steps_within(600, swings) < steps_within(600, quick) - 100
    for costs in (quick, slow, swings):
        for first in (0, 60, 400):
            for allowed in (1, 100, 600, 3600):
                last = steps_within(allowed, costs, first)
                assert last % 10 == 0 and last > first
                assert last == first + 10 or 1.05 * seconds(costs, first, last) <= allowed
                assert 1.05 * seconds(costs, first, last + 10) > allowed - 4 - (costs is slow) * 66
    assert steps_within(180, slow) == 10 and steps_within(180, quick) > 10_000 / 2


def test_a_time_is_kept_where_steps_take_another_time_than_was_measured():
    timed = Minutes(Costs(0.1, 0.0, 0.0, 0.0, 200, 200), 0, 100.0)
    last = steps_within(timed.seconds, timed.costs)
    assert timed.last(120, 120 * 0.105, last) == last == 950
    assert timed.last(120, 120 * 0.05, last) == pytest.approx(120 + 94 / 0.0525, abs=10)
    assert timed.last(120, 120 * 0.2, last) == pytest.approx(120 + 76 / 0.21, abs=10)
    assert timed.last(120, 120 * 0.8, last) == 260  # its stiffness is found at half
    later = timed._replace(first=900)  # of a run that is resumed
    assert later.last(1020, 120 * 0.8, 1850) == pytest.approx(1020 + 4 / 0.84, abs=10)


@pytest.mark.filterwarnings("ignore:0.05 minutes hold")
@pytest.mark.parametrize("step", [0.1, 0.003])
def test_minutes_that_were_measured_wrongly_are_planned_anew(tmp_path, plain_jax, monkeypatch, step):
    """A step of this scene takes some 15 ms."""
    scene, seen, out = write_scene(tmp_path, FREE), [], tmp_path / "run"
    measure = runs_train.measure_costs
    monkeypatch.setattr(
        runs_train, "measure_costs", lambda *a, **k: measure(*a, **k)._replace(step=step, checkpoint=0, lists=0)
    )
    run = train(scene, out, minutes=0.05, report=seen.append)
    first, last = seen[0].steps, seen[-1].steps
    assert (last > 1.3 * first) if step > 0.05 else (last < 0.8 * first)
    assert run.steps == last == load_run(out).steps == seen[-1].step and read_run(out)["steps"] == last


def test_steps_are_whole(tmp_path):
    with pytest.raises(InputError, match=r"steps: a whole number expected .*60\.0"):
        train(write_scene(tmp_path, FREE), None, steps=60.0)
    with pytest.raises(InputError, match=r"steps: at least one step expected .*0"):
        train(write_scene(tmp_path, FREE), None, steps=0)


def test_resumed_to_more_steps_a_run_goes_on_to_them(tmp_path, plain_jax):
    scene, out, rates = write_scene(tmp_path, FREE), tmp_path / "run", []
    train(scene, out, steps=20)
    before = leaves(out)
    run = train(scene, out, steps=40, resume=True, report=rates.append)
    assert run.steps == load_run(out).steps == 40 and steps_of_log(out) == [10, 20, 30, 40]
    assert [r.steps for r in rates] == [40, 40]
    assert not any(np.array_equal(a, b) for a, b in zip(before, leaves(out), strict=True) if a.any())
    # The rate is that of a run of 40 steps: had the one of 20 been kept, it would be 2 % of the full one.
    moved = max(float(np.abs(a - b).max()) for a, b in zip(before, leaves(out), strict=True))
    assert moved > 3 * 0.02 * 1e-3 * 20
    assert train(scene, out, steps=40, resume=True, report=pytest.fail).steps == 40
    with pytest.raises(InputError, match=r"steps: at least the 40 steps .*found 30"):
        train(scene, out, steps=30, resume=True)
    with pytest.raises(InputError, match=r"a run keeps its seed .*found 5"):
        train(scene, out, seed=5, resume=True)
    scene.write_text(scene.read_text().replace("steps = 40", "steps = 40\nlearning_rate = 0.01"))
    with pytest.warns(InputWarning, match=r"not taken: training.learning_rate; .*weights: start "):
        train(scene, out, resume=True)


OTHERS = {  # what a scene says that a run is resumed with, and the field that is named
    "garment": ('file = "cloth.npz"', 'file = "other.npz"', r'garment.file: .*cloth.npz".*found .*other.npz'),
    "shapes": ('file = "body.npz"', 'file = "body.npz"\nshapes = { smile = 1.0 }', r"body.shapes: .*where it is {}"),
    "two": ("smoothing = 2", "smoothing = 3\nweld = 0.01", r"garment.weld: .*where it is 0.0 .*begin a new run"),
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_run_is_not_resumed_with_another_scene(unstarted, tmp_path, plain_jax, other):
    scene, (old, new, match) = write_scene(tmp_path, FREE), OTHERS[other]
    shutil.copytree(unstarted, out := tmp_path / "run")
    facts = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(facts).replace(str(unstarted.parent), str(tmp_path)))
    assert train(scene, out, resume=True, steps=10).steps == 10
    (wrong := tmp_path / "wrong.toml").write_text(scene.read_text().replace(old, new))
    more = "; other too: garment.smoothing" if other == "two" else ""
    with pytest.raises(InputError, match=rf"wrong.toml: {match}.*weights: start {out}{more}$"):
        train(wrong, out, resume=True)


def test_a_run_goes_on_with_its_own_scene_and_its_preset(tmp_path, plain_jax, recwarn):
    scene, out = write_scene(tmp_path, FREE), tmp_path / "run"
    with pytest.raises(InputError, match=r"scene: a scene expected"):
        train(None, out)
    train(load_scene(scene, "fast"), out, steps=10)
    assert train(scene, out, steps=10, resume=True).steps == 10  # the preset is not given again
    assert train(None, out, steps=20, resume=True).steps == 20
    assert not [w for w in recwarn if issubclass(w.category, InputWarning)]


def test_another_network_than_the_default_that_a_run_has_is_refused(tmp_path, recwarn):
    """Though a preset has the default's sizes. A run that began with a preset goes on with the scene that it was put on."""
    write_scene(tmp_path)
    file, out = tmp_path / "plain.toml", tmp_path / "run"
    file.write_text('[body]\nfile = "body.npz"\n[garment]\nfile = "cloth.npz"\n[motion]\nfiles = ["swing.npz"]\n')
    plain = load_scene(file)
    for preset in (None, *PRESETS):
        write_run(out, {"steps": 40, "seed": 0, "scene": load_scene(file, preset).to_dict()})
        assert resumed_scene(read_run(out), out, plain, None, None).network == load_scene(file, preset).network
    assert not [w for w in recwarn if issubclass(w.category, InputWarning)]
    write_run(out, {"steps": 40, "seed": 0, "scene": plain.to_dict()})
    other = replace(plain, network=replace(plain.network, decoder=(64,)))
    with pytest.raises(InputError, match=r"network.decoder: the scene of .*run expected, where it is \[256, 256, 256\] .*64"):
        resumed_scene(read_run(out), out, other, None, None)


def test_a_folder_of_motions_may_grow_before_a_run_is_resumed(tmp_path, plain_jax):
    scene, out = write_scene(tmp_path, FREE.replace('files = ["swing.npz"]', 'files = ["takes"]')), tmp_path / "run"
    (tmp_path / "takes").mkdir()
    shutil.copy(tmp_path / "swing.npz", tmp_path / "takes" / "a.npz")
    scene.write_text(scene.read_text().replace("validation", "#"))
    train(scene, out, steps=10)
    shutil.copy(tmp_path / "swing.npz", tmp_path / "takes" / "b.npz")
    with pytest.warns(InputWarning, match=r"given otherwise now, and not taken: motion.files;"):
        assert train(scene, out, steps=20, resume=True).steps == 20


CHANGED = {  # in the scene of a run that is trained, and the field that is named
    "decoder": ("network", {"decoder": [32]}, r"network.decoder: .*\(16,\) for decoder.layers_0.bias \(found \(32,\)\)"),
    "deeper": ("network", {"static": [16, 16, 16]}, r"network.static: .*no array for static.layer_2.bias"),
    "descriptor": ("network", {"descriptor": "axis_angle"}, r"network.descriptor, or body.joints: "),
    "cell": ("network", {"cell": "linear"}, r"network.dynamic, joint or cell: "),
    "method": ("network", {"method": "pbns"}, r"network.method, or garment.learn_weights: "),
    "modes": ("network", {"modes": 4}, r"network.modes, or garment.file: .*shape \(30, 6\) \(found \(30, 4\)\)"),
}


@pytest.mark.parametrize("change", CHANGED)
def test_a_scene_that_was_changed_in_a_run_is_named(unstarted, tmp_path, plain_jax, change):
    shutil.copytree(unstarted, out := tmp_path / "run")
    (table, values, match), facts = CHANGED[change], read_run(out)
    facts["scene"][table] |= values
    write_run(out, facts)
    with pytest.raises(InputError, match=rf"run.json: scene: {match}.*; the scene, or a file that it names, was changed"):
        train(None, out, steps=20, resume=True) if change == "modes" else load_run(out)
    assert Checkpoints(out).latest() == 10


ALTERED = {  # an array of a file of the scene that was trained, and what is said of it
    "a vertex of the garment": (
        "garment",
        "vertices",
        r"cloth.npz: garment.file: vertices: the garment .*'up to 1.0 mm elsewhere'",
    ),
    "a vertex fewer": ("garment", "faces", r"cloth.npz: garment.file: vertices: the garment .*'29 of them, for 30'"),
    "the body": ("body", "vertices", r"body.npz: body.file: joints and vertices: the body .*'up to 1.0 mm elsewhere'"),
    "its joints": ("body", "joints", r"body.npz: body.file: joints and vertices: the body .*'up to 1.0 mm elsewhere'"),
    "turned triangles": ("garment", "turned", r"cloth.npz: garment.file: faces: the garment .*'(\d+) others of \1'"),
    "a triangle fewer": ("garment", "one fewer", r"cloth.npz: garment.file: faces: the garment .*of them, for "),
    "the body's triangles": ("body", "one fewer", r"body.npz: body.file: faces: the body .*of them, for "),
}


@pytest.mark.parametrize("change", ALTERED)
def test_a_garment_or_body_that_was_changed_since_is_refused(unstarted, tmp_path, plain_jax, change):
    """By all that opens a run, and by a training that is resumed, before anything is found out of it."""
    (table, name, match), out = ALTERED[change], tmp_path / "run"
    shutil.copytree(unstarted, out)
    facts = read_run(out)
    file = Path(facts["scene"][table]["file"])
    original = dict(np.load(file))
    arrays = dict(original)
    facts["scene"][table]["file"] = str(tmp_path / file.name)
    write_run(out, facts)
    for far in (0.00005, 0.00095):  # m, one after the other
        if name == "faces":
            arrays["faces"] = arrays["faces"][(arrays["faces"] != 29).all(axis=1)]
            arrays |= {"vertices": arrays["vertices"][:29], "group_pins": arrays["group_pins"][:4]}
        elif name == "turned":
            arrays["faces"] = original["faces"][:, ::-1]
        elif name == "one fewer":
            arrays["faces"] = original["faces"][:-1]
        else:
            arrays[name][1] += [far, 0, 0]
        np.savez(tmp_path / file.name, **arrays)
        if name in ("vertices", "joints") and far < 1e-4:
            assert load_run(out).steps == 10
            continue
        for go in (load_run, lambda out: train(None, out, steps=20, resume=True)):
            with pytest.raises(InputError, match=match):
                go(out)


def test_pins_that_were_changed_since_are_refused(unstarted, tmp_path, plain_jax):
    shutil.copytree(unstarted, out := tmp_path / "run")
    facts = read_run(out)
    facts["scene"]["garment"]["pins"] = "pins"
    write_run(out, facts)
    with pytest.raises(
        InputError, match=r"garment.pins: the pins that the run was trained with expected \(found '5 of them, for 0'"
    ):
        load_run(out)


@pytest.fixture(scope="module")
def unstarted(tmp_path_factory):
    """A run to begin others from."""
    folder = tmp_path_factory.mktemp("first")
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        train(write_scene(folder, FREE), folder / "first", steps=10)
    return folder / "first"


def test_a_run_begins_with_the_weights_of_another(unstarted, tmp_path, plain_jax):
    scene, begun = write_scene(tmp_path, FREE), load_run(unstarted)
    moving = swing()
    moving["poses"][:, 1] = 0  # the upper joint does not turn; yet the run goes on to read it
    np.savez(tmp_path / "walk.npz", **moving)
    text = scene.read_text()
    other = tmp_path / "other.toml"
    other.write_text(text.replace('files = ["swing.npz"]', 'files = ["walk.npz"]') + "[physics]\ndensity = 0.2\n")
    out = tmp_path / "second"
    run = train(other, out, steps=10, start=begun)
    kept = Checkpoints(out)
    assert kept.latest() == 10 and load_run(out).assembly.prepared.inputs.tolist() == begun.assembly.prepared.inputs.tolist()
    # A step of Adam is at most its rate: ten of them lead at most so far from where the run began.
    apart = [
        float(np.abs(a - b).max()) for a, b in zip(jax.tree.leaves(begun.params), jax.tree.leaves(run.params), strict=True)
    ]
    assert 0 < max(apart) <= 10 * 1.1e-3
    assert train(other, out, steps=20, resume=True).steps == 20
    assert np.isfinite(begun.animate(str(tmp_path / "swing.npz"))).all()


def test_joints_that_turn_and_are_not_read_are_warned_of(tmp_path, plain_jax):
    scene = load_scene(write_scene(tmp_path, FREE))
    one = assemble(replace(scene, body=replace(scene.body, joints=("0",))))
    begun = Run(one, initial_state(one.model, one.network, 0).params)
    with pytest.warns(InputWarning, match="does not read joints that turn in the motions: 1;"):
        found, _ = assemble_run(scene, None, None, begun, None, assemble)
    assert found.prepared.inputs.tolist() == [0]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("decoder = [16]", "decoder = [32]", r"network.decoder: the network of .*first expected, \(16,\) .*decoder = \[16\]"),
        (
            'file = "cloth.npz"',
            'file = "other.npz"',
            r"garment.file: the garment of .*first expected, .*cloth.npz with 40 triangles, .*found 'other.npz, 32 triangles'",
        ),
        (
            'file = "body.npz"',
            'file = "one.npz"',
            r"body.file: the body of .*first expected, .*body.npz, whose .*found 'one.npz, without joint 1'",
        ),
        (
            'file = "body.npz"',
            'file = "none"',
            r"body.file: the body of .*first expected, .*found 'none, without joint 0 and 1 more'",
        ),
    ],
)
def test_weights_of_another_network_garment_or_body_are_refused(unstarted, tmp_path, plain_jax, monkeypatch, old, new, match):
    """In words of the scene, and before a garment is made ready, which may take a minute."""
    monkeypatch.setattr("ncs_jax.runs.train.assemble", pytest.fail)
    scene = write_scene(tmp_path, FREE.replace(old, new))
    one = {name: a[:1] if name in ("joints", "parents") else a for name, a in post().items()}
    np.savez(tmp_path / "one.npz", **one | {"blend_weights": np.ones((len(one["vertices"]), 1))})
    vertices, faces = grid(rows=5)
    np.savez(tmp_path / "other.npz", vertices=vertices, faces=faces)
    with pytest.raises(InputError, match=match):
        train(scene, tmp_path / "run", steps=10, start=unstarted)
    assert not (tmp_path / "run").exists()


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


def test_a_run_that_looks_at_its_worst_frames_is_resumed_bit_for_bit(tmp_path, plain_jax):
    text = SCENE.replace("[training]", "[training]\nfocus = 0.5")
    scene, out = write_scene(tmp_path, text), tmp_path / "run"
    train(scene, out, steps=30)
    whole = leaves(out)
    plain = train(write_scene(tmp_path, text.replace("focus = 0.5", "focus = 0.0")), tmp_path / "plain", steps=30)
    assert any(not np.array_equal(a, b) for a, b in zip(whole, jax.tree.leaves(plain.params), strict=True))
    write_scene(tmp_path, text)
    shutil.rmtree(out / "checkpoints" / "30")
    train(scene, out, resume=True)
    jax.tree.map(np.testing.assert_array_equal, leaves(out), whole)

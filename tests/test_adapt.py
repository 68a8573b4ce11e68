"""Adapting a run to motions: it goes on where it stood, is a run like any, and never comes out worse."""

import json
import shutil
from dataclasses import replace
from itertools import count
from pathlib import Path

import jax
import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.cli import main
from ncs_jax.errors import InputError
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.runs import adapt as module
from ncs_jax.runs.adapt import adapt, adapted_folder
from ncs_jax.runs.placed_scene import PlacedScene
from ncs_jax.runs.run import load_run
from ncs_jax.runs.train import train
from ncs_jax.scene.spec import scene_from

from .ready import assembled
from .scenes import FREE, swing, write_scene

MOMENT = 0.001  # s: ten steps


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with a scene, a run of ten steps, and a clip that it was not trained on."""
    folder = tmp_path_factory.mktemp("adapted")
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        train(write_scene(folder, FREE.replace("files = [", "mirror = false\nfiles = [")), folder / "run", steps=10)
    np.savez(folder / "clip.npz", **swing(frames=40, size=1.2))
    return folder


def leaves(run):
    return [np.asarray(a) for a in jax.tree.leaves(run.params)]


def same(a, b):
    return all(np.array_equal(p, q) for p, q in zip(leaves(a), leaves(b), strict=True))


def test_adapted_is_a_run_that_goes_on_and_does_nothing_twice(trained, tmp_path, monkeypatch):
    run, clip, out = load_run(trained / "run"), str(trained / "clip.npz"), tmp_path / "adapted"
    monkeypatch.setattr(PlacedScene, "find_stiffness", lambda *_: pytest.fail("the run's is kept: it need not be timed"))
    first = adapt(run, clip, MOMENT, out)
    assert first.kept and first.run.steps == 10 and first.after["total"] < first.before["total"]
    assert np.isclose(first.before["total"], run.evaluate(clip)["total"].mean(), rtol=1e-6)
    kept = load_run(out)
    assert np.isclose(first.after["total"], kept.evaluate(clip)["total"].mean(), rtol=1e-6)
    assert same(kept, first.run) and not same(kept, run) and same(run, load_run(trained / "run"))
    assert kept.assembly.scene.motion.files == (clip,) and kept.assembly.scene.motion.validation == ()
    again = adapt(run, clip, MOMENT / 2, out, report=pytest.fail)
    assert (again.before, again.after, again.seconds) == (first.before, first.after, MOMENT) and same(again.run, kept)
    more = adapt(trained / "run", clip, 2 * MOMENT, out)
    assert more.run.steps == load_run(out).steps == 20 and more.after["total"] <= first.after["total"]
    assert more.before == first.before
    assert "before:  total" in str(more) and "20 steps" in str(more) and str(out) in str(more)

    for more_steps in (None, 40):
        with pytest.raises(
            InputError, match=r"not adapted expected .*one adapted for 0.002 s.*--adapt SECONDS --adapted .*start "
        ):
            train(write_scene(tmp_path), out, steps=more_steps, resume=True)
    with pytest.raises(InputError, match=r"adapted to ncs:.*swing.npz expected .*clip.npz.*another folder".replace("ncs:", "")):
        adapt(run, str(trained / "swing.npz"), MOMENT, out)
    with pytest.raises(InputError, match="found 'another run'"):
        adapt(run, clip, MOMENT, trained / "run")
    other = replace(run, params=jax.tree.map(lambda a: a + 1e-3, run.params))
    with pytest.raises(InputError, match="before the motion, or the run that it began from, was changed"):
        adapt(other, clip, MOMENT, out)


def test_a_run_that_is_adapted_stays_as_it_is_where_nothing_is_written(trained):
    run, clip = load_run(trained / "run"), str(trained / "clip.npz")
    first, second = (adapt(run, clip, MOMENT) for _ in range(2))
    assert same(first.run, second.run) and not same(first.run, run) and same(run, load_run(trained / "run"))


def test_interrupted_it_keeps_its_weights_and_goes_on(trained, tmp_path):
    out, clip = tmp_path / "adapted", str(trained / "clip.npz")

    def stop(report):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adapt(trained / "run", clip, 600.0, out, report=stop)
    assert load_run(out).steps == 10
    facts = json.loads((out / "run.json").read_text())
    assert facts["steps"] > 10 and "after" not in facts["adapted"]
    seen = []
    found = adapt(trained / "run", clip, 600 * 10 / facts["steps"] + MOMENT, out, report=seen.append)
    assert [r.step for r in seen] == [20] and found.run.steps == 20 and found.after["total"] < found.before["total"]


def test_what_comes_out_worse_is_not_kept(trained, tmp_path, monkeypatch):
    seen = count()
    monkeypatch.setattr(module, "_measured", lambda run: {"total": float(next(seen))})
    run, out = load_run(trained / "run"), tmp_path / "adapted"
    found = adapt(run, str(trained / "clip.npz"), MOMENT, out)
    assert not found.kept and found.after == found.before and "the weights of the run are kept" in str(found)
    assert same(found.run, run) and same(load_run(out), run) and load_run(out).steps == 10
    assert not adapt(run, str(trained / "clip.npz"), MOMENT, out, report=pytest.fail).kept


def test_a_clip_is_adapted_to_as_a_whole(trained):
    run = load_run(trained / "run")
    a = replace(run.assembly, scene=scene_from({**run.assembly.scene.to_dict(), "motion": {"frames": [0, 10], "fps": 30.0}}))
    on, records = module._scene_on(replace(run, assembly=a), str(trained / "clip.npz"))
    again = scene_from(on.to_dict())  # as its run.json has it
    assert [len(r.poses) for r in (*records.values(), load_motion(again, on.motions[0], a.body))] == [40, 40]


def test_motions_fill_whole_blocks():
    records = [io.MotionRecord(np.full((n, 2, 3), n, np.float32), np.zeros((n, 3), np.float32), 30.0, ()) for n in (300, 7)]
    filled = module._filled(records)
    assert [len(r.poses) for r in filled] == [300, 7, 205] and filled[:2] == records
    assert np.all(filled[2].poses == 300)
    short = module._filled(records[1:])
    assert sum(len(r.poses) for r in short) == module.FILLED and {len(r.poses) for r in short} == {7, module.FILLED % 7}


def test_skin_that_a_motion_brings_near_is_touched():
    assembly = assembled({"physics.collision.reach": 0.005})
    record = next(iter(assembly.motions.values()))
    part = assembly.prepared.part
    assert module._part(assembly, [record]) is part
    less = replace(assembly, prepared=replace(assembly.prepared, part=part[::2]))
    assert np.array_equal(module._part(less, [record]), part)


def test_names_of_folders(tmp_path):
    near = tmp_path / "run"
    assert adapted_folder(near, "a/dance.1.bvh[10:300]") == tmp_path / "run_adapted_dance.1_10_300"
    assert adapted_folder(near, ["ncs:walk", "b.bvh"]) == tmp_path / "run_adapted_walk_b"
    many = [f"recording_{i}.bvh" for i in range(40)]
    assert len(adapted_folder(near, many).name) < 120 and adapted_folder(near, many) != adapted_folder(near, many[::-1])


def test_animate_adapts_first(trained, tmp_path, capsys, monkeypatch):
    shutil.copytree(trained, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    line = ["animate", "run", "--out", "a.npz"]
    for wrong, words in (
        (["--motion", "clip.npz", "--motion", "swing.npz"], "--motion: one motion expected without --adapt"),
        (["--adapted", "b"], "--adapted: --adapt expected beside it (found 'b'); add --adapt 20\n"),
        (["--adapted", "run"], "--adapted: --adapt expected beside it (found 'run'); add --adapt 20, or give run as the RUN\n"),
    ):
        assert main([*line, *wrong]) == 2 and words in capsys.readouterr().err
    assert main([*line, "--motion", "clip.npz", "--adapt", str(MOMENT)]) == 0
    said = capsys.readouterr()
    assert "before:  total" in said.out and "kept:    run_adapted_clip" in said.out and said.err == ""
    assert np.allclose(np.load("a.npz")["vertices"], load_run("run_adapted_clip").animate("clip.npz"))
    assert main([*line, "--motion", "clip.npz", "--adapt", str(MOMENT)]) == 0
    assert "nothing was trained" in capsys.readouterr().out
    assert main(["view", "run", "--adapt", "1"]) == 2
    assert "--motion: a motion expected beside --adapt; add --motion FILE" in capsys.readouterr().err
    assert main(["view", "run", "--adapted", "b"]) == 2
    assert "--adapted: --adapt expected beside it" in capsys.readouterr().err
    assert Path("run_adapted_clip").is_dir()

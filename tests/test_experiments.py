"""Experiments at their smallest size."""

import csv
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments import __main__ as whole
from experiments import (
    architecture,
    augmentation,
    budget,
    control,
    descriptors,
    falling,
    fast_motion,
    fit_material,
    garments,
    limits,
    membranes,
    methods,
    seeds,
    specimens,
    speed_accuracy,
    spread,
    stability,
    study,
    unseen,
)
from ncs_jax import InputError, assemble, load_scene, scene_from, train
from ncs_jax.io import read_body, read_motion
from ncs_jax.io.packaged import packaged

from .scenes import FREE, SCENE, post, swing, write_scene
from .shapes import tube


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def test_seeds(tmp_path, capsys):
    scene, out = write_scene(tmp_path, FREE), tmp_path / "out"
    assert seeds.main([str(scene), "--steps", "10", "--seeds", "2", "--out", str(out)]) == 0
    with (out / "seeds.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["seed"] for row in rows] == ["0", "1"] and rows[0]["total"] != rows[1]["total"]
    assert (out / "seeds.png").read_bytes()[:4] == b"\x89PNG"
    assert "dropped 0" in capsys.readouterr().out
    assert seeds.main([str(tmp_path / "nowhere.toml")]) == 2


@pytest.mark.slow  # nearly all of it is compiling
def test_fit_material(tmp_path, capsys):
    command = ["--cloth", "hanging", "--side", "6", "--frames", "4", "--noise", "0", "--out", str(tmp_path)]
    assert fit_material.main(command) == 0
    with (tmp_path / "fit_material.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["cloth"] == "hanging" and row["failed"] == "0" and int(row["evaluations"]) > 1
    assert all(abs(float(row[name]) - 1) < 0.05 for name in ("stretch", "bending", "density"))
    assert (tmp_path / "fit_material.png").read_bytes()[:4] == b"\x89PNG"
    assert "stretch 5.0000  bending 0.2000  density 5.0000" in capsys.readouterr().out
    assert fit_material.main(["--cloth", "tshirt", "--frames", "1000", "--out", str(tmp_path)]) == 2


def test_speed_accuracy(tmp_path, capsys):
    out = tmp_path / "out"
    command = [str(write_scene(tmp_path, FREE)), "--quick", "--only", "fast", "--out", str(out)]
    assert speed_accuracy.main(command) == 0
    with (out / "speed_accuracy.csv").open() as file:
        rows = {row["point"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"simulation", "fast", "fast, rank 16", "fast, bfloat16"}
    assert float(rows["simulation"]["excess"]) == float(rows["simulation"]["distance"]) == 0
    assert all(float(row["distance"]) > 0 and float(row["rate"]) > 0 for name, row in rows.items() if name != "simulation")
    assert all(50 < float(row["memory"]) < 2000 and float(row["frame"]) > 0 for row in rows.values())
    assert (out / "speed_accuracy.md").read_text().count("\n") == 2 + len(rows)
    assert (out / "speed_accuracy.png").read_bytes()[:4] == b"\x89PNG"
    before = (out / "speed_accuracy.csv").read_text()
    (out / "speed_accuracy.csv").unlink()
    assert speed_accuracy.main(command) == 0  # nothing is measured twice
    assert (out / "speed_accuracy.csv").read_text() == before
    assert speed_accuracy.main([str(tmp_path / "nowhere.toml")]) == 2


@pytest.fixture
def alone(monkeypatch):
    """Everything in this process: starting others takes longer than what they do here."""
    for module in (control, garments, limits, methods, unseen):
        monkeypatch.setattr(module, "apart", lambda job, *arguments: job(*arguments))
    for module in (study, garments, methods, architecture, budget, descriptors):
        monkeypatch.setattr(module, "abreast", lambda jobs: [job(*arguments) for job, *arguments in jobs])


def test_two_jobs_run_on_cores_of_their_own():
    cores = os.sched_getaffinity(0)
    first, second = study.abreast([(os.sched_getaffinity, 0)] * 2)
    assert first | second == cores and (len(cores) == 1 or not first & second)


def studied(module, tmp_path, *more, text=SCENE):
    """Run an experiment of the study at its smallest: its rows by the first column, as read from the CSV."""
    scene, out = write_scene(tmp_path, text.replace('validation = ["swing.npz"]', "")), tmp_path / "out"
    moves = swing(frames=40, size=0.3)
    np.savez(tmp_path / "sway.npz", **moves | {name: moves[name][14:] for name in ("poses", "trans")})  # its end, and the stop
    given = ["--quick", "--unseen", str(tmp_path / "sway.npz"), "--out", str(out), "--kept", str(tmp_path / "kept"), *more]
    assert module.main([str(scene), *given]) == 0
    name = module.__name__.rpartition(".")[2]
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in out.glob("*.png")) and list(out.glob(f"{name}*.png"))
    with (out / f"{name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert (out / f"{name}.md").read_text().count("\n") == 2 + len(rows)
    told = module.conclusion([{k: whole.number(v) for k, v in row.items() if v} for row in rows])
    assert told.endswith(".") and "nan" not in told
    assert module.main([str(tmp_path / "nowhere.toml")]) == 2
    return {next(iter(row.values())): row for row in rows}


def test_fast_clips_begin_at_rest_and_are_as_fast_as_they_say(tmp_path):
    files = fast_motion.clips(tmp_path, read_body(packaged("body")))
    for name, file in files.items():
        with np.load(file) as clip:
            poses, path = clip["poses"], clip["trans"]
        assert len(poses) == len(path) == fast_motion.FRAMES and np.isfinite(poses).all(), name
        still = np.ptp(poses[:3], axis=0).max() + np.ptp(path[:3], axis=0).max()
        assert name == "dance" or still == 0, name
    with np.load(files["stop"]) as clip:
        steps = np.diff(clip["trans"][:, 2]) * fast_motion.FPS
    np.testing.assert_allclose([steps.min(), steps.max()], [0, 3], atol=1e-6)


@pytest.mark.slow  # nearly all of it is compiling
def test_fast_motion(tmp_path):
    assert fast_motion.main(["--quick", "--clips", "stop", "--sets", "them", "--out", str(tmp_path)]) == 0
    with (tmp_path / "fast_motion.csv").open() as file:
        rows = {row["cell"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["gated", "swing", "swing, alpha = 0"] and all(float(row["energy"]) > 0 for row in rows.values())
    assert float(rows["swing"]["stopped"]) > 0 and fast_motion.main([str(tmp_path / "nowhere.toml")]) == 2


def test_a_part_of_a_motion_is_held_where_it_ends_standing(tmp_path):
    """Its frames are those in its name, and a part is not taken for the whole or for another part."""
    scene = load_scene("ncs:tshirt")
    whole_, part = study.standing(scene, ("ncs:walk_turn_stop", "ncs:walk_turn_stop[20:]"), tmp_path)
    assert whole_ != part and study.stem("ncs:walk_turn_stop[20:]") == "walk_turn_stop"
    found, all_ = (read_motion(path).poses for path in (part, whole_))
    np.testing.assert_array_equal(found, all_[20:])
    assert study.standing(scene, ("ncs:walk[0:30]",), tmp_path) == ("ncs:walk[0:30]",)


def test_the_page_is_what_its_tables_say():
    folder = Path(study.__file__).parent
    assert whole.page(folder / "results") == (folder / "README.md").read_text()


def test_an_interrupted_reference_goes_on_and_is_in_no_other_scene_s_way(tmp_path, monkeypatch):
    """Scenes with other networks share the simulation, but not what a simulation of the one has begun."""
    scene = load_scene("ncs:skirt")
    other = study.changed(scene, network={"method": "pbns"})
    assert study.simulation_file(scene, "ncs:walk", tmp_path) == study.simulation_file(other, "ncs:walk", tmp_path)
    given = []

    def interrupted(scene, motion, partial):
        given.append((partial, partial.exists()))
        partial.touch()
        if len(given) < 3:
            raise KeyboardInterrupt
        return SimpleNamespace(vertices=np.ones((2, 3, 3)))

    monkeypatch.setattr(study, "simulate", interrupted)
    for one in (scene, other):
        with pytest.raises(KeyboardInterrupt):
            study.reference(one, "ncs:walk", tmp_path)
    assert study.reference(scene, "ncs:walk", tmp_path).shape == (2, 3, 3)
    (first, _), (second, there), (again, continued) = given
    assert first == again != second and continued and not there and not first.exists() and second.exists()
    np.testing.assert_array_equal(study.reference(other, "ncs:walk", tmp_path), 1)


def test_methods(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(study, "COARSE", 50.0)  # g: what few iterations reach, and stop at
    rows = studied(methods, tmp_path, text=FREE.replace("smoothing = 2", 'smoothing = 2\npins = "pins"'))
    assert list(rows) == [*methods.SIMULATIONS.values(), "pbns", "snug", "ncs"]
    ours, coarse, static, pbns, snug, ncs = rows.values()
    assert float(ours["distance"]) == 0 and float(ours["dynamic_share"]) == 1
    assert all(float(row["distance"]) > 0 for name, row in rows.items() if name != "simulation")
    # what stands beside every distance is that of the second simulation, whose static part is the one without inertia
    assert {row["sensitivity"] for row in rows.values()} == {coarse["distance"]}
    assert [float(row["static_distance"]) for row in (ours, coarse, static)] == [0, 0, 0]
    assert float(ours["dynamic_correlation"]) == pytest.approx(1) == float(ours["dynamic_factor"])
    # a pose alone has no dynamic part, and a recurrence no part that is static
    assert float(pbns["static_distance"]) > 0 and not pbns["dynamic_correlation"] and not static["dynamic_factor"]
    assert not snug["static_distance"] and -1 <= float(ncs["dynamic_correlation"]) <= 1
    # the motion stops: a pose without motion stands at once
    assert float(rows["pbns"]["stopped_share"]) == 0 < float(rows["snug"]["stopped_share"])
    assert len(list((tmp_path / "kept" / "simulations").glob("*.npz"))) == len(methods.SIMULATIONS)


def test_unseen(alone, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(study, "COARSE", 50.0)
    monkeypatch.setattr(unseen, "adapt", lambda run, motion, seconds: SimpleNamespace(run=run, after=asked.append(seconds)))
    asked: list[float] = []
    text = FREE.replace("smoothing = 2", 'smoothing = 2\npins = "pins"').replace('validation = ["swing.npz"]', "")
    scene, out = write_scene(tmp_path, text), tmp_path / "out"
    np.savez(tmp_path / "sway.npz", **swing(frames=12, size=0.3))
    given = ["--unseen", str(tmp_path / "sway.npz"), "--out", str(out), "--kept", str(tmp_path / "kept")]
    assert unseen.main([str(scene), "--quick", "--adapt", "3", *given]) == 0
    with (out / "unseen.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == [*methods.SIMULATIONS.values(), "ncs", "ncs, adapted", "pbns", "pbns, adapted"]
    ours, coarse, static, ncs, adapted, pbns, _ = rows.values()
    assert {row["motion"] for row in rows.values()} == {"sway"} and asked == [3, 3]
    assert float(ours["distance"]) == 0 < float(coarse["distance"]) == float(ncs["sensitivity"]) < float(static["distance"])
    assert float(ncs["distance"]) != float(pbns["distance"]) and not pbns["dynamic_factor"]
    assert float(adapted["minutes"]) == pytest.approx(float(ncs["minutes"]) + 0.05) and adapted["total"] == ncs["total"]
    assert (out / "unseen_sway.png").read_bytes()[:4] == b"\x89PNG" and "| sway | ncs |" in capsys.readouterr().out
    assert unseen.main([str(tmp_path / "nowhere.toml")]) == 2


def test_limits(alone, tmp_path, monkeypatch, capsys):
    """What is trained on is not told; what is turned farther is, and rightly where adapting gains more than a tenth."""
    run = train(write_scene(tmp_path, FREE), tmp_path / "run", steps=10)
    np.savez(tmp_path / "far.npz", **swing(size=2.5))
    gains = iter([1.04, 1.5])
    found = lambda run, motion, seconds: SimpleNamespace(before={"total": next(gains)}, after={"total": 1.0})  # noqa: E731
    monkeypatch.setattr(limits, "adapt", found)
    out = tmp_path / "out"
    given = [str(tmp_path / "run"), str(tmp_path / "swing.npz"), str(tmp_path / "far.npz"), "--out", str(out)]
    assert limits.main(given) == 0
    with (out / "limits.csv").open() as file:
        known, far = csv.DictReader(file)
    assert (known["told"], far["told"], known["right"], far["right"]) == ("", "beyond", "yes", "yes")
    assert float(known["excess"]) == pytest.approx(4) and float(far["expected"]) > 10 > float(known["expected"])
    assert float(far["outside"]) > 0 and "rightly: 2 of 2" in capsys.readouterr().out and run.steps == 10
    assert (out / "limits.png").read_bytes()[:4] == b"\x89PNG" and limits.main([str(tmp_path / "nowhere"), "walk"]) == 2


def write_sleeve(file, radius=0.085, bottom=0.5, unit=1.0):
    """A tube around the post: of 85 mm it lies on it, and of 100 mm it hangs."""
    x, faces = tube(16, 6, radius, 0.2)
    np.savez(file, vertices=(x + [0, bottom, 0]) / unit, faces=faces)


@pytest.mark.slow  # nearly all of it is compiling
def test_garments(alone, tmp_path, capsys):
    np.savez(tmp_path / "body.npz", **post())
    np.savez(tmp_path / "swing.npz", **swing())
    np.savez(tmp_path / "still.npz", **swing(size=0.1))
    (tmp_path / "worn").mkdir()
    write_sleeve(tmp_path / "worn" / "sleeve.npz")
    (tmp_path / "worn" / "broken.obj").write_text("v 0 0\n")
    command = [
        str(tmp_path / "worn"),
        "--body",
        str(tmp_path / "body.npz"),
        "--motions",
        str(tmp_path / "swing.npz"),
        "--quick",
    ]
    command += ["--methods", "simulation", "pbns", "--out", str(tmp_path / "out"), "--kept", str(tmp_path / "kept")]
    assert garments.main([*command, "--unseen", str(tmp_path / "still.npz")]) == 0
    with (tmp_path / "out" / "garments.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(r["garment"], r["method"], r["on"]) for r in rows} == {
        ("sleeve", method, on) for method in ("simulation", "pbns") for on in ("trained", "unseen")
    }
    every = [r for r in rows if r["motion"] == garments.ALL]
    assert len(rows) == 2 * len(every) == 8
    energies = ("membrane", "bending", "inertia", "gravity", "collision")
    for row in every:
        assert float(row["total"]) == pytest.approx(sum(float(row[name]) for name in (*energies, "pinning") if name in row))
        assert 0 <= float(row["penetrating"]) <= float(row["within_1mm"]) <= 100 and float(row["gradient_norm"]) > 0
        assert (float(row["distance"]) == 0) == (row["method"] == "simulation")
    told = (tmp_path / "out" / "garments.md").read_text()
    assert told.count("| sleeve |") == 4 and "broken.obj" in told and "broken.obj" in capsys.readouterr().err
    assert (tmp_path / "out" / "sleeve.png").read_bytes()[:4] == b"\x89PNG"
    (tmp_path / "worn" / "sleeve.npz").unlink()
    assert garments.main(command) == 2 and garments.main([str(tmp_path / "nowhere"), *command[1:]]) == 2


def test_garments_of_a_folder_become_scenes(tmp_path, capsys):
    """One that hangs is placed as the others if these agree; one that cannot be read is told by name, and the others go on."""
    body, worn = tmp_path / "body.npz", tmp_path / "worn"
    np.savez(body, **post())
    worn.mkdir()
    for name, radius, bottom in (("a", 0.085, 0.5), ("b", 0.085, 0.45), ("skirt", 0.1, 0.3)):
        write_sleeve(worn / f"{name}.npz", radius, bottom)
    (worn / "broken.obj").write_text("v 0 0\n")
    (worn / "notes.txt").write_text("")
    np.savez(worn / "swing.npz", **swing())
    files = garments.garment_files([str(worn), str(worn / "a.npz")], [str(worn / "swing.npz")])
    assert [file.name for file in files] == ["a.npz", "b.npz", "broken.obj", "skirt.npz"]
    plain = scene_from({"body": {"file": str(body)}, "motion": {"files": [str(worn / "swing.npz")]}})
    scenes, refused = garments.scenes_of(files, plain, read_body(body), tmp_path / "kept")
    assert list(scenes) == ["a", "b", "skirt"] and list(refused) == [str(worn / "broken.obj")]
    physics = scenes["skirt"].physics
    # 23.6 and 44.4 kPa times 0.47 mm
    assert (physics.density, physics.membrane.mu, physics.membrane.lam) == pytest.approx((0.20022, 11.092, 20.868))
    x = np.load(scenes["skirt"].garment.file)["vertices"]
    assert np.abs(np.linalg.norm(x[:, [0, 2]], axis=1) - 0.1).max() < 0.005 and abs(x[:, 1].min() - 0.3) < 0.005
    told = capsys.readouterr().err
    assert "skirt.npz: placed as the others" in told and "not used: " in told and "broken.obj" in told
    found = dict(garments.placed([worn / "a.npz", worn / "skirt.npz"], read_body(body)))
    assert found[worn / "skirt.npz"].doubt  # one alone says nothing of it
    with pytest.raises(InputError, match="mesh file"):
        garments.garment_files([str(tmp_path / "kept")], [])


@pytest.mark.slow
def test_descriptors(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(descriptors, "DESCRIPTORS", ("heading_free", "six"))
    rows = studied(descriptors, tmp_path)
    assert list(rows) == ["heading_free", "six", "six, gravity not seen"]
    assert float(rows["heading_free"]["turned"]) < 0.01 < 0.1 < float(rows["six"]["turned"])
    assert rows["six"]["unseen_total"] != rows["six, gravity not seen"]["unseen_total"]


@pytest.mark.slow
def test_architecture(alone, tmp_path):
    hung = SCENE.replace("smoothing = 2", 'smoothing = 2\npins = "pins"')  # without, it has no period to swing with
    rows = studied(architecture, tmp_path, text=hung)
    ours, one, bias, window, linear, swing = rows.values()
    for row in (ours, window, linear, swing):  # without bias, no motion is nothing
        assert float(row["before"]) < 1e-3 and float(row["left_2000"]) < 1e-3 < float(row["left_0"])
    assert float(bias["before"]) > 1e-3 < float(one["before"])


@pytest.mark.slow
def test_spread(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(spread, "SEEDS", 2)
    one, two, between = studied(spread, tmp_path).values()
    assert (one["seed"], two["seed"], between["seed"]) == ("0", "1", spread.RANGE)
    assert 0 < float(between["total"]) == pytest.approx(abs(float(one["total"]) - float(two["total"])))


@pytest.mark.slow
def test_augmentation(alone, tmp_path):
    rows = studied(augmentation, tmp_path)
    assert list(rows) == ["none", "motion", "mirror", "recombined", "all"]
    assert len({row["total"] for row in rows.values()}) == 5


@pytest.mark.slow
def test_control(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(control, "ALPHAS", np.array([0.0, 1.0, 3.0]))
    still, one, three = studied(control, tmp_path).values()
    assert float(still["speed"]) < float(one["speed"]) < float(three["speed"])


@pytest.mark.slow
def test_budget(alone, tmp_path, monkeypatch):
    for name, values in {"WINDOWS": (6,), "BATCHES": (4,), "RATES": (15.0, 60.0)}.items():
        monkeypatch.setattr(budget, name, values)
    rows = studied(budget, tmp_path)
    assert list(rows)[-1] == "trained at 60 frames/s, used at 60" and len(rows) == 7
    assert all(float(row["distance"]) > 0 for row in rows.values())


@pytest.mark.slow
def test_membranes(alone, tmp_path, monkeypatch):
    chosen = {name: membranes.MEMBRANES[name] for name in ("stvk", "neo_hookean")}
    monkeypatch.setattr(membranes, "MEMBRANES", chosen)
    rows = studied(membranes, tmp_path)
    # uniaxial strain: S = (lam + 2 mu) (l^2 - 1) / 2, whose force S l is greatest at 1/sqrt(3)
    assert float(rows["stvk"]["yields"]) == pytest.approx(1 / np.sqrt(3), abs=0.01)
    assert rows["neo_hookean"]["yields"] == "never"


@pytest.mark.slow
def test_falling(tmp_path, capsys):
    assert falling.main(["--quick", "--out", str(tmp_path)]) == 0
    with (tmp_path / "falling.csv").open() as file:
        rows = {(row["case"], row["inertia"]): row for row in csv.DictReader(file)}
    assert len(rows) == 6 and (tmp_path / "falling.png").read_bytes()[:4] == b"\x89PNG"
    assert float(rows["free fall", "simulation"]["mean"]) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("name", ["a batch of 1", "a window of 1", "one triangle"])
def test_scenes_of_the_least_size_train(tmp_path, name):
    scene = dict(specimens.least(tmp_path))[name]
    row = stability.learned("training", "scene", name, assemble(scene), steps=4)
    assert row["dropped"] == 0 and np.isfinite(row["last"]) and row["first"] != row["last"]


def test_scenes_that_are_none_are_refused(tmp_path):
    scenes = dict(specimens.least(tmp_path))
    for name in ("vertices without faces", "a face given twice", "no garment vertices"):
        with pytest.raises(InputError, match=r"\.npz"):
            assemble(scenes[name])


@pytest.mark.slow  # nearly all of it is compiling, in two precisions
def test_stability(tmp_path, capsys):
    assert stability.main([str(write_scene(tmp_path)), "--quick", "--out", str(tmp_path / "out")]) == 0
    for part in stability.PARTS:
        with (tmp_path / "out" / f"stability_{part}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert {row["state"] for row in rows} <= set(stability.STATES) and any(row["state"] == "safe" for row in rows)
        assert (tmp_path / "out" / f"stability_{part}.png").read_bytes()[:4] == b"\x89PNG"
    assert "training" in capsys.readouterr().out
    assert stability.main([str(tmp_path / "nowhere.toml")]) == 2

"""Experiments at their smallest size."""

import csv

import numpy as np
import pytest

from experiments import fit_material, methods, seeds, speed_accuracy

from .scenes import SCENE, swing, write_scene


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def test_seeds(tmp_path, capsys):
    scene, out = write_scene(tmp_path), tmp_path / "out"
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
    assert speed_accuracy.main([str(write_scene(tmp_path)), "--quick", "--only", "fast", "--out", str(out)]) == 0
    with (out / "speed_accuracy.csv").open() as file:
        rows = {row["point"]: row for row in csv.DictReader(file)}
    assert set(rows) == {"simulation", "fast", "fast, rank 16", "fast, bfloat16"}
    assert float(rows["simulation"]["excess"]) == float(rows["simulation"]["distance"]) == 0
    assert all(float(row["distance"]) > 0 and float(row["rate"]) > 0 for name, row in rows.items() if name != "simulation")
    assert all(50 < float(row["memory"]) < 2000 and float(row["frame"]) > 0 for row in rows.values())
    assert (out / "speed_accuracy.md").read_text().count("\n") == 2 + len(rows)
    assert (out / "speed_accuracy.png").read_bytes()[:4] == b"\x89PNG"
    assert speed_accuracy.main([str(tmp_path / "nowhere.toml")]) == 2


def test_methods(tmp_path, capsys):
    scene, out = write_scene(tmp_path, SCENE.replace('validation = ["swing.npz"]', "")), tmp_path / "out"
    np.savez(tmp_path / "sway.npz", **swing(size=0.3))
    assert methods.main([str(scene), "--quick", "--unseen", str(tmp_path / "sway.npz"), "--out", str(out)]) == 0
    with (out / "methods.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["simulation", "pbns", "snug", "ncs"]
    assert float(rows["simulation"]["distance"]) == 0 and float(rows["simulation"]["dynamic_share"]) == 1
    assert all(float(row["distance"]) > 0 for name, row in rows.items() if name != "simulation")
    assert (out / "methods.md").read_text().count("\n") == 2 + len(rows)
    assert len(list((out / "simulations").iterdir())) == 1 and len(list(out.glob("*.png"))) == 1
    assert methods.main([str(tmp_path / "nowhere.toml")]) == 2

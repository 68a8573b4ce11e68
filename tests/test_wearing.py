"""How a body and a garment meet: the benchmark that counts how garments are placed."""

import json
from types import SimpleNamespace

import numpy as np

from ncs_jax import InputError, io
from ncs_jax.io.packaged import ASSETS


def test_the_benchmark_of_placing_counts_what_came_home(tmp_path, monkeypatch, capsys):
    """A garment that stays where the case put it is wrong; in doubt or without a place, refused; at home, placed."""
    from benchmarks import placing

    body = io.read_body(ASSETS / "body.npz")
    made = dict(placing.garments_of(body))
    assert set(made) == {*placing.LIMBS, "skirt", "dress"} and all(len(g.faces) > 100 for g in made.values())

    def answered(answer):
        monkeypatch.setattr(placing, "place", answer)
        return placing.tried(made["shorts"], body, np.random.default_rng(2))

    def refuses(file, garment, body):
        raise InputError("no place", file=file, field="vertices", value=0, mend="none")

    left = answered(lambda file, garment, body: SimpleNamespace(garment=garment, scale=0.001, doubt=""))
    assert left["outcome"] == "wrong" and left["error"] > placing.RIGHT
    home = SimpleNamespace(garment=made["shorts"], scale=left["unit"], doubt="")
    assert answered(lambda *_: home)["outcome"] == "placed"
    assert answered(lambda *_: SimpleNamespace(**{**vars(home), "doubt": "loose"}))["outcome"] == "refused"
    assert answered(refuses)["outcome"] == "refused"
    assert placing.main(["--cases", "3", "--shared", str(tmp_path), "--json", str(tmp_path / "out.json")]) == 0
    assert "placed 0, refused 3, wrong 0" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "out.json").read_text())["cases"]) == 3

"""How a body and a garment meet: the benchmark that counts how garments are placed."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from ncs_jax import InputError, io
from ncs_jax.io.packaged import ASSETS
from ncs_jax.prepare.wearing import wearing_faults


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


def test_a_garment_that_the_body_does_not_wear_is_told():
    body, shirt = io.read_body("ncs:body"), io.read_garment("ncs:tshirt")
    assert not list(wearing_faults(shirt, body))
    (aside,) = wearing_faults(replace(shirt, vertices=shirt.vertices * 0.4 + [1.0, 0, 0]), body)
    assert aside[0] == "openings of the garment" and "none of its 4" in aside[1]
    through, *rest = wearing_faults(replace(shirt, vertices=shirt.vertices + [0.15, 0, 0]), body)
    assert through[0] == "bones through the cloth at rest" and "Spine1" in through[1] and not rest
    child = replace(body, vertices=body.vertices * 0.7, joints=body.joints * 0.7)
    (large,) = wearing_faults(io.read_garment("ncs:dress"), child)
    assert large[0] == "openings of the garment" and "of another size than this body" in large[2]


def test_cloth_with_one_opening_beside_the_body_is_no_fault():
    body, cape = io.read_body("ncs:body"), io.read_garment("ncs:tshirt")
    kept = cape.faces[(cape.vertices[cape.faces][..., 2] < -0.02).all(axis=1)]
    assert not list(wearing_faults(replace(cape, faces=kept, vertices=cape.vertices - [0, 0, 0.1]), body))

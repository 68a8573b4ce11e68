"""How a body and a garment meet: what a surface encloses; and the benchmark that counts how garments are placed."""

import json
from types import SimpleNamespace

import numpy as np
import trimesh

from ncs_jax import InputError, io
from ncs_jax.io.packaged import ASSETS
from ncs_jax.prepare.wearing import _enclosed, _even


def test_points_on_a_surface_tell_what_it_encloses():
    """Two balls that touch, as thighs do: between them the nearest skin is the other one's; a hole does not matter."""
    balls = [trimesh.creation.icosphere(3, 0.1).apply_translation([side * 0.101, 0, 0]) for side in (-1, 1)]
    both = trimesh.util.concatenate(balls)
    faces = both.faces[both.triangles_center[:, 1] < 0.095]  # each with a hole on top
    assert len(faces) < len(both.faces)
    points, normals, area = _even(np.asarray(both.vertices), np.asarray(faces), 4000)
    x = np.array(
        [[0.101, 0, 0], [-0.101, 0, 0], [0.02, 0, 0], [0.17, 0, 0], [0, 0.05, 0], [0, 0, 0.15], [0.23, 0, 0], [1, 1, 1]]
    )
    np.testing.assert_array_equal(_enclosed(x, points, normals, area), [True] * 4 + [False] * 4)
    np.testing.assert_array_equal(_enclosed(x[:4], points, -normals, area), [False] * 4)  # inside out, it encloses nothing


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

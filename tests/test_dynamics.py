"""Measures of motion, on motions whose answers are known."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.metrics.motion import MEASURES, compare_dynamics, compare_motion, hem, measure_motion, stops, unposed
from ncs_jax.prepare.build import features_from_records
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import load_scene

from .scenes import write_scene

FPS = 30.0


def walked(folder, still=60):
    """A model, and a motion that goes 1 m along x in a second and then stands still."""
    assembly = assemble(load_scene(write_scene(folder)), dtype=jnp.float64)
    record = next(iter(assembly.motions.values()))
    along = np.concatenate([np.linspace(0, 1, 31), np.ones(still)])
    poses = np.repeat(record.poses[:1], len(along), axis=0)
    model = dataclasses.replace(assembly.model, fps=FPS)
    return model, features_from_records(
        model, dataclasses.replace(record, poses=poses, translation=along[:, None] * [[1.0, 0, 0]])
    )


def moved(model, track, offsets):
    """Vertices of a garment that is so far, (frames, 3), from where the body carries its rest shape, as seen from the body."""
    rest = np.asarray(model.garment.mesh.rest)
    return np.stack(
        [np.asarray(skin(blend(m, model.blend), jnp.asarray(rest + o))) for m, o in zip(track.matrices, offsets, strict=True)]
    )


def test_the_body_is_looked_from(tmp_path):
    model, track = walked(tmp_path)
    offsets = np.linspace(0, 0.3, len(track.start))[:, None] * [[0, 1.0, 0]]
    u = unposed(model, moved(model, track, offsets), track)
    np.testing.assert_allclose(u, np.asarray(model.garment.mesh.rest)[None] + offsets[:, None], rtol=0, atol=1e-12)
    found = measure_motion(model, moved(model, track, offsets), track)
    step = 0.3 / (len(offsets) - 1)
    assert found["speed"] == pytest.approx(1000 * FPS * step, rel=1e-9)


def test_where_the_character_stops(tmp_path):
    model, track = walked(tmp_path)
    assert list(stops(track, model)) == [(31, 91)]
    _, short = walked(tmp_path, still=10)
    assert list(stops(short, model)) == []
    assert "settling" not in measure_motion(model, moved(model, short, np.zeros((41, 3))), short)


@pytest.mark.parametrize(("damping", "omega"), [(2.0, 8.0), (5.0, 8.0), (5.0, 0.0)])
def test_settling_and_overshoot_of_a_damped_swing(tmp_path, damping, omega):
    model, track = walked(tmp_path, still=150)
    t = np.maximum(np.arange(len(track.start)) - 30, 0) / FPS
    swing = np.exp(-damping * t) * np.cos(omega * t)
    found = measure_motion(model, moved(model, track, 0.05 * swing[:, None] * [[1.0, 0, 0]]), track)
    assert found["overshoot"] == pytest.approx(max(-100 * swing.min(), 0), rel=1e-3, abs=1e-6)
    speed = np.diff(swing[30:]) ** 2
    left = np.array([np.sum(speed[k:]) for k in range(121)]) / np.sum(speed)
    assert found["settling"] == pytest.approx(np.flatnonzero(left <= 0.01)[0] / FPS, abs=1e-9)
    assert found["settling"] == pytest.approx(np.log(10) / damping, abs=0.15)  # what the envelope takes to a tenth


def test_what_does_not_come_to_rest_has_no_settling_time(tmp_path):
    model, track = walked(tmp_path, still=60)
    t = np.maximum(np.arange(len(track.start)) - 30, 0) / FPS
    swing = np.exp(-0.3 * t) * np.cos(8 * t)
    found = measure_motion(model, moved(model, track, 0.05 * swing[:, None] * [[1.0, 0, 0]]), track)
    assert "settling" not in found and found["overshoot"] > 20


@pytest.mark.parametrize("late", [0, 3, 5])
def test_lag(tmp_path, late):
    model, track = walked(tmp_path)
    low = hem(model)
    carried = moved(model, track, np.zeros((len(track.start), 3)))
    delayed = carried[np.maximum(np.arange(len(carried)) - late, 0)]
    assert len(low) >= 1 and measure_motion(model, delayed, track)["lag"] == pytest.approx(late / FPS, abs=0.2 / FPS)


def test_beside_a_reference(tmp_path):
    model, track = walked(tmp_path, still=150)
    t = np.arange(len(track.start)) / FPS
    swing = 0.05 * (np.exp(-t) * np.sin(7 * t))[:, None] * [[1.0, 0, 0]]
    reference = moved(model, track, swing)
    same = compare_motion(model, reference, reference, track)
    assert same["dynamic_share"] == pytest.approx(1) and same["stopped_share"] == pytest.approx(1)
    assert same["hem_correlation"] == pytest.approx(1) and same["distance"] == 0
    half = compare_motion(model, moved(model, track, swing / 2), reference, track)
    assert half["dynamic_share"] == pytest.approx(0.5) and half["hem_correlation"] == pytest.approx(1)
    assert half["distance"] == pytest.approx(1000 * np.abs(swing[:, 0]).mean() / 2, rel=1e-6)
    rigid = compare_motion(model, moved(model, track, 0 * swing), reference, track)
    assert rigid["dynamic_share"] == pytest.approx(0, abs=1e-9)
    parts = compare_dynamics(reference, reference, reference, reference)
    assert [*measure_motion(model, reference, track), "gain", *half, *parts] == list(MEASURES)


def test_parts_beside_those_of_a_reference():
    """Static error, direction and size of the dynamic part are told apart."""
    rng = np.random.default_rng(0)
    static, true, other = rng.normal(size=(3, 40, 30, 3))
    other -= true * np.sum(other * true) / np.sum(true * true)
    other *= np.linalg.norm(true) / np.linalg.norm(other)  # as large, and unrelated
    offset = np.array([0.003, 0.0, 0.004])
    found = compare_dynamics(static + offset + 0.5 * true, static + offset, static + true, static)
    assert found == pytest.approx({"static_distance": 5, "dynamic_correlation": 1, "dynamic_factor": 2})
    found = compare_dynamics(static + true + other, static, static + true, static)
    assert found == pytest.approx({"static_distance": 0, "dynamic_correlation": 0.5**0.5, "dynamic_factor": 0.5})
    nothing = compare_dynamics(static, static, static + true, static)
    assert np.isnan(nothing["dynamic_correlation"]) and np.isnan(nothing["dynamic_factor"])

"""Shares of many motions: what a round deals out, and that training on them goes on as if it had never stopped."""

from __future__ import annotations

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from ncs_jax.errors import InputError
from ncs_jax.prepare.build import TrainingMotions, features_from_records
from ncs_jax.runs.placed_scene import PlacedScene
from ncs_jax.runs.train import train
from ncs_jax.training import shares
from ncs_jax.training.devices import check_fits
from ncs_jax.training.loss import with_bodies
from ncs_jax.training.shares import shares_of

from .ready import assembled
from .scenes import FREE, swing, write_scene

LIGHT = '[physics.membrane]\nmodel = "mass_spring"\n[physics.bending]\nstiffness = 0\n'  # compiles fast


def frames(pieces, *, ends):
    """Return the frames of pieces as pairs of motion and frame, or those at which windows end."""
    return [(p.motion, t) for p in pieces for t in range(p.first + (p.lead if ends else 0), p.stop)]


@pytest.mark.parametrize("lengths", [[5000], [40] * 300, [1, 3000, 90, 5000, 2, 700]])
def test_a_round_has_every_frame_once_and_shares_are_alike(lengths):
    dealt = shares_of(lengths, window=11)
    each = [dealt.share(3, number) for number in range(2 * dealt.count)]
    sizes = [len(frames(pieces, ends=False)) for pieces in each]
    assert max(sizes) <= dealt.size <= shares.SHARE and min(sizes) >= 0.8 * dealt.size and dealt.count >= 2
    for turn in (each[: dealt.count], each[dealt.count :]):
        seen = sorted(frame for pieces in turn for frame in frames(pieces, ends=True))
        assert seen == [(motion, t) for motion, length in enumerate(lengths) for t in range(length)]
    assert each[0] != each[dealt.count] and each[0] == dealt.share(3, 0) != dealt.share(4, 0)
    spread = frames(dealt.spread(), ends=False)
    assert spread[0] == (0, 0) and 0.5 * dealt.size < len(spread) <= dealt.size
    assert spread[-1][0] >= len(lengths) - 1 - 0.1 * len(lengths)


@pytest.mark.parametrize("window", [11, 200])
def test_a_window_of_a_piece_sees_what_was_before_it(window):
    dealt = shares_of([3000] * 9, window)
    for piece in dealt.pieces:
        assert piece.lead >= min(window - 1, piece.first + piece.lead)
    assert shares_of([shares.SHARE], 11) is None


@pytest.fixture
def small(monkeypatch):
    """Make shares small."""
    for name, size in (("SHARE", 120), ("PIECE", 12), ("LEAD", 3)):
        monkeypatch.setattr(shares, name, size)


@pytest.fixture
def many(small):
    """Return a small scene whose motions are more than a share has, and these motions."""
    a = assembled()
    record = next(iter(a.motions.values()))
    rng = np.random.default_rng(0)
    records = tuple(
        dataclasses.replace(
            record,
            poses=np.cumsum(rng.normal(size=(n, *record.poses.shape[1:])), axis=0) * 0.05,
            translation=np.cumsum(rng.normal(size=(n, 3)), axis=0) + 20 * i,
        )
        for i, n in enumerate((100, 7, 60))
    )
    motions = TrainingMotions(records, shares_of([100, 7, 60], 3))
    track, _ = motions.features(a.model, motions.shares.spread())
    return dataclasses.replace(a, training=motions, training_features=track)


def test_features_of_a_share_are_those_of_its_motions(many):
    motions, whole = many.training, [features_from_records(many.model, record) for record in many.training.records]
    pieces = motions.shares.share(0, 1)
    found, ends = motions.features(many.model, pieces)
    every, may_end = frames(pieces, ends=False), frames(pieces, ends=True)
    assert [every[t] for t in ends] == may_end and len(found.start) == motions.shares.size
    first, _ = motions.features(many.model, motions.shares.share(0, 0))
    shapes = [list(map(np.shape, jax.tree.leaves(features))) for features in (first, found, many.track)]
    assert shapes[0] == shapes[1] == shapes[2] and len(shapes[0]) == 5  # with an origin: one program for all
    here, *there = (np.asarray(m.absolute(m.matrices[..., 3])) for m in (found, *whole))
    for t, (motion, frame) in zip(ends, may_end, strict=True):
        np.testing.assert_allclose(found.static[t], whole[motion].static[frame], atol=1e-6)
        np.testing.assert_allclose(found.dynamic[t], whole[motion].dynamic[frame], atol=1e-4)
        place = [places[i] for places, i in ((here, t), (there[motion], frame))]
        np.testing.assert_allclose(*place, atol=1e-4)
    still = found.static[len(every) :]
    assert len(still) and (still == still[:1]).all() and not found.dynamic[len(every) :].any()


def test_training_takes_one_share_after_another_whenever_it_begins(many, plain_jax):
    scene = many.scene
    spec = dataclasses.replace(scene.training, checkpoint_every=20, batch=4)
    a = dataclasses.replace(many, scene=dataclasses.replace(scene, training=spec))
    through, later = PlacedScene(a, 0), PlacedScene(a, 0)
    state = through.initial_state()
    seen = []
    for step in range(0, 60, 10):
        if step % 20 == 0:
            through.refresh(state.params, step)
        seen.append((np.asarray(through.features.static), through._ends(step, 10)))
    later.refresh(state.params, 40)
    for static, ends in seen[4:5]:
        np.testing.assert_array_equal(static, later.features.static)
        np.testing.assert_array_equal(ends, later._ends(40, 10))
    assert not np.array_equal(seen[0][0], seen[2][0]) and np.array_equal(seen[0][0], seen[1][0])
    assert not np.array_equal(seen[0][1], seen[1][1])
    once = np.concatenate([seen[0][1], seen[1][1]]).ravel()[: len(through._last)]
    assert len(set(once.tolist())) == len(once)
    piece = later._pieces[1]
    at = later._pieces[0].stop - later._pieces[0].first
    mirrored = ", mirrored" if piece.motion else ""  # the scene names one file
    assert later._named(at + 2) == f" (that is frame {piece.first + 2} of {many.scene.motion.files[0]}{mirrored})"


def test_bodies_are_posed_when_compiling_has_given_back_what_it_took(many, plain_jax, monkeypatch):
    placed = PlacedScene(many, 0)
    state, every = placed.initial_state(), placed._every
    placed.refresh(state.params, 0)
    placed.compile(state, 10)
    assert placed._everywhere is None
    program = placed._compiled[10]
    size = program.memory_analysis()
    besides = size.temp_size_in_bytes + size.output_size_in_bytes - size.alias_size_in_bytes
    monkeypatch.setattr("ncs_jax.training.devices.free_memory", lambda: besides)
    check_fits(program, 4)
    with pytest.raises(InputError, match="does not fit into memory"):
        check_fits(program, 4, there=size.argument_size_in_bytes - 1)
    state, _ = placed.run_chunk(state, 0, 10, 10)
    assert list(placed._compiled.values()) == [program]
    (_, features), anew = placed._everywhere, with_bodies(many.model, placed.features, 4).bodies
    np.testing.assert_array_equal(features.bodies, anew)
    placed.refresh(state.params, every)  # from now on at once: what a refresh takes is measured
    assert not np.array_equal(placed._everywhere[1].bodies, anew)


def test_resumed_between_two_shares_a_run_is_that_which_went_through(small, tmp_path, plain_jax):
    text = FREE.replace('files = ["swing.npz"]', 'files = ["walks"]').replace("validation", "# ")
    scene = write_scene(tmp_path, text.replace('cell = "gated"', 'method = "pbns"') + LIGHT)
    (tmp_path / "walks").mkdir()
    for number in range(9):
        np.savez(tmp_path / "walks" / f"{number}.npz", **swing(frames=20 + number, size=0.1 * number))
    through = train(scene, tmp_path / "run", steps=40)
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "40")
    resumed = train(scene, tmp_path / "run", resume=True)
    pairs = zip(jax.tree.leaves(through.params), jax.tree.leaves(resumed.params), strict=True)
    assert all(np.array_equal(x, y) for x, y in pairs) and resumed.steps == 40
    kept = json.loads((tmp_path / "run" / "run.json").read_text())["scene"]["motion"]["files"]
    assert kept == [str(tmp_path / "walks" / f"{number}.npz") for number in range(9)]

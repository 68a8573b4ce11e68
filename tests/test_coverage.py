"""What a run knows of the motions that it was trained on: near ones are quiet, far ones are told with frame and joint."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.metrics.coverage import (
    CLOSE,
    FAR,
    KEPT,
    STRAINED,
    STRAINS,
    TOLD,
    _described,
    _nearest,
    coverage,
    trained_motion,
    with_strain,
)
from ncs_jax.metrics.quality import measure_on_host
from ncs_jax.prepare.build import features_from_records
from ncs_jax.runs.checkpoint import read_trained, write_trained
from ncs_jax.runs.run import Run
from ncs_jax.training.step import initial_state

from .ready import assembled
from .scenes import swing


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def record(**options):
    arrays = swing(frames=60, **options)
    return io.MotionRecord(arrays["poses"], arrays["trans"], 30.0, ())


def seen(trained, assembly, motion, **options):
    return coverage(trained, assembly.model, features_from_records(assembly.model, motion), **options)


@pytest.fixture
def known():
    assembly = assembled()
    return assembly, trained_motion(assembly.model, features_from_records(assembly.model, record()))


def test_what_was_trained_on_is_inside_and_so_is_another_heading(known):
    assembly, trained = known
    found = seen(trained, assembly, record())
    assert found.share == 0 and not found.told and found.distance.max() <= 0.5 and found.joints == ("0", "1")
    assert "every frame is near" in str(found)
    turned = record()
    turned.poses[:, 0, 1] += 2.0
    assert np.allclose(seen(trained, assembly, turned).poses, found.poses, atol=1e-4)


def test_a_pose_beyond_is_told_with_its_frame_and_joint(known):
    assembly, trained = known
    far = record(size=1.3)
    found = seen(trained, assembly, far)
    worst = int(np.abs(far.poses[:, 1, 0]).argmax())
    assert found.worst[1:] == ("1", "pose") and np.isclose(far.poses[found.worst[0], 1, 0], far.poses[worst, 1, 0])
    # Beyond 0.5 rad at rest and 1.3 rad there: two columns turn and gravity does, each by a chord of that angle.
    chord = np.sqrt(2) * 2 * np.sin(0.4)
    assert np.isclose(found.poses.max() * FAR, chord, rtol=0.05)
    assert found.told and found.excess > TOLD and np.array_equal(found.outside, found.distance > 1)
    assert (
        f"{found.share:.0%} of the frames" in str(found)
        and "joint" not in str(found)
        and "--adapt 20 (in Python ncs_jax.adapt)" in str(found)
    )
    facts = found.facts()
    assert facts["worst"] == {"frame": found.worst[0], "joint": "1", "by": "pose"} and facts["told"] is True


def test_speeds_beyond_count_where_a_network_reads_them(known):
    assembly, trained = known
    motion = record()
    fast = replace(motion, poses=motion.poses[:31:5], translation=motion.translation[:31:5])
    found = seen(trained, assembly, fast)
    assert found.poses.max() < 1 < found.speeds.max() and found.worst[2] == "speed"
    assert seen(trained, assembly, fast, moving=False).share == 0
    slower = replace(motion, poses=motion.poses[:31:2][:12], translation=motion.translation[:31:2][:12])
    assert seen(trained, assembly, slower).distance.max() <= 1


def test_cloth_strained_more_than_in_training_is_told_whatever_the_pose(known):
    """Its energy is quadratic: at `STRAINED` times it is a tenth above; where the strain is known, it decides."""
    assembly, trained = known
    assert seen(trained, assembly, record(), strain=np.full(60, 3.0)).strain == 0  # an earlier version has none to compare with
    trained = replace(trained, strain=1.5)
    for ratio, told in ((0.8, False), (STRAINED - 0.01, False), (STRAINED + 0.01, True)):
        found = seen(trained, assembly, record(), strain=np.full(60, 1.5 * ratio))
        assert found.strain == pytest.approx(ratio) and found.told == told and not found.outside.any()
    assert found.excess == pytest.approx(TOLD, rel=0.05) and found.facts()["strain"] == round(STRAINED + 0.01, 3)
    assert "its poses and speeds are near" in str(
        found
    ) and ", but the cloth is strained 1.5 times as much as there; adapt it" in str(found)
    far = seen(trained, assembly, record(size=1.3), strain=np.full(60, 1.5))
    assert far.outside.any() and far.excess == 0 and not far.told and "strained" not in str(far)


def test_a_frame_near_a_trained_one_is_compared_with_that_one_and_others_with_the_mean(known):
    """So a motion that was trained on is not told for straining more than calm ones, nor another for a calm one being near."""
    assembly, trained = known
    track = features_from_records(assembly.model, record())
    strain = 0.5 + 8 * np.abs(record().poses[:, 1, 0])  # of the pose
    trained = with_strain(trained, assembly.model, track, np.arange(60), strain.__getitem__)
    assert len(np.unique(trained.frames, axis=0)) == len(trained.frames) > 10 and trained.frame_radius < CLOSE
    assert trained.strain == pytest.approx(strain.mean(), rel=0.02)
    trained = replace(trained, strain=1.0)  # as with calm ones
    again = seen(trained, assembly, record(), strain=strain)
    lowest = strain.mean() / np.maximum(strain, 1).mean()  # those below the mean are compared with the mean
    assert again.strain == pytest.approx(lowest, abs=0.1) and not again.told
    assert seen(trained, assembly, record(), strain=strain[::7], every=7).strain == pytest.approx(again.strain, abs=0.1)
    assert seen(trained, assembly, record(), strain=2 * strain).told
    far = replace(record(), poses=record().poses + np.array([0, 0, 1.5]))
    assert seen(trained, assembly, far, strain=strain).strain == pytest.approx(strain.mean())


def test_few_frames_are_kept_of_many_motions(known, rng):
    assembly, trained = known
    poses = rng.normal(size=(3000, 2, 3)).astype(np.float32)
    track = features_from_records(assembly.model, replace(record(), poses=poses, translation=np.zeros((3000, 3), np.float32)))
    kept = with_strain(trained, assembly.model, track, np.arange(1000, 3000), lambda some: some.astype(float))
    assert len(kept.frames) == STRAINS and min(kept.frame_strain) >= 1000 and kept.strain == pytest.approx(2000, abs=10)
    far, which = _nearest(_described(assembly.model, track)[0], kept.frames)
    away = np.linalg.norm(_described(assembly.model, track)[0][:, None] - kept.frames.astype(float), axis=-1).max(axis=-1)
    assert np.allclose(far, away.min(axis=1), atol=5e-3) and np.allclose(away[np.arange(3000), which], far, atol=5e-3)
    assert np.isclose(np.mean(far <= kept.frame_radius), 0.95, atol=0.001)


def test_few_poses_are_kept_and_every_trained_one_is_near_one(known, rng):
    assembly, _ = known
    motion = record()
    many = replace(motion, poses=rng.normal(size=(2000, 2, 3)).astype(np.float32), translation=np.zeros((2000, 3), np.float32))
    track = features_from_records(assembly.model, many)
    trained = trained_motion(assembly.model, track)
    assert np.bincount(trained.joint).tolist()[1] == KEPT and sum(np.asarray(a).nbytes for a in vars(trained).values()) < 50_000
    found = coverage(trained, assembly.model, track)
    assert np.mean(found.poses > 0.02) < 0.06 and trained.radius[1] > FAR > trained.radius[0]  # gravity lies on a sphere


def test_the_nearest_pose_is_that_of_a_plain_search(rng):
    poses, kept = rng.normal(size=(1100, 9)), rng.normal(size=(40, 9))
    plain = [min(np.linalg.norm(p - k) for k in kept) for p in poses]
    assert np.allclose(_nearest(poses[:, None], kept[:, None])[0], plain)


def test_it_is_kept_and_found_again_where_it_was_not(known, tmp_path):
    assembly, trained = known
    assert read_trained(tmp_path, assembly.model) is None
    whole = strained(known)
    for each in (trained, whole):
        write_trained(tmp_path, each)
        back = read_trained(tmp_path, assembly.model)
        assert all(np.array_equal(a, b) for a, b in zip(vars(back).values(), vars(each).values(), strict=True))
    for lacking in (FRAMES, ["strain", *FRAMES]):
        np.savez(tmp_path / "trained.npz", **{name: value for name, value in vars(whole).items() if name not in lacking})
        back = read_trained(tmp_path, assembly.model)  # of earlier versions
        assert back.strain == (0 if "strain" in lacking else whole.strain)
        ratio = seen(back, assembly, record(), strain=np.full(60, 2 * whole.strain)).strain
        assert ratio == (0 if "strain" in lacking else pytest.approx(2))


FRAMES = ["frames", "frame_strain", "frame_radius"]


def strained(known):
    assembly, trained = known
    track = features_from_records(assembly.model, record())
    return with_strain(trained, assembly.model, track, np.arange(60), lambda some: 1.25 + 0.01 * some)


@pytest.mark.parametrize(
    "change, field",
    [
        (lambda w: {"poses": w["poses"][:, :6]}, "poses"),
        (lambda w: {"poses": w["poses"] * np.float16("nan")}, "poses"),
        (lambda w: {"joint": w["joint"][:10]}, "joint"),
        (lambda w: {"joint": np.zeros_like(w["joint"])}, "joint"),
        (lambda w: {"radius": w["radius"][:-1]}, "radius"),
        (lambda w: {"rates": w["rates"] * np.nan}, "rates"),
        (lambda w: {"accelerations": -1 - w["accelerations"]}, "accelerations"),
        (lambda w: {"strain": np.float64("nan")}, "strain"),
        (lambda w: {"strain": np.float64(-1)}, "strain"),
        (lambda w: {"strain": np.ones(3)}, "strain"),
        (lambda w: {"strain": "1"}, "strain"),
        (lambda w: {"frames": w["frames"][:, :1]}, "frames"),
        (lambda w: {"frames": w["frames"].reshape(len(w["frames"]), -1)}, "frames"),
        (lambda w: {"frames": w["frames"] + np.float16("inf")}, "frames"),
        (lambda w: {"frame_strain": w["frame_strain"][:5]}, "frame"),
        (lambda w: {"frame_strain": w["frame_strain"] * np.nan}, "frame_strain"),
        (lambda w: {"frame_strain": np.array(["a"] * len(w["frames"]))}, "frame_strain"),
        (lambda w: {"frame_radius": np.ones(4)}, "frame_radius"),
        *((lambda w, name=name: {name: None}, name) for name in ("poses", "radius", "strain", *FRAMES)),
    ],
)
def test_a_file_that_contradicts_itself_is_refused_with_its_field(known, tmp_path, change, field):
    """It was taken in silence, and NaN came into what is written, or ended in a traceback."""
    whole = vars(strained(known))
    np.savez(tmp_path / "trained.npz", **{name: value for name, value in (whole | change(whole)).items() if value is not None})
    with pytest.raises(InputError, match=r"trained\.npz.*delete this file") as refused:
        read_trained(tmp_path, known[0].model)
    assert field in str(refused.value.field)


def test_a_file_that_is_cut_off_is_refused(known, tmp_path):
    write_trained(tmp_path, known[1])
    (tmp_path / "trained.npz").write_bytes((tmp_path / "trained.npz").read_bytes()[:200])
    with pytest.raises(InputError, match=r"trained\.npz.*delete this file"):
        read_trained(tmp_path, known[0].model)


def test_a_run_that_keeps_no_strain_finds_it_again_from_its_motions(known):
    """One of an earlier version, or one that was interrupted: its motions are there, and so is the network."""
    assembly, trained = known
    params = initial_state(assembly.model, assembly.network, 0).params
    motions = {name: record() for name in assembly.scene.motion.files} or {"m": record()}
    scene = replace(assembly.scene, motion=replace(assembly.scene.motion, files=tuple(motions)))
    assembly = replace(assembly, scene=scene, motions=motions)
    for there in (None, trained, replace(trained, strain=3.0)):
        run = Run(assembly, params, trained=there)
        found, strain = run.known, measure_on_host(assembly.model, run.animate(record()))["strain_mean"]
        assert len(found.frames) > 10 and found.strain == pytest.approx(strain.mean(), rel=0.02) and run.known is found
        assert set(found.frame_strain) <= set(strain.astype(np.float32))
        assert run.coverage(record()).strain == pytest.approx(
            strain.mean() / np.maximum(strain, strain.mean()).mean(), rel=0.05
        )
    gone = Run(replace(assembly, motions={}), params)
    assert gone.known is None and gone.coverage(record()) is None
    old = Run(replace(assembly, motions={}), params, trained=replace(trained, strain=3.0))
    assert old.known is old.trained

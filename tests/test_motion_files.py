"""Motions as people bring them: headers of .bvh as tools write them, and rotations in .npz in every form."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io.character.smpl import smpl_parents
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.scene_checks import _cut_short, _radians
from ncs_jax.scene.spec import scene_from

HIERARCHY = """\
HIERARCHY
ROOT Hips
{
  OFFSET 0.5 90.25 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0.0 20.5 0.0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 10.5 0.0
    }
  }
}
"""
FRAMES = np.round(np.random.default_rng(3).uniform(-80, 80, (8, 9)), 4)


def rows(numbers=FRAMES, comma: str = ".", between: str = " ") -> str:
    return "".join(between.join(f"{n:.4f}".replace(".", comma) for n in row) + "\n" for row in numbers)


def bvh(head: str = "Frames: 8\nFrame Time: 0.033333\n", data: str = "", hierarchy: str = HIERARCHY) -> str:
    return f"{hierarchy}MOTION\n{head}{data or rows()}"


def read(tmp_path, data: str | bytes, name: str = "", **options) -> io.MotionRecord:
    path = tmp_path / "m.bvh"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return io.read_motion(f"{path}{name}", **options)


PLAIN = bvh()
SPELLED = {  # the same motion as other tools spell it
    "blank before the colon": PLAIN.replace("Frames:", "Frames :").replace("Frame Time:", "Frame Time :"),
    "tabs": PLAIN.replace("Frames: ", "Frames:\t").replace("Frame Time: ", "Frame Time:\t").replace(" ", "\t"),
    "upper case": PLAIN.upper().replace("SPINE", "Spine").replace("HIPS", "Hips"),
    "lower case": PLAIN.lower().replace("spine", "Spine").replace("hips", "Hips"),
    "Windows": PLAIN.replace("\n", "\r\n"),
    "old Mac": PLAIN.replace("\n", "\r"),
    "blank lines": PLAIN.replace("\n", "\n\n") + "\n\n",
    "blanks at the ends": PLAIN.replace("\n", "  \n"),
    "a byte order mark": "\ufeff" + PLAIN,
    "UTF-16": PLAIN.encode("utf-16"),
    "UTF-16 without a mark": PLAIN.encode("utf-16-le"),
    "comments": "# recorded today\n// at 30\n; by me\n" + PLAIN.replace("MOTION", "  # the motion\nMOTION // now"),
    "a comment on a line": PLAIN.replace("90.25 0.0", "90.25 0.0 # hips").replace("0.033333", "0.033333 ; 30 fps"),
    "comments between frames": bvh(data="# first\n" + rows(FRAMES[:3]) + "# later\n" + rows(FRAMES[3:])),
    "no end site": bvh(hierarchy=HIERARCHY.replace("End Site\n    {\n      OFFSET 0.0 10.5 0.0\n    }\n", "")),
    "a named end site": PLAIN.replace("End Site", "End Site SpineEnd"),
    "an end site without channels": PLAIN.replace("0.0 10.5 0.0\n", "0.0 10.5 0.0\n      CHANNELS 0\n"),
    "scientific": bvh(data="".join(" ".join(f"{n:.8e}".replace("e-0", "e-00") for n in row) + "\n" for row in FRAMES)),
    "commas between": bvh(data=rows(between=", ")),
    "wrapped lines": bvh(data=rows().replace(" ", "\n", 40)),
    "ended by an old editor": PLAIN + "\x1a\0\0",
    "OFFSETs with commas": bvh(hierarchy=HIERARCHY.replace(".5", ",5").replace(".25", ",25")),
}


@pytest.mark.parametrize("case", SPELLED)
def test_a_bvh_is_read_however_it_is_spelled(tmp_path, case):
    plain, found = read(tmp_path, PLAIN), read(tmp_path, SPELLED[case])
    assert found.joint_names == ("Hips", "Spine") and found.fps == 30 and found.notes == ()
    np.testing.assert_array_equal(found.poses, plain.poses)
    np.testing.assert_array_equal(found.translation, FRAMES[:, :3] - [0.5, 90.25, 0])
    np.testing.assert_array_equal(found.joints, plain.joints)
    expected = Rotation.from_euler("ZXY", FRAMES[:, 6:], degrees=True).as_rotvec()
    np.testing.assert_allclose(found.poses[:, 1], expected, atol=1e-12)


HEADS = {  # what is not as it should be: frames that are read, and a note
    "one more": ("Frames: 7", rows(), 7, "its header says 7 frames; 1 more at the end"),
    "two more": ("Frames: 6", rows(), 6, "its header says 6 frames; 2 more at the end"),
    "one fewer": ("Frames: 9", rows(), 8, "its header says 9 frames, 8 are there"),
    "cut short": ("Frames: 800", rows(), 8, "its header says 800 frames, 8 are there"),
    "half a frame more": ("Frames: 8", rows() + "1.0 2.0\n", 8, "the last, of 2 numbers instead of 9, is left out"),
    "half a frame": ("Frames: 8", rows()[:-30], 7, "8 frames, 7 are there.*the last, of . numbers instead of 9, is left out"),
    "never filled in": ("Frames: 0", rows(), 8, "its header says 0 frames, 8 are there"),
    "left at one": ("Frames: 1", rows(), 8, "its header says 1 frames, 8 are there"),
    "decimal commas": ("Frames: 8", rows(comma=","), 8, "decimal commas"),
}  # fmt: skip


@pytest.mark.parametrize("case", HEADS)
def test_frames_that_the_header_does_not_count_are_told(tmp_path, case):
    head, data, frames, note = HEADS[case]
    found = read(tmp_path, bvh(f"{head}\nFrame Time: 0.033333\n", data))
    np.testing.assert_array_equal(found.poses, read(tmp_path, PLAIN).poses[:frames])
    assert len(found.notes) == 1
    assert re.search(note, found.notes[0]), found.notes


@pytest.mark.parametrize("case", HEADS)
def test_a_file_that_is_cut_short_is_at_risk(tmp_path, case):
    head, data, frames, _ = HEADS[case]
    found = read(tmp_path, bvh(f"{head}\nFrame Time: 0.033333\n", data))
    risks = list(_cut_short(found, "a.bvh", ()))
    assert [risk.value for risk in risks] == {
        "cut short": ["8 of the 800 frames that its header says are there, in a.bvh"],
        "half a frame": ["7 of the 8 frames that its header says are there, in a.bvh"],
    }.get(case, [])
    assert not list(_cut_short(found, "a.bvh", (0, frames)))


def test_rotations_that_may_be_radians_are_at_risk(tmp_path):
    """All within half a turn in radians, in enough frames; not where one is larger, nor in a few frames."""
    few = np.tile(FRAMES, (3, 1))
    few[:, 3:] *= 3.1 / np.abs(few[:, 3:]).max()
    large = few.copy()
    large[5, 4] = 3.2
    told = []
    for values in (few, large, few[:8]):
        record = read(tmp_path, bvh(f"Frames: {len(values)}\nFrame Time: 0.033333\n", rows(values)))
        told.append([risk.value for risk in _radians(record, "a.bvh")])
    assert told == [["at most 3.1 degrees, in a.bvh"], [], []]


@pytest.mark.parametrize(
    ("printed", "fps"),
    [
        ("0.0333333", 30), ("0.0333", 30), ("0.033", 30), ("0.03", 30), ("0,033333", 30), ("3.3333e-02", 30), (".0333", 30),
        ("0.00833333", 120), ("0.0083", 120), ("0.008", 125), ("0.017", 60), ("0.0167", 60), ("0.0417", 24), ("0.04", 25),
        ("0.02", 50), ("0.01", 100), ("0.1", 10), ("0.005", 200), ("0.0333667", 1 / 0.0333667), ("0.0152", 1 / 0.0152),
        ("33.333", 30), ("16.67", 60), ("8.3333", 120), ("41.67", 24),
    ],
)  # fmt: skip
def test_frame_times_are_rounded_where_they_are_printed(tmp_path, printed, fps):
    found = read(tmp_path, bvh(f"Frames: 8\nFrame Time: {printed}\n"))
    assert found.fps == pytest.approx(fps, rel=1e-12)
    assert [n for n in found.notes if "milliseconds" in n] == list(found.notes[: float(printed.replace(",", ".")) > 1])


REFUSED = {
    "no time": (bvh("Frames: 8\nFrame Time: 0\n"), r"Frame Time: seconds above 0 expected .found '0'.; write 1/fps, 0.033333"),
    "a rate": (bvh("Frames: 8\nFrame Time: 30\n"), "Frame Time: .*write 0.0333333 if it is frames per second, 0.03 if"),
    "a film's rate": (bvh("Frames: 8\nFrame Time: 29.97\n"), "Frame Time: .*if it is frames per second"),
    "NaN of Microsoft": (PLAIN.replace(f"{FRAMES[5, 7]:.4f}", "-nan(ind)"), r"poses, frame 5, joint 1 \(Spine\): finite"),
    "NaN of old": (PLAIN.replace(f"{FRAMES[2, 4]:.4f}", "-1.#IND00"), r"poses, frame 2, joint 0 \(Hips\): finite"),
    "NaN": (PLAIN.replace(f"{FRAMES[4, 8]:.4f}", "nan"), r"poses, frame 4, joint 1 \(Spine\): finite"),
    "infinite": (PLAIN.replace(f"{FRAMES[3, 1]:.4f}", "1.#INF"), "trans, frame 3: finite"),
    "a word": (PLAIN.replace(f"{FRAMES[6, 7]:.4f}", "1.2.3"), "MOTION, frame 6, Xrotation of Spine: numbers expected"),
    "too many columns": (bvh(data=rows(np.tile(FRAMES, 2)[:, :12])), "8 frames of 9 channels expected.*a line of 12"),
    "too few columns": (bvh(data=rows(FRAMES[:, :6])), "8 frames of 9 channels expected.*a line of 6"),
    "no frames": (bvh(data="\n"), "8 frames of 9 channels expected.*0 numbers"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_a_bvh_cannot_mean_is_refused_by_name(tmp_path, case):
    data, message = REFUSED[case]
    with pytest.raises(InputError, match=message):
        read(tmp_path, data)
    if "finite" in message:  # the other frames are good
        assert len(read(tmp_path, data, frame_range=(0, 2)).poses) == 2


@pytest.mark.parametrize(
    ("name", "encoding"),
    [
        ("左足", "cp932"),
        ("腰", "cp932"),
        ("センター", "utf-16"),
        ("Hüfte", "latin-1"),
        ("hanché", "latin-1"),
        ("Bip01 左足", "utf-8"),
        ("左大腿", "gb18030"),
        ("髋部", "gb18030"),
        ("왼쪽 어깨", "euc-kr"),
        ("척추", "euc-kr"),
        ("créé à Noël", "latin-1"),
    ],
)
def test_names_in_the_encodings_of_their_tools(tmp_path, name, encoding):
    found = read(tmp_path, PLAIN.replace("Spine", name).encode(encoding))
    assert found.joint_names == ("Hips", name)
    np.testing.assert_array_equal(found.poses, read(tmp_path, PLAIN).poses)


def test_names_with_blanks_and_hashes_are_kept(tmp_path):
    assert read(tmp_path, PLAIN.replace("Spine", "Left Arm #1 // a")).joint_names[1] == "Left Arm #1 // a"


def test_of_several_skeletons_the_largest_or_the_named_is_read(tmp_path):
    prop = "ROOT Prop\n{\nOFFSET 1.5 0.0 0.0\nCHANNELS 3 Xposition Yposition Zposition\n}\n"
    twin = HIERARCHY.replace("HIERARCHY\n", "").replace("Hips", "Hips2")
    extra = np.arange(24.0).reshape(8, 3)
    before = bvh(data=rows(np.hstack([extra, FRAMES])), hierarchy=HIERARCHY.replace("ROOT Hips", prop + "ROOT Hips"))
    after = bvh(data=rows(np.hstack([FRAMES, extra])), hierarchy=HIERARCHY + prop)
    both = bvh(data=rows(np.hstack([FRAMES, FRAMES[::-1]])), hierarchy=HIERARCHY + twin)
    plain = read(tmp_path, PLAIN)
    for data, other in ((before, r"Prop \(1 joints\)"), (after, r"Prop \(1 joints\)"), (both, r"Hips2 \(2 joints\)")):
        found = read(tmp_path, data)
        np.testing.assert_array_equal(found.poses, plain.poses)
        np.testing.assert_array_equal(found.translation, plain.translation)
        assert found.parents.tolist() == [-1, 0]
        assert re.search(f"Hips.*FILE#NAME reads another: {other}", found.notes[0])
    second = read(tmp_path, both, "#Hips2")
    np.testing.assert_array_equal(second.poses, plain.poses[::-1])
    assert second.joint_names == ("Hips2", "Spine") and second.parents.tolist() == [-1, 0]
    np.testing.assert_array_equal(read(tmp_path, after, "#Prop").translation, extra - [1.5, 0, 0])
    with pytest.raises(InputError, match=r"no such ROOT .found 'Prop'.; write FILE#NAME with one of Hips, Hips2"):
        read(tmp_path, both, "#Prop")


# --- rotations in .npz --------------------------------------------------------------------------------------------------------


def save(tmp_path, **arrays) -> io.MotionRecord:
    frames = len(next(iter(arrays.values())))
    np.savez(tmp_path / "m.npz", trans=np.zeros((frames, 3)), fps=30.0, **arrays)
    return io.read_motion(tmp_path / "m.npz")


def moving(rng, degrees: float, frames: int = 6, joints: int = 5) -> Rotation:
    axes = rng.normal(size=(frames * joints, 3))
    return Rotation.from_rotvec(np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True))


@pytest.mark.parametrize("w_first", [True, False])
@pytest.mark.parametrize("degrees", [0, 25, 80])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quaternions_called_poses_tell_their_order(tmp_path, rng, w_first, degrees, dtype):
    turns = moving(rng, degrees)
    q = (turns.as_quat(scalar_first=w_first) * rng.choice([-1, 1], (30, 1))).reshape(6, 5, 4).astype(dtype)
    q[:, 0] = Rotation.from_euler("x", 150, degrees=True).as_quat(scalar_first=w_first)  # a root that lies down
    found = save(tmp_path, poses=q)
    expected = turns.as_rotvec().reshape(6, 5, 3)[:, 1:]
    np.testing.assert_allclose(found.poses[:, 1:], expected, atol=2e-6 if dtype == np.float32 else 1e-12)
    np.testing.assert_allclose(found.poses[:, 0], np.tile([np.radians(150), 0, 0], (6, 1)), atol=2e-6)
    assert found.notes == (f"its poses are read as quaternions ({'w, x, y, z' if w_first else 'x, y, z, w'})",)
    assert found.poses.dtype == dtype


def test_quaternions_of_either_order_are_not_guessed(tmp_path, rng):
    for turns in (moving(rng, 120), Rotation.from_rotvec(np.tile([0, 0, np.pi / 2], (30, 1)))):
        q = turns.as_quat().reshape(6, 5, 4)
        with pytest.raises(InputError, match=r"poses: quaternions of which most.*write them as `quaternions`"):
            save(tmp_path, poses=q)
    q = moving(rng, 30).as_quat().reshape(6, 5, 4)
    q[4, 2] *= 3
    with pytest.raises(InputError, match=r"poses, frame 4, joint 2: .*a unit quaternion, expected"):
        save(tmp_path, poses=q)


def test_rotation_matrices_called_poses(tmp_path, rng):
    turns = moving(rng, 70)
    matrices = turns.as_matrix().reshape(6, 5, 3, 3)
    found = save(tmp_path, poses=matrices)
    np.testing.assert_allclose(found.poses, turns.as_rotvec().reshape(6, 5, 3), atol=1e-12)
    assert found.notes == ("its poses are rotation matrices",)
    for bad in (1.1 * matrices[3, 1], -matrices[3, 1], np.zeros((3, 3))):
        given = matrices.copy()
        given[3, 1] = bad
        with pytest.raises(InputError, match="poses, frame 3, joint 1: a rotation matrix expected"):
            save(tmp_path, poses=given)


def test_parts_of_amass_are_checked_in_the_chosen_frames_alone(tmp_path, rng):
    body = rng.normal(size=(6, 63))
    body[4, 10] = np.nan
    np.savez(
        tmp_path / "m.npz", root_orient=rng.normal(size=(6, 3)), pose_body=body, trans=np.zeros((6, 3)), mocap_framerate=60.0
    )
    found = io.read_motion(tmp_path / "m.npz", frame_range=(0, 4))
    np.testing.assert_array_equal(found.poses[:, 1:].reshape(4, -1), body[:4])
    np.testing.assert_array_equal(io.read_motion(tmp_path / "m.npz", frame_range=(-6, -2)).poses, found.poses)
    with pytest.raises(InputError, match="pose_body, frame 4: finite"):
        io.read_motion(tmp_path / "m.npz", frame_range=(3, None))


# --- settings of a file alone ----------------------------------------------------------------------------------------------


def scene(files, **motion):
    return scene_from({"motion": {"files": files, "fps": 30.0} | motion}, "")


@pytest.mark.parametrize(
    ("given", "chosen"),
    [
        ("ncs:walk[10:30]", slice(10, 30)),
        ("ncs:walk[10:]", slice(10, None)),
        ("ncs:walk[:30]", slice(0, 30)),
        ("ncs:walk[-20:]", slice(-20, None)),
        ("ncs:walk[ 5 : -5 ]", slice(5, -5)),
        ("ncs:walk[:]", slice(None)),
        ({"file": "ncs:walk", "frames": [10, 30]}, slice(10, 30)),
        ({"file": "ncs:walk", "frames": [10]}, slice(10, None)),
        ({"file": "ncs:walk", "frames": []}, slice(None)),
        ({"file": "ncs:walk[3:9]", "scale": 2.0}, slice(3, 9)),
        ("ncs:walk", slice(2, 40)),
    ],
)
def test_frames_of_a_file_override_those_of_the_scene(given, chosen):
    one, body, whole = scene([given], frames=[2, 40]), io.read_body(packaged("body")), io.read_motion(packaged("walk"))
    record = load_motion(one, one.motions[0], body)
    np.testing.assert_array_equal(record.poses, whole.poses[chosen])
    scale = 2.0 if isinstance(given, dict) and "scale" in given else 1.0
    np.testing.assert_array_equal(record.translation, scale * whole.translation[chosen])
    # what a run keeps is the same scene again, its paths and settings too
    again = scene_from(one.to_dict(), "")
    assert again.motion == one.motion and again.to_dict() == one.to_dict()


STRANGERS = {  # beside a scene of ncs:walk with frames, scale and joints: frames and scale that a motion is read with
    "ncs:dance": ((), 0.0),
    "ncs:dance[4:9]": ((4, 9), 0.0),
    "ncs:walk[0:]": ((0,), 0.5),
    "ncs:walk": ((2, 40), 0.25),
    "take.bvh": ((), 0.25),
    "below/../b.bvh": ((2, 40), 0.75),
    "a.bvh[1:3]": ((1, 3), 2.0),
}


@pytest.mark.parametrize("name", STRANGERS)
def test_frames_of_the_scene_are_of_its_own_files_alone(name):
    own = [{"file": "ncs:walk[:5]", "scale": 0.5}, {"file": "a.bvh", "scale": 2.0}, {"file": "b.bvh", "scale": 0.75}]
    one = scene([*own, "ncs:walk"], frames=[2, 40], scale=0.25, joints={"a": "b"})
    _, spec = one.motion_file(name)
    assert (spec.frames, spec.scale, spec.joints) == (*STRANGERS[name], {"a": "b"})


def test_a_motion_beside_the_scenes_is_whole():
    one, body = scene(["ncs:walk"], frames=[2, 40]), io.read_body(packaged("body"))
    assert len(load_motion(one, "ncs:dance", body).poses) == len(io.read_motion(packaged("dance")).poses)
    cut = load_motion(one, "ncs:walk", body)
    assert len(cut.poses) == 38 and cut.notes[-1] == "frames from 2 to before 40, as motion.frames says"
    assert not any("motion.frames" in note for note in load_motion(one, "ncs:walk[2:40]", body).notes)


def test_a_table_sets_scale_up_and_joints_of_one_file_alone(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.bvh").write_text(PLAIN)
    entries = [{"file": "a.bvh", "scale": 0.5, "up": "z", "joints": {"Spine": "spine1"}}, "b.bvh"]
    one = scene_from({"motion": {"files": entries, "validation": ["a.bvh[2:5]"], "scale": 0.25}}, str(tmp_path / "s.toml"))
    assert one.motions == ("a.bvh", "b.bvh", "a.bvh[2:5]")
    settings = {name: one.motion_file(name) for name in one.motions}
    assert [(s.scale, s.up, s.joints, s.frames) for _, s in settings.values()] == [
        (0.5, "z", {"Spine": "spine1"}, ()), (0.25, "auto", {}, ()), (0.25, "auto", {}, (2, 5)),
    ]  # fmt: skip
    assert [p for p, _ in settings.values()] == [tmp_path / "a.bvh", tmp_path / "b.bvh", tmp_path / "a.bvh"]
    kept = scene_from(one.to_dict(), "elsewhere/run.json")
    assert kept.motion_file(str(tmp_path / "a.bvh"))[1].up == "z"
    assert kept.motion_file(f"{tmp_path / 'a.bvh'}[2:5]")[1].frames == (2, 5)


WRONG = {
    "letters": (["ncs:walk[a:b]"], {}, r"motion.files\[0\]: frames as \[START:STOP\].*write ncs:walk\[10:300\]"),
    "steps": (["ncs:walk[1:9:2]"], {}, r"motion.files\[0\]: frames as \[START:STOP\]"),
    "a dash": (["walk.bvh[1-40]"], {}, r"motion.files\[0\]: frames as \[START:STOP\].*write walk.bvh\[1:40\]"),
    "a comma": (["ncs:walk[1, 40]"], {}, r"motion.files\[0\]: frames as \[START:STOP\].*write ncs:walk\[1:40\]"),
    "words": (["a/*.BVH[1 to 40]"], {}, r"motion.files\[0\]: frames as \[START:STOP\].*write a/\*.BVH\[1:40\]"),
    "one number": (["w.glb#Run [7]"], {}, r"motion.files\[0\]: frames as \[START:STOP\].*write w.glb#Run\[7:\]"),
    "three": ([{"file": "a.bvh", "frames": [1, 2, 3]}], {}, r"motion.files\[0\].frames: one or two numbers"),
    "below": (["ncs:walk", {"file": "a.bvh", "frames": [-1]}], {}, r"motion.files\[1\].frames\[0\]: a number from 0"),
    "scale": ([{"file": "a.bvh", "scale": "cm"}], {}, r"motion.files\[0\].scale: a number expected.*found 'cm'"),
    "up": ([], {"validation": [{"file": "a.bvh", "up": "w"}]}, r"motion.validation\[0\].up: one of auto, x, y, z"),
    "key": ([{"file": "a.bvh", "fps": 30}], {}, r"motion.files\[0\].fps: unknown key.*file, frames, scale, up, rest, joints"),
    "no file": ([{"frames": [1]}], {}, r"motion.files\[0\].file: the motion's file expected"),
    "twice": ([{"file": "a.bvh[1:2]", "frames": [1]}], {}, r"motion.files\[0\].frames: frames given once"),
    "two ways": ([{"file": "a.bvh", "scale": 1.0}, "a.bvh"], {}, r"motion.files\[1\]: the same settings"),
    "no list": ("a.bvh", {}, r"motion.files: a list expected"),
    "number": ([3.5], {}, r"motion.files\[0\]: text expected"),
}


@pytest.mark.parametrize("case", WRONG)
def test_settings_of_a_file_that_do_not_fit_are_named(case):
    files, motion, message = WRONG[case]
    with pytest.raises(InputError, match=message):
        scene(files, **motion)


def test_frames_that_a_file_lacks_are_named():
    one = scene(["ncs:walk[10:100000]"])
    with pytest.raises(InputError, match=r"walk.npz: frames: 0 <= start < stop <= .*found .10, 100000"):
        load_motion(one, one.motions[0], io.read_body(packaged("body")))
    with pytest.raises(InputError, match=r"motion: frames as \[START:STOP\]"):
        load_motion(one, "ncs:walk[1-2:]", io.read_body(packaged("body")))


def swung(rng, joints: int = 24) -> np.ndarray:
    return 0.4 * np.sin(np.linspace(0, 5, 30)[:, None, None] + rng.uniform(0, 6, (1, joints, 3)))


def test_tables_of_other_contents_say_what_to_write(tmp_path, rng):
    """Degrees, places of joints, other orders and other names: none is read as something else."""
    poses = swung(rng)
    turns = Rotation.from_rotvec(poses.reshape(-1, 3))
    matrices = turns.as_matrix().reshape(30, 24, 3, 3)
    places = np.zeros((30, 24, 3))
    for j, parent in enumerate(smpl_parents(24)[1:], 1):  # bones of 1 to 3 dm
        places[:, j] = places[:, parent] + matrices[:, parent] @ rng.uniform(0.1, 0.3, 3)
    rest = {"trans": np.zeros((30, 3)), "fps": 30}
    cases = [
        ({"poses": np.degrees(poses), **rest}, "poses: axis times angle in radians expected .*divide by 57.29578"),
        ({"poses": places, **rest}, "poses: rotations expected, not the places of joints .*fit SMPL"),
        ({"poses": matrices[..., :2], **rest}, "poses: .*of a 6D rotation make a matrix"),
        ({"poses": matrices[..., :2].reshape(30, 24, 6), **rest}, "poses: .*of a 6D rotation make a matrix"),
        ({"quaternions": turns.as_quat().reshape(30, 24, 4), **rest}, r"quaternions: w first expected .*\[3, 0, 1, 2\]"),
        (
            {"smpl_poses": poses.reshape(30, 72), "smpl_trans": rest["trans"], "smpl_scaling": [93.0]},
            "smpl_trans / smpl_scaling",
        ),
        ({"global_orient": poses[:, 0], "body_pose": poses[:, 1:].reshape(30, -1)}, "body_pose: .*trans = transl and fps"),
        ({"joints": places, "fps": 20}, "joints: poses or quaternions expected .*fit SMPL"),
    ]
    for arrays, words in cases:
        np.savez(tmp_path / "m.npz", **arrays)
        with pytest.raises(InputError, match=words):
            io.read_motion(tmp_path / "m.npz")
    np.savez(tmp_path / "m.npz", quaternions=turns.as_quat(scalar_first=True).reshape(30, 24, 4), **rest)
    np.testing.assert_allclose(io.read_motion(tmp_path / "m.npz").poses, poses, atol=1e-9)
    np.savez(tmp_path / "m.npz", poses=poses, **rest)
    np.testing.assert_array_equal(io.read_motion(tmp_path / "m.npz").poses, poses)
    (tmp_path / "dance.pkl").write_bytes(b"\x80\x04.")
    with pytest.raises(InputError, match=r"dance\.pkl: one of .*write an \.npz of poses, trans and fps"):
        io.read_motion(tmp_path / "dance.pkl")

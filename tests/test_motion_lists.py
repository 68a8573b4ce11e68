"""Many motions by one name: folders, patterns, lists; and what is said of those that cannot be used."""

from __future__ import annotations

import os
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.errors import InputError, InputWarning
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.motion_import import load_motion, load_motions
from ncs_jax.scene.spec import load_scene, scene_from

FILES = ("A/s 1/jump_poses.npz", "A/s 1/walk_poses.npz", "B/Subject_2_F/run_stageii.npz", "dance.bvh", "own.npz")


@pytest.fixture
def folder(tmp_path):
    """Write a folder as AMASS's, with what lies beside the motions there."""
    for name in FILES:
        file = tmp_path / "motions" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".npz":
            np.savez(file, poses=np.zeros((4, 1, 3)), trans=np.zeros((4, 3)), fps=30.0)
        else:
            file.write_text("HIERARCHY")
    beside = tmp_path / "motions" / "A" / "s 1"
    np.savez(beside / "shape.npz", betas=np.zeros(16))
    np.savez(tmp_path / "motions" / "B" / "neutral_stagei.npz", betas=np.zeros(16), poses=np.zeros((1, 3)))
    np.savez(beside / "skirt.npz", vertices=np.zeros((3, 3)), faces=np.zeros((1, 3)))
    (beside / "LICENSE.txt").write_text("A/s 1/none.npz")
    (beside / "._walk_poses.npz").write_bytes(b"resource fork")
    os.symlink(tmp_path / "motions", tmp_path / "motions" / "B" / "again", target_is_directory=True)
    return tmp_path


def scene(folder, *files, validation=(), **motion):
    return scene_from({"motion": {"files": list(files), "validation": list(validation), **motion}}, str(folder / "scene.toml"))


def test_a_folder_stands_for_all_motions_in_it_and_says_what_is_none(folder):
    found = scene(folder, "motions").motion
    assert found.files == tuple(f"motions/{name}" for name in FILES)
    assert len(found.found) == 1 and found.found[0].startswith("motions: 5 motions, beside ")
    for kind in ("1 shape.npz", "1 neutral_stagei.npz", "1 *.npz", "1 *.txt"):
        assert kind in found.found[0]
    assert scene(folder, "motions/A/s 1/walk_poses.npz").motion.found == ()
    assert scene(folder, "", "motions/none.npz").motion.files == ("", "motions/none.npz")  # reading says what is wrong


def test_patterns_frames_and_settings_reach_each_motion(folder):
    assert scene(folder, "motions/**/*_poses.npz").motion.files == tuple(f"motions/{name}" for name in FILES[:2])
    assert scene(folder, "motions/A[1:3]").motion.files == tuple(f"motions/{name}[1:3]" for name in FILES[:2])
    own = scene(folder, {"file": "motions/A", "frames": [1], "up": "z"})
    assert own.motion.files[0] == "motions/A/s 1/jump_poses.npz[1:]"
    assert own.motion.own == {name: {"up": "z"} for name in own.motion.files}
    kept = scene_from(own.to_dict(), str(folder / "elsewhere" / "run.json"))  # as a run keeps it, wherever it is read
    assert [kept.motion_file(name)[0] for name in kept.motion.files] == [folder / "motions" / name for name in FILES[:2]]
    assert {kept.motion_file(name)[1].up for name in kept.motion.files} == {"z"}


def test_a_list_names_a_motion_a_line(folder):
    lines = [
        "# to train on",
        "motions/own.npz[2:]   # from frame 2",
        "",
        "motions/A",
        "ncs:walk",
        "hero.glb#Walk",
        "motions/B/*F/*",
    ]
    (folder / "lists").mkdir()
    (folder / "lists" / "train.txt").write_text("\n".join(line.replace("motions", "../motions") for line in lines))
    found = scene(folder, "lists/train.txt").motion.files
    a, b = [f"motions/{name}" for name in FILES[:2]], f"motions/{FILES[2]}"
    assert found == ("motions/own.npz[2:]", *a, "ncs:walk", "lists/hero.glb#Walk", b)


@pytest.mark.parametrize("heads", ["", "source_path,start_frame,end_frame,new_name\n"])
def test_a_table_names_frames_in_columns(folder, heads):
    (folder / "index.csv").write_text(heads + '"motions/own.npz",0,3\nmotions/dance.bvh,,\n"a, b.bvh",5,\n')
    assert scene(folder, "index.csv").motion.files == ("motions/own.npz[0:3]", "motions/dance.bvh", "a, b.bvh[5:]")
    (folder / "index.csv").write_text(heads + "motions/own.npz,begin,3\n")
    with pytest.raises(InputError, match=r"index.csv: row 1: whole numbers of frames"):
        scene(folder, "index.csv")


def test_what_is_validated_on_is_not_trained_on_and_no_motion_comes_twice(folder):
    found = scene(folder, "motions", "motions/A", validation=[str(folder / "motions/B/again/B/Subject_2_F[:2]")]).motion
    assert found.files == tuple(f"motions/{name}" for name in FILES if not name.startswith("B"))
    assert found.validation == (str(folder / "motions/B/again" / FILES[2]) + "[:2]",)  # the same file by another way
    alone = scene(folder, "motions/A", {"file": f"motions/{FILES[0]}", "up": "z"}).motion
    assert alone.files == (f"motions/{FILES[1]}", f"motions/{FILES[0]}") and list(alone.own) == [f"motions/{FILES[0]}"]
    with pytest.raises(InputError, match=r"motion\.files: motions to train on expected"):
        scene(folder, "motions/A", validation=["motions"])
    twice = scene(folder, f"motions/{FILES[0]}", f"motions/{FILES[0]}").motion.files
    assert len(twice) == 2  # as written, by itself


def test_a_list_in_a_list_is_refused(folder):
    (folder / "inner.txt").write_text("ncs:walk\n")
    (folder / "list.txt").write_text("ncs:dance\ninner.txt[3:]\n")
    with pytest.raises(InputError, match=r"list\.txt: .*no other list \(found .inner\.txt\[3:\].\)"):
        scene(folder, "list.txt")


@pytest.mark.parametrize("name", ["empty", "motions/*.fbx", "list.txt"])
def test_where_there_is_no_motion_the_name_is_refused(folder, name):
    (folder / "empty").mkdir()
    (folder / "list.txt").write_text("# none\n")
    with pytest.raises(InputError, match=r"motion\.validation: motions expected there") as refused:
        scene(folder, validation=[name])
    assert ("none of its lines leads to one" in refused.value.mend) == (name == "list.txt")


def test_a_motion_of_a_list_that_is_not_there_is_told_with_the_list(folder):
    (folder / "list.txt").write_text(f"motions/{FILES[0]} [:2]\nmotions/nosuch.bvh\n")  # a space before the frames
    given = scene(folder, "list.txt")
    assert given.motion.files == (f"motions/{FILES[0]}[:2]", "motions/nosuch.bvh")
    shutil.copytree(folder / "motions" / "A", folder / "walks [old]")
    (folder / "old.txt").write_text("walks [old]\n")
    assert scene(folder, "old.txt").motion.files == scene(folder, "walks [old]").motion.files
    with pytest.raises(InputError, match=r"motion\.files: no such file.*nosuch\.bvh.*or what lists it: list\.txt"):
        load_motion(given, "motions/nosuch.bvh", None)
    with pytest.raises(InputError, match=r"list\.txt: one motion expected .*name one of the motions that it lists"):
        load_motion(given, str(folder / "list.txt"), None)


def test_all_broken_motions_are_told_at_once_or_skipped(folder):
    for name in FILES[:2]:
        np.savez(folder / "motions" / name, poses=np.full((4, 1, 3), np.nan), trans=np.zeros((4, 3)), fps=30.0)
    (folder / "scene.toml").write_text('[body]\nfile = "none"\n[motion]\nfiles = ["motions"]\nvalidation = ["ncs:walk"]\n')
    given, said = load_scene(folder / "scene.toml"), []
    with pytest.raises(InputError) as error:
        load_motions(given, None, said.append)
    text = str(error.value)
    assert "4 of 6 not" in text and 'motion.broken = "skip"' in text and said[0] == given.motion.found[0]
    nan, others = (next(line for line in text.splitlines() if part in line) for part in (FILES[0], "dance.bvh"))
    assert FILES[1] in nan and "dance.bvh" not in nan and "HIERARCHY" not in nan and FILES[0] not in others
    skipping = scene_from(given.to_dict() | {"motion": given.to_dict()["motion"] | {"broken": "skip"}}, given.source)
    with pytest.warns(InputWarning, match="4 of 6 motions are left out"):
        left, motions = load_motions(skipping, None, said.append)
    kept = tuple(str(folder / "motions" / name) for name in FILES if name in (FILES[2], FILES[4]))
    assert left.motion.files == kept == tuple(motions) and left.motion.validation == ()


def test_one_broken_motion_is_that_error_and_none_left_to_train_on_is_refused(folder):
    broken = {"files": ["motions/dance.bvh"], "validation": ["motions/own.npz"], "broken": "skip"}
    given = scene_from({"body": {"file": "none"}, "motion": broken}, str(folder / "scene.toml"))
    with warnings.catch_warnings(), pytest.raises(InputError) as error:
        warnings.simplefilter("error")
        load_motions(given, None, lambda _: None)
    assert str(error.value.file).endswith("dance.bvh")


def joints_said(files, joints=None, **motion):
    return scene_from({"motion": {"files": files, "joints": joints or {}} | motion}, "scene.toml")


@pytest.mark.parametrize(
    ("files", "joints", "mend"),
    [
        (["ncs:walk", "ncs:jump"], {"LeftLegg": "LeftLeg"}, 'did you mean "LeftLeg" = "LeftLeg"?'),
        (["ncs:walk"], {"mixamorig:leftleg": ""}, 'did you mean "LeftLeg" = ""?'),
        (["ncs:walk"], {"Q": "LeftLeg"}, "leave it out, or write a joint of the motion first"),
        ([{"file": "ncs:walk", "joints": {"Hipps": "Hips"}}, "ncs:jump"], {}, 'did you mean "Hips" = "Hips"?'),
    ],
)
def test_a_mistyped_joint_is_refused_with_the_nearest_name(files, joints, mend):
    name = next(iter(joints or files[0]["joints"]))
    with pytest.raises(InputError) as error:
        load_motions(joints_said(files, joints), io.read_body(packaged("body")), lambda _: None)
    assert str(error.value) == (
        f"scene.toml: motion.joints: a joint of the motions expected, and none has it (found {name!r}); {mend}"
    )


def test_joints_of_other_motions_of_the_scene_are_no_fault(tmp_path):
    """One of several skeletons has the joint; or one motion is taken by itself, as a simulation does."""
    body = io.read_body(packaged("body"))
    walk = io.read_motion("ncs:walk")
    names = ["Hip" if n == "Hips" else n for n in walk.joint_names]
    given = {"poses": walk.poses, "trans": walk.translation, "fps": 30.0, "joint_names": names}
    np.savez(tmp_path / "own.npz", **given, joints=body.joints, parents=body.parents)
    said = joints_said([str(tmp_path / "own.npz"), "ncs:walk"], {"Hip": "Hips"})
    _, motions = load_motions(said, body, lambda _: None)
    assert [record.absent for record in motions.values()] == [{}, {"Hip": "Hips"}]
    alone = replace(said, motion=replace(said.motion, files=("ncs:walk",), lone=True))
    assert list(load_motions(alone, body, lambda _: None)[1]) == ["ncs:walk"]

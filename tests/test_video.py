"""A video is what the pictures are: its frames are read back and compared."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from ncs_jax.cli import main
from ncs_jax.errors import InputError
from ncs_jax.view.camera import Camera
from ncs_jax.view.pictures import drawn_frames
from ncs_jax.view.rasteriser import SQUARE, DrawnMesh, render
from ncs_jax.view.video import animation_mp4, check_video

from .test_pictures import swing, tube

__all__ = ["swing"]


def test_a_video_shows_what_the_pictures_do(tmp_path, swing):
    av = pytest.importorskip("av", reason="the package av is not installed")
    told: list[float] = []
    some = replace(swing.until(5), fps=29.97)
    animation_mp4(tmp_path / "a.mp4", some, size=(161, 199), report=told.append)
    with av.open(str(tmp_path / "a.mp4")) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == pytest.approx(29.97, rel=1e-4)
        shown = [frame.to_ndarray(format="rgb24", src_colorspace="ITU709") for frame in file.decode(stream)]
    drawn = list(drawn_frames(some, range(5), (162, 200), "three-quarter"))
    assert len(shown) == 5 and told[-1] == 1
    for got, want in zip(shown, drawn, strict=True):
        assert got.shape == want.shape == (200, 162, 3)
        apart = np.abs(got.astype(int) - want)
        assert apart.mean() < 3 and np.abs(got.mean((0, 1)) - want.mean((0, 1))).max() < 2  # no tint
    moved = np.abs(drawn[0].astype(int) - drawn[4]).mean()
    assert moved > 3 * np.abs(shown[4].astype(int) - drawn[4]).mean()  # and not one frame for another


def test_a_missing_encoder_is_told_at_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"a\.mp4.*the package av is needed.*pip install av"):
        check_video(tmp_path / "a.mp4")
    assert main(["train", "ncs:skirt", "--out", str(tmp_path / "run"), "--video"]) == 2
    assert "the package av is needed" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_a_checker_is_fixed_to_the_cloth():
    """Squares of the cloth at rest: they stay where the cloth moves as one, and widen where it is stretched."""
    rest, faces = tube(40, 48, 0.3, 0.0, 0.6)
    camera = Camera(np.array([0.0, 0.3, 0.0]), 0.7, 0.7, 0.0)

    def picture(vertices, checker):
        return render([DrawnMesh(vertices, faces, (0.9, 0.9, 0.9), None, checker)], camera, (100, 100)).astype(int)

    plain, checked = picture(rest, None), picture(rest, rest)
    dark = plain.sum(2) - checked.sum(2) > 60
    assert 0.3 < dark.sum() / (plain != plain[0, 0]).any(2).sum() < 0.7
    assert not np.array_equal(checked, picture(rest, rest + np.array([0, SQUARE, 0])))
    stretched = (rest - [0, 0.3, 0]) * [1, 2, 1] + [0, 0.3, 0]
    column = lambda image: (np.diff((image[20:80, 50].sum(1) < image[20:80, 50].sum(1).mean()).astype(int)) != 0).sum()  # noqa: E731
    assert column(picture(stretched, rest)) < 0.75 * column(checked)


def test_a_checker_of_another_garment_is_refused(swing):
    with pytest.raises(InputError, match="checker"):
        replace(swing, checker=np.zeros((3, 3)))

"""An animated garment as a video that browsers play: H.264 in an .mp4, at the motion's own rate."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import check_place, replacing
from ncs_jax.view.animation import Animation
from ncs_jax.view.pictures import drawn_frames

__all__ = ["animation_mp4", "check_video"]

QUALITY = {"crf": "18", "preset": "medium"}  # hardly any loss to the eye
BT709 = 1  # the number of this standard of colours, in files and in the encoder
LIMITED = 1  # brightness from 16 to 235


def check_video(file: str | Path) -> None:
    """Raise an InputError where the package that encodes videos is not installed, or the place cannot be written to."""
    if check_place(file).is_dir():
        raise InputError("a file expected", file=file, value="a folder", mend="give another name")
    try:
        import av  # noqa: F401
    except ImportError:
        mend = "pip install av, or 'ncs-jax[video]'"
        raise InputError("the package av is needed", file=file, value=".mp4", mend=mend) from None


def animation_mp4(
    path: str | Path,
    animation: Animation,
    *,
    size: tuple[int, int] = (720, 900),
    view: str = "three-quarter",
    report: Callable[[float], None] | None = None,
) -> None:
    """Write a video that follows the character over a fixed grid: every frame, H.264, yuv420p.

    Args:
        path: of the .mp4. animation: to draw. size: width and height in pixels, made even. view: one of `pictures.VIEWS`.
        report: called with the share of the frames that are drawn.

    Raises:
        InputError: the package av is missing, the view is unknown, or the place is unwritable.
    """
    check_video(path)
    import av

    width, height = (n + n % 2 for n in size)
    count = len(animation.garment)
    with replacing(path) as part, av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as file:
        stream = file.add_stream("libx264", rate=Fraction(animation.fps).limit_denominator(1001), options=QUALITY)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.colorspace = stream.codec_context.color_primaries = stream.codec_context.color_trc = BT709
        stream.codec_context.color_range = LIMITED
        for number, picture in enumerate(drawn_frames(animation, range(count), (width, height), view)):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            file.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED)))
            if report is not None:
                report((number + 1) / count)
        file.mux(stream.encode(None))

"""`ncs preview`: draw a run again, over any motion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ncs_jax.cli import arguments
from ncs_jax.cli.check import tell_skin
from ncs_jax.cli.progress import WorkProgress
from ncs_jax.errors import InputError
from ncs_jax.scene.motion_names import split_frames

__all__ = ["add_commands", "check_video", "draw", "preview"]

DRAWN = (".png", ".html", ".gif", ".mp4", ".jpg")


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(commands, "preview", preview, "draw a run: a picture, a page that plays it, a GIF, its energies")
    parser.add_argument("folder", metavar="RUN", help="folder that ncs train made")
    parser.add_argument("--motion", metavar="FILE", help="motion file or ncs:NAME (default: the scene's first of validation)")
    parser.add_argument("--out", metavar="DIR", help="folder for the files (default: RUN)")
    parser.add_argument("--video", action="store_true", help="preview.mp4, every frame, in place of the GIF")


def preview(options) -> int:
    """Draw a run, and print how it does on the motion."""
    arguments.check_run(options.folder)
    out = options.out or options.folder
    if Path(out).suffix.lower() in DRAWN:
        raise InputError(
            "a folder expected", field="--out", value=out, mend="its files are preview.png, preview.html and others"
        )
    if options.video:
        check_video(out)
    from ncs_jax.runs.checkpoint import check_writable
    from ncs_jax.runs.run import load_run

    check_writable(Path(out))
    draw(load_run(options.folder), out, options.motion, log=Path(options.folder) / "log.csv", video=options.video)
    return 0


def check_video(out: str | Path) -> None:
    """Raise an InputError where preview.mp4 cannot be made, before there is work to lose."""
    from ncs_jax.view import video

    video.check_video(Path(out) / "preview.mp4")


def draw(run, out: str | Path, motion: str | None = None, *, log: Path | None = None, video: bool = False) -> dict[str, float]:
    """Draw a run into a folder; print each file as soon as it is there, and last how it does on the motion."""
    from ncs_jax.metrics.seen import SkinShown
    from ncs_jax.view.preview import preview

    with WorkProgress("drawing the preview") as progress:

        def show(step) -> None:
            if step.file is not None:
                progress.say(f"  {step.file}")
            progress.show(step.next, step.share, 1.0)

        quantities = preview(run, out, motion, log=log, mp4=video, report=show)
    scene = run.assembly.scene
    name = motion or (*scene.motion.validation, *scene.motion.files)[0]
    never = "" if _is_trained_on(scene.motion.files, name) else ", which it never trained on"
    inside = f", penetrating vertices {quantities['penetrating']:.2f} %" if "penetrating" in quantities else ""
    never += f", one frame in {quantities['every']:.0f}" if quantities["every"] > 1 else ""
    print(f"On {name}{never}:\n  mean strain {quantities['strain_mean']:.2f} %{inside}")
    if "skin_shown" in quantities:
        shown = SkinShown(**{name.removeprefix("skin_"): int(n) for name, n in quantities.items() if name.startswith("skin_")})
        tell_skin(shown, run.assembly)
    others = len({*scene.motion.validation, *scene.motion.files}) - 1
    if motion is None and others:
        print(f"  nothing of its {others} other motions: ncs preview RUN --motion FILE draws and measures another")
    return quantities


def _is_trained_on(files: Sequence[str], name: str) -> bool:
    """Tell whether a motion, perhaps named from the current folder, shares frames with a run's files, of absolute paths."""
    file, frames = split_frames(name)
    return any(
        _overlap(frames, other) for known, other in map(split_frames, files) if known in (file, str(Path(file).absolute()))
    )


def _overlap(*cuts: tuple[int, ...] | None) -> bool:
    """Tell whether two cuts of one motion share frames, as far as their numbers tell."""
    starts, stops = zip(*((cut[0], cut[1] if len(cut) > 1 else None) if cut else (0, None) for cut in cuts), strict=True)
    counted = all(number is None or number >= 0 for number in (*starts, *stops))  # else from an end that is not known here
    return not counted or max(starts) < min((stop for stop in stops if stop is not None), default=max(starts) + 1)

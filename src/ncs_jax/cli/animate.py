"""`ncs animate` and `ncs export`: a trained garment over a motion, and its step as a file or in a page."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ncs_jax.cli import arguments
from ncs_jax.cli.train import adapted
from ncs_jax.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from ncs_jax.io import MotionRecord
    from ncs_jax.metrics.coverage import Coverage
    from ncs_jax.prepare.build import Assembly
    from ncs_jax.runs.run import Run
    from ncs_jax.scene.features import MotionFeatures

__all__ = ["add_commands", "animate", "export"]

MOMENTS = 8  # in a picture


def add_commands(commands) -> None:
    """Declare the options of both commands."""
    _add_animate(commands)
    _add_export(commands)


def _add_animate(commands) -> None:
    parser = arguments.command(commands, "animate", animate, "animate a trained garment over a motion")
    parser.add_argument("folder", metavar="RUN", help="folder that ncs train made")
    parser.add_argument(
        "--motion", metavar="FILE", action="append", default=[],
        help="motion: FILE, FILE[10:300] or ncs:NAME (default: the scene's first one); given again, one more to --adapt to",
    )  # fmt: skip
    arguments.add_adapting(parser)
    arguments.add_alpha(parser)
    parser.add_argument(
        "--refine",
        type=arguments.whole,
        metavar="N",
        help="take N iterations of the solver on every frame, say 4: the more, the nearer to the simulation (default: none)",
    )
    parser.add_argument(
        "--rank", type=arguments.whole, help="make the decoder smaller for this motion: its rank, say 64; prints the error"
    )
    parser.add_argument("--bfloat16", action="store_true", help="keep the decoder in 16 bits; prints the error")
    parser.add_argument(
        "--as-trained",
        action="store_true",
        help="leave cloth in the body where the network has it there (default: put out)",
    )
    parser.add_argument("--notes", action="store_true", help="print all that was done to bring --motion onto the skeleton")
    parser.add_argument("--out", required=True, metavar="FILE", help=f"{arguments.FORMATS}; or drawn: .mp4, .png")
    parser.add_argument("--body", action="store_true", help="write the body too, skinned, into a .glb")
    parser.add_argument(
        "--checker", action="store_true", help="where it is drawn: a pattern of 4 cm on the cloth, for strain and sliding"
    )
    parser.add_argument(
        "--frames",
        type=lambda text: arguments.whole(text, 0),
        nargs="+",
        metavar="FRAME",
        help="in a .png: which moments of the motion, from 0 (default: eight, evenly spread)",
    )


def _add_export(commands) -> None:
    parser = arguments.command(
        commands, "export", export, "write one step of a trained garment for a host that has neither JAX nor this package"
    )
    parser.add_argument("folder", metavar="RUN", help="folder that ncs train made")
    parser.add_argument(
        "--format", choices=("onnx", "stablehlo", "web"), default="onnx",
        help="web: one .html in which a browser runs it; motions, alpha, joints to drag (default: onnx)",
    )  # fmt: skip
    parser.add_argument("--out", required=True, metavar="FILE", help="the file; what a host has to know goes to FILE.json")
    parser.add_argument(
        "--motion", metavar="FILE", action="append", default=[],
        help="to check it on and to fit --rank to (default: one of the scene's); web: in the page, given again, one more "
        "(default: all of the scene's)",
    )  # fmt: skip
    parser.add_argument("--rank", type=arguments.whole, default=0, help="a smaller decoder: its rank, say 64; prints the error")
    parser.add_argument("--float16", action="store_true", help="store weights in 16 bits (computed in 32); prints the error")
    parser.add_argument("--opset", type=arguments.whole, default=15, help="of the ONNX operators, 13 to 21 (default: 15)")
    parser.add_argument(
        "--runtime",
        metavar="PLACE",
        help="web: the npm package onnxruntime-web, its .tgz or folder (npm pack onnxruntime-web; default: in this folder)",
    )
    parser.add_argument(
        "--refine",
        type=arguments.whole,
        metavar="N",
        help="web: the first motion after N iterations of the solver as well, to be compared with (default: none)",
    )


def animate(options) -> int:
    """Animate a trained garment over a motion, and write it to a file."""
    arguments.check_run(options.folder)
    arguments.check_adapted(options)
    import numpy as np

    from ncs_jax import io
    from ncs_jax.io.animation.animation import animation_suffix

    # before the run is read
    drawn = _is_drawn(options)
    if not drawn:
        animation_suffix(options.out, with_body=options.body, also=(".mp4", ".png"))
    run, motion, track, known = _run_and_motion(options)
    worn_by = None
    if options.body:
        if run.assembly.body is None:
            raise InputError("a scene with a body expected", file=options.folder, field="--body", mend="leave it out")
        worn_by = run.assembly.body, motion
    outside = not options.as_trained
    vertices, error = run.animate(track, options.alpha, outside=outside), ""
    if options.rank or options.bfloat16:
        run = run.compressed(track, rank=options.rank or 0, bfloat16=options.bfloat16)
        whole, vertices = vertices, run.animate(track, options.alpha, outside=outside)
        apart = 1000 * np.linalg.norm(vertices - whole, axis=-1)
        error = f"; {np.mean(apart):.2g} mm from the whole decoder, {np.max(apart):.2g} at most"
    if options.refine:
        vertices = _refined(run, track, options.alpha, options.refine, outside)
    _tell_skin(run, track, vertices, known)
    garment = run.assembly.garment
    fps = run.assembly.model.fps
    if drawn:
        print(f"{_draw(run, motion, vertices, options)}{error}")
        return 0
    names = arguments.mesh_names(run.assembly.scene)
    more = {"rest": garment.vertices, "uv": garment.uv}
    files = io.write_animation(
        options.out, vertices, garment.faces, fps, **more, worn_by=worn_by, names=names, layers=garment.layers
    )
    arguments.tell_written(files, len(vertices), fps, (*garment.layers, vertices.shape[1]), error)
    if worn_by is not None and worn_by[0].posedirs is not None:
        print("  note: the body is written without its pose correctives; skin may show by as much as they move it")
    return 0


def _is_drawn(options) -> bool:
    """Tell whether a picture or a video is asked for, and can be made."""
    suffix = Path(options.out).suffix.lower()
    drawn = suffix in (".mp4", ".png")
    for name, possible, expected in (("checker", drawn, ".mp4 or .png"), ("frames", suffix == ".png", ".png")):
        if getattr(options, name) and not possible:
            mend = f"end the name in {expected}, or leave it out"
            raise InputError(f"{expected} expected", file=options.out, field=f"--{name}", mend=mend)
    if drawn and options.body:
        raise InputError(".glb expected", file=options.out, field="--body", mend="leave it out: the body is drawn")
    if suffix == ".mp4":
        from ncs_jax.view.video import check_video

        check_video(options.out)
    elif drawn:
        from ncs_jax.io.tables.files import check_place

        if check_place(options.out).is_dir():
            raise InputError("a file expected", file=options.out, value="a folder", mend="give another name")
    return drawn


def _draw(run: Run, motion: MotionRecord, vertices: np.ndarray, options) -> str:
    """Draw the garment on its body: every frame, with a bar, or some moments. Return what has been written."""
    from ncs_jax.cli.progress import WorkProgress
    from ncs_jax.view.character import animation_of

    shown = animation_of(run.assembly, motion, vertices)
    if options.checker:
        shown = replace(shown, checker=run.assembly.garment.vertices)
    if Path(options.out).suffix.lower() == ".png":
        from ncs_jax.view.pictures import contact_sheet

        contact_sheet(options.out, shown, frames=options.frames or MOMENTS)
        return f"{options.out}: {len(options.frames or vertices[:MOMENTS])} of {len(vertices)} frames"
    from ncs_jax.view.video import animation_mp4

    with WorkProgress("drawing the video") as progress:
        animation_mp4(options.out, shown, report=lambda share: progress.show("drawing the video", share, 1.0))
    return f"{options.out}: {len(vertices)} frames at {shown.fps:g} per second"


def _refined(run: Run, track: MotionFeatures, alpha: float, iterations: int, outside: bool = False) -> np.ndarray:
    """Return the animation after some iterations of the solver on every frame, with a bar."""
    from ncs_jax.cli.progress import WorkProgress

    with WorkProgress("compiling the solver") as progress:
        return run.animate(
            track,
            alpha,
            refine=iterations,
            outside=outside,
            report=lambda frame, frames: progress.show(f"refining frame {frame}/{frames}", frame, frames),
        )


def _tell_skin(run: Run, track: MotionFeatures, vertices: np.ndarray, known: Coverage | None) -> None:
    """Print where skin shows in the animation, of frames evenly spread and the one that is most beyond the training."""
    model = run.assembly.model
    if model.surface is None:
        return
    import numpy as np

    from ncs_jax.cli.check import tell_skin
    from ncs_jax.metrics.seen import LOOKED_AT, shown_skin, touchable_bodies

    worst = () if known is None else (known.worst[0],)
    chosen = np.unique([*range(0, len(vertices), -(-len(vertices) // LOOKED_AT)), *worst])
    body = touchable_bodies(model, track, chosen)
    tell_skin(shown_skin(model, track.relative(vertices)[chosen], body, chosen), run.assembly)


def _run_and_motion(options) -> tuple[Run, MotionRecord, MotionFeatures, Coverage | None]:
    """Return the run, adapted if that is asked for, the first motion as read and made ready, and how far that is beyond."""
    from ncs_jax.cli.check import tell_beyond
    from ncs_jax.runs.run import load_run

    if options.adapt is None and len(options.motion) > 1:
        value = ", ".join(options.motion)
        raise InputError("one motion expected without --adapt", field="--motion", value=value, mend="add --adapt 20")
    run = load_run(options.folder)
    arguments.check_scene_kept(options.out, run.assembly.scene, *options.motion)
    motions = options.motion or list(run.assembly.scene.motions[:1])
    if not motions:
        raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
    records = {name: run.motion(name) for name in motions}
    run = replace(run, assembly=replace(run.assembly, motions=records))
    last, count = max(options.frames or [0]), len(records[motions[0]].poses)
    if last >= count:
        expected = f"frames 0 to {count - 1} of the motion expected"
        raise InputError(expected, field="--frames", value=last, mend="or another --motion")
    if options.motion:
        _tell_motions(run.assembly, options.notes)
    if options.adapt is not None:
        run = adapted(run, motions, options).run
    track = run.track(motion := records[motions[0]])
    tell_beyond(known := run.coverage(track))
    return run, motion, track, known


def _tell_motions(assembly: Assembly, whole: bool) -> None:
    """Print what puts the animation at risk in the motions, and how they drive the body, in a line or as a whole."""
    from ncs_jax.cli.check import tell, tell_risk
    from ncs_jax.prepare.scene_checks import motion_risks

    for risk in motion_risks(assembly):
        tell_risk(risk)
    for motion in assembly.motions.values():
        notes = motion.notes
        if not whole and len(notes) > 1:
            first = next((note for note in notes if note.startswith("retargeted")), notes[0])
            first = re.split(r"[;:]|, of these", first)[0]
            notes = (f"{first[:100]}; --notes prints all {len(notes)} lines on it",)
        for number, note in enumerate(notes):
            tell("" if number else "motion", note)


def export(options) -> int:
    """Write one step of a trained garment as a file, and print how it was checked."""
    arguments.check_run(options.folder)
    from ncs_jax.export.facts import FileFormat
    from ncs_jax.io.tables.files import check_place
    from ncs_jax.runs.run import load_run

    if options.format == "web":
        return _export_page(options)
    FileFormat(options.format).check_name(check_place(options.out))  # before the run is read
    for field in ("runtime", "refine"):
        if getattr(options, field) is not None:
            raise InputError("--format web expected", field=f"--{field}", value=getattr(options, field), mend="leave it out")
    if len(options.motion) > 1:
        raise InputError("one motion expected", field="--motion", value=", ".join(options.motion), mend="or --format web")
    chosen = {name: getattr(options, name) for name in ("format", "rank", "float16", "opset")}
    print(load_run(options.folder).export(options.out, motion=next(iter(options.motion), None), **chosen))
    return 0


def _export_page(options) -> int:
    """Write the page in which a browser runs a garment, and print how it was checked."""
    from ncs_jax.cli.check import tell_beyond
    from ncs_jax.io.tables.files import check_place
    from ncs_jax.runs.run import load_run
    from ncs_jax.view.browser_runtime import read_runtime
    from ncs_jax.view.living import check_name, write_living_page

    check_name(check_place(options.out))
    if options.opset != 15:
        raise InputError("15 expected for web", field="--opset", value=options.opset, mend="leave it out")
    runtime = read_runtime(options.runtime)
    run = load_run(options.folder)
    spec = run.assembly.scene.motion
    names = options.motion or [*spec.validation, *spec.files]
    motions = {name: run.motion(name) for name in dict.fromkeys(names)}
    for name in options.motion:
        tell_beyond(run.coverage(motions[name]))
    refined = None
    if options.refine and motions:
        refined = options.refine, _refined(run, run.track(next(iter(motions.values()))), 1.0, options.refine)
    print(write_living_page(options.out, run, motions, runtime, rank=options.rank, float16=options.float16, refined=refined))
    return 0

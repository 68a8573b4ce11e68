"""The command line: ncs demo, train, animate, export, simulate, evaluate, view, fit, check."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from pathlib import Path

from ncs_jax import reports
from ncs_jax.errors import InputError
from ncs_jax.scene import PRESETS, load_scene

__all__ = ["main"]

DESCRIPTION = """\
Neural cloth simulation: a garment learns to move on an animated character from physics alone.

  ncs demo                          train the packaged T-shirt and write a preview to look at
  ncs train SCENE --out RUN         train the garment of a scene file (ncs:tshirt and ncs:skirt come with the package)
  ncs animate RUN --out FILE        animate a trained garment
  ncs export RUN --out FILE         write its step for a game engine or another host, as ONNX or StableHLO
  ncs simulate SCENE --out FILE     animate it without a network, by minimising the same energy frame by frame
  ncs evaluate RUN                  strain, penetration, energies in physical units
  ncs view RUN|FILE|SCENE           look at it in a browser: play, scrub, orbit, alpha, colours
  ncs fit GARMENT --out FILE        bring a garment onto a body: units, axes, place, out of the skin, pins, weights
  ncs check SCENE                   read a scene and say what is in it, or what is wrong with it
"""
FORMATS = ".npz, .h5, .pc2, .mdd, .glb, .usd, .usdc, .usda, .usdz, or a folder of .obj"


def main(arguments: list[str] | None = None) -> int:
    """Run a command; the exit code is 0, or 2 for input that cannot be used, or 130 when interrupted."""
    parsed = _parser().parse_args(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the simulator's matrices are small: two threads take 1.3 times as long
    _keep_compiled_programs()
    try:
        return parsed.run(parsed)
    except InputError as error:
        print(f"ncs: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("ncs: interrupted; `ncs train --resume` goes on from the last checkpoint", file=sys.stderr)
        code = 130
    if getattr(parsed, "hosts", None) is not None:
        _leave(code)
    return code


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="ncs", description=DESCRIPTION, formatter_class=raw)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name, run, text):
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(run=run)
        return sub

    demo = command("demo", _demo, "train the packaged T-shirt and write pictures and a page that plays it")
    demo.add_argument("--out", default="runs/demo", help="run folder (default: runs/demo)")
    demo.add_argument("--minutes", type=_positive, default=3.0, help="minutes of training (default: 3)")
    demo.add_argument("--scene", default="ncs:demo", help="another scene file")

    train = command("train", _train, "train the garment of a scene file from the physics energy alone")
    train.add_argument("scene", metavar="SCENE", help="scene file (TOML), or ncs:NAME for a packaged one")
    train.add_argument("--out", required=True, metavar="RUN", help="folder for checkpoints and logs")
    train.add_argument("--steps", type=_whole, help="optimiser steps (default: the scene's)")
    train.add_argument("--minutes", type=_positive, help="train for about this long instead of a number of steps")
    train.add_argument("--seed", type=_seed, help="seed (default: the scene's)")
    train.add_argument("--preset", choices=PRESETS, help="speed for accuracy: sizes of the network (default: the scene's)")
    train.add_argument("--resume", action="store_true", help="go on with the run in --out from its last checkpoint")
    train.add_argument("--preview", action="store_true", help="write pictures and a page into the run folder when done")
    train.add_argument(
        "--hosts", type=_hosts, metavar="HOST:PORT,COUNT,RANK",
        help="train with the same command on other hosts: the first one's address, how many there are, and which one this is, "
        "from 0; `auto` asks the cluster (Slurm, Open MPI, Kubernetes, Cloud TPU)",
    )  # fmt: skip

    animate = command("animate", _animate, "animate a trained garment over a motion")
    animate.add_argument("folder", metavar="RUN", help="folder that ncs train made")
    animate.add_argument("--motion", metavar="FILE", help="motion file or ncs:NAME (default: the scene's first motion)")
    animate.add_argument(
        "--alpha", type=_finite, default=1.0, help="how much the garment moves: 0 static, 1 as trained, more exaggerates"
    )
    animate.add_argument(
        "--rank", type=_whole, help="make the decoder smaller for this motion: its rank, say 64; prints the error"
    )
    animate.add_argument("--bfloat16", action="store_true", help="keep the decoder in 16 bits; prints the error")
    animate.add_argument("--out", required=True, metavar="FILE", help=FORMATS)
    animate.add_argument("--body", action="store_true", help="write the body too, skinned, into a .glb")

    export = command("export", _export, "write one step of a trained garment for a host that has neither JAX nor this package")
    export.add_argument("folder", metavar="RUN", help="folder that ncs train made")
    export.add_argument("--format", choices=("onnx", "stablehlo"), default="onnx", help="default: onnx")
    export.add_argument("--out", required=True, metavar="FILE", help="the file; what a host has to know goes to FILE.json")
    export.add_argument("--motion", metavar="FILE", help="to check it on and to fit --rank to (default: one of the scene's)")
    export.add_argument("--rank", type=_whole, default=0, help="a smaller decoder: its rank, say 64; prints the error")
    export.add_argument("--float16", action="store_true", help="store weights in 16 bits (computed in 32); prints the error")
    export.add_argument("--opset", type=_whole, default=15, help="of the ONNX operators, 13 to 21 (default: 15)")

    simulate = command("simulate", _simulate, "animate the garment of a scene by full-space simulation, without a network")
    simulate.add_argument("scene", metavar="SCENE", help="scene file (TOML), or ncs:NAME for a packaged one")
    simulate.add_argument("--motion", metavar="FILE", help="motion file or ncs:NAME (default: the scene's first motion)")
    simulate.add_argument(
        "--out", required=True, metavar="FILE",
        help=f"{FORMATS}; an interrupted simulation goes on from FILE.partial.npz",
    )  # fmt: skip

    evaluate = command("evaluate", reports.evaluate, "measure strain, shear, penetration, energies and forces out of balance")
    evaluate.add_argument("target", metavar="RUN|FILE", help="run folder, or an animation file together with --scene")
    evaluate.add_argument("--motion", metavar="FILE", help="motion file or ncs:NAME (default: all of the scene's)")
    evaluate.add_argument("--scene", metavar="SCENE", help="the scene that an animation file belongs to")
    evaluate.add_argument("--alpha", type=_finite, default=1.0, help="motion control")
    evaluate.add_argument(
        "--reference", metavar="FILE", help="an animation of the same motion, say by ncs simulate, to compare the movement with"
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON, with every frame")

    fit = command("fit", reports.fit, "bring a garment onto a body, and write it as a file to train with, and a picture")
    fit.add_argument("garment", metavar="GARMENT", help="mesh file: .npz, .obj, .ply, .stl, .glb, .usd*")
    fit.add_argument("--body", default="ncs:body", metavar="FILE", help="body file (default: ncs:body, the packaged one)")
    fit.add_argument("--out", required=True, metavar="FILE", help=".npz; the picture goes beside it, as .png")
    fit.add_argument("--scale", type=_positive, default=0.0, help="metres a unit of the file (default: found out)")
    fit.add_argument("--up", choices=("x", "y", "z"), default="", help="the axis that is up in the file (default: found out)")
    fit.add_argument("--weld", type=_positive, default=0.0, metavar="M", help="make vertices within M metres one")
    fit.add_argument(
        "--clearance", type=_positive, default=0.004, metavar="M", help="keep vertices M metres off the body (default: 0.004)"
    )
    look = command(
        "view", _view, "look at a run, an animation or a scene in a browser page: play, scrub, orbit, alpha, colours"
    )
    look.add_argument("target", metavar="RUN|FILE|SCENE", help="run folder; animation file together with --scene; or scene")
    look.add_argument("--motion", metavar="FILE", help="motion file or ncs:NAME (default: all of the scene's, to be chosen)")
    look.add_argument("--scene", metavar="SCENE", help="the scene that an animation file belongs to")
    look.add_argument("--overlay", metavar="RUN|FILE", nargs="+", default=[], help="others of the first motion, to lay over it")
    look.add_argument("--host", default="127.0.0.1", help="address to serve on (default: 127.0.0.1, this machine alone)")
    look.add_argument("--port", type=_whole, default=8080, help="default: 8080")

    check = command("check", reports.check, "read and assemble a scene without training it")
    check.add_argument("scene", metavar="SCENE", nargs="?", help="scene file (TOML), or ncs:NAME")
    check.add_argument("--fields", action="store_true", help="print a scene file with every field, its default and its range")
    return parser


def _keep_compiled_programs() -> None:
    """A second run need not compile again; JAX_COMPILATION_CACHE_DIR, if set, says where."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ncs-jax"
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"a number above 0 expected, found {text}")
    return value


def _whole(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"a whole number from 1 expected, found {text}")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**31:
        raise argparse.ArgumentTypeError(f"a whole number from 0 to {2**31 - 1} expected, found {text}")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"a finite number expected, found {text}")
    return value


def _hosts(text: str) -> dict:
    """Arguments of `jax.distributed.initialize`."""
    if text == "auto":
        return {}
    found = re.fullmatch(r"(.+):(\d+),(\d+),(\d+)", text)
    if not found or not 0 < int(found[2]) < 65536 or int(found[4]) >= int(found[3]):
        raise argparse.ArgumentTypeError(f"HOST:PORT,COUNT,RANK with RANK below COUNT, or auto, expected, found {text}")
    every = {"cluster_detection_method": "deactivate"}  # all devices of this host, whoever started the command
    address = f"{found[1]}:{found[2]}"
    return {"coordinator_address": address, "num_processes": int(found[3]), "process_id": int(found[4]), **every}


def _join(hosts: dict) -> None:
    """Make this process one of those that train together; where they do not meet in five minutes, JAX ends it."""
    import socket

    import jax

    jax.config.update("jax_enable_preemption_service", False)  # which would ignore SIGTERM
    try:
        if hosts:
            address, port = hosts["coordinator_address"].rsplit(":", 1)
            socket.getaddrinfo(address.strip("[]"), port)
            if hosts["process_id"] == 0:
                socket.create_server(("", int(port))).close()  # JAX itself crashes where another program has it
            print("waiting for the other hosts", flush=True)
        jax.distributed.initialize(**hosts)
    except (OSError, RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0][:120]
        mend = "give HOST:PORT,COUNT,RANK: HOST and a free port of the first one, the same on each"
        raise InputError(f"the hosts do not find each other: {reason}", field="--hosts", mend=mend) from None


def _leave(code: int) -> None:
    """End a process that trains with others before they have finished; on the way out JAX would wait for them."""
    import jax

    if jax.distributed.is_initialized():
        sys.stdout.flush()
        os._exit(code)


def _train(options) -> int:
    import jax

    if options.preset and options.resume:
        raise InputError("a run keeps its network", field="--preset", value=options.preset, mend="leave it out, or begin anew")
    scene = load_scene(options.scene, options.preset)
    if options.hosts is not None:
        _join(options.hosts)
    try:
        run = _trained(scene, options.out, options.steps, options.minutes, options.seed, options.resume)
    except jax.errors.JaxRuntimeError as error:
        if options.hosts is None:
            raise
        reason = str(error).splitlines()[0][:250]
        mend = "see what the other hosts say, then start the command on each again, with --resume"
        raise InputError(f"training with the other hosts broke off: {reason}", field="--hosts", mend=mend) from error
    if options.hosts is not None:
        jax.distributed.shutdown()  # the others need not wait for the pictures
    if options.preview and jax.process_index() == 0:
        _previews(run, options.out)
    return 0


def _demo(options) -> int:
    out = Path(options.out)
    resume = (out / "run.json").exists()
    run = _trained(options.scene, out, None, options.minutes, None, resume)
    quantities = _previews(run, out)
    motion = run.assembly.scene.motion.validation
    print(f"On {motion[0] if motion else 'its own motion'}, which it never trained on:" if motion else "On its motion:")
    print(f"  mean strain {quantities['strain_mean']:.2f} %, penetrating vertices {quantities['penetrating']:.2f} %")
    return 0


def _previews(run, out) -> dict[str, float]:
    from ncs_jax.preview import preview

    print("drawing the preview ...", flush=True)
    quantities = preview(run, out)
    for name in ("preview.png", "preview.gif", "preview.html", "energies.png"):
        if (Path(out) / name).exists():
            print(f"  {Path(out) / name}")
    return quantities


def _trained(scene, out, steps, minutes, seed, resume):
    import jax
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from ncs_jax.runs import train

    console = Console(quiet=jax.process_index() > 0)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        TextColumn("{task.percentage:>3.0f}%"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=False) as progress:
        task = progress.add_task("reading the scene and compiling", total=None)

        def show(r):
            if jax.device_count() > 1 and progress.tasks[0].total is None:  # the first report
                fewer = "" if r.devices == jax.device_count() else ": no more of them divide training.batch"
                progress.print(f"training on {r.devices} of {jax.device_count()} devices{fewer}")
            parts = " ".join(f"{name} {value:.3g}" for name, value in r.energies.items())
            text = (
                f"step {r.step}/{r.steps}  [bold]{sum(r.energies.values()):.4f} J[/bold]  ({parts})\n"
                f"strain {r.strain:.1f} %  penetrating {r.penetrating:.1f} %  {_clock(r.left)} left"
                + ("" if r.moved is None else f"  alpha moves {r.moved:.1f} mm")
                + (f"  dropped {r.dropped}" if r.dropped else "")
            )
            progress.update(task, total=r.steps, completed=r.step, description=text)
            if r.message:
                progress.print(r.message)
            if r.validation:
                words = ", ".join(f"{k} {v:.4g}" for k, v in r.validation.items())
                progress.print(f"step {r.step}: validation {words}")
            if not console.is_terminal and (r.step % 100 == 0 or r.step == r.steps):
                print(f"step {r.step}/{r.steps} total {sum(r.energies.values()):.4f} {parts} strain {r.strain:.1f} %"
                      f" penetrating {r.penetrating:.1f} % {_clock(r.left)} left", flush=True)  # fmt: skip

        return train(scene, out, steps=steps, minutes=minutes, seed=seed, resume=resume, report=show)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _animate(options) -> int:
    import numpy as np

    from ncs_jax import io
    from ncs_jax.runs import load_run

    run = load_run(options.folder)
    motions = (options.motion,) if options.motion else reports.motions_of(run.assembly.scene)
    if not motions:
        raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
    worn_by = None
    if options.body:
        if run.assembly.body is None:
            raise InputError("a scene with a body expected", file=options.folder, field="--body", mend="leave it out")
        worn_by = run.assembly.body, run.motion(motions[0])
    vertices, error = run.animate(motions[0], options.alpha), ""
    if options.rank or options.bfloat16:
        smaller = run.compressed(motions[0], rank=options.rank or 0, bfloat16=options.bfloat16)
        whole, vertices = vertices, smaller.animate(motions[0], options.alpha)
        apart = 1000 * np.linalg.norm(vertices - whole, axis=-1)
        error = f"; {np.mean(apart):.2g} mm from the whole decoder, {np.max(apart):.2g} at most"
    garment = run.assembly.garment
    fps = run.assembly.model.fps
    io.write_animation(options.out, vertices, garment.faces, fps, rest=garment.vertices, worn_by=worn_by)
    print(f"{options.out}: {len(vertices)} frames at {fps:g} per second, {vertices.shape[1]} vertices{error}")
    return 0


def _export(options) -> int:
    from ncs_jax.runs import load_run

    chosen = {name: getattr(options, name) for name in ("format", "rank", "float16", "opset", "motion")}
    print(load_run(options.folder).export(options.out, **chosen))
    return 0


def _simulate(options) -> int:
    import numpy as np
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from ncs_jax import io
    from ncs_jax.simulation import simulate

    partial = Path(f"{str(options.out).rstrip('/')}.partial.npz")
    console = Console()
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("reading the scene and compiling", total=None)

        def show(p):
            text = f"frame {p.frame}/{p.frames}  {p.iterations} iterations  {p.residual:.3g} g  {_clock(p.left)} left"
            progress.update(task, total=p.frames, completed=p.frame, description=text)
            if not console.is_terminal and (p.frame % 30 == 0 or p.frame == p.frames):
                print(text, flush=True)

        result = simulate(options.scene, options.motion, partial=partial, report=show)
    garment = result.assembly.garment
    io.write_animation(options.out, result.vertices, garment.faces, result.fps, rest=garment.vertices)
    partial.unlink(missing_ok=True)
    print(f"{options.out}: {len(result.vertices)} frames at {result.fps:g} per second, {result.vertices.shape[1]} vertices")
    precision = "double" if result.vertices.dtype == np.float64 else "single"
    print(
        f"  iterations a frame {np.mean(result.iterations):.1f}, residual at most {np.max(result.residual):.3g} g, "
        f"median {np.median(result.seconds):.3g} s, {precision} precision"
    )
    for status, text in ((1, "out of iterations"), (2, "no step lowers the energy further"), (3, "not finite")):
        frames = np.flatnonzero(result.status == status)
        if frames.size:
            worst = result.residual[frames].max()
            print(f"  {frames.size} frames not at tolerance: {text} (first: frame {frames[0]}, worst {worst:.3g} g)")
    return 0


def _view(options) -> int:
    from ncs_jax.live import view

    window = view(
        options.target,
        scene=options.scene,
        motion=options.motion,
        overlays=options.overlay,
        host=options.host,
        port=options.port,
    )
    print(f"{window.address}  (over SSH: ssh -L {options.port}:localhost:{options.port} HOST; Ctrl-C ends it)", flush=True)
    try:
        window.wait()
    except KeyboardInterrupt:
        window.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The command line: ncs demo, train, animate, export, simulate, evaluate, check."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
import textwrap
from pathlib import Path

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

    evaluate = command("evaluate", _evaluate, "measure strain, shear, penetration, energies and forces out of balance")
    evaluate.add_argument("target", metavar="RUN|FILE", help="run folder, or an animation file together with --scene")
    evaluate.add_argument("--motion", metavar="FILE", help="motion file or ncs:NAME (default: all of the scene's)")
    evaluate.add_argument("--scene", metavar="SCENE", help="the scene that an animation file belongs to")
    evaluate.add_argument("--alpha", type=_finite, default=1.0, help="motion control")
    evaluate.add_argument(
        "--reference", metavar="FILE", help="an animation of the same motion, say by ncs simulate, to compare the movement with"
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON, with every frame")

    check = command("check", _check, "read and assemble a scene without training it")
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


def _default_motions(scene) -> tuple[str, ...]:
    return (*scene.motion.files, *scene.motion.validation)


def _animate(options) -> int:
    import numpy as np

    from ncs_jax import io
    from ncs_jax.runs import load_run

    run = load_run(options.folder)
    motions = (options.motion,) if options.motion else _default_motions(run.assembly.scene)
    if not motions:
        raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
    vertices, error = run.animate(motions[0], options.alpha), ""
    if options.rank or options.bfloat16:
        smaller = run.compressed(motions[0], rank=options.rank or 0, bfloat16=options.bfloat16)
        whole, vertices = vertices, smaller.animate(motions[0], options.alpha)
        apart = 1000 * np.linalg.norm(vertices - whole, axis=-1)
        error = f"; {np.mean(apart):.2g} mm from the whole decoder, {np.max(apart):.2g} at most"
    garment = run.assembly.garment
    io.write_animation(options.out, vertices, garment.faces, run.assembly.model.fps, rest=garment.vertices)
    print(
        f"{options.out}: {len(vertices)} frames at {run.assembly.model.fps:g} per second, {vertices.shape[1]} vertices{error}"
    )
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
    print(
        f"  iterations a frame {np.mean(result.iterations):.1f}, residual at most {np.max(result.residual):.3g} g, "
        f"median {np.median(result.seconds):.3g} s"
    )
    for status, text in ((1, "out of iterations"), (2, "no step lowers the energy further"), (3, "not finite")):
        frames = np.flatnonzero(result.status == status)
        if frames.size:
            worst = result.residual[frames].max()
            print(f"  {frames.size} frames not at tolerance: {text} (first: frame {frames[0]}, worst {worst:.3g} g)")
    return 0


def _evaluate(options) -> int:
    import numpy as np

    from ncs_jax import io
    from ncs_jax.assembly import assemble
    from ncs_jax.dynamics import MEASURES, compare, dynamics
    from ncs_jax.evaluation import QUANTITIES, measure, summarise
    from ncs_jax.runs import Run, load_run

    target = Path(options.target)
    if not target.exists():
        raise InputError("no such run folder or animation", file=target, mend="check the path")
    rows, moving = {}, {}

    def look(run, name, track, vertices):
        model = run.assembly.model
        rows[name], moving[name] = measure(model, vertices, track), dynamics(model, vertices, track)
        if options.reference is None:
            return
        reference = io.read_animation(options.reference)
        if reference.vertices.shape != vertices.shape:
            raise InputError(
                f"frames, vertices and 3 of the motion expected, {vertices.shape}", file=options.reference, field="vertices",
                value=reference.vertices.shape, mend="give the --motion that it was made from",
            )  # fmt: skip
        moving[name] |= compare(model, vertices, reference.vertices, track)

    if target.is_dir() and not options.scene:
        run = load_run(target)
        names = (options.motion,) if options.motion else tuple(dict.fromkeys(_default_motions(run.assembly.scene)))
        if options.reference is not None and len(names) > 1:
            raise InputError("one motion is needed beside --reference", field="--motion", mend="give the one it was made from")
        for name in names:
            track = run.track(name)
            look(run, name, track, run.animate(track, options.alpha))
            if options.alpha != 0 and run.assembly.network.controlled:
                still = dynamics(run.assembly.model, run.animate(track, 0.0), track)["speed"]
                moving[name]["gain"] = moving[name]["speed"] / still if still > 0 else float("nan")
    else:
        if not options.scene:
            raise InputError("the scene of the animation is needed", file=target, field="--scene", mend="add --scene SCENE")
        animation, scene = io.read_animation(target), load_scene(options.scene)
        assembly = assemble(scene.without_network())
        names = (options.motion,) if options.motion else _default_motions(scene)
        if not names:
            raise InputError("a motion is needed", field="--motion", mend="give the motion of the animation")
        run = Run(assembly, {})
        track = run.track(names[0])
        expected = (track.start.shape[0], *assembly.model.garment.mesh.rest.shape)
        if animation.vertices.shape != expected:
            raise InputError(
                f"frames, vertices and 3 of the scene expected, {expected}", file=target, field="vertices",
                value=animation.vertices.shape, mend="give the --motion and --scene that it was made from",
            )  # fmt: skip
        look(run, names[0], track, np.asarray(animation.vertices, np.float32))
    if options.json:
        frames = {n: {k: v.tolist() for k, v in r.items()} for n, r in rows.items()}
        print(json.dumps({n: {"mean": summarise(r) | moving[n], "frames": frames[n]} for n, r in rows.items()}))
        return 0
    means = {name: summarise(r) | moving[name] for name, r in rows.items()}
    if len(means) > 1:
        every = dict.fromkeys(k for m in means.values() for k in m)
        means["all"] = {k: float(np.mean([m[k] for m in means.values() if k in m])) for k in every}
    labels = [name if name.startswith("ncs:") else Path(name).stem for name in means]
    width = max(map(len, labels)) + 2
    for quantity in dict.fromkeys(k for m in means.values() for k in m):
        unit, text = (QUANTITIES | MEASURES).get(quantity, ("J", "energy"))
        print(f"{quantity} [{unit}], {text}" if unit else f"{quantity}, {text}")
        for name, m in zip(labels, means.values(), strict=True):
            if quantity in m:
                print(f"  {name:{width}} {m[quantity]:.4g}")
    return 0


def _check(options) -> int:
    from ncs_jax.assembly import assemble
    from ncs_jax.grading import findings
    from ncs_jax.io.surface import anatomy
    from ncs_jax.scene import template

    if options.fields:
        print(template(), end="")
        return 0
    if options.scene is None:
        raise InputError("a scene file is needed", mend="give one, ncs:tshirt for the packaged one, or --fields")
    assembly = assemble(load_scene(options.scene))
    model, mesh = assembly.model, assembly.model.garment.mesh
    names = assembly.body.joint_names if assembly.body is not None else ()
    joints = [names[model.source_joints[j]] if names else str(model.source_joints[j]) for j in model.inputs]
    terms = model.terms
    on = [n for n in ("membrane", "bending", "collision", "gravity", "inertia", "pinning") if getattr(terms, n)]
    print(f"{options.scene}: good")
    mass = float((mesh.vertex_area * model.material.density).sum())
    size = f"{float(mesh.face_area.sum()):.3f} m^2, {mass:.3f} kg, edges {1000 * float(mesh.edge_length.mean()):.1f} mm"
    print(f"  garment   {mesh.rest.shape[0]} vertices, {mesh.faces.shape[0]} triangles, {size}")
    record = assembly.garment
    parts = anatomy(record.vertices, record.faces)
    print(f"  surface   connected components {parts.components}, boundary loops (holes) {parts.loops}, ", end="")
    print(f"degenerate triangles {parts.degenerate}")
    kept = f"{record.welded} vertices welded to others" if record.welded else "vertices in the file's number and order"
    print(f"  file      {record.scale:g} m a unit, {record.up.upper()} up; {kept}")
    if model.body is not None:
        print(f"  body      {len(assembly.body.vertices)} vertices, of which {model.body.shape[0]} can be touched")
    print(f"  joints    {', '.join(joints)}")
    print(f"  energies  {', '.join(on)}" + (f" ({terms.membrane})" if terms.membrane else ""))
    scene = assembly.scene
    for kind, names in (("train", scene.motion.files), ("validate", scene.motion.validation)):
        for name in names:
            print(f"  {kind:9} {name}: {len(assembly.motions[name].poses)} frames at {model.fps:g} per second")
            for note in assembly.motions[name].notes:
                print(textwrap.fill(note, 128, initial_indent=12 * " ", subsequent_indent=14 * " "))
    if not model.moves:
        print("  the character never moves: only the static network is trained")
    found = findings(assembly)
    for finding in found:
        print(f"  at risk   {finding.what}: {finding.value}: {finding.risk}; {finding.mend}")
    if not found:
        print("  safe      material, mesh, fit and motions are inside the ranges of the stability map")
    return 0


if __name__ == "__main__":
    sys.exit(main())

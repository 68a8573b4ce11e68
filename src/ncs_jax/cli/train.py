"""`ncs train` and `ncs demo`: train with a bar that says how it goes, on one host or several."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ncs_jax.cli import arguments
from ncs_jax.cli.preview import check_video, draw
from ncs_jax.cli.progress import WorkProgress
from ncs_jax.errors import InputError
from ncs_jax.runs.log import Report
from ncs_jax.scene.spec import PRESETS, load_scene

if TYPE_CHECKING:
    from ncs_jax.runs.adapt import Adapted
    from ncs_jax.runs.run import Run

__all__ = ["adapted", "add_commands", "demo", "leave", "train"]

DEMO_MINUTES = 3.0


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(commands, "demo", demo, "train the packaged dress and write pictures and a page that plays it")
    parser.add_argument("--out", default="runs/demo", help="run folder (default: runs/demo)")
    parser.add_argument(
        "--minutes",
        type=partial(arguments.positive, of="minutes"),
        help="minutes of training, from the first step on (default: 3)",
    )
    parser.add_argument("--scene", default="ncs:demo", help="another scene file")

    parser = arguments.command(commands, "train", train, "train the garment of a scene file from the physics energy alone")
    parser.add_argument(
        "scene", metavar="SCENE", nargs="?", help="scene file (TOML), or ncs:NAME for a packaged one; none to --resume"
    )
    parser.add_argument("--out", required=True, metavar="RUN", help="folder for checkpoints and logs")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=arguments.whole, help="optimiser steps in all (default: the scene's)")
    length.add_argument(
        "--minutes",
        type=partial(arguments.positive, of="minutes"),
        metavar="M",
        help="as many steps as fit into M minutes, from the first step on",
    )
    parser.add_argument("--seed", type=arguments.seed, help="seed (default: the scene's)")
    parser.add_argument("--preset", choices=PRESETS, help="speed for accuracy: sizes of the network (default: the scene's)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out: to --steps, or --minutes more")
    parser.add_argument("--from", dest="start", metavar="RUN", help="begin with the weights of another run of this garment")
    parser.add_argument("--preview", action="store_true", help="write pictures and a page into the run folder when done")
    parser.add_argument("--video", action="store_true", help="as --preview, with preview.mp4, every frame, in place of the GIF")
    parser.add_argument(
        "--hosts", type=arguments.hosts, metavar="HOST:PORT,COUNT,RANK",
        help="train with the same command on other hosts: the first one's address, how many there are, and which one this is, "
        "from 0; `auto` asks the cluster (Slurm, Open MPI, Kubernetes, Cloud TPU)",
    )  # fmt: skip


def train(options) -> int:
    """Train the garment of a scene, perhaps with other hosts."""
    if options.preset and options.resume:
        raise InputError("a run keeps its network", field="--preset", value=options.preset, mend="leave it out, or begin anew")
    if options.video:
        check_video(options.out)
    scene = None
    if options.scene is not None:
        scene = load_scene(options.scene, options.preset)  # before JAX is imported, which takes a second
        arguments.check_motions(scene)
    elif not options.resume:
        raise InputError("a scene file is needed", field="SCENE", mend="give one, ncs:tshirt for the packaged one, or --resume")

    import jax

    if options.hosts is not None:
        _join(options.hosts)
    chosen = {name: getattr(options, name) for name in ("steps", "minutes", "seed", "resume", "start")}
    try:
        run = _trained(scene, options.out, **chosen)
    except jax.errors.JaxRuntimeError as error:
        if options.hosts is None:
            raise
        reason = str(error).splitlines()[0][:250]
        mend = "see what the other hosts say, then start the command on each again, with --resume"
        raise InputError(f"training with the other hosts broke off: {reason}", field="--hosts", mend=mend) from error
    if options.hosts is not None:
        jax.distributed.shutdown()  # the others need not wait for the pictures
    if jax.process_index() == 0:
        if options.preview or options.video:
            draw(run, options.out, video=options.video)
        _warn_of_few_steps(run, options.steps, f"ncs train --out {shlex.quote(options.out)} --resume --minutes M goes on")
    return 0


def demo(options) -> int:
    """Train the packaged dress, draw it and print how it does on a spin; a demo that is there goes on."""
    out = Path(options.out)
    resume = (out / "run.json").exists()
    minutes = options.minutes if options.minutes or resume else DEMO_MINUTES
    scene = load_scene(options.scene)
    arguments.check_motions(scene)
    run = _trained(scene, out, minutes=minutes, resume=resume)
    draw(run, out)
    _warn_of_few_steps(run, None, f"ncs demo --out {shlex.quote(str(out))} --minutes M goes on")
    return 0


def adapted(run: Run, motions: Sequence[str], options) -> Adapted:
    """Adapt a run to motions as the options of `arguments.add_adapting` say, with a bar; print what it was and what it is."""
    from ncs_jax.runs.adapt import adapt, adapted_folder

    folder = options.adapted or adapted_folder(Path(run.assembly.scene.source).parent, motions)
    with _TrainingBar() as bar:
        try:
            found = adapt(run, motions, options.adapt, folder, report=bar.show, say=bar.begin)
        except KeyboardInterrupt:
            if bar.reports:
                bar.say(f"{folder} keeps what is learned so far; the same command goes on from there")
            raise
    if not bar.reports:
        print(f"{folder} has its {found.seconds:g} seconds already: nothing was trained; --adapt, with more, goes on")
    print("\n".join(f"  {line}" for line in str(found).splitlines()))
    return found


def _trained(scene, out, **chosen):
    """Train with a bar, and say so where a run has all its steps already."""
    import jax

    from ncs_jax.runs import train as runs_train

    with _TrainingBar() as bar:
        run = runs_train.train(scene, out, **chosen, report=bar.show, say=bar.begin)
    if not bar.reports and jax.process_index() == 0:
        print(f"{out} has its {run.steps} steps already: nothing was trained; --steps N, or --minutes M, goes on")
    return run


def _warn_of_few_steps(run, steps: int | None, mend: str) -> None:
    """Say, at the very end, that a training whose steps nobody chose was too short to be looked at."""
    from ncs_jax.runs.plan import ENOUGH

    if steps is None and run.steps < ENOUGH:
        what = f"only {run.steps} steps were taken, too few to learn from: what was written shows no trained garment"
        print(f"ncs: warning: {what}; {mend}", file=sys.stderr)


class _TrainingBar:
    """Say how training goes; only the first process does. Ctrl-C ends it after the chunk of steps under way, which is kept."""

    def __init__(self) -> None:
        import jax

        self._progress = WorkProgress("reading the scene", quiet=jax.process_index() > 0)
        self._devices = jax.device_count()
        self._handler: Any = None
        self._stopped = False
        self.reports = 0

    def __enter__(self) -> _TrainingBar:
        self._progress.__enter__()
        return self

    def __exit__(self, *error) -> None:
        self._let_go()
        self._progress.__exit__(*error)

    def _stop(self, *_) -> None:
        self._stopped = True
        self._let_go()  # a second Ctrl-C does not wait
        self._progress.say("stopping after these steps; Ctrl-C again stops at once")

    def _let_go(self) -> None:
        if self._handler is not None:
            signal.signal(signal.SIGINT, self._handler)
            self._handler = None

    def say(self, line: str) -> None:
        """Print a line."""
        self._progress.say(line)

    def begin(self, doing: str) -> None:
        """Say what is done before the first step."""
        self._progress.begin(doing)

    def show(self, r: Report) -> None:
        """Show a report.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed since the last one.
        """
        if self._stopped:
            raise KeyboardInterrupt
        if not self.reports and self._devices == 1 and threading.current_thread() is threading.main_thread():
            self._handler = signal.signal(signal.SIGINT, self._stop)
        if self._devices > 1 and not self.reports:
            fewer = "" if r.devices == self._devices else ": no more of them divide training.batch"
            self._progress.say(f"training on {r.devices} of {self._devices} devices{fewer}")
        self.reports += 1
        if r.message:
            self._progress.say(f"step {r.step}: {r.message}")
        parts = " ".join(f"{name} {value:.3g}" for name, value in r.energies.items())
        energy = f"total {sum(r.energies.values()):.4f} J ({parts})"
        garment = f"strain {r.strain:.1f} %, penetrating {r.penetrating:.1f} %"
        garment += "" if r.moved is None else f", alpha moves {r.moved:.1f} mm"
        garment += f", {r.dropped} steps dropped" if r.dropped else ""
        self._progress.show(f"step {r.step}/{r.steps}", r.step, r.steps, energy, garment, left=r.left or None)
        if r.validation:
            units = {"total": "total {:.4g} J", "strain_mean": "strain {:.3g} %", "penetrating": "penetrating {:.3g} %"}
            self._progress.say(f"step {r.step}: validation " + ", ".join(units[k].format(v) for k, v in r.validation.items()))


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


def leave(code: int) -> None:
    """End a process that trains with others before they have finished; on the way out JAX would wait for them."""
    import jax

    if jax.distributed.is_initialized():
        sys.stdout.flush()
        os._exit(code)

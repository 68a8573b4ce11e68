"""`ncs train` and `ncs demo`: train with a bar that says how it goes, on one host or several."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from ncs_jax.cli import arguments
from ncs_jax.cli.clock import clock
from ncs_jax.errors import InputError
from ncs_jax.runs.log import Report
from ncs_jax.scene.spec import PRESETS, load_scene

__all__ = ["add_commands", "demo", "leave", "train"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(commands, "demo", demo, "train the packaged T-shirt and write pictures and a page that plays it")
    parser.add_argument("--out", default="runs/demo", help="run folder (default: runs/demo)")
    parser.add_argument("--minutes", type=arguments.positive, default=3.0, help="minutes of training (default: 3)")
    parser.add_argument("--scene", default="ncs:demo", help="another scene file")

    parser = arguments.command(commands, "train", train, "train the garment of a scene file from the physics energy alone")
    parser.add_argument("scene", metavar="SCENE", help="scene file (TOML), or ncs:NAME for a packaged one")
    parser.add_argument("--out", required=True, metavar="RUN", help="folder for checkpoints and logs")
    parser.add_argument("--steps", type=arguments.whole, help="optimiser steps (default: the scene's)")
    parser.add_argument("--minutes", type=arguments.positive, help="train for about this long instead of a number of steps")
    parser.add_argument("--seed", type=arguments.seed, help="seed (default: the scene's)")
    parser.add_argument("--preset", choices=PRESETS, help="speed for accuracy: sizes of the network (default: the scene's)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out from its last checkpoint")
    parser.add_argument("--preview", action="store_true", help="write pictures and a page into the run folder when done")
    parser.add_argument(
        "--hosts", type=arguments.hosts, metavar="HOST:PORT,COUNT,RANK",
        help="train with the same command on other hosts: the first one's address, how many there are, and which one this is, "
        "from 0; `auto` asks the cluster (Slurm, Open MPI, Kubernetes, Cloud TPU)",
    )  # fmt: skip


def train(options) -> int:
    """Train the garment of a scene, perhaps with other hosts."""
    if options.preset and options.resume:
        raise InputError("a run keeps its network", field="--preset", value=options.preset, mend="leave it out, or begin anew")
    scene = load_scene(options.scene, options.preset)  # before JAX is imported, which takes a second

    import jax

    from ncs_jax.runs import train as runs_train

    if options.hosts is not None:
        _join(options.hosts)
    try:
        chosen = {name: getattr(options, name) for name in ("steps", "minutes", "seed", "resume")}
        with _TrainingBar() as bar:
            run = runs_train.train(scene, options.out, **chosen, report=bar.show)
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


def demo(options) -> int:
    """Train the packaged T-shirt, draw it and print how it does on a motion that it never saw."""
    out, scene = Path(options.out), load_scene(options.scene)

    from ncs_jax.runs import train as runs_train

    resume = (out / "run.json").exists()
    with _TrainingBar() as bar:
        run = runs_train.train(scene, out, minutes=options.minutes, resume=resume, report=bar.show)
    quantities = _previews(run, out)
    motion = run.assembly.scene.motion.validation
    print(f"On {motion[0]}, which it never trained on:" if motion else "On its motion:")
    inside = f", penetrating vertices {quantities['penetrating']:.2f} %" if "penetrating" in quantities else ""
    print(f"  mean strain {quantities['strain_mean']:.2f} %{inside}")
    return 0


def _previews(run, out) -> dict[str, float]:
    """Draw the run into its folder, print which files there are, and return how it does on its motion."""
    from ncs_jax.view.preview import preview

    print("drawing the preview ...", flush=True)
    quantities = preview(run, out)
    for name in ("preview.png", "preview.gif", "preview.html", "energies.png"):
        if (Path(out) / name).exists():
            print(f"  {Path(out) / name}")
    return quantities


class _TrainingBar:
    """A bar that says how training goes; lines instead where the output is no terminal. Only the first process shows it."""

    def __init__(self) -> None:
        import jax
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = Console(quiet=jax.process_index() > 0)
        percent = TextColumn("{task.percentage:>3.0f}%")
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), percent, TimeElapsedColumn())
        self._progress = Progress(*columns, console=self._console, transient=False)
        self._task = self._progress.add_task("reading the scene and compiling", total=None)
        self._devices = jax.device_count()

    def __enter__(self) -> _TrainingBar:
        self._progress.start()
        return self

    def __exit__(self, *_) -> None:
        self._progress.stop()

    def show(self, r: Report) -> None:
        """Show a report."""
        if self._devices > 1 and self._progress.tasks[0].total is None:  # the first report
            fewer = "" if r.devices == self._devices else ": no more of them divide training.batch"
            self._progress.print(f"training on {r.devices} of {self._devices} devices{fewer}")
        total = sum(r.energies.values())
        parts = " ".join(f"{name} {value:.3g}" for name, value in r.energies.items())
        moved = "" if r.moved is None else f"  alpha moves {r.moved:.1f} mm"
        dropped = f"  dropped {r.dropped}" if r.dropped else ""
        text = f"step {r.step}/{r.steps}  [bold]{total:.4f} J[/bold]  ({parts})\n"
        text += f"strain {r.strain:.1f} %  penetrating {r.penetrating:.1f} %  {clock(r.left)} left{moved}{dropped}"
        self._progress.update(self._task, total=r.steps, completed=r.step, description=text)
        if r.message:
            self._progress.print(r.message)
        if r.validation:
            words = ", ".join(f"{k} {v:.4g}" for k, v in r.validation.items())
            self._progress.print(f"step {r.step}: validation {words}")
        if not self._console.is_terminal and (r.step % 100 == 0 or r.step == r.steps):
            where = f"step {r.step}/{r.steps} total {total:.4f} {parts} strain {r.strain:.1f} %"
            print(f"{where} penetrating {r.penetrating:.1f} % {clock(r.left)} left", flush=True)


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

"""The command line: ncs demo, train, preview, animate, export, stream, simulate, evaluate, view, body, fit, check."""

from __future__ import annotations

import _thread
import argparse
import contextlib
import gc
import os
import shlex
import sys
import threading
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from ncs_jax.cli import animate, body, check, evaluate, fit, preview, simulate, stream, train, view
from ncs_jax.errors import InputError, InputWarning

__all__ = ["main", "quieten_jaxlib"]

DESCRIPTION = """\
Neural cloth simulation: a garment learns to move on an animated character from physics alone.

  ncs demo                          train the packaged dress and write a preview to look at
  ncs train SCENE --out RUN         train the garment of a scene file (packaged: ncs:demo, ncs:tshirt, ncs:skirt, ncs:dress)
  ncs preview RUN                   draw it again: a picture, a page that plays it, a GIF
  ncs animate RUN --out FILE        animate a trained garment
  ncs export RUN --out FILE         write its step for engines and hosts, as ONNX or StableHLO, or a page that runs it
  ncs stream RUN                    answer poses with vertices, frame by frame, for another program such as Blender
  ncs simulate SCENE --out FILE     animate it without a network, by minimising the same energy frame by frame
  ncs evaluate RUN                  strain, penetration, energies in physical units
  ncs view RUN|FILE|SCENE           look at it in a browser: play, scrub, orbit, alpha, colours
  ncs body --out FILE               write a body at rest, to model clothes on it
  ncs fit GARMENT --out FILE        bring a garment onto a body: units, axes, place, out of the skin, pins, weights
  ncs check SCENE                   read a scene and say what is in it, or what is wrong with it
"""

KEPT = 2 << 30  # bytes of compiled programs, at most

# What an interrupted command has kept.
GOES_ON = {
    train.train: "; `ncs train --out {out} --resume` goes on from the last checkpoint",
    train.demo: "; `ncs demo --out {out}` goes on from the last checkpoint",
    simulate.simulate: "; the same command goes on with the frames that are done",
}


def main(arguments: list[str] | None = None) -> int:
    """Run a command, and return its exit code: 0, 2 for input that cannot be used, or 130 when interrupted."""
    parsed = _parser().parse_args(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the simulator's matrices are small: two threads take 1.3 times as long
    if arguments is None:  # the process is ours: tracing makes many objects, and to look for cycles took a tenth of a start
        _keep_compiled_programs()
        sys.unraisablehook = _never_lost(sys.unraisablehook)
        gc.freeze()
        gc.set_threshold(10_000, 20, 50)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            warnings.showwarning = _show_warning
            return parsed.run(parsed)
    except InputError as error:
        print(f"ncs: {error.as_command}", file=sys.stderr)
        code = 2
    except BrokenPipeError:  # whoever read what is printed has enough, as `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except KeyboardInterrupt:
        given = {name: shlex.quote(value) for name, value in vars(parsed).items() if isinstance(value, str)}
        goes_on = GOES_ON.get(parsed.run, "").format(**given)
        if parsed.run in (train.train, train.demo):
            if not (Path(parsed.out) / "run.json").exists():
                goes_on = " before the first step: the same command begins again"
            elif not any(Path(parsed.out).glob("checkpoints/[0-9]*")):
                goes_on = goes_on.replace("goes on from the last checkpoint", "begins again: no checkpoint was due")
        print(f"ncs: interrupted{goes_on}", file=sys.stderr)
        code = 130
    if getattr(parsed, "hosts", None) is not None:
        train.leave(code)
    return code


AGAIN = 0.1  # s


def _never_lost(hook: Callable) -> Callable:
    """Return a hook that has Ctrl-C come again where Python drops it, as in what JAX has its collector of garbage call."""

    def dropped(what) -> None:
        if issubclass(what.exc_type, KeyboardInterrupt):
            later = threading.Timer(AGAIN, _thread.interrupt_main)
            later.daemon = True
            later.start()
        else:
            hook(what)

    return dropped


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Print what a user's input may have done wrong as one line, and any other warning as Python does."""
    told = isinstance(message, InputWarning)
    text = (
        f"ncs: warning: {message.as_command}\n" if told else warnings.formatwarning(message, category, filename, lineno, line)
    )
    (file or sys.stderr).write(text)


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="ncs", description=DESCRIPTION, formatter_class=raw)
    parser.add_argument("--version", action="version", version=f"ncs-jax {version('ncs-jax')}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (train, preview, animate, stream, simulate, evaluate, body, fit, view, check):
        group.add_commands(commands)
    return parser


def quieten_jaxlib() -> None:
    """Hide two errors of no consequence that some versions log for each program kept before; call it before JAX is imported."""
    if version("jaxlib") in ("0.10.0", "0.10.1"):
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # JAX itself sets 1, which whoever started this process may have left


def _keep_compiled_programs() -> None:
    """Have JAX keep compiled programs for the next run, once a command imports it; JAX's own variables win."""
    quieten_jaxlib()
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    with contextlib.suppress(OSError, RuntimeError):  # no home, or none that can be written to: then none is kept
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ncs-jax"
        cache.mkdir(parents=True, exist_ok=True)
        if os.access(cache, os.W_OK):
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(cache)
            _trim(cache)


def _trim(cache: Path) -> None:
    """Delete the oldest files of a folder until it holds no more than `KEPT` bytes."""
    files = sorted((entry.stat().st_mtime, entry.stat().st_size, entry.path) for entry in os.scandir(cache) if entry.is_file())
    excess = sum(size for _, size, _ in files) - KEPT
    for _, size, path in files:
        if excess <= 0:
            break
        os.unlink(path)
        excess -= size

"""The command line: ncs demo, train, animate, export, simulate, evaluate, view, body, fit, check."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from pathlib import Path

from ncs_jax.cli import animate, body, check, evaluate, fit, simulate, train, view
from ncs_jax.errors import InputError

__all__ = ["main"]

DESCRIPTION = """\
Neural cloth simulation: a garment learns to move on an animated character from physics alone.

  ncs demo                          train the packaged T-shirt and write a preview to look at
  ncs train SCENE --out RUN         train the garment of a scene file (ncs:demo, ncs:tshirt and ncs:skirt are packaged)
  ncs animate RUN --out FILE        animate a trained garment
  ncs export RUN --out FILE         write its step for a game engine or another host, as ONNX or StableHLO
  ncs simulate SCENE --out FILE     animate it without a network, by minimising the same energy frame by frame
  ncs evaluate RUN                  strain, penetration, energies in physical units
  ncs view RUN|FILE|SCENE           look at it in a browser: play, scrub, orbit, alpha, colours
  ncs body --out FILE               write a body at rest, to model clothes on it
  ncs fit GARMENT --out FILE        bring a garment onto a body: units, axes, place, out of the skin, pins, weights
  ncs check SCENE                   read a scene and say what is in it, or what is wrong with it
"""


# What an interrupted command has kept.
GOES_ON = {
    train.train: "; `ncs train --resume` goes on from the last checkpoint",
    train.demo: "; `ncs demo` goes on from the last checkpoint",
    simulate.simulate: "; the same command goes on with the frames that are done",
}


def main(arguments: list[str] | None = None) -> int:
    """Run a command, and return its exit code: 0, 2 for input that cannot be used, or 130 when interrupted."""
    parsed = _parser().parse_args(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the simulator's matrices are small: two threads take 1.3 times as long
    _keep_compiled_programs()
    if arguments is None:  # the process is ours: tracing makes many objects, and to look for cycles took a tenth of a start
        gc.freeze()
        gc.set_threshold(10_000, 20, 50)
    try:
        return parsed.run(parsed)
    except InputError as error:
        print(f"ncs: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print(f"ncs: interrupted{GOES_ON.get(parsed.run, '')}", file=sys.stderr)
        code = 130
    if getattr(parsed, "hosts", None) is not None:
        train.leave(code)
    return code


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="ncs", description=DESCRIPTION, formatter_class=raw)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for group in (train, animate, simulate, evaluate, body, fit, view, check):
        group.add_commands(commands)
    return parser


def _keep_compiled_programs() -> None:
    """Keep compiled programs for the next run, in JAX_COMPILATION_CACHE_DIR if that is set."""
    import jax
    import jaxlib

    if jaxlib.__version__ in ("0.10.0", "0.10.1"):  # which log two errors of no consequence for every program kept before
        jaxlib.utils.absl_set_min_log_level(3)
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ncs-jax"
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

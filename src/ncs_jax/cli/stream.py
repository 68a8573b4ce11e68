"""`ncs stream`: a trained garment for another program, through stdin and stdout."""

from __future__ import annotations

import os
import sys

from ncs_jax.cli import arguments
from ncs_jax.errors import InputError

__all__ = ["add_commands", "stream"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(
        commands, "stream", stream, "answer poses on stdin with vertices on stdout, frame by frame, for another program"
    )
    parser.add_argument("folder", metavar="RUN", help="folder that ncs train made")
    parser.add_argument(
        "--rank", type=arguments.whole, metavar="R", help="a smaller decoder for the scene's first motion: its rank, say 64"
    )


def stream(options) -> int:
    """Serve frames until stdin ends, or nobody reads any more."""
    arguments.check_run(options.folder)
    sink = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever else prints does not get between the vertices
    from ncs_jax.runs.run import load_run
    from ncs_jax.runs.stream import serve_frames

    run = load_run(options.folder)
    if options.rank:
        if not run.assembly.scene.motions:
            raise InputError("a scene with a motion expected", file=options.folder, field="--rank", mend="leave it out")
        run = run.compressed(run.assembly.scene.motions[0], rank=options.rank)
    try:
        serve_frames(run, sys.stdin.buffer, sink)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sink.fileno())  # or the end of Python would flush into it once more
    return 0

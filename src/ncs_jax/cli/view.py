"""`ncs view`: look at a run, an animation or a scene in a browser page."""

from __future__ import annotations

from ncs_jax.cli import arguments
from ncs_jax.cli.check import tell_beyond
from ncs_jax.cli.train import adapted
from ncs_jax.errors import InputError

__all__ = ["add_commands", "view"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(
        commands, "view", view, "look at a run, an animation or a scene in a browser page: play, scrub, orbit, alpha, colours"
    )
    parser.add_argument("target", metavar="RUN|FILE|SCENE", help="run folder; animation file together with --scene; or scene")
    parser.add_argument(
        "--motion", metavar="FILE", help="motion: FILE, FILE[10:300] or ncs:NAME (default: all of the scene's, to be chosen)"
    )
    arguments.add_adapting(parser)
    parser.add_argument("--scene", metavar="SCENE", help="the scene that an animation file belongs to")
    parser.add_argument(
        "--overlay", metavar="RUN|FILE", nargs="+", default=[], help="others of the first motion, to lay over it"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to serve on (default: 127.0.0.1, this machine alone)")
    parser.add_argument("--port", type=arguments.whole, default=8080, help="default: 8080")


def view(options) -> int:
    """Serve the page until it is interrupted."""
    for name in (options.target, *options.overlay):
        arguments.check_file(name)
    arguments.check_adapted(options)
    target = options.target if options.adapt is None else _adapted(options)
    from ncs_jax.view import live

    window = live.view(
        target,
        scene=options.scene,
        motion=options.motion,
        overlays=options.overlay,
        host=options.host,
        port=options.port,
    )
    tell_beyond(window.coverage)
    print(f"{window.address}  (over SSH: ssh -L {options.port}:localhost:{options.port} HOST; Ctrl-C ends it)", flush=True)
    try:
        window.wait()
    except KeyboardInterrupt:
        window.close()
    return 0


def _adapted(options) -> str:
    """Return the folder of the run, adapted to the motion."""
    if not options.motion:
        raise InputError("a motion expected beside --adapt", field="--motion", mend="add --motion FILE")
    arguments.check_run(options.target)
    from ncs_jax.runs.run import load_run

    return str(adapted(load_run(options.target), [options.motion], options).folder)

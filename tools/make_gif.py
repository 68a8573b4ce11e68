"""Draw a trained garment over a motion as an animated GIF: the picture of the README.

    ncs train ncs:skirt --minutes 6 --out runs/skirt
    python -m tools.make_gif runs/skirt docs/swing.gif --motion ncs:dance --frames 30 210

Takes half a minute. It is drawn at 15 frames per second, with fewer colours until it is below 3 MB.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from ncs_jax import load_run
from ncs_jax.view.pictures import animation_gif
from ncs_jax.view.preview import posed_body

SIZE = (400, 480)  # pixels
LARGEST = 3_000_000  # bytes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tools.make_gif", description=__doc__.splitlines()[0])
    parser.add_argument("run", metavar="RUN", help="folder that ncs train made")
    parser.add_argument("out", metavar="FILE", help="the GIF")
    parser.add_argument("--motion", default="ncs:dance", help="motion file or ncs:NAME (default: ncs:dance)")
    parser.add_argument("--frames", type=int, nargs=2, default=(0, None), metavar=("FIRST", "END"), help="of the motion")
    parser.add_argument("--alpha", type=float, default=1.0, help="how much the garment moves (default: 1)")
    parser.add_argument("--view", default="three-quarter", help="front, three-quarter, side or back")
    o = parser.parse_args(arguments)
    run, shown = load_run(o.run), slice(*o.frames)
    assembly = run.assembly
    garment = run.animate(o.motion, o.alpha)[shown]
    body = posed_body(assembly.body, run.motion(o.motion))[shown]
    faces = assembly.garment.faces, assembly.body.faces
    animation_gif(
        o.out, garment, faces[0], body, faces[1], assembly.model.fps,
        max_frames=len(garment), size=SIZE, view=o.view, max_bytes=LARGEST,
    )  # fmt: skip
    print(f"{o.out}: {len(garment)} frames of {o.motion}, alpha {o.alpha:g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Draw a trained garment over a motion as an animated GIF: the picture of the README.

    make demo
    python -m tools.make_gif runs/demo docs/swing.gif --motion ncs:cmu_spin --frames 0 84

Takes half a minute. It is drawn at 15 frames per second, with fewer colours until it is below 3 MB.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

from ncs_jax import load_run
from ncs_jax.view.character import animation_of
from ncs_jax.view.pictures import animation_gif

SIZE = (400, 480)  # pixels
LARGEST = 3_000_000  # bytes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tools.make_gif", description=__doc__.splitlines()[0])
    parser.add_argument("run", metavar="RUN", help="folder that ncs train made")
    parser.add_argument("out", metavar="FILE", help="the GIF")
    parser.add_argument("--motion", default="ncs:cmu_spin", help="motion file or ncs:NAME (default: ncs:cmu_spin)")
    parser.add_argument("--frames", type=int, nargs=2, default=(0, None), metavar=("FIRST", "END"), help="of the motion")
    parser.add_argument("--alpha", type=float, default=1.0, help="how much the garment moves (default: 1)")
    parser.add_argument("--view", default="three-quarter", help="front, three-quarter, side or back")
    o = parser.parse_args(arguments)
    run = load_run(o.run)
    first, end = o.frames
    whole = animation_of(run.assembly, run.motion(o.motion), run.animate(o.motion, o.alpha)).until(end)
    garment, body = whole.garment[first:], replace(whole.body, vertices=whole.body.vertices[first:])
    shown = replace(whole, garment=garment, body=body)
    animation_gif(o.out, shown, max_frames=len(garment), size=SIZE, view=o.view, max_bytes=LARGEST)
    print(f"{o.out}: {len(garment)} frames of {o.motion}, alpha {o.alpha:g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""`ncs fit`: bring a garment onto a body, and draw it there."""

from __future__ import annotations

import json
from pathlib import Path

from ncs_jax.cli import arguments
from ncs_jax.errors import InputError
from ncs_jax.scene.spec import Scene

__all__ = ["add_commands", "fit"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(
        commands, "fit", fit, "bring a garment onto a body, and write it as a file to train with, and a picture"
    )
    parser.add_argument("garment", metavar="GARMENT", help="mesh file: .npz, .obj, .ply, .stl, .glb, .vrm, .fbx, .usd*")
    arguments.add_body(parser)
    parser.add_argument("--mesh", nargs="+", default=[], metavar="NAME", help="meshes of the file that are the garment")
    parser.add_argument("--out", required=True, metavar="FILE", help=".npz; the picture goes beside it, as .png")
    parser.add_argument("--scale", type=arguments.positive, default=0.0, help="metres a unit of the file (default: found)")
    parser.add_argument("--up", choices=("x", "y", "z"), default="", help="the axis that is up in the file (default: found)")
    parser.add_argument("--weld", type=arguments.positive, default=0.0, metavar="M", help="merge vertices within M metres")
    parser.add_argument(
        "--clearance",
        type=arguments.positive,
        default=0.004,
        metavar="M",
        help="distance to keep from the body, metres (default: 0.004)",
    )


def fit(options) -> int:
    """Fit a garment to a body, write it with a picture, and print what was done to it."""
    import numpy as np

    from ncs_jax import io
    from ncs_jax.io.mesh.surface import boundary_loops
    from ncs_jax.prepare.fit import PINS
    from ncs_jax.prepare.fit import fit as fitted
    from ncs_jax.prepare.garment_checks import summarise_surface
    from ncs_jax.prepare.skinning_weights import with_body_weights
    from ncs_jax.view.animation import Animation, PosedBody
    from ncs_jax.view.pictures import contact_sheet

    out, scene = Path(options.out), Scene()
    if out.suffix.lower() != ".npz":
        raise InputError(
            "a name that ends in .npz expected", field="--out", value=options.out, mend="no other format here holds weights"
        )
    body, unit = arguments.body_of(options), {"scale": options.scale, "up": options.up, "weld": options.weld}
    given = with_body_weights(io.read_garment(scene.path(options.garment), **unit, mesh=options.mesh), body)
    asked = {name: value for name, value in (("scale", options.scale), ("up", options.up)) if value}
    found = fitted(options.garment, given, body, clearance=options.clearance, **asked)
    g, (before, after) = found.garment, found.depth
    x, parts = g.vertices, summarise_surface(g.vertices, g.faces)
    shift = ", ".join(f"{v:.3f}" for v in found.moved)
    pushed = 1000 * np.linalg.norm(x - found.before, axis=1)
    print(f"{options.garment} on {options.body}: {len(x)} vertices, {len(g.faces)} triangles")
    print(
        f"  placed    {g.scale:g} m a unit, {g.up.upper()} up; "
        + (f"moved by ({shift}) m" if found.moved.any() else "not moved")
    )
    print(f"  body      {(before > 0).sum()} vertices were inside, up to {1000 * max(before.max(), 0):.1f} mm; ", end="")
    print(f"{(pushed > 0.01).sum()} moved, by {pushed.max():.1f} mm at most; {(after > 0).sum()} inside now")
    print(f"  clearance {-1000 * after.max():.1f} mm at least, {-1000 * after.mean():.1f} mm mean")
    print(f"  surface   connected components {parts.components}, degenerate triangles {parts.degenerate}")
    for loop in sorted(boundary_loops(g.faces), key=lambda loop: -x[loop, 1].mean()):
        long = np.linalg.norm(x[loop] - np.roll(x[loop], 1, axis=0), axis=1).sum()
        print(f"  hole      {len(loop)} edges, {100 * long:.0f} cm around, at a height of {x[loop, 1].mean():.2f} m")
    if PINS in given.groups:
        print(f"  pins      {len(g.groups[PINS])} vertices, the file's own")
    elif PINS in g.groups:
        print(f"  pins      {len(g.groups[PINS])} vertices around its highest hole: nothing else carries it")
    else:
        print(f"  pins      none: {1e4 * found.carried:.0f} cm^2 lie on skin that faces up")
    spread = f"the body's where it lies on it, {100 * found.lying:.0f} % of the vertices, and spread smoothly from there"
    print("  weights   " + ("the file's own" if given.weights is not None else spread))
    io.write_garment(out, g)
    picture, sides = out.with_suffix(".png"), np.repeat(body.vertices[None], 2, axis=0)
    labels = ("placed", "out of the body")
    animation = Animation(np.stack([found.before, x]), g.faces, 1.0, PosedBody(sides, body.faces))
    contact_sheet(picture, animation, frames=2, labels=labels)
    print(f"wrote {out} and {picture}. In the scene file:\n\n{arguments.body_table(options)}\n")
    print(f"[garment]\nfile = {json.dumps(out.name)}" + (f'\npins = "{PINS}"' if PINS in g.groups else ""))
    return 0

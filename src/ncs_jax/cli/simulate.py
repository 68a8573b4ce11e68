"""`ncs simulate`: animate a scene's garment without a network."""

from __future__ import annotations

from pathlib import Path

from ncs_jax.cli import arguments
from ncs_jax.cli.progress import WorkProgress
from ncs_jax.scene.spec import load_scene

__all__ = ["add_commands", "simulate"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(
        commands, "simulate", simulate, "animate the garment of a scene by full-space simulation, without a network"
    )
    parser.add_argument("scene", metavar="SCENE", help="scene file (TOML), or ncs:NAME for a packaged one")
    parser.add_argument(
        "--motion", metavar="FILE", help="motion: FILE, FILE[10:300] or ncs:NAME (default: the scene's first motion)"
    )
    parser.add_argument(
        "--out", required=True, metavar="FILE",
        help=f"{arguments.FORMATS}; an interrupted simulation goes on from FILE.partial.npz",
    )  # fmt: skip
    parser.add_argument("--body", action="store_true", help="write the body too, into a .glb")


def simulate(options) -> int:
    """Simulate a scene's garment with a bar, write it to a file, and print how the solves went."""
    scene = load_scene(options.scene)  # before JAX is imported, which takes a second

    import numpy as np

    from ncs_jax import io
    from ncs_jax.io.animation.animation import animation_suffix
    from ncs_jax.runs import simulate as runs_simulate

    animation_suffix(options.out, with_body=options.body)  # before hours are spent on frames that cannot be written
    arguments.check_scene_kept(options.out, scene, *filter(None, [options.motion]))
    partial = Path(f"{str(options.out).rstrip('/')}.partial.npz")
    with WorkProgress("reading the scene") as progress:

        def show(p):
            if p.compiling:
                progress.begin(f"compiling, then frame {p.frame + 1} of {p.frames}")
                return
            how = f"{p.iterations} iterations, {p.residual:.3g} g out of balance"
            progress.show(f"frame {p.frame}/{p.frames}", p.frame, p.frames, how, left=p.left or None)

        result = runs_simulate.simulate(scene, options.motion, partial=partial, report=show)
    garment = result.assembly.garment
    names, x, fps = arguments.mesh_names(scene), result.vertices, result.fps
    worn_by = result.wearer() if options.body else None
    more = {"rest": garment.vertices, "uv": garment.uv}
    files = io.write_animation(options.out, x, garment.faces, fps, **more, worn_by=worn_by, names=names, layers=garment.layers)
    partial.unlink(missing_ok=True)
    arguments.tell_written(files, len(x), fps, (*garment.layers, x.shape[1]))
    precision = "double" if result.vertices.dtype == np.float64 else "single"
    print(
        f"  iterations a frame {np.mean(result.iterations):.1f}, residual at most {np.max(result.residual):.3g} g, "
        f"median {np.median(result.seconds):.3g} s, {precision} precision"
    )
    for status, text in ((1, "out of iterations"), (2, "no step lowers the energy further"), (3, "not finite")):
        frames = np.flatnonzero(result.status == status)
        if frames.size:
            worst = result.residual[frames].max()
            print(f"  {frames.size} frames not at tolerance: {text} (first: frame {frames[0]}, worst {worst:.3g} g)")
    if result.status.any() and scene.physics.collision.distance == "plane":
        print('  note: with physics.collision.distance = "plane" cloth may find no balance; "smooth" has one')
    return 0

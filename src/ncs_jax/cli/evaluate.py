"""`ncs evaluate`: measure an animation in physical units."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path

from ncs_jax.cli import arguments
from ncs_jax.errors import InputError, InputWarning
from ncs_jax.scene.motion_names import split_frames
from ncs_jax.scene.spec import Scene, load_scene

__all__ = ["add_commands", "evaluate"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(
        commands,
        "evaluate",
        evaluate,
        "measure strain, shear, penetration, skin that shows, energies and forces out of balance",
    )
    parser.add_argument("target", metavar="RUN|FILE", help="run folder, or an animation file together with --scene")
    parser.add_argument("--motion", metavar="FILE", help="motion: FILE, FILE[10:300] or ncs:NAME (default: all of the scene's)")
    parser.add_argument("--scene", metavar="SCENE", help="the scene that an animation file belongs to")
    arguments.add_alpha(parser)
    parser.add_argument(
        "--reference", metavar="FILE", help="an animation of the same motion, say by ncs simulate, to compare the movement with"
    )
    parser.add_argument("--json", action="store_true", help="print JSON, with every frame; of skin that shows, one in five")


def _scene(options) -> Scene | None:
    """Return the scene of an animation file, None for a run folder."""
    target = Path(options.target)
    if not target.exists():
        raise InputError("no such run folder or animation", file=target, mend="check the path")
    if target.is_dir() and not options.scene:
        return None
    if not options.scene:
        raise InputError("the scene of the animation is needed", file=target, field="--scene", mend="add --scene SCENE")
    return load_scene(options.scene)


def evaluate(options) -> int:
    """Print how an animation does and how it moves, in physical units."""
    target, scene = Path(options.target), _scene(options)  # before JAX is imported, which takes a second

    from ncs_jax.metrics.motion import compare_motion, measure_motion
    from ncs_jax.metrics.quality import measure, summarise
    from ncs_jax.metrics.seen import measure_seen
    from ncs_jax.runs.run import Run, assemble, load_run, read_animation_over

    rows, moving, beyond = {}, {}, {}

    def look(run, name, track, vertices):
        model = run.assembly.model
        rows[name] = measure_seen(model, vertices, track) | measure(model, vertices, track)
        moving[name] = measure_motion(model, vertices, track)
        if options.reference is None:
            return
        reference = read_animation_over(options.reference, model, track)
        moving[name] |= compare_motion(model, vertices, reference, track)

    if scene is None:
        run = load_run(target)
        run.check_terms()
        run = replace(run, trained=run.known)
        names = (options.motion,) if options.motion else tuple(dict.fromkeys(run.assembly.scene.motions))
        if not names:
            raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
        if options.reference is not None and len(names) > 1:
            raise InputError("one motion is needed beside --reference", field="--motion", mend="give the one it was made from")
        for name in names:
            track = run.track(name)
            look(run, name, track, run.animate(track, options.alpha))
            if (found := run.coverage(track)) is not None:
                beyond[name], rows[name]["outside"] = found, 100.0 * found.outside
                if found.told:
                    warnings.warn(f"{name}: {found}", InputWarning, stacklevel=1)
            if options.alpha != 0 and run.assembly.network.controlled:
                still = measure_motion(run.assembly.model, run.animate(track, 0.0), track)["speed"]
                moving[name]["gain"] = moving[name]["speed"] / still if still > 0 else float("nan")
    else:
        names = (options.motion,) if options.motion else (scene.body.file,) if scene.moves_by_itself else scene.motions
        if not names:
            raise InputError("a motion is needed", field="--motion", mend="give the motion of the animation")
        if scene.moves_by_itself and options.motion:
            raise InputError("no motion expected: the body's frames are it", field="--motion", mend="leave it out")
        run = Run(assemble(scene.without_network()), {})
        track = run.assembly.track if names[0] == scene.body.file else run.track(names[0])
        look(run, names[0], track, read_animation_over(target, run.assembly.model, track))
    if options.json:
        frames = {n: {k: v.tolist() for k, v in r.items()} for n, r in rows.items()}
        told = {n: {"beyond": found.facts()} for n, found in beyond.items()}
        means = {n: {"mean": summarise(r) | moving[n], "frames": frames[n]} | told.get(n, {}) for n, r in rows.items()}
        print(json.dumps(means))
        return 0
    _print({name: summarise(r) | moving[name] for name, r in rows.items()})
    return 0


def _print(means: dict[str, dict[str, float]]) -> None:
    """Print a table of each quantity over the motions."""
    import numpy as np

    from ncs_jax.metrics.motion import MEASURES
    from ncs_jax.metrics.quality import QUANTITIES, summarise

    if len(means) > 1:
        every = dict.fromkeys(k for m in means.values() for k in m)
        means["all"] = summarise({k: np.array([m[k] for m in means.values() if k in m]) for k in every})
    files = [split_frames(name)[0] for name in means]
    short = [file if file.startswith("ncs:") else Path(file).stem for file in files]
    labels = [label + name.removeprefix(file) for label, name, file in zip(short, means, files, strict=True)]
    width = max(map(len, labels)) + 2
    for quantity in dict.fromkeys(k for m in means.values() for k in m):
        unit, text = (QUANTITIES | MEASURES).get(quantity, ("J", "energy"))
        print(f"{quantity} [{unit}], {text}" if unit else f"{quantity}, {text}")
        for name, m in zip(labels, means.values(), strict=True):
            if quantity in m:
                print(f"  {name:{width}} {m[quantity]:.4g}")

"""What the command line tells of an animation, of a scene and of a garment on a body."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.scene import Scene, load_scene

if TYPE_CHECKING:
    from ncs_jax.model import Model
    from ncs_jax.motion import Track

__all__ = ["animation_over", "check", "evaluate", "fit", "motions_of"]


def motions_of(scene: Scene) -> tuple[str, ...]:
    """All of a scene's motions, those to train on first."""
    return (*scene.motion.files, *scene.motion.validation)


def animation_over(file: str | Path, model: Model, track: Track) -> np.ndarray:
    """An animation of the model's garment over a motion from a file, (frames, verts, 3) float32 in m.

    Raises:
        InputError: it has other frames or vertices.
    """
    vertices = np.asarray(io.read_animation(file).vertices, np.float32)
    expected = (track.start.shape[0], *model.garment.mesh.rest.shape)
    if vertices.shape != expected:
        raise InputError(
            f"frames, vertices and 3 of the motion expected, {expected}", file=file, field="vertices", value=vertices.shape,
            mend="give the --motion and --scene that it was made from",
        )  # fmt: skip
    return vertices


def evaluate(options) -> int:
    """`ncs evaluate`: how an animation does and how it moves, in physical units."""
    from ncs_jax.assembly import assemble
    from ncs_jax.dynamics import MEASURES, compare, dynamics
    from ncs_jax.evaluation import QUANTITIES, measure, summarise
    from ncs_jax.runs import Run, load_run

    target = Path(options.target)
    if not target.exists():
        raise InputError("no such run folder or animation", file=target, mend="check the path")
    rows, moving = {}, {}

    def look(run, name, track, vertices):
        model = run.assembly.model
        rows[name], moving[name] = measure(model, vertices, track), dynamics(model, vertices, track)
        if options.reference is None:
            return
        reference = animation_over(options.reference, model, track)
        moving[name] |= compare(model, vertices, reference, track)

    if target.is_dir() and not options.scene:
        run = load_run(target)
        names = (options.motion,) if options.motion else tuple(dict.fromkeys(motions_of(run.assembly.scene)))
        if options.reference is not None and len(names) > 1:
            raise InputError("one motion is needed beside --reference", field="--motion", mend="give the one it was made from")
        for name in names:
            track = run.track(name)
            look(run, name, track, run.animate(track, options.alpha))
            if options.alpha != 0 and run.assembly.network.controlled:
                still = dynamics(run.assembly.model, run.animate(track, 0.0), track)["speed"]
                moving[name]["gain"] = moving[name]["speed"] / still if still > 0 else float("nan")
    else:
        if not options.scene:
            raise InputError("the scene of the animation is needed", file=target, field="--scene", mend="add --scene SCENE")
        scene = load_scene(options.scene)
        names = (options.motion,) if options.motion else motions_of(scene)
        if not names:
            raise InputError("a motion is needed", field="--motion", mend="give the motion of the animation")
        run = Run(assemble(scene.without_network()), {})
        track = run.track(names[0])
        look(run, names[0], track, animation_over(target, run.assembly.model, track))
    if options.json:
        frames = {n: {k: v.tolist() for k, v in r.items()} for n, r in rows.items()}
        print(json.dumps({n: {"mean": summarise(r) | moving[n], "frames": frames[n]} for n, r in rows.items()}))
        return 0
    means = {name: summarise(r) | moving[name] for name, r in rows.items()}
    if len(means) > 1:
        every = dict.fromkeys(k for m in means.values() for k in m)
        means["all"] = summarise({k: np.array([m[k] for m in means.values() if k in m]) for k in every})
    labels = [name if name.startswith("ncs:") else Path(name).stem for name in means]
    width = max(map(len, labels)) + 2
    for quantity in dict.fromkeys(k for m in means.values() for k in m):
        unit, text = (QUANTITIES | MEASURES).get(quantity, ("J", "energy"))
        print(f"{quantity} [{unit}], {text}" if unit else f"{quantity}, {text}")
        for name, m in zip(labels, means.values(), strict=True):
            if quantity in m:
                print(f"  {name:{width}} {m[quantity]:.4g}")
    return 0


def check(options) -> int:
    """`ncs check`: what is in a scene, and what is at risk."""
    from ncs_jax.assembly import assemble
    from ncs_jax.grading import findings
    from ncs_jax.io.surface import anatomy
    from ncs_jax.scene import template

    if options.fields:
        print(template(), end="")
        return 0
    if options.scene is None:
        raise InputError("a scene file is needed", mend="give one, ncs:tshirt for the packaged one, or --fields")
    assembly = assemble(load_scene(options.scene))
    model, mesh = assembly.model, assembly.model.garment.mesh
    names = assembly.body.joint_names if assembly.body is not None else ()
    joints = [names[model.source_joints[j]] if names else str(model.source_joints[j]) for j in model.inputs]
    terms = model.terms
    on = [n for n in ("membrane", "bending", "collision", "gravity", "inertia", "pinning") if getattr(terms, n)]
    print(f"{options.scene}: good")
    mass = float((mesh.vertex_area * model.material.density).sum())
    size = f"{float(mesh.face_area.sum()):.3f} m^2, {mass:.3f} kg, edges {1000 * float(mesh.edge_length.mean()):.1f} mm"
    print(f"  garment   {mesh.rest.shape[0]} vertices, {mesh.faces.shape[0]} triangles, {size}")
    record = assembly.garment
    parts = anatomy(record.vertices, record.faces)
    print(f"  surface   connected components {parts.components}, boundary loops (holes) {parts.loops}, ", end="")
    print(f"degenerate triangles {parts.degenerate}")
    kept = f"{record.welded} vertices welded to others" if record.welded else "vertices in the file's number and order"
    print(f"  file      {record.scale:g} m a unit, {record.up.upper()} up; {kept}")
    if model.body is not None:
        print(f"  body      {len(assembly.body.vertices)} vertices, of which {model.body.shape[0]} can be touched")
    for name, layer in zip(assembly.scene.garment.over, model.under, strict=False):
        print(f"  over      {name}: {len(layer.rest)} vertices")
    print(f"  joints    {', '.join(joints)}")
    print(f"  energies  {', '.join(on)}" + (f" ({terms.membrane})" if terms.membrane else ""))
    scene = assembly.scene
    for kind, names in (("train", scene.motion.files), ("validate", scene.motion.validation)):
        for name in names:
            print(f"  {kind:9} {name}: {len(assembly.motions[name].poses)} frames at {model.fps:g} per second")
            for note in assembly.motions[name].notes:
                print(textwrap.fill(note, 128, initial_indent=12 * " ", subsequent_indent=14 * " "))
    if not model.moves:
        print("  the character never moves: only the static network is trained")
    found = findings(assembly)
    for finding in found:
        print(f"  at risk   {finding.what}: {finding.value}: {finding.risk}; {finding.mend}")
    if not found:
        print("  safe      material, mesh, fit and motions are inside the ranges of the stability map")
    return 0


def fit(options) -> int:
    """`ncs fit`: a garment on a body, written with a picture, and what was done to it."""
    from ncs_jax.fit import PINS
    from ncs_jax.fit import fit as fitted
    from ncs_jax.io.surface import anatomy, boundary_loops
    from ncs_jax.pictures import contact_sheet

    out, scene = Path(options.out), Scene()
    if out.suffix.lower() != ".npz":
        raise InputError("a name that ends in .npz expected", field="--out", value=options.out, mend="it also holds weights")
    body = io.read_body(scene.path(options.body))
    given = io.read_garment(scene.path(options.garment), scale=options.scale, up=options.up, weld=options.weld)
    asked = {name: value for name, value in (("scale", options.scale), ("up", options.up)) if value}
    found = fitted(options.garment, given, body, clearance=options.clearance, **asked)
    g, (before, after) = found.garment, found.depth
    x, parts = g.vertices, anatomy(g.vertices, g.faces)
    way = ", ".join(f"{v:.3f}" for v in found.moved)
    pushed = 1000 * np.linalg.norm(x - found.before, axis=1)
    print(f"{options.garment} on {options.body}: {len(x)} vertices, {len(g.faces)} triangles")
    print(
        f"  placed    {g.scale:g} m a unit, {g.up.upper()} up; "
        + (f"moved by ({way}) m" if found.moved.any() else "where it is")
    )
    print(f"  body      {(before > 0).sum()} vertices were inside, up to {1000 * max(before.max(), 0):.1f} mm; ", end="")
    print(f"{(pushed > 0.01).sum()} moved, by {pushed.max():.1f} mm at most; {(after > 0).sum()} inside now")
    print(f"  clearance {-1000 * after.max():.1f} mm at least, {-1000 * after.mean():.1f} mm mean")
    print(f"  surface   connected components {parts.components}, degenerate triangles {parts.degenerate}")
    for loop in sorted(boundary_loops(g.faces), key=lambda loop: -x[loop, 1].mean()):
        long = np.linalg.norm(x[loop] - np.roll(x[loop], 1, axis=0), axis=1).sum()
        print(f"  hole      {len(loop)} edges, {100 * long:.0f} cm around, at a height of {x[loop, 1].mean():.2f} m")
    if PINS in given.groups:
        print(f"  pins      {len(g.groups[PINS])} vertices, its own")
    elif PINS in g.groups:
        print(f"  pins      {len(g.groups[PINS])} vertices around its highest hole: nothing else carries it")
    else:
        print(f"  pins      none: {1e4 * found.carried:.0f} cm^2 lie on what faces up")
    spread = f"of the body where it lies on it, {100 * found.lying:.0f} % of the vertices, and spread from there"
    print("  weights   " + ("its own" if given.weights is not None else spread))
    io.write_garment(out, g)
    picture, sides = out.with_suffix(".png"), np.repeat(body.vertices[None], 2, axis=0)
    labels = ("placed", "out of the body")
    contact_sheet(picture, np.stack([found.before, x]), g.faces, sides, body.faces, 1.0, frames=2, labels=labels)
    print(f"wrote {out} and {picture}. In the scene file:\n\n[body]\nfile = {json.dumps(options.body)}\n")
    print(f"[garment]\nfile = {json.dumps(out.name)}" + (f'\npins = "{PINS}"' if PINS in g.groups else ""))
    return 0

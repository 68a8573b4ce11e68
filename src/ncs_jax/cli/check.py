"""`ncs check`: print what is in a scene, and what is at risk."""

from __future__ import annotations

import textwrap

from ncs_jax.cli import arguments
from ncs_jax.errors import InputError
from ncs_jax.scene.spec import load_scene

__all__ = ["add_commands", "check"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(commands, "check", check, "read and assemble a scene without training it")
    parser.add_argument("scene", metavar="SCENE", nargs="?", help="scene file (TOML), or ncs:NAME")
    parser.add_argument("--fields", action="store_true", help="print a scene file with every field, its default and its range")


def check(options) -> int:
    """Print what is in a scene, and what is at risk."""
    from ncs_jax.energies.terms import NAMES
    from ncs_jax.prepare.garment_checks import summarise_surface
    from ncs_jax.prepare.scene_checks import find_risks
    from ncs_jax.runs.run import assemble
    from ncs_jax.scene.spec import template

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
    on = [name for name in NAMES if getattr(terms, name, None)] + [term.__name__ for term in terms.own]
    print(f"{options.scene}: good")
    mass = float((mesh.vertex_area * model.material.density).sum())
    size = f"{float(mesh.face_area.sum()):.3f} m^2, {mass:.3f} kg, edges {1000 * float(mesh.edge_length.mean()):.1f} mm"
    print(f"  garment   {mesh.rest.shape[0]} vertices, {mesh.faces.shape[0]} triangles, {size}")
    record = assembly.garment
    parts = summarise_surface(record.vertices, record.faces)
    print(f"  surface   connected components {parts.components}, boundary loops (holes) {parts.loops}, ", end="")
    print(f"degenerate triangles {parts.degenerate}")
    kept = f"{record.welded} vertices welded to others" if record.welded else "vertices in the file's number and order"
    print(f"  file      {record.scale:g} m a unit, {record.up.upper()} up; {kept}")
    if assembly.body is not None and model.body is not None:
        print(f"  body      {len(assembly.body.vertices)} vertices, of which {model.body.shape[0]} can be touched")
    for name, layer in zip(assembly.scene.garment.over, model.under, strict=False):
        print(f"  over      {name}: {len(layer.rest)} vertices")
    print(f"  joints    {', '.join(joints)}")
    if len(model.garment.pins):
        print(f"  pins      {len(model.garment.pins)} vertices of the group {assembly.scene.garment.pins}")
    print(f"  energies  {', '.join(on)}" + (f" ({terms.membrane})" if terms.membrane else ""))
    scene = assembly.scene
    for kind, names in (("train", scene.motion.files), ("validate", scene.motion.validation)):
        for name in names:
            print(f"  {kind:9} {name}: {len(assembly.motions[name].poses)} frames at {model.fps:g} per second")
            for note in assembly.motions[name].notes:
                print(textwrap.fill(note, 128, initial_indent=12 * " ", subsequent_indent=14 * " "))
    if not model.moves:
        print("  the character never moves: only the static network is trained")
    risks = find_risks(assembly)
    for risk in risks:
        print(f"  at risk   {risk.what}: {risk.value}: {risk.risk}; {risk.mend}")
    if not risks:
        print("  safe      material, mesh, fit and motions are inside the ranges of the stability map")
    return 0

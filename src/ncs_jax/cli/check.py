"""`ncs check`: print what puts a scene at risk, then what is in it, and draw its motions."""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ncs_jax.cli import arguments
from ncs_jax.errors import InputError
from ncs_jax.scene.spec import load_scene, template

if TYPE_CHECKING:
    from ncs_jax.io import MotionRecord
    from ncs_jax.metrics.coverage import Coverage
    from ncs_jax.metrics.seen import SkinShown
    from ncs_jax.prepare.build import Assembly
    from ncs_jax.prepare.scene_checks import Risk
    from ncs_jax.prepare.setting import Setting

__all__ = ["add_commands", "check", "tell", "tell_beyond", "tell_risk", "tell_skin"]

DRAWN = 4  # motions in the picture, at most
NAMED = 6  # motions of a group that are named, at most
SHOWN = 3  # risks of a kind that are printed, of more than so many
LISTED = 20  # motions that have a line each; of more, groups of motions do


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(commands, "check", check, "read and assemble a scene without training it, and draw its motions")
    parser.add_argument("scene", metavar="SCENE", nargs="?", help="scene file (TOML), or ncs:NAME")
    parser.add_argument("--out", metavar="FILE", default="check.png", help="picture of the motions (default: check.png)")
    parser.add_argument("--fields", action="store_true", help="print a scene file with every field, its default and its range")


def check(options) -> int:
    """Print what puts a scene at risk and what is in it, and draw its motions."""
    if options.fields:
        print(template(), end="")
        return 0
    if options.scene is None:
        raise InputError("a scene file is needed", mend="give one, ncs:tshirt for the packaged one, or --fields")
    if Path(options.out).suffix.lower() not in ("", ".png"):
        raise InputError("a name that ends in .png expected", field="--out", value=options.out, mend="pictures are PNG")
    scene = load_scene(options.scene)  # before JAX is imported, which takes a second
    arguments.check_motions(scene)

    from ncs_jax.prepare.scene_checks import find_risks
    from ncs_jax.prepare.setting import set_up

    below = []
    if scene.garment.over:
        from ncs_jax.runs.run import worn_below

        below = worn_below(scene)
    setting = set_up(scene, below=below, report=_say)
    _say("looking for risks")
    risks = find_risks(setting, _say)
    groups = _alike(setting.motions)
    drawn = _draw(options.out, setting, _worst_first(groups, setting, risks))
    print(f"at risk: {len(risks)} in {options.scene}" if risks else f"{options.scene}: good")
    _tell_risks(risks, Path(options.out).with_suffix(".risks.txt"))
    for note in scene.motion.found:
        tell("found", note)
    if not risks:
        tell("safe", "material, mesh, fit and motions are inside the ranges of the stability map")
    _tell_scene(setting, automatic=scene.network.cell == "auto")
    _tell_motions(setting, groups)
    if drawn:
        tell("picture", drawn)
    return 0


def _say(words: str) -> None:
    """Print what is done next, where it does not mix with the results."""
    print(f"{words} ...", file=sys.stderr, flush=True)


def _tell_risks(risks: Sequence[Risk], file: Path) -> None:
    """Print risks; where many motions have one of a kind, some of these, and where all of them were written."""
    kinds: dict[str, list[Risk]] = {}
    for risk in risks:
        kinds.setdefault(risk.risk if risk.motion else "", []).append(risk)
    shortened = False
    for kind, alike in kinds.items():
        few = alike if not kind or len(alike) <= NAMED else alike[:SHOWN]
        for risk in few:
            tell_risk(risk)
        if len(few) < len(alike):
            shortened = True
            tell("", f"and {len(alike) - len(few)} more of this kind, in {len({risk.motion for risk in alike})} motions")
    if shortened:
        lines = [f"{risk.motion or '-'}\t{_words(risk)}" for risk in risks]
        try:
            file.write_text("motion\trisk\n" + "\n".join(lines) + "\n", encoding="utf-8")
            tell("list", f"{file}: all {len(risks)} risks, a line each")
        except OSError as error:  # as of the picture
            tell("list", f"none: {type(error).__name__} {error}")


def _words(risk: Risk) -> str:
    return f"{risk.what}: {risk.value}: {risk.risk}; {risk.mend}"


def tell_risk(risk: Risk) -> None:
    """Print a risk."""
    tell("at risk", _words(risk))


def tell_beyond(found: Coverage | None) -> None:
    """Print that a motion is beyond what a run was trained on, where it is, or that frames of it are."""
    if found is not None and (found.told or found.outside.any()):
        tell("beyond" if found.told else "coverage", str(found))


def tell_skin(found: SkinShown, assembly: Assembly) -> None:
    """Print in how many frames skin shows, where most, and what mends it, if it does."""
    if not found.shown:
        return
    body, part, thickness = assembly.body, assembly.prepared.part, assembly.scene.physics.collision.thickness
    place = " by the garment below" if found.vertex >= len(part) else ""
    if body is not None and body.joint_names and not place:
        place = f" by {body.joint_names[int(body.weights[part[found.vertex]].argmax())]}"
    frames = f"in {found.shown} of {found.looked} frames that were looked at, most in frame {found.frame}{place}"
    mend = f"--adapt 20 of ncs animate, more training, or physics.collision.thickness above {1000 * thickness:g} mm"
    tell("skin", f"shows {frames}: {found.pixels} pixels of six views; see ncs animate --frames {found.frame}; {mend}")


def tell(label: str, text: str) -> None:
    """Print a line under a label, wrapped."""
    print(textwrap.fill(text, 128, initial_indent=f"  {label:10}", subsequent_indent=14 * " ", break_on_hyphens=False))


def _tell_scene(setting: Setting, *, automatic: bool) -> None:
    """Print what the garment, the body and the physics are, and the network's cell, which may be chosen by itself."""
    import numpy as np

    from ncs_jax.energies.terms import NAMES
    from ncs_jax.prepare.garment_checks import summarise_surface
    from ncs_jax.prepare.joint_names import listed

    model, mesh = setting.model, setting.model.garment.mesh
    names = setting.body.joint_names if setting.body is not None else ()
    joints = [names[model.source_joints[j]] if names else str(model.source_joints[j]) for j in model.inputs]
    terms = model.terms
    on = [name for name in NAMES if getattr(terms, name, None)] + [term.__name__ for term in terms.own]
    area, edges = np.asarray(mesh.face_area, np.float64).sum(), np.asarray(mesh.edge_length, np.float64)  # no program for a sum
    size = f"{area:.3f} m^2, {area * float(model.material.density):.3f} kg, edges {1000 * edges.mean():.1f} mm"
    tell("garment", f"{mesh.rest.shape[0]} vertices, {mesh.faces.shape[0]} triangles, {size}")
    record = setting.garment
    parts = summarise_surface(record.vertices, record.faces)
    holes = [opening for opening in parts.openings if opening.small]
    counts = f"connected components {parts.components}, openings {len(parts.openings) - len(holes)}"
    tell("surface", f"{counts}, small holes {len(holes)}, degenerate triangles {parts.degenerate}")
    if holes:
        more = f" and {len(holes) - 3} more" if len(holes) > 3 else ""
        tell("holes", "; ".join(map(str, holes[:3])) + more + ": meant?")
    kept = f"{record.welded} vertices welded to others" if record.welded else "vertices in the file's number and order"
    tell("file", f"{record.scale:g} m a unit, {record.up.upper()} up; {kept}")
    if setting.body is not None and model.body is not None:
        tell("body", f"{len(setting.body.vertices)} vertices, of which {model.body.shape[0]} can be touched")
    if setting.prepared.betas.size:
        tell("shape", f"betas {', '.join(f'{b:.3g}' for b in setting.prepared.betas)}")
    for note in (*(() if setting.body is None else setting.body.notes), *record.notes):
        tell("note", note)
    for name, first, stop in zip(
        setting.scene.garment.layers, record.layers, (*record.layers[1:], len(record.vertices)), strict=False
    ):
        tell("layer", f"{name}: {stop - first} vertices, from {first} on")
    for name, layer in zip(setting.scene.garment.over, model.under, strict=False):
        tell("over", f"{name}: {len(layer.rest)} vertices")
    moving = setting.body is not None and setting.body.frames is not None  # of which no network reads joints
    if not moving:
        tell("joints", listed(joints, {name: name for name in joints}))
    if len(model.garment.pins):
        tell("pins", f"{len(model.garment.pins)} vertices of the group {setting.scene.garment.pins}")
    tell("energies", ", ".join(on) + (f" ({terms.membrane})" if terms.membrane else ""))
    if moving:
        return
    network = setting.scene.network
    swings = network.method == "ncs" and network.cell == "swing" and terms.inertia
    if past := [name for name in ("inertia", "friction") if name in on and (swings or network.method == "pbns")]:
        hold = ": the swing itself has inertia, and hold ties the cloth to it" if swings else ": it trains on poses alone"
        tell("", f"training and log.csv have {'hold' if swings else 'nothing'} in the place of {' and '.join(past)}{hold}")
    if setting.scene.network.method == "ncs" and terms.inertia:
        tell("cell", setting.scene.network.cell + (" (auto)" if automatic else ""))


def _alike(motions: dict[str, MotionRecord]) -> list[list[str]]:
    """Return the motions' names in groups that match the body alike: of one skeleton, with notes equal but for numbers."""
    groups: dict[tuple, list[str]] = {}
    for name, record in motions.items():
        notes = [re.sub(r"\d+(?:\.\d+)?", "#", note) for note in record.notes]
        groups.setdefault((record.source and record.source.joint_names, *notes), []).append(name)
    return list(groups.values())


def _tell_motions(setting: Setting, groups: Sequence[Sequence[str]]) -> None:
    """Print the motions and how they drive the body; what several have in common is printed once, after them.

    Of many motions it is how many they are, and of the kinds that drive the body unlike, the largest.
    """
    scene, motions, fps = setting.scene, setting.motions, setting.model.fps
    many = len(motions) > LISTED
    told = {name for group in groups if len(group) > 1 for name in group}
    for kind, names in (("train", scene.motion.files), ("validate", scene.motion.validation)):
        if len(names) > LISTED:
            frames = [len(motions[name].poses) for name in names]
            length = f"{sum(frames)} frames at {fps:g} per second, {sum(frames) / fps / 60:.3g} minutes"
            tell(kind, f"{len(names)} motions: {length}; {min(frames)} to {max(frames)} frames each")
            continue
        for name in names:
            tell(kind, f"{name}: {len(motions[name].poses)} frames at {fps:g} per second")
            for note in () if name in told else motions[name].notes:
                tell("", note)
            told.add(name)
    noted = [group for group in groups if motions[group[0]].notes and (many or len(group) > 1)]
    if many and len(noted) > NAMED:
        noted = sorted(noted, key=len, reverse=True)
        tell("", f"they drive the body in {len(noted)} ways, of which the {NAMED} that most have follow")
        noted = noted[:NAMED]
    for group in noted:
        more = f" and {len(group) - NAMED} more" if len(group) > NAMED else ""
        tell("alike", f"{len(group)} motion{'s' * (len(group) > 1)}: {', '.join(group[:NAMED])}{more}")
        shared = [note for note in motions[group[0]].notes if all(note in motions[name].notes for name in group)]
        for note in shared:
            tell("", note)
        for name in group[:1] if many else group:
            for note in motions[name].notes:
                if note not in shared:
                    tell("", f"{name}: {note}")
    if not setting.model.moves:
        print("  the character never moves: only the static network is trained")


def _worst_first(groups: Sequence[Sequence[str]], setting: Setting, risks: Sequence[Risk]) -> list[list[str]]:
    """Return groups of motions, and the names in each, those that a risk names first, then those that move most."""
    risky = {risk.motion for risk in risks} | {name for name, record in setting.motions.items() if record.uncertain}

    def order(name: str) -> tuple[bool, float]:
        poses = setting.motions[name].poses
        return name not in risky, -float((poses.max(axis=0) - poses.min(axis=0)).sum())

    return sorted((sorted(group, key=order) for group in groups), key=lambda group: order(group[0])[0])


def _draw_frames(out: str, setting: Setting) -> None:
    """Draw some frames of a body that is a moving mesh, with the garment as that alone carries it."""
    import numpy as np

    from ncs_jax.io.records import shown_frames
    from ncs_jax.prepare.posing import skinned
    from ncs_jax.view.animation import Animation, PosedBody
    from ncs_jax.view.heading import up_of
    from ncs_jax.view.pictures import contact_sheet

    body, garment = setting.body, setting.garment
    if body is None or body.frames is None or body.carriers is None:
        return
    some = shown_frames(len(body.frames))
    cloth = np.array([skinned(garment.vertices, setting.prepared.weights, each) for each in body.carriers[some]])
    up, times = up_of(setting.scene.physics.gravity), tuple(f"{k / body.fps:.2f} s" for k in some)
    worn_on = PosedBody(body.frames[some], body.faces)
    contact_sheet(out, Animation(cloth, garment.faces, body.fps, worn_on, up), frames=len(some), labels=times)


def _draw(out: str, setting: Setting, groups: Sequence[Sequence[str]]) -> str:
    """Draw one motion of each group; return what the picture shows, nothing where there is none to draw."""
    moving = setting.body is not None and setting.body.frames is not None
    if setting.body is None or not (groups or moving):
        return ""
    _say("drawing the motions")
    try:
        if moving:
            _draw_frames(out, setting)
            return f"{out}: the mesh in some frames, and the garment as that alone carries it"
        from ncs_jax.view.motion_sheet import motion_sheet

        chosen = {name if len(group) == 1 else f"{name}  (and {len(group) - 1} alike)": setting.motions[name]
                  for group in groups[:DRAWN] for name in group[:1]}  # fmt: skip
        motion_sheet(out, setting, chosen)
    except Exception as error:  # a check is worth as much without its picture
        return f"none: {error if isinstance(error, InputError) else f'{type(error).__name__} {error}'}"
    left = f"; {len(groups) - DRAWN} other kinds of motion are not drawn" if len(groups) > DRAWN else ""
    return f"{out}: each motion on the character, and below as it was recorded: both must do the same{left}"

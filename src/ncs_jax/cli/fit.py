"""`ncs fit`: bring a garment onto a body, and draw it there."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ncs_jax.cli import arguments
from ncs_jax.errors import InputError
from ncs_jax.scene.spec import Scene

if TYPE_CHECKING:
    import numpy as np

__all__ = ["add_commands", "fit"]

MOTIONS = (
    *("stand", "walk", "walk_turn_stop", "jump", "twist", "lift_arms", "dance"),
    *(f"cmu_{name}" for name in ("walk", "walk_fast", "run", "dance", "spin", "turn", "ball", "stand")),
)
FOUND = ("body.", "garment.", "physics.collision.", "physics.bending.")  # what fitting finds out, in a scene
HOLES = 10  # so many small ones are listed
TIGHT = 5.0  # %; a garment that is strained more by coming out of a body was not made for it
LIMBS = {"left arm", "right arm", "left thigh", "right thigh"}  # whose joints the packaged motions must find


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(
        commands, "fit", fit, "bring a garment onto a body, and write it as a file to train with, a scene and a picture"
    )
    parser.add_argument("garment", metavar="GARMENT", help="mesh file: .npz, .obj, .ply, .stl, .glb, .vrm, .fbx, .usd*")
    arguments.add_body(parser)
    parser.add_argument(
        "--from", dest="source", metavar="BODY", help="body that it was made for, if another: it is carried over from there"
    )
    parser.add_argument("--mesh", nargs="+", default=[], metavar="NAME", help="meshes of the file that are the garment")
    parser.add_argument(
        "--out", required=True, metavar="FILE", help=".npz; beside it a picture, .png, and a scene, .toml, if there is none yet"
    )
    parser.add_argument(
        "--scale",
        type=partial(arguments.positive, of="metres a unit"),
        default=0.0,
        help="metres a unit of the file (default: found)",
    )
    parser.add_argument(
        "--up", choices=("x", "y", "z", "-x", "-y", "-z"), default="", help="the axis that is up in the file (default: found)"
    )
    parser.add_argument(
        "--turn",
        type=partial(arguments.whole, least=0),
        choices=(0, 90, 180, 270),
        help="degrees to turn it about the vertical then (default: found)",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--stay", action="store_true", help="do not move it, whatever speaks for another place")
    where.add_argument(
        "--move",
        type=arguments.finite,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="move it by this, metres along the body's axes, Y up, once unit and axes are found (default: found)",
    )
    parser.add_argument(
        "--pins",
        choices=("found", "shoulders", "top", "none"),
        default="found",
        help="what is held to the body, lest it slide off: what lies over shoulders, the band of the highest opening, nothing, "
        "or what is found to need it (default)",
    )
    parser.add_argument(
        "--weld", type=partial(arguments.positive, of="metres"), default=0.0, metavar="M", help="merge vertices within M metres"
    )
    parser.add_argument(
        "--clearance",
        type=partial(arguments.positive, of="metres"),
        metavar="M",
        help="distance to keep from the body, metres (default: found, so that no skin shows between vertices)",
    )


def fit(options) -> int:
    """Fit a garment to a body, write it with a picture and a scene, and print what was done to it."""
    for name in filter(None, (options.garment, options.body, options.source)):
        arguments.check_file(name)
    from ncs_jax import io
    from ncs_jax.io.tables.files import check_place
    from ncs_jax.prepare.fit import check_length, settle

    for name in ("clearance", "weld"):
        check_length(f"--{name}", getattr(options, name))
    out = Path(options.out)
    if out.suffix.lower() != ".npz":
        raise InputError(
            "a name that ends in .npz expected", field="--out", value=options.out, mend="no other format here holds weights"
        )
    if check_place(out).is_dir():
        raise InputError("a file expected", field="--out", value=options.out, mend="give another name")
    arguments.check_not_read(options.out, options.garment, options.body, *filter(None, [options.source]))
    body = arguments.body_of(options)
    source = io.read_body(options.source) if options.source else body
    given, placement = _placed(options, source, options.scale)
    if options.weld and placement.scale != given.scale:  # it was read before it was known how far a metre is
        given, placement = _placed(options, source, placement.scale)
    print(
        f"{options.garment} on {options.source or options.body}: {len(given.vertices)} vertices, {len(given.faces)} triangles"
    )
    for note in given.notes:
        print(f"  note      {note}")
    _say_doubled(given, placement.scale / given.scale)
    _say_where(placement)
    picture = out.with_suffix(".png")
    if options.source:
        placement = _carried(options, picture, placement, source, body)
        given = placement.garment
    with _drawn(picture, body, placement):
        found = settle(options.garment, placement, body, clearance=options.clearance, pins=options.pins)
    _say_what(found, given, options.pins)
    io.write_garment(out, found.garment)
    label = "carried over" if options.source else "placed"
    _draw(picture, body, given.faces, {label: placement.garment.vertices, "out of the body": found.garment.vertices})
    text = _scene(options, out, found, body)
    print(f"wrote {out} and {picture}")
    file = out.with_suffix(".toml")
    if file.exists():
        _say_kept(file, text)
    else:
        file.write_text(text)
        name, run = shlex.quote(str(file)), shlex.quote(f"runs/{out.stem}")
        use, after = "train", f"ncs train {name} --out {run} --preview"
        if body.frames is not None:
            use, after = "simulate", f"ncs simulate {name} --out {shlex.quote(out.stem)}.glb --body"
        first = "name its motions there, then " if "files = []" in text else ""
        print(f"wrote {file}, a scene to {use}:\n\n{text}\nnext: {first}ncs check {name}, then {after}")
    return 0


def _say_kept(file: Path, text: str) -> None:
    """Print that a scene file is left as it is, and where it differs from the scene that would have been written."""
    import tomllib

    try:
        there, here = (_values(tomllib.loads(scene)) for scene in (file.read_text(), text))
    except (OSError, ValueError):  # not to be read: the scene stands below it
        print(f"kept {file}, which is there. A scene for this garment:\n\n{text}", end="")
        return
    about = [key for key in {**here, **there} if key.startswith(FOUND) and here.get(key) != there.get(key)]
    print(f"kept {file}, which is there{', and says the same' if not about else '. Of what was found it differs in:'}")
    for key in about:
        print(f"  {key:29} {there.get(key, 'unsaid')}, found now: {here.get(key, 'nothing to say')}")
    if about:
        print("mend: change these there, or delete it and fit again")


def _values(tables: dict, above: str = "") -> dict[str, str]:
    """Return the values of nested tables as a file says them, by `table.field`."""
    found: dict[str, str] = {}
    for key, value in tables.items():
        name = f"{above}{key}"
        found |= _values(value, f"{name}.") if isinstance(value, dict) else {name: json.dumps(value, default=str)}
    return found


def _placed(options, body, scale: float):
    """Return the garment as read, in so many metres a unit (0: as the file says), and its place on the body."""
    from ncs_jax import io
    from ncs_jax.prepare.garment_placement import place
    from ncs_jax.prepare.skinning_weights import with_body_weights

    with arguments.as_options():
        given = io.read_garment(
            Scene().path(options.garment), scale=scale, up=options.up.removeprefix("-"), weld=options.weld, mesh=options.mesh,
            turn_faces=True,
        )  # fmt: skip
    if len(given.faces) == len(body.faces):
        raise InputError(
            "a garment expected", file=options.garment, value=f"{len(given.faces)} triangles, as many as the body has",
            mend="this is the body itself; name the garment's file, or the garment in it with --mesh",
        )  # fmt: skip
    given = with_body_weights(given, body)
    move = (0.0, 0.0, 0.0) if options.stay else options.move
    known = {"scale": scale or None, "up": options.up or None, "turn": options.turn}
    return given, place(options.garment, given, body, move=move, **known)


@contextmanager
def _drawn(picture: Path, body, placement) -> Iterator[None]:
    """Draw a garment on the body at its place where what follows refuses it; the picture of one that was written stays."""
    try:
        yield
    except InputError:
        if picture.with_suffix(".npz").exists():
            picture = picture.with_stem(f"{picture.stem}_refused")
        _draw(picture, body, placement.garment.faces, {"refused": placement.garment.vertices})
        print(f"wrote {picture}: " + ("the place that was given" if placement.given else "the best place that was found"))
        raise


def _carried(options, picture: Path, placement, source, body):
    """Return the garment's place on the body, to which it is carried over from the source, and print what that did to it."""
    import numpy as np

    from ncs_jax.prepare.carry_over import carry_over
    from ncs_jax.prepare.garment_placement import place

    with _drawn(picture, source, placement):
        placement.check(options.garment)
    found = carry_over(placement.garment, source, body, options.source)
    after = place(options.garment, found.garment, body, scale=1.0, up="y", turn=0, move=(0.0, 0.0, 0.0))
    middle, high = (100 * float(np.percentile(found.strain, share)) for share in (50, 95))
    print(f"carried over to {options.body}: {found.size:.2f} times as large")
    print(f"  strain    of its edges besides: {middle:.0f} % median, {high:.0f} % for 95 of 100")
    _say_lying(after)
    with _drawn(picture, body, after):
        found.check(options.garment, placement, after)
    return after


def _say_doubled(given, unit: float) -> None:
    """Print how many vertices of a garment as read, in metres a unit, lie at another's place, and what joins them."""
    from ncs_jax.prepare.garment_checks import TOGETHER, doubled

    if count := doubled(unit * given.vertices.astype(float), given.faces):
        print(f"  doubled   {count} vertices lie where another one is and share no edge with it: cloth comes apart there;")
        print(f"            --weld {TOGETHER:g} joins them")


def _say_where(placement) -> None:
    """Print unit, axes and place, and how much of the garment lies on the body there."""
    moved = "not moved"
    if placement.shift.any():
        moved = "moved by ({:.3f}, {:.3f}, {:.3f}) m".format(*placement.shift)
    turned = f", turned by {placement.turn} degrees" if placement.turn else ""
    print(f"  placed    {placement.scale:g} m a unit, {placement.up.upper()} up{turned}; {moved}")
    _say_lying(placement)
    if placement.warning:
        print(f"  unsure    {placement.warning}. Look at the picture; --move if it is wrong")
    if placement.turn and not placement.doubt:
        print("  turned    if it is alike from front and back, --turn 0 leaves it as it is in the file")
    if placement.mirrored:
        print("  mirrored  left and right were exchanged: its faces looked inward, as left-handed axes make them. If only the")
        print("            faces are wrong, turn them around in the modeller first")


def _say_lying(placement) -> None:
    """Print how much of a garment lies on the body."""
    print(
        f"  lies      {100 * placement.lying:.0f} % on the skin, {100 * placement.inside:.0f} % inside the body; "
        f"the body passes through {100 * placement.threaded:.0f} % of its openings"
    )


def _say_what(found, given, pins: str) -> None:
    """Print what was done to the garment at its place, and what it is made of."""
    import numpy as np

    from ncs_jax.prepare.fit import PINS
    from ncs_jax.prepare.garment_checks import summarise_surface

    g, (before, after) = found.garment, found.depth
    x, parts = g.vertices, summarise_surface(g.vertices, g.faces)
    pushed = 1000 * np.linalg.norm(x - found.placement.garment.vertices, axis=1)
    print(f"  body      {(before > 0).sum()} vertices were inside, up to {1000 * max(before.max(), 0):.1f} mm; ", end="")
    print(f"cloth moved by {pushed.mean():.1f} mm, {pushed.max():.1f} at most; {(after > 0).sum()} inside now")
    if pushed.max() > 0.01:
        _say_strain(found)
    print(f"  clearance {-1000 * after.max():.1f} mm at least, {-1000 * after.mean():.1f} mm mean")
    _say_contact(found.contact)
    print(f"  surface   connected components {parts.components}, degenerate triangles {parts.degenerate}")
    small = [opening for opening in parts.openings if opening.small]
    for opening in parts.openings:
        if not opening.small:
            print(f"  opening   {opening}")
    for opening in small[:HOLES]:
        print(f"  hole      a small one, {opening}: meant?")
    if len(small) > HOLES:
        print(f"  hole      and {len(small) - HOLES} more small ones")
    if PINS in given.groups and pins == "found":
        print(f"  pins      {len(g.groups[PINS])} vertices, the file's own")
    elif PINS in g.groups:
        told = "over the shoulders, where nothing but friction keeps them" if found.straps else "around its highest opening"
        print(f"  pins      {len(g.groups[PINS])} vertices {told}")
    else:
        told = "as is said" if pins == "none" else f"{1e4 * found.carried:.0f} cm^2 lie on skin that faces up"
        print(f"  pins      none: {told}; if it slides off, --pins shoulders or --pins top")
    own = "the file's own" if given.weights is not None else "those of the skin, found when the scene is made ready"
    print(f"  weights   {own}")


def _say_strain(found) -> None:
    """Print how much the garment was strained by coming out of the body."""
    import numpy as np

    from ncs_jax.geometry.mesh import topology

    ends = topology(found.garment.faces)[0]
    before, after = (
        np.linalg.norm(np.diff(np.asarray(x, np.float64)[ends], axis=1)[:, 0], axis=1)
        for x in (found.placement.garment.vertices, found.garment.vertices)
    )
    strain = 100 * np.abs(after / np.maximum(before, 1e-12) - 1)
    mean = np.sqrt(np.mean(strain**2))
    print(f"            by that its edges are {mean:.1f} % longer or shorter (r.m.s.), {strain.max():.0f} % at most")
    if mean > TIGHT:
        print("            so it was made for a slimmer body: give that one as --from, or a larger --scale")


def _say_contact(contact) -> None:
    """Print the thickness and stiffness of the scene's collision, and why they are what they are."""
    thick, sunk, pressed, edge = (1000 * a for a in (contact.thickness, contact.sinking, contact.pressed, contact.edge))
    print(f"  contact   thickness {thick:g} mm, stiffness {contact.stiffness:g}: triangles of {edge:.0f} mm, laid on the skin,")
    print(
        f"            sink {sunk:.1f} mm into its curves, and their load presses them {pressed:.1f} mm; the rest is for motion"
    )
    if contact.thickness < contact.least:
        least = math.ceil(1000 * contact.least) / 1000
        print(f"            too thin, skin will show: give --clearance {least:g} or more, or a finer mesh")


def _draw(picture: Path, body, faces: np.ndarray, cloths: dict[str, np.ndarray]) -> None:
    """Draw a garment on the body, once for each label."""
    import numpy as np

    from ncs_jax.view.animation import Animation, PosedBody
    from ncs_jax.view.pictures import contact_sheet

    same = np.repeat(body.vertices[None], len(cloths), axis=0)
    animation = Animation(np.stack(list(cloths.values())), faces, 1.0, PosedBody(same, body.faces))
    contact_sheet(picture, animation, frames=len(cloths), labels=tuple(cloths))


def _scene(options, out: Path, found, body) -> str:
    """Return a whole scene for the fitted garment: with the packaged motions where the body's joints can be told apart."""
    from ncs_jax.prepare.fit import PINS
    from ncs_jax.prepare.garment_checks import fine_folds
    from ncs_jax.prepare.joint_names import anatomy
    from ncs_jax.prepare.retarget import body_names, called

    names = () if body.frames is not None else body_names(body)
    moved = names and anatomy(called(names, body.bones), body.parents).roles.keys() >= LIMBS
    lines = [arguments.body_table(options, out.parent), "", "[garment]", f"file = {json.dumps(out.name)}"]
    lines += [f'pins = "{PINS}"'] if PINS in found.garment.groups else []
    lines += ["", "[motion]"]
    if body.frames is not None:
        if not body.fps > 0:
            lines.insert(1, "# fps = 30  # frames per second of the body, which its file does not say: state it")
        lines += ["fps = 30  # of the physics; the body's frames are its motion"]
    elif moved:
        lines += [f"files = {json.dumps([f'ncs:{name}' for name in MOTIONS])}", 'validation = ["ncs:mixed"]', "fps = 30"]
    else:
        lines += [
            "files = []  # the names of its joints do not tell how packaged motions move them: name its own, say walk.fbx"
        ]
    contact, usual = found.contact, Scene().physics.collision
    told = [f"{n} = {getattr(contact, n):g}" for n in ("thickness", "stiffness") if getattr(contact, n) != getattr(usual, n)]
    told = [f"{told[0]}  # for edges of {1000 * contact.edge:.0f} mm, else skin shows between them", *told[1:]] if told else []
    g = found.garment
    if fine := fine_folds(g.vertices.astype(float), g.faces, -found.depth[1], Scene().physics):
        why = (
            f"# with {Scene().physics.bending.stiffness:g} its folds are finer than its triangles, and pass through each other"
        )
        lines += ["", "[physics.bending]", f"stiffness = {fine.stiffness:g}  {why}"]
    lines += ["", "[physics.collision]", *told, 'points = "auto"'] if told else []
    if body.frames is None:
        lines += ["", "[training]", "window = 15", "motion_augmentation = 0.5", "recombined = 0.3", "untangling = 0.3"]
    return "\n".join(lines) + "\n"

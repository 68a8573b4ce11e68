"""What puts a scene at risk: its material, mesh, fit and motions against ranges that are known to be safe.

The ranges are those of the stability map (`experiments/stability.py`). Inside them float32 agrees with float64 to a thousandth
and nothing fails; outside them a scene is at risk. What cannot work at all is refused when the files are read.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, astuple, dataclass, replace

import numpy as np

from ncs_jax.energies.terms import MEMBRANES
from ncs_jax.errors import required
from ncs_jax.geometry.mesh import LINE, relative_heights
from ncs_jax.geometry.surface_distance import border_of, distance_and_direction
from ncs_jax.geometry.triangle_crossings import crossing_pairs
from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.metrics.penetration import depths_on_host
from ncs_jax.prepare.covering import contact_for, least_thickness, sinking, vertex_share
from ncs_jax.prepare.garment_checks import TOGETHER, doubled, fine_folds
from ncs_jax.prepare.kept import kept
from ncs_jax.prepare.motion_import import one_by_one
from ncs_jax.prepare.posing import carried, corrected_rest, joint_transforms
from ncs_jax.prepare.posture_checks import posture_faults
from ncs_jax.prepare.reference_pose import ZERO
from ncs_jax.prepare.setting import RECURRENT, Setting
from ncs_jax.prepare.speed_checks import frame_jumps, speed_faults
from ncs_jax.prepare.touchable import touchable_faces
from ncs_jax.prepare.wearing import wearing_faults
from ncs_jax.scene.model import Model, resting_body
from ncs_jax.scene.spec import Scene

__all__ = ["RANGES", "Risk", "find_risks", "motion_risks"]

# quantity: (least, most) that is safe
RANGES = {
    "time step": (1 / 240, 1 / 5),  # s
    "time step of a recurrence": (RECURRENT, 1 / 5),
    "density": (0.01, 10.0),  # kg/m^2
    "stiffness": (1e-3, 1e4),  # times the default
    "gravity": (0.0, 100 * 9.81),  # m/s^2
    "size": (0.01, 100.0),  # m
    "distance from the start": (0.0, 1000.0),  # m from where a motion begins
    "height of a triangle": (1e-3, 1.0),  # of its longest edge
}
DEEP = 0.01  # m that vertices may be inside the body, where the body alone carries the garment,
MANY = 0.02  # and the share of the vertices that may be deeper
POSES = 8  # checked in every motion
MOST = 400  # poses that are checked in all motions together
NAMED = 6  # motions that a risk names
CUT = re.compile(r"its header says (\d+) frames, (\d+) are there and taken(.*)")  # a note of the reader of .bvh
SMALL = re.compile(r"its rotations are no larger than (\S+), and are read as degrees")  # another
FLAT = 1e-4  # m; triangles that sink by less lie on flat skin


@dataclass(frozen=True)
class Risk:
    """A quantity that puts a scene at risk: its name, its value here, what may happen, the mend; and the motion, if of one."""

    what: str
    value: str
    risk: str
    mend: str
    motion: str = ""


def _outside(name: str, value: float, shown: str, risk: str, mend: str) -> Iterator[Risk]:
    """Yield a risk where a value is outside the safe range of its quantity."""
    low, high = RANGES[name]
    if not low * (1 - 1e-6) <= value <= high * (1 + 1e-6):
        yield Risk(name, f"{shown} (safe: {low:.4g} to {high:.4g})", risk, mend)


def _material(scene: Scene) -> Iterator[Risk]:
    """Yield the risks of the time step, the density, gravity and the stiffnesses."""
    physics, default, fps = scene.physics, Scene().physics, scene.motion.fps
    rounding = "forces of very different size are added in single precision"
    yield from _outside(
        "time step", 1 / fps, f"1/{fps:g} s", "inertia's energy and the cloth's differ very much", "motion.fps from 5 to 240"
    )
    if scene.network.method == "ncs" and scene.network.cell != "swing" and physics.inertia:
        yield from _outside(
            "time step of a recurrence", 1 / fps, f"1/{fps:g} s", "errors may grow: inertia acts on the network's own past",
            'network.cell = "swing", or motion.fps up to 15; a trained network runs at any frame rate',
        )  # fmt: skip
    yield from _outside("density", physics.density, f"{physics.density:g} kg/m^2", rounding, "physics.density")
    pull = float(np.linalg.norm(physics.gravity))
    yield from _outside("gravity", pull, f"{pull:g} m/s^2", rounding, "physics.gravity")
    membrane = physics.membrane.model
    pairs = {
        f"physics.membrane.{n}": (getattr(physics.membrane, n), getattr(default.membrane, n))
        for n in (MEMBRANES[membrane][1] if membrane != "none" else ())
    }
    for term in ("bending", "collision", "pinning"):
        pairs[f"physics.{term}.stiffness"] = getattr(physics, term).stiffness, getattr(default, term).stiffness
    for field, (value, usual) in pairs.items():
        if value > 0:
            yield from _outside("stiffness", value / usual, f"{value / usual:.3g} times the default", rounding, field)


def _mesh(a: Setting) -> Iterator[Risk]:
    """Yield the risks of the garment's size and of triangles and vertices that are degenerate."""
    x, faces = np.asarray(a.garment.vertices, np.float64), np.asarray(a.garment.faces)
    size = float(np.ptp(x, axis=0).max())
    yield from _outside("size", size, f"{size:.3g} m", "thicknesses and stiffnesses are meant for metres", "scale it to metres")
    slim = relative_heights(x, faces)
    clean = "clean the mesh where it was made"
    flat = int((slim <= LINE).sum())
    if flat:
        yield Risk("triangles of no area", str(flat), "they weigh nothing and resist nothing", clean)
    worst = float(slim[slim > LINE].min(initial=1.0))
    count = int((slim[slim > LINE] < RANGES["height of a triangle"][0]).sum())
    shown = f"{worst:.1e} of its longest edge, {count} such"
    yield from _outside("height of a triangle", worst, shown, "its strain is lost in rounding", clean)
    if len(through := crossing_pairs(x, faces)):
        value = f"{len(through)} pairs of triangles, first {through[0, 0]} and {through[0, 1]}"
        kept = "a simulation keeps it so" if a.scene.training.untangling or a.model.terms.layers else "it stays so"
        mend = (
            "fit the outer garment with a larger --clearance"
            if a.garment.layers
            else "ncs fit smooths small folds, else bring it apart"
        )
        yield Risk("garment through itself at rest", value, kept, mend)
    if twice := doubled(x, faces):
        mend = f"garment.weld = {TOGETHER:g}"
        yield Risk("vertices at one place", str(twice), "cloth comes apart there: they share no edge", mend)


def _grain(a: Setting) -> Iterator[Risk]:
    """Yield the risk of a membrane that differs along warp and weft where no texture coordinates say which is which."""
    if a.scene.physics.membrane.model == "baraff_witkin" and a.garment.uv is None:
        value = "baraff_witkin, of a garment without texture coordinates"
        risk = "the warp is taken to be up and down on the body, whatever the cut"
        yield Risk("warp and weft", value, risk, 'export the garment with its UV map, or physics.membrane.model = "stvk"')


def _depths(a: Setting, faces: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return how deep in the body the garment is as the body alone carries it (poses, verts), m.

    poses: axis-angle (poses, joints, 3); of a moving mesh, the numbers of frames (poses,).
    """
    model, body = a.model, required(a.body, "body")
    if body.frames is not None and body.carriers is not None:
        rest = np.asarray(model.garment.mesh.rest, np.float64)
        cloth = [carried(rest, model.blend, transforms) for transforms in body.carriers[poses][:, list(model.source_joints)]]
        return depths_on_host(np.stack(cloth), body.frames[poses][:, a.prepared.part], faces, layered=False)
    rest, skin = (np.asarray(x, np.float64) for x in (model.garment.mesh.rest, required(model.body, "model.body")))
    cloths, bodies = [], []
    for pose, transforms in zip(poses, joint_transforms(body, poses)[:, list(model.source_joints)], strict=True):
        bare = corrected_rest(skin, model.correctives, transforms, model.skeleton.parents)
        surface = [carried(bare, required(model.body_blend, "model.body_blend"), transforms), *_worn_below(model, pose)]
        cloths.append(carried(rest, model.blend, transforms))
        bodies.append(np.concatenate(surface))
    return depths_on_host(np.stack(cloths), np.stack(bodies), faces, layered=bool(model.under))


def _shows(a: Setting, faces: np.ndarray) -> Iterator[Risk]:
    """Yield the risk of a collision that is too thin or too soft for the garment's edges: skin shows between its vertices."""
    model, collision = a.model, a.scene.physics.collision
    if collision.stiffness == 0:
        return
    rest, own = np.asarray(model.garment.mesh.rest, np.float64), np.asarray(model.garment.mesh.faces)
    below, pieces = resting_body(model), a.prepared.pieces
    wanted = contact_for(rest, own, sinking(rest, own, below, faces, pieces), pieces=pieces)
    pressed = least_thickness(0.0, vertex_share(rest, own, pieces), collision.stiffness)
    if wanted.sinking < FLAT or collision.thickness >= wanted.sinking + pressed:
        return
    thick, edge, sunk, deeper = (f"{1000 * a:.3g} mm" for a in (collision.thickness, wanted.edge, wanted.sinking, pressed))
    value = f"{thick}; triangles of {edge}, laid on the skin, sink {sunk} into its curves, and their load presses them {deeper}"
    stiffness = max(wanted.stiffness, collision.stiffness)
    mend = f"physics.collision: thickness = {wanted.thickness:g}, stiffness = {stiffness:g}, or a finer mesh"
    yield Risk("thickness of the collision", value, "skin shows through the cloth", mend)


def _folds(a: Setting) -> Iterator[Risk]:
    """Yield the risk of a loose garment whose folds are finer than its triangles."""
    x, body = np.asarray(a.garment.vertices, np.float64), required(a.body, "body")
    away, _ = distance_and_direction(x, body.vertices, body.faces, border_of(body.faces, len(body.vertices)))
    if fine := fine_folds(x, np.asarray(a.garment.faces), away, a.scene.physics):
        value = f"{1000 * fine.length:.0f} mm under its weight, of edges of {1000 * fine.edge:.0f} mm"
        mend = f"physics.bending.stiffness = {fine.stiffness:g}, or a finer mesh"
        yield Risk("folds of loose cloth", value, "they are finer than its triangles, and pass through each other", mend)


def _worn_below(model: Model, pose: np.ndarray) -> list[np.ndarray]:
    """Return the vertices of the garments below in a pose that is held, m."""
    if not model.under:
        return []
    from ncs_jax.network.rollout import animated
    from ncs_jax.prepare.build import features_from_records

    still = MotionRecord(pose[None], np.zeros((1, 3), pose.dtype), model.fps)
    return [animated(g.model, g.network, g.params, features_from_records(g.model, still))[0] for g in model.under]


def _inside(
    a: Setting, faces: np.ndarray, poses: np.ndarray, when: str, limits: tuple[float, float], mend: str
) -> Iterator[Risk]:
    """Yield a risk where, in some pose, more than a share of the garment is deeper (m) inside the body than the limits say."""
    (deep, many), depth = limits, _depths(a, faces, poses)
    share = float((depth > deep).mean(axis=1).max())
    if share > many:
        value = f"{100 * share:.1f} % of its vertices by more than {1000 * deep:.0f} mm, up to {1000 * depth.max():.1f} mm"
        yield Risk(f"garment inside the body {when}", value, "contact pushes it out on the nearer side, right or wrong", mend)


def _far(a: Setting, name: str) -> Iterator[Risk]:
    """Yield the risk of a motion that goes too far."""
    path = a.motions[name].translation.astype(np.float64)
    far = float(np.linalg.norm(path - path[:1], axis=1).max())
    rounding = "positions are rounded to more than 0.1 mm"
    for risk in _outside("distance from the start", far, f"{far:.0f} m in {name}", rounding, "cut the motion"):
        yield replace(risk, motion=name)


def _inside_in(a: Setting, faces: np.ndarray, say: Callable[[str], None]) -> Iterator[Risk]:
    """Yield the risks of cloth inside the body as it moves: of `POSES` of each motion, or of the most bent one of `MOST`."""
    names = list(a.motions)
    many = len(names) > MOST // POSES
    if len(names) > MOST:
        names = [names[i] for i in np.linspace(0, len(names) - 1, MOST).astype(int)]
    mend = "mend the pose, or smooth the skinning weights"
    which = ", in the most bent pose of each" if many else ""
    for name in one_by_one(names, f"looking for cloth inside the body{which}", say):
        poses = a.motions[name].poses
        frames = np.unique(np.linspace(0, len(poses) - 1, POSES).astype(int))
        if many:
            frames = np.abs(poses[:, 1:]).sum(axis=(1, 2)).argmax(keepdims=True)
        when = f"where the body alone carries it in {name}"
        for risk in _inside(a, faces, poses[frames], when, (DEEP, MANY), mend):
            yield replace(risk, motion=name)


def _in_frames(a: Setting, body: BodyRecord, faces: np.ndarray) -> Iterator[Risk]:
    """Yield the risks of a moving mesh: what jumps, and cloth inside it in `POSES` of its frames as it alone carries it."""
    if body.frames is None:
        return
    yield from (Risk(*fault) for fault in frame_jumps(a))
    some = np.unique(np.linspace(0, len(body.frames) - 1, POSES).astype(int))
    yield from _inside(
        a, faces, some, "where that alone carries it", (DEEP, MANY), "clear the mesh of itself where it was made"
    )


def _undriven(record: MotionRecord, name: str) -> Iterator[Risk]:
    """Yield a risk for each limb, spine or head of the body that no joint of a motion drives."""
    for limb, mend in record.undriven.items():
        yield Risk(name, f"{limb} is driven by nothing", "it keeps the angle of the rest pose", mend, name)


def _cut_short(record: MotionRecord, name: str, frames: tuple[int, ...]) -> Iterator[Risk]:
    """Yield a risk where a motion's file ends before its header says, unless the scene says which frames it means.

    One frame fewer, and none in parts, is how some tools count.
    """
    for note in record.notes if not frames else ():
        said = CUT.match(note)
        if said and int(said[1]) - int(said[2]) > (0 if said[3] else 1):
            value = f"{said[2]} of the {said[1]} frames that its header says are there, in {name}"
            yield Risk("a file that is cut short", value, "the motion ends in its middle", "export it or copy it again", name)


def _radians(record: MotionRecord, name: str) -> Iterator[Risk]:
    """Yield a risk where no rotation of a .bvh is larger than half a turn in radians."""
    for said in filter(None, map(SMALL.match, record.notes)):
        value = f"at most {said[1]} degrees, in {name}"
        mend = "export the rotations in degrees, or leave it where the character only stands"
        yield Risk("joints that hardly turn", value, "the character is stiff, as rotations in radians make it", mend, name)


def _uncertain(motions: Mapping[str, MotionRecord]) -> Iterator[Risk]:
    """Yield a risk where poses since which motions are told had to be built, with the parts that may be wrong at most; and for
    each motion whose zero pose is bent in one part as no frame is."""
    for name, record in motions.items():
        odd = [f"{part.removesuffix(ZERO)} {by:.0f}" for part, by in record.uncertain.items() if part.endswith(ZERO)]
        if odd:
            value = f"by so many degrees, as in no upright frame of {name}: {', '.join(odd)}"
            risk = "its error is in all frames: raised collar bones drop the shoulders, a head that looks down looks up"
            mend = 'motion.rest = the number of a frame in T-pose or A-pose; "zero" if it is meant so'
            yield Risk("the zero pose is bent in one part alone", value, risk, mend, name)
    built = {
        name: record.uncertain for name, record in motions.items() if any(not part.endswith(ZERO) for part in record.uncertain)
    }
    if built:
        parts = dict.fromkeys(part for one in built.values() for part in one)
        worst = ", ".join(f"{part} {max(one.get(part, 0) for one in built.values()):.0f}" for part in parts)
        mend = "motion.rest = the number of a frame in T-pose, A-pose, or upright with hanging arms"
        risk = "they lean, look up or down, or are twisted by so much in all frames"
        names = ", ".join([*built][:NAMED]) + (f" and {len(built) - NAMED} more" if len(built) > NAMED else "")
        yield Risk(
            "the pose at rest had to be built",
            f"right to so many degrees in nine of ten recordings: {worst}, in {names}",
            risk,
            mend,
        )


def _posture(a: Setting, name: str) -> Iterator[Risk]:
    """Yield the risks of a motion in which the character stands, bends or floats as nobody does."""
    world = "z" if np.abs(np.array(a.scene.physics.gravity)).argmax() == 2 else "y"
    for what, value, risk, mend in posture_faults(a.motions[name], a.body, world) if a.body is not None else ():
        yield Risk(what, f"{value} of {name}", risk, mend, name)


def motion_risks(a: Setting, say: Callable[[str], None] = lambda _: None) -> list[Risk]:
    """Return what puts a scene at risk in its motions themselves, whatever is worn; `say` is told how far it is with many."""
    spec = a.scene.motion_file
    found = [risk for name, record in a.motions.items() for risk in _cut_short(record, name, spec(name)[1].frames)]
    found += [risk for name, record in a.motions.items() for risk in (*_radians(record, name), *_undriven(record, name))]
    found += _uncertain(a.motions)
    for name in one_by_one(a.motions, "looking for what is too fast", say):
        found += [Risk(*fault, name) for fault in speed_faults(a, name)]
    for name in one_by_one(a.motions, "looking at postures", say):
        found += _posture(a, name)
    return found


def find_risks(a: Setting, say: Callable[[str], None] = lambda _: None) -> list[Risk]:
    """Return all that puts a scene at risk, from its motions, material, mesh and fit; none where it is safe.

    What was found in the same scene before is kept, see `kept`; not of garments worn over others, whose networks tell.
    """
    if a.model.under:
        return _looked_for(a, say)

    def make() -> dict[str, np.ndarray]:
        return {"risks": np.frombuffer(json.dumps([astuple(risk) for risk in _looked_for(a, say)]).encode(), np.uint8)}

    files = [asdict(a.garment), *(asdict(record) for record in a.motions.values()), a.body and asdict(a.body)]
    found = required(
        kept(("risks",), make, a.model, asdict(a.prepared), files, tuple(a.motions), str(a.scene.to_dict())), "risks"
    )
    return [Risk(*risk) for risk in json.loads(found["risks"].tobytes())]


def _looked_for(a: Setting, say: Callable[[str], None]) -> list[Risk]:
    """Return what `find_risks` does, without having kept anything."""
    found = motion_risks(a, say)
    body, faces = a.body, None
    if body is not None:
        found += [Risk(*fault) for fault in wearing_faults(a.garment, body)]
    if a.model.body is not None and body is not None:
        faces = touchable_faces(a.model, body, a.prepared.part)
        found += [*_shows(a, faces), *_folds(a)]
    found += [*_material(a.scene), *_grain(a), *_mesh(a)]
    if faces is not None and body is not None:
        below = "give it room over the garment below where it was made, or fit it with a larger ncs fit --clearance"
        mend = below if a.model.under else "push it out: ncs fit"
        rest = np.zeros((1, len(body.parents), 3)) if body.frames is None else np.zeros(1, int)
        found += _inside(a, faces, rest, "at rest", (0.0, 0.0), mend)
        found += _in_frames(a, body, faces)
    found += [risk for name in a.motions for risk in _far(a, name)]
    return found if faces is None else [*found, *_inside_in(a, faces, say)]

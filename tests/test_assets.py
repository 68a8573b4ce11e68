"""The packaged scene: what a user may rely on about its body, garments and motions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import ncs_jax
from ncs_jax.io import read_body
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.scene.spec import MotionSpec, Scene
from ncs_jax.view.character import body_vertices
from tools.make_recordings import CUTS, make_recording

ASSETS = Path(ncs_jax.__file__).parent / "assets"
SIZES = {"": (900, 1200), "_fine": (4000, 5000)}
GARMENTS = {name + fine: size for name in ("tshirt", "skirt", "dress") for fine, size in SIZES.items()}
MOTIONS = ("stand", "walk", "walk_turn_stop", "jump", "twist", "lift_arms", "dance", "mixed")
RECORDINGS = tuple(f"cmu_{name}" for name in ("walk", "walk_fast", "run", "dance", "spin", "turn", "ball", "stand"))
CMU = Path(__file__).parents[2] / "shared" / "data" / "cmu_mocap_bvh"
HOLDS = {"walk_turn_stop": 4.0, "jump": 1.0, "twist": 1.5}  # seconds of rest at the end
# Largest turn of a joint from the rest pose, degrees. The A-pose is 42 degrees from hanging arms, its elbows bent by 40.
LIMITS = {
    "LowerBack": 25,
    "Spine": 25,
    "Spine1": 25,
    "Neck": 25,
    "Neck1": 25,
    "Head": 25,
    "Shoulder": 35,
    "Arm": 130,
    "ForeArm": 90,
    "Hand": 1,
    "UpLeg": 95,
    "Leg": 120,
    "Foot": 60,
    "ToeBase": 60,
    "HipJoint": 1,
    "Thumb": 1,
    "FingerBase": 1,
    "HandFinger1": 1,
}


@cache
def load(name: str) -> dict[str, np.ndarray]:
    with np.load(ASSETS / f"{name}.npz", allow_pickle=False) as file:
        return {k: file[k] for k in file.files}


def closest_offset(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """From the nearest point of each triangle (N, 3, 3) to each point (N, 3); the minimum over face and three edges."""
    a, b, c = (triangles[:, k] for k in range(3))
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    inside = np.ones(len(points), dtype=bool)
    best, squared = np.zeros_like(points), np.full(len(points), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(q - p, points - p) * n).sum(1) >= 0
        s = np.clip(((points - p) * (q - p)).sum(1) / ((q - p) ** 2).sum(1), 0, 1)
        offset = points - p - s[:, None] * (q - p)
        nearer = (offset**2).sum(1) < squared
        best[nearer], squared[nearer] = offset[nearer], (offset**2).sum(1)[nearer]
    flat = ((points - a) * n).sum(1, keepdims=True) * n
    return np.where(inside[:, None], flat, best)


def signed_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact signed distance (N,) to a triangle mesh, and the offset vectors (N, 3) from its nearest points."""
    corners = vertices[faces]
    centre = corners.mean(1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max()
    near = cKDTree(centre).query_ball_point(points, cKDTree(vertices).query(points)[0] + radius)
    owner = np.repeat(np.arange(len(points)), [len(i) for i in near])
    face = np.concatenate([np.array(i) for i in near])
    offset = closest_offset(points[owner], corners[face])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = (offset * normal[face]).sum(1)
    length = np.linalg.norm(offset, axis=1)
    least = np.full(len(points), np.inf)
    np.minimum.at(least, owner, length)
    # Among equally near faces the one seen most squarely gives the sign (Baerentzen and Aanaes 2005 in spirit).
    order = np.lexsort((-np.abs(height), length > least[owner] + 1e-9, owner))
    first = order[np.searchsorted(owner[order], np.arange(len(points)))]
    return np.copysign(length[first], height[first]), offset[first]


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unique undirected edges and how many faces use each; fails if two faces use one in the same direction."""
    half = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(half, axis=0)) == len(half)
    return np.unique(np.sort(half, axis=1), axis=0, return_counts=True)


def smallest_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    t = vertices[faces].astype(float)
    out = []
    for k in range(3):
        u, v = t[:, (k + 1) % 3] - t[:, k], t[:, (k + 2) % 3] - t[:, k]
        out.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(1))))
    return np.min(out, axis=0)


def boundary_loops(faces: np.ndarray) -> int:
    edges, count = edge_counts(faces)
    rim = edges[count == 1]
    label = {v: v for v in rim.ravel()}

    def root(v: int) -> int:
        while label[v] != v:
            v = label[v]
        return v

    for a, b in rim:
        label[root(a)] = root(b)
    return len({root(v) for v in label})


def skinning() -> np.ndarray:
    body = load("body")
    dense = np.zeros((len(body["vertices"]), len(body["joints"])))
    rows = np.arange(len(dense))
    for k in range(body["weights"].shape[1]):
        np.add.at(dense, (rows, body["weight_joints"][:, k]), body["weights"][:, k])
    return dense


@cache
def pose(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Posed body vertices (T, V, 3) and joints (T, J, 3): linear blend skinning written out."""
    body, motion = load("body"), load(name)
    rest, parents = body["joints"].astype(float), body["parents"]
    turns = Rotation.from_rotvec(motion["poses"].reshape(-1, 3)).as_matrix().reshape(*motion["poses"].shape, 3)
    world, place = np.empty_like(turns), np.zeros(motion["poses"].shape)
    for j, p in enumerate(parents):
        world[:, j] = turns[:, j] if p < 0 else world[:, p] @ turns[:, j]
        place[:, j] = rest[j] if p < 0 else place[:, p] + world[:, p] @ (rest[j] - rest[p])
    place += motion["trans"][:, None]
    shift = place - np.einsum("tjab,jb->tja", world, rest)
    weights, vertices = skinning(), body["vertices"].astype(float)
    blend = np.tensordot(weights, world, ([1], [1])).transpose(1, 0, 2, 3)
    moved = np.einsum("tvab,vb->tva", blend, vertices) + np.tensordot(weights, shift, ([1], [1])).transpose(1, 0, 2)
    return moved, place


def joint(name: str) -> int:
    return list(load("body")["joint_names"]).index(name)


def part(*endings: str) -> np.ndarray:
    """Body vertices that follow mostly joints with these endings (after Left or Right)."""
    body = load("body")
    wanted = [i for i, n in enumerate(body["joint_names"]) if n.removeprefix("Left").removeprefix("Right") in endings]
    return np.isin(body["weight_joints"][:, 0], wanted)


def test_everything_fits_in_a_megabyte():
    assert sum(p.stat().st_size for p in ASSETS.iterdir() if p.is_file()) < 1_000_000
    assert (ASSETS / "LICENSE.md").read_text().count("CC0") > 1


def test_body_is_a_closed_upright_woman_facing_z():
    body = load("body")
    vertices, faces = body["vertices"], body["faces"]
    assert 5000 <= len(vertices) <= 7000 and faces.dtype == np.int32
    _, count = edge_counts(faces)
    assert (count == 2).all()
    assert len(vertices) - len(count) + len(faces) == 2  # a sphere: one component, no handles
    assert vertices[:, 1].min() == pytest.approx(0, abs=1e-4)
    assert 1.5 < vertices[:, 1].max() < 1.7
    toes, heels = (vertices[part(p)][:, 2].mean() for p in ("ToeBase", "Leg"))
    assert toes > heels
    t = vertices[faces].astype(float)
    double_area = np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1)
    assert double_area.min() > 5e-7
    assert np.einsum("fi,fi->", t[:, 0], np.cross(t[:, 1], t[:, 2])) / 6 > 0.04  # m^3, so faces look outward


def test_body_is_its_own_mirror_image():
    vertices = load("body")["vertices"]
    assert cKDTree(vertices).query(vertices * np.float32([-1, 1, 1]))[0].max() == 0


def test_skeleton_and_weights():
    body = load("body")
    assert len(body["joint_names"]) == len(body["joints"]) == len(body["parents"]) == 31
    assert body["parents"][0] == -1
    assert (body["parents"][1:] < np.arange(1, 31)).all()
    assert body["weight_joints"].shape == body["weights"].shape == (len(body["vertices"]), 4)
    assert (body["weights"] >= 0).all() and body["weight_joints"].max() < 31
    np.testing.assert_allclose(body["weights"].sum(1), 1, atol=1e-6)


@pytest.mark.parametrize("name", GARMENTS)
def test_garment_mesh_is_clean(name):
    garment = load(name)
    vertices, faces = garment["vertices"], garment["faces"]
    low, high = GARMENTS[name]
    assert low <= len(vertices) <= high and faces.dtype == np.int32
    assert (np.unique(faces) == np.arange(len(vertices))).all()
    edges, count = edge_counts(faces)
    assert count.max() == 2
    openings = 2 if "skirt" in name else 4
    assert boundary_loops(faces) == openings
    assert len(vertices) - len(edges) + len(faces) == 2 - openings
    angles = smallest_angles(vertices, faces)
    assert angles.min() > 15 and (angles > 20).mean() > 0.998 and np.median(angles) > 45
    lengths = np.linalg.norm(np.diff(vertices[edges].astype(float), axis=1)[:, 0], axis=1)
    assert lengths.std() / lengths.mean() < 0.2
    assert cKDTree(vertices).query(vertices * np.float32([-1, 1, 1]))[0].max() < 2e-5


@pytest.mark.parametrize("name", GARMENTS)
def test_garment_clears_the_body(name):
    body, garment = load("body"), load(name)
    skin, cloth = body["vertices"].astype(float), garment["vertices"].astype(float)
    distance, _ = signed_distance(cloth, skin, body["faces"])
    assert distance.min() >= 0.003
    bare = part("Arm", "ForeArm", "Hand", "FingerBase", "HandFinger1") if "dress" in name else np.zeros(len(skin), bool)
    near = skin[(cKDTree(cloth).query(skin)[0] < 0.05) & ~bare]
    depth, offset = signed_distance(near, cloth, garment["faces"])
    # Beyond a hem the nearest cloth is a boundary edge and has no inside: look only at skin straight under a face.
    normal_like = np.abs(depth) < 0.03
    under = normal_like & ~_at_hem(near - offset, cloth, garment["faces"])
    assert under.sum() > 200 and depth[under].max() < -0.001


def _at_hem(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    edges, count = edge_counts(faces)
    a, b = vertices[edges[count == 1]].swapaxes(0, 1)
    rim = np.concatenate([a + share * (b - a) for share in np.linspace(0, 1, 5)])
    return cKDTree(rim).query(points)[0] < 0.02


@pytest.mark.parametrize("name", ["skirt", "skirt_fine"])
def test_skirt_is_pinned_at_the_waistband(name):
    skirt = load(name)
    pins, height = skirt["group_pins"], skirt["vertices"][:, 1]
    assert len(pins) >= 24
    assert (height[pins] > height.max() - 0.0201).all()
    assert (np.delete(height, pins) <= height.max() - 0.0199).all()


@pytest.mark.parametrize("name", ["dress", "dress_fine"])
def test_dress_hangs_from_shoulders_and_waist_and_is_wide_at_the_hem(name):
    dress, body = load(name), load("body")
    vertices = dress["vertices"].astype(float)
    edges, count = edge_counts(dress["faces"])
    rim = vertices[edges[count == 1]]
    low = rim[:, :, 1].max(1) < vertices[:, 1].min() + 0.01
    hem, middle = np.linalg.norm(rim[low, 0] - rim[low, 1], axis=1).sum(), (vertices[:, 1] - 1.035)
    waist = cKDTree(body["vertices"]).query(vertices[np.abs(middle) < 0.03])[0]
    assert np.median(waist) < 0.03
    length = (1.035 - vertices[:, 1].min()) / 0.8  # along the cloth, which is a cone whose radius grows by 0.6 of it
    assert 1.035 - length == pytest.approx(0.28, abs=0.03)  # on the calf
    assert (hem - 0.69) / length > 1.1 * np.pi  # as it opens from a waist of 0.69 m: half a circle would be pi


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_is_complete_and_bounded(name):
    motion = load(name)
    frames = len(motion["poses"])
    assert motion["poses"].shape == (frames, 31, 3) and motion["trans"].shape == (frames, 3)
    assert motion["poses"].dtype == motion["trans"].dtype == np.float32
    assert float(motion["fps"]) == 30 and 4 <= (frames - 1) / 30 <= 10
    assert list(motion["joint_names"]) == list(load("body")["joint_names"])
    turned = np.degrees(np.linalg.norm(motion["poses"], axis=2)).max(0)
    for joint_name, angle in zip(motion["joint_names"][1:], turned[1:], strict=True):
        bare = joint_name.removeprefix("Left").removeprefix("Right")
        bare = {"LHipJoint": "HipJoint", "RHipJoint": "HipJoint", "LThumb": "Thumb", "RThumb": "Thumb"}.get(bare, bare)
        assert angle <= LIMITS[bare], joint_name


@pytest.mark.parametrize("name", MOTIONS)
def test_knees_and_elbows_bend_one_way(name):
    _, place = pose(name)
    turns = Rotation.from_rotvec(load(name)["poses"][:, 0]).as_matrix()
    for side in ("Left", "Right"):
        hip, knee, ankle = (place[:, joint(side + p)] for p in ("UpLeg", "Leg", "Foot"))
        bend = np.einsum("tij,ti->tj", turns, knee - (hip + ankle) / 2)  # in the hips' frame
        straight = np.linalg.norm(ankle - hip, axis=1) / (
            np.linalg.norm(knee - hip, axis=1) + np.linalg.norm(ankle - knee, axis=1)
        )
        assert (bend[:, 2] > 0).all() and straight.min() > 0.55 and straight.max() < 1
        shoulder, elbow, hand = (place[:, joint(side + p)] for p in ("Arm", "ForeArm", "Hand"))
        cosine = ((elbow - shoulder) * (hand - elbow)).sum(1) / (
            np.linalg.norm(elbow - shoulder, axis=1) * np.linalg.norm(hand - elbow, axis=1)
        )
        assert cosine.min() > np.cos(np.radians(120)) and cosine.max() < np.cos(np.radians(3))


@pytest.mark.parametrize("name", MOTIONS)
def test_feet_stand_on_the_ground(name):
    vertices, place = pose(name)
    lowest = vertices[..., 1].min(1)
    if name in ("jump", "mixed"):
        air = lowest > 0.015
        first, last = np.flatnonzero(air)[[0, -1]]
        assert air[first : last + 1].all() and 8 <= last - first <= 18  # one flight
        fall = np.diff(place[first : last + 1, 0, 1], 2) * 30**2
        np.testing.assert_allclose(fall[1:-1], -9.81, rtol=0.03)
        lowest = lowest[~air]
    assert np.abs(lowest).max() < 0.015


@pytest.mark.parametrize("name", MOTIONS)
def test_standing_feet_do_not_skate(name):
    vertices, _ = pose(name)
    feet = vertices[:, part("Foot", "ToeBase")]
    touching = (feet[1:, :, 1] < 0.005) & (feet[:-1, :, 1] < 0.005)
    slip = np.linalg.norm(np.diff(feet[..., [0, 2]], axis=0), axis=2)
    assert np.where(touching, slip, 0).max() < 0.006


@pytest.mark.parametrize("name", MOTIONS)
def test_arms_and_legs_keep_clear(name):
    vertices, _ = pose(name)
    arms = part("ForeArm", "Hand", "FingerBase", "HandFinger1")
    trunk = part("Hips", "LowerBack", "Spine", "Spine1", "UpLeg")
    left = load("body")["vertices"][:, 0] > 0
    shins = part("Leg", "Foot", "ToeBase")
    for frame in vertices[::6]:
        assert cKDTree(frame[trunk]).query(frame[arms])[0].min() > 0.01
        assert cKDTree(frame[shins & left]).query(frame[shins & ~left])[0].min() > 0.01


@pytest.mark.parametrize("name", MOTIONS)
def test_motion_starts_with_hanging_arms_and_is_smooth(name):
    _, place = pose(name)
    for side in ("Left", "Right"):
        arm = place[0, joint(f"{side}ForeArm")] - place[0, joint(f"{side}Arm")]
        assert -arm[1] / np.linalg.norm(arm) > np.cos(np.radians(20))
    acceleration = np.linalg.norm(np.diff(place, 2, axis=0), axis=2) * 30**2
    assert acceleration.max() < 130  # m/s^2; the legs straightening at take-off
    assert acceleration[0].max() < 3


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_moves_the_body_without_leaps(name):
    motion, (vertices, place) = load(name), pose(name)
    assert motion["poses"].shape == (len(place), 31, 3) and float(motion["fps"]) == 30
    assert list(motion["joint_names"]) == list(load("body")["joint_names"])
    assert np.abs(motion["trans"][0, [0, 2]]).max() == 0
    turns = Rotation.from_rotvec(motion["poses"][:-1].reshape(-1, 3)).inv() * Rotation.from_rotvec(
        motion["poses"][1:].reshape(-1, 3)
    )
    assert np.degrees(turns.magnitude().max()) < 90  # in a frame, from which on `ncs check` tells of a risk
    assert np.linalg.norm(np.diff(place, axis=0), axis=2).max() < 0.3  # m
    lowest = vertices[..., 1].min(1)
    assert np.percentile(lowest, 5) > -0.08 and np.median(lowest) < 0.05


@pytest.mark.skipif(not CMU.exists(), reason="needs recordings that are not in the repository")
@pytest.mark.parametrize("name", ["cmu_run", "cmu_turn"])
def test_a_recording_is_what_its_script_makes_of_the_file(name):
    clip, *cut = CUTS[name]
    body = read_body(packaged("body"))
    made, kept = make_recording(body, CMU / f"{clip}.bvh", cut), load(name)
    np.testing.assert_allclose(kept["poses"], made["poses"], atol=2e-4)
    np.testing.assert_allclose(kept["trans"], made["trans"], atol=5e-5)
    file = f"{CMU / clip}.bvh[{cut[0]}:{cut[1]}]"
    exact = load_motion(Scene(motion=MotionSpec(files=(file,), rest="zero")), file, body)
    path = exact.translation - exact.translation[0] * (1, 0, 1)
    right = body_vertices(body, replace(exact, translation=path))
    away = np.linalg.norm(right - pose(name)[0], axis=2).max(0)
    assert away[~part("Foot", "ToeBase") & ~part("Leg")].max() < 1e-4  # m; a foot may have been set straight


@pytest.mark.parametrize(("name", "seconds"), HOLDS.items())
def test_motion_ends_in_a_hold(name, seconds):
    motion = load(name)
    tail = int(seconds * 30)
    assert np.abs(np.diff(motion["poses"][-tail:], axis=0)).max() < 1e-4
    assert np.abs(np.diff(motion["trans"][-tail:], axis=0)).max() < 1e-4

"""Try files that other tools wrote, folder by folder, and measure how motions drive the packaged body against own computations.

    python -m tools.check_inputs FOLDER

Below FOLDER, each file is read as all that its suffix may be, and what comes of it is printed: sizes and notes, or the refusal.
Each motion drives the packaged body, in all its frames. Compared are

- with twin.* of the same folder, or else with the folder's first motion, if they have as many frames but for a first one, which
  may be a T-pose: the largest distance of a joint, and the largest angle of trunk, head, collars and feet. Where one file has
  more joints in its spine or neck than the other, these joints bend differently in between, so the places above them are no
  truth, and are left out by name; which way the head looks is one still;
- with the .bvh itself, read and posed here in a few lines: the largest angle between a limb's bone on the character and the one
  that drives it.

A motion passes with 1 mm and 2 degrees. Folders hold files of one motion under other conventions, or of motions of other
lengths. Ends with 1 where a motion is off, or a file is refused as everything.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.io import BodyRecord, MotionRecord
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.packaged import packaged
from ncs_jax.io.tables.files import text_of
from ncs_jax.prepare.motion_import import retarget_to_body
from ncs_jax.scene.spec import MotionSpec, load_scene

__all__ = ["bvh_places", "main", "posed"]

CLOSE = 0.001, 2.0  # m and degrees
BONES = [(f"{side}{a}", f"{side}{b}") for side in ("Left", "Right")
         for a, b in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))]  # fmt: skip
TRUNK = re.compile(r"Hips|Spine|LowerBack|Neck|Head|Shoulder|Foot$")
KINDS: dict[str, Callable] = {"body": io.read_body, "garment": io.read_garment, "motion": io.read_motion}
SUFFIXES = {
    "body": {".npz", ".glb", ".gltf", ".vrm", ".fbx", ".obj"},
    "garment": {".obj", ".ply", ".stl", ".usd", ".usda", ".usdc", ".usdz"},
    "motion": {".npz", ".h5", ".hdf5", ".bvh", ".glb", ".gltf", ".vrm", ".vrma", ".fbx"},
}


@dataclass(frozen=True, eq=False)
class Driven:
    """A motion on the body: world rotations (T, J, 3, 3) and places (T, J, 3), m; which joint drives which; notes."""

    turns: np.ndarray
    places: np.ndarray
    by: dict[str, str]
    notes: tuple[str, ...]


def bvh_places(text: str) -> dict[str, np.ndarray]:
    """Return the places (T, 3) of the joints of a .bvh by name, in the file's unit: read and posed without the package."""
    text = re.sub(r"(?m)^#.*$", "", text)
    head, data = re.split(r"(?im)^\s*motion\s*$", text, maxsplit=1)
    numbers = re.split("(?i)time", data, maxsplit=1)[1].lstrip(" :").split()[1:]
    rows = np.array([float(n.replace(",", ".")) for n in numbers])
    joints: list[dict] = []
    chain: list[dict] = []
    words = iter(re.sub(r"([{}])", r" \1 ", head).lstrip("\ufeff").split())
    for word in map(str.upper, words):
        if word in ("ROOT", "JOINT", "END"):
            name = []
            while (part := next(words)) != "{":
                name.append(part)
            chain.append({"name": " ".join(name), "parent": chain[-1] if chain else None, "channels": [], "end": word == "END"})
            joints += [] if word == "END" else [chain[-1]]
        elif word == "OFFSET":
            chain[-1]["offset"] = np.array([float(next(words).replace(",", ".")) for _ in range(3)])
        elif word == "CHANNELS":
            chain[-1]["channels"] = [next(words).capitalize() for _ in range(int(next(words)))]
        elif word == "}":
            chain.pop()
    width = sum(len(j["channels"]) for j in joints)
    rows = rows[: len(rows) // width * width].reshape(-1, width)
    column = 0
    for j in joints:
        place, turn = np.tile(j["offset"], (len(rows), 1)), np.tile(np.eye(3), (len(rows), 1, 1))
        for channel in j["channels"]:
            axis = "XYZ".index(channel[0])
            if channel.endswith("position"):
                place[:, axis] = rows[:, column]
            else:
                turn = turn @ Rotation.from_euler("xyz"[axis], rows[:, column, None], degrees=True).as_matrix()
            column += 1
        above = j["parent"]
        j["turn"] = turn if above is None else above["turn"] @ turn
        j["place"] = place if above is None else above["place"] + np.einsum("tab,tb->ta", above["turn"], place)
    return {j["name"]: j["place"] for j in joints}


def posed(body: BodyRecord, motion: MotionRecord) -> Driven:
    """Pose a body by a motion of its joints, in plain loops."""
    frames, count = motion.poses.shape[:2]
    turns, places = np.zeros((frames, count, 3, 3)), np.zeros((frames, count, 3))
    rest = body.rest_rotations if body.rest_rotations is not None else np.tile(np.eye(3), (count, 1, 1))
    for j, parent in enumerate(body.parents):
        own = rest[j] @ Rotation.from_rotvec(motion.poses[:, j]).as_matrix() @ rest[j].T
        turns[:, j] = own if parent < 0 else turns[:, parent] @ own
        if parent < 0:
            places[:, j] = body.joints[j] + motion.translation
        else:
            places[:, j] = places[:, parent] + turns[:, parent] @ (body.joints[j] - body.joints[parent])
    by = motion.driven or dict(zip(body.joint_names, body.joint_names, strict=True))  # of the body's own joints: as it is
    return Driven(turns, places, by, motion.notes)


def apart(one: Driven, other: Driven, body: BodyRecord) -> tuple[float, str, float, str, list[str]]:
    """Return the largest distance of a joint that both drive, m, the largest angle of the trunk, degrees, and where they are.

    Compared are the last frames that both have. Last are the joints whose places are not compared, as below them is one that
    only one motion drives.
    """
    names, frames = body.joint_names, min(len(one.places), len(other.places))
    both = [j for j, n in enumerate(names) if n in one.by and n in other.by]
    alike = [j for j in both if all((names[k] in one.by) == (names[k] in other.by) for k in path_to_root(body.parents, j))]
    far = np.linalg.norm(one.places[-frames:] - other.places[-frames:], axis=-1).max(axis=0)
    farthest = max(((float(far[j]), names[j]) for j in alike), default=(np.inf, "nothing below the root is driven alike"))
    trunk = [j for j in both if TRUNK.search(names[j])]
    turn = np.swapaxes(one.turns[-frames:, trunk], -1, -2) @ other.turns[-frames:, trunk]
    angle = np.degrees(Rotation.from_matrix(turn.reshape(-1, 3, 3)).magnitude()).reshape(turn.shape[:2]).max(axis=0)
    most = max(zip(angle.tolist(), (names[j] for j in trunk), strict=True), default=(np.inf, "no part of it in both"))
    return *farthest, *most, [names[j] for j in both if j not in alike]


def limbs_apart(driven: Driven, own: dict[str, np.ndarray], names: tuple[str, ...]) -> tuple[float, str]:
    """Return the largest angle, degrees, between a limb's bone on the character and in the file, and the bone.

    The world of the file has Y up, or Z: what fits better.
    """
    worst = []
    for turn in (np.eye(3), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])):
        found = [(0.0, "no bone")]
        for a, b in BONES:
            if not {a, b} <= set(driven.by) or not {driven.by[a], driven.by[b]} <= set(own):
                continue
            ours = driven.places[:, names.index(b)] - driven.places[:, names.index(a)]
            theirs = (own[driven.by[b]] - own[driven.by[a]])[: len(ours)] @ turn.T
            angle = np.arctan2(np.linalg.norm(np.cross(ours, theirs), axis=1), (ours * theirs).sum(1))
            found.append((float(np.degrees(angle).max()), f"{a} to {b}"))
        worst.append(max(found))
    return min(worst)


def _read(file: Path) -> tuple[list[str], MotionRecord | None]:
    """Return what came of reading a file as each kind, in words, and its motion."""
    told, motion = [], None
    for kind, read in KINDS.items():
        if file.suffix.lower() not in SUFFIXES[kind] and not (kind == "garment" and file.suffix == ".glb"):
            continue
        try:
            record = read(file)
        except InputError as error:
            told.append(f"{kind} refused: {str(error).replace(str(file), '').lstrip(': ')[:160]}")
            continue
        if isinstance(record, MotionRecord):
            motion = record
            told.append(f"motion of {len(record.poses)} frames, {record.poses.shape[1]} joints")
        else:
            size = " x ".join(f"{s:.3g}" for s in np.ptp(record.vertices, axis=0))
            told.append(f"{kind} of {len(record.vertices)} vertices, {size} m")
        told += [f"  {note}" for note in record.notes]
    if file.suffix == ".toml":
        try:
            load_scene(file)
            told.append("scene is read")
        except InputError as error:
            told.append(f"scene refused: {error}")
    return told, motion


def _compare(folder: Path, motions: dict[str, MotionRecord], body: BodyRecord) -> bool:
    """Print how the motions of a folder drive the body, and tell whether all of them pass."""
    found: dict[str, Driven] = {}
    good = True
    for name, motion in sorted(motions.items(), key=lambda item: not item[0].startswith("twin.")):
        try:
            driven = posed(body, retarget_to_body(motion, body, MotionSpec(frames=(0,))))
        except InputError as error:
            print(f"    {name}: refused on the body: {error}")
            continue
        line = []
        if name.endswith(".bvh"):
            own = bvh_places(text_of(folder / name)[1])
            angle, where = limbs_apart(driven, own, body.joint_names)
            line.append(f"limbs to {angle:.2f} degrees ({where})")
            good &= angle < CLOSE[1]
        base = next((n for n, d in found.items() if abs(len(d.places) - len(driven.places)) <= (n[:5] == "twin.")), None)
        if base is not None:
            far, joint, angle, bone, left_out = apart(found[base], driven, body)
            line.append(f"from {base}: {1000 * far:.2f} mm ({joint}), trunk, head, collars, feet {angle:.2f} degrees ({bone})")
            line += [f"places not compared, as the files differ below them: {', '.join(left_out)}"] if left_out else []
            good &= far < CLOSE[0] and angle < CLOSE[1]
        found[name] = driven
        line += [n for n in driven.notes if "reference pose" in n or "turned" in n or "carries" in n or "shape of" in n]
        print(f"    {name} on the body: {'; '.join(line)}")
    return good


def main(folders: list[str]) -> int:
    """Try all files below the folders."""
    body = io.read_body(packaged("body"))
    good = True
    for folder in sorted({file.parent for top in folders for file in Path(top).rglob("*") if file.is_file()}):
        print(folder.name)
        motions: dict[str, MotionRecord] = {}
        for file in sorted(folder.iterdir()):
            if not file.is_file() or file.suffix.lower() == ".md":
                continue
            told, motion = _read(file)
            print("\n".join(f"    {file.name}: {one}" for one in told or ["no reader has this suffix"]))
            good &= not told or not all("refused" in one for one in told)
            motions |= {file.name: motion} if motion is not None else {}
        good &= _compare(folder, motions, body)
    print("all pass" if good else "not all pass")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

"""A skinned character as 4 x 4 matrices, as .glb and .fbx hold it, and the body and the motion made from it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar
from unicodedata import normalize

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.io.character.hierarchy import by_depth, lowest_common, nearest_parents, path_to_root
from ncs_jax.io.character.moving_root import SLIDE, SPARE, check_slides, moving_root
from ncs_jax.io.mesh.weld import distinct
from ncs_jax.io.records import BodyRecord, MotionRecord
from ncs_jax.io.tables.files import LARGEST

__all__ = [
    "MOST_NODES",
    "Piece",
    "Rig",
    "body_of",
    "clip_named",
    "first_that_moves",
    "motion_of",
    "quarter_turns",
    "rig_from",
    "split_clip",
    "unique_names",
]

GIVE = 0.01  # m by which a bone may change, and share by which a joint may scale; more is an error, less is ignored
MOST_NODES = 20_000  # of a file
HOUR = 3600.0  # s; the longest animation
BLOCK = 256  # frames evaluated at once
SAME = 1e-3  # of the size of the character: bind matrices that differ by less are the same


Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles under one skin.

    Attributes:
        vertices: (V, 3) in the space where they were bound. faces: (F, 3). owners, weights: (V, K), numbers into `nodes`, and
            how much each moves the vertex. nodes: (S,) of the file. inverse_binds: (S, 4, 4) from that space to each node.
            bound: (4, 4) from that space to the world, None where the file does not say.
    """

    vertices: np.ndarray
    faces: np.ndarray
    owners: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray
    inverse_binds: np.ndarray
    bound: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """Joints and skin in the bind pose, in metres and Y up.

    Attributes:
        file: the path. nodes: (J,) the file's nodes that are the joints. names: their names. parents: (J,), -1 for the root.
            binds: (J, 4, 4) joint to world in the bind pose. used: (J,) whether a joint, or one below it, moves some vertex.
            vertices: (V, 3). faces: (F, 3). weights: (V, J). A file without a skin has no vertices.
    """

    file: Path
    nodes: np.ndarray
    names: tuple[str, ...]
    parents: np.ndarray
    binds: np.ndarray
    used: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray


def split_clip(path: str | Path) -> tuple[str, str]:
    """Return the file and the animation, or the ROOT, that `FILE.glb#NAME` names; the name is empty where none is given."""
    found = re.match(r"(.+?\.(?:bvh|glb|gltf|fbx))(?:#(.*))?$", str(path), re.IGNORECASE | re.DOTALL)
    return (found[1], found[2] or "") if found else (str(path), "")


def clip_named(file: Path, names: Sequence[str], wanted: str) -> int:
    """Return the number of the animation that has a name; the first where none is given.

    Letters with accents are the same whether they are written as one character or as two.
    """
    names, wanted = [normalize("NFC", n) for n in names], normalize("NFC", wanted)
    if not names:
        raise InputError("an animation expected", file=file, field="animations", value="none", mend="export it with animation")
    if wanted and wanted not in names:
        raise InputError(
            "no such animation", file=file, field="animations", value=wanted,
            mend=f"write FILE#NAME with one of {', '.join(names)[:400]}",
        )  # fmt: skip
    return names.index(wanted) if wanted else 0


def first_that_moves(
    names: Sequence[str],
    candidates: Sequence[int],
    read: Callable[[int], Found],
    moves: Callable[[Found], bool],
    full: Sequence[int],
) -> tuple[int, Found, tuple[str, ...]]:
    """Return the number of the first animation among candidates that moves, what was read of it, and a note on the others.

    Where none moves, the first. `full` are those that could be chosen by name; `read` gives something empty for the others.
    """
    found = {}
    for number in candidates:
        found[number] = read(number)
        if moves(found[number]):
            break
    else:
        number = candidates[0] if candidates else 0
    others = ", ".join(names[n] for n in full if n != number)
    note = (f"its animation {names[number]} is read; FILE#NAME reads another: {others[:400]}",) if others else ()
    return number, found[number] if found else read(number), note


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names that are all different: the node's number is added to those that are empty or occur twice."""
    return tuple(n if n and names.count(n) == 1 else f"{n or 'node'}_{i}" for i, n in enumerate(names))


def rig_from(
    file: Path,
    names: Sequence[str],
    parents: np.ndarray,
    rest: np.ndarray,
    pieces: Sequence[Piece],
    turning: Sequence[int] = (),
) -> Rig:
    """Put joints and pieces together in one rest pose, the one in which the skin was bound.

    Joints rest where the inverse bind matrices say, and not where the nodes stand: only from there do the joints' movements
    give the skin as the file means it. Nodes may stand in any pose; exporters leave some frame in them. Where the bound
    character stands in the world is what the joints' nodes agree on, if they are in the bind pose; else where the file says
    that the skin was bound (FBX); else the place of the root's node, with the turn of the armature or the quarter turn that is
    nearest to the mean turn of the joints.

    The root is the lowest node above all joints that move a vertex. A root bone of the file that moves no vertex, and below
    which the pelvis moves, is no joint, nor are controls beside it.

    Args:
        file: for errors. names, parents, rest: of all nodes (N,), (N,), (N, 4, 4) node to world. pieces: each has a vertex.
        turning: nodes that turn. Where there is no piece, the joints are the nodes above, between and below these, at rest.

    Raises:
        InputError: there is neither a piece nor a node that turns, the pieces hang on several skeletons or were bound in
            several poses, weights do not sum to 1, or a matrix has no inverse.
    """
    if not pieces:
        return _rig_without_skin(file, names, parents, rest, turning)
    for piece in pieces:
        _check(file, names, piece)
    moving = {int(p.nodes[k]) for p in pieces for k in np.unique(p.owners[p.weights > 0])}
    root = lowest_common(parents, sorted(moving))
    if root < 0:
        raise InputError("one skeleton expected", file=file, field="nodes", value="several", mend="export one character")
    listed = {int(n) for p in pieces for n in p.nodes}
    joints = by_depth(parents, [n for n in listed | {root} if root in path_to_root(parents, n)])
    number = {n: j for j, n in enumerate(joints)}
    binds: dict[int, np.ndarray] = {}
    placed = []
    for piece in sorted(pieces, key=lambda p: -len(p.vertices)):
        to_world = _to_world(file, names, parents, rest, piece, binds)
        for node, inverse in zip(piece.nodes.tolist(), piece.inverse_binds, strict=True):
            if node in number:
                binds.setdefault(node, to_world @ np.linalg.inv(inverse))
        placed.append(_placed(piece, to_world, number))
    vertices, faces, weights = _joined(file, placed, len(joints))
    above = nearest_parents(parents, joints)
    used = np.array([n in moving for n in joints])
    for j in range(len(joints) - 1, 0, -1):
        used[above[j]] |= used[j]
    return Rig(
        file, np.array(joints), unique_names([names[n] for n in joints]), above, _all_binds(joints, above, rest, binds), used,
        vertices, faces, weights,
    )  # fmt: skip


def _rig_without_skin(file: Path, names: Sequence[str], parents: np.ndarray, rest: np.ndarray, turning: Sequence[int]) -> Rig:
    """Return a rig without vertices: the nodes above, between and below those that turn, bound where they rest."""
    if not len(turning):
        raise InputError("a skin, or nodes that turn, expected", file=file, field="nodes", mend="export a skinned character")
    root = lowest_common(parents, turning)
    joints = by_depth(parents, [n for n in range(len(parents)) if root in path_to_root(parents, n)])
    none = np.zeros((0, 3))
    return Rig(
        file, np.array(joints), unique_names([names[n] for n in joints]), nearest_parents(parents, joints), rest[joints],
        np.ones(len(joints), bool), none, none.astype(np.int32), none[:, :0],
    )  # fmt: skip


def _check(file: Path, names: Sequence[str], piece: Piece) -> None:
    """Raise an InputError unless weights sum to about 1 and inverse bind matrices can be inverted."""
    sums = np.maximum(piece.weights, 0).sum(axis=1)
    bad = ~(np.abs(sums - 1) < 0.1)
    if bad.any():
        v = int(bad.argmax())
        raise InputError(
            "weights that sum to 1 expected", file=file, field=f"skin, vertex {v} of the mesh", value=float(sums[v]),
            mend="normalise the skinning weights, and give every vertex to some joint",
        )  # fmt: skip
    with np.errstate(all="ignore"):
        flat = ~(np.abs(np.linalg.det(piece.inverse_binds[:, :3, :3])) > 1e-18)
    if flat.any():
        raise InputError(
            "matrices that can be inverted expected", file=file, value=piece.inverse_binds[flat.argmax()].tolist(),
            field=f"inverse bind matrix of {names[int(piece.nodes[flat.argmax()])]}", mend="export the file again",
        )  # fmt: skip


def _to_world(
    file: Path, names: Sequence[str], parents: np.ndarray, rest: np.ndarray, piece: Piece, binds: dict[int, np.ndarray]
) -> np.ndarray:
    """Return the matrix (4, 4) from the space in which a piece was bound to the world in which it stands."""
    moving = sorted(np.unique(piece.owners[piece.weights > 0]), key=lambda k: len(path_to_root(parents, int(piece.nodes[k]))))
    already = [k for k in moving if int(piece.nodes[k]) in binds]  # bound by another piece
    seen = already or moving
    worlds = np.array([binds[int(piece.nodes[k])] if already else rest[piece.nodes[k]] for k in seen])
    found = worlds @ piece.inverse_binds[seen]
    low = piece.vertices.min(axis=0)
    corners = low + np.ptp(piece.vertices, axis=0).max() * np.eye(4, 3)  # one of a cube around it, and the three beside that
    ends = np.einsum("kab,nb->kna", found[:, :3, :3], corners) + found[:, None, :3, 3]
    size = np.linalg.norm(ends[:, 1] - ends[:, 3], axis=1).max()
    apart = np.abs(ends - ends[:1]).max(axis=(1, 2))
    if apart.max() <= SAME * size:
        return found[0]
    if already:
        raise InputError(
            "one bind pose for all meshes expected", file=file, value=f"{apart.max():.3g} m apart",
            field=f"joint {names[int(piece.nodes[seen[int(apart.argmax())]])]}",
            mend="join the meshes of the character, or export one character",
        )  # fmt: skip
    if piece.bound is not None:
        return piece.bound
    share = np.bincount(piece.owners.ravel(), piece.weights.ravel(), len(piece.nodes))[moving]
    highest, armature = rest[piece.nodes[moving[0]]], int(parents[piece.nodes[moving[0]]])
    out = _upright(found, share, rest[armature] if armature >= 0 else np.eye(4))
    out[:3, 3] = highest[:3, 3] - out[:3, :3] @ np.linalg.inv(piece.inverse_binds[moving[0]])[:3, 3]
    return out


def _upright(matrices: np.ndarray, share: np.ndarray, armature: np.ndarray) -> np.ndarray:
    """Return a matrix (4, 4) from bound space to world that fits several (K, 4, 4), up to its translation.

    It has the scale of the first, and of the armature's turn and all quarter turns the one nearest to the mean turn.
    """
    left, _, right = np.linalg.svd(matrices[:, :3, :3])
    turn = np.einsum("j,jab->ab", share, left @ right)
    candidates = [q * np.sign(np.linalg.det(matrices[0, :3, :3])) for q in quarter_turns()]
    left, _, right = np.linalg.svd(armature[:3, :3])
    candidates.append(left @ right)
    out = np.eye(4)
    out[:3, :3] = max(candidates, key=lambda q: float((q * turn).sum())) * np.cbrt(abs(np.linalg.det(matrices[0, :3, :3])))
    return out


def quarter_turns() -> np.ndarray:
    """Return the 24 rotations (24, 3, 3) that take axes of coordinates to axes of coordinates, the identity first."""
    return np.round(Rotation.create_group("O").as_matrix())


def _placed(piece: Piece, to_world: np.ndarray, place: dict[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    x = piece.vertices @ to_world[:3, :3].T + to_world[:3, 3]
    faces = piece.faces if np.linalg.det(to_world[:3, :3]) > 0 else piece.faces[:, ::-1]
    number = np.array([place.get(int(n), 0) for n in piece.nodes])
    return x, faces, number[np.where(piece.weights > 0, piece.owners, 0)], piece.weights


def _joined(file: Path, bodies: list, joints: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and dense weights of all pieces; vertices at one place (to 1 um) with equal weights are merged."""
    count = sum(len(b[0]) for b in bodies)
    if count * joints * 8 > LARGEST:
        raise InputError("a smaller body expected", file=file, field="skin", value=f"{count} vertices, {joints} joints")
    starts = np.cumsum([0] + [len(b[0]) for b in bodies[:-1]])
    x = np.concatenate([b[0] for b in bodies])
    faces = np.concatenate([b[1] + s for b, s in zip(bodies, starts, strict=True)])
    weights = np.zeros((count, joints))
    for start, (_, _, owners, own) in zip(starts, bodies, strict=True):
        np.add.at(weights, (start + np.arange(len(own))[:, None], owners), np.maximum(own, 0))
    weights /= weights.sum(axis=1, keepdims=True)
    key = np.concatenate([np.round(x * 1e6), np.round(weights * 1e4)], axis=1)
    kept, number = distinct(key)
    faces = number[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    if not whole.any():
        raise InputError("triangles expected", file=file, field="skin", value="none", mend="export the character's mesh")
    return x[kept], faces[whole].astype(np.int32), weights[kept]


def _all_binds(joints: list[int], parents: np.ndarray, rest: np.ndarray, binds: dict[int, np.ndarray]) -> np.ndarray:
    """Return the bind matrices of all joints; one that no skin binds stands to its nearest bound relative as its node does."""
    found = {j: binds[n] for j, n in enumerate(joints) if n in binds}
    children = [(int(parents[j]), j) for j in range(len(joints) - 1, 0, -1)]
    for here, other in children + [(j, p) for p, j in reversed(children)]:
        if here not in found and other in found:
            found[here] = found[other] @ np.linalg.pinv(rest[joints[other]]) @ rest[joints[here]]
    return np.array([found[j] for j in range(len(joints))])


def _rest_rotations(rig: Rig) -> np.ndarray:
    """Return the rotation nearest to each bind matrix (J, 3, 3)."""
    left, _, right = np.linalg.svd(rig.binds[:, :3, :3])
    turns = left @ right
    return turns * np.sign(np.linalg.det(turns))[:, None, None]


def body_of(rig: Rig) -> BodyRecord:
    """Return the character at rest, in the pose in which its skin was bound."""
    if not len(rig.vertices):
        raise InputError("a skinned mesh expected", file=rig.file, field="skins", value="none", mend="export it with its skin")
    return BodyRecord(
        rig.vertices, rig.faces, rig.binds[:, :3, 3].copy(), rig.parents, rig.weights, rig.names, _rest_rotations(rig)
    )


def motion_of(rig: Rig, times: tuple[float, float, float], worlds: Callable[[np.ndarray], np.ndarray]) -> MotionRecord:
    """Return the motion of joints that move as a file says: local rotations since rest, in the joints' own rest frames.

    Since rest a joint has turned in the world by G_j = A_j B_j^-1, its matrix now times the inverse of its bind matrix. In its
    own frame, seen from its parent, that is R_j = Q_j^T G_parent^T G_j Q_j, where Q_j is its rest rotation. A root above the
    hips may stand still or carry a part of the path, and bones may slide a little about their mean, see `moving_root`.

    Args:
        rig: the joints. times: begin and end, s, and frames per second. worlds: gives, for times (n,) in s, the matrices
            (n, J, 4, 4) joint to world.

    Raises:
        InputError: the motion lasts an hour or more, a joint scales by more than 1 %, or a joint leaves its mean place on its
            parent by more than 1 cm and a twentieth of the bone. Joints that move no vertex may do both.
    """
    begin, end, fps = times
    count = int(np.floor((end - begin) * fps + 1e-3)) + 1 if end - begin < HOUR else 0
    if count < 1 or count * len(rig.names) * 24 > LARGEST:
        raise InputError(
            "an animation of less than an hour expected", file=rig.file, field="animations", value=f"{end - begin:.6g} s",
            mend="cut it into several",
        )  # fmt: skip
    back, turned, placed = np.linalg.pinv(rig.binds), [], []
    for first in range(0, count, BLOCK):
        at = worlds(begin + np.arange(first, min(first + BLOCK, count)) / fps)
        turned.append(_rotations(rig, (at @ back)[..., :3, :3], first))
        placed.append(at[..., :3, 3])
    world, place = np.concatenate(turned), np.concatenate(placed)
    joints, kept, notes = _settled(rig, world, place)
    rest, parents = _rest_rotations(rig)[kept], nearest_parents(rig.parents, kept)
    local = world[:, kept]
    local[:, 1:] = np.swapaxes(local[:, parents[1:]], -1, -2) @ local[:, 1:]
    own = np.swapaxes(rest, -1, -2) @ local @ rest
    poses = Rotation.from_matrix(own.reshape(-1, 3, 3)).as_rotvec().reshape(own.shape[:3])
    names = tuple(rig.names[j] for j in kept)
    return MotionRecord(poses, place[:, kept[0]] - joints[0], fps, names, joints, parents, rest_rotations=rest, notes=notes)


def _settled(rig: Rig, world: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, list[int], tuple[str, ...]]:
    """Return rest joints whose bones are as long as they are on average, the numbers of the joints that are kept, and notes.

    A bone keeps its place in the bind pose where it is within `GIVE` of it.
    """
    joints, parents = rig.binds[:, :3, 3].copy(), rig.parents
    seen = np.einsum("tjba,tjb->tja", world[:, parents[1:]], place[:, 1:] - place[:, parents[1:]])
    if not np.isfinite(place).all():
        t, j = (int(i) for i in np.argwhere(~np.isfinite(place).all(axis=-1))[0])
        where = f"animation, frame {t}, joint {rig.names[j]}"
        raise InputError("finite numbers expected", file=rig.file, field=where, mend="export it again")
    bones, bind = seen.mean(axis=0), joints[1:] - joints[parents[1:]]
    off = np.concatenate([[0.0], np.linalg.norm(seen - bones, axis=-1).max(axis=0)])
    length = np.concatenate([[0.0], np.linalg.norm(bones, axis=-1)])
    wrong = rig.used & (off > np.maximum(GIVE, SLIDE * length))
    own = np.asarray(rig.weights.any(axis=0))
    if not len(rig.weights):
        own = (np.abs(world - world[:1]) > 0.01).any(axis=(0, 2, 3)) & ~wrong
    kept = moving_root(parents, wrong, own, 0 if len(rig.weights) else SPARE)
    others = kept[1:]
    slides = np.where(rig.used & (off > GIVE), off, 0)
    notes = check_slides(rig.file, [rig.names[j] for j in others], slides[others], length[others], wrong[others])
    near = np.linalg.norm(bones - bind, axis=-1) <= GIVE
    changed = [j for j in others if rig.used[j] and not near[j - 1]]
    for j in others:
        joints[j] = joints[parents[j]] + (bones[j - 1] if j in changed else bind[j - 1])
    if changed:
        notes = (*notes, f"{len(changed)} bones are longer or shorter than in the bind pose, as {rig.names[changed[0]]}")
    if kept[0]:
        gone = ", ".join(n for j, n in enumerate(rig.names) if j not in kept)
        notes = (f"{rig.names[kept[0]]} carries the path, so it is the root; left out: {gone[:200]}", *notes)
    return joints[kept], kept, notes


def _rotations(rig: Rig, linear: np.ndarray, first: int) -> np.ndarray:
    """Return the rotations in matrices (T, J, 3, 3).

    The matrix of a used joint must be one but for rounding. For other joints what is none becomes the identity.
    """
    with np.errstate(all="ignore"):
        scale = np.cbrt(np.linalg.det(linear))
        turns = linear / scale[..., None, None]
        square = np.swapaxes(turns, -1, -2) @ turns
        bad = ~((np.abs(scale - 1) < GIVE) & (np.abs(square - np.eye(3)).max(axis=(-1, -2)) < 2 * GIVE))
        for _ in range(3):  # to the nearest rotation (Higham 1986, Newton-Schulz)
            turns = turns @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(turns, -1, -2) @ turns)
    if (bad & rig.used).any():
        t, j = (int(i) for i in np.argwhere(bad & rig.used)[0])
        raise InputError(
            "rotations without scale expected", file=rig.file, field=f"animation, frame {t + first}, joint {rig.names[j]}",
            value=f"scaled by {float(scale[t, j]):.4g}, or sheared", mend="apply scale, and animate rotations only",
        )  # fmt: skip
    return np.where(bad[..., None, None], np.eye(3), turns)

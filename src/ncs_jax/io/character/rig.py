"""A skinned character as 4 x 4 matrices, as glTF and FBX hold it, and the body made from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.hierarchy import by_depth, lowest_common, nearest_parents, path_to_root
from ncs_jax.io.mesh.weld import distinct
from ncs_jax.io.records import BodyRecord
from ncs_jax.io.tables.files import LARGEST

__all__ = [
    "MOST_NODES",
    "Piece",
    "Rig",
    "body_of",
    "quarter_turns",
    "rest_rotations",
    "rig_from",
    "together",
    "unique_names",
]

MOST_NODES = 20_000  # of a file
SAME = 1e-3  # of the size of the character: bind matrices that differ by less are the same


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles under one skin.

    Attributes:
        vertices: (V, 3) in the space where they were bound. faces: (F, 3). owners, weights: (V, K), numbers into `nodes`, and
            how much each moves the vertex. nodes: (S,) of the file. inverse_binds: (S, 4, 4) from that space to each node.
            bound: (4, 4) from that space to the world, None where the file does not say. rests: the same where the file
            tells a pose of the bones from a move of what is above them, else None. chosen: whether the triangles are
            wanted, or only what they tell of the joints. uv: (F, 3, 2) texture coordinates of the triangles' corners, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    owners: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray
    inverse_binds: np.ndarray
    bound: np.ndarray | None = None
    rests: np.ndarray | None = None
    chosen: bool = True
    uv: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Rig:
    """Joints and skin in the bind pose, in metres and Y up.

    Attributes:
        file: the path. nodes: (J,) the file's nodes that are the joints. names: their names. parents: (J,), -1 for the root.
            binds: (J, 4, 4) joint to world in the bind pose. used: (J,) whether a joint, or one below it, moves some vertex.
            vertices: (V, 3). faces: (F, 3). weights: (V, J). A file without a skin has no vertices. notes: what was mended.
            uv: (F, 3, 2) or None, as of the pieces. carrier: (3,) the place of what carries a skeleton without skin.
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
    notes: tuple[str, ...] = ()
    uv: np.ndarray | None = None
    carrier: np.ndarray | None = None


def together(uv: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Return the texture coordinates of all parts of a mesh; None where a part has none."""
    return np.concatenate([part for part in uv if part is not None]) if all(part is not None for part in uv) else None


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
    character stands in the world is what the joints' nodes agree on, unless the file tells that all of them were posed together
    (FBX, see `bound_now`); if they do not agree, where the file says that the skin was bound (FBX); else the place of the
    root's node, with the turn of the armature or the quarter turn that is nearest to the mean turn of the joints.

    Weights are divided by their sum; a vertex without follows the nearest that has some. See `_bound` for identity matrices.
    The root is the lowest node above all joints that move a vertex. A root bone of the file that moves no vertex, and below
    which the pelvis moves, is no joint, nor are controls beside it.

    Args:
        file: for errors. names, parents, rest: of all nodes (N,), (N,), (N, 4, 4) node to world. pieces: each has a vertex.
        turning: nodes that turn. Where there is no piece, the joints are the nodes above, between and below these, at rest.

    Raises:
        InputError: there is neither a piece nor a node that turns, the pieces hang on several skeletons or were bound in
            several poses, or a matrix has no inverse.
    """
    if not pieces:
        return _rig_without_skin(file, names, parents, rest, turning)
    notes: list[str] = []
    pieces = [_bound(_weighted(_checked(file, names, p), parents, notes), rest, notes) for p in pieces]
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
        if not piece.chosen and all(n in binds or n not in number for n in piece.nodes.tolist()):
            continue  # it tells nothing more
        to_world = _to_world(file, names, parents, rest, piece, binds)
        for node, inverse in zip(piece.nodes.tolist(), piece.inverse_binds, strict=True):
            if node in number:
                binds.setdefault(node, to_world @ np.linalg.inv(inverse))
        if piece.chosen:
            placed.append(_placed(piece, to_world, number))
    vertices, faces, weights, uv = _joined(file, placed, len(joints))
    above = nearest_parents(parents, joints)
    used = np.array([n in moving for n in joints])
    for j in range(len(joints) - 1, 0, -1):
        used[above[j]] |= used[j]
    return Rig(
        file, np.array(joints), unique_names([names[n] for n in joints]), above, _all_binds(joints, above, rest, binds), used,
        vertices, faces, weights, tuple(dict.fromkeys(notes)), uv,
    )  # fmt: skip


def _rig_without_skin(file: Path, names: Sequence[str], parents: np.ndarray, rest: np.ndarray, turning: Sequence[int]) -> Rig:
    """Return a rig without vertices: all below the lowest node above those that turn, at rest where they stand."""
    if not len(turning):
        raise InputError("a skin, or nodes that turn, expected", file=file, field="nodes", mend="export a skinned character")
    trees: dict[int, list[int]] = {}
    for node in turning:
        trees.setdefault(path_to_root(parents, node)[-1], []).append(node)
    root = lowest_common(parents, max(trees.values(), key=len))  # cameras and lights may turn beside the skeleton
    joints = by_depth(parents, [n for n in range(len(parents)) if root in path_to_root(parents, n)])
    none, above = np.zeros((0, 3)), int(parents[root])
    return Rig(
        file, np.array(joints), unique_names([names[n] for n in joints]), nearest_parents(parents, joints), rest[joints],
        np.ones(len(joints), bool), none, none.astype(np.int32), none[:, :0],
        carrier=rest[above, :3, 3] if above >= 0 else np.zeros(3),
    )  # fmt: skip


def _checked(file: Path, names: Sequence[str], piece: Piece) -> Piece:
    """Return a piece, after a check that its inverse bind matrices can be inverted."""
    with np.errstate(all="ignore"):
        flat = ~(np.abs(np.linalg.det(piece.inverse_binds[:, :3, :3])) > 1e-18)
    if flat.any():
        raise InputError(
            "matrices that can be inverted expected", file=file, value=piece.inverse_binds[flat.argmax()].tolist(),
            field=f"inverse bind matrix of {names[int(piece.nodes[flat.argmax()])]}", mend="export the file again",
        )  # fmt: skip
    return piece


def _weighted(piece: Piece, parents: np.ndarray, notes: list[str]) -> Piece:
    """Return a piece whose rows of weights sum to 1; one without weights follows the nearest that has some, else the top."""
    owners, weights = piece.owners, np.maximum(piece.weights, 0)
    sums = weights.sum(axis=1, keepdims=True)
    none = ~(sums[:, 0] > 1e-12)
    off = float(sums[np.abs(sums - 1).argmax(), 0]) if len(sums) else 1.0
    weights = weights / np.where(none[:, None], 1, sums)
    if none.all():
        top = min(range(len(piece.nodes)), key=lambda k: len(path_to_root(parents, int(piece.nodes[k]))))
        owners, weights = np.full((len(owners), 1), top), np.ones((len(owners), 1))
        notes.append("a mesh without skinning weights follows the first of its joints")
    elif none.any():
        from scipy.spatial import cKDTree

        near = np.flatnonzero(~none)[cKDTree(piece.vertices[~none]).query(piece.vertices[none])[1]]
        owners, weights = owners.copy(), weights.copy()
        owners[none], weights[none] = owners[near], weights[near]
        notes.append(f"{none.sum()} vertices without skinning weights follow the nearest that have some")
    elif abs(off - 1) > 0.01:
        notes.append(f"skinning weights that sum to {off:.4g} are divided by their sum")
    return replace(piece, owners=owners, weights=weights)


def _bound(piece: Piece, rest: np.ndarray, notes: list[str]) -> Piece:
    """Return a piece bound as the nodes stand, where all its inverse bind matrices are the identity and these stand elsewhere.

    Such a skin has no bind pose. The specification draws sum_j w_j M_j x, with M_j the node's matrix, and there it is bound.
    """
    worlds = rest[piece.nodes]
    eye = np.abs(piece.inverse_binds - np.eye(4)).max() < 1e-6
    if not eye or np.abs(worlds - worlds[:1]).max() < 1e-6 or (np.abs(np.linalg.det(worlds[:, :3, :3])) < 1e-18).any():
        return piece
    x = np.einsum("vk,vkab,vb->va", piece.weights, worlds[piece.owners, :3, :3], piece.vertices)
    x += np.einsum("vk,vka->va", piece.weights, worlds[piece.owners, :3, 3])
    edges = piece.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    drawn, own = (np.linalg.norm(y[edges[:, 0]] - y[edges[:, 1]], axis=1).sum() for y in (x, piece.vertices))
    if drawn > 1.2 * own * np.cbrt(np.abs(np.linalg.det(worlds[:, :3, :3])).max()):
        notes.append("the skin has no inverse bind matrices, and every viewer draws it torn apart: export it with them")
    return replace(piece, vertices=x, inverse_binds=np.linalg.inv(worlds))


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
        return found[0] if already or piece.rests is None else piece.rests
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
    axes, signs = permutations(range(3)), product((1.0, -1.0), repeat=3)
    turned = np.stack([np.eye(3)[list(order)] * sign for order, sign in product(axes, signs)])
    return turned[np.linalg.det(turned) > 0]


def _placed(piece: Piece, to_world: np.ndarray, place: dict[int, int]) -> tuple:
    """Return vertices in the world, faces, their owners among the joints and weights, and texture coordinates."""
    x = piece.vertices @ to_world[:3, :3].T + to_world[:3, 3]
    step = 1 if np.linalg.det(to_world[:3, :3]) > 0 else -1
    faces, uv = piece.faces[:, ::step], None if piece.uv is None else piece.uv[:, ::step]
    number = np.array([place.get(int(n), 0) for n in piece.nodes])
    return x, faces, number[np.where(piece.weights > 0, piece.owners, 0)], piece.weights, uv


def _joined(file: Path, bodies: list, joints: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Return vertices, faces, dense weights and texture coordinates of all pieces.

    Vertices at one place (to 1 um) with equal weights are merged.
    """
    count = sum(len(b[0]) for b in bodies)
    if count * joints * 8 > LARGEST:
        raise InputError("a smaller body expected", file=file, field="skin", value=f"{count} vertices, {joints} joints")
    starts = np.cumsum([0] + [len(b[0]) for b in bodies[:-1]])
    x = np.concatenate([b[0] for b in bodies])
    faces = np.concatenate([b[1] + s for b, s in zip(bodies, starts, strict=True)])
    weights = np.zeros((count, joints))
    for start, (_, _, owners, own, _) in zip(starts, bodies, strict=True):
        np.add.at(weights, (start + np.arange(len(own))[:, None], owners), np.maximum(own, 0))
    weights /= weights.sum(axis=1, keepdims=True)
    key = np.concatenate([np.round(x * 1e6), np.round(weights * 1e4)], axis=1)
    kept, number = distinct(key)
    faces = number[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    if not whole.any():
        raise InputError("triangles expected", file=file, field="skin", value="none", mend="export the character's mesh")
    uv = together([b[4] for b in bodies])
    return x[kept], faces[whole].astype(np.int32), weights[kept], None if uv is None else uv[whole]


def _all_binds(joints: list[int], parents: np.ndarray, rest: np.ndarray, binds: dict[int, np.ndarray]) -> np.ndarray:
    """Return the bind matrices of all joints; one that no skin binds stands to its nearest bound relative as its node does."""
    found = {j: binds[n] for j, n in enumerate(joints) if n in binds}
    children = [(int(parents[j]), j) for j in range(len(joints) - 1, 0, -1)]
    for here, other in children + [(j, p) for p, j in reversed(children)]:
        if here not in found and other in found:
            found[here] = found[other] @ np.linalg.pinv(rest[joints[other]]) @ rest[joints[here]]
    return np.array([found[j] for j in range(len(joints))])


def rest_rotations(rig: Rig) -> np.ndarray:
    """Return the rotation nearest to each bind matrix (J, 3, 3)."""
    left, _, right = np.linalg.svd(rig.binds[:, :3, :3])
    turns = left @ right
    return turns * np.sign(np.linalg.det(turns))[:, None, None]


def body_of(rig: Rig) -> BodyRecord:
    """Return the character at rest, in the pose in which its skin was bound."""
    if not len(rig.vertices):
        raise InputError("a skinned mesh expected", file=rig.file, field="skins", value="none", mend="export it with its skin")
    return BodyRecord(
        rig.vertices, rig.faces, rig.binds[:, :3, 3].copy(), rig.parents, rig.weights, rig.names, rest_rotations(rig),
        notes=rig.notes,
    )  # fmt: skip

"""Where a skin of FBX rests: as it was bound, on whatever carries its skeleton as that stands now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.character.fbx_graph import Graph
from ncs_jax.io.character.hierarchy import path_to_root
from ncs_jax.io.character.rig import SAME, quarter_turns

__all__ = ["bind_pose", "bound_now", "carriers"]

BONES = ("LimbNode", "Limb", "Root")  # kinds of models that a pose moves


def bound_now(
    graph: Graph, worlds: np.ndarray, stood: Mapping[int, np.ndarray], bones: Sequence[int], links: np.ndarray
) -> np.ndarray | None:
    """Return what carries the bind pose of a skeleton to where it rests now, (4, 4) in the world, or None.

    Bones that stand elsewhere than in the bind pose are posed: they rest as bound. What is above them, as an armature, may have
    been moved, turned or scaled after binding, and carries them along. With A its matrix now and A_bind that of the file's
    BindPose, this is A A_bind^-1; the identity where nothing is above the bones.

    It is None where the file does not say how A stood, and where what is left is no pose, since it scales or shears: then the
    file's bind pose is stale or in another space. Without a node above, a quarter turn tells the same of axes.

    Args:
        graph: the models. worlds: (N, 4, 4) of all models now, m. stood: what `bind_pose` returns. bones: (S,) models of a
            skin, of which the first moves a vertex. links: (S, 4, 4) their matrices when the skin was bound, m.
    """
    above = carriers(graph, bones)
    while above and above[0] not in stood:
        if not _alike(worlds[above[0]], worlds[above[1]] if len(above) > 1 else graph.to_metres):
            return None
        above = above[1:]
    carried = np.eye(4)
    if above:
        if any(not _alike(stood[n], m) for n, m in zip(bones, links, strict=True) if n in stood):
            return None
        carried = worlds[above[0]] @ np.linalg.pinv(stood[above[0]])
    turn = (worlds[bones[0]] @ np.linalg.pinv(carried @ links[0]))[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > SAME or np.linalg.det(turn) < 0:
        return None
    quarter = not above and any(np.abs(q - turn).max() < SAME for q in quarter_turns())
    return None if quarter and np.abs(turn - np.eye(3)).max() > SAME else carried


def carriers(graph: Graph, bones: Sequence[int]) -> list[int]:
    """Return the models that carry the skeleton of some bones, from the lowest to the top: those above its highest bone."""
    path = path_to_root(graph.parents, bones[0])
    highest = max(k for k, n in enumerate(path) if n in bones or graph.models[n].kind in BONES)
    return path[highest + 1 :]


def bind_pose(graph: Graph) -> dict[int, np.ndarray]:
    """Return the matrices to the world, m, that the file's bind poses give to models, by the models' numbers.

    What is no matrix says nothing: skins have their own.
    """
    place, found = {m.key: i for i, m in enumerate(graph.models)}, {}
    poses = [r for r in graph.objects.values() if r.name == "Pose" and r.value(2, str, "") == "BindPose"]
    for line in (line for pose in poses for line in pose.all("PoseNode")):
        node = place.get(line.first("Node").value(0, int, 0))
        with suppress(InputError):
            matrix = graph.fbx.array(line, "Matrix", "BindPose")
            if node is not None and len(matrix) == 16:
                found[node] = graph.to_metres @ matrix.reshape(4, 4).T
    return found


def _alike(first: np.ndarray, second: np.ndarray) -> bool:
    """Tell whether two matrices (4, 4) to the world differ by less than a thousandth, or a millimetre."""
    turn, place = np.abs(first - second)[:3, :3].max(), np.abs(first - second)[:3, 3].max()
    return bool(turn <= SAME * np.abs(second[:3, :3]).max() and place <= SAME * max(1.0, np.abs(second[:3, 3]).max()))

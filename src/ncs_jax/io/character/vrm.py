"""Humanoid bones of VRM 0, VRM 1 and VRM animations: which node of a glTF file is which bone, whatever the node is called."""

from __future__ import annotations

from collections.abc import Iterable

from ncs_jax.io.character.gltf import Gltf
from ncs_jax.io.character.rig import Rig

__all__ = ["humanoid_bones"]

EXTENSIONS = ("VRMC_vrm", "VRM", "VRMC_vrm_animation")


def humanoid_bones(gltf: Gltf, rig: Rig, joints: Iterable[str]) -> tuple[str, ...]:
    """Return the bone, such as "leftUpperArm", of each of a rig's joints, "" for others; none where the file names no bones.

    VRM 1 and .vrma map bones to nodes, VRM 0 lists pairs. Source: the VRM consortium's specification, humanoid.
    """
    extensions, bones = gltf.object("extensions", gltf.tree, "file"), dict[int, str]()
    for extension in EXTENSIONS:
        humanoid = gltf.object("humanoid", gltf.object(extension, extensions, "extensions"), extension)
        given, where = humanoid.get("humanBones", {}), f"{extension} humanBones"
        pairs = given.items() if isinstance(given, dict) else ((gltf.text("bone", one, where), one) for one in given)
        for bone, one in pairs:
            node = one.get("node", -1) if isinstance(one, dict) else one
            if isinstance(node, int) and node >= 0:  # Unity writes -1 for none
                bones.setdefault(node, bone)
    told = {name: bones.get(node, "") for name, node in zip(rig.names, rig.nodes.tolist(), strict=True)}
    return tuple(told[name] for name in joints) if bones else ()

"""The packaged body rigged, animated, posed and exported by Blender: `python tests/blender.py FOLDER BODY.npz`, where bpy is.

Writes hero.glb, hero.gltf with hero.bin, hero.fbx and idle.fbx (the skeleton alone), and truth.npz: `rest` (verts, 3) and
`posed` (frames, verts, 3), the skin as Blender itself moves it, m, Y up. The armature is a hundred times too small and turned,
as Mixamo's are, and its bones have rolls of their own.
"""

from __future__ import annotations

import sys
from pathlib import Path

import bpy
import numpy as np
from blender_character import UP, rigged
from mathutils import Euler

FRAMES = 25  # at 24 a second


def build(folder: Path, body: dict) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = 24, 0, FRAMES - 1
    names = [str(n) for n in body["joint_names"]]
    skin, armature = rigged(body)
    uv = skin.data.uv_layers.new().data
    uv.foreach_set("uv", np.random.default_rng(0).random(2 * len(skin.data.loops)))  # every corner a seam
    rest = posed(skin)
    animate(armature, names)
    truth = []
    for frame in range(FRAMES):
        scene.frame_set(frame)
        truth.append(posed(skin))
    np.savez(folder / "truth.npz", rest=rest, posed=np.array(truth))
    scene.frame_set(7)  # the nodes of the files stand in this pose, not in that of the bind
    bpy.ops.export_scene.gltf(filepath=str(folder / "hero.glb"), export_format="GLB", export_influence_nb=8)
    bpy.ops.export_scene.gltf(filepath=str(folder / "hero.gltf"), export_format="GLTF_SEPARATE", export_influence_nb=8)
    bpy.ops.export_scene.fbx(filepath=str(folder / "hero.fbx"), add_leaf_bones=False, bake_anim_simplify_factor=0)
    bpy.ops.object.select_all(action="DESELECT")
    armature.select_set(True)
    bpy.ops.export_scene.fbx(
        filepath=str(folder / "idle.fbx"), use_selection=True, add_leaf_bones=False, bake_anim_simplify_factor=0
    )


def animate(armature, names: list[str]) -> None:
    rng = np.random.default_rng(1)
    speed = rng.normal(scale=0.4, size=(len(names), 3))
    for frame in range(FRAMES):
        t = frame / 24
        for bone, own in zip((armature.pose.bones[n] for n in names), speed, strict=True):
            bone.rotation_mode = "QUATERNION"
            bone.rotation_quaternion = Euler(np.sin(2 * t) * own).to_quaternion()
            bone.keyframe_insert("rotation_quaternion", frame=frame)
        root = armature.pose.bones[names[0]]
        root.location = (30 * t, 5 * t * t, -10 * t)  # cm
        root.keyframe_insert("location", frame=frame)


def posed(skin) -> np.ndarray:
    """The vertices (verts, 3) as they stand now, m, Y up."""
    found = skin.evaluated_get(bpy.context.evaluated_depsgraph_get())
    x = np.empty(3 * len(found.data.vertices), np.float32)
    found.data.vertices.foreach_get("co", x)
    world = np.array(found.matrix_world)
    return (x.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]) @ UP.T


if __name__ == "__main__":
    with np.load(sys.argv[2]) as given:
        build(Path(sys.argv[1]), dict(given))

"""The packaged body rigged, animated, posed and exported by Blender: `python tests/blender.py FOLDER BODY.npz`, where bpy is.

Writes hero.glb, hero.gltf with hero.bin, hero.fbx and idle.fbx (the skeleton alone), and truth.npz: `rest` (verts, 3) and
`posed` (frames, verts, 3), the skin as Blender itself moves it, m, Y up. The armature is a hundred times too small and turned,
as Mixamo's are, and its bones have rolls of their own.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector

FRAMES = 25  # at 24 a second
UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's Z up to Y up


def build(folder: Path, body: dict) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = 24, 0, FRAMES - 1
    place = Matrix.Translation((0.3, 0.2, 0)) @ Matrix.Rotation(math.radians(90), 4, "X") @ Matrix.Scale(0.01, 4)
    inner = np.array(place.inverted())

    def inside(points):
        """Points (n, 3), m, Y up, in the armature's own space."""
        return (points @ UP) @ inner[:3, :3].T + inner[:3, 3]

    names = [str(n) for n in body["joint_names"]]
    joints = inside(body["joints"])
    armature = bpy.data.objects.new("Armature", bpy.data.armatures.new("Armature"))
    scene.collection.objects.link(armature)
    armature.matrix_world = place
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for j, name in enumerate(names):
        bone = armature.data.edit_bones.new(name)
        child = next((c for c, p in enumerate(body["parents"]) if p == j), None)
        bone.head = Vector(joints[j])
        bone.tail = Vector(joints[child] if child is not None else joints[j] + [0, 8.0, 0])
        bone.roll = 0.1 * j
        if j:
            bone.parent = armature.data.edit_bones[names[body["parents"][j]]]
    bpy.ops.object.mode_set(mode="OBJECT")
    mesh = bpy.data.meshes.new("Skin")
    mesh.from_pydata(inside(body["vertices"]).tolist(), [], body["faces"].tolist())
    mesh.uv_layers.new().data.foreach_set("uv", np.random.default_rng(0).random(2 * len(mesh.loops)))  # every corner a seam
    skin = bpy.data.objects.new("Skin", mesh)
    scene.collection.objects.link(skin)
    skin.parent = armature
    skin.modifiers.new("Armature", "ARMATURE").object = armature
    for j, name in enumerate(names):
        group = skin.vertex_groups.new(name=name)
        for v, k in np.argwhere((body["weight_joints"] == j) & (body["weights"] > 0)).tolist():
            group.add([v], float(body["weights"][v, k]), "ADD")
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

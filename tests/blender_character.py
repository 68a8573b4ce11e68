"""The packaged body on an armature in Blender, for the scripts beside it, where bpy is."""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Matrix, Vector

UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's Z up to Y up


def rigged(body: dict, unit: float = 1.0, prefix: str = ""):
    """The skin and its armature, a hundred times too small and turned, as Mixamo's are, with rolls of its own; unit in m."""
    place = Matrix.Translation((0.3, 0.2, 0)) @ Matrix.Rotation(math.radians(90), 4, "X") @ Matrix.Scale(0.01 / unit, 4)
    inner = np.array(place.inverted())
    names = [f"{prefix}{n}" for n in body["joint_names"].tolist()]
    joints, vertices = ((body[k] @ UP / unit) @ inner[:3, :3].T + inner[:3, 3] for k in ("joints", "vertices"))
    armature = bpy.data.objects.new("Armature", bpy.data.armatures.new("Armature"))
    bpy.context.scene.collection.objects.link(armature)
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
    mesh.from_pydata(vertices.tolist(), [], body["faces"].tolist())
    skin = bpy.data.objects.new("Skin", mesh)
    bpy.context.scene.collection.objects.link(skin)
    skin.parent = armature
    skin.modifiers.new("Armature", "ARMATURE").object = armature
    for j, name in enumerate(names):
        group = skin.vertex_groups.new(name=name)
        for v, k in np.argwhere((body["weight_joints"] == j) & (body["weights"] > 0)).tolist():
            group.add([v], float(body["weights"][v, k]), "ADD")
    return skin, armature

"""A tube of quads that Blender bends and exports frame by frame: `python tests/blender_frames.py FOLDER`, where bpy is.

Writes objs/, frames.usdc and truth.npz: `vertices` (frames, verts, 3) as Blender itself has them, m, Y up.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np

FRAMES = 12  # at 24 a second
UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Blender's Z up to Y up


def main(folder: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.frame_start, scene.frame_end = 24, 1, FRAMES
    bpy.ops.mesh.primitive_cylinder_add(vertices=16, radius=0.2, depth=1.0, location=(0.1, 0.2, 0.5))
    tube = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=3)
    bpy.ops.object.mode_set(mode="OBJECT")
    bend = tube.modifiers.new("bend", "SIMPLE_DEFORM")
    bend.deform_method, bend.deform_axis = "BEND", "X"
    for frame, angle in ((1, 0.0), (FRAMES, math.radians(50))):
        bend.angle = angle
        bend.keyframe_insert("angle", frame=frame)
    (folder / "objs").mkdir()
    found = []
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        made = tube.evaluated_get(bpy.context.evaluated_depsgraph_get())
        x = np.array([tube.matrix_world @ v.co for v in made.to_mesh().vertices])
        made.to_mesh_clear()
        found.append(x @ UP.T)
        bpy.ops.wm.obj_export(filepath=str(folder / "objs" / f"tube{frame}.obj"))
    bpy.ops.wm.usd_export(filepath=str(folder / "frames.usdc"), export_animation=True)
    np.savez(folder / "truth.npz", vertices=np.array(found))


if __name__ == "__main__":
    main(Path(sys.argv[-1]))

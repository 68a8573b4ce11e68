"""The add-on's actions on a character and a dress made by script: `python tests/blender_addon.py FOLDER ASSETS ZIP NCS`.

The packaged body stands on an armature that is a hundred times too small and turned, with names of bones and an action as
Mixamo's have them. The dress is an object of its own, turned, moved and half as large, with a modifier before the cloth and one
after it. Writes what Blender shows into FOLDER: truth.npz (`baked` and `live`, (frames, verts, 3), m, Y up, and what the test
looks at), and rendered.png. With --fine: a dress of 4,364 vertices and the default network, and what a frame takes.
"""

import json
import math
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
from blender_character import UP, rigged
from mathutils import Euler, Matrix, Vector

FIRST, LAST = 1, 24
UNIT = 0.5  # m
TURNS = {  # of the two actions: bone, axis, radians
    "Armature|mixamo.com|Layer0": {"LeftUpLeg": (0, 0.5), "RightUpLeg": (0, -0.5), "Spine": (1, 0.2), "LeftArm": (2, 0.3)},
    "Turn": {"Spine": (1, -0.5), "Hips": (1, 0.4), "RightArm": (2, 0.5)},
}
OWN = """
[network]
cell = "gated"
static = [32, 32]
joint = [8]
dynamic = [16]
decoder = [32]
modes = 8
[training]
steps = 20
batch = 4
window = 5
checkpoint_every = 10
"""


def dress(file: dict):
    """The packaged dress on an object that is turned and moved, with a modifier before the cloth and one after it."""
    place = Matrix.Translation((0.1, 0.5, 0.2)) @ Matrix.Rotation(0.4, 4, "Z") @ Matrix.Scale(0.5, 4)
    inner = np.array(place.inverted())
    mesh = bpy.data.meshes.new("Dress")
    x = (file["vertices"] @ UP / UNIT) @ inner[:3, :3].T + inner[:3, 3]
    mesh.from_pydata(x.tolist(), [], file["faces"].tolist())
    mesh.uv_layers.new().data.foreach_set("uv", np.random.default_rng(0).random(2 * len(mesh.loops)))
    garment = bpy.data.objects.new("Dress", mesh)
    bpy.context.scene.collection.objects.link(garment)
    garment.matrix_world = place
    garment.modifiers.new("Weld", "WELD").merge_threshold = 1e-7
    garment.modifiers.new("Subdivision", "SUBSURF").levels = 0
    return garment


def actions(armature) -> None:
    """Two actions: one whose name no file can have, and one with a way of the root."""
    armature.animation_data_create()
    for name, turns in TURNS.items():
        armature.animation_data.action = bpy.data.actions.new(name)
        for frame in range(FIRST, LAST + 1):
            t = (frame - FIRST) / 24
            for bone, (axis, angle) in turns.items():
                posed = armature.pose.bones[f"mixamorig:{bone}"]
                posed.rotation_mode = "QUATERNION"
                turn = [0.0, 0.0, 0.0]
                turn[axis] = angle * math.sin(2 * math.pi * t)
                posed.rotation_quaternion = Euler(turn).to_quaternion()
                posed.keyframe_insert("rotation_quaternion", frame=frame)
            root = armature.pose.bones["mixamorig:Hips"]
            root.location = (20 * t, 0, 30 * t)  # cm
            root.keyframe_insert("location", frame=frame)


def shown(thing) -> np.ndarray:
    """The vertices (verts, 3) of an object as Blender shows it now, m, Y up."""
    found = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = found.to_mesh()
    x = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", x)
    found.to_mesh_clear()
    world = np.array(found.matrix_world)
    return (x.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]) @ UP.T * UNIT


def played(thing) -> np.ndarray:
    """The same over the scene's frames."""
    out = []
    for frame in range(FIRST, LAST + 1):
        bpy.context.scene.frame_set(frame)
        out.append(shown(thing))
    return np.array(out)


def rendered(file: Path) -> None:
    """Render the scene as it is, from ahead and a little aside."""
    scene = bpy.context.scene
    camera, light = bpy.data.cameras.new("Camera"), bpy.data.lights.new("Sun", "SUN")
    eye, lamp = bpy.data.objects.new("Camera", camera), bpy.data.objects.new("Sun", light)
    for thing in (eye, lamp):
        scene.collection.objects.link(thing)
    eye.location = Vector((1.8, -3.2, 1.3)) / UNIT
    eye.rotation_euler = (Vector((0, 0, 0.9)) / UNIT - eye.location).to_track_quat("-Z", "Y").to_euler()
    lamp.rotation_euler, light.energy = (0.6, 0.3, 0.2), 3
    for name, colour in (("Skin", (0.7, 0.5, 0.4, 1)), ("Dress", (0.1, 0.25, 0.6, 1))):
        material = bpy.data.materials.new(name)
        material.diffuse_color = colour
        material.use_nodes = True
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = colour
        bpy.data.objects[name].data.materials.append(material)
    scene.camera, scene.render.filepath = eye, str(file)
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 8, "CPU"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.threads_mode, scene.render.threads = 360, 480, "FIXED", 1
    bpy.ops.render.render(write_still=True)


def enabled(packed: str, command: str):
    """Install the zip as a user does, and name the command; return the preferences."""
    bpy.ops.extensions.package_install_files(filepath=packed, repo="user_default", enable_on_install=True)
    own = bpy.context.preferences.addons["bl_ext.user_default.ncs_cloth"].preferences
    own.command = command
    return own


def refusal(operator) -> str:
    """What an operator says as it refuses."""
    try:
        operator()
    except RuntimeError as error:
        return str(error)
    return ""


def ticked(operator) -> tuple[float, str]:
    """Begin as with a window, and let the timer tick; return the longest tick in seconds, and what the task says."""
    from bl_ext.user_default.ncs_cloth import tasks

    longest, tasks.WAITS = 0.0, False
    operator()
    bpy.app.timers.unregister(tasks._tick)
    stopped = False
    while tasks.busy():
        began = time.monotonic()
        tasks._tick()
        longest = max(longest, time.monotonic() - began)
        said = drawn()
        assert "Cancel" in said or not tasks.busy()
        if not stopped and tasks.current.text.startswith("step "):  # a training: cancel it
            stopped = bpy.ops.ncs.cancel() == {"FINISHED"}
        time.sleep(0.05)
    tasks.WAITS = True
    return longest, tasks.current.text


class Layout:
    """Stands for the layout of a panel: refuses what Blender does not have, and keeps what it shows."""

    icons = frozenset(bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys())

    def __init__(self, shown=None):
        self.shown = [] if shown is None else shown

    def inner(self, align=False):
        return Layout(self.shown)

    row = column = inner

    def prop(self, data, name, text="", toggle=False, icon="NONE"):
        assert name in data.bl_rna.properties and icon in self.icons
        self.shown.append(data.bl_rna.properties[name].name)

    def prop_search(self, data, name, other, names):
        assert name in data.bl_rna.properties and names in other.bl_rna.properties

    def operator(self, name, text="", icon="NONE", depress=False):
        room, word = name.split(".")
        self.shown.append(getattr(getattr(bpy.ops, room), word).get_rna_type().name)
        assert icon in self.icons

    def label(self, text, icon="NONE"):
        assert icon in self.icons
        self.shown.append(text)

    def progress(self, factor, text):
        assert 0 <= factor <= 1
        self.shown.append(text)

    def template_list(self, kind, name, data, items, active, chosen, rows):
        assert hasattr(bpy.types, kind) and {items, chosen} <= set(data.bl_rna.properties.keys()) and active == data


def drawn() -> str:
    """What the panel and the preferences show."""
    from bl_ext.user_default.ncs_cloth import panel

    real = panel.preferences(bpy.context)
    own = SimpleNamespace(layout=Layout(), command=real.command, bl_rna=real.bl_rna)
    own.draw_state = partial(panel.NCS_PT_panel.draw_state, own)
    panel.NCS_PT_panel.draw(own, bpy.context)
    panel.NCS_UL_actions.draw_item(own, bpy.context, own.layout, None, bpy.context.scene.ncs.actions[0], 0, None, "")
    panel.NCS_Preferences.draw(own, bpy.context)
    return "\n".join(own.layout.shown)


def refusals(own, skin, armature) -> dict[str, str]:
    """What is said of what cannot be used; everything is then as it was."""
    said = {}
    own.character = None
    said["nothing"] = refusal(bpy.ops.ncs.check)
    own.character = skin
    skin.modifiers["Armature"].use_deform_preserve_volume = True
    said["volume"] = refusal(bpy.ops.ncs.check)
    skin.modifiers["Armature"].use_deform_preserve_volume = False
    own.pins = "waist"
    said["pins"] = refusal(bpy.ops.ncs.check)
    own.pins = ""
    said["untrained"] = refusal(bpy.ops.ncs.bake) + refusal(bpy.ops.ncs.live)
    spine = armature.pose.bones["mixamorig:Spine"]
    grown = spine.constraints.new("LIMIT_SCALE")
    grown.use_min_x, grown.min_x = True, 1.5
    said["scale"] = refusal(bpy.ops.ncs.train)
    spine.constraints.remove(grown)
    return said


def speed(rounds: int = 5) -> float:
    """Milliseconds that Blender takes for a frame of the scene."""
    bpy.context.scene.frame_set(FIRST)
    began = time.monotonic()
    for _ in range(rounds):
        for frame in range(FIRST, LAST + 1):
            bpy.context.scene.frame_set(frame)
    return 1000 * (time.monotonic() - began) / rounds / (LAST + 1 - FIRST)


def bake_keys(garment, found: dict, work: Path) -> None:
    """Bake as shape keys, with all that can go wrong with them, and as a cache again."""
    own, fresh = bpy.context.scene.ncs, (work / "scene" / "garment.npz").read_bytes()
    own.bake_as = "KEYS"
    mirror = garment.modifiers.new("Mirror", "MIRROR")
    garment.modifiers.move(garment.modifiers.find("Mirror"), 0)
    found["more"] = refusal(bpy.ops.ncs.bake)
    garment.modifiers.remove(mirror)
    garment.shape_key_add(name="Basis")
    other = garment.shape_key_add(name="Wide")
    found["keys_of_its_own"] = refusal(bpy.ops.ncs.bake)
    garment.shape_key_remove(other)
    for _ in range(2):
        assert bpy.ops.ncs.bake() == {"FINISHED"}
    found["keys"], found["blocks"] = played(garment), [k.name for k in garment.data.shape_keys.key_blocks]
    found["keyed_modifiers"] = [m.type for m in garment.modifiers]
    assert bpy.ops.ncs.check() == {"FINISHED"}
    assert (work / "scene" / "garment.npz").read_bytes() == fresh  # at rest, whatever the keys say
    own.bake_as = "CACHE"
    assert bpy.ops.ncs.bake() == {"FINISHED"}
    found["again"], found["blocks_again"] = played(garment), len(garment.data.shape_keys.key_blocks)


def main(folder: Path, assets: Path, packed: str, command: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    preferences = enabled(packed, command)
    fine = "--fine" in sys.argv
    with np.load(assets / "body.npz") as body, np.load(assets / ("dress_fine.npz" if fine else "dress.npz")) as file:
        skin, armature = rigged(dict(body), UNIT, "mixamorig:")
        garment = dress(dict(file))
    actions(armature)
    scene, found = bpy.context.scene, dict[str, Any]()
    scene.render.fps, scene.frame_start, scene.frame_end, scene.unit_settings.scale_length = 30, FIRST, LAST, UNIT
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "hero.blend"))
    (work := folder / "hero_ncs").mkdir()
    (work / "own.toml").write_text("" if fine else OWN)
    own = scene.ncs
    own.garment, own.character, own.minutes, own.alpha = garment, skin, 0.5 if fine else 0.05, 1.25
    for action in bpy.data.actions:
        own.actions.add().action = action
    found["refusals"] = json.dumps(refusals(own, skin, armature))
    before = armature.animation_data.action.name, scene.frame_current
    for name in ("check", "fit", "train", "resume", "bake"):
        assert getattr(bpy.ops.ncs, name)() == {"FINISHED"}, name
    assert before == (armature.animation_data.action.name, scene.frame_current)
    found["baked"] = played(garment)
    scene.frame_set(LAST // 2)
    rendered(folder / "rendered.png")
    bpy.ops.ncs.live()
    live = bpy.data.objects["Dress live"]
    found["live"], found["hidden"], found["ms"] = played(live), garment.hide_get(), speed()
    armature.animation_data.action = bpy.data.actions[next(iter(TURNS))]
    for bone in armature.pose.bones:  # as the action was trained on: bones without keys are at rest
        bone.matrix_basis = Matrix()
    found["other"] = played(live)
    if fine:
        bpy.ops.ncs.live()
        print(f"{len(garment.data.vertices)} vertices: {found['ms']:.1f} ms a frame live, {speed():.1f} without")
        return
    own.alpha = 0.0
    bpy.context.view_layer.update()
    found["static"] = shown(live)
    posed = armature.pose.bones["mixamorig:LeftUpLeg"]
    posed.rotation_quaternion = Euler((0.8, 0, 0)).to_quaternion()
    bpy.context.view_layer.update()
    found["by_hand"] = shown(live)
    for frame, alpha in ((FIRST, 0.0), (LAST, 2.0)):
        own.alpha = alpha
        own.keyframe_insert("alpha", frame=frame)
    found["keyed_live"] = played(live)
    bpy.ops.ncs.bake()
    found["keyed_baked"], found["gone"] = played(garment), "Dress live" not in bpy.data.objects
    found["modifiers"] = [m.type for m in garment.modifiers]
    bake_keys(garment, found, work)
    found["texts"], found["images"] = [t.name for t in bpy.data.texts], [i.name for i in bpy.data.images]
    own.minutes = 5
    for name in ("check", "train"):
        found[f"{name}_tick"], found[f"{name}_said"] = ticked(getattr(bpy.ops.ncs, name))
    found["drawn"] = drawn()
    preferences.command, preferences.source = "", str(folder / "ncs_jax-0.0.1-py3-none-any.whl")
    found["lost"] = refusal(bpy.ops.ncs.check)
    bpy.ops.ncs.install()
    found["installed"] = refusal(bpy.ops.ncs.check)
    np.savez(folder / "truth.npz", **found)
    bpy.ops.wm.save_mainfile()
    bpy.ops.preferences.addon_disable(module="bl_ext.user_default.ncs_cloth")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4])

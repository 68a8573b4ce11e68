"""What is chosen in a scene, and where files and the package are."""

import tempfile
from pathlib import Path

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from .export import Names
from .pose import Wrong
from .process import find_command

PACKAGE = __package__
RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (5, 0) else set()  # 4.5 takes // without a word
SOURCE = "ncs-jax"  # what pip installs, unless the preferences say otherwise


class NCS_Action(bpy.types.PropertyGroup):
    """An action to train on."""

    action: PointerProperty(type=bpy.types.Action, name="Action")


class NCS_Settings(bpy.types.PropertyGroup):
    """What is chosen in a scene."""

    garment: PointerProperty(
        type=bpy.types.Object, name="Garment", description="Mesh that is worn, as it lies on the character in its rest pose",
        poll=lambda self, thing: thing.type == "MESH",
    )  # fmt: skip
    character: PointerProperty(
        type=bpy.types.Object, name="Character", description="Mesh with an Armature modifier",
        poll=lambda self, thing: thing.type == "MESH" and any(m.type == "ARMATURE" for m in thing.modifiers),
    )  # fmt: skip
    pins: StringProperty(name="Pins", description="Vertex group of the garment that is held to the body, as a waistband")
    actions: CollectionProperty(type=NCS_Action)
    chosen: IntProperty(name="Chosen action")
    find_place: BoolProperty(name="Find its place", description="Let Fit look for the garment's unit, axes and place")
    options: StringProperty(name="Options", description="Options of ncs fit that say where it is, as it prints them")
    minutes: FloatProperty(
        name="Minutes", description="How long to train, from the first step on", default=10, min=0.05, soft_max=240
    )
    alpha: FloatProperty(
        name="Alpha", description="How much the garment moves: 0 static, 1 as trained, more exaggerates",
        default=1.0, min=0.0, max=10.0, soft_max=2.0, options={"ANIMATABLE"},
        update=lambda self, context: self.id_data.update_tag(),  # or Blender would evaluate the last one
    )  # fmt: skip
    bake_as: EnumProperty(
        name="Bake as", description="How the garment keeps its frames", default="CACHE",
        items=(
            ("CACHE", "Mesh Cache", "A modifier that reads a file: any number of frames"),
            ("KEYS", "Shape Keys", "In the mesh itself, a key a frame: for exporters and other programs"),
        ),
    )  # fmt: skip
    folder: StringProperty(
        name="Folder", description="Where files are written; empty: beside the .blend", subtype="DIR_PATH", options=RELATIVE
    )
    trained: StringProperty(name="Trained", description="Folder, within that, of the training that is baked and live")


class NCS_Preferences(bpy.types.AddonPreferences):
    """Where the package is."""

    bl_idname = PACKAGE
    command: StringProperty(
        name="ncs or Python",
        description="The ncs command, a Python that has ncs-jax, or its environment's folder",
        subtype="FILE_PATH",
    )
    source: StringProperty(
        name="To install", description="What pip installs: a name, a folder, a file or an address", default=SOURCE
    )

    def draw(self, context) -> None:
        """Draw them."""
        self.layout.prop(self, "command")
        self.layout.label(text=found_text(self), icon="CHECKMARK" if command(self) else "ERROR")
        self.layout.prop(self, "source")
        self.layout.operator("ncs.install")


def preferences(context):
    """Return the add-on's preferences."""
    return context.preferences.addons[PACKAGE].preferences


def own_environment() -> Path:
    """Return the folder of the add-on's own environment, which may not be there."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path="environment"))
    except ValueError:  # installed as a plain add-on
        return Path(bpy.utils.user_resource("DATAFILES"), "ncs_environment")


def command(own) -> list[str]:
    """Return how to call the package, empty where it is not found."""
    return find_command(bpy.path.abspath(own.command) if own.command else "", own_environment())


def found_text(own) -> str:
    """Return where the package is, or what to do."""
    there = command(own)
    if there:
        return f"Found: {' '.join(there)}"
    return f"Nothing at {own.command}" if own.command else "ncs is not on PATH: name it here, or install it"


def needed_command(context) -> list[str]:
    """Return how to call the package, or say that it is not there."""
    own = preferences(context)
    there = command(own)
    if not there:
        raise Wrong(f"{found_text(own)} (in the preferences of the add-on)")
    return there


def work_folder(context) -> Path:
    """Return the folder for the scene's files: the one chosen, else one beside the .blend, else a temporary one; keep it."""
    own, file = context.scene.ncs, bpy.data.filepath
    if not own.folder:
        own.folder = f"//{Path(file).stem}_ncs/" if file else tempfile.mkdtemp(prefix="ncs_")
    folder = Path(bpy.path.abspath(own.folder))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def actions_of(context, names: Names) -> list[str]:
    """Return the names of the actions to train on: those listed, else the armature's own, if it has one."""
    listed = [entry.action.name for entry in context.scene.ncs.actions if entry.action]
    data = names.of("armature").animation_data
    if not listed and data is not None and data.action is not None:
        listed = [data.action.name]
    return list(dict.fromkeys(listed))


def needed_actions(context, names: Names) -> list[str]:
    """Return the names of the actions to train on, of which there must be one."""
    found = actions_of(context, names)
    if not found:
        raise Wrong(f"{names.armature} has no action: give it one, or add some in the panel")
    return found


def trained_folder(context) -> Path:
    """Return the folder of the scene's training, after a check that there is one."""
    own = context.scene.ncs
    if not own.trained or not (work_folder(context) / own.trained / "run" / "run.json").exists():
        raise Wrong("Train first")
    return work_folder(context) / own.trained

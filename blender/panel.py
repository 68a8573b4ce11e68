"""What is seen of the add-on: its panel, operators, settings and preferences."""

import os
import shutil
import tempfile
from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from . import commands, live, tasks
from .bake import bake
from .export import Names, chosen, export
from .pose import Wrong
from .process import find_command, install_commands, warnings
from .tasks import Command

PACKAGE = __package__
TRAIN = "Neural Cloth: Train"  # the text with what is printed
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
        default=1.0, soft_min=0.0, soft_max=2.0, options={"ANIMATABLE"},
        update=lambda self, context: self.id_data.update_tag(),  # or Blender would evaluate the last one
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


def checked(context):
    """Check the scene, and show the picture; yield what is done in between."""
    ncs, names, folder = needed_command(context), chosen(context), work_folder(context) / "scene"
    yield from export(names, folder, context.scene.ncs.pins, needed_actions(context, names))
    text = yield Command([*ncs, *commands.check()], folder, "Neural Cloth: Check")
    picture(folder / "check.png")
    risks = text.count("  at risk ")
    return f"good, but at risk: {risks}; see the text Neural Cloth: Check" if risks else "good"


def fitted(context):
    """Fit the garment: out of the skin, with the contact that keeps it so; yield what is done in between."""
    ncs, names, folder = needed_command(context), chosen(context), work_folder(context) / "scene"
    own, actions = context.scene.ncs, actions_of(context, names)
    line = [*ncs, *commands.fit(own.find_place, own.options if own.find_place else "")]
    yield from export(names, folder, own.pins, actions)
    for old in folder.glob("fitted.*"):
        old.unlink()
    try:
        yield Command(line, folder, "Neural Cloth: Fit")
    finally:  # it is drawn too where the place is refused
        picture(folder / "fitted.png")
    return "fitted; look at the picture fitted.png"


def trained(context):
    """Train a new run; yield what is done in between."""
    ncs, names, work = needed_command(context), chosen(context), work_folder(context)
    own, minutes = context.scene.ncs, context.scene.ncs.minutes
    yield from export(names, work / "scene", own.pins, needed_actions(context, names))
    number = next(n for n in range(1, 10_000) if not (work / f"trained_{n}").exists())
    shutil.copytree(work / "scene", work / f"trained_{number}")
    names.scene_now().ncs.trained = f"trained_{number}"
    told = yield Command([*ncs, *commands.train(minutes, False)], work / f"trained_{number}", TRAIN)
    return "; ".join([f"trained_{number}", *warnings(told)])


def resumed(context):
    """Go on with the run; yield what is done in between."""
    ncs, folder = needed_command(context), trained_folder(context)
    told = yield Command([*ncs, *commands.train(context.scene.ncs.minutes, True)], folder, TRAIN)
    return "; ".join([folder.name, *warnings(told)])


def baked(context):
    """Bake the scene's frames; yield what is done in between."""
    ncs, names, folder = needed_command(context), chosen(context), trained_folder(context)
    return (yield from bake(names, ncs, folder))


def installed(context):
    """Make an environment of the add-on's own, and install the package there; yield what is done in between."""
    source = preferences(context).source
    own = own_environment()
    if not bpy.app.online_access and not os.path.exists(source):
        raise Wrong("Blender is offline: allow online access in Preferences > System, or name a file to install")
    own.parent.mkdir(parents=True, exist_ok=True)
    for line in install_commands(own, source):
        yield f"{own}: {' '.join(line[1:4])}"
        yield Command(line, own.parent, "Neural Cloth: Install")
    return f"installed {source} in {own}"


def picture(file: Path) -> None:
    """Load a picture that a command drew, or load it again."""
    if file.exists():
        image = bpy.data.images.get(file.name) or bpy.data.images.load(str(file))
        image.name, image.filepath = file.name, str(file)
        image.reload()


class Doing:
    """Begin a task, and report what is wrong."""

    task = None

    def execute(self, context):
        """Begin; without a window, do it all. Live ends: it hides the garment, and follows every frame."""
        live.stop()
        try:
            tasks.start(self.bl_label, type(self).task(context))
        except Wrong as wrong:
            self.report({"ERROR"}, str(wrong))
            return {"CANCELLED"}
        return {"FINISHED"}


class NCS_OT_check(Doing, bpy.types.Operator):
    """Write garment, character and actions, and say what is at risk in them"""

    bl_idname, bl_label, task = "ncs.check", "Check", checked


class NCS_OT_fit(Doing, bpy.types.Operator):
    """Push the garment out of the skin, and find the contact that keeps it there"""

    bl_idname, bl_label, task = "ncs.fit", "Fit", fitted


class NCS_OT_train(Doing, bpy.types.Operator):
    """Train the garment on the actions, in a process of its own"""

    bl_idname, bl_label, task = "ncs.train", "Train", trained


class NCS_OT_resume(Doing, bpy.types.Operator):
    """Train the same garment for as many minutes more"""

    bl_idname, bl_label, task = "ncs.resume", "Resume", resumed


class NCS_OT_bake(Doing, bpy.types.Operator):
    """Animate the scene's frames, and put them onto the garment as a Mesh Cache"""

    bl_idname, bl_label, task = "ncs.bake", "Bake", baked


class NCS_OT_install(Doing, bpy.types.Operator):
    """Make a Python environment in the add-on's own folder, and install the package there with pip: some 500 MB"""

    bl_idname, bl_label, task = "ncs.install", "Install", installed


class NCS_OT_cancel(bpy.types.Operator):
    """Stop what is under way; a training keeps what it has learned"""

    bl_idname, bl_label = "ncs.cancel", "Cancel"

    @classmethod
    def poll(cls, context) -> bool:
        """Tell whether there is something to stop."""
        return tasks.busy()

    def execute(self, context):
        """Stop it."""
        tasks.current.stop()
        return {"FINISHED"}


class NCS_OT_live(bpy.types.Operator):
    """Let the trained garment follow the character as it is shown, or end that"""

    bl_idname, bl_label = "ncs.live", "Live"

    def execute(self, context):
        """Begin, or end."""
        try:
            if live.current is not None:
                live.stop()
            else:
                live.remove_copies()
                live.start(chosen(context), needed_command(context), trained_folder(context))
        except Wrong as wrong:
            self.report({"ERROR"}, str(wrong))
            return {"CANCELLED"}
        return {"FINISHED"}


class NCS_OT_action_add(bpy.types.Operator):
    """Add the armature's action to those that are trained on"""

    bl_idname, bl_label = "ncs.action_add", "Add Action"

    def execute(self, context):
        """Add it."""
        own = context.scene.ncs
        entry = own.actions.add()
        try:
            data = chosen(context).of("armature").animation_data
            entry.action = data.action if data is not None else None
        except Wrong:  # nothing is chosen yet: the new line is empty
            entry.action = None
        own.chosen = len(own.actions) - 1
        return {"FINISHED"}


class NCS_OT_action_remove(bpy.types.Operator):
    """Take the chosen action out of the list"""

    bl_idname, bl_label = "ncs.action_remove", "Remove Action"

    def execute(self, context):
        """Take it out."""
        own = context.scene.ncs
        own.actions.remove(own.chosen)
        own.chosen = max(own.chosen - 1, 0)
        return {"FINISHED"}


class NCS_UL_actions(bpy.types.UIList):
    """Actions to train on."""

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0) -> None:
        """Draw one."""
        layout.prop(item, "action", text="", icon="ACTION")


class NCS_PT_panel(bpy.types.Panel):
    """Neural Cloth, in the sidebar of the 3D view."""

    bl_idname, bl_label, bl_category = "NCS_PT_panel", "Neural Cloth", "Neural Cloth"
    bl_space_type, bl_region_type = "VIEW_3D", "UI"

    def draw(self, context) -> None:
        """Draw it."""
        own, layout = context.scene.ncs, self.layout
        if not command(preferences(context)):
            layout.label(text=found_text(preferences(context)), icon="ERROR")
            layout.prop(preferences(context), "command", text="")
            layout.operator("ncs.install")
        column = layout.column()
        column.prop(own, "garment")
        column.prop(own, "character")
        if own.garment is not None:
            column.prop_search(own, "pins", own.garment, "vertex_groups")
        row = layout.row()
        row.template_list("NCS_UL_actions", "", own, "actions", own, "chosen", rows=2)
        buttons = row.column(align=True)
        buttons.operator("ncs.action_add", text="", icon="ADD")
        buttons.operator("ncs.action_remove", text="", icon="REMOVE")
        if not own.actions:
            layout.label(text="None listed: the armature's own action")
        column = layout.column(align=True)
        column.enabled = not tasks.busy()
        column.operator("ncs.check")
        row = column.row(align=True)
        row.operator("ncs.fit")
        row.prop(own, "find_place", toggle=True)
        if own.find_place:
            column.prop(own, "options")
        row = column.row(align=True)
        row.operator("ncs.train")
        row.operator("ncs.resume")
        row.prop(own, "minutes")
        layout.prop(own, "alpha")
        row = layout.row(align=True)
        row.enabled = not tasks.busy()
        row.operator("ncs.bake")
        row.operator("ncs.live", depress=live.current is not None)
        self.draw_state(layout)
        layout.prop(own, "trained")
        layout.prop(own, "folder")
        if own.folder and not own.folder.startswith("//") and own.folder.startswith(tempfile.gettempdir()):
            layout.label(text="A temporary folder: save the file, then choose another", icon="INFO")

    def draw_state(self, layout) -> None:
        """Draw how the task and Live are doing."""
        task = tasks.current
        if task is not None and not task.over:
            layout.progress(factor=max(task.share, 0.0), text=f"{task.name}: {task.text[:60]}")
            layout.operator("ncs.cancel", icon="X")
        elif task is not None:
            lines(layout, f"{task.name}: {task.text}", "ERROR" if task.failed else "CHECKMARK")
        if live.current is not None and live.current.text != "live":
            layout.label(text=f"Live: {live.current.text}")
        elif live.failure:
            lines(layout, f"Live ended: {live.failure}", "ERROR")


def lines(layout, text: str, icon: str) -> None:
    """Draw a long text in several lines."""
    width, words, line = 48, text.split(), ""
    box = layout.column(align=True)
    for word in [*words, ""]:
        if line and (not word or len(line) + len(word) >= width):
            box.label(text=line, icon=icon)
            line, icon = "", "BLANK1"
        line = f"{line} {word}".strip()


CLASSES = (
    NCS_Action, NCS_Settings, NCS_Preferences, NCS_OT_check, NCS_OT_fit, NCS_OT_train, NCS_OT_resume, NCS_OT_bake,
    NCS_OT_install, NCS_OT_cancel, NCS_OT_live, NCS_OT_action_add, NCS_OT_action_remove, NCS_UL_actions, NCS_PT_panel,
)  # fmt: skip


@bpy.app.handlers.persistent
def on_load(*_) -> None:
    """Another file has come: end what belongs to the last one."""
    live.stop()
    live.remove_copies()
    if tasks.busy():
        tasks.current.end()


def register() -> None:
    """Add all of it to Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.ncs = PointerProperty(type=NCS_Settings)
    bpy.app.handlers.load_post.append(on_load)


def unregister() -> None:
    """Take all of it away."""
    live.stop()
    if tasks.busy():
        tasks.current.end()
    bpy.app.handlers.load_post.remove(on_load)
    del bpy.types.Scene.ncs
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)

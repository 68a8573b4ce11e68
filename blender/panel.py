"""What is seen of the add-on: its panel and its operators."""

import tempfile

import bpy
from bpy.props import PointerProperty

from . import live, stages, tasks
from .export import chosen
from .pose import Wrong
from .settings import (
    NCS_Action,
    NCS_Preferences,
    NCS_Settings,
    command,
    found_text,
    needed_command,
    preferences,
    trained_folder,
)


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

    bl_idname, bl_label, task = "ncs.check", "Check", stages.checked


class NCS_OT_fit(Doing, bpy.types.Operator):
    """Push the garment out of the skin, and find the contact that keeps it there"""

    bl_idname, bl_label, task = "ncs.fit", "Fit", stages.fitted


class NCS_OT_train(Doing, bpy.types.Operator):
    """Train the garment on the actions, in a process of its own"""

    bl_idname, bl_label, task = "ncs.train", "Train", stages.trained


class NCS_OT_resume(Doing, bpy.types.Operator):
    """Train the same garment for as many minutes more"""

    bl_idname, bl_label, task = "ncs.resume", "Resume", stages.resumed


class NCS_OT_bake(Doing, bpy.types.Operator):
    """Animate the scene's frames, and put them onto the garment as a Mesh Cache"""

    bl_idname, bl_label, task = "ncs.bake", "Bake", stages.baked


class NCS_OT_install(Doing, bpy.types.Operator):
    """Make a Python environment in the add-on's own folder, and install the package there with pip: some 500 MB"""

    bl_idname, bl_label, task = "ncs.install", "Install", stages.installed


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
        row.prop(own, "bake_as", text="")
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

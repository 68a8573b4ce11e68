"""What the buttons do, step by step: each yields what it does, and the commands that it waits for."""

import os
import shutil
from pathlib import Path

import bpy

from . import commands
from .bake import bake
from .export import chosen, export
from .pose import Wrong
from .process import install_commands, warnings
from .settings import actions_of, needed_actions, needed_command, own_environment, preferences, trained_folder, work_folder
from .tasks import Command

TRAIN = "Neural Cloth: Train"  # the text with what is printed


def checked(context):
    """Check the scene, and show the picture; yield what is done in between."""
    ncs, names, folder = needed_command(context), chosen(context), work_folder(context) / "scene"
    yield from export(names, folder, context.scene.ncs.pins, needed_actions(context, names))
    text = yield Command([*ncs, *commands.check()], folder, "Neural Cloth: Check")
    picture(folder / "check.png")
    risks = text.count("  at risk ")
    return f"at risk: {risks}; see the text Neural Cloth: Check" if risks else "good"


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
    return (yield from bake(names, ncs, folder, context.scene.ncs.bake_as == "KEYS"))


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

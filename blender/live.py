"""The trained garment follows the character as it is shown: while playing, scrubbing, posing, and when alpha changes."""

import contextlib

import bpy
import numpy as np
from mathutils import Matrix

from .export import Names, at_rest, mesh_of, pose_now, read_skeleton, shape_modifiers
from .pose import Wrong, between, from_metres
from .tasks import redraw
from .worker import AGAIN, BEGIN, NEXT, Worker

MARK = "ncs_live"  # on the object that moves: the name of the garment that it stands for
SKIPPED = 8  # frames left out while playing or scrubbing that are filled in, at most
STILL = 1e-5  # by which a pose may change and be the same


class Live:
    """A worker, the object that shows its vertices, and the last frame.

    The garment itself is hidden and stays as it is. A copy with its materials and the modifiers that come after the cloth is
    shown in its place.
    """

    def __init__(self, names: Names, command: list[str], trained) -> None:
        """Start the worker, and show the garment at rest."""
        self.names, self.text = names, "starting"
        self._skeleton = read_skeleton(trained / "skeleton.json")
        self._frame, self._pose, self._alpha = None, None, 0.0
        self.cloth = shown_copy(names)
        self._worker = Worker(command, trained, self._skeleton)

    def ready(self) -> bool:
        """Tell whether the worker has started; show the first frame when it has."""
        if not self._worker.ready():
            return False
        if self._frame is None:
            trained, there = self._worker.vertices, len(bpy.data.objects[self.cloth].data.vertices)
            if trained != there:
                raise Wrong(f"the garment was trained with {trained} vertices and has {there}: train again")
            self.show(self.names.layer_now().depsgraph)
        return True

    def show(self, depsgraph) -> None:
        """Show the frame as it is now, if anything has changed.

        The frame after the last one goes on from it, and a gap of a few frames is filled with poses in between. Any other
        frame, and a pose that was changed by hand, has no past: there the cloth is at rest.
        """
        scene = self.names.scene_now()
        alpha = scene.evaluated_get(depsgraph).ncs.alpha
        pose = pose_now(self.names.of("armature").evaluated_get(depsgraph), self._skeleton)
        ahead = None if self._frame is None else scene.frame_current - self._frame
        same = self._pose is not None and all(np.abs(a - b).max() < STILL for a, b in zip(pose, self._pose, strict=True))
        if ahead == 0 and same and alpha == self._alpha:
            return
        if ahead == 0 and same:
            x = self._vertices(AGAIN, alpha, pose)
        elif ahead is not None and 0 < ahead <= SKIPPED:
            for pose_between in between(self._pose, pose, ahead):
                x = self._vertices(NEXT, alpha, pose_between)
        else:
            x = self._vertices(BEGIN, alpha, pose)
        self._frame, self._pose, self._alpha = scene.frame_current, pose, alpha
        mesh = bpy.data.objects[self.cloth].data
        mesh.attributes["position"].data.foreach_set("vector", from_metres(x, self._skeleton.unit).astype(np.float32).ravel())
        mesh.update()
        self.text = "live"

    def _vertices(self, kind: int, alpha: float, pose: tuple) -> np.ndarray:
        return self._worker.frame(kind, alpha, *pose)

    def close(self) -> None:
        """End the worker, and show the garment again."""
        self._worker.close()
        remove_copies()


def shown_copy(names: Names) -> str:
    """Show a copy of the garment at rest in its place, with what comes after the cloth; return its name."""
    remove_copies()
    garment = names.of("garment")
    count = shape_modifiers(garment)
    with at_rest(names, {"garment": count}), mesh_of(names, "garment"):
        thing = names.evaluated("garment")
        mesh = bpy.data.meshes.new_from_object(thing, preserve_all_data_layers=True, depsgraph=names.layer_now().depsgraph)
        mesh.transform(thing.matrix_world)
        if thing.matrix_world.determinant() < 0:
            mesh.flip_normals()
    copy = garment.copy()
    copy.name, copy.data, copy.parent = f"{garment.name} live", mesh, None
    copy.animation_data_clear()
    copy.matrix_world = Matrix()
    copy.constraints.clear()
    for k, modifier in reversed(list(enumerate(copy.modifiers))):
        if k < count or modifier.type in ("ARMATURE", "MESH_CACHE", "CLOTH"):
            copy.modifiers.remove(modifier)
    copy[MARK] = garment.name
    for collection in garment.users_collection:
        collection.objects.link(copy)
    garment["ncs_hidden"] = [garment.hide_render]
    garment.hide_set(True)
    garment.hide_render = True
    return copy.name


def remove_copies() -> None:
    """Remove all copies, and show the garments again, also those of a file that was saved while one was live."""
    for copy in [o for o in bpy.data.objects if MARK in o]:
        garment, mesh = bpy.data.objects.get(copy[MARK]), copy.data
        bpy.data.objects.remove(copy)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)
        if garment is not None and "ncs_hidden" in garment:
            garment.hide_render = bool(garment["ncs_hidden"][0])
            del garment["ncs_hidden"]
            with contextlib.suppress(RuntimeError):  # it is in no view layer any more
                garment.hide_set(False)


current: Live | None = None
failure = ""  # why it ended


def start(names: Names, command: list[str], trained) -> None:
    """Begin; without a window, wait until it is ready.

    Raises:
        Wrong: it cannot begin; or, without a window, it ended at once.
    """
    global current, failure
    stop()
    try:
        current, failure = Live(names, command, trained), ""
    except Wrong:
        remove_copies()
        raise
    bpy.app.handlers.frame_change_post.append(on_frame)
    bpy.app.handlers.depsgraph_update_post.append(on_change)
    if not bpy.app.background:
        bpy.app.timers.register(_tick, first_interval=0.2, persistent=True)
        return
    try:
        while not current.ready():
            pass
    except Wrong as wrong:
        stop()
        raise wrong


def stop() -> None:
    """End it, if it is on."""
    global current
    for handlers, own in ((bpy.app.handlers.frame_change_post, on_frame), (bpy.app.handlers.depsgraph_update_post, on_change)):
        if own in handlers:
            handlers.remove(own)
    if current is not None:
        live, current = current, None
        live.close()


def _tick() -> float | None:
    """Wait for the worker; Blender's timer calls it."""
    if current is not None and not _tried(current.ready):
        return 0.2
    redraw()
    return None


def _tried(call, *given):
    """Return what a call gives; where it fails, end Live and keep why."""
    global failure
    try:
        return call(*given)
    except (Wrong, KeyError) as wrong:  # KeyError: what it shows, or is worn by, was deleted
        failure = str(wrong) if isinstance(wrong, Wrong) else f"{wrong} is gone"
        stop()
        return True


@bpy.app.handlers.persistent
def on_frame(scene, depsgraph) -> None:
    """Show a frame that has come."""
    if current is not None and scene.name == current.names.scene and current.text != "starting":
        _tried(current.show, depsgraph)


@bpy.app.handlers.persistent
def on_change(scene, depsgraph) -> None:
    """Show what was changed within a frame."""
    if current is not None and scene.name == current.names.scene and current.text != "starting":
        _tried(current.show, depsgraph)

"""What the commands read, out of Blender: garment, character and motions as .npz, in metres with Y up."""

import contextlib
import filecmp
import json
import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from mathutils.kdtree import KDTree

from .pose import Skeleton, Wrong, to_metres
from .scene_file import OWN, file_names, write_scene

# What makes a garment's mesh when it stands before all others; the rest comes after the cloth has moved.
SHAPES = {"ARRAY", "BEVEL", "BOOLEAN", "DECIMATE", "MIRROR", "REMESH", "SCREW", "SKIN", "TRIANGULATE", "WELD"}
KEY = "Neural Cloth "  # how the names of baked shape keys begin
HELD = 0.5  # weight in the group of pins from which a vertex is held


@dataclass(frozen=True)
class Names:
    """What is chosen, by name: between two moments an undo may replace the things themselves."""

    scene: str
    layer: str
    garment: str
    character: str
    armature: str

    def scene_now(self):
        """Return the scene."""
        return bpy.data.scenes[self.scene]

    def layer_now(self):
        """Return the view layer."""
        return self.scene_now().view_layers[self.layer]

    def of(self, kind: str):
        """Return an object: "garment", "character" or "armature"."""
        return bpy.data.objects[getattr(self, kind)]

    def evaluated(self, kind: str):
        """Return an object as it is now, with all that moves it."""
        return self.of(kind).evaluated_get(self.layer_now().depsgraph)

    def unit(self) -> float:
        """Return metres for one unit of the scene."""
        units = self.scene_now().unit_settings
        return 1.0 if units.system == "NONE" else units.scale_length

    def fps(self) -> float:
        """Return frames per second of the scene."""
        render = self.scene_now().render
        return render.fps / render.fps_base


def chosen(context) -> Names:
    """Return what the panel names, after a check that it can be used."""
    own = context.scene.ncs
    for kind, words in (("garment", "a garment"), ("character", "a character")):
        thing = getattr(own, kind)
        if thing is None:
            raise Wrong(f"Choose {words} in the panel")
        if thing.name not in context.view_layer.objects or not thing.visible_get(view_layer=context.view_layer):
            raise Wrong(f"{thing.name} is hidden, or not in this scene: show it")
    if own.garment == own.character:
        raise Wrong("Garment and character are one object. Separate the garment: Edit Mode, select it, P")
    moved = next((m for m in own.character.modifiers if m.type == "ARMATURE" and m.object), None)
    if moved is None:
        raise Wrong(
            f"{own.character.name} has no Armature modifier with an armature: add one, with vertex groups for its bones"
        )
    return Names(context.scene.name, context.view_layer.name, own.garment.name, own.character.name, moved.object.name)


@contextlib.contextmanager
def at_rest(names: Names, shown: dict):
    """Hold the armature in its rest pose, and of objects only the first modifiers: `shown` says how many, by kind.

    Baked shape keys of the garment are left out.
    """
    armature = names.of("armature").data
    keys = [key for key in own_keys(names.of("garment")) if not key.mute]
    off = [m for kind, count in shown.items() for m in names.of(kind).modifiers[count:] if m.show_viewport]
    pose, armature.pose_position = armature.pose_position, "REST"
    for modifier in off:
        modifier.show_viewport = False
    for key in keys:
        key.mute = True
    try:
        names.layer_now().update()
        yield
    finally:
        armature.pose_position = pose
        for modifier in off:
            modifier.show_viewport = True
        for key in keys:
            key.mute = False
        names.layer_now().update()


def own_keys(garment) -> list:
    """Return the garment's shape keys that were baked."""
    block = garment.data.shape_keys
    return [key for key in block.key_blocks[1:] if key.name.startswith(KEY)] if block else []


def shape_modifiers(garment) -> int:
    """Count the modifiers that make the garment's mesh: those in front that are of `SHAPES`."""
    count = 0
    for modifier in garment.modifiers:
        if modifier.type not in SHAPES:
            break
        count += 1
    return count


@contextlib.contextmanager
def mesh_of(names: Names, kind: str):
    """Give the mesh of an object as it is now, its triangles and vertices in metres, Y up."""
    thing = names.of(kind)
    if thing.mode == "EDIT":
        thing.update_from_editmode()
        names.layer_now().update()
    thing = names.evaluated(kind)
    mesh = thing.to_mesh(preserve_all_data_layers=True, depsgraph=names.layer_now().depsgraph)
    try:
        mesh.calc_loop_triangles()
        faces = np.empty(3 * len(mesh.loop_triangles), np.int32)
        mesh.loop_triangles.foreach_get("vertices", faces)
        if not len(faces):
            raise Wrong(f"{thing.name} has no faces")
        yield mesh, faces.reshape(-1, 3), to_metres(placed(positions(mesh), np.array(thing.matrix_world)), names.unit())
    finally:
        thing.to_mesh_clear()


def positions(mesh) -> np.ndarray:
    """Return the vertices (V, 3) of a mesh in its own space."""
    x = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", x)
    return x.reshape(-1, 3).astype(np.float64)


def placed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return points (..., 3) after a matrix (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def write_garment(names: Names, pins: str, file: Path) -> None:
    """Write the garment at rest, with texture coordinates and pins. Where it is as it was, what was fitted to it stays."""
    thing = names.of("garment")
    with at_rest(names, {"garment": shape_modifiers(thing)}), mesh_of(names, "garment") as (mesh, faces, x):
        arrays = {"vertices": x.astype(np.float32), "faces": mirrored(faces, thing)}
        if mesh.uv_layers.active is not None:
            uv, loops = np.empty(2 * len(mesh.loops), np.float32), np.empty(faces.size, np.int32)
            mesh.uv_layers.active.data.foreach_get("uv", uv)
            mesh.loop_triangles.foreach_get("loops", loops)
            arrays["uv"] = mirrored(uv.reshape(-1, 2)[loops.reshape(-1, 3)], thing)
        if pins:
            group = thing.vertex_groups.get(pins)
            if group is None:
                raise Wrong(f"{thing.name} has no vertex group {pins}: choose the pins again")
            held = [v.index for v in mesh.vertices if any(g.group == group.index and g.weight > HELD for g in v.groups)]
            if not held:
                raise Wrong(f"no vertex of {thing.name} has a weight above {HELD} in {pins}")
            arrays["group_pins"] = np.array(held, np.int32)
    new = file.with_name("new.npz")
    np.savez(new, **arrays)
    if not file.exists() or not same(file, new):
        for old in file.parent.glob("fitted.*"):
            old.unlink()
        new.replace(file)
    else:
        new.unlink()


def same(one: Path, other: Path) -> bool:
    """Tell whether two .npz hold the same arrays."""
    if filecmp.cmp(one, other, shallow=False):
        return True
    with np.load(one) as a, np.load(other) as b:
        return set(a) == set(b) and all(np.array_equal(a[name], b[name]) for name in a)


def mirrored(faces: np.ndarray, thing) -> np.ndarray:
    """Return corners of faces (F, 3, ...) that face outward after the object's own matrix, which may mirror."""
    return faces if thing.matrix_world.determinant() > 0 else faces[:, ::-1]


def write_character(names: Names, file: Path) -> Skeleton:
    """Write the character at rest with its bones and weights; return the bones."""
    thing, armature = names.of("character"), names.of("armature")
    carried = next(k for k, m in enumerate(thing.modifiers) if m.type == "ARMATURE" and m.object)
    if thing.modifiers[carried].use_deform_preserve_volume:
        raise Wrong(
            f"{thing.name}: turn off Preserve Volume in its Armature modifier; cloth lies on skin that is blended linearly"
        )
    with at_rest(names, {"character": carried}), mesh_of(names, "character") as (mesh, faces, x):
        bones = [b.name for b in armature.data.bones if b.use_deform]
        column = {g.index: bones.index(g.name) for g in thing.vertex_groups if g.name in bones}
        weights = np.zeros((len(mesh.vertices), len(bones)))
        for vertex in mesh.vertices:
            for group in vertex.groups:
                if group.group in column:
                    weights[vertex.index, column[group.group]] += group.weight
        if not weights.any():
            raise Wrong(f"{thing.name} has no vertex group with the name of a bone of {armature.name}")
        faces = mirrored(faces, thing)
        world = np.array(names.evaluated("armature").matrix_world)
    weights = filled(weights, x)
    order, parents = joints_of(armature, [b for b, used in zip(bones, weights.any(axis=0), strict=True) if used])
    rest = np.array([world @ np.array(armature.data.bones[name].matrix_local) for name in order])
    skeleton = Skeleton(order, parents, rest, names.unit())
    blend = np.stack([weights[:, bones.index(n)] if n in bones else np.zeros(len(x)) for n in order], axis=1)
    np.savez(
        file, vertices=x.astype(np.float32), faces=faces, joints=skeleton.joints.astype(np.float32),
        parents=np.array(parents, np.int32), blend_weights=blend.astype(np.float32), joint_names=np.array(order),
    )  # fmt: skip
    return skeleton


def filled(weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return weights (V, J) that sum to 1; a vertex without any follows the nearest that has some."""
    none = weights.sum(axis=1) < 1e-6
    if none.any():
        tree = KDTree(int((~none).sum()))
        for v in np.flatnonzero(~none).tolist():
            tree.insert(x[v], v)
        tree.balance()
        weights[none] = weights[[tree.find(p)[1] for p in x[none]]]
    return weights / weights.sum(axis=1, keepdims=True)


def joints_of(armature, used: list[str]) -> tuple[list[str], list[int]]:
    """Return the bones that move skin and those between them, each after its parent, and their parents' places."""
    lines = {name: [b.name for b in (armature.data.bones[name], *armature.data.bones[name].parent_recursive)] for name in used}
    roots = {line[-1] for line in lines.values()}
    if len(roots) > 1:
        first, second = sorted(roots)[:2]
        raise Wrong(f"bones {first} and {second} of {armature.name} hang together nowhere: give them one root bone as parent")
    shared = set.intersection(*(set(line) for line in lines.values()))
    root = next(name for name in next(iter(lines.values())) if name in shared)  # the lowest above all
    wanted = {name for line in lines.values() for name in line[: line.index(root) + 1]}
    order = [root, *(b.name for b in armature.data.bones[root].children_recursive if b.name in wanted)]
    order.sort(key=lambda name: len(armature.data.bones[name].parent_recursive))
    return order, [-1, *(order.index(armature.data.bones[name].parent.name) for name in order[1:])]


def pose_now(armature, skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of an evaluated armature."""
    bones = armature.pose.bones
    missing = [name for name in skeleton.names if name not in bones]
    if missing:
        raise Wrong(f"{armature.name} has no bone {missing[0]}, which the garment was trained with: train again")
    return skeleton.pose(np.array(armature.matrix_world) @ np.array([bones[name].matrix for name in skeleton.names]))


def write_motion(file: Path, poses: list, skeleton: Skeleton, fps: float) -> None:
    """Write poses, one a frame."""
    rotations, translations = (np.array([pose[k] for pose in poses], np.float32) for k in (0, 1))
    np.savez(file, poses=rotations, trans=translations, fps=np.array(fps), joint_names=np.array(skeleton.names))


@contextlib.contextmanager
def frames_kept(names: Names):
    """Let the scene show other frames, and then its own again."""
    scene = names.scene_now()
    frame, sub = scene.frame_current, scene.frame_subframe
    try:
        yield
    finally:
        names.scene_now().frame_set(frame, subframe=sub)


@contextlib.contextmanager
def playing(names: Names, action):
    """Let an action alone move the armature; give all of it back after that.

    Bones without keys stay as they are in the action that the armature has, and are at rest in others.
    """
    armature = names.of("armature")
    data = armature.animation_data or armature.animation_data_create()
    if data.use_tweak_mode:
        raise Wrong(f"{armature.name} is in the tweak mode of its NLA strips: leave it, Tab in the NLA editor")
    before, slot, nla = data.action, data.action_slot, data.use_nla
    basis = {bone.name: bone.matrix_basis.copy() for bone in armature.pose.bones}
    data.use_nla = False
    give(data, action, slot if action == before else None)
    for bone in armature.pose.bones if action != before else ():
        bone.matrix_basis = Matrix()
    try:
        yield
    finally:
        armature = names.of("armature")
        give(armature.animation_data, before, slot)
        armature.animation_data.use_nla = nla
        for name, matrix in basis.items():
            armature.pose.bones[name].matrix_basis = matrix


def give(data, action, slot) -> None:
    """Give animation data an action with a slot, or with the first of the action's that suits it."""
    data.action = action
    if action is not None:
        data.action_slot = slot or data.action_slot or next(iter(data.action_suitable_slots), None)


def posed_frames(names: Names, skeleton: Skeleton, first: int, last: int):
    """Yield every frame of the scene's, shown, with the armature's pose in it."""
    for frame in range(first, last + 1):
        names.scene_now().frame_set(frame)
        try:
            pose = pose_now(names.evaluated("armature"), skeleton)
        except Wrong as wrong:
            raise Wrong(f"frame {frame}: {wrong}") from None
        yield frame, pose


def write_action(names: Names, action_name: str, skeleton: Skeleton, file: Path):
    """Write an action, frame by frame; yield what is done in between."""
    action = bpy.data.actions[action_name]
    first, last = math.floor(action.frame_range[0]), math.ceil(action.frame_range[1])
    poses = []
    with frames_kept(names), playing(names, action):
        try:
            for frame, pose in posed_frames(names, skeleton, first, last):
                poses.append(pose)
                yield f"reading {action_name}, frame {frame} of {last}"
        except Wrong as wrong:
            raise Wrong(f"{action_name}, {wrong}") from None
    write_motion(file, poses, skeleton, names.fps())


def export(names: Names, folder: Path, pins: str, actions: list[str]):
    """Write all that the commands read into a folder; yield what is done in between."""
    motions = folder / "motions"
    motions.mkdir(parents=True, exist_ok=True)
    yield "reading the garment"
    write_garment(names, pins, folder / "garment.npz")
    yield "reading the character"
    skeleton = write_character(names, folder / "body.npz")
    (folder / "skeleton.json").write_text(json.dumps(skeleton.facts()), encoding="utf-8")
    for old in motions.glob("*.npz"):
        old.unlink()
    for action, name in zip(actions, files := file_names(actions), strict=True):
        yield from write_action(names, action, skeleton, motions / f"{name}.npz")
    write_scene(folder, bool(pins), [f"motions/{name}.npz" for name in files], names.fps(), folder.parent / OWN)
    yield "starting"


def read_skeleton(file: Path) -> Skeleton:
    """Return the bones that a garment was trained with."""
    return Skeleton(**json.loads(file.read_text(encoding="utf-8")))

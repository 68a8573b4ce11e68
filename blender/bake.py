"""The trained garment over the scene's frames, as a Mesh Cache modifier or as shape keys."""

import contextlib
import struct
from pathlib import Path

import bpy
import numpy as np

from . import commands
from .export import (
    KEY,
    Names,
    at_rest,
    frames_kept,
    mesh_of,
    own_keys,
    posed_frames,
    read_skeleton,
    shape_modifiers,
    write_motion,
)
from .pose import Wrong, from_metres
from .process import warnings
from .tasks import Command
from .worker import BEGIN, NEXT, Worker

CACHE = "Neural Cloth"  # the modifier's name
HEADER = struct.Struct("<12siiffi")  # name, version, points, first frame, frames a sample, samples


def read_pc2(file: Path) -> np.ndarray:
    """Return the vertices (frames, verts, 3) of a .pc2."""
    data = file.read_bytes()
    _, _, points, _, _, samples = HEADER.unpack(data[: HEADER.size])
    return np.frombuffer(data, "<f4", offset=HEADER.size).reshape(samples, points, 3).astype(np.float64)


def write_pc2(file: Path, vertices: np.ndarray) -> None:
    """Write vertices (frames, verts, 3)."""
    head = HEADER.pack(b"POINTCACHE2\0", 1, vertices.shape[1], 0.0, 1.0, vertices.shape[0])
    file.write_bytes(head + np.ascontiguousarray(vertices, "<f4").tobytes())


def bake(names: Names, command: list[str], trained: Path, keys: bool = False):
    """Animate the scene's frames, and give the garment its cache, or keys; yield what is done in between.

    Both hold the garment in its own space in every frame, so its object may stand, be turned and be scaled as it likes.
    """
    scene, skeleton = names.scene_now(), read_skeleton(trained / "skeleton.json")
    first, last = scene.frame_start, scene.frame_end
    count = garment_vertices(names)
    if keys:
        check_keys(names.of("garment"), count)
    poses, places, alphas, told = [], [], [], ""
    with frames_kept(names):
        for frame, pose in posed_frames(names, skeleton, first, last):
            poses.append(pose)
            places.append(np.array(names.evaluated("garment").matrix_world))
            alphas.append(names.scene_now().evaluated_get(names.layer_now().depsgraph).ncs.alpha)
            yield f"reading frame {frame} of {last}"
    if np.ptp(alphas) < 1e-6:
        write_motion(trained / "baked.npz", poses, skeleton, names.fps())
        told = yield Command([*command, *commands.animate(alphas[0])], trained, "Neural Cloth: Bake")
        x = read_pc2(trained / "baked.pc2")
    else:
        with contextlib.closing(Worker(command, trained, skeleton)) as worker:
            while not worker.ready():
                yield "starting the garment"
            x = []
            for k, (pose, alpha) in enumerate(zip(poses, alphas, strict=True)):
                x.append(worker.frame(NEXT if k else BEGIN, alpha, *pose).astype(np.float64))
                yield f"frame {first + k} of {last}"
            x = np.array(x)
    if x.shape[:2] != (len(poses), count):
        raise Wrong(f"the garment was trained with {x.shape[1]} vertices and has {count}: train again")
    inner = np.linalg.inv(np.array(places))
    local = np.einsum("tab,tvb->tva", inner[:, :3, :3], from_metres(x, skeleton.unit)) + inner[:, None, :3, 3]
    garment = names.of("garment")
    if keys:
        give_keys(garment, local, first)
    else:
        file = trained / f"baked_{first}_{last}.pc2"
        write_pc2(file, local)
        drop_keys(garment)
        give_cache(garment, file, first)
    worn_already(garment)
    return "; ".join([f"baked frames {first} to {last}", *warnings(told)])


def garment_vertices(names: Names) -> int:
    """Return how many vertices the garment has where its cache comes."""
    with at_rest(names, {"garment": shape_modifiers(names.of("garment"))}), mesh_of(names, "garment") as (_, _, x):
        return len(x)


def give_cache(garment, file: Path, first: int) -> None:
    """Give the garment a Mesh Cache modifier behind those that make its shape, and turn off what else would move it."""
    cache = garment.modifiers.get(CACHE) or garment.modifiers.new(CACHE, "MESH_CACHE")
    garment.modifiers.move(garment.modifiers.find(cache.name), shape_modifiers(garment))
    cache.cache_format, cache.filepath = "PC2", str(file)
    if bpy.data.filepath:
        cache.filepath = bpy.path.relpath(str(file))
    cache.deform_mode, cache.interpolation, cache.factor = "OVERWRITE", "LINEAR", 1.0
    cache.time_mode, cache.play_mode, cache.frame_start, cache.frame_scale = "FRAME", "SCENE", first, 1.0
    cache.forward_axis, cache.up_axis = "POS_Y", "POS_Z"
    cache.show_viewport = cache.show_render = True


def worn_already(garment) -> None:
    """Turn off what would move the cloth again: it is on the character."""
    for modifier in garment.modifiers:
        if modifier.type in ("ARMATURE", "CLOTH"):
            modifier.show_viewport = modifier.show_render = False


def check_keys(garment, count: int) -> None:
    """Refuse a garment whose mesh can't hold the cloth as shape keys."""
    there = len(garment.data.vertices)
    if there != count:
        raise Wrong(
            f"{garment.name} has {there} vertices, and {count} after its first modifiers: apply these, or bake a Mesh Cache"
        )
    block = garment.data.shape_keys
    if block and len(block.key_blocks) - len(own_keys(garment)) > 1:
        raise Wrong(f"{garment.name} has shape keys of its own: apply or remove them, or bake a Mesh Cache")


def give_keys(garment, local: np.ndarray, first: int) -> None:
    """Give the garment a shape key for each frame, which is 1 in that frame and 0 in the others, linear in between."""
    if (cache := garment.modifiers.get(CACHE)) is not None:
        garment.modifiers.remove(cache)
    drop_keys(garment)
    if garment.data.shape_keys is None:
        garment.shape_key_add(name="Basis", from_mix=False)
    garment.data.shape_keys.use_relative = True
    edit = bpy.context.preferences.edit
    usual, edit.keyframe_new_interpolation_type = edit.keyframe_new_interpolation_type, "LINEAR"
    try:
        for k, x in enumerate(local):
            key = garment.shape_key_add(name=f"{KEY}{first + k:04}", from_mix=False)
            key.data.foreach_set("co", x.astype(np.float32).ravel())
            for frame, value in ((-1, 0.0), (1, 0.0), (0, 1.0)):
                if 0 <= k + frame < len(local):
                    key.value = value
                    key.keyframe_insert("value", frame=first + k + frame)
    finally:
        edit.keyframe_new_interpolation_type = usual
    garment.data.update()


def drop_keys(garment) -> None:
    """Remove the shape keys of an earlier bake, with what moves them."""
    if not own_keys(garment):
        return
    garment.data.shape_keys.animation_data_clear()
    for key in own_keys(garment):
        garment.shape_key_remove(key)

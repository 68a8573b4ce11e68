"""The trained garment over the scene's frames, as a Mesh Cache modifier."""

import contextlib
import struct
from pathlib import Path

import bpy
import numpy as np

from . import commands
from .export import Names, at_rest, frames_kept, mesh_of, posed_frames, read_skeleton, shape_modifiers, write_motion
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


def bake(names: Names, command: list[str], trained: Path):
    """Animate the scene's frames, and give the garment its cache; yield what is done in between.

    The cache holds the garment in its own space in every frame, so its object may stand, be turned and be scaled as it likes.
    """
    scene, skeleton = names.scene_now(), read_skeleton(trained / "skeleton.json")
    first, last = scene.frame_start, scene.frame_end
    count = garment_vertices(names)
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
    file = trained / f"baked_{first}_{last}.pc2"
    write_pc2(file, local)
    give_cache(names.of("garment"), file, first)
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
    for modifier in garment.modifiers:
        if modifier.type in ("ARMATURE", "CLOTH"):  # the cloth is on the character already
            modifier.show_viewport = modifier.show_render = False

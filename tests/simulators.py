"""Cloth on a nodding post, or in nothing, for the tests of the simulator and of what it is made of."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import local_rotations
from ncs_jax.scene.spec import load_scene, scene_from
from ncs_jax.simulation.implicit_euler import simulator_from, stepper
from ncs_jax.simulation.solver.minimise import Settings

from .scenes import grid, post, swing, write_scene
from .shapes import tube

TOLERANCE = 1e-6
SETTINGS = Settings(tolerance=TOLERANCE, iterations=400)  # one frame leaves a state that is all but unstable, in 310


@partial(jax.jit, static_argnums=1)
def advance(simulator, settings, state, rotations, translation):
    return stepper(simulator, settings).step(state, rotations, translation)


def written(folder, vertices, faces, pins=(), dtype=jnp.float64, **tables):
    """A scene of the given cloth on a post that nods."""
    path = write_scene(folder)
    np.savez(folder / "cloth.npz", vertices=vertices, faces=faces, group_pins=np.asarray(pins, np.int32))
    np.savez(folder / "body.npz", **post(rings=24, around=20))
    np.savez(folder / "swing.npz", **swing(frames=10))
    scene = load_scene(path).to_dict()
    scene["garment"]["pins"] = "pins" if len(pins) else ""
    scene["physics"].update(tables)
    return assemble(scene_from(scene), dtype=dtype)


# A sleeve round a post, its upper rim held; the post nods. Springs, for they compile fastest.
SLEEVE = tube(12, 6, 0.1, 0.25)
PHYSICS = {
    "membrane": {"model": "mass_spring"},
    "collision": {"distance": "smooth"},
    "pinning": {"stiffness": 100.0},
}


def sleeve(folder, dtype=jnp.float64, new=None, **physics):
    vertices, faces = SLEEVE
    new = np.arange(len(vertices)) if new is None else new  # vertex new[v] of the old order is vertex v
    place = np.argsort(new)
    return written(folder, vertices[new] + [0, 0.5, 0], place[faces], place[60:72], dtype, **{**PHYSICS, **physics})


def loose(folder, pins=()):
    physics = {"collision": {"stiffness": 0}, "membrane": {"model": "mass_spring"}}
    assembly = written(folder, *grid(), pins, **physics)
    motion = next(iter(assembly.motions.values()))
    return simulator_from(assembly.model), local_rotations(assembly.model, jnp.asarray(motion.poses, jnp.float64))[0]


def thrown(simulator, start, velocity=0.0):
    """A state in flight: without anything to hold it there is no static one."""
    x = jnp.asarray(start)
    state = stepper(simulator, SETTINGS).init()
    return replace(state, previous=x, before=x - velocity / simulator.model.fps, started=jnp.asarray(True))


def crumpled(simulator):
    rest = np.asarray(simulator.model.garment.mesh.rest)
    return rest * 1.1 + 5e-3 * np.random.default_rng(1).normal(size=rest.shape)


def dense(couplings, diagonal, off):
    n = len(diagonal)
    a = np.zeros((n, 3, n, 3))
    a[np.arange(n), :, np.arange(n)] = diagonal
    for (i, j), block in zip(np.asarray(couplings.pairs), np.asarray(off), strict=True):
        assert i < j and not a[i, :, j].any()  # a pair is there once
        a[i, :, j], a[j, :, i] = block, block.T
    return a.reshape(3 * n, 3 * n)

"""Scenes made ready, each once in a process, with weights, rollouts and training steps: what many tests begin with."""

from __future__ import annotations

import json
import re
import tempfile
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.network.rollout import animate
from ncs_jax.prepare.build import Assembly, features_from_records
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import load_scene, scene_from
from ncs_jax.training.batches import CHUNK, batches
from ncs_jax.training.loss import gradients
from ncs_jax.training.step import Task, chunk_runner, initial_state, windows_of

from .scenes import write_scene

STRICT = ("jax_enable_x64", "jax_numpy_rank_promotion", "jax_numpy_dtype_promotion")  # what `plain_jax` sets otherwise


def assembled(changes=(), dtype=jnp.float32) -> Assembly:
    """Return the scene of `scenes.SCENE` with fields set by their paths, such as `{"network.cell": "linear"}`."""
    settings = tuple(getattr(jax.config, name) for name in STRICT)
    return _assembled(json.dumps(dict(changes)), jnp.dtype(dtype), settings)


@cache
def _assembled(changes, dtype, settings):
    with tempfile.TemporaryDirectory() as folder:
        tables = load_scene(write_scene(Path(folder))).to_dict()
        for path, value in json.loads(changes).items():
            *parents, last = path.split(".")
            table = tables
            for name in parents:
                table = table[name]
            table[last] = value
        return assemble(scene_from(tables), dtype=dtype)


# --- networks -----------------------------------------------------------------------------------------------------------


def shaken(params, key=1):
    """Return parameters far from their start, biases and modal coefficients included."""
    rng = np.random.default_rng(key)
    return jax.tree.map(lambda p: p + jnp.asarray(0.1 * rng.normal(size=p.shape), p.dtype), params)


def ready(dtype=jnp.float64, method="ncs", cell="gated"):
    """Return the scene of a method, its shaken parameters, and its first motion."""
    changes = {"network.method": method, "network.cell": cell}
    if method == "swing":  # cloth that hangs on something
        changes = {"network.method": "ncs", "network.cell": "swing", "garment.pins": "pins", "network.vibrations": 3}
    assembly = assembled(changes, dtype)
    params = jax.tree.map(lambda p: p.astype(dtype), shaken(initial_state(assembly.model, assembly.network, 0).params))
    return assembly, params, next(iter(assembly.motions.values()))


animated = jax.jit(animate, static_argnums=1)


def run(assembly, params, motion, alpha=1.0):
    """Return the vertices (frames, verts, 3) that a network makes of a motion."""
    track = features_from_records(assembly.model, motion)
    return np.asarray(animated(assembly.model, assembly.network, params, track, alpha))


def edited(motion, poses=None, translation=None):
    """Return a motion with other poses or translations."""
    return io.MotionRecord(
        motion.poses if poses is None else poses,
        motion.translation if translation is None else translation,
        motion.fps,
        motion.joint_names,
    )


# --- training steps -----------------------------------------------------------------------------------------------------


def prepared(changes=(), dtype=jnp.float32):
    """Return an assembled scene, its training fields, and the indices of the first chunk of steps."""
    assembly = assembled(changes, dtype)
    spec = assembly.scene.training
    ends = jnp.asarray(batches(assembly.track.start.shape[0], spec.batch, 0, 0, CHUNK))
    return assembly, spec, ends, jnp.zeros_like(ends)


def one_gradient(assembly, spec, params, ends, pairs):
    """Return the gradients of a step, its energies, and what it saw."""
    return _gradient(assembly.network, spec, assembly.model, params, assembly.track, ends, pairs)


def _of_a_step(network, spec, model, params, track, ends, pairs):
    return gradients(model, network, params, track, windows_of(Task(model, network, spec), ends, pairs))


_gradient = jax.jit(_of_a_step, static_argnums=(0, 1))


def lowered(assembly, spec, ends, pairs):
    """Return the text of the program of a chunk of steps, the names of its parts included."""
    state = jax.eval_shape(lambda model: initial_state(model, assembly.network, 0), assembly.model)
    runner = chunk_runner(assembly.network, spec)
    # Plain leaves: JAX fills the containers of a lowered program's arguments with what is not an array.
    leaves, tree = jax.tree.flatten((state, ends, pairs, 10, assembly.model, assembly.track))
    return jax.jit(lambda *leaves: runner(*jax.tree.unflatten(tree, leaves))).lower(*leaves).as_text(debug_info=True)


TERMS = ("membrane", "bending", "collision", "gravity", "inertia", "pinning")


def scopes(text):
    """Return which terms a program's text names."""
    return {t for t in TERMS if re.search(rf'["/(]{t}\)?/', text)}

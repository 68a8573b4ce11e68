"""What each part of the method cannot avoid, counted from the sizes of a scene and of its parameters: no program is asked.

Arithmetic is that of the matrix products: of dense layers, forward and where a derivative is asked for backward, once for
every frame that differs; and of skinning, for weights that are not zero. What a motion fixes once, the body's poses and the
garment's blended matrices, is no work of a training step. Bytes are those of the parameters, and of the positions that one part
hands to the next, each read or written once. Between two parts nothing needs to be written, so a whole needs fewer bytes than
its parts together: a training step those of reading and writing the parameters and Adam's moments.
"""

from __future__ import annotations

import jax
import numpy as np

from benchmarks.measure import Work
from ncs_jax.geometry.skinning import Blend
from ncs_jax.prepare.build import Assembly
from ncs_jax.scene.model import Model
from ncs_jax.simulation.solver.cholesky import Elimination


def numbers(params, name: str = "") -> float:
    """Numbers in the matrices whose place in the tree holds a name."""
    leaves = jax.tree_util.tree_leaves_with_path(params)
    return float(sum(leaf.size for path, leaf in leaves if leaf.ndim == 2 and name in jax.tree_util.keystr(path)))


def weights(blend: Blend | None) -> float:
    """How many skinning weights are not zero."""
    return 0.0 if blend is None else float(np.count_nonzero(np.asarray(blend.weights)))


def training(assembly: Assembly, params, ends: np.ndarray) -> dict[str, Work]:
    """Of each part of a training step by name, of one with windows that end at `ends`."""
    model, track, length = assembly.model, assembly.track, assembly.scene.training.window
    inertia = assembly.network.loss(model.terms).inertia
    batch, history, joints = len(ends), 3 if inertia else 1, len(model.inputs)
    item = model.garment.mesh.rest.dtype.itemsize
    verts, modes = model.basis.shape
    positions = 3.0 * verts * batch
    body = 0.0 if model.body is None else 3.0 * len(model.body) * batch
    start = np.asarray(track.start)[ends]

    def frames(count):  # that differ among the last `count` of all windows
        return np.unique(np.maximum(ends[:, None] - np.arange(count), start[:, None])).size

    static, decoder = numbers(params, "static"), numbers(params, "decoder")
    products = frames(history) * static + batch * (2 * static - numbers(params, "['static']['layer_0']"))
    products += batch * ((history + 2) * decoder + (history + 1) * 3.0 * verts * modes)
    if "dynamic" in params:
        each = joints * numbers(params, "per_joint") + numbers(params, "joined") + numbers(params, "gates_in")
        products += frames(length) * (3 * each - joints * numbers(params, "per_joint_0"))  # no descriptor has a derivative
        recurring = np.minimum(ends - start, length - 1).sum()  # the first state is zero
        products += 3 * recurring * numbers(params, "recurrent")
    every = sum(leaf.size for leaf in jax.tree.leaves(params))
    skinning = Work(6 * positions * (history + 1), item * (2 * history + 2) * positions)
    posing = Work(24.0 * batch * weights(model.body_blend), item * (body + body / batch))
    network = Work(2 * products, item * (2 * every + (history + 1) * positions))
    one = Work(0, item * 2 * positions)
    per_frame = track.static[0].size + track.dynamic[0].size + track.matrices[0].size
    return {
        "step": Work(network.flops + skinning.flops, item * 6 * every),
        "network": network,
        "physics": Work(skinning.flops, item * (history + 1) * positions),
        "skinning": skinning,
        "body": posing,
        "membrane": one,
        "bending": one,
        "collision": Work(0, item * (2 * positions + body)),
        "contact query": Work(0, item * (positions + body + positions / 3)),
        "friction": Work(0, item * (4 * positions + body)),
        "gravity": one,
        "inertia": Work(0, item * 4 * positions),
        "pinning": Work(0, item * 6 * len(model.garment.pins) * batch),
        "self_contact": one,
        "optimiser": Work(0, item * 7 * every),
        "descriptors": Work(0, item * len(track.start) * (per_frame + 9 * len(model.skeleton.parents))),
    }


def inference(model: Model, params, frames: int) -> Work:
    """Of so many frames at once, of one character or of several: the parameters, as they are used, are read once for all."""
    joints, verts = len(model.inputs), len(model.garment.mesh.rest)
    products = joints * numbers(params, "per_joint") + sum(
        numbers(params, name) for name in ("static", "joined", "gates_in", "recurrent", "decoder")
    )
    moved = 3.0 * verts + 12 * len(model.skeleton.parents)
    read = sum(leaf.nbytes for leaf in jax.tree.leaves(params))
    return Work(frames * (2 * products + 24 * weights(model.blend)), read + model.basis.dtype.itemsize * frames * moved)


def factor(order: Elimination, block: int, item: int) -> tuple[Work, Work]:
    """Of one sparse Cholesky factor with `block` x `block` numbers a pair of vertices, and of one solution with it.

    A number a pair (block 1) stands for all three directions, which are solved at once.
    """
    flops = entries = 0.0
    for group in (group for level in order.levels for group in level):
        p, b = (block * np.sum(np.asarray(g) < order.verts, axis=1).astype(float) for g in (group.pivots, group.border))
        flops += float(np.sum(p**3 / 3 + p**2 * b + p * b**2))
        entries += float(np.sum(p * (p + 1) / 2 + p * b))
    return Work(flops, item * entries), Work(0, 2 * item * entries)

"""Animate with a trained network: frame by frame with explicit state, of one character or of many; or a whole motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ncs_jax.errors import InputError, shaped
from ncs_jax.geometry.skinning import Blend, forward, transforms
from ncs_jax.network.methods.method import Method, decode, for_inference, garment_blend
from ncs_jax.scene import descriptors
from ncs_jax.scene.descriptors import Joints
from ncs_jax.scene.features import MotionFeatures, input_joints
from ncs_jax.scene.model import Model, pose_garment

__all__ = ["Rollout", "StreamState", "animate", "animated", "first_broken", "stepper"]

BLOCK = 32  # garments decoded and skinned together
LOCAL = "ncs_jax.local_rotations makes them from poses"
PADDED = 64  # frames in whole blocks of which a motion is animated
LONG = 4096  # frames that are posed at once, at most


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StreamState:
    """What a stream carries from frame to frame: the recurrent code and the joints of the two frames before."""

    code: Float[Array, "*characters code"]
    previous: Joints
    before: Joints
    started: Bool[Array, "*characters"]


class Rollout(NamedTuple):
    """`init(*characters) -> state`; `step(state, rotations, translation, alpha) -> (state, vertices)`."""

    init: Callable[..., StreamState]
    step: Callable[..., tuple[StreamState, Array]]


def stepper(model: Model, network: Method, params: dict) -> Rollout:
    """Return a streaming animator: pure functions with explicit state, to be jitted by the caller.

    `step` takes one frame's local rotations (joints, 3, 3) of the model's joints (see `model.local_rotations`), the root's
    translation (3,) in m and alpha, and returns the state and the garment's vertices (verts, 3) in m. Frame for frame it gives
    what `animate` gives. Pass alpha as a float: for 1 in the place of 1.0 `jax.jit` compiles the step again.

    With a state from `init(256)` all these have a leading axis, of characters who move by themselves; alpha is one number or
    one for each. That is about twice as fast as `jax.vmap(step)`, and more for large networks: what they share is read once.
    Derivatives are those of reverse mode, `jax.grad`; forward mode, `jax.jvp`, is not defined.
    """
    rest = model.garment.mesh.rest
    network, params = for_inference(network, params, model)
    weights = garment_blend(network, params, model)
    g, joints = model.material.gravity, len(model.skeleton.parents)

    def init(*characters: int) -> StreamState:
        n, new = len(model.inputs), partial(np.zeros, dtype=rest.dtype)
        eye = np.broadcast_to(np.eye(3, dtype=rest.dtype), (*characters, n, 3, 3))
        # From the host: nothing to compile, and no two arrays are one, so that a caller may donate the state.
        previous, before = (Joints(*map(jax.device_put, (eye, eye, new((*characters, n, 3))))) for _ in range(2))
        code, started = new((*characters, network.state)), np.zeros(characters, bool)
        return StreamState(jax.device_put(code), previous, before, jax.device_put(started))

    def look(previous: Joints, before: Joints, started, rotations, translation):
        """Read one character: the joints now and before, their transforms, and the descriptors."""
        pose = forward(model.skeleton, rotations, translation)
        now = input_joints(model, rotations, pose)
        previous, before = (jax.tree.map(lambda old, new: jnp.where(started, old, new), old, now) for old in (previous, before))
        dynamic = None
        if network.state:
            dynamic = descriptors.dynamic(now, previous, before, g, 1 / model.fps, model.descriptor)
        return now, previous, transforms(model.skeleton, pose), descriptors.static(now, g, model.descriptor), dynamic

    def step(state: StreamState, rotations, translation, alpha=1.0):
        characters = state.started.shape
        if rotations.ndim != len(characters) + 3:
            mend = "begin with the state of init(number of characters), or of init() for one"
            what = f"rotations {(*characters, joints, 3, 3)} for this state"
            raise InputError(f"{what} expected", field="rotations", value=f"shape {rotations.shape}", mend=mend)
        shaped(rotations, (*characters, joints, 3, 3), "rotations", f"{joints} joints' local rotations", LOCAL)
        shaped(translation, (*characters, 3), "translation", "the root's translation (3,), m, for every character")
        every = look
        for _ in characters:
            every = jax.vmap(every)
        now, previous, matrices, static, dynamic = every(state.previous, state.before, state.started, rotations, translation)
        code, codes = network.step(params, model, state.code, static, dynamic, matrices)
        alpha = jnp.asarray(alpha, code.dtype)
        if alpha.shape not in ((), characters):
            what = f"one number, or one for every character, {characters}," if characters else "one number"
            raise InputError(f"{what} expected", field="alpha", value=f"shape {alpha.shape}", mend="see ncs_jax.stepper")
        alpha = alpha[..., None]
        x = _posed(model, network, params, weights, matrices, codes.together(alpha), codes.swung(alpha))
        return StreamState(code, now, previous, jnp.ones(characters, bool)), x

    return Rollout(init, step)


def _posed(model: Model, network: Method, params: dict, weights: Blend, matrices, z, swing) -> Float[Array, "*poses verts 3"]:
    """Vertices of the garment with codes (*poses, code) on joints (*poses, joints, 3, 4), `BLOCK` at a time, m."""
    shape, rest = matrices.shape[:-3], model.garment.mesh.rest
    matrices = matrices.reshape(-1, *matrices.shape[-3:])
    codes = tuple(None if c is None else c.reshape(-1, c.shape[-1]) for c in (z, swing))
    poses = len(matrices)
    block = min(BLOCK, poses)
    at = np.minimum(np.arange(-(-poses // block) * block), poses - 1).reshape(-1, block)  # equal poses stay equal

    def some(args):
        matrices, codes = args
        return pose_garment(model, decode(network, params, model, *codes), jnp.moveaxis(matrices, 0, -1), weights)

    # Turned at the end, outside the map: XLA would skin in that order too, ten times slower.
    x = lax.map(some, jax.tree.map(lambda a: a[at], (matrices, codes)))
    return jnp.moveaxis(x, -1, 1).reshape(-1, *rest.shape)[:poses].reshape(*shape, *rest.shape)


def animate(
    model: Model, network: Method, params: dict, track: MotionFeatures, alpha: float | Float[Array, ""] | None = 1.0
) -> Float[Array, "frames verts 3"]:
    """Return the vertices of the garment over one whole motion, m: z = z_S + alpha z_D (15), decoded and skinned (16).

    Args:
        track: of one motion, from `features.motion_features`. alpha: motion control; `None` gives the static result and traces
            nothing dynamic (alpha = 0 gives the same vertices).
    """
    if model.under:
        track = replace(track, matrices=track.matrices[:, : len(model.skeleton.parents)])
    codes, weights = network.codes(params, model, track), garment_blend(network, params, model)
    x = _posed(model, network, params, weights, track.matrices, codes.together(alpha), codes.swung(alpha))
    return track.absolute(x)


_animate = jax.jit(animate, static_argnums=1)


def animated(model: Model, network: Method, params: dict, track: MotionFeatures, alpha: float = 1.0) -> np.ndarray:
    """Return what `animate` returns, as NumPy.

    It is compiled for whole blocks of frames, so motions of many lengths share a program. A motion of more than `LONG` frames
    is posed so many at a time, and takes little more memory than its vertices.
    """
    frames = track.start.shape[0]
    padded = jax.tree.map(lambda a: jnp.pad(a, [(0, -frames % PADDED)] + [(0, 0)] * (a.ndim - 1), mode="edge"), track)
    if frames <= LONG:
        return np.asarray(_animate(model, network, params, padded, float(alpha)))[:frames]
    codes, swung = _codes(model, network, params, padded, float(alpha))
    x = np.empty((frames, *model.garment.mesh.rest.shape), model.garment.mesh.rest.dtype)
    for first in range(0, frames, LONG):
        at = np.minimum(np.arange(first, first + LONG), frames - 1)
        some = None if swung is None else swung[at]
        posed = _pose(model, network, params, track.matrices[at], codes[at], some)
        x[first : first + LONG] = posed[: frames - first]
    if track.origin is not None:
        x += np.asarray(track.origin)[:, None]
    return x


@partial(jax.jit, static_argnums=1)
def _codes(model: Model, network: Method, params: dict, track: MotionFeatures, alpha) -> tuple[Array, Array | None]:
    codes = network.codes(params, model, track)
    return codes.together(alpha), codes.swung(alpha)


@partial(jax.jit, static_argnums=1)
def _pose(model: Model, network: Method, params: dict, matrices: Array, codes: Array, swung: Array | None) -> Array:
    joints, weights = len(model.skeleton.parents), garment_blend(network, params, model)
    return _posed(model, network, params, weights, matrices[:, :joints], codes, swung)


def first_broken(model: Model, network: Method, params: dict, track: MotionFeatures, alpha: float = 1.0) -> str:
    """Find what is not finite first in a motion: the frame, what it is, and its vertex."""
    codes = network.codes(params, model, track)
    x = animate(model, network, params, track, alpha)
    stages = {
        "joint transforms": track.matrices,
        "static descriptors": track.static,
        "dynamic descriptors": track.dynamic,
        "static code": codes.static,
        "swing": codes.swing,
        "dynamic code": codes.dynamic,
        "vertices": x,
    }
    broken = {name: ~np.isfinite(np.asarray(a)) for name, a in stages.items() if a is not None}
    first = {name: int(bad.reshape(len(bad), -1).any(axis=1).argmax()) for name, bad in broken.items() if bad.any()}
    if not first:
        return "none"
    name = min(first, key=lambda n: first[n])  # of those in one frame what comes first
    entry = np.argwhere(broken[name][first[name]])[0][0]
    return f"frame {first[name]}, {name}, entry {entry}"

"""Neural cloth simulation whose dynamic code is of a swing: how the garment's own soft vibrations answer to the motion.

The swing q is what implicit Euler makes of the energy linearised about the static garment s_t that the network gives, along
the directions D of `ritz_modes.softest_ritz_modes`, carried by skinning, P_t = R_t D:

    (G_t (1 + c h) + h^2 K_t) q_t = -P_t^T M (s_t - 2 x_{t-1} + x_{t-2}) + c h G_t q_{t-1},   G_t = P_t^T M P_t,   x = s + P q

K_t is the stiffness of the pose: what a displacement along the vibrations costs when all else of the garment gives way, see
`ritz_modes.stiffness_in_poses`. Training finds it about the garment that it has learned, in some poses, and fits it to all by a
linear map of the descriptors: `stiffness`. Until then it is that about the drape, E_0 I.

and, where that is beyond the linear range, stops short of it, see `Swing.bounded`. It begins at zero, rings with the garment's
own periods, and decays; nothing of it is learned. What is learned is how the cloth goes along with a swing:

    x = skin(rest + decoder(z_S + alpha z_D(q)))

by the static energy and the inertia of what q and the cloth differ by along the vibrations, `Swing.hold`. A fresh network
swings next to nothing, and each step goes as far along as its energy pays for. As no past enters, any pose is trained with any
swing, and every step is a descent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.terms import Terms
from ncs_jax.errors import required
from ncs_jax.geometry.skinning import blend
from ncs_jax.network.encoders import SwingEncoder
from ncs_jax.network.methods.method import (
    Codes,
    Kept,
    Offsets,
    Windows,
    decode,
    descriptor_sizes,
    garment_blend,
    static_code_size,
)
from ncs_jax.network.methods.modal_mass import constants, modal_mass, pulled, rotations_of
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, RitzModes, pose_garment

__all__ = ["Swing", "as_about_the_drape", "stiffness"]

BLOCK = 32  # frames whose statics are posed together
FEW = 8  # poses of which the mass is faster by the directions in each
QUIET = 0.02  # of a track's largest swing: a smaller one is not enlarged that far

_matmul = partial(jnp.matmul, precision="highest")


@dataclass(frozen=True)
class Swing:
    """The three networks, the dynamic one of the swing. See `methods.method.Method`.

    verts, modes: how many vertices and vibrations the garment has. damping: c, 1/s. Source: none; the slides' codes that add,
    with modal dynamics (Pentland and Williams 1989) in place of a recurrent network.
    """

    static: nn.Module
    dynamic: SwingEncoder
    decoder: nn.Module
    verts: int
    modes: int
    damping: float
    learn_weights: bool = False
    controlled = True
    refreshes = True
    still = 0.5

    @property
    def state(self) -> int:
        """Return how many numbers are carried.

        They are the garment in the two frames before, measured from the root, the root, the swing, and whether there was a
        frame.
        """
        return 6 * self.verts + 3 + self.modes + 1

    def code_size(self, model: Model) -> int:
        """Return how many numbers a code has: the static encoder's."""
        return static_code_size(self.static, model)

    def init(self, keys: tuple[Array, Array], model: Model) -> dict:
        """Return fresh parameters of both encoders."""
        static, swing = jnp.zeros(descriptor_sizes(model)[0], model.basis.dtype), jnp.zeros(self.modes, model.basis.dtype)
        return {
            "static": self.static.init(keys[0], static)["params"],
            "dynamic": self.dynamic.init(keys[1], swing)["params"],
        }

    def loss(self, terms: Terms) -> Terms:
        """Return all but inertia, which is the swing's, and friction, which knows of a frame before."""
        return replace(terms, inertia=False, friction=False)

    def step(
        self, params: dict, model: Model, state: Array, static: Array, dynamic: Array | None, matrices: Array
    ) -> tuple[Array, Codes]:
        """Return z_S of the frame, the swing and its z_D. What is carried knows of no alpha."""
        shape, fixed = state.shape[:-1], self._static(params, static)
        state, matrices = state.reshape(-1, self.state).T, jnp.moveaxis(matrices.reshape(-1, *matrices.shape[-3:]), 0, -1)
        earlier, root, q, started = jnp.split(state, np.cumsum([6 * self.verts, 3, self.modes]))
        now = matrices[0, :, 3]
        matrices, weights = matrices.at[:, :, 3].add(-now[None]), garment_blend(self, params, model)
        s = pose_garment(model, decode(self, params, model, fixed.reshape(-1, fixed.shape[-1])), matrices, weights)
        previous, before = jnp.where(started[None, None] > 0, earlier.reshape(2, *s.shape) + (root - now)[None, None], s[None])
        d, transforms = _vibrations(model).directions, blend(matrices, weights)
        force = _mass(model)[:, None, None] * (s - 2 * previous + before)
        g, push = _product(d, _mass(model), transforms), pulled(d, transforms, force)
        h, k = 1 / model.fps, stiffness(_vibrations(model), static.reshape(-1, *static.shape[-2:]))
        q = self.bounded(model, _times(_inverse(self._system(model, g, k)), self.damping * h * _times(g, q) - push))
        swung = _matmul(d.reshape(-1, self.modes), q).reshape(s.shape)
        x = s + sum(transforms[:, :, i] * swung[:, i, None] for i in range(3))
        new = jnp.concatenate([a.reshape(-1, a.shape[-1]) for a in (x, previous, now, q, jnp.ones_like(started))])
        q = q.T.reshape(*shape, self.modes)
        return new.T.reshape(*shape, self.state), Codes(fixed, self._dynamic(params, q), q)

    def refresh(self, params: dict, model: Model, features: MotionFeatures) -> MotionFeatures:
        """Return the motions with the swing of every frame, which `windows` and `mixed` look up."""
        return replace(features, swing=self.swings(params, model, features))

    def codes(self, params: dict, model: Model, track: MotionFeatures) -> Codes:
        """Return the codes of every frame, without a swing at its motion's start."""
        q = self.swings(params, model, track)
        return Codes(self._static(params, track.static), self._dynamic(params, q), q)

    def swings(self, params: dict, model: Model, track: MotionFeatures) -> Float[Array, "frames modes"]:
        """Return q of every frame of motions end to end: sums over the garment, `BLOCK` frames at a time, then a recurrence."""
        frames, h = len(track.start), 1 / model.fps
        z, number = self._static(params, track.static), jnp.arange(frames, dtype=track.start.dtype)
        block = min(BLOCK, frames)
        # A block with the two frames before it, of which those before a motion's start are that start.
        seen = np.clip(np.arange(0, frames, block)[:, None] + np.arange(-2, block), 0, frames - 1)

        weights, directions, mass = garment_blend(self, params, model), _vibrations(model).directions, _mass(model)
        known = constants(directions, mass, weights)

        def sums(args):
            z, matrices, number, start, static = args
            matrices = jnp.moveaxis(matrices, 0, -1)
            s, axes = pose_garment(model, decode(self, params, model, z), matrices, weights), rotations_of(matrices, weights)
            (s, s1, s2), (r, r1, r2) = ([a[..., 2 - k : block + 2 - k] for k in range(3)] for a in (s, axes))
            one, two = ((number[2:] - k >= start[2:])[None, None] for k in (1, 2))
            s1, s2 = jnp.where(one, s1, s), jnp.where(two, s2, jnp.where(one, s1, s))
            r1, r2 = jnp.where(one, r1, 0), jnp.where(two, r2, 0)
            products = [modal_mass(known, r, past) for past in (r, r1, r2)]
            force = mass[:, None, None] * (s - 2 * s1 + s2)
            push = pulled(directions, blend(matrices[..., 2:], weights), force)
            inverse = _inverse(self._system(model, products[0], stiffness(_vibrations(model), static)))
            return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), (inverse, *products, push))

        some = lax.map(sums, (z[seen], track.matrices[seen], number[seen], track.start[seen], track.static[seen[:, 2:]]))
        inverse, g, g1, g2, push = (a.reshape(-1, *a.shape[2:])[:frames] for a in some)

        def step(swing, frame):
            previous, before = swing
            inverse, g, g1, g2, push, begins = frame
            previous, before = jnp.where(begins, 0, previous), jnp.where(begins, 0, before)
            past = self.damping * h * _matmul(g, previous) + 2 * _matmul(g1, previous) - _matmul(g2, before)
            q = self.bounded(model, _matmul(inverse, past - push))
            return (q, previous), q

        zero = jnp.zeros(self.modes, push.dtype)
        return lax.scan(step, (zero, zero), (inverse, g, g1, g2, push, number == track.start), unroll=4)[1]

    def bounded(self, model: Model, q: Float[Array, "modes *poses"]) -> Float[Array, "modes *poses"]:
        """Return a swing that is shorter where it is beyond the linear range, or beyond what was trained.

            q / (1 + n^4)^(1/4),   n^2 = q^T (S + W) q,   S_kl = mean of grad d_k : grad d_l over the garment

        q^T S q is one at r.m.s. displacement gradients of 45 degrees, q^T W q at 1.5 times the farthest that the training
        motions swing, in its own direction: a network is not asked for what no training has shown it. S + W is kept as
        `RitzModes.slope`. Half of the range is shortened by 1.5 %, and no acceleration brings a swing beyond it. It only takes
        energy away, like an inelastic stop: E_0 |q|^2 / 2 falls, and what is carried to the next frames is the shorter swing.
        """
        slope = _vibrations(model).slope
        if slope is None:
            return q
        square = jnp.sum(q * jnp.tensordot(slope, q, 1, precision="highest"), axis=0, keepdims=True)
        return q / jnp.sqrt(jnp.sqrt(1 + square * square))

    def windows(self, params: dict, track: MotionFeatures, ends: Int[Array, "batch"], length: int, last: int) -> Codes:
        """Return the codes of the last frames, time leading, whose swings the track knows."""
        back = jnp.maximum(ends[None] - jnp.arange(last - 1, -1, -1, dtype=ends.dtype)[:, None], track.start[ends][None])
        q = required(track.swing, "track.swing")[back]
        return Codes(self._static(params, track.static[back]), self._dynamic(params, q), q)

    def offsets(self, params: dict, model: Model, track: MotionFeatures, windows: Windows) -> tuple[Offsets, Kept]:
        """Return offsets of the last frames with a swing, and what they are beyond the static ones.

        The swing is the frame's own, or with motion augmentation any size of another frame's, `bounded` as those of animations
        are: what none of them can show would only cost the garment's shape.
        """
        swing, ends, others = required(track.swing, "track.swing"), windows.ends, windows.ends
        if windows.axis is not None:
            others = lax.all_gather(ends, windows.axis, tiled=True)
        at = jnp.where(windows.own, ends, others[windows.others])
        share = windows.number.astype(swing.dtype) / max(windows.augmented - 1, 1)
        other = self.bounded(model, (share * self.enlargement(track, at))[None] * swing[at].T)
        swings = windows.number < required(windows.still, "windows.still")
        q = jnp.where(swings[:, None], jnp.where(windows.own[:, None], swing[at], other.T), 0)
        codes = Codes(self._static(params, track.static[ends]), self._dynamic(params, q), q)
        z = codes.together()
        offsets = decode(self, params, model, jnp.concatenate([z, lax.stop_gradient(codes.static)]))
        offsets, static = jnp.split(offsets, 2, axis=-1)
        moved = offsets - lax.stop_gradient(static)
        force = jnp.sum(stiffness(_vibrations(model), track.static[ends]) * q.T[None], axis=1).T
        return Offsets([offsets], moved), Kept(z[None], q, force)

    def coupling(self, model: Model, extra: Array, kept: Kept) -> tuple[dict[str, Array], Array]:
        """Return the energy `hold` of what the dynamic code adds to the offsets, and its derivative."""
        value, gradient = self.hold(model, extra, required(kept.swing, "kept.swing"), required(kept.force, "kept.force"))
        return {"hold": value}, gradient

    def enlargement(self, track: MotionFeatures, frames: Int[Array, "batch"]) -> Float[Array, "batch"]:
        """Return by how much the swings q of frames, enlarged, have the energy E_0 |q|^2 / 2 of the track's largest.

        Most of a motion is quiet: so its poses are trained with swings as strong as any of the track's.
        """
        size = jnp.linalg.norm(required(track.swing, "track.swing"), axis=1)
        largest = jnp.max(size)
        return largest / jnp.maximum(jnp.maximum(size[frames], QUIET * largest), jnp.finfo(size.dtype).tiny)

    def hold(
        self,
        model: Model,
        moved: Float[Array, "verts 3 batch"],
        swing: Float[Array, "batch modes"],
        force: Float[Array, "batch modes"],
    ) -> tuple[Float[Array, "batch"], Array]:
        """Return the inertia of the swing q, which carries it on where the energy pulls it back, and its derivative.

            sum_i g_i r_i^2 / (2 h^2) - (K q)_i r_i,   r_i = d_i^T M y / g_i - q_i,   g_i = d_i^T M d_i

        It is how inertia changes as the garment moves by r beyond q along the vibrations, for the q that implicit Euler gives.
        Only what the linearised energy does not know of moves it then: the body, above all.

        Args:
            moved: y, what the dynamic code adds to the offsets, m. swing: q. force: K q, J.
        """
        vibrations, mass = _vibrations(model), _mass(model)
        d = vibrations.directions
        along = (d * mass[:, None, None]).reshape(-1, self.modes)
        g = jnp.sum(along * d.reshape(along.shape), axis=0)
        along = along / g[None]
        r = _matmul(along.T, moved.reshape(len(along), -1)) - swing.T
        inertia = (g * model.fps**2)[:, None] * r
        return jnp.sum(r * (inertia / 2 - force.T), axis=0), _matmul(along, inertia - force.T).reshape(moved.shape)

    def _system(self, model, g, stiff):
        """G (1 + c h) + h^2 K, poses last."""
        h = 1 / model.fps
        return g * (1 + self.damping * h) + h * h * stiff

    def _static(self, params, descriptors):
        return jnp.asarray(self.static.apply({"params": params["static"]}, descriptors))

    def _dynamic(self, params, swing):
        return jnp.asarray(self.dynamic.apply({"params": params["dynamic"]}, swing))


def as_about_the_drape(model: Model, modes: int) -> Float[Array, "rows entries"]:
    """Return the zeros (rows, entries) of which `stiffness` makes E_0 I in every pose."""
    (joints, numbers), _ = descriptor_sizes(model)
    return jnp.zeros((joints * numbers + 3, modes * (modes + 1) // 2), model.basis.dtype)


def stiffness(vibrations: RitzModes, static: Float[Array, "poses joints numbers"]) -> Float[Array, "modes modes poses"]:
    """Return K of poses by their static descriptors d, J: positive definite, its factor between what training saw.

    K = E_0 C C^T,   C lower triangular, its entries, those of the diagonal as logarithms, clip(A d + a, least, most)
    """
    modes = vibrations.directions.shape[-1]
    if vibrations.by_pose is None:
        return jnp.broadcast_to(vibrations.energy * jnp.eye(modes, dtype=static.dtype)[..., None], (modes, modes, len(static)))
    slopes, (constant, least, most) = vibrations.by_pose[:-3], vibrations.by_pose[-3:, :, None]
    entries = jnp.clip(_matmul(slopes.T, static.reshape(len(static), -1).T) + constant, least, most)
    row, column = np.tril_indices(modes)
    entries = jnp.where((row == column)[:, None], jnp.exp(entries), entries)
    place = np.zeros((modes, modes, len(row)))
    place[row, column, np.arange(len(row))] = 1
    c = _matmul(jnp.asarray(place.reshape(-1, len(row)), entries.dtype), entries).reshape(modes, modes, -1)
    return vibrations.energy * jnp.sum(c[:, None] * c[None], axis=2)


def _vibrations(model: Model) -> RitzModes:
    return required(model.vibrations, "model.vibrations")


def _mass(model: Model) -> Float[Array, "verts"]:
    return model.material.density * model.garment.mesh.vertex_area


def _product(directions, mass, transforms):
    """P^T M P (modes, modes, poses), P = R D.

    Of few poses by P; of many by R^T R, six numbers a vertex, and so as a product of matrices with what is of no pose.
    """
    if transforms.shape[-1] < FEW:
        p = sum(transforms[:, :, i, None] * directions[:, i, :, None][:, None] for i in range(3))
        return jnp.einsum("vikp,vilp->klp", mass[:, None, None, None] * p, p, precision="highest")
    axes, modes = np.triu_indices(3), directions.shape[-1]
    k, other = np.tril_indices(modes)
    squares = sum(transforms[:, i, axes[0]] * transforms[:, i, axes[1]] for i in range(3))
    left, right = (directions[:, a] for a in axes)
    both = left[..., k] * right[..., other] + right[..., k] * left[..., other]
    share = jnp.where(axes[0] == axes[1], 0.5, 1).astype(mass.dtype)[None] * mass[:, None]
    constant = (share[..., None] * both).reshape(-1, len(k))
    place = np.zeros((modes, modes), int)
    place[k, other] = place[other, k] = np.arange(len(k))
    return _matmul(constant.T, squares.reshape(len(constant), -1))[place]


def _times(matrix, x):
    """A x, poses last."""
    return jnp.sum(matrix * x[None], axis=1)


def _inverse(a: Float[Array, "n n poses"]) -> Float[Array, "n n poses"]:
    """Of positive definite matrices, poses last, by Gauss and Jordan's elimination."""
    n = len(a)
    rows = jnp.concatenate([a, jnp.broadcast_to(jnp.eye(n, dtype=a.dtype)[..., None], a.shape)], axis=1)
    for k in range(n):
        pivot = rows[k] / rows[k, k][None]
        rows = (rows - rows[:, k, None] * pivot[None]).at[k].set(pivot)
    return rows[:, n:]

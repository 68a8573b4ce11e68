"""Training is simulating: an Optax loop on the physics energy alone, with no simulated data."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float, Int

from ncs_jax.kinematics import Blend, blend, skin
from ncs_jax.methods.shared import Method, decode, garment_blend, initial_parameters
from ncs_jax.methods.swing import Swing
from ncs_jax.model import Model, pose_body, posed_bodies
from ncs_jax.motion import Track
from ncs_jax.numerics import norm
from ncs_jax.objective import Frame, Terms, distances, elastic, energies, pressure
from ncs_jax.scene import TrainingSpec

__all__ = [
    "CHUNK",
    "Fault",
    "TrainState",
    "batches",
    "chunk_runner",
    "chunks",
    "diagnose",
    "glance",
    "gradients",
    "initial_state",
    "step_size",
    "with_bodies",
]

CHUNK = 10  # steps in one compiled scan; checkpoints fall on its multiples
BODIES = 1 << 28  # bytes of posed bodies that are kept, at most


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Fault:
    """The last dropped step: what its first bad sample looked like, enough to find the term and the element again."""

    step: Int[Array, ""]
    frame: Int[Array, ""]
    offsets: Float[Array, "3 verts 3"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything that training carries from step to step."""

    params: dict
    optimiser: optax.OptState
    step: Int[Array, ""]
    dropped: Int[Array, ""]
    fault: Fault


BETAS = (0.9, 0.999)
ADAM = optax.scale_by_adam(*BETAS)


def step_size(spec: TrainingSpec, step, steps) -> Float[Array, ""]:
    """From the learning rate down to 2 % of it along a cosine, at the last of `steps`."""
    fall = jnp.clip(step / jnp.maximum(steps, 1), 0, 1)
    return spec.learning_rate * (0.02 + 0.98 * (1 + jnp.cos(jnp.pi * fall)) / 2)


@functools.partial(jax.jit, static_argnums=1)
def initial_state(model: Model, network: Method, seed: int) -> TrainState:
    """Fresh parameters and a fresh optimiser."""
    params = initial_parameters(network, jax.random.PRNGKey(seed), model)
    zero = jnp.zeros((), jnp.int32)
    fault = Fault(zero, zero, jnp.zeros((3, *model.garment.mesh.rest.shape), model.garment.mesh.rest.dtype))
    return TrainState(params, ADAM.init(params), zero, zero, fault)


def with_bodies(model: Model, track: Track, batch: int) -> Track:
    """The same motions with the bodies of all frames posed, `batch` at a time, where collision is by planes.

    A motion fixes them; a step looks them up. Where they take more than `BODIES` bytes, each step poses those it sees.
    """
    if model.terms.collision != "plane" or 2 * len(track.start) * model.body.nbytes > BODIES:
        return track
    return replace(track, bodies=jax.jit(posed_bodies, static_argnums=2)(model, track.matrices, batch))


def batches(frames: int, batch: int, seed: int, first: int, count: int) -> np.ndarray:
    """The last frames of the windows of steps first .. first + count, (count, batch): every frame once a round, shuffled.

    A pure function of its arguments, so that a resumed run sees what an unbroken one would have seen.
    """
    wanted = np.arange(first * batch, (first + count) * batch)
    rounds = wanted // frames
    shuffled = {r: np.random.default_rng([seed, int(r)]).permutation(frames) for r in np.unique(rounds)}
    picked = np.stack([shuffled[r][i] for r, i in zip(rounds, wanted % frames, strict=True)])
    return picked.reshape(count, batch).astype(np.int32)


def _pose(model: Model, weights: Blend, offsets, matrices):
    """Vertices (verts, 3, *poses) in m from offsets, in m, and joint transforms (joints, 3, 4, *poses)."""
    rest = model.garment.mesh.rest
    return skin(blend(matrices, weights), rest.reshape(rest.shape + (1,) * (offsets.ndim - 2)) + offsets)


def _alone(model: Model, terms: Terms, weights: Blend, x, earlier, matrices, inertia_share):
    """The terms that look at one pose by itself: energies by name and derivatives by x and, with pins, by the weights."""
    body = None if model.body is None else pose_body(model, matrices)
    carried = pressed = None
    if terms.friction:
        carried = _pose(model, weights, earlier, matrices)
        pressed = pressure(carried, body, model.surface, terms, model.material)
    frame = Frame(1 / model.fps, body=body, carried=carried, pressed=pressed)

    def value(x, weights):
        at = replace(frame, blended=blend(matrices, weights)) if terms.pinning else frame
        parts = energies(x, model.garment, model.material, at, terms, model.surface)
        if terms.friction:
            parts["friction"] = parts["friction"] * inertia_share
        return sum(parts.values()), parts

    if not terms.pinning:
        slope, parts = jax.grad(value, has_aux=True)(x, weights)
        return parts, slope, None
    (slope, to_weights), parts = jax.grad(value, argnums=(0, 1), has_aux=True)(x, weights)
    return parts, slope, to_weights.weights


def physics(model: Model, weights: Blend, offsets, matrices, inertia_share, body=None):
    """Energies by term (poses,), and the gradients of their sum by the last frame's offsets and by the skinning weights.

    Args:
        offsets: (verts, 3, poses) in m of each frame, the last first. matrices: (history, joints, 3, 4, poses).
        inertia_share: (poses,) 1, or 0 where a pose has no past of its own. body: (body, 6, poses) of `posed_bodies`, if known.

    The poses lie beside each other in the vector lanes, but for the terms that look for what is near.
    """
    terms = model.terms
    x, back = jax.vjp(lambda last, weights: _pose(model, weights, last, matrices[0]), offsets[0], weights)
    parts, gradient = elastic(x, model.garment, model.material, terms)

    previous = before = None
    if terms.inertia:
        previous, before = (_pose(model, weights, offsets[k], matrices[k]) for k in (1, 2))
    plane = "plane" if terms.collision == "plane" else None
    together = Terms(None, bending=False, collision=plane, exact=terms.exact, gravity=terms.gravity, inertia=terms.inertia)
    posed = normals = None
    if body is not None:
        posed, normals = body[:, :3], body[:, 3:]
    elif plane is not None:
        posed = pose_body(model, matrices[0])
    frame = Frame(1 / model.fps, previous, before, posed, normals=normals)

    def simple(x):
        some = energies(x, model.garment, model.material, frame, together, model.surface)
        if terms.inertia:
            some["inertia"] = some["inertia"] * inertia_share
        return jnp.sum(sum(some.values(), start=jnp.zeros((), x.dtype))), some

    slope, some = jax.grad(simple, has_aux=True)(x)
    parts, gradient = parts | some, gradient + slope
    collision = None if plane else terms.collision
    alone = replace(terms, membrane=None, bending=False, collision=collision, gravity=False, inertia=False)
    if alone.collision is None and not (alone.friction or alone.pinning or alone.self_contact):
        return parts, *back(gradient)

    each = (x, offsets[1] if terms.friction else None, matrices[0], inertia_share)
    each = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), each)
    some, slope, to_weights = lax.map(lambda one: _alone(model, alone, weights, *one), each)
    to_offsets, to_all = back(gradient + jnp.moveaxis(slope, 0, -1))
    if to_weights is not None:
        to_all = replace(to_all, weights=to_all.weights + jnp.sum(to_weights, axis=0))
    return parts | some, to_offsets, to_all


def _through_time(model: Model, weights: Blend, offsets, matrices, inertia_share):
    """The gradients of inertia by the offsets of the two frames before, and by the skinning weights that pose them."""
    x = _pose(model, weights, offsets[0], matrices[0])
    terms = Terms(None, bending=False, collision=None, gravity=False, through_time=True)

    def value(earlier, weights):
        frame = Frame(1 / model.fps, *(_pose(model, weights, earlier[k], matrices[1 + k]) for k in (0, 1)))
        return jnp.sum(inertia_share * energies(x, model.garment, model.material, frame, terms)["inertia"])

    return jax.grad(value, argnums=(0, 1))(list(offsets[1:]), weights)


def gradients(model: Model, network: Method, spec: TrainingSpec, params, track: Track, ends, pairs, axis: str | None = None):
    """One step's gradient: the network's transposed derivative applied to the physics' gradient at the vertices.

    Returns gradients of the parameters, the batch's energies by term (batch,), and what `Fault` needs of every sample.
    Positions before the last frame enter as constants, so only that frame is differentiated through the decoder; unless the
    method's loss goes through time.
    Within a `shard_map` over `axis`, `ends`, `pairs` and what is returned of samples are this device's share of the batch.
    """
    model = replace(model, terms=network.loss(model.terms))
    history = 3 if model.terms.inertia else 1
    swapped = round(spec.motion_augmentation * spec.batch) if network.controlled else 0
    augmented = 0 if isinstance(network, Swing) else swapped  # no inertia of theirs
    number = jnp.arange(ends.shape[0], dtype=ends.dtype)  # in the whole batch
    if axis is not None:
        number = number + lax.axis_index(axis) * ends.shape[0]
    own = number >= augmented

    def codes(params):
        z_static, z_dynamic, _ = network.windows(params, track, ends, max(spec.window, history), history)
        if z_dynamic is None:
            return z_static
        if not augmented:
            return z_static + z_dynamic
        # Motion augmentation: another window's dynamic code on this one's static code, both constants.
        if axis is not None:  # any number of this device's windows are such, and the others' codes may be elsewhere
            everyone = lax.all_gather(lax.stop_gradient(z_dynamic), axis, axis=1, tiled=True)
            return jnp.where(own[:, None], z_static + z_dynamic, lax.stop_gradient(z_static) + everyone[:, pairs])
        mixed = lax.stop_gradient(z_static[:, :augmented]) + lax.stop_gradient(z_dynamic[:, pairs[:augmented]])
        return jnp.concatenate([mixed, (z_static + z_dynamic)[:, augmented:]], axis=1)

    def swung(network, params):
        """Offsets with a swing, its own or any size of another frame's, and what they are beyond the static ones."""
        everyone = ends if axis is None else lax.all_gather(ends, axis, tiled=True)
        at = jnp.where(number < swapped, everyone[pairs], ends)
        share = number.astype(track.swing.dtype) / max(swapped - 1, 1)
        share = jnp.where(number < swapped, share * network.enlargement(track, at), 1)
        found = network.mixed(params, track, ends, at, share)
        z = found.together()
        offsets = decode(network, params, model, jnp.concatenate([z, lax.stop_gradient(found.static)]))
        offsets, static = jnp.split(offsets, 2, axis=-1)
        moved = offsets - lax.stop_gradient(static)
        return [offsets + jnp.tensordot(model.vibrations.directions, found.swing, (-1, -1)), moved], (z[None], found.swing)

    def decoded(params):
        if isinstance(network, Swing):
            return swung(network, params)
        z = codes(params)
        if not model.terms.through_time:
            return [decode(network, params, model, z[-1])], (z, None)
        every = decode(network, params, model, z)
        return [every[:, :, k] for k in (2, 1, 0)], (z, None)

    offsets, transpose, (z, swing) = jax.vjp(decoded, params, has_aux=True)
    if isinstance(network, Swing):
        *offsets, moved = offsets
    if history > len(offsets):
        earlier = decode(network, params, model, z[:-1])
        offsets = [*offsets, earlier[:, :, 1], earlier[:, :, 0]]
    back = jnp.maximum(ends[None] - jnp.arange(history, dtype=ends.dtype)[:, None], track.start[ends][None])
    matrices = jnp.moveaxis(track.matrices[back], 1, -1)
    weights, pull = jax.vjp(lambda p: garment_blend(network, p, model), params)
    body = None if track.bodies is None else jnp.moveaxis(track.bodies[ends], 0, -1)
    share = own.astype(offsets[0].dtype)
    parts, g, to_weights = physics(model, weights, offsets, matrices, share, body)
    by_frame = [g]
    if isinstance(network, Swing):
        held, to_moved = network.hold(model, moved, swing)
        parts, by_frame = parts | {"hold": held}, [g, to_moved]
    if model.terms.through_time:
        past, more = _through_time(model, weights, offsets, matrices, share)
        by_frame, to_weights = by_frame + past, jax.tree.map(jnp.add, to_weights, more)
    (result,) = transpose([g / ends.shape[0] for g in by_frame])
    if network.learn_weights:
        (more,) = pull(jax.tree.map(lambda w: w / ends.shape[0], to_weights))
        result = jax.tree.map(jnp.add, result, more)
    return result if axis is None else lax.pmean(result, axis), parts, (g, offsets)


def _sample(share, index, axis: str | None):
    """Entry `index` of the whole batch, along the last axis, which within a `shard_map` over `axis` one device has."""
    if axis is None:
        return share[..., index]
    size = share.shape[-1]
    return lax.psum(jnp.where(lax.axis_index(axis) == index // size, share[..., index % size], 0), axis)


def step(model, network, spec, steps, state: TrainState, track, ends, pairs, axis=None) -> tuple[TrainState, dict]:
    """One optimiser step; a step with any number that is not finite leaves the weights as they were and is counted.

    Within a `shard_map` over `axis`, `ends` and `pairs` are this device's share of the batch and the rest is every device's.
    """
    grads, parts, (g, offsets) = gradients(model, network, spec, state.params, track, ends, pairs, axis)
    sample_good = jnp.all(jnp.isfinite(g), axis=(0, 1)) & jnp.isfinite(sum(parts.values()))
    if axis is not None:
        sample_good = lax.all_gather(sample_good, axis, tiled=True)
    # Columns first, which adds in vector lanes; a sum is finite only if everything in it is.
    sums = [jnp.sum(jnp.sum(leaf, axis=0)) for leaf in jax.tree.leaves(grads)]
    good = lax.optimization_barrier(jnp.all(sample_good) & jnp.isfinite(sum(sums)))

    def choose(new, old):  # a select where a branch would copy what it returns
        return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)

    # The barrier has the moments written in place before they are read: otherwise XLA copies the old ones, 100 MB a step.
    opt = lax.optimization_barrier(choose(ADAM.update(grads, state.optimiser)[1], state.optimiser))
    count = jnp.maximum(opt.count, 1)
    mean, square = optax.tree.bias_correction(opt.mu, BETAS[0], count), optax.tree.bias_correction(opt.nu, BETAS[1], count)
    size = step_size(spec, state.step, steps)
    params = jax.tree.map(lambda p, m, v: jnp.where(good, p - size * m / (jnp.sqrt(v) + 1e-8), p), state.params, mean, square)

    def first_bad():
        worst = jnp.argmin(sample_good)
        kept = state.fault.offsets.at[: len(offsets)].set(jnp.stack([_sample(frame, worst, axis) for frame in offsets]))
        return Fault(state.step, _sample(ends, worst, axis), kept)

    fault = lax.cond(good, lambda: state.fault, first_bad)
    logs = {name: jnp.mean(value) for name, value in parts.items()}
    logs = logs if axis is None else lax.pmean(logs, axis)
    return TrainState(params, opt, state.step + 1, state.dropped + ~good, fault), logs


def chunk_runner(network: Method, spec: TrainingSpec, mesh: Mesh | None = None):
    """Several steps compiled as one: f(state, ends (n, batch), pairs (n, batch), steps, model, track) -> state, logs.

    `steps` is how many the whole training has, for the schedule. The state's buffers are reused. The track is that of
    `with_bodies`. With a mesh of several devices (`devices.batch_mesh`), each works on its part of the batch and takes the same
    step as the others.
    """
    axis = None if mesh is None else mesh.axis_names[0]

    def run(state, ends, pairs, steps, model, track):
        def body(state, indices):
            return step(model, network, spec, steps, state, track, *indices, axis)

        return lax.scan(body, state, (ends, pairs))

    if mesh is not None:
        whole, share = P(), P(None, axis)
        given = whole, share, share, whole, whole, whole
        run = jax.shard_map(run, mesh=mesh, in_specs=given, out_specs=whole, check_vma=False)
    return jax.jit(run, donate_argnums=0)


def chunks(first: int, steps: int) -> Iterator[tuple[int, int]]:
    """(first step, count) of every chunk up to `steps`, cut at the multiples of CHUNK wherever a run resumes."""
    while first < steps:
        upto = min((first // CHUNK + 1) * CHUNK, steps)
        yield first, upto - first
        first = upto


def glance(model: Model, network: Method, window: int, params, track: Track, ends) -> dict[str, Float[Array, ""]]:
    """Mean edge strain and share of penetrating vertices (by the scene's own query), in %, of a few frames.

    Where alpha scales anything also `moved`: how far alpha = 1 is from alpha = 0, mean over the vertices in mm.
    """
    codes = network.windows(params, track, ends, window, 1)
    offsets = decode(network, params, model, *(c if c is None else c[-1] for c in (codes.together(), codes.swung())))
    weights = garment_blend(network, params, model)
    mesh = model.garment.mesh

    def one(args):
        offset, matrices = args
        x = skin(blend(matrices, weights), mesh.rest + offset)
        length = norm(x[mesh.edges[:, 1]] - x[mesh.edges[:, 0]])
        strain = jnp.abs(length / jnp.where(mesh.edge_length > 0, mesh.edge_length, 1) - 1)
        result = {"strain": 100 * jnp.mean(strain)}
        if model.terms.collision is not None:
            d = distances(x, pose_body(model, matrices), model.surface, model.terms)
            result["penetrating"] = 100 * jnp.mean(d < 0)
        return result

    each = (jnp.moveaxis(offsets, -1, 0), track.matrices[ends])
    found = {k: jnp.mean(v) for k, v in lax.map(one, each).items()}
    if codes.dynamic is not None:
        moved = offsets - decode(network, params, model, codes.static[-1])
        found["moved"] = 1000 * jnp.mean(norm(jnp.moveaxis(moved, 1, -1)))
    return found


def diagnose(model: Model, network: Method, params, track: Track, fault: Fault) -> str:
    """Which term of a dropped step went non-finite, in which frame, and at which vertex first."""
    model, frame = replace(model, terms=network.loss(model.terms)), int(fault.frame)
    history = 3 if model.terms.inertia else 1
    back = jnp.maximum(frame - jnp.arange(history), track.start[frame])
    weights = garment_blend(network, params, model)
    matrices, share = track.matrices[back][..., None], jnp.ones(1, fault.offsets.dtype)
    last = fault.offsets[0]

    def value(last):
        offsets = [frame[..., None] for frame in (last, *fault.offsets[1:history])]
        return {name: energy[0] for name, energy in physics(model, weights, offsets, matrices, share)[0].items()}

    if not bool(jnp.all(jnp.isfinite(last))):
        return f"step {int(fault.step)}, frame {frame}: the network's own output is not finite"
    parts = jax.jit(value)(last)
    for name, energy in parts.items():
        gradient = jax.jit(jax.grad(lambda o, n=name: value(o)[n]))(last)
        bad = ~np.isfinite(np.asarray(gradient)).all(axis=1)
        if not np.isfinite(float(energy)) or bad.any():
            vertex = int(bad.argmax()) if bad.any() else -1
            faces = np.flatnonzero((np.asarray(model.garment.mesh.faces) == vertex).any(axis=1))
            where = f"vertex {vertex}" + (f" (face {faces[0]})" if faces.size else "") if vertex >= 0 else "an unknown element"
            return f"step {int(fault.step)}, frame {frame}: {name} is not finite at {where}"
    return f"step {int(fault.step)}, frame {frame}: the gradient of the parameters is not finite"

"""What a training step costs on a scene, part by part, beside the least that it could cost on this machine.

    python -m benchmarks.training [SCENE] [--repeats 7] [--batches 32 128 512] [--quick] [--json FILE]

Every part is timed inside one compiled loop, as it stands in the scan of a training, on the poses of one batch after some steps
of training: its value and its derivative, for all poses of the batch. Indented rows are parts of the row above them;
`descriptors` are computed once a scene and are no part of a step, nor is `body` where the same frames come again within a chunk
of steps. The least is the time of the matrix products and of the bytes that a part cannot avoid (`benchmarks/work.py`), at the
rates that this run measures; other arithmetic is not counted, so an energy's least is that of reading positions and writing
forces.

`--batches` instead measures whole steps alone, with so many windows each, and how many windows a second that makes.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks import work
from benchmarks.measure import ROUNDS, advanced, clocks, looped, nudged, peak_memory, read, run, timed
from ncs_jax import assemble, local_rotations
from ncs_jax.energies.contact.points import with_points
from ncs_jax.energies.elements import elastic
from ncs_jax.energies.terms import StepInputs, Terms
from ncs_jax.energies.total import contact_force, distances, energy_terms
from ncs_jax.geometry.skinning import blend
from ncs_jax.network.methods.method import garment_blend
from ncs_jax.prepare.build import Assembly
from ncs_jax.scene.features import motion_features
from ncs_jax.scene.model import Model, pose_body, pose_garment
from ncs_jax.scene.spec import Scene
from ncs_jax.training.batches import CHUNK, batches
from ncs_jax.training.devices import trim_memory
from ncs_jax.training.loss import gradients, physics, with_bodies
from ncs_jax.training.step import Task, TrainState, chunk_runner, initial_state, windows_of

STEPS = 1000  # of the schedule
NOTHING = Terms(None, bending=False, collision=None, gravity=False, inertia=False)
DEPTH = {"step": 0, "descriptors": 0, "network": 1, "physics": 1, "optimiser": 1, "contact query": 3}  # all others 2


def ready(scene: Scene) -> Assembly:
    """A scene as training takes it, with what its motions fix and what a fresh network tells them."""
    assembly = assemble(scene)
    trim_memory()  # as training does
    model, network, features = assembly.model, assembly.network, assembly.track
    if network.refreshes:
        features = jax.jit(network.refresh)(initial_state(model, network, 0).params, model, features)
    return replace(assembly, training_features=with_bodies(model, features, scene.training.batch))


def steps(assembly: Assembly, count: int) -> tuple[Callable, list]:
    """`count` training steps as one program, and a list of one: the state, which goes on from call to call."""
    model, network, whole, spec = assembly.model, assembly.network, assembly.track, assembly.scene.training
    chunk, held = chunk_runner(network, spec), [initial_state(model, network, 0)]
    ends, pairs = batch(assembly, count)

    def several():
        held[0], logs = chunk(held[0], ends, pairs, STEPS, model, whole)
        return logs

    return several, held


def batch(assembly: Assembly, count: int):
    """Last frames of the windows of the first steps, and with whom each is paired: (count, batch) both."""
    size = assembly.scene.training.batch
    ends = batches(assembly.track.start.shape[0], size, 0, 0, count)
    return jnp.asarray(ends), jnp.tile(jnp.arange(size, dtype=jnp.int32)[::-1], (count, 1))


def _front(tree):
    return jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), tree)


def _energy(model: Model, name: str) -> Callable:
    """One term and its gradient by the positions, of poses at the back: a function of positions and what a frame brings."""
    terms = replace(NOTHING, exact=model.terms.exact, **{name: getattr(model.terms, name)})

    def of(varied, model):
        def value(x, brought):
            given = dict(brought)
            if name == "friction":
                near = replace(terms, collision=model.terms.collision)
                given["lagged_normal_force"] = contact_force(
                    given["advected"], given["body"], model.surface, near, model.material
                )
            parts = energy_terms(x, model.garment, model.material, StepInputs(1 / model.fps, **given), terms, model.surface)
            return jnp.sum(parts[name])

        return jax.value_and_grad(value)(*varied)

    together = name in ("gravity", "inertia") or terms.collision == "plane"  # as in `training.loss.physics`
    return of if together else lambda varied, model: lax.map(lambda pose: of(pose, model), _front(varied))


def parts(assembly: Assembly, state: TrainState, ends, pairs) -> dict[str, tuple]:
    """Every part that the scene has, by name: a function, what it depends on, and its constants."""
    network, whole, spec, params = assembly.network, assembly.track, assembly.scene.training, state.params
    terms = network.loss(assembly.model.terms)  # a swing's inertia is no term of a sample
    model = replace(assembly.model, terms=terms)
    windows = functools.partial(windows_of, Task(model, network, spec))  # within a trace
    offsets = jax.jit(lambda p: gradients(model, network, p, whole, windows(ends, pairs)))(params)[2][1]
    history = len(offsets)
    back = jnp.maximum(ends[None] - jnp.arange(history, dtype=ends.dtype)[:, None], whole.start[ends][None])
    matrices = jnp.moveaxis(whole.matrices[back], 1, -1)
    weights = garment_blend(network, params, model)

    def unmoved(model, weights, offsets, *_):
        return {}, offsets[0], weights

    def networks(whole, params, model):
        with mock.patch("ncs_jax.training.loss.physics", unmoved):
            return gradients(model, network, params, whole, windows(ends, pairs))

    def pose(offset, matrices, model):
        return pose_garment(model, offset, matrices, weights)

    def skinned(varied, model):
        offsets, matrices = varied
        x, pull = jax.vjp(lambda offset: pose(offset, matrices[0], model), offsets[0])
        return [x, *(pose(offsets[k], matrices[k], model) for k in range(1, history))], pull(jnp.ones_like(x))

    def simulated(varied, model):
        offsets, matrices, body = varied
        return physics(model, weights, offsets, matrices, share, body)

    posed = jax.jit(skinned)((offsets, matrices), model)[0]
    x, share = posed[0], jnp.ones(len(ends), posed[0].dtype)
    found: dict[str, tuple] = {
        "network": (networks, whole, params, model),
        "skinning": (skinned, (offsets, matrices), model),
    }
    brought: dict[str, dict] = {"inertia": {"previous": posed[1], "before": posed[2]}} if terms.inertia else {}
    known, body = None, {}
    if model.body is not None:
        found["body"] = (lambda matrices, model: pose_body(model, matrices), matrices[0], model)
        body = {"body": jax.jit(pose_body)(model, matrices[0])}
        if whole.bodies is not None:
            known = jnp.moveaxis(whole.bodies[ends], 0, -1)
            body["normals"] = known[:, 3:]
        brought["collision"] = body
    found["physics"] = (simulated, (offsets, matrices, known), model)
    for name in ("membrane", "bending"):
        if value := getattr(terms, name):
            alone = replace(NOTHING, **{name: value})
            found[name] = (lambda x, model, alone=alone: elastic(x, model.garment, model.material, alone), x, model)
    if terms.friction:
        brought["friction"] = {"body": body["body"], "advected": pose(offsets[1], matrices[0], model)}
    if terms.pinning:
        brought["pinning"] = {"vertex_transforms": blend(matrices[0], weights)}
    for name in ("collision", "friction", "gravity", "inertia", "pinning", "self_contact"):
        if getattr(terms, name):
            found[name] = (_energy(model, name), (x, brought.get(name, {})), model)

    def queried(varied, model):
        def one(varied):
            x, body = varied
            return distances(with_points(x, model.surface.points), body["body"], model.surface, terms, body.get("normals"))

        return one(varied) if terms.collision == "plane" else lax.map(one, _front(varied))

    if terms.collision:
        found["contact query"] = (queried, (x, body), model)
    return found


def optimiser(assembly: Assembly, state: TrainState, ends, pairs) -> tuple:
    """All of a step but its gradient, which is taken as given: as a step of `advanced`, its carry, and its constants."""
    model, network, whole, spec = assembly.model, assembly.network, assembly.track, assembly.scene.training
    windows = functools.partial(windows_of, Task(model, network, spec))
    given = jax.eval_shape(lambda p: gradients(model, network, p, whole, windows(ends, pairs)), state.params)
    given = jax.tree.map(lambda s: jnp.full(s.shape, 1e-6, s.dtype), given)

    def update(carry, model, whole):
        state, given = carry
        given = nudged(given, 1e-30 * state.step.astype(jnp.float32))
        with mock.patch("ncs_jax.training.step.gradients", lambda *_: given):
            state, _ = chunk_runner(network, spec)(state, ends[None], pairs[None], STEPS, model, whole)
        return state, given

    return update, (state, given), model, whole


def by_batch(assembly: Assembly, sizes: Sequence[int], repeats: int, count: int) -> dict:
    """Whole steps, `count` in a program, with each number of windows."""
    rows = {}
    for size in sizes:
        training = replace(assembly.scene.training, batch=size)
        resized = replace(assembly, scene=replace(assembly.scene, training=training))
        several, held = steps(resized, count)
        seconds = timed(several, repeats, count)
        needed = work.training(resized, held[0].params, np.asarray(batch(resized, 1)[0][0]))["step"]
        speed = {"windows/s": size / seconds["median"], "peak MB": peak_memory() >> 20}
        rows[f"step, batch {size}"] = {"seconds": seconds, "work": needed, **speed}
    return {"vertices": len(assembly.model.garment.mesh.rest), "window": assembly.scene.training.window, "rows": rows}


def benchmark(options) -> dict:
    """Measure a scene's training step and its parts, or whole steps by the size of the batch."""
    assembly = ready(read(options.scene))
    model, whole = assembly.model, assembly.track
    rounds, count = (2, 2) if options.quick else (ROUNDS, CHUNK)
    if options.batches:
        return by_batch(assembly, [round(size) for size in options.batches], options.repeats, count)
    several, held = steps(assembly, count)
    seconds = {"step": timed(several, options.repeats, count)}
    peak = peak_memory()
    ends, pairs = (a[0] for a in batch(assembly, 1))
    loop = functools.partial(looped, repeats=options.repeats, rounds=rounds)
    seconds |= {name: loop(*part) for name, part in parts(assembly, held[0], ends, pairs).items()}
    seconds["optimiser"] = advanced(*optimiser(assembly, held[0], ends, pairs), repeats=options.repeats, rounds=rounds)
    records = [assembly.motions[name] for name in assembly.scene.motion.files]
    poses, places = (jnp.asarray(np.concatenate([getattr(r, k) for r in records])) for k in ("poses", "translation"))
    start = whole.start[: len(poses)]
    described = (
        lambda poses, start, model: motion_features(model, *poses, start),
        (local_rotations(model, poses), places),
        start,
        model,
    )
    seconds["descriptors"] = loop(*described)
    needed = work.training(assembly, held[0].params, np.asarray(ends))
    rows: dict[str, dict] = {name: {"seconds": seconds[name], "work": needed[name]} for name in needed if name in seconds}
    rows["descriptors"]["times"] = len(whole.start) / len(poses)  # its mirror images were left out
    return {
        "vertices": len(model.garment.mesh.rest),
        "touchable body vertices": 0 if model.body is None else len(model.body),
        "batch": len(ends),
        "window": assembly.scene.training.window,
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(held[0].params)),
        "peak memory MB": peak >> 20,
        "rows": rows,
    }


def show(figures: dict) -> str:
    """The table of a step's parts, and what they come to."""
    rows = figures["rows"]
    if "step" not in rows:
        return clocks(rows, ("windows/s", "peak MB"))
    parts = sum(row["seconds"]["median"] for name, row in rows.items() if DEPTH.get(name) == 1)
    indented = {"  " * DEPTH.get(name, 2) + name: row for name, row in rows.items()}
    text = f"the parts of a step come to {1000 * parts:.4g} ms, the step takes {1000 * rows['step']['seconds']['median']:.4g}"
    return f"{clocks(indented)}\n{text}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    return run(
        __doc__, benchmark, show, arguments,
        repeats=(7, "timed calls of each part"), batches=((), "numbers of windows, for whole steps alone"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

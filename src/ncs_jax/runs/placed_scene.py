"""A scene on the devices that train it: its constants and motions there, and the programs compiled for them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.stages import Compiled
from jax.tree_util import PyTreeDef
from jaxtyping import Array

from ncs_jax.energies.contact.surface import rebuild_lists
from ncs_jax.errors import required
from ncs_jax.io.records import MotionRecord
from ncs_jax.metrics.coverage import TrainedMotion, with_strain
from ncs_jax.network.methods.method import Method
from ncs_jax.network.methods.swing import Swing
from ncs_jax.network.rollout import animate
from ncs_jax.prepare.build import Assembly, features_from_records
from ncs_jax.prepare.recombination import Recombination, recombination_of, recombined
from ncs_jax.runs.pose_stiffness import find_stiffness, learn_pose_stiffness
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body
from ncs_jax.simulation.ritz_modes import AT_ONCE
from ncs_jax.training.batches import batches, focused, whole_chunks
from ncs_jax.training.devices import batch_mesh, check_fits, local, replicate, shard_batch, trim_memory
from ncs_jax.training.loss import with_bodies
from ncs_jax.training.metrics import contact_energies, diagnose, training_metrics
from ncs_jax.training.programs import Programs
from ncs_jax.training.step import TrainState, chunk_runner, initial_state, refreshed

__all__ = ["PlacedScene", "begin_programs"]

SAMPLED = 64  # poses that the search for contacts is prepared for
SEEN = 4  # frames that are measured between chunks
POOL = 512  # poses put together of the motions' limbs, others after every checkpoint, where a scene trains on any
FOCUSED = 256  # frames, at most, whose contact is looked at for `training.focus`; those between are like them


class PlacedScene:
    """A scene made ready, on every device that trains it, and the programs that train it there.

    `model` and `features` are this process's own copies. They hold the same numbers as those on the devices. Of many motions
    they are a share, another one after every checkpoint: see `training.shares`. `POOL` recombined poses come last, if any.
    """

    def __init__(self, assembly: Assembly, seed: int, programs: Programs | None = None):
        """`programs`: where some were begun already, see `begin_programs`."""
        spec = assembly.scene.training
        self.assembly, self.seed = assembly, seed
        self.model, self.mesh = assembly.model, batch_mesh(spec.batch)
        self._programs, self._chunk, self._metrics = programs or Programs(), *_functions(assembly, self.mesh)
        self._compiled: dict[int, Compiled] = {}
        self._every, self._number = whole_chunks(spec.checkpoint_every), -1  # steps that a share is trained on, and which it is
        self._weight: np.ndarray | None = None  # of the frames, where some are trained on more
        self._recombination = _recombination(assembly)
        self._motions: MotionFeatures  # without poses that are no motion's
        self.features: MotionFeatures
        self._everywhere: Any = None  # the model and the features, with bodies; None until they are needed
        self._known: tuple[Array | None, int] = None, 0  # bodies of before, and of how many frames they are those of now
        self._show(0)

    @property
    def devices(self) -> int:
        """Return how many devices train."""
        return 1 if self.mesh is None else self.mesh.size

    def initial_state(self, params: dict | None = None) -> TrainState:
        """Return the state that the seed gives, in this process alone; with parameters of another run, if there are any.

        These are copied, as training uses up the arrays of its state.
        """
        state = initial_state(self.model, self.assembly.network, self.seed)
        return state if params is None else replace(state, params=jax.tree.map(jnp.array, params))

    def copied(self, tree):
        """Return the first process's arrays on every device."""
        return replicate(self.mesh, tree)

    def local(self, tree):
        """Return this process's copy of arrays that every device has."""
        return local(self.mesh, tree)

    def compile(self, state: TrainState, count: int) -> None:
        """Compile the program of a chunk of `count` steps, and give back the memory that this took, before bodies take some.

        Raises:
            InputError: it does not fit into memory.
        """
        batch, structures = self.assembly.scene.training.batch, []

        def shapes(state: TrainState, model: Model, track: MotionFeatures) -> list[Array]:
            leaves, structure = jax.tree.flatten((state, *self._indices(0, count), 0, model, with_bodies(model, track, batch)))
            structures.append(structure)
            return leaves

        if self.mesh is None:
            leaves = jax.eval_shape(shapes, state, self.model, self.features)
            self._compiled[count] = self._programs.begin("chunk", self._chunk, leaves, structures[0], reused=True).result()
            there = sum(leaf.nbytes for leaf in jax.tree.leaves((state, self.model, self.features)))
            check_fits(self._compiled[count], batch, there)
        else:
            self._ready((self.copied(state), *self._indices(0, count), 0, *self._placed()))
        trim_memory()

    def run_chunk(self, state: TrainState, first: int, count: int, steps: int) -> tuple[TrainState, dict[str, Array]]:
        """Take the steps first to first + count of `steps`; the state given is used up. Return the new one and the logs."""
        arguments = state, *self._indices(first, count), steps, *self._placed()
        return self._ready(arguments)(*jax.tree.leaves(arguments))

    def measure(self, params: dict, done: int) -> dict[str, float]:
        """Return `training_metrics` of a few frames of the last of the `done` steps."""
        return {
            name: float(np.mean(value)) for name, value in self._measured(params, self._ends(done - 1, 1)[0, :SEEN]).items()
        }

    def with_strain(self, trained: TrainedMotion, params: dict) -> TrainedMotion:
        """Return what is known of the motions that are trained on, with how much they strain the garment."""
        return with_strain(trained, self.model, self._motions, self._last, functools.partial(self._strain, params))

    def _strain(self, params: dict, frames: np.ndarray) -> np.ndarray:
        """Return the garment's mean strain in each of these frames, %."""
        count = len(self._ends(0, 1)[0, :SEEN])  # of which the program is
        parts = np.pad(frames, (0, -len(frames) % count), mode="edge").astype(np.int32).reshape(-1, count)
        return np.concatenate([self._measured(params, few)["strain"] for few in parts])[: len(frames)]

    def _measured(self, params: dict, ends) -> dict[str, np.ndarray]:
        arguments = self.model, params, self.features, ends
        program = self._programs.ready("metrics", self._metrics, *arguments)
        return {name: np.asarray(value) for name, value in program(*jax.tree.leaves(arguments)).items()}

    def diagnose(self, state: TrainState) -> str:
        """Return why the last dropped step was dropped."""
        found = diagnose(self.model, self.assembly.network, state.params, self.features, state.fault)
        return f"{found}{self._named(int(state.fault.frame))}"

    def _named(self, frame: int) -> str:
        """Return in words which frame of which file a frame of a share is; nothing where there are no shares."""
        if frame >= len(self._motions.start):
            return " (that is a recombined pose)"
        files = self.assembly.scene.motion.files
        for piece in self._pieces:
            if frame < piece.stop - piece.first:
                mirrored = ", mirrored" if piece.motion >= len(files) else ""
                return f" (that is frame {piece.first + frame} of {files[piece.motion % len(files)]}{mirrored})"
            frame -= piece.stop - piece.first
        return ""

    def refresh(self, params: dict, step: int) -> None:
        """Take the motions that are trained on from a step on, and what the network adds to them: see `Method.refresh`."""
        self._show(step // self._every)
        told: dict[str, Array] = {}
        if self.assembly.network.refreshes:
            told = refreshed(self.assembly.network, params, self.model, self._motions)
            told = {name: _and_still(array, len(self._bare.start)) for name, array in told.items()}
            self.features = replace(self.features, **told)
        if self._everywhere is not None:
            self._everywhere = self._everywhere[0], replace(self._everywhere[1], **self.copied(told))
        elif self._compiled:
            self._placed()
        if step and self.assembly.scene.training.focus and self.model.terms.collision is not None:
            self._weight = self._contacts(params)

    def _contacts(self, params: dict) -> np.ndarray:
        """Return what contact costs in every frame that is trained on, J; none of them nothing."""
        spec, count = self.assembly.scene.training, len(self._last)
        some = np.unique(np.linspace(0, count - 1, FOCUSED).astype(int))
        arguments = self.model, params, self.features, self._last[some].astype(np.int32)
        program = self._programs.ready(
            "contact", lambda model, *given: contact_energies(model, self.assembly.network, spec.window, *given), *arguments
        )
        found = np.asarray(program(*jax.tree.leaves(arguments)), np.float64)
        found = np.where(np.isfinite(found), found, 0)
        return np.interp(np.arange(count), some, found + max(found.mean() / 100, 1e-12))

    def learn_pose_stiffness(self, params: dict, done: int, steps: int) -> bool:
        """Find how stiff the garment is in poses, after `done` of `steps`: see `runs.pose_stiffness`. Return if it is known."""
        learned = learn_pose_stiffness(self.assembly, params, self._motions, steps, self.seed)
        if learned is self.assembly:
            return False
        self.assembly = learned
        self._change(replace(self.model, vibrations=learned.model.vibrations))
        self.refresh(params, done)
        return True

    def find_stiffness(self, params: dict) -> None:
        """Do what finding the stiffness in `AT_ONCE` poses and one takes, where the garment swings."""
        if isinstance(network := self.assembly.network, Swing):
            find_stiffness(network, params, self.model, self._bare, np.arange(AT_ONCE + 1) % len(self._bare.start))

    def rebuild_lists(self, params: dict) -> None:
        """Tell the searches for the nearest vertex where the garment is now: they find the same, several times as fast."""
        surface, terms = self.model.surface, self.model.terms
        if surface is None or terms.collision != "plane" or not terms.exact:
            return
        motions = self._bare
        some = np.unique(np.linspace(0, motions.start.shape[0] - 1, SAMPLED).astype(int))
        part = replace(jax.tree.map(lambda a: a[some], motions), origin=None)
        cloth, body = map(np.asarray, _garment_and_body(self.model, self.assembly.network, params, part))
        garment = self.model.garment
        uppers = tuple(
            replace(upper, below=rebuild_lists(upper.below, [(x[upper.first : upper.stop], x[: upper.first]) for x in cloth]))
            for upper in garment.uppers
        )
        surface = rebuild_lists(surface, list(zip(cloth, body, strict=True)))
        self._change(replace(self.model, surface=surface, garment=replace(garment, uppers=uppers)))

    def _change(self, model: Model) -> None:
        """Train with another model from here on."""
        self.model = model
        if self._everywhere is not None:
            self._everywhere = self.copied(model), self._everywhere[1]

    def _show(self, number: int) -> None:
        """Place the motions of a share, or all of them where they are few, and recombined poses."""
        training, begun = required(self.assembly.training, "training"), self._number >= 0
        if number == self._number or (begun and training.shares is None and self._recombination is None):
            return
        if training.shares is None and self._everywhere is not None and (bodies := self._everywhere[1].bodies) is not None:
            self._known = self.local(bodies), len(self._motions.start)
        self._everywhere = None  # before the next one takes as much memory
        self._number, self._pieces = number, training.shares.share(self.seed, number) if training.shares else []
        if training.shares is not None:
            self._weight = None  # of other frames
            self._motions, self._last = training.features(self.assembly.model, self._pieces)
        elif not begun:
            self._motions, self._last = self.assembly.track, np.arange(len(self.assembly.track.start))
        self._bare = self._motions
        if self._recombination is not None:
            poses = recombined(self._recombination, POOL, [self.seed, 5, number])
            self._bare = _joined(self._motions, _standing(self.assembly.model, poses))
        self.features = self._bare

    def _placed(self) -> tuple[Model, MotionFeatures]:
        """Return model and features, with bodies, on every device; the bodies are posed now if they were not."""
        if self._everywhere is None:
            known, self._known = self._known, (None, 0)
            batch = self.assembly.scene.training.batch
            self._everywhere = replicate(self.mesh, (self.model, with_bodies(self.model, self.features, batch, *known)))
        return self._everywhere

    def _ends(self, first: int, count: int) -> np.ndarray:
        """Return the last frames of the windows of some steps, (count, batch)."""
        seed, batch = self.seed, self.assembly.scene.training.batch
        if required(self.assembly.training, "training").shares is not None:
            seed, first = int(np.random.SeedSequence([seed, 3, self._number]).generate_state(1)[0]), first % self._every
        ends = self._last[batches(len(self._last), batch, seed, first, count)].astype(np.int32)
        spec = self.assembly.scene.training
        if self._weight is not None:
            ends = focused(ends, self._last, self._weight, spec.focus, seed, first)
        if self._recombination is not None:
            pool = len(self._motions.start) + np.arange(POOL, dtype=np.int32)
            ends = focused(ends, pool, np.ones(POOL), spec.recombined, seed, first, stream=6)
        return ends

    def _indices(self, first: int, count: int) -> tuple[Array, Array]:
        """Return the windows of some steps and their partners, (count, batch) both, on the devices."""
        ends = self._ends(first, count)
        each = [np.random.default_rng([self.seed, 1, step]) for step in range(first, first + count)]
        pairs = np.stack([rng.permutation(ends.shape[1]) for rng in each]).astype(np.int32)
        return shard_batch(self.mesh, (ends, pairs))

    def _ready(self, arguments: tuple) -> Compiled:
        """Return the program for a chunk's arguments, compiled once for every number of steps."""
        count, batch = arguments[1].shape
        if count not in self._compiled:
            self._compiled[count] = self._programs.ready("chunk", self._chunk, *arguments, reused=True)
            check_fits(self._compiled[count], batch)
        return self._compiled[count]


def begin_programs(programs: Programs, assembly: Assembly, count: int) -> None:
    """Begin to compile what trains a scene `count` steps and what measures it then, where a single device does it.

    Of the arrays of the assembly no more than their shapes counts.
    """
    network, batch = assembly.network, assembly.scene.training.batch
    structures: list[PyTreeDef] = []
    if batch_mesh(batch) is not None:
        return

    more = _recombines(assembly)

    def shapes(model: Model, track: MotionFeatures) -> list[list[Array]]:
        if more:
            track = _joined(
                track, jax.tree.map(lambda a: jnp.zeros((POOL, *a.shape[1:]), a.dtype), replace(track, origin=None))
            )
        state, placed, ends = (
            initial_state(model, network, 0),
            with_bodies(model, track, batch),
            np.zeros((count, batch), np.int32),
        )
        told = refreshed(network, state.params, model, track) if network.refreshes else {}
        chunk = state, ends, ends, count, model, replace(placed, **told)
        metrics = model, state.params, replace(track, **told), ends[0, :SEEN]
        structures.extend(map(jax.tree.structure, (chunk, metrics)))
        return [jax.tree.leaves(chunk), jax.tree.leaves(metrics)]

    chunk, metrics = jax.eval_shape(shapes, assembly.model, assembly.track)
    steps, measures = _functions(assembly, None)
    programs.begin("chunk", steps, chunk, structures[0], reused=True)
    programs.begin("metrics", measures, metrics, structures[1])


def _functions(assembly: Assembly, mesh: Mesh | None) -> tuple[Callable, Callable]:
    """Return what is compiled: a chunk of steps, and `training_metrics` of model, parameters, motions and frames."""
    network, spec = assembly.network, assembly.scene.training
    return chunk_runner(network, spec, mesh), lambda model, *given: training_metrics(model, network, spec.window, *given)


def _recombines(assembly: Assembly) -> bool:
    """Tell whether a scene trains on recombined poses, and has motions to make them of."""
    scene = assembly.scene
    return bool(scene.training.recombined and scene.motion.files) and assembly.body is not None


def _recombination(assembly: Assembly) -> Recombination | None:
    """Return what poses are put together from; None where a scene trains on none."""
    body, training = assembly.body, assembly.training
    return recombination_of(body, training.records) if body and training and _recombines(assembly) else None


def _standing(model: Model, poses: np.ndarray) -> MotionFeatures:
    """Return a character that stands in each of the poses (poses, joints, 3)."""
    return features_from_records(model, MotionRecord(poses, np.zeros_like(poses[:, 0]), model.fps), apart=True)


def _joined(motions: MotionFeatures, more: MotionFeatures) -> MotionFeatures:
    """Return motions and, behind them, others that are measured from the world's origin."""
    count, origin = len(motions.start), motions.origin
    more = replace(
        more, start=more.start + count, origin=None if origin is None else jnp.zeros((len(more.start), 3), origin.dtype)
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), motions, more)


def _and_still(array: Array, frames: int) -> Array:
    """Return what a network adds to motions, and none of it in the other frames."""
    return jnp.pad(array, [(0, frames - len(array))] + [(0, 0)] * (array.ndim - 1))


@functools.partial(jax.jit, static_argnums=1)
def _garment_and_body(model: Model, network: Method, params: dict, motions: MotionFeatures) -> tuple[Array, Array]:
    """Return the vertices of the garment, static, and of the body in every frame."""
    return animate(model, network, params, motions, None), jax.vmap(lambda at: pose_body(model, at))(motions.matrices)

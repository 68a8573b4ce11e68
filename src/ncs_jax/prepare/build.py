"""A scene made ready to run: set up, its motions as features, the body's surface, vibrations, and the network."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax import io
from ncs_jax.energies.terms import OwnTerm, Terms
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import InputError, required
from ncs_jax.network.methods.choose import network_from
from ncs_jax.network.methods.method import Method
from ncs_jax.network.methods.swing import Swing, as_about_the_drape
from ncs_jax.network.rollout import animated
from ncs_jax.prepare.kept import kept
from ncs_jax.prepare.mirroring import mirror_partners
from ncs_jax.prepare.moving_body import frame_features
from ncs_jax.prepare.prepared import Prepared
from ncs_jax.prepare.retarget import body_names
from ncs_jax.prepare.setting import Below, Setting, cell_of, set_up
from ncs_jax.prepare.touchable import beside_of, surface_of, touchable_faces, uppers_of
from ncs_jax.scene.features import MotionFeatures, mirror, motion_features
from ncs_jax.scene.model import Layer, Model, RitzModes, local_rotations
from ncs_jax.scene.spec import Scene
from ncs_jax.scene.step_inputs import Past, step_inputs
from ncs_jax.training.shares import Shares, Stretch, shares_of

__all__ = [
    "Assembly",
    "TrainingMotions",
    "build",
    "check_terms",
    "features_from_records",
    "tell_a_person",
    "training_features",
    "training_motions",
]

SWING = "vibrations", "energy", "slope", "by_pose", "drape"  # what `Prepared` keeps of a swing
BEYOND = 1.5  # times as far as in training may a swing go
LEAST = 0.01  # of the mean square of a training's swings, which every mode is taken to have at least
LONG = 4096  # frames of which features are made at once, at most
CELL = 8.0  # m; side of the grid from whose corners motions are measured


@dataclass(frozen=True)
class Assembly(Setting):
    """A scene made ready. `training_features` are what `track` gives; `model` is whole; `training` are all training motions."""

    network: Method
    training_features: MotionFeatures | None
    training: TrainingMotions | None = None

    @property
    def track(self) -> MotionFeatures:
        """Return all training motions end to end, in the order of the scene's files, then their mirror images if any.

        Of more than `shares.SHARE` frames they are pieces from the first motion to the last, of about so many frames.

        Raises:
            InputError: the scene is that of a loaded run, which is made ready without them.
        """
        mend = "a loaded run has no training motions: assemble its scene, ncs_jax.assemble(run.assembly.scene)"
        return required(self.training_features, "track", mend)


@dataclass(frozen=True, eq=False)
class TrainingMotions:
    """The motions that a scene trains on, in the order of its files, then their mirror images if any.

    shares: of them, where they are too many to be kept as features; see `training.shares`.
    """

    records: tuple[io.MotionRecord, ...]
    shares: Shares | None

    def features(self, model: Model, pieces: Sequence[Stretch] | None) -> tuple[MotionFeatures, np.ndarray]:
        """Return motions end to end, and the frames at which windows may end; all motions, or `pieces` of shares.

        Shares have the same shapes: the character stands still in the frames after its last piece.
        """
        if self.shares is None or pieces is None:
            found = features_from_records(model, *self.records)
            return found, np.arange(len(found.start))
        cut = [_part(self.records[piece.motion], piece.first, piece.stop) for piece in pieces]
        lengths, leads = (np.array([of(p) for p in pieces]) for of in (lambda p: p.stop - p.first, lambda p: p.lead))
        first = np.cumsum(lengths) - lengths
        ends = np.concatenate([np.arange(a + lead, a + length) for a, lead, length in zip(first, leads, lengths, strict=True)])
        if left := self.shares.size - int(lengths.sum()):
            last = _part(cut[-1], len(cut[-1].poses) - 1)
            cut.append(replace(last, poses=last.poses.repeat(left, 0), translation=last.translation.repeat(left, 0)))
        found = features_from_records(model, *cut)
        if found.origin is None:
            found = replace(found, origin=jnp.zeros((self.shares.size, 3), found.static.dtype))
        return found, ends


def _part(record: io.MotionRecord, first: int, stop: int | None = None) -> io.MotionRecord:
    """Return frames first to stop - 1 of a motion, no copies."""
    return replace(record, poses=record.poses[first:stop], translation=record.translation[first:stop])


def build(
    scene: Scene,
    *,
    prepared: Prepared | None = None,
    below: Sequence[Below] = (),
    terms: Sequence[OwnTerm] = (),
    dtype=jnp.float32,
    report: Callable[[str], None] | None = None,
    ahead: Callable[[Assembly], None] | None = None,
) -> Assembly:
    """Read every file of a scene, check that they fit together, and precompute all that does not change.

    Args:
        scene: from `load_scene`. prepared: that of a run, which needs no training motion any more; None: it is found out here.
        below: the trained garments of `garment.over`, each with the body that it was trained on. terms: of one's own.
        dtype: of all arrays; float64 needs JAX's x64 mode. report: called with what is done next, in words; without
            one, what takes long is told on stderr in a terminal or a notebook, and nothing elsewhere.
        ahead: called before vibrations are looked for, with what is expected: zeros in their place.

    Raises:
        InputError: a file is unusable, joint counts disagree, units are off, the garment is not on the body, or a term needs a
            past that a swing trains without.
    """
    setting = set_up(scene, prepared=prepared, below=below, dtype=dtype, report=report)
    automatic, scene = scene.network.cell == "auto", setting.scene
    model, body, track, faces, training = setting.model, setting.body, None, None, None
    if body is not None and body.frames is not None:
        track, scene = frame_features(model, body, setting.prepared.part), scene.without_network()
    elif prepared is None:
        training = training_motions(setting)
        track = training_features(training, model)
    prepared = setting.prepared
    if model.body is not None and body is not None:
        faces = touchable_faces(model, body, prepared.part)
        smooth = scene.physics.collision.distance == "smooth"
        model = replace(model, surface=surface_of(model, faces, track, smooth=smooth, pieces=prepared.pieces))
        if scene.physics.collision.distance == "plane":
            model = replace(model, beside=beside_of(model))
    if setting.garment.layers and model.surface is not None:
        uppers = uppers_of(model, setting.garment.layers, track, prepared.pieces)
        model = replace(model, garment=replace(model.garment, uppers=uppers))
    if scene.network.method == "ncs" and scene.network.cell == "swing" and model.terms.inertia:
        if not prepared.vibrations.size and not (automatic and track is None):  # found before to have none
            known = required(track, "vibrations", "train again into a new folder")
            check_terms(model, terms, known, past=False)  # before a minute is spent

            def begin() -> None:
                (report or tell_a_person)("finding the garment's vibrations, which may take a minute")
                if ahead is not None:
                    ahead(_expected(setting, model.with_terms(terms) if terms else model, known))

            prepared = _with_vibrations(scene, prepared, model, faces, known, begin)
        scene = cell_of(scene, prepared.vibrations.size > 0, automatic)
        model = replace(model, vibrations=vibrations_of(prepared, dtype) if prepared.vibrations.size else None)
    network = network_from(scene, model)
    if terms:
        if track is not None and not isinstance(network, Swing):
            check_terms(model, terms, track, past=True)
        model = model.with_terms(terms)
    return Assembly(scene, prepared, model, body, setting.garment, setting.motions, network, track, training)


def check_terms(model: Model, terms: Sequence[OwnTerm], track: MotionFeatures, *, past: bool) -> None:
    """See that terms of one's own are energies, and do without a past where a swing is trained; nothing is computed.

    Raises:
        InputError: one is not a scalar, cannot be traced, or needs a past that there is not.
    """
    own, alone = model.with_terms(terms), Terms(None, False, None, gravity=False, inertia=False, own=tuple(terms))

    def energies(x, matrices):
        step = step_inputs(own, matrices, Past(x, x, x) if past else None)
        return energy_terms(x, model.garment, model.material, step, alone)

    jax.eval_shape(energies, model.garment.mesh.rest, jax.ShapeDtypeStruct(track.matrices.shape[1:], track.matrices.dtype))


def training_features(training: TrainingMotions, model: Model) -> MotionFeatures:
    """Return what `Assembly.track` gives."""
    return training.features(model, None if training.shares is None else training.shares.spread())[0]


def training_motions(setting: Setting) -> TrainingMotions:
    """Return the training motions, with their mirror images if wanted; one frame at rest where there is none."""
    scene, model, body = setting.scene, setting.model, setting.body
    motions = [setting.motions[name] for name in scene.motion.files]
    if not motions:
        joints = 1 if body is None else len(body.parents)
        motions = [io.MotionRecord(np.zeros((1, joints, 3), np.float32), np.zeros((1, 3), np.float32), model.fps, ())]
    elif scene.motion.mirror and body is not None:
        try:
            partner, axis = mirror_partners(body_names(body), body.joints, body.parents)
        except InputError as error:
            raise InputError(error.expected, file=scene.source, field=error.field, value=error.value, mend=error.mend) from None
        given = partner, axis, body.rest_rotations
        mirrored = [io.MotionRecord(*mirror(r.poses, r.translation, *given), r.fps, r.joint_names) for r in motions]
        motions = motions + mirrored
    return TrainingMotions(tuple(motions), shares_of([len(r.poses) for r in motions], scene.training.window))


def tell_a_person(words: str) -> None:
    """Write what takes long to stderr, where a person sees it: in a terminal or a notebook."""
    shell = sys.modules.get("IPython")
    if sys.stderr.isatty() or (shell is not None and shell.get_ipython() is not None):
        sys.stderr.write(f"ncs_jax: {words} ...\n")


def _with_vibrations(scene: Scene, prepared: Prepared, model: Model, faces, track: MotionFeatures, begin) -> Prepared:
    """Add the garment's vibrations, if any, found with smooth contact, because a simulation converges with no other."""
    from ncs_jax.simulation.ritz_modes import softest_ritz_modes

    smooth, count = model, scene.network.vibrations
    if faces is not None:
        surface = surface_of(model, faces, track, smooth=True, pieces=prepared.pieces)
        smooth = replace(model, terms=replace(model.terms, collision="smooth"), surface=surface)

    def found() -> dict[str, np.ndarray] | None:
        begin()
        modes = softest_ritz_modes(smooth, track.matrices[track.middle()], count)
        if modes is None:
            return None
        modes = replace(modes, by_pose=as_about_the_drape(model, count))
        slope = _range(scene, replace(model, vibrations=modes), track)
        arrays = modes.directions, modes.energy, slope, modes.by_pose, modes.drape
        return {name: np.asarray(array) for name, array in zip(SWING, arrays, strict=True)}

    return replace(prepared, **(kept(SWING, found, smooth, track, str(scene.network)) or {}))


def _expected(setting: Setting, model: Model, track: MotionFeatures) -> Assembly:
    """Return what a scene becomes whose garment has all the vibrations that it may have: of zeros, as they are not known."""
    scene, basis = setting.scene, model.basis
    count, zeros = scene.network.vibrations, functools.partial(np.zeros, dtype=basis.dtype)
    by_pose = as_about_the_drape(setting.model, count).shape
    shapes = (len(basis), 3, count), (), (count, count), by_pose, (len(basis), 3)
    modes = RitzModes(*(jax.device_put(zeros(shape)) for shape in shapes))
    setting = replace(setting, model=replace(model, vibrations=modes))
    return Assembly(**vars(setting), network=network_from(scene, setting.model), training_features=track)


def _range(scene: Scene, model: Model, track: MotionFeatures) -> np.ndarray:
    """Return what bounds a swing of the garment that a fresh network gives, next to that of skinning."""
    from ncs_jax.training.step import initial_state

    network = network_from(scene, model)  # by the programs that training begins with
    return swing_range(network, initial_state(model, network, 0).params, model, track)


def swing_range(network: Method, params: dict, model: Model, track: MotionFeatures) -> np.ndarray:
    """Return what bounds a swing, S + W (modes, modes): its linear range, and what the training motions show a network of it.

        W = C^-1 / (b^2 max_t q_t^T C^-1 q_t),   C = mean q q^T + e tr(mean q q^T) / modes I,   b = BEYOND,   e = LEAST

    q are the training's swings of the network's garment, with the slope S of the model alone. One that is b times as far as
    any of them has q^T W q = 1, by how far they go in its own direction.
    """
    from ncs_jax.training.step import refreshed

    q = np.asarray(refreshed(network, params, model, track)["swing"], np.float64)
    spread, slope = q.T @ q / len(q), np.asarray(required(model.vibrations, "vibrations").slope, np.float64)
    if not spread.any():
        return slope
    inverse = np.linalg.inv(spread + LEAST * np.trace(spread) / len(spread) * np.eye(len(spread)))
    return slope + inverse / (BEYOND**2 * np.einsum("tk,kl,tl->t", q, inverse, q).max())


def vibrations_of(prepared: Prepared, dtype) -> RitzModes:
    """Return what was prepared of a swing; without slope it is of a run of an earlier version."""
    found = (jnp.asarray(a, dtype) if a.size else None for a in (prepared.slope, prepared.by_pose, prepared.drape))
    return RitzModes(jnp.asarray(prepared.vibrations, dtype), jnp.asarray(prepared.energy, dtype), *found)


def features_from_records(model: Model, *records: io.MotionRecord, apart: bool = False) -> MotionFeatures:
    """Return descriptors and transforms of motions that are at the model's frame rate, end to end.

    Each motion is measured from the corner, nearest to where it begins, of a grid of `CELL` m. apart: in each frame the
    character stands still, as in a motion of its own.
    """
    dtype = model.skeleton.joints.dtype
    lengths = [len(r.poses) for r in records]
    start = np.arange(sum(lengths)) if apart else np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    poses = np.concatenate([r.poses for r in records])
    origins = [CELL * np.round(r.translation[0].astype(np.float64) / CELL) for r in records]
    near = np.concatenate([r.translation - origin for r, origin in zip(records, origins, strict=True)])
    found = _in_parts(model, poses.astype(dtype), near.astype(dtype), start.astype(np.int32))
    if model.under:
        layers = jnp.concatenate([_layer_transforms(layer, records, origins, dtype, apart) for layer in model.under], axis=1)
        found = replace(found, matrices=jnp.concatenate([found.matrices, layers], axis=1))
    return replace(found, origin=jnp.asarray(np.repeat(origins, lengths, axis=0), dtype)) if np.any(origins) else found


def _in_parts(model: Model, poses: np.ndarray, translation: np.ndarray, start: np.ndarray) -> MotionFeatures:
    """Return `motion_features`, of more than `LONG` frames in parts, each with the two frames before it."""
    frames = len(start)
    if frames <= LONG:
        rotations = local_rotations(model, jnp.asarray(poses))
        return motion_features(model, rotations, jnp.asarray(translation), jnp.asarray(start))
    parts = []
    for first in range(0, frames, LONG):
        at = np.arange(first - 2, first + LONG).clip(0, frames - 1)
        local = local_rotations(model, jnp.asarray(poses[at]))
        found = motion_features(model, local, jnp.asarray(translation[at]), jnp.asarray(np.maximum(start[at] - first + 2, 0)))
        parts.append([np.asarray(a)[2 : 2 + frames - first] for a in (found.static, found.dynamic, found.matrices)])
    static, dynamic, matrices = (jnp.asarray(np.concatenate(each)) for each in zip(*parts, strict=True))
    return MotionFeatures(static, dynamic, matrices, jnp.asarray(start))


def _layer_transforms(layer: Layer, records, origins, dtype, apart: bool) -> Float[Array, "frames verts 3 4"]:
    """Return what takes each vertex of a garment below from its rest to its place, measured from the motions' origins."""
    x = [
        animated(layer.model, layer.network, layer.params, features_from_records(layer.model, record, apart=apart)) - origin
        for record, origin in zip(records, origins, strict=True)
    ]
    offsets = jnp.asarray(np.concatenate(x), dtype) - layer.rest
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*offsets.shape[:2], 3, 3))
    return jnp.concatenate([eye, offsets[..., None]], axis=-1)

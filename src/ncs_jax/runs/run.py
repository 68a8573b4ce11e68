"""Open a trained garment from its run folder; animate, measure and export it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.energies.terms import OwnTerm
from ncs_jax.errors import InputError, check_alpha
from ncs_jax.export.facts import FileFormat
from ncs_jax.export.write import Exported, export
from ncs_jax.metrics.coverage import Coverage, TrainedMotion, coverage, trained_motion, with_strain
from ncs_jax.metrics.quality import measure, measure_on_host
from ncs_jax.metrics.seen import EVERY, measure_seen
from ncs_jax.network.compression import compress
from ncs_jax.network.methods.method import Method, check_network
from ncs_jax.network.rollout import animated, first_broken
from ncs_jax.prepare.build import Assembly, build, features_from_records, training_features, training_motions
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.prepared import Prepared
from ncs_jax.prepare.setting import Below
from ncs_jax.runs.checkpoint import Checkpoints, read_prepared, read_run, read_trained
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Layer, Model
from ncs_jax.scene.spec import Scene, scene_from
from ncs_jax.training.step import initial_state

__all__ = ["NetworkMaker", "Run", "assemble", "check_own", "load_run", "own_names", "read_animation_over", "worn_below"]


ASKED = 1024  # frames of a motion, at most, of which the strain is asked

NetworkMaker = Callable[[Scene, Model], Method]  # makes a network of one's own, sized for a model


@dataclass(frozen=True)
class Run:
    """A trained garment: its scene made ready, and the parameters."""

    assembly: Assembly
    params: dict
    steps: int = 0
    lacking: tuple[str, ...] = ()  # names of own terms that it was trained with and that were not given again
    trained: TrainedMotion | None = None  # what it was trained on, if that is known

    def track(self, motion: str | io.MotionRecord | MotionFeatures) -> MotionFeatures:
        """Return a motion, ready to animate: a file, `ncs:NAME`, one as the scene names it, or a record of poses.

        Raises:
            InputError: the motion cannot be read, is not in metres, or does not fit the body.
        """
        if isinstance(motion, MotionFeatures):
            return motion
        record = self.motion(motion) if isinstance(motion, str) else motion
        return features_from_records(self.assembly.model, record)

    def motion(self, name: str) -> io.MotionRecord:
        """Return a motion at the scene's frame rate; a path that the scene does not name is taken from the current folder.

        Raises:
            InputError: the motion cannot be read, is not in metres, or does not fit the body.
        """
        a = self.assembly
        if name in a.motions:
            return a.motions[name]
        known = name.startswith("ncs:") or name in (*a.scene.motion.files, *a.scene.motion.validation)
        return load_motion(a.scene, name if known else str(Path(name).absolute()), a.body)

    def animate(
        self,
        motion: str | io.MotionRecord | MotionFeatures,
        alpha: float = 1.0,
        *,
        refine: int = 0,
        outside: bool = False,
        report: Callable[[int, int], None] | None = None,
    ) -> np.ndarray:
        """Return garment vertices (frames, verts, 3) in m over a motion; alpha sets how much it moves.

        refine: iterations of the solver on every frame, see `simulation.refinement`; `report` is called after each with the
        frame, and of how many. outside: what lies inside the body, or too near to it, is put outside in each frame by itself,
        see `runs.outside`; no energy is asked, and a network is measured without it.

        Raises:
            InputError: alpha is not from 0 to 10; or a vertex is not finite: where, and what was so first.
        """
        check_alpha(alpha)
        track = self.track(motion)
        a = self.assembly
        x = animated(a.model, a.network, self.params, track, alpha)
        if not np.isfinite(np.sum(x)):
            what = motion if isinstance(motion, str) else "a track"
            broken = first_broken(a.model, a.network, self.params, track, float(alpha))
            raise InputError(
                "finite vertices expected", file=what, field=broken, value=f"alpha {alpha:g}", mend="see ncs check"
            )
        if refine < 0:
            raise InputError("no fewer than 0 iterations expected", field="refine", value=refine)
        if refine:
            self.check_terms()
            from ncs_jax.runs.refine import refined  # the solver, which is not loaded otherwise

            x = refined(a, track, x, refine, report)
        if not outside:
            return x
        from ncs_jax.runs.outside import outside_body

        return outside_body(a.model, track, x)

    def compressed(self, motion: str | io.MotionRecord | MotionFeatures, *, rank: int = 0, bfloat16: bool = False) -> Run:
        """Return this garment with a smaller decoder, made for what it does in a motion: see `compression.compress`.

        Raises:
            InputError: the motion has no such rank.
        """
        a, track = self.assembly, self.track(motion)
        try:
            network, params = compress(a.network, self.params, a.model, track, rank=rank, bfloat16=bfloat16)
        except ValueError as fault:
            raise InputError(str(fault), field="--rank", value=rank) from fault
        return replace(self, assembly=replace(a, network=network), params=params)

    def export(
        self,
        file: str | Path,
        *,
        format: str = "onnx",
        rank: int = 0,
        float16: bool = False,
        opset: int = 15,
        motion: str | None = None,
    ) -> Exported:
        """Write one step for hosts without this package, checked over a motion: see `export.write.export`.

        Args:
            rank: of a smaller decoder, see `compressed`. motion: to be smaller for and to check on; else the scene's first one,
                of those for validation if it has any.
        """
        scene = self.assembly.scene
        motion = motion or next(iter((*scene.motion.validation, *scene.motion.files)), None)
        smaller = self
        if rank:
            if motion is None:
                raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
            smaller = self.compressed(motion, rank=rank)
        return export(
            smaller.assembly,
            smaller.params,
            file,
            FileFormat(format, float16, opset),
            motion=None if motion is None else self.motion(motion),
            trained=(self.assembly.network, self.params) if rank or float16 else None,
            beyond=None if motion is None or (found := self.coverage(motion)) is None else {"motion": motion, **found.facts()},
        )

    def check_terms(self) -> None:
        """Raise an InputError where the run was trained with terms that were not given again: its energies lack them."""
        if self.lacking:
            mend = "open it with ncs_jax.load_run(folder, terms=[...])"
            what = "the run's own terms are needed to measure its energies"
            raise InputError(what, field="terms", value=self.lacking, mend=mend)

    def evaluate(
        self, motion: str | io.MotionRecord | MotionFeatures, alpha: float = 1.0, *, exact: bool = True, seen: int = EVERY
    ) -> dict[str, np.ndarray]:
        """Return physical quantities per frame: see `metrics.quality.QUANTITIES` and `metrics.quality.measure`.

        Of a run that knows what it was trained on, `outside` says which frames are beyond that, see `coverage`. What a person
        sees is of one frame in `seen`, and of none for 0 or where the measures are not `exact`, see `metrics.seen`.
        """
        self.check_terms()
        model, track = self.assembly.model, self.track(motion)
        x = self.animate(track, alpha)
        rows = (measure_seen(model, x, track, seen) if exact and seen else {}) | measure(model, x, track, exact=exact)
        found = None if self.trained is None else self.coverage(track, x)
        return rows if found is None else rows | {"outside": 100.0 * found.outside}

    def coverage(self, motion: str | io.MotionRecord | MotionFeatures, vertices: np.ndarray | None = None) -> Coverage | None:
        """Return how far each frame of a motion is from the poses and speeds that the run was trained on, and how strained.

            found = run.coverage("dance.bvh")
            found.share, found.worst   # of the frames that are beyond; frame, joint, and whether by its pose or its speed

        vertices: what `animate` gives for this motion, where that is there already. None is returned where nobody knows: of a
        run of an earlier version whose motions cannot be read any more.
        """
        a, trained = self.assembly, self.known
        if trained is None:
            return None
        names, track, strain, every = a.body.joint_names if a.body is not None else (), self.track(motion), None, 1
        if trained.strain:
            x = self.animate(track) if vertices is None else vertices
            every = -(-len(x) // ASKED)
            strain = measure_on_host(a.model, x[::every])["strain_mean"]
        return coverage(trained, a.model, track, names=names, moving=a.network.state > 0, strain=strain, every=every)

    @functools.cached_property
    def known(self) -> TrainedMotion | None:
        """Return what the run was trained on, found again from the motions of its scene where it was not kept as a whole.

        Its strain is kept at the end of a training: one that was interrupted has none, nor has a run of an earlier version.
        """
        a, trained = self.assembly, self.trained
        if not a.scene.motion.files or (trained is not None and len(trained.frames)):
            return trained
        try:
            motions = {name: self.motion(name) for name in a.scene.motion.files}
            track = training_features(training_motions(replace(a, motions=motions)), a.model)
            x = self.animate(track)
        except InputError:  # a file is gone, or what was learned is not finite there
            return trained
        trained = trained_motion(a.model, track) if trained is None else trained
        frames = np.arange(len(x))
        return with_strain(trained, a.model, track, frames, lambda some: measure_on_host(a.model, x[some])["strain_mean"])


def load_run(folder: str | Path, *, terms: Sequence[OwnTerm] = (), network: NetworkMaker | None = None) -> Run:
    """Load a run folder: the scene from its JSON, the parameters from its newest checkpoint.

    Args:
        terms, network: those of one's own that the run was trained with, which a folder keeps by name alone. Without the terms
            the garment can be animated, and energies cannot be measured.

    Raises:
        InputError: not a run folder, a file of its scene is gone, or terms or network are not those of the run.
    """
    folder = Path(folder)
    facts = read_run(folder)
    check_own(facts, folder, terms if terms else None, network)
    scene = scene_from(facts["scene"], source=str(folder / "run.json"))
    assembly = assemble(scene, prepared=read_prepared(folder), terms=terms, network=network)
    if not (folder / "checkpoints").is_dir():
        raise InputError("no checkpoint there yet", file=folder, mend="train it with ncs train --resume")
    checkpoints = Checkpoints(folder)
    step = checkpoints.latest()
    if step is None:
        raise InputError("no checkpoint there yet", file=folder, mend="train it with ncs train --resume")
    like = jax.eval_shape(lambda: initial_state(assembly.model, assembly.network, 0))
    lacking = () if terms else tuple(facts.get("terms", ()))
    return Run(assembly, checkpoints.restore(like).params, step, lacking, read_trained(folder, assembly.model))


def own_names(terms: Sequence[OwnTerm], network: NetworkMaker | None) -> dict:
    """Return what run.json says of terms and a network of one's own: their names, nothing where there are none."""
    names = {"terms": [term.__name__ for term in terms], "network": getattr(network, "__name__", "")}
    return {key: value for key, value in names.items() if value}


def check_own(facts: dict, folder: Path, terms: Sequence[OwnTerm] | None, network: NetworkMaker | None) -> None:
    """See that terms (None: not asked for) and network are those that a run was trained with, by their names.

    Raises:
        InputError: they are not.
    """
    given = own_names(terms or (), network)
    for key, asked in (("terms", terms is not None), ("network", True)):
        expected = facts.get(key)
        if asked and given.get(key) != expected:
            mend = f"in Python, give {key}=...: the commands have none of one's own"
            mend = mend if expected else f"leave {key} out, or begin a new run"
            what = f"the run's own {key} expected, {expected or 'of which it has none'}"
            raise InputError(what, file=folder, field=key, value=given.get(key, "none"), mend=mend)


def assemble(
    scene: Scene,
    *,
    prepared: Prepared | None = None,
    terms: Sequence[OwnTerm] = (),
    network: NetworkMaker | None = None,
    dtype=jnp.float32,
    report: Callable[[str], None] | None = None,
    ahead: Callable[[Assembly], None] | None = None,
) -> Assembly:
    """Make a scene ready: read its files and the runs of the garments worn below, check that they fit, precompute the rest.

    Args:
        scene: from `load_scene`. prepared: of a run, which needs no training motion any more; else found out here.
        terms: of one's own, beside the scene's, see `energies.terms.OwnTerm`. network: a function of one's own,
            (scene, model) -> network, see `network.methods.method.Method`; else the scene's.
        dtype: of everything; float64 needs JAX's x64 mode. report: called with what is done next, in words; without one, what
            takes long is told on stderr in a terminal or a notebook, and nothing elsewhere. ahead: called before that with
            what is expected, zeros in the place of the vibrations, so that programs can be compiled meanwhile.

    What takes long are the vibrations of `network.cell = "swing"`. Energies need none: with "gated" none are looked for.

    Raises:
        InputError: a file is unusable, joint counts disagree, units are off, the garment is not on the body, or a term or the
            network does not fit.
    """
    if network is not None and scene.network.cell == "auto":  # one's own needs no vibrations, unless the scene asks for them
        scene = replace(scene, network=replace(scene.network, cell="gated"))
    ahead = ahead if network is None else None  # one's own may look at the vibrations
    assembly = build(scene, prepared=prepared, below=worn_below(scene), terms=terms, dtype=dtype, report=report, ahead=ahead)
    if network is None:
        return assembly
    made = network(scene, assembly.model)
    check_network(made, assembly.model)
    return replace(assembly, network=made)


def worn_below(scene: Scene) -> list[Below]:
    """Return the trained garments that a scene's garment is worn over, each with the body that it was trained on."""
    runs = [load_run(scene.path(name)) for name in scene.garment.over]
    return [(run.assembly.body, Layer(run.assembly.model, run.params, run.assembly.network)) for run in runs]


def read_animation_over(file: str | Path, model: Model, track: MotionFeatures) -> np.ndarray:
    """Return an animation of the model's garment over a motion from a file, (frames, verts, 3) float32 in m.

    Raises:
        InputError: it has other frames or vertices.
    """
    vertices = np.asarray(io.read_animation(file).vertices, np.float32)
    expected = (track.start.shape[0], *model.garment.mesh.rest.shape)
    if vertices.shape != expected:
        raise InputError(
            f"frames, vertices and 3 of the motion expected, {expected}", file=file, field="vertices", value=vertices.shape,
            mend="give the --motion and --scene that it was made from",
        )  # fmt: skip
    return vertices

"""Adapt a trained garment to motions: go on training it on them alone, for some seconds, and keep what is better there.

A garment has the energy of a simulation where it was trained, and more on motion that it has never seen. As no data is needed,
the very clip that is to be animated can be trained on.
"""

from __future__ import annotations

import hashlib
import math
import time
import warnings
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path

import jax
import numpy as np

from ncs_jax.errors import InputError, InputWarning
from ncs_jax.geometry.skinning import blend_from
from ncs_jax.io import MotionRecord
from ncs_jax.metrics.quality import summarise
from ncs_jax.prepare.build import Assembly, TrainingMotions, training_features
from ncs_jax.prepare.touchable import covered_by_layers, touchable, touchable_part, turned_away
from ncs_jax.runs.begin import unread_joints
from ncs_jax.runs.checkpoint import Checkpoints, check_writable, read_run, read_trained, write_run
from ncs_jax.runs.log import Report
from ncs_jax.runs.placed_scene import begin_programs
from ncs_jax.runs.run import Run, assemble, load_run
from ncs_jax.runs.train import Begun, train_assembly
from ncs_jax.scene.motion_names import split_frames
from ncs_jax.scene.spec import Scene
from ncs_jax.training.batches import CHUNK
from ncs_jax.training.programs import Programs
from ncs_jax.training.step import initial_state

__all__ = ["Adapted", "adapt", "adapted_folder"]

AUGMENTED = 0.25  # share of a batch that gets another frame's swing
FILLED = 512  # frames in whole blocks of which a clip is trained on, so that clips of many lengths share their programs
NEAR = 0.03  # m; skin that comes so near to the garment, as the body carries it, is touched
SEEN = 60  # poses in which that is looked for
MEASURES = ("total", "penetrating", "depth_max")
LONGEST = 80  # letters of a name


@dataclass(frozen=True)
class Adapted:
    """A garment adapted to motions.

    Attributes:
        run: the garment, with the weights that have the least energy on the motions: the adapted ones, or those before.
        before, after: `total` in J, `penetrating` in % and `depth_max` in mm over the motions, of the run as it was, and now.
        seconds: for which it has been adapted in all, in `run.steps` steps. kept: whether it is better than the run as it was.
        folder: where it is kept, if it is.
    """

    run: Run
    before: dict[str, float]
    after: dict[str, float]
    seconds: float
    kept: bool
    folder: Path | None

    def __str__(self) -> str:
        """Return in three lines what it was and what it is."""
        what = f"adapted for {self.seconds:g} s, {self.run.steps} steps"
        lines = [f"before:  {_told(self.before)}", f"after:   {_told(self.after)}, {what}"]
        if not self.kept:
            lines[1] = f"after:   no less energy, {what}: the weights of the run are kept"
        return "\n".join(lines if self.folder is None else [*lines, f"kept:    {self.folder}"])


def _told(measures: dict[str, float]) -> str:
    """Return energy and skin in words."""
    text = f"total {measures['total']:.4g} J"
    if "penetrating" in measures:
        text += f", {measures['penetrating']:.3g} % of vertices inside, the deepest {measures['depth_max']:.3g} mm"
    return text


def adapt(
    run: Run | str | Path,
    motions: str | Sequence[str],
    seconds: float = 20.0,
    out: str | Path | None = None,
    *,
    report: Callable[[Report], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> Adapted:
    """Go on training a run on motions alone, for some seconds from the first step on; keep the weights that are better there.

    It is for these motions: what the run knew of others, it forgets.

        adapted = ncs_jax.adapt("runs/tshirt", "dance.bvh", seconds=20)
        vertices = adapted.run.animate("dance.bvh")

    Args:
        run: the run, or its folder; of one with own terms or an own network, the run that `load_run` opens with these. It stays
            as it is. motions: one or several, as `Run.animate` takes their names.
        seconds: of training in all. Asked again for more, with the same folder, it goes on for what is left.
        out: run folder to keep it in, as `adapted_folder` names it, for example; None keeps nothing.
        report, say: see `runs.train.train`; KeyboardInterrupt from `report` ends it with a checkpoint, from which it goes on.

    Learning rate and optimiser begin anew. Which skin the garment can touch is found again
    where the motions bring other skin near it.

    Raises:
        InputError: a motion cannot be read, `seconds` is not positive, or `out` is another run, adapted to other motions.
    """
    since, run = time.monotonic(), run if isinstance(run, Run) else load_run(run)
    run.check_terms()
    if not (math.isfinite(seconds) and seconds > 0):
        raise InputError("a number of seconds above 0 expected", field="--adapt", value=seconds)
    out, say = None if out is None else Path(out), say or (lambda words: None)
    scene, records = _scene_on(run, motions)
    about = {"motions": list(records), "of": _digest(run, list(records.values()))}
    facts = _facts_of(out, about)
    begins = replace(run, assembly=_assembly_on(run, scene, records), steps=0, trained=None)
    now, spent = _standing(out, facts, begins)
    told = {} if facts is None else facts["adapted"]
    if spent >= seconds and "after" in told:
        return Adapted(now, told["before"], told["after"], told["seconds"], told["kept"], out)
    programs = Programs()
    begin_programs(programs, begins.assembly, CHUNK)  # while it is measured
    say("compiling, and measuring the garment on " + ", ".join(records))
    best = _Best(begins, told.get("before"))
    if now.steps:
        best(now.params)
    told = {**about, "seconds": seconds, "before": best.before}
    said = {"start": str(Path(run.assembly.scene.source).parent), **_own_facts(run, out), "adapted": told}
    begun = Begun(None if facts is None else facts | said, said, run.params, scene.training.seed, since, now.trained)
    left = None, (seconds - spent) / 60
    say("compiling what trains it")
    adapted = train_assembly(begins.assembly, out, begun, left, programs=programs, report=report, settle=best)
    told |= {"after": best.measures, "kept": best.measures is not best.before}
    if out is not None:
        write_run(out, read_run(out) | {"adapted": told})
    return Adapted(adapted, best.before, best.measures, seconds, told["kept"], out)


class _Best:
    """The weights that have the least energy on the motions of a scene, of those that it is called with; and `measures`."""

    def __init__(self, run: Run, measures: dict[str, float] | None):
        """Begin with those of a run, and what is measured of it if that is known."""
        self._run, self._params, self.before = run, run.params, measures or _measured(run)
        self.measures = self.before

    def __call__(self, params: dict) -> dict:
        """Return the best weights, these included; of equal ones the first."""
        measures = _measured(replace(self._run, params=params))
        if measures["total"] < self.measures["total"]:
            self._params, self.measures = params, measures
        return self._params


def _standing(out: Path | None, facts: dict | None, begins: Run) -> tuple[Run, float]:
    """Return the run as its adaptation in a folder stands, and how many seconds were spent on it."""
    if out is None or facts is None:
        return begins, 0.0
    checkpoints, a = Checkpoints(out), begins.assembly
    steps = checkpoints.latest()
    if steps is None:
        raise InputError("no checkpoint there yet", file=out, mend="delete this folder")
    state = checkpoints.restore(jax.eval_shape(lambda: initial_state(a.model, a.network, 0)))
    now = replace(begins, params=state.params, steps=steps, trained=read_trained(out, a.model))
    return now, facts["adapted"]["seconds"] * (steps / max(facts["steps"], 1))


def _facts_of(out: Path | None, about: dict) -> dict | None:
    """Return what run.json says of the adaptation to go on with, None for a new one.

    Raises:
        InputError: the folder cannot be written, or has something else in it.
    """
    if out is None:
        return None
    check_writable(out)
    if not (out / "run.json").exists():
        return None
    facts = read_run(out)
    expected = f"a run adapted to {', '.join(about['motions'])} expected"
    there = facts.get("adapted")
    if there is None or there["motions"] != about["motions"]:
        value = "another run" if there is None else ", ".join(there["motions"])
        raise InputError(expected, file=out, value=value, mend="name another folder")
    if there["of"] != about["of"]:
        what = "one made before the motion, or the run that it began from, was changed"
        raise InputError(expected, file=out, value=what, mend="delete this folder, or name another one")
    return facts


def _own_facts(run: Run, out: Path | None) -> dict:
    """Return what run.json is to say of terms and a network of one's own."""
    a = run.assembly
    source = Path(a.scene.source)
    facts = read_run(source.parent) if source.name == "run.json" else {}
    if out is not None and "network" not in facts and not type(a.network).__module__.startswith("ncs_jax."):
        mend = "open it from its folder, ncs_jax.load_run(folder, network=...), or keep nothing"
        raise InputError("a run in a folder expected, as its network is one's own", field="run", mend=mend)
    terms = [term.__name__ for term in a.model.terms.own]
    return ({"terms": terms} if terms else {}) | {key: facts[key] for key in ("network",) if key in facts}


def _scene_on(run: Run, motions: str | Sequence[str]) -> tuple[Scene, dict[str, MotionRecord]]:
    """Return the scene of a run with motions in the place of its own, and these by their names there, with whole paths."""
    given, scene = [motions] if isinstance(motions, str) else list(motions), run.assembly.scene
    if not given:
        raise InputError("a motion is needed", field="motion", mend="give one")
    records: dict[str, MotionRecord] = {}
    own: dict[str, dict] = {}
    for name in given:
        file = split_frames(name)[0]
        path = scene.path(file) if name in scene.motions else Path(file).expanduser()
        whole = (file if file.startswith("ncs:") else str(path.resolve())) + name.removeprefix(file)
        records[whole] = run.motion(name)
        own |= {whole: settings} if (settings := scene.own_settings(name if name in scene.motions else whole)) else {}
    motion = replace(scene.motion, files=tuple(records), validation=(), mirror=False, own=own)
    augmented = min(AUGMENTED, scene.training.motion_augmentation)
    training = replace(scene.training, motion_augmentation=augmented, recombined=0.0)
    return replace(scene, motion=motion, training=training), records


def _digest(run: Run, records: Sequence[MotionRecord]) -> str:
    """Return a word for the weights of a run and for motions, another one for others."""
    found = hashlib.sha256()
    for array in (*jax.tree.leaves(run.params), *(a for r in records for a in (r.poses, r.translation))):
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]


def _assembly_on(run: Run, scene: Scene, records: dict[str, MotionRecord]) -> Assembly:
    """Return a run's scene ready to train on motions; it can touch the skin that they bring near, too."""
    a = run.assembly
    part = _part(a, list(records.values()))
    if len(part) > len(a.prepared.part):
        prepared, terms, dtype = replace(a.prepared, part=part), tuple(a.model.terms.own), a.model.basis.dtype
        a = assemble(scene, prepared=prepared, terms=terms, network=lambda scene, model: run.assembly.network, dtype=dtype)
    training = TrainingMotions(tuple(_filled(list(records.values()))), None)
    track = training_features(training, a.model)
    a = replace(a, scene=scene, motions=dict(records), training=training, training_features=track)
    if unread := unread_joints(a):
        told = f"the network does not read joints that turn in the motions: {', '.join(unread)}"
        warnings.warn(f"{told}; what they do to the garment is not learned", category=InputWarning, stacklevel=3)
    return a


def _part(a: Assembly, records: Sequence[MotionRecord]) -> np.ndarray:
    """Return the numbers of the body vertices that the garment can touch, in these motions too."""
    part, body = a.prepared.part, a.body
    if body is None or not a.scene.physics.collision.stiffness > 0:
        return part
    poses = np.concatenate([r.poses for r in records])
    some = poses[np.unique(np.linspace(0, len(poses) - 1, SEEN).astype(int))]
    blend = blend_from(a.prepared.weights)
    near = touchable(body, a.garment.vertices, blend, some, NEAR)
    near = np.flatnonzero(near & ~turned_away(body, a.garment, blend, some, a.scene.physics.collision.reach))
    if a.model.under:
        near = near[~covered_by_layers(body, a.model.under)[near]]
    if not np.setdiff1d(near, part).size:
        return part  # of the same size, so that its programs are there
    more = touchable_part(a.scene, body, a.garment, a.prepared.weights, records)
    if a.model.under:
        more = more[~covered_by_layers(body, a.model.under)[more]]
    return np.union1d(part, more)


def _filled(records: Sequence[MotionRecord]) -> list[MotionRecord]:
    """Return motions, and beginnings of them once more, so that all their frames fill whole blocks of `FILLED`."""
    filled = list(records)
    missing = -sum(len(r.poses) for r in records) % FILLED
    for record in cycle(records):
        if not missing:
            return filled
        count = min(missing, len(record.poses))
        filled.append(replace(record, poses=record.poses[:count], translation=record.translation[:count]))
        missing -= count
    return filled


def _measured(run: Run) -> dict[str, float]:
    """Return energy and skin of a garment over all frames of the motions of its scene."""
    rows = [run.evaluate(name, seen=0) for name in run.assembly.scene.motion.files]
    return summarise({key: np.concatenate([r[key] for r in rows]) for key in MEASURES if key in rows[0]})


def adapted_folder(run: str | Path, motions: str | Sequence[str]) -> Path:
    """Return where a run that is adapted to motions is kept: beside it, RUN_adapted_MOTION."""
    names = [motions] if isinstance(motions, str) else list(motions)
    files = [(Path(file.removeprefix("ncs:")).stem, frames) for file, frames in map(split_frames, names)]
    stems = [stem if frames is None else "_".join(map(str, (stem, *frames))) for stem, frames in files]
    text = "_".join(stems)
    if len(text) > LONGEST:
        text = f"{stems[0][:LONGEST]}_and_{len(stems) - 1}_more_{zlib.crc32(text.encode()):08x}"
    folder = Path(run)
    return folder.parent / f"{folder.resolve().name}_adapted_{text}"

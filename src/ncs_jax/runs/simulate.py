"""Simulate a scene's garment over a motion, frame by frame, with progress and resumption."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.energies.inertia import out_of_balance
from ncs_jax.energies.terms import OwnTerm, StepInputs
from ncs_jax.energies.total import energy_terms
from ncs_jax.errors import InputError
from ncs_jax.geometry.skinning import skin
from ncs_jax.io.tables.npz import read_npz, write_npz
from ncs_jax.prepare.build import Assembly, features_from_records, tell_a_person
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import Model
from ncs_jax.scene.motion_names import split_frames
from ncs_jax.scene.spec import Scene, load_scene
from ncs_jax.simulation.implicit_euler import SimulationState, Simulator, simulator_from, stepper
from ncs_jax.simulation.solver.minimise import Settings, Solution
from ncs_jax.simulation.walk_in import FALL, SETTLE, walk_in

__all__ = ["Progress", "Trajectory", "simulate"]

SAVE_EVERY = 10.0  # s, at least,
SHARE = 20  # and so many times as long as it takes to save
TURN = (0.3, 0.5, 0.7)


@dataclass(frozen=True)
class Progress:
    """What a simulation says after every frame, and once before the first, as it is `compiling`."""

    frame: int
    frames: int
    iterations: int
    residual: float  # g
    status: int
    left: float  # s; 0 where nobody knows yet
    compiling: bool = False


@dataclass(frozen=True)
class Trajectory:
    """A simulated garment: vertices (frames, verts, 3) in m, and of every frame how its solve went, see `Solution`.

    With substeps, `iterations` is their sum, and `residual` and `status` are the worst of them. `seconds` is the wall-clock
    time of a frame; that of the first one of a run includes compiling.
    """

    vertices: np.ndarray
    iterations: np.ndarray
    residual: np.ndarray  # g
    status: np.ndarray
    seconds: np.ndarray
    fps: float
    assembly: Assembly
    motion: io.MotionRecord | None = None  # of the body's joints at `fps`; None: the body has no joints, or stands still

    def wearer(self) -> tuple[io.BodyRecord, io.MotionRecord] | io.AnimationRecord:
        """Return the body as it moves, as `write_animation` takes it for a .glb.

        Raises:
            InputError: the scene has no body.
        """
        body, substeps = self.assembly.body, self.assembly.model.fps / self.fps
        if body is None:
            raise InputError("a scene with a body expected", file=self.assembly.scene.source, field="body.file", value="none")
        if body.frames is not None:
            return io.AnimationRecord(body.frames[:: round(substeps)].astype(np.float32), body.faces, self.fps)
        still = np.zeros((len(self.vertices), len(body.parents), 3), np.float32)
        return body, self.motion or io.MotionRecord(still, still[:, 0], self.fps)


@jax.jit
def _turned(model: Model, turn) -> Array:
    """Return how far stretch, bending and pins of a garment that is only turned are out of balance, g: rounding alone."""
    garment, rest = model.garment, model.garment.mesh.rest
    transforms = jnp.broadcast_to(jnp.pad(turn, ((0, 0), (0, 1))), (len(rest), 3, 4))
    alone = replace(model.terms, collision=None, friction=False, gravity=False, inertia=False, own=())
    terms = replace(alone, self_contact=False, layers=None)

    def energy(x):
        step = StepInputs(vertex_transforms=transforms)
        return sum(energy_terms(x, garment, model.material, step, terms).values(), start=jnp.zeros((), x.dtype))

    return out_of_balance(jax.grad(energy)(skin(transforms, rest)), model.material.density * garment.mesh.vertex_area)


def rounding(model: Model) -> float:
    """Estimate what rounding leaves out of balance in the precision of a model, as a `Solution`'s residual, in g.

    Positions are rounded to a share of their distance from the root. Cloth that is stiff for its weight answers with
    accelerations. Their mass-weighted r.m.s. is returned, for a garment that is only turned, so that nothing strains. It is
    0.9 to 3.3 times the residual that a simulation cannot go below (`experiments.stability`).
    """
    turn = jnp.asarray(Rotation.from_rotvec(TURN).as_matrix(), model.basis.dtype)
    return float(_turned(model, turn))


@functools.partial(jax.jit, static_argnums=1)
def _follow(simulator: Simulator, settings: Settings, state: SimulationState, matrices, limit, still):
    return stepper(simulator, settings).follow(state, matrices, limit=limit, still=still)


def _frame(simulator: Simulator, settings: Settings, state: SimulationState, matrices, k: int):
    """Return the state and the vertices of frame k; in the first the garment follows the body from rest, and comes to rest."""
    if k:
        return _follow(simulator, settings, state, matrices[k], settings.iterations, still=False)
    for n, pose in enumerate(walk_in(simulator.model, matrices[0])):
        state, _ = _follow(simulator, settings, state, pose, SETTLE if n else FALL, still=True)
    return _follow(simulator, settings, state, matrices[0], settings.first, still=True)


def simulate(
    scene: Scene | str | Path,
    motion: str | None = None,
    *,
    partial: str | Path | None = None,
    report: Callable[[Progress], None] | None = None,
    terms: Sequence[OwnTerm] = (),
) -> Trajectory:
    """Minimise the scene's energy frame by frame: the ground truth of the network that is trained on the same energy.

    The garment lies on the body at rest. From there it follows the body into the first pose (`simulation.walk_in`) and comes to
    rest in it: that is the first frame. The vertices are of the precision that was computed in.

    Args:
        scene: a scene, or the path of a scene file; its [simulation] says how. motion: a file, or `ncs:NAME`; else the scene's
            first. partial: a file that keeps what is done while it runs and is continued from where it exists. report: called
            before the first frame, which compiles for a minute or more, and after every one; without it a line in a terminal
            or a notebook says so. terms: of one's own, see `energies.terms.OwnTerm`.

    Raises:
        InputError: the scene or the motion is unusable, or the partial file belongs to another simulation.
    """
    scene = load_scene(scene) if isinstance(scene, str | Path) else scene
    named = (*scene.motion.files, *scene.motion.validation)
    name = motion or (named[0] if named else None)
    if motion is None and name is not None:
        scene.there(split_frames(name)[0], "motion." + ("files" if scene.motion.files else "validation"))
    if name is not None and not name.startswith("ncs:") and name not in named:
        name = str(Path(name).absolute())
    fine = scene.motion.fps * scene.simulation.substeps
    # What can be touched is found out from this motion.
    own = {} if name is None else {name: scene.own_settings(name)}
    lone = replace(
        scene.without_network(),
        motion=replace(scene.motion, files=tuple(own), own=own, validation=(), fps=fine, mirror=False, lone=True),
    )
    precision = scene.simulation.precision
    if precision != "double":
        assembly = assemble(lone, terms=terms)
        if precision == "single" or rounding(assembly.model) <= scene.simulation.tolerance:
            return _simulated(scene, lone, assembly, name, partial, report)
    with jax.enable_x64(True):
        return _simulated(scene, lone, assemble(lone, terms=terms, dtype=jnp.float64), name, partial, report)


def _simulated(
    scene: Scene, lone: Scene, assembly: Assembly, name: str | None, partial: str | Path | None, report
) -> Trajectory:
    spec, model = scene.simulation, assembly.model
    dtype = model.basis.dtype
    records = [] if name is None else [load_motion(lone, name, assembly.body)]
    track = features_from_records(model, *records) if records else assembly.track
    matrices = track.matrices
    settings = Settings(
        spec.solver, spec.tolerance, spec.iterations, inertia=scene.physics.inertia, exact_pins=spec.pins == "exact"
    )
    simulator = simulator_from(model)
    state = stepper(simulator, settings).init()
    frames = 1 + (len(matrices) - 1) // spec.substeps
    own = [term.__name__ for term in model.terms.own]
    identity = json.dumps([scene.to_dict(), name, frames, *([own] if own else [])], sort_keys=True)
    done: dict[str, np.ndarray] = {
        "vertices": np.zeros((0, *model.garment.mesh.rest.shape), dtype),
        "iterations": np.zeros(0, np.int64),
        "residual": np.zeros(0),
        "status": np.zeros(0, np.int64),
        "seconds": np.zeros(0),
    }
    if partial is not None and Path(partial).exists():
        done, state = _continued(Path(partial), identity, done, state)
    rows: dict[str, list] = {key: list(values) for key, values in done.items()}
    begun, pause = time.monotonic(), SAVE_EVERY
    saved = begun
    first = len(rows["status"])
    if first < frames:
        if report is None:
            tell_a_person(f"compiling, which may take a minute or more, then frame {first + 1} of {frames}")
        else:
            report(Progress(first, frames, 0, 0.0, 0, 0.0, compiling=True))
    for t in range(first, frames):
        solutions: list[Solution] = []
        started = time.monotonic()
        for k in range((t - 1) * spec.substeps + 1 if t else 0, t * spec.substeps + 1):
            state, x = _frame(simulator, settings, state, matrices, k)
            solutions.append(jax.device_get(state.solution))
        rows["vertices"].append(np.asarray(x))
        rows["iterations"].append(sum(int(s.iterations) for s in solutions))
        rows["residual"].append(max(float(s.residual) for s in solutions))
        rows["status"].append(max(int(s.status) for s in solutions))
        now = time.monotonic()
        rows["seconds"].append(now - started)
        begun = now if t == first else begun
        if report is not None:
            # The first frame compiles, and the garment comes to rest in it: it tells nothing of the others.
            left = (now - begun) / (t - first) * (frames - 1 - t) if t > first else 0.0
            report(Progress(t + 1, frames, rows["iterations"][-1], rows["residual"][-1], rows["status"][-1], left))
        if partial is not None and now - saved > pause and t + 1 < frames:
            arrays = {key: np.asarray(values) for key, values in rows.items()}
            write_npz(partial, **_kept(state), identity=np.asarray(identity), **arrays)
            saved = time.monotonic()
            pause = max(SAVE_EVERY, SHARE * (saved - now))  # of a long motion a file takes long
    arrays = {key: np.asarray(values) for key, values in rows.items()}
    if track.origin is not None:
        arrays["vertices"] += np.asarray(track.origin)[:: spec.substeps, None]
    return Trajectory(**arrays, fps=scene.motion.fps, assembly=assembly, motion=_every(records, spec.substeps))


def _every(records: Sequence[io.MotionRecord], step: int) -> io.MotionRecord | None:
    """Return the frames of a motion that have a garment, of every substep one; None where there is no motion."""
    return next((replace(r, poses=r.poses[::step], translation=r.translation[::step], fps=r.fps / step) for r in records), None)


KEPT = ("previous", "before", "unposed", "unposed_before")  # the state, beside how the last solve went


def _kept(state: SimulationState) -> dict[str, np.ndarray]:
    return {name: np.asarray(getattr(state, name)) for name in KEPT}


def _continued(partial: Path, identity: str, like: dict[str, np.ndarray], start: SimulationState):
    """Return the frames that are done, and the state to go on from."""
    table = read_npz(partial, {*like, *KEPT, "identity"}.__contains__)
    if str(table.array("identity")) != identity:
        raise InputError(
            "the same scene and motion expected", file=partial, field="identity", value="another simulation's",
            mend="delete this file to begin anew",
        )  # fmt: skip
    done = {key: np.asarray(table.array(key), values.dtype) for key, values in like.items()}
    previous, before, unposed, unposed_before = (jnp.asarray(table.array(name)) for name in KEPT)
    return done, SimulationState(previous, before, unposed, unposed_before, jnp.asarray(True), start.solution)

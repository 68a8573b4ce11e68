"""Open a trained garment from its run folder; animate, measure and export it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.export.facts import FileFormat
from ncs_jax.export.write import Exported, export
from ncs_jax.metrics.quality import measure
from ncs_jax.network.compression import compress
from ncs_jax.network.rollout import animated, first_broken
from ncs_jax.prepare.build import Assembly, build, features_from_records
from ncs_jax.prepare.motion_import import load_motion
from ncs_jax.prepare.prepared import Prepared
from ncs_jax.runs.checkpoint import Checkpoints, read_prepared, read_run
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model
from ncs_jax.scene.spec import Scene, scene_from
from ncs_jax.training.step import initial_state

__all__ = ["Run", "assemble", "load_run", "read_animation_over"]


@dataclass(frozen=True)
class Run:
    """A trained garment: its scene made ready, and the parameters."""

    assembly: Assembly
    params: dict
    steps: int = 0

    def track(self, motion: str) -> MotionFeatures:
        """Return a motion, ready to animate: a file, `ncs:NAME`, or one as the scene names it."""
        return features_from_records(self.assembly.model, self.motion(motion))

    def motion(self, name: str) -> io.MotionRecord:
        """Return a motion at the scene's frame rate; a path that the scene does not name is taken from the current folder."""
        a = self.assembly
        if name in a.motions:
            return a.motions[name]
        known = name.startswith("ncs:") or name in (*a.scene.motion.files, *a.scene.motion.validation)
        return load_motion(a.scene, name if known else str(Path(name).absolute()), a.body)

    def animate(self, motion: str | MotionFeatures, alpha: float = 1.0) -> np.ndarray:
        """Return garment vertices (frames, verts, 3) in m over a motion; alpha sets how much it moves.

        Raises:
            InputError: a vertex is not finite: where, and what was so first.
        """
        track = self.track(motion) if isinstance(motion, str) else motion
        a = self.assembly
        x = animated(a.model, a.network, self.params, track, alpha)
        if not np.isfinite(np.sum(x)):
            what = motion if isinstance(motion, str) else "a track"
            broken = first_broken(a.model, a.network, self.params, track, float(alpha))
            raise InputError(
                "finite vertices expected", file=what, field=broken, value=f"alpha {alpha:g}", mend="see ncs check"
            )
        return x

    def compressed(self, motion: str | MotionFeatures, *, rank: int = 0, bfloat16: bool = False) -> Run:
        """Return this garment with a smaller decoder, made for what it does in a motion: see `compression.compress`.

        Raises:
            InputError: the motion has no such rank.
        """
        a, track = self.assembly, self.track(motion) if isinstance(motion, str) else motion
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
        if rank and motion is None:
            raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
        smaller = self.compressed(motion, rank=rank) if rank else self
        return export(
            smaller.assembly,
            smaller.params,
            file,
            FileFormat(format, float16, opset),
            motion=None if motion is None else self.motion(motion),
            trained=(self.assembly.network, self.params) if rank or float16 else None,
        )

    def evaluate(self, motion: str | MotionFeatures, alpha: float = 1.0, *, exact: bool = True) -> dict[str, np.ndarray]:
        """Return physical quantities per frame: see `metrics.quality.QUANTITIES` and `metrics.quality.measure`."""
        track = self.track(motion) if isinstance(motion, str) else motion
        return measure(self.assembly.model, self.animate(track, alpha), track, exact=exact)


def load_run(folder: str | Path) -> Run:
    """Load a run folder: the scene from its JSON, the parameters from its newest checkpoint.

    Raises:
        InputError: not a run folder, or a file of its scene is gone.
    """
    folder = Path(folder)
    facts = read_run(folder)
    scene = scene_from(facts["scene"], source=str(folder / "run.json"))
    assembly = assemble(scene, prepared=read_prepared(folder))
    if not (folder / "checkpoints").is_dir():
        raise InputError("no checkpoint there yet", file=folder, mend="train it with ncs train --resume")
    checkpoints = Checkpoints(folder)
    step = checkpoints.latest()
    if step is None:
        raise InputError("no checkpoint there yet", file=folder, mend="train it with ncs train --resume")
    like = jax.eval_shape(lambda: initial_state(assembly.model, assembly.network, 0))
    return Run(assembly, checkpoints.restore(like).params, step)


def assemble(scene: Scene, *, prepared: Prepared | None = None, dtype=jnp.float32) -> Assembly:
    """Make a scene ready: read its files and the runs of the garments worn below, check that they fit, precompute the rest.

    Args:
        scene: from `load_scene`. prepared: of a run, which needs no training motion any more; else found out here.
        dtype: of everything; float64 needs JAX's x64 mode.

    Raises:
        InputError: a file is unusable, joint counts disagree, units are off, or the garment is not on the body.
    """
    below = [load_run(scene.path(name)) for name in scene.garment.over]
    return build(scene, prepared=prepared, below=[(run.assembly, run.params) for run in below], dtype=dtype)


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

"""Which network? Codes that add or one code, with bias, a window in place of a memory, a memory that is linear and contracts.

    python -m experiments.architecture [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

All are trained on the scene's motions but the unseen ones, on the same energy. Beside how they do on those: by how much 100
still frames before the first unseen motion change what follows (nothing, if no motion means no dynamic code); and, its first
half followed by 2,000 still frames, how far the garment is from the shape it has in that pose without any motion before, at
once, after 30 frames and at the end. Writes architecture.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.study import (
    COLUMNS,
    abreast,
    axes_of,
    changed,
    command,
    fitted,
    judged_on,
    recurrent,
    references,
    still,
    trained,
    without,
    write,
)  # fmt: skip
from ncs_jax import Run, Scene
from ncs_jax.io import MotionRecord
from ncs_jax.network.encoders import DynamicEncoder
from ncs_jax.network.methods.method import Codes, Method
from ncs_jax.network.methods.ncs import NCS
from ncs_jax.network.methods.snug import SNUG
from ncs_jax.prepare.build import features_from_records
from ncs_jax.scene.features import MotionFeatures

TAPS = 11  # frames that the window sees
STILL = 0.1  # of what the simulation moves after a stop
BEFORE, AFTER = 100, 2000  # still frames
MEASURED = COLUMNS | {
    "before": "still frames before: mm",
    "left_0": "after a stop: mm from rest",
    "left_30": "30 frames later",
    "left_2000": "2,000 frames later",
}


class WindowEncoder(DynamicEncoder):
    """A sum over the last `TAPS` frames of what each gives by itself, without bias."""

    def cell(self, dense: Callable[[int], nn.Module]) -> None:
        """A linear map of those frames."""
        self.taps = dense(self.state)

    def __call__(self, descriptors: Array, state: Array | None = None) -> Array:
        """Codes (frames, *batch, code) of descriptors, rest before the first; nothing is carried."""
        h = self.by_frame(descriptors)
        padded = jnp.concatenate([jnp.zeros((TAPS - 1, *h.shape[1:]), h.dtype), h])
        return self.taps(jnp.concatenate([padded[k : k + len(h)] for k in range(TAPS)], axis=-1))


@dataclass(frozen=True)
class Windowed(NCS):
    """The dynamic code is of the last `TAPS` frames; what is carried are their descriptors."""

    joints: tuple[int, ...] = (0, 0)

    @property
    def state(self) -> int:
        """The descriptors of those frames."""
        return TAPS * self.joints[0] * self.joints[1]

    def init(self, keys, model):
        """Fresh parameters of both encoders."""
        static = NCS(self.static, None, self.decoder).init(keys, model)
        return static | {"dynamic": self.dynamic.init(keys[1], jnp.zeros((TAPS, *self.joints), model.basis.dtype))["params"]}

    def step(self, params, model, state, static, dynamic, matrices):
        """z_S of the frame, and z_D of the descriptors carried and the new ones."""
        seen = jnp.concatenate(
            [state.reshape(*state.shape[:-1], TAPS, *self.joints)[..., 1:, :, :], dynamic[..., None, :, :]], -3
        )
        code = self.dynamic.apply({"params": params["dynamic"]}, jnp.moveaxis(seen, -3, 0))[-1]
        return seen.reshape(state.shape), Codes(self._static(params, static), code)

    def codes(self, params, model, track):
        """Of every frame, from rest at the motion's start."""
        return Codes(self._static(params, track.static), self.dynamic.apply({"params": params["dynamic"]}, track.dynamic))

    def windows(self, params, track, ends, length, last):
        """Time leading. Frames before a motion's start are rest."""
        start = track.start[ends]
        back = ends[None] - jnp.arange(length - 1, -1, -1, dtype=ends.dtype)[:, None]
        inside = jnp.maximum(back, start[None])
        moving = jnp.where((back >= start[None])[..., None, None], track.dynamic[inside], 0)
        codes = self.dynamic.apply({"params": params["dynamic"]}, moving)[length - last :]
        return Codes(self._static(params, track.static[inside[length - last :]]), codes)


class OneCode(SNUG):
    """One recurrent network of pose and motion, trained like the others, inertia's target a constant."""

    def loss(self, terms):
        """All of them."""
        return terms


def one_code(ncs: Any, track: MotionFeatures) -> Method:
    """The same sizes and decoder."""
    d = ncs.dynamic
    return OneCode(DynamicEncoder((), d.sizes, d.state, d.dtype, bias=True), ncs.decoder, ncs.learn_weights)


def biased(ncs: Any, track: MotionFeatures) -> Method:
    """With bias in the dynamic encoder."""
    return replace(ncs, dynamic=ncs.dynamic.clone(bias=True))


def windowed(ncs: Any, track: MotionFeatures) -> Method:
    """With the window."""
    d, joints = ncs.dynamic, track.dynamic.shape[1:]
    encoder = WindowEncoder(d.joint_sizes, d.sizes, d.state, d.dtype)
    return Windowed(ncs.static, encoder, ncs.decoder, ncs.learn_weights, joints)


# A cell that a scene file names, or a network that none does.
ARCHITECTURES: dict[str, str | Callable[[Any, MotionFeatures], Method]] = {
    "two codes, gated unit without bias": "gated",
    "one code, gated unit": one_code,
    "with bias": biased,
    f"window of {TAPS} frames": windowed,
    "linear, contracting": "linear",
    "the garment's own vibrations": "swing",
}


def rest(run: Run, motion: str) -> dict:
    """What still frames before a motion and after it do; under "left" all distances from rest after it, mm."""
    record, model = run.motion(motion), run.assembly.model

    def still(frame, count):
        shape = (count, *record.poses.shape[1:])
        return np.broadcast_to(record.poses[frame], shape), np.broadcast_to(record.translation[frame], (count, 3))

    def moved(*parts):
        made = MotionRecord(*(np.concatenate(part) for part in zip(*parts, strict=True)), record.fps, record.joint_names)
        return run.animate(features_from_records(model, made)).astype(np.float64)

    def apart(a, b):
        return 1000 * np.linalg.norm(a - b, axis=-1).mean(axis=-1)

    half = len(record.poses) // 2
    whole, cut = (record.poses, record.translation), (record.poses[:half], record.translation[:half])
    before = apart(moved(still(0, BEFORE), whole)[BEFORE:], moved(whole)).max()
    left = apart(moved(cut, still(half - 1, AFTER))[half:], moved(still(half - 1, AFTER))[-1:])
    return {
        "before": float(before),
        "left_0": float(left[0]),
        "left_30": float(left[30]),
        "left_2000": float(left[-1]),
        "left": left,
    }


def measured(scene: Scene, network: str | Callable, unseen: Sequence[str], steps: int, kept: Path) -> dict:
    """Train a network and measure it."""
    cell = network if isinstance(network, str) else "gated"
    scene = changed(scene, network={"cell": cell}) if cell == "swing" else recurrent(scene, cell)
    run, minutes = trained(scene, steps, kept) if isinstance(network, str) else fitted(scene, network, steps)
    found = judged_on(run, unseen, [run.animate(motion) for motion in unseen], still(run, unseen[0]), kept)
    return found | {"minutes": minutes} | rest(run, unseen[0])


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    scene = without(scene, unseen)
    references([scene], unseen, kept)
    found = abreast([(measured, scene, network, unseen, steps, kept) for network in ARCHITECTURES.values()])
    rows = [{"network": name, **row} for name, row in zip(ARCHITECTURES, found, strict=True)]
    left = {row["network"]: row.pop("left") for row in rows}
    write(out, "architecture", rows, {"network": "", **MEASURED})
    with axes_of(out / "architecture.png", 1, (5.0, 3.6)) as (axes,):
        for name, curve in left.items():
            axes.loglog(np.arange(1, len(curve) + 1), np.maximum(curve, 1e-6), label=name)
        axes.set(xlabel="frames after the stop", ylabel="mm from rest")
        axes.legend(frameon=False, fontsize=7)
    return rows


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    kept = [row["network"] for row in rows if row["left_2000"] > 0.01]
    far = "; ".join(f"{row['network']} {row['distance']:.1f} mm" for row in rows)
    text = f"To the simulation: {far}."
    if "stopped_share" in rows[0]:
        moving = [f"{row['network']} {row['stopped_share']:.2f}" for row in rows if row["stopped_share"] >= STILL]
        moving += [f"all others below {STILL}"] if len(moving) < len(rows) else []
        text += f" After a stop, as a share of what the simulation moves: {', '.join(moving)}."
    never = f"never at rest again: {', '.join(kept)}" if kept else "in the end all come to rest"
    return f"{text} Still frames before a motion change the default by {rows[0]['before']:.2g} mm; {never}."


main = partial(command, "architecture", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

"""Which pose descriptor? Axis-angle, quaternion, 6D, and 6D without a heading; 6D also without the gravity direction.

    python -m experiments.descriptors [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

Each is trained, with a gated unit, on the scene's motions but the unseen ones, and measured on the first of those, on the last
it was trained on, and on the first unseen one turned about gravity: by how many mm the result differs from the turned result.
Writes descriptors.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.study import (
    abreast,
    bars,
    changed,
    command,
    fitted,
    judged,
    recurrent,
    references,
    still,
    trained,
    without,
    write,
)
from ncs_jax import Run, Scene, local_rotations
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.network.methods.method import Method
from ncs_jax.network.methods.ncs import NCS
from ncs_jax.scene.descriptors import DESCRIPTORS
from ncs_jax.scene.features import MotionFeatures, motion_features

TURN = 135.0  # degrees
SIX = DESCRIPTORS["six"]
COLUMNS = {
    "descriptor": "",
    "unseen_total": "unseen: energy, J",
    "unseen_distance": "mm to simulation",
    "unseen_sensitivity": "two simulations, mm",
    "unseen_static_distance": "static part, mm",
    "unseen_hem_correlation": "hem correlation",
    "seen_total": "seen: energy, J",
    "seen_distance": "mm to simulation ",
    "seen_sensitivity": "two simulations, mm ",
    "turned": f"turned by {TURN:.0f} degrees: mm from the turned result",
    "turned_total": "energy there, J",
}


class WithoutGravity(NCS):
    """Does not see which way is down."""

    def _blind(self, descriptor, first):
        return descriptor.at[..., first : first + 3].set(0)

    def step(self, params, model, state, static, dynamic, matrices):
        """As without the gravity direction and its rate."""
        static, dynamic = (None if d is None else self._blind(d, SIX) for d in (static, dynamic))
        return super().step(params, model, state, static, dynamic, matrices)

    def codes(self, params, model, track):
        """As without the gravity direction and its rate."""
        return super().codes(params, model, self._blinded(track))

    def windows(self, params, track, ends, length, last):
        """As without the gravity direction and its rate."""
        return super().windows(params, self._blinded(track), ends, length, last)

    def _blinded(self, track):
        return replace(track, static=self._blind(track.static, SIX), dynamic=self._blind(track.dynamic, SIX))


def without_gravity(network: Any, track: MotionFeatures) -> Method:
    """The same networks, blind to it."""
    return WithoutGravity(network.static, network.dynamic, network.decoder, network.learn_weights)


def turned(run: Run, motion: str) -> tuple[np.ndarray, MotionFeatures]:
    """The rotation about gravity, and the motion as it is after it."""
    model, record = run.assembly.model, run.motion(motion)
    down = model.material.gravity / jnp.linalg.norm(model.material.gravity)
    turn = axis_angle_to_matrix(-jnp.radians(TURN) * down)
    local, root = local_rotations(model, jnp.asarray(record.poses)), model.skeleton.joints[0]
    local = local.at[:, 0].set(jnp.matmul(turn, local[:, 0], precision="highest"))
    way = jnp.matmul(jnp.asarray(record.translation) + root, turn.T, precision="highest") - root
    return np.asarray(turn, np.float64), motion_features(model, local, way, jnp.zeros(len(local), jnp.int32))


def measured(scene: Scene, unseen: str, steps: int, kept: Path, blind: bool) -> dict:
    """Train, and measure on the three motions."""
    run, minutes = fitted(scene, without_gravity, steps) if blind else trained(scene, steps, kept)
    row: dict[str, float] = {"minutes": minutes}
    for name, motion in (("unseen", unseen), ("seen", scene.motion.files[-1])):
        found = judged(run, motion, run.animate(motion), still(run, motion), kept)
        row |= {f"{name}_{key}": value for key, value in found.items()}
    turn, way = turned(run, unseen)
    away = run.animate(way) - run.animate(unseen).astype(np.float64) @ turn.T
    row["turned_total"] = float(run.evaluate(way)["total"].mean())
    return row | {"turned": 1000 * float(np.linalg.norm(away, axis=-1).mean())}


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    scene = recurrent(without(scene, unseen))
    cases = {name: (name, False) for name in DESCRIPTORS} | {"six, gravity not seen": ("six", True)}
    scenes = [(changed(scene, network={"descriptor": name}), blind) for name, blind in cases.values()]
    references([scene], unseen[:1], kept)
    references([scene], scene.motion.files[-1:], kept)
    found = abreast([(measured, one, unseen[0], steps, kept, blind) for one, blind in scenes])
    rows = [{"descriptor": name, **row} for name, row in zip(cases, found, strict=True)]
    write(out, "descriptors", rows, COLUMNS)
    bars(
        out / "descriptors.png",
        rows,
        "descriptor",
        {key: COLUMNS[key] for key in ("unseen_total", "unseen_distance", "turned")},
    )
    return rows


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    best = min(rows, key=lambda row: row["unseen_total"])
    free = next(row for row in rows if row["descriptor"] == "heading_free")
    worst = max(rows, key=lambda row: row["turned"])
    beside = "" if best is free else f"; heading_free {free['unseen_total']:.4f} J"
    return (
        f"On the unseen motion the lowest energy is that of {best['descriptor']} ({best['unseen_total']:.4f} J{beside}); "
        f"turned about gravity, heading_free gives the same to {free['turned']:.2g} mm, "
        f"{worst['descriptor']} is {worst['turned']:.2g} mm off."
    )


main = partial(command, "descriptors", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

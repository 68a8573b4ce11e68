"""Free fall and a pendulum, learned by a network from their energy alone: with inertia's target a constant, and without.

    python -m experiments.falling [--steps 10000] [--quick] [--out runs/falling]

A sheet of cloth falls, or swings from two of its corners. A small network gives each frame's change of the sheet's affine
motion from that of the frame before (and, for the pendulum, from where the sheet is), and is trained on the sum of the energy
(10) over its own motion from rest. Where x_{t-1} and x_{t-2} are constants to the derivative, every frame is at the minimum of
its own energy and the sheet accelerates by g. Where they are not, frames are moved to make later ones cheaper: with N frames of
free fall the first accelerates by N (N + 1) / 2 times g at the minimum of the sum. Beside them the simulation: the affine
motion that minimises each frame's energy in turn, by Newton's method. Medians over three seeds. Writes falling.csv, .md, .png.
"""

from __future__ import annotations

import argparse
import functools
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Float

from experiments.fit_material import sheet
from experiments.study import write
from ncs_jax import assemble, scene_from
from ncs_jax.energies.terms import StepInputs
from ncs_jax.energies.total import total
from ncs_jax.geometry.skinning import blend
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.scene.model import Model

SIDE, FPS, FRAMES, TILT = 5, 30.0, 20, 35.0  # vertices a side, frames/s, frames, degrees
SEEDS = 3
COLUMNS = {
    "case": "",
    "inertia": "x_{t-1}, x_{t-2} in inertia",
    "first": "acceleration of the first frame, g",
    "mean": "mean acceleration, g",
    "spread": "of the seeds",
    "quarter": "quarter of a swing, s",
    "distance": "mm to the simulation",
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Case:
    """A sheet, where it starts from rest, and whether it knows where it is."""

    name: str = field(metadata={"static": True})
    model: Model
    start: Float[Array, "verts 3"]
    modes: Float[Array, "verts 3"]
    placed: bool = field(metadata={"static": True})


class Mover(nn.Module):
    """The next change of the coefficients, in m, from the last one and from the coefficients."""

    @nn.compact
    def __call__(self, seen: Float[Array, "numbers"]) -> Float[Array, "3 3"]:
        """Coefficients (affine modes, 3) in m."""
        h = seen
        for size in (64, 64):
            h = nn.tanh(nn.Dense(size)(h))
        return 0.1 * nn.Dense(9, kernel_init=nn.initializers.zeros)(jnp.concatenate([h, seen])).reshape(3, 3)


def cases(folder: Path) -> list[Case]:
    """The free sheet, and the one on two corners, tilted."""
    vertices, faces = sheet(SIDE)
    angle = np.radians(TILT)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    made = []
    for name, pins, start in (("free fall", "", vertices), ("pendulum", "pins", vertices @ turn.T)):
        write_npz(folder / "sheet.npz", vertices=vertices, faces=faces, group_pins=np.array([0, SIDE - 1]))
        tables = {
            "body": {"file": "none"},
            "garment": {"file": str((folder / "sheet.npz").resolve()), "pins": pins},
            "motion": {"files": [], "fps": FPS},
            "network": {"modes": 0},
        }
        model = assemble(scene_from(tables)).model
        model = replace(model, moves=True, terms=replace(model.terms, inertia=True))
        made.append(Case(name, model, jnp.asarray(start, jnp.float32), affine(vertices), bool(pins)))
    return made


def affine(rest: np.ndarray) -> Float[Array, "verts 3"]:
    """Modes of a flat sheet that a product with (3, 3) coefficients moves, turns and stretches: orthonormal columns."""
    across = np.linalg.svd(rest - rest.mean(axis=0), full_matrices=False)[0][:, :2]
    return jnp.asarray(np.column_stack([np.full(len(rest), len(rest) ** -0.5), across]), jnp.float32)


def energy(case: Case, now, previous, before, stop: bool) -> tuple[Array, Float[Array, "verts 3"]]:
    """The energy (10) of a frame in J from its coefficients and those of the two before, and where the sheet is."""
    model, modes = replace(case.model, terms=replace(case.model.terms, through_time=not stop)), case.modes
    x, *earlier = (case.start + modes @ c for c in (now, previous, before))
    frame = StepInputs(
        1 / model.fps, *earlier, vertex_transforms=blend(jnp.broadcast_to(jnp.eye(3, 4), (1, 3, 4)), model.blend)
    )
    return total(x, model.garment, model.material, frame, model.terms), x


def rollout(case: Case, params, stop: bool) -> tuple[Array, Float[Array, "frames verts 3"]]:
    """The energy of the network's own motion from rest, summed over the frames, and the motion."""
    hold = lax.stop_gradient if stop else (lambda a: a)

    def step(carried, _):
        previous, before = map(hold, carried)
        seen = [10 * (previous - before).ravel(), *([previous.ravel()] if case.placed else [])]
        now = previous + Mover().apply(params, jnp.concatenate(seen))
        return (now, previous), energy(case, now, previous, before, stop)

    rest = jnp.zeros((3, 3))
    _, (parts, x) = lax.scan(step, (rest, rest), None, length=FRAMES)
    return jnp.sum(parts), x


@functools.partial(jax.jit, static_argnums=1)
def _simulated(case: Case, iterations: int):
    def step(carried, _):
        previous, before = carried

        def value(flat):
            return energy(case, flat.reshape(3, 3), previous, before, True)

        def newton(_, flat):
            slope, _ = jax.grad(value, has_aux=True)(flat)
            return flat - jnp.linalg.solve(jax.hessian(lambda f: value(f)[0])(flat), slope)

        flat = lax.fori_loop(0, iterations, newton, (2 * previous - before).ravel())
        return (flat.reshape(3, 3), previous), value(flat)[1]

    rest = jnp.zeros((3, 3))
    return lax.scan(step, (rest, rest), None, length=FRAMES)[1]


def simulated(case: Case) -> np.ndarray:
    """The affine motion of least energy, frame by frame, (frames, verts, 3)."""
    return np.asarray(_simulated(case, 20), np.float64)


def learned(case: Case, stop: bool, steps: int) -> np.ndarray:
    """The motions of trained networks, (seeds, frames, verts, 3)."""
    optimiser = optax.adam(optax.cosine_decay_schedule(3e-3, steps))

    @jax.jit
    @jax.vmap
    def run(key):
        params = Mover().init(key, jnp.zeros(18 if case.placed else 9))

        def step(carried, _):
            params, state = carried
            gradient = jax.grad(lambda p: rollout(case, p, stop)[0])(params)
            updates, state = optimiser.update(gradient, state)
            return (optax.apply_updates(params, updates), state), None

        params, _ = lax.scan(step, (params, optimiser.init(params)), None, length=steps)[0]
        return rollout(case, params, stop)[1]

    return np.asarray(run(jax.random.split(jax.random.PRNGKey(0), SEEDS)), np.float64)


def experiment(out: Path, steps: int) -> list[dict]:
    """Learn both motions both ways; write the table and the picture into `out`; return the rows, medians over the seeds."""
    rows: list[dict] = []
    paths: dict[tuple[str, str], np.ndarray] = {}
    with tempfile.TemporaryDirectory() as folder:
        for case in cases(Path(folder)):
            reference = simulated(case)
            made = {"simulation": reference[None], "constants": learned(case, True, steps)}
            made["differentiated"] = learned(case, False, steps)
            for name, x in made.items():
                path = np.concatenate([np.broadcast_to(np.asarray(case.start), x[:, :2].shape), x], axis=1).mean(axis=2)
                paths[case.name, name] = path
                row = {"case": case.name, "inertia": name, **measured(case, path)}
                row["distance"] = float(np.median(1000 * np.linalg.norm(x - reference, axis=-1).mean(axis=(1, 2))))
                rows.append(row)
                print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True)
    write(out, "falling", rows, COLUMNS)
    draw(out / "falling.png", paths)
    return rows


def measured(case: Case, paths: np.ndarray) -> dict[str, float | str]:
    """What the paths (seeds, frames, 3) of a sheet's centre, from rest, say of gravity."""
    fall = -np.diff(paths[..., 1], n=2) * FPS**2 / 9.81
    found: dict[str, float | str] = {"first": float(np.median(fall[:, 0]))}
    if not case.placed:
        mean = fall.mean(axis=1)
        return found | {"mean": float(np.median(mean)), "spread": f"{mean.min():.4f} to {mean.max():.4f}"}
    quarters = [quarter(path[1:, 2]) for path in paths]
    return found | {"quarter": float(np.median(quarters)), "spread": f"{min(quarters):.3f} to {max(quarters):.3f} s"}


def quarter(aside: np.ndarray) -> float:
    """When a pendulum, aside (frames,) in m, is first below its pins, s; infinite if never."""
    past = np.flatnonzero(np.sign(aside) != np.sign(aside[0]))
    if not len(past):
        return float("inf")
    k = past[0]
    return float(k - 1 + aside[k - 1] / (aside[k - 1] - aside[k])) / FPS


def draw(path: Path, paths: dict) -> None:
    """Heights of the free sheet and how far the pendulum is aside, over time, of every seed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    styles = {"simulation": ("0.7", 5.0), "constants": ("C0", 1.5), "differentiated": ("C3", 1.0)}
    shown = {"free fall": (1, "height, m"), "pendulum": (2, "aside, m")}
    for axes, (name, (axis, label)) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        true = paths[name, "simulation"][0, :, axis]
        size = np.ptp(true)
        for inertia, (colour, width) in styles.items():
            lines = axes.plot(np.arange(len(true)) / FPS, paths[name, inertia][..., axis].T, color=colour, linewidth=width)
            lines[0].set_label(inertia)
        axes.set(title=name, xlabel="s", ylabel=label, ylim=(true.min() - size, true.max() + 0.5 * size))
        axes.legend(fontsize=8, frameon=False)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""
    by = {(row["case"], row["inertia"]): row for row in rows}
    fall, without = by["free fall", "constants"], by["free fall", "differentiated"]
    swing, other, true = (by["pendulum", name] for name in ("constants", "differentiated", "simulation"))
    return (
        f"With the past a constant to the derivative the sheet falls with {fall['mean']:.4f} g ({fall['spread']}); "
        f"differentiated through time its first frame falls with {without['first']:.0f} g and the mean is "
        f"{without['mean']:.1f} g ({without['spread']}). The pendulum is {swing['distance']:.0f} mm from the simulation with "
        f"it and {other['distance']:.0f} mm without; a quarter of its swing takes {swing['quarter']:.3f} s, "
        f"{other['quarter']:.3f} s without, {true['quarter']:.3f} s simulated."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000, help="of Adam (default: 10000)")
    parser.add_argument("--quick", action="store_true", help="100 steps: the numbers mean nothing")
    parser.add_argument("--out", default="runs/falling", help="folder for the table and the picture")
    options = parser.parse_args(arguments)
    experiment(Path(options.out), 100 if options.quick else options.steps)
    return 0


if __name__ == "__main__":
    sys.exit(main())

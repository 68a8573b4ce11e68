"""What is a cloth made of? Recover its material from how it moves, with the simulator's own gradient.

    python -m experiments.fit_material --cloth hanging --out runs/fit_material

A trajectory X is simulated with the true material. From a guess that is a factor of 5 off in each of three parameters

    stretch   one factor on all numbers of the membrane (lam and mu of stvk and neo_hookean), N/m
    bending   the bending stiffness, N m
    density   the mass per area, kg/m^2

A trust region with BFGS (scipy's trust-constr) minimises the mean squared distance of the vertices,

    f(p) = mean_{t,v} |x_{t,v}(p) - X_{t,v}|^2,   p: logarithms of the parameters' ratios to the truth

once with X as it is and once with Gaussian noise on all its coordinates. The gradient is `jax.grad` through `simulate`: through
all frames and the static first one. In float64: f falls by many orders of magnitude between the density, which shows at once,
and the bending, which shows last. (Without a trust region BFGS takes a step to no cloth at all, under 1e-4 of the stretch.)

Of a cloth that only gravity moves, no motion tells these three: where stretch, bending and density grow by one factor, so does
the whole energy, and its minimum stays where it was. Something of known strength must act: here a wind, the force p(t) A_v n
on a vertex of rest area A_v, with the known pressure p(t) = p_0 (1 + cos(2 pi t / T)) / 2, also in the static state. (The
stiffnesses of pins and contact are known too, and also break the scaling.)

hanging: a square sheet of 0.3 m on two corners. tshirt: the packaged shirt on a body that lifts its arms. The search for the
static state begins at the measured one, so that both have the same folds. On two busy cores a fit of the sheet took 20 s and
one of the shirt 9 minutes, and compiling 1 and 2 minutes before them.

Writes fit_material.csv (one row a fit: the parameters' ratios to the truth, the r.m.s. distance left in mm, evaluations, how
many of them had a frame that did not converge, seconds) and fit_material.png (ratios and distance over the evaluations).
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax import InputError, Model, assemble, scene_from
from ncs_jax.geometry.skinning import blend, skin, unpose
from ncs_jax.io.tables.npz import write_npz
from ncs_jax.prepare.build import features_from_records
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.simulation.implicit_euler import Simulator, simulate, simulator_from, stepper
from ncs_jax.simulation.solver.minimise import CONVERGED, Settings

FRAMES = {"hanging": 8, "tshirt": 4}  # by default, of every cloth
PARAMETERS = ("stretch", "bending", "density")
GUESS = (5.0, 0.2, 5.0)  # times the truth
SETTINGS = Settings(tolerance=1e-6, iterations=300, first=3000)
WIND = np.array([0.28, 0.0, 0.96])  # n
PERIOD = 0.5  # s
SCALE = np.array([1.0, 0.3, 3.0])  # what the fit varies is SCALE * p: the distance feels density most and bending least
RADIUS = 0.5  # of the first steps


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """A cloth, how its character moves, and the known forces on it in N."""

    simulator: Simulator
    track: MotionFeatures
    forces: Float[Array, "frames verts 3"]


def sheet(side: int, length: float = 0.3):
    """A square sheet that hangs from y = 0 and faces +z: vertices (side^2, 3) in m, faces of alternating diagonals."""
    v, u = np.mgrid[:side, :side] / (side - 1) * length
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = (index[i : i + side - 1, j : j + side - 1] for i in (0, 1) for j in (0, 1))
    even = (np.add(*np.indices(a.shape)) % 2 == 0)[..., None]
    one = np.where(even, np.stack([a, c, d], -1), np.stack([a, c, b], -1))
    other = np.where(even, np.stack([a, d, b], -1), np.stack([b, c, d], -1))
    vertices = np.stack([u - length / 2, -v, np.zeros_like(u)], axis=-1)
    return vertices.reshape(-1, 3), np.concatenate([one, other]).reshape(-1, 3).astype(np.int32)


def wind(model: Model, frames: int, pressure: float) -> Float[Array, "frames verts 3"]:
    """The gusts' force on every vertex in N; `pressure` p_0 in Pa."""
    gust = pressure * (1 + np.cos(2 * np.pi * np.arange(frames) / model.fps / PERIOD)) / 2
    return jnp.asarray(gust[:, None, None] * np.asarray(model.garment.mesh.vertex_area)[:, None] * WIND)


def hanging(folder: Path, frames: int, side: int, pressure: float) -> Problem:
    """A sheet on two corners; its mesh is written into `folder`."""
    vertices, faces = sheet(side)
    write_npz(folder / "sheet.npz", vertices=vertices, faces=faces, group_pins=np.array([0, side - 1]))
    tables = {
        "body": {"file": "none"},
        "garment": {"file": str((folder / "sheet.npz").resolve()), "pins": "pins"},
        "motion": {"files": []},
        "network": {"modes": 0},
        "physics": {"bending": {"stiffness": 1e-4}},
    }
    assembly = assemble(scene_from(tables), dtype=jnp.float64)
    model = replace(assembly.model, moves=True)
    track = jax.tree.map(lambda a: jnp.repeat(a, frames, axis=0), assembly.track)
    return Problem(simulator_from(model), track, wind(model, frames, pressure))


def tshirt(frames: int, pressure: float, start: int = 16) -> Problem:
    """The packaged shirt on a body that begins to lift its arms."""
    motion = "ncs:lift_arms"
    tables = {"motion": {"files": [motion]}, "network": {"modes": 0}, "physics": {"collision": {"distance": "smooth"}}}
    assembly = assemble(scene_from(tables), dtype=jnp.float64)
    track = features_from_records(assembly.model, assembly.motions[motion])
    if start + frames > len(track.matrices):
        raise InputError(f"1 to {len(track.matrices) - start} frames expected", file=motion, field="frames", value=frames)
    part = jax.tree.map(lambda a: a[start : start + frames], track)
    return Problem(simulator_from(assembly.model), part, wind(assembly.model, frames, pressure))


def simulated(problem: Problem, logs: Float[Array, "3"], begin: Float[Array, "verts 3"]):
    """The trajectory of a material whose parameters are exp(logs) times the model's; its first frame is sought from `begin`."""
    simulator, factor = problem.simulator, jnp.exp(logs)
    model, material = simulator.model, simulator.model.material
    changed = replace(
        material,
        membrane=tuple(factor[0] * number for number in material.membrane),
        bending=factor[1] * material.bending,
        density=factor[2] * material.density,
    )
    simulator = replace(simulator, model=replace(model, material=changed))
    unposed = unpose(blend(problem.track.matrices[0], model.blend), begin)
    state = replace(stepper(simulator).init(), unposed=unposed, unposed_before=unposed)
    return simulate(simulator, problem.track, SETTINGS, state=state, forces=problem.forces)


@jax.jit
def compared(logs: Float[Array, "3"], problem: Problem, begin: Float[Array, "verts 3"], wanted: Float[Array, "frames verts 3"]):
    """Mean squared distance to `wanted` in mm^2, the vertices and how their solves went; and the gradient of the first."""

    def loss(logs):
        x, solution = simulated(problem, logs, begin)
        return 1e6 * jnp.mean(jnp.sum((x - wanted) ** 2, axis=-1)), (x, solution)

    return jax.value_and_grad(loss, has_aux=True)(logs)


def fit(problem: Problem, wanted: Float[Array, "frames verts 3"], iterations: int) -> tuple[np.ndarray, int]:
    """Ratios to the truth and r.m.s. distance in mm of all evaluations (evaluations, 4), and how many had a failed solve."""
    seen: list[tuple[float, ...]] = []
    failed: list[int] = []

    def objective(scaled):
        logs = scaled / SCALE
        (loss, (_, solution)), gradient = compared(jnp.asarray(logs), problem, wanted[0], wanted)
        seen.append((*np.exp(logs), float(np.sqrt(loss))))
        failed.append(int(jnp.sum(solution.status != CONVERGED)))
        ratios = "  ".join(f"{name} {ratio:.4f}" for name, ratio in zip(PARAMETERS, seen[-1], strict=False))
        solve = f"{int(jnp.sum(solution.iterations))} Newton steps, {failed[-1]} frames not converged"
        print(f"{len(seen):3d}  {ratios}  distance {seen[-1][-1]:.3g} mm  {solve}", flush=True)
        return float(loss), np.asarray(gradient) / SCALE

    options = {"maxiter": iterations, "initial_tr_radius": RADIUS, "gtol": 1e-4, "xtol": 1e-5}
    from scipy.optimize import BFGS, minimize  # here: its BLAS reads how many threads to take when it is loaded

    minimize(objective, SCALE * np.log(GUESS), jac=True, hess=BFGS(), method="trust-constr", options=options)
    return np.array(seen), sum(count > 0 for count in failed)


def measured(problem: Problem) -> Float[Array, "frames verts 3"]:
    """The trajectory of the true material, sought from the rest shape as it is skinned."""
    model = problem.simulator.model
    begin = skin(blend(problem.track.matrices[0], model.blend), model.garment.mesh.rest)
    (_, (x, solution)), _ = compared(jnp.zeros(3), problem, begin, jnp.zeros_like(problem.forces))
    worst, failed = float(jnp.max(solution.residual)), int(jnp.sum(solution.status != CONVERGED))
    print(f"{len(x)} frames of {x.shape[1]} vertices, {failed} of them not converged, residual {worst:.1e} g", flush=True)
    return x


def experiment(
    out: str | Path,
    *,
    cloths: Sequence[str] = tuple(FRAMES),
    frames: int | None = None,
    side: int = 11,
    pressure: float = 1.0,
    noises: Sequence[float] = (0.0, 1e-3),
    iterations: int = 60,
) -> list[dict]:
    """Fit every cloth with every noise (its standard deviation in m); write table and picture into `out`; return the rows."""
    if (frames is not None and frames < 1) or side < 3:
        raise InputError("a frame and three vertices a side expected", field="frames, side", value=(frames, side))
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    rows, curves = [], {}
    with jax.enable_x64(True):
        for cloth in cloths:
            count = frames or FRAMES[cloth]
            problem = tshirt(count, pressure) if cloth == "tshirt" else hanging(out, count, side, pressure)
            truth = measured(problem)
            for noise in noises:
                begun = time.monotonic()
                curve, failed = fit(problem, truth + noise * np.random.default_rng(0).standard_normal(truth.shape), iterations)
                best = curve[np.argmin(curve[:, 3])].tolist()
                row = {"cloth": cloth, "noise_mm": 1e3 * noise, **dict(zip(PARAMETERS, best[:3], strict=True))}
                row |= {"rms_mm": best[3], "evaluations": len(curve), "failed": failed, "seconds": time.monotonic() - begun}
                rows.append(row)
                curves[f"{cloth}, {1e3 * noise:g} mm of noise"] = curve
                with (out / "fit_material.csv").open("w", newline="") as file:
                    table = csv.DictWriter(file, rows[0])
                    table.writeheader()
                    table.writerows(rows)
                draw(out / "fit_material.png", curves)
    return rows


def draw(path: Path, curves: dict[str, np.ndarray]) -> None:
    """Each parameter's ratio to the truth, and the loss, over the evaluations; a column a cloth and noise."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(curves) + 1, 5), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    columns = figure.subplots(2, len(curves), sharey="row", squeeze=False).T
    for (title, curve), (above, below) in zip(curves.items(), columns, strict=True):
        count = np.arange(1, len(curve) + 1)
        above.axhspan(0.95, 1.05, color="0.85", linewidth=0)
        for k, name in enumerate(PARAMETERS):
            above.semilogy(count, curve[:, k], linewidth=1.2, label=f"{name}: {curve[np.argmin(curve[:, 3]), k]:.4f}")
        below.semilogy(count, curve[:, 3], color="0.3", linewidth=1.2)
        above.set_title(title, fontsize=9)
        above.legend(fontsize=8, frameon=False)
        below.set(xlabel="evaluation")
        for axes in (above, below):
            axes.grid(alpha=0.3)
            axes.spines[["top", "right"]].set_visible(False)
    columns[0][0].set(ylabel="ratio to the truth (grey: 5 %)")
    columns[0][0].set_yticks([0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10], ["0.05", "0.1", "0.2", "0.5", "1", "2", "5", "10"])
    columns[0][0].minorticks_off()
    columns[0][1].set(ylabel="r.m.s. distance, mm")
    figure.savefig(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cloth", choices=(*FRAMES, "both"), default="both", help="what to fit (default: both)")
    parser.add_argument("--frames", type=int, help="of the trajectory (default: 8 of the sheet, 4 of the shirt)")
    parser.add_argument("--side", type=int, default=11, help="vertices along a side of the sheet (default: 11)")
    parser.add_argument("--wind", type=float, default=1.0, help="pressure of the known wind, Pa (default: 1)")
    parser.add_argument("--noise", type=float, default=0.001, help="on all coordinates, m, in the second fit (default: 0.001)")
    parser.add_argument("--iterations", type=int, default=60, help="of the fit, at most (default: 60)")
    parser.add_argument("--out", default="runs/fit_material", help="folder for the table and the picture")
    options = parser.parse_args(arguments)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `ncs simulate` does
    try:
        rows = experiment(
            options.out,
            cloths=tuple(FRAMES) if options.cloth == "both" else (options.cloth,),
            frames=options.frames,
            side=options.side,
            pressure=options.wind,
            noises=(0.0, options.noise) if options.noise else (0.0,),
            iterations=options.iterations,
        )
    except InputError as error:
        print(f"fit_material: {error}", file=sys.stderr)
        return 2
    for row in rows:
        print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())

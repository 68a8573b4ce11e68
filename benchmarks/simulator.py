"""What a simulated frame costs with both solvers, how well it is solved, and how the time grows with the garment.

    python -m benchmarks.simulator [SCENE] [--motion NAME] [--frames 30] [--iterations 9] [--growth] [--quick] [--json FILE]
    python -m benchmarks.simulator [SCENE] [--motion NAME] [--frames 30] --picture FILE [--vbd-python PATH] [--json FILE]

Newton solves every frame to 0.1 g; quasi-Newton stops after a fixed number of iterations, 9, and says what is left. Seconds a
frame are those of a stream, compile time and the first, static, frame apart. `--growth` instead divides every triangle of the
scene's garment in four, and again, and measures so many iterations of both. The least is that of the median number of
iterations: of one sparse factor each for Newton and one a frame for quasi-Newton, and of reading it twice to solve with it.

`--picture` draws seconds a frame against what is left out of balance, for several tolerances and numbers of iterations, and for
NVIDIA Newton's vertex block descent (VBD) of 2 to 20 iterations a frame; 80 % of the frames lie within the bars. All begin with
the same static frame, and roll on by themselves; `mm` is the root mean square distance from the first row, Newton to 0.02 g.
`benchmarks/residual.py` judges all of them alike, by the energies here. `benchmarks/against_vbd.py` tells what of VBD
corresponds, and which laws of the scene change for the comparison. VBD is run by the Python that `--vbd-python` names, or this
one, where `pip install newton` was done; elsewhere it is left out.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import against_vbd, work
from benchmarks.growth import finer
from benchmarks.measure import Work, clock, read, run, table
from benchmarks.residual import residuals
from ncs_jax import InputError, assemble
from ncs_jax.prepare.build import Assembly
from ncs_jax.scene.spec import Scene
from ncs_jax.simulation.implicit_euler import SimulationState, Simulator, simulator_from, stepper
from ncs_jax.simulation.solver.minimise import CONVERGED, Settings

FAST = Settings("quasi_newton", tolerance=1.0)
TIMES = (1, 4, 16)  # as many triangles
TIGHT = 0.02  # g: what the picture calls solved
TOLERANCES = (TIGHT, 0.1, 1.0, 10.0)  # g: of Newton in the picture,
ITERATIONS = (5, 9, 20, 50)  # of quasi-Newton,
VBD = (2, 5, 10, 20)  # and of VBD


class Program(NamedTuple):
    """A compiled frame: `frame(state, matrices, limit) -> state`, with a limit to the iterations; what it took to compile."""

    frame: Callable
    compiling: float  # s


class Stream(NamedTuple):
    """Frames as they were simulated."""

    states: list[SimulationState]
    seconds: np.ndarray


def compiled(simulator: Simulator, settings: Settings, matrices) -> Program:
    """Compile a frame of a simulation."""
    fixed, kind = jax.tree.flatten(simulator)
    state, form = jax.tree.flatten(stepper(simulator, settings).init())

    @jax.jit
    def step(fixed, state, matrices, limit):  # of plain arrays: the classes check their types, which `lower` does not have
        simulation = stepper(jax.tree.unflatten(kind, fixed), settings)
        state, _ = simulation.follow(jax.tree.unflatten(form, state), matrices, limit=limit)
        return jax.tree.leaves(state)

    start = time.perf_counter()
    program = step.lower(fixed, state, matrices, np.int32(0)).compile()

    def frame(state: SimulationState, matrices, limit: int) -> SimulationState:
        leaves = jax.block_until_ready(program(fixed, jax.tree.leaves(state), matrices, np.int32(limit)))
        return jax.tree.unflatten(form, leaves)

    return Program(frame, time.perf_counter() - start)


def stream(program: Program, state: SimulationState, matrices, limits: Sequence[int]) -> Stream:
    """Simulate frame by frame, with so many iterations each."""
    states, seconds = [], []
    for m, limit in zip(matrices, limits, strict=True):
        start = time.perf_counter()
        state = program.frame(state, m, limit)
        seconds.append(time.perf_counter() - start)
        states.append(state)
    return Stream(states, np.array(seconds))


def row_of(simulator: Simulator, settings: Settings, program: Program, rolled: Stream) -> dict:
    """Return seconds, iterations and residuals of frames, and the least that they could take."""
    solved = [jax.device_get(state.solution) for state in rolled.states]
    iterations = np.array([float(s.iterations) for s in solved])
    typical, newton = float(np.median(iterations)), settings.solver == "newton"
    factor, solve = work.factor(simulator.order, 3 if newton else 1, simulator.model.garment.mesh.rest.dtype.itemsize)
    factors = typical if newton else 1
    return {
        "seconds": spread(rolled.seconds) | clock(rolled.seconds, program.compiling),
        "each": float(np.median(rolled.seconds / np.maximum(iterations, 1))),
        "iterations": {"median": typical, "max": float(iterations.max())},
        "residual": spread([float(s.residual) for s in solved]),
        "unsolved": int(np.sum([int(s.status) != CONVERGED for s in solved])),
        "frames": len(solved) + 1,
        "work": Work(factors * factor.flops + typical * solve.flops, factors * factor.bytes + typical * solve.bytes),
    }


def spread(values) -> dict[str, float]:
    """Return median and maximum, and between what 80 % lie."""
    low, median, high = np.percentile(values, (10, 50, 90))
    return {"median": float(median), "max": float(np.max(values)), "p10": float(low), "p90": float(high)}


def measured(assembly: Assembly, settings: Settings, frames: int) -> dict:
    """Return the row of a stream from its first, static, frame on."""
    simulator, matrices = simulator_from(assembly.model), assembly.track.matrices
    program = compiled(simulator, settings, matrices[0])
    frames = min(frames, len(matrices))
    begun = stream(program, stepper(simulator, settings).init(), matrices[:1], [settings.first])
    rolled = stream(program, begun.states[0], matrices[1:frames], [settings.iterations] * (frames - 1))
    return {"first": float(begun.seconds[0]), **row_of(simulator, settings, program, rolled)}


# --- residual against seconds -----------------------------------------------------------------------------------------


def curve(options, spec: Scene) -> dict:
    """Return a row for every tolerance and number of iterations, and for VBD, and draw them; `quick`: two, and no VBD."""
    spec, changed = against_vbd.comparable(spec)
    assembly = assemble(spec.without_network())
    model, matrices = assembly.model, assembly.track.matrices[: 3 if options.quick else max(options.frames, 2)]
    pins = len(model.garment.pins) > 0
    simulator, steps = simulator_from(model), len(matrices) - 1
    wanted = {f"{t:g} g": Settings(tolerance=t, exact_pins=pins) for t in TOLERANCES[: 1 if options.quick else None]}
    many = Settings("quasi_newton", tolerance=TIGHT, exact_pins=pins)
    wanted |= {f"{n} iterations": replace(many, iterations=n) for n in ITERATIONS[: 1 if options.quick else None]}
    programs: dict[Settings, Program] = {}
    rows: dict[str, dict] = {}
    start, exact = stepper(simulator, many).init(), np.zeros(0)
    for name, settings in wanted.items():
        of = replace(settings, iterations=many.iterations)  # the limit is given frame by frame
        if of not in programs:
            programs[of] = compiled(simulator, of, matrices[0])
        program = programs[of]
        if not rows:
            start = program.frame(start, matrices[0], settings.first)
        rolled = stream(program, start, matrices[1:], [settings.iterations] * steps)
        positions = np.array([state.previous for state in (start, *rolled.states)])
        exact = exact if rows else positions
        rows[f"{settings.solver}, {name}"] = row_of(simulator, settings, program, rolled) | judged(
            simulator, matrices, positions, exact
        )
    told = {"changed": changed, "vertices": len(model.garment.mesh.rest), "start": f"{float(start.solution.residual):.3g} g"}
    if not options.quick:
        told |= vbd_rows(rows, options, simulator, matrices, exact)
    motion = spec.motion.files[0].rpartition("/")[2]
    draw(rows, f"{Path(options.scene).stem}, {motion}, {told['vertices']} vertices, {steps} frames", Path(options.picture))
    return {"rows": rows, **told}


def judged(simulator: Simulator, matrices, positions: np.ndarray, exact: np.ndarray) -> dict:
    """Return what is left out of balance in a trajectory, and its distance from another."""
    left = residuals(simulator, matrices, positions, exact_pins=len(simulator.model.garment.pins) > 0)
    apart = np.sqrt(np.mean(np.sum((positions[1:] - exact[1:]).astype(float) ** 2, axis=-1)))
    return {"residual": spread(left), "mm": 1000 * float(apart)}


def vbd_rows(rows: dict[str, dict], options, simulator: Simulator, matrices, exact: np.ndarray) -> dict[str, str]:
    """Add VBD's rows, or why there are none; return what ran it."""
    problem = against_vbd.problem_of(simulator.model, matrices, exact[0], iterations=np.array(VBD), detect="iteration")
    try:
        found, versions = against_vbd.roll(options.vbd_python, problem)
    except InputError as error:
        rows["VBD"] = {"failed": str(error)}
        return {}
    for n, rolled in zip(VBD, found, strict=True):
        positions = np.concatenate([exact[:1], rolled.vertices])
        rows[f"VBD, {n} iterations"] = {
            "seconds": spread(rolled.seconds) | clock(rolled.seconds, rolled.compiling),
            "each": float(np.median(rolled.seconds)) / n,
            "iterations": {"median": float(n), "max": float(n)},
            "frames": len(positions),
            **judged(simulator, matrices, positions, exact),
        }
    return {"vbd": versions}


def draw(rows: dict[str, dict], title: str, file: Path) -> None:
    """Draw the residual of every row against its seconds a frame."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xscale="log", yscale="log", xlabel="seconds a frame", ylabel="out of balance, g", title=title)
    looks = {
        "newton": ("o-", "Newton, to a tolerance"),
        "quasi_newton": ("s-", "quasi-Newton"),
        "VBD": ("^-", "NVIDIA Newton's VBD"),
    }
    for solver, (look, label) in looks.items():
        points = {name.partition(", ")[2]: row for name, row in rows.items() if name.split(", ")[0] == solver and "mm" in row}
        if not points:
            continue
        (x, wide), (y, high) = (_bars([row[key] for row in points.values()]) for key in ("seconds", "residual"))
        axes.errorbar(x, y, xerr=wide, yerr=high, fmt=look, label=label, elinewidth=0.7, capsize=2)
        for name, place in zip(points, zip(x, y, strict=True), strict=True):
            axes.annotate(name, place, textcoords="offset points", xytext=(6, 5), fontsize=8)
    axes.grid(which="both", alpha=0.2)
    axes.legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=150)


def _bars(spreads: Sequence[dict[str, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return medians, and how far 10 and 90 % are from them."""
    low, middle, high = (np.array([each[key] for each in spreads]) for key in ("p10", "median", "p90"))
    return middle, np.stack([middle - low, high - middle])


# --- the command ------------------------------------------------------------------------------------------------------


def benchmark(options) -> dict:
    """Measure both solvers on a scene, or some iterations of each on ever finer garments; `quick`: quasi-Newton alone."""
    spec, rows, iterations = read(options.scene), {}, options.iterations
    if options.motion:
        motion = options.motion if options.motion.startswith("ncs:") else str(Path(options.motion).absolute())
        spec = replace(spec, motion=replace(spec.motion, files=(motion,), validation=()))
    if options.picture:
        return curve(options, spec)
    frames = 3 if options.quick else max(options.frames, 2)
    solvers = [replace(FAST, iterations=iterations)] if options.quick else [Settings(), replace(FAST, iterations=iterations)]
    with tempfile.TemporaryDirectory() as folder:
        for times in TIMES if options.growth and not options.quick else TIMES[:1]:
            finest = finer(spec, Path(folder), garment=times)
            assembly = assemble(finest.without_network())
            for settings in solvers:
                if options.growth:
                    settings = Settings(settings.solver, tolerance=1e-9, iterations=iterations, first=iterations)
                row = measured(assembly, settings, frames)
                rows[f"{settings.solver}, {len(assembly.model.garment.mesh.rest)} vertices"] = row
    return {"rows": rows}


def show(figures: dict) -> str:
    """The table."""
    heads = ["s a frame, residual in g", "compile", "min", "median", "p90", "max", "least", "% of limit"]
    heads += ["iterations", "each", "residual", "worst", "unsolved", *(["mm"] if "changed" in figures else [])]
    lines: list[list[object]] = []
    for name, row in figures["rows"].items():
        if "failed" in row:
            lines.append([f"{name}: {row['failed']}"])
            continue
        times = [row["seconds"][k] for k in ("compile", "min", "median", "p90", "max")]
        least = [row["least"], 100 * row["share"]] if "least" in row else [None, None]
        solved = [row["iterations"]["median"], row["each"], row["residual"]["median"], row["residual"]["max"]]
        unsolved = f"{row['unsolved']} of {row['frames'] - 1}" if "unsolved" in row else None
        lines.append([name, *times, *least, *solved, unsolved, *([row["mm"]] if "mm" in row else [])])
    return table(heads, lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    return run(
        __doc__, benchmark, show, arguments, scene=str(Path(__file__).parent / "tshirt.toml"),
        frames=(30, "of the scene's first motion, its first too"), iterations=(9, "of quasi-Newton; with --growth of both"),
        growth=(False, "some iterations on ever finer garments"), motion=("", "in place of the scene's motions"),
        picture=("", "draw seconds a frame against residual there, of several settings and of VBD"),
        vbd_python=("", "Python that has the package newton; else this one, where it has it"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

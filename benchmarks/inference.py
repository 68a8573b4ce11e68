"""What a frame costs with a network: streamed, of a whole motion, of many characters at once, and with a smaller decoder.

    python -m benchmarks.inference [SCENE] [--steps 100] [--rank 64] [--frames 500] [--repeats 7] [--characters 1 256]
        [--whole] [--quick] [--json FILE]

SCENE is a scene file, which is trained for so many steps, or the folder of a run. A streamed frame is one call of the compiled
step with its state's memory reused, waited for: its median and 99th percentile are over so many frames. `mm` is how far the
vertices of the motion are from those of the whole decoder in float32, in the mean and at most; the rank is made for this
motion, the scene's first. `--whole` leaves the smaller decoders out. With many characters, who are at different places of the
motion, times are a character's. The least is that of reading the parameters once and writing the vertices, or of the layers'
products at the rate of float32; see `benchmarks/work.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import work
from benchmarks.measure import clocks, peak_memory, read, run, timed
from ncs_jax import Run, load_run, local_rotations, train
from ncs_jax.network.methods.method import for_inference
from ncs_jax.network.rollout import animate, stepper

CHARACTERS = (1, 4, 16, 64, 256)
PLACES = 64  # of the motion, that a crowd goes through


def stream(garment: Run, *characters: int) -> Callable:
    """One frame of the first motion as one program, or one of each of several characters, at different places of it."""
    model = garment.assembly.model
    rollout: Any = stepper(model, garment.assembly.network, garment.params)
    record = garment.motion(garment.assembly.scene.motion.files[0])
    rotations, places = local_rotations(model, jnp.asarray(record.poses)), jnp.asarray(record.translation)
    for several in characters:
        frames = len(places)
        at = (np.arange(min(frames, PLACES))[:, None] + np.arange(several) * max(1, frames // several)) % frames
        rotations, places = rotations[at], places[at]
    program = jax.jit(rollout.step, donate_argnums=0)
    inputs, state, now = list(zip(list(rotations), list(places), strict=True)), rollout.init(*characters), 0

    def frame():
        nonlocal state, now
        state, x = program(state, *inputs[now % len(inputs)])
        now += 1
        return x

    return frame


def sequence(garment: Run) -> tuple[Callable, int]:
    """The first motion animated at once, and how many frames it has."""
    model, network = garment.assembly.model, garment.assembly.network
    program, track = jax.jit(animate, static_argnums=1), garment.track(garment.assembly.scene.motion.files[0])
    network, params = for_inference(network, garment.params, model)
    return lambda: program(model, network, params, track), len(track.start)


def compressed(whole: Run, track, rank: int) -> dict[str, Run]:
    """The same with smaller decoders, by name."""
    rank = min(rank, len(track.start), *whole.assembly.network.decoder.sizes)
    smaller = {"bfloat16": whole.compressed(track, bfloat16=True), f"rank {rank}": whole.compressed(track, rank=rank)}
    return smaller | {f"rank {rank}, bfloat16": whole.compressed(track, rank=rank, bfloat16=True)}


def benchmark(options) -> dict:
    """Measure a scene's inference."""
    if Path(options.scene).is_dir():
        whole = load_run(options.scene)
        read(whole.assembly.scene)
    else:
        whole = train(read(options.scene), steps=min(options.steps, 10) if options.quick else options.steps)
    model, motion = whole.assembly.model, whole.assembly.scene.motion.files[0]
    frames = 5 if options.quick else options.frames
    track = whole.track(motion)
    smaller = {} if options.whole else compressed(whole, track, options.rank)
    if options.quick:
        smaller = dict(list(smaller.items())[-1:])
    rows: dict[str, dict] = {}
    exact = whole.animate(track)
    for name, garment in {"float32": whole, **smaller}.items():
        params = for_inference(garment.assembly.network, garment.params, model)[1]
        apart = 1000 * np.linalg.norm(garment.animate(track) - exact, axis=-1)
        error = {"mm mean": float(apart.mean()), "mm max": float(apart.max())}
        at_once, count = sequence(garment)
        rows[f"streamed, {name}"] = {
            "seconds": timed(stream(garment), frames), "work": work.inference(model, params, 1), **error,
        }  # fmt: skip
        rows[f"whole motion, {name}, a frame"] = {
            "seconds": timed(at_once, options.repeats, count), "work": work.inference(model, params, count), "times": count,
            **error,
        }  # fmt: skip
    several = [round(n) for n in options.characters] or CHARACTERS
    crowds = [("float32", whole, n) for n in (several[:2] if options.quick else several)]
    crowds += [(name, garment, crowds[-1][2]) for name, garment in smaller.items()]
    for name, garment, n in crowds:
        params = for_inference(garment.assembly.network, garment.params, model)[1]
        seconds = timed(stream(garment, n), max(options.repeats, frames // n), n)
        rows[f"{n} at once, {name}, each"] = {"seconds": seconds, "work": work.inference(model, params, n), "times": n}
    for row in rows.values():
        row["frames/s"] = 1 / row["seconds"]["median"]
    return {
        "vertices": len(model.garment.mesh.rest),
        "steps of training": whole.steps,
        "frames of the motion": count,
        "peak memory MB": peak_memory() >> 20,
        "rows": rows,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    return run(
        __doc__, benchmark, lambda figures: clocks(figures["rows"], ("frames/s", "mm mean", "mm max")), arguments,
        steps=(100, "of training, where SCENE is no run"), rank=(64, "of the smaller decoder, at most"),
        frames=(500, "streamed ones that are timed"), repeats=(7, "timed calls of the others"),
        characters=((), f"how many move at once (default: {' '.join(map(str, CHARACTERS))})"),
        whole=(False, "the whole decoder alone"),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

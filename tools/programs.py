"""Whether two versions of the package compute the same: hashes of the programs that train and simulate a scene.

    python -m tools.programs [ncs:skirt ncs:tshirt ncs:dress]

Figures measured with one version hold for another where these are equal, and the files of `assets` are. Nothing is run but what
makes a scene ready: the programs are those that JAX hands to its compiler.
"""

from __future__ import annotations

import hashlib
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp

from ncs_jax import InputError, assemble, load_scene
from ncs_jax.prepare.build import Assembly
from ncs_jax.runs.refine import with_smooth_contact
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.training.loss import with_bodies
from ncs_jax.training.step import chunk_runner, initial_state, refreshed

PACKAGED = "ncs:skirt", "ncs:tshirt", "ncs:dress"


def lowered(assembly: Assembly) -> dict[str, str]:
    """Return the text of the program of ten steps of training, and of a simulation with smooth contact."""
    model, network, spec = assembly.model, assembly.network, assembly.scene.training
    state, track = initial_state(model, network, 0), with_bodies(model, assembly.track, spec.batch)
    track = replace(track, **refreshed(network, state.params, model, track))
    ends = jnp.zeros((10, spec.batch), jnp.int32)
    training = chunk_runner(network, spec).lower(state, ends, ends, 100, model, track)
    simulator = simulator_from(with_smooth_contact(assembly, assembly.track))
    simulation = jax.jit(lambda simulator, track: simulate(simulator, track)).lower(simulator, assembly.track)
    return {"train": training.as_text(), "simulate": simulation.as_text()}


def main() -> int:
    """Print a line for each program of each scene."""
    try:
        for name in sys.argv[1:] or PACKAGED:
            for what, text in lowered(assemble(load_scene(name))).items():
                print(f"{name} {what}: {hashlib.sha256(text.encode()).hexdigest()[:16]}, {len(text)} characters")
    except InputError as error:
        print(f"programs: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

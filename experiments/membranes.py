"""Four membranes, St. Venant-Kirchhoff, Neo-Hookean, Baraff-Witkin and mass-spring: learned, simulated, pressed together.

    python -m experiments.membranes [SCENE] [--steps 2000] [--unseen ncs:mixed ncs:walk_turn_stop] [--quick]

Each is trained and simulated on the same motions, and judged by its own energy and beside its own simulation. Apart from that a
sheet is pressed to between 1 and 0 times its length, its width kept: where its force falls, it gives way, and where the force
is zero before the length is, nothing keeps it from collapsing. Writes membranes.csv, .md and .png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.fit_material import sheet
from experiments.study import COLUMNS, axes_of, changed, command, networks, references, without, write
from ncs_jax import Scene
from ncs_jax.energies.terms import MEMBRANES
from ncs_jax.geometry.mesh import mesh_from

LENGTHS = np.linspace(1, 0.02, 99)  # of the rest length
YIELDS = {"yields": "force greatest at, of its length", "collapses": "force zero again at"}


def pressed(scene: Scene) -> dict[str, np.ndarray]:
    """Force in N per m of width that a sheet of 0.3 m pushes back with, at every one of LENGTHS, by membrane."""
    vertices, faces = sheet(5)
    mesh, side = mesh_from(vertices, faces), 0.3
    forces = {}
    for name, (energy, fields) in MEMBRANES.items():
        material = [jnp.asarray(getattr(scene.physics.membrane, field)) for field in fields]

        def at(length, energy=energy, material=material):
            return energy(mesh.rest * jnp.stack([jnp.ones(()), length, jnp.ones(())]), mesh, *material)

        slope = jax.vmap(jax.grad(at))(jnp.asarray(LENGTHS, jnp.float32))
        forces[name] = -np.asarray(slope, np.float64) / side**2
    return forces


def limits(force: np.ndarray) -> dict[str, float | str]:
    """Where the force is greatest, and where it is zero again."""
    peak = int(force.argmax())
    gone = np.flatnonzero(force[peak:] <= 0)
    found: dict[str, float | str] = {"yields": float(LENGTHS[peak]) if peak < len(force) - 1 else "never"}
    return found | {"collapses": float(LENGTHS[peak + gone[0]]) if len(gone) else "never"}


def experiment(scene: Scene, unseen: Sequence[str], steps: int, out: Path, kept: Path) -> list[dict]:
    """Measure all, write the table and the picture into `out`, and return the rows."""
    forces = pressed(scene)
    scene = without(scene, unseen)
    scenes = {name: changed(scene, physics={"membrane": {"model": name}}) for name in MEMBRANES}
    references(reversed(scenes.values()), unseen[:1], kept)  # the last takes longest
    rows = networks(scenes, unseen[:1], steps, kept, "model")
    rows = [row | limits(forces[row["model"]]) for row in rows]
    write(out, "membranes", rows, {"model": "", **COLUMNS, **YIELDS})
    with axes_of(out / "membranes.png", 1) as (axes,):
        for name, force in forces.items():
            axes.plot(LENGTHS, force, label=name)
        axes.axhline(0, color="0.7", linewidth=1)
        axes.set(xlabel="length, of that at rest", ylabel="force, N per m of width", xlim=(1, 0))
        axes.legend(frameon=False, fontsize=8)
    return rows


def conclusion(rows: Sequence[dict]) -> str:
    """What the numbers say."""

    def told(row):
        return f"{row['model']} {row['strain_mean']:.2f} % strain, {row['distance']:.1f} mm"

    yields = [f"{r['model']} from {r['yields']:.2f}" for r in rows if isinstance(r["yields"], float)]
    end = f"pressed together, these give way: {', '.join(yields)} of their length" if yields else "pressed, none gives way"
    return f"Learned, to their own simulations: {'; '.join(map(told, rows))}; {end}."


main = partial(command, "membranes", __doc__, experiment)

if __name__ == "__main__":
    sys.exit(main())

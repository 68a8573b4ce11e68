"""Derivatives through the simulator, by the implicit function theorem, against central differences in float64."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.prepare.build import features_from_records
from ncs_jax.runs.run import assemble
from ncs_jax.scene.spec import load_scene
from ncs_jax.simulation.implicit_euler import simulate, simulator_from
from ncs_jax.simulation.solver.minimise import CONVERGED, Settings

from .scenes import SCENE, write_scene

pytestmark = pytest.mark.slow

TIGHT = Settings(tolerance=1e-10, iterations=200, first=5000)
FREE = SCENE.replace("body.npz", "none").replace('files = ["swing.npz"]\nvalidation = ["swing.npz"]', "files = []")
PINNED = "[physics]\ngravity = [0.4, -9.81, 1.0]\n[physics.pinning]\nstiffness = 50\n"


def scene(tmp_path, contact, friction):
    text = (SCENE if contact else FREE).replace("smoothing = 2", 'smoothing = 2\npins = "pins"') + PINNED
    text = text.replace("modes = 6", "modes = 0")
    if contact:
        text += '[physics.collision]\ndistance = "smooth"\nstiffness = 40\nthickness = 0.006\n'
        text += f"friction = {friction}\n"
    assembly = assemble(load_scene(write_scene(tmp_path, text)), dtype=jnp.float64)
    model = assembly.model
    if contact:
        track = features_from_records(model, assembly.motions["swing.npz"])
        return simulator_from(model), jax.tree.map(lambda a: a[:5], track)
    track = assembly.track  # a character that never moves is one frame long
    return simulator_from(replace(model, moves=True)), jax.tree.map(lambda a: jnp.repeat(a, 5, axis=0), track)


def outcome(simulator, track, forces, wanted, settings):
    x, solution = simulate(simulator, track, settings, forces=forces)
    return jnp.sum(wanted * x[1:]), solution


def perturbed(simulator, track, forces, name, size, direction):
    """The same problem with one of its inputs moved by `size` times `direction`."""
    if name == "forces":
        return simulator, track, forces + size * direction
    if name == "body motion":
        return simulator, replace(track, matrices=track.matrices + size * direction), forces
    if name == "pins":
        garment = simulator.model.garment
        mesh = replace(garment.mesh, rest=garment.mesh.rest + size * direction)
        return replace(simulator, model=replace(simulator.model, garment=replace(garment, mesh=mesh))), track, forces
    material = simulator.model.material
    if name == "lam":
        changed = replace(material, membrane=(material.membrane[0] * (1 + size), material.membrane[1]))
    else:
        changed = replace(material, **{name: getattr(material, name) * (1 + size)})
    return replace(simulator, model=replace(simulator.model, material=changed)), track, forces


@pytest.mark.parametrize("kind", ["hanging", "hanging from exact pins", "on the post", "rubbing on the post"])
def test_gradients_of_a_trajectory_are_its_central_differences(tmp_path, rng, kind):
    contact, rubs, exact = "post" in kind, "rubbing" in kind, "exact" in kind
    simulator, track = scene(tmp_path, contact, 0.3 if rubs else 0.0)
    settings = replace(TIGHT, exact_pins=exact)
    shape = (5, *simulator.model.garment.mesh.rest.shape)
    wanted = jnp.asarray(rng.uniform(0.5, 1.5, (4, *shape[1:])))  # of one sign, so that no parameter's effects cancel
    forces = jnp.asarray(1e-4 * rng.standard_normal(shape))
    directions = {
        "density": jnp.ones(()),
        "lam": jnp.ones(()),
        "bending": jnp.ones(()),
        "pinning": jnp.ones(()),
        "gravity": jnp.ones(()),
        "forces": jnp.asarray(1e-4 * rng.standard_normal(shape)),
        "pins": jnp.zeros(shape[1:]).at[25:].set(0.01 * rng.standard_normal((5, 3))),
    }
    if exact:
        del directions["pinning"]  # no springs hold them
    if rubs:
        directions["friction"] = jnp.ones(())
    if contact:
        directions |= {"collision": jnp.ones(()), "thickness": jnp.ones(())}
        directions["body motion"] = jnp.asarray(0.01 * rng.standard_normal(track.matrices.shape))

    @jax.jit
    def moved(sizes):
        problem = simulator, track, forces
        for (name, direction), size in zip(directions.items(), sizes, strict=True):
            problem = perturbed(*problem, name, size, direction)
        return outcome(*problem, wanted, settings)

    here = jnp.zeros(len(directions))
    gradient, solution = jax.jit(jax.grad(moved, has_aux=True))(here)
    assert np.all(np.asarray(solution.status) == CONVERGED)
    for k, name in enumerate(directions):
        step = 1e-4  # the solves round to 1e-12 m; a central difference leaves out the square
        ends = [moved(here.at[k].set(sign * step)) for sign in (1, -1)]
        assert all(np.all(np.asarray(s.status) == CONVERGED) for _, s in ends)
        difference = float(ends[0][0] - ends[1][0]) / (2 * step)
        assert abs(difference) > 1e-7, f"{name} changes nothing"
        np.testing.assert_allclose(float(gradient[k]), difference, rtol=1e-4, err_msg=name)

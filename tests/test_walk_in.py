"""The way from rest into the pose in which a simulation begins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ncs_jax
from ncs_jax.geometry.skinning import Skeleton, forward, transforms
from ncs_jax.scene.spec import scene_from
from ncs_jax.simulation.implicit_euler import simulator_from, stepper
from ncs_jax.simulation.solver.minimise import Settings
from ncs_jax.simulation.walk_in import ANGLE, FALL, SETTLE, walk_in

from .scenes import swing
from .simulators import sleeve

JOINTS = np.array([[0, 1, 0], [0, 1.5, 0], [0.4, 1.5, 0], [0.7, 1.5, 0.1]])
PARENTS = (-1, 0, 1, 2)


def posed(turns, at=(2.0, 0.5, -1.0)):
    rotations = jnp.asarray(Rotation.from_rotvec(np.asarray(turns, float)).as_matrix())
    skeleton = Skeleton(jnp.asarray(JOINTS), PARENTS)
    return skeleton, transforms(skeleton, forward(skeleton, rotations, jnp.asarray(at)))


def local(matrices):
    world = np.asarray(matrices)[..., :3]
    turned = [world[:, j] if p < 0 else np.swapaxes(world[:, p], 1, 2) @ world[:, j] for j, p in enumerate(PARENTS)]
    return np.stack([Rotation.from_matrix(turn).as_rotvec() for turn in turned], axis=1)


def test_the_joints_turn_evenly_from_rest_while_the_root_stays():
    turns = [[0, 2.0, 0.3], [0.2, 0, 0], [0, 0, -1.2], [0.3, -0.4, 0]]
    skeleton, matrices = posed(turns)
    way = walk_in(skeleton, matrices)
    np.testing.assert_allclose(way[:, 0], np.broadcast_to(matrices[0], (len(way), 3, 4)), atol=1e-9)
    found, every = local(way), np.array([*local(way), *local(np.asarray(matrices)[None])])
    np.testing.assert_allclose(found[0, 1:], 0, atol=1e-9)
    steps = np.linalg.norm(np.diff(every, axis=0), axis=2)[:, 1:]
    assert steps.max() <= 1.1 * ANGLE + 1e-9  # a tenth more, rather than one pose for a rest of rounding
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-9)
    assert len(way) == 12


@pytest.mark.parametrize("turn", [0.0, 0.5 * ANGLE * 0.1])
def test_a_body_that_begins_at_rest_has_no_way_to_go(turn):
    skeleton, matrices = posed([[0, 1.0, 0], [turn, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert walk_in(skeleton, matrices).shape == (0, 4, 3, 4)


def test_a_simulation_begins_where_the_garment_was_led(tmp_path):
    """A sleeve on a post that is bent by 140 degrees: how it lies in the bend is told by how it came there."""
    assembly = sleeve(tmp_path)
    bent = {**swing(frames=2, size=0.0), "poses": np.zeros((2, 2, 3), np.float32)}
    bent["poses"][:, 1, 0] = 2.4
    np.savez(tmp_path / "bent.npz", **bent)
    tables = assembly.scene.to_dict()
    tables["simulation"] |= {"tolerance": 1e-4, "precision": "double"}
    scene = scene_from(tables)
    led = ncs_jax.simulate(scene, str(tmp_path / "bent.npz"))
    model = led.assembly.model
    simulator, settings = simulator_from(model), Settings(tolerance=1e-4, iterations=400)
    first, simulation = led.assembly.track.matrices[0], stepper(simulator, settings)
    follow = jax.jit(lambda state, pose, limit: simulation.follow(state, pose, limit=limit, still=jnp.asarray(True)))
    state, way = simulation.init(), walk_in(model.skeleton, first)
    for pose, limit in zip((*way, first), (FALL, *[SETTLE] * (len(way) - 1), 400), strict=True):
        state, x = follow(state, pose, limit)
    _, skinned = follow(simulation.init(), first, 400)
    np.testing.assert_allclose(led.vertices[0], x, atol=1e-6)
    assert led.status[0] == 0 and np.abs(led.vertices[0] - skinned).max() > 0.01  # the sleeve has caught in the bend

"""Skin beside a garment: by its normals there contact pushes cloth inwards, whichever way the skin itself is turned."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ncs_jax
from ncs_jax.energies.contact.beside import Beside, turned_inwards
from ncs_jax.energies.total import energy_terms
from ncs_jax.geometry.skinning import Blend
from ncs_jax.io import read_body
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.posing import joint_transforms
from ncs_jax.scene.model import body_normals, pose_body, pose_garment, posed_bodies
from ncs_jax.scene.step_inputs import step_inputs
from ncs_jax.simulation.solver.problem import Problem, body_contact
from ncs_jax.simulation.solver.stiffness import couplings_from


def turned(cosines, rotation, shift):
    """Normals at these cosines with the outward normal of a garment at x = 0 that looks along x; all is moved together."""
    sines = np.sqrt(1 - np.square(cosines))
    normals = np.stack([cosines, sines, 0 * sines], axis=1)
    wall = np.stack([np.zeros(25), *np.mgrid[-2:3, -2:3].reshape(2, -1) / 10], axis=1)
    far = wall + [0, 0, 30]  # of which the other side looks out
    points, outward = (
        np.concatenate([wall, far]),
        np.concatenate([np.tile([1.0, 0, 0], (25, 1)), np.tile([-1.0, 0, 0], (25, 1))]),
    )
    one = Beside(jnp.arange(len(normals)), jnp.asarray(points), jnp.asarray(outward), Blend(jnp.ones((50, 1)), (0,)))
    body = np.concatenate([np.linspace(-0.1, 0.1, len(normals))[:, None] * [1, 1, 0], [[5.0, 5, 5]]])  # the last is not beside
    normals = np.concatenate([normals, [[1.0, 0, 0]]])
    matrices = np.concatenate([rotation, shift[:, None]], axis=1)[None]
    found = turned_inwards(
        jnp.asarray(normals @ rotation.T), jnp.asarray(body @ rotation.T + shift), jnp.asarray(matrices), one
    )
    return np.asarray(found) @ rotation


def test_normals_that_look_outwards_look_inwards(rng):
    cosines = np.array([-1, -0.8, -0.5, -0.2, 0, 0.2, 0.5, 0.8, 1])
    found = turned(cosines, np.eye(3), np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found[:3, 0], cosines[:3], atol=1e-6)  # those that look inwards stay
    np.testing.assert_allclose(found[4], [-np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-6)
    np.testing.assert_allclose(found[6:9], np.tile([-1.0, 0, 0], (3, 1)), atol=1e-6)
    np.testing.assert_array_equal(found[9], [1, 0, 0])
    assert np.all(found[:9, 0] < 0)
    moved = turned(cosines, Rotation.random(rng=rng).as_matrix(), np.array([30.0, -20, 10]))
    np.testing.assert_allclose(moved, found, atol=2e-4)  # rounded at 40 m


def dressed(name):
    """A packaged scene, made ready without looking for vibrations."""
    scene = ncs_jax.load_scene(name)
    return ncs_jax.assemble(replace(scene, network=replace(scene.network, cell="gated")))


@pytest.fixture(scope="module")
def dress():
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return dressed("ncs:dress")


def reaching(a, bend, twist=0.0):
    """Joint transforms with the arms bent down by an angle, rad, so that the hands reach into the dress, and twisted before."""
    body = read_body(packaged("body"))
    poses = np.zeros((1, len(body.parents), 3))
    for side, sign in (("Left", -1), ("Right", 1)):
        arm, elbow = (body.joint_names.index(f"{side}{name}") for name in ("Arm", "ForeArm"))
        along = body.joints[elbow] - body.joints[arm]
        twisted = Rotation.from_rotvec(twist * along / np.linalg.norm(along))
        poses[0, arm] = (Rotation.from_rotvec([0, 0, sign * bend]) * twisted).as_rotvec()
    return jnp.asarray(joint_transforms(body, poses)[0][np.asarray(a.model.source_joints)], jnp.float32)


def test_arms_are_beside_a_dress_and_legs_are_not(dress, plain_jax):
    model, body = dress.model, read_body(packaged("body"))
    rest = np.asarray(model.body)[np.asarray(model.beside.skin)]
    number = np.argmin(np.linalg.norm(rest[:, None] - body.vertices[None], axis=-1), axis=1)
    names = set(np.array(body.joint_names)[body.weights[number].argmax(axis=1)])
    assert names & {"LeftForeArm", "RightForeArm"} and not any(
        part in name for name in names for part in ("Leg", "Spine", "Hips")
    )


def test_a_hand_in_a_skirt_pushes_the_skirt_before_it(dress, plain_jax):
    """Cloth over the back of a hand is pushed inwards with it, as by its palm: by its own normals it would be pushed out."""
    model = dress.model
    matrices = reaching(dress, 0.75, np.pi)
    body = pose_body(model, matrices)
    own, found = (np.asarray(body_normals(m, body, matrices)) for m in (replace(model, beside=None), model))
    skin = np.asarray(model.beside.skin)
    hands = skin[np.asarray(body)[skin, 1] < 0.9]
    over = hands[np.abs(own[hands, 0]) > 0.8]
    over = over[np.sign(own[over, 0]) == np.sign(np.asarray(body)[over, 0])]  # those that look away from the body
    alike = np.sum(found[over] * own[over], axis=1)
    assert len(over) > 100 and np.mean(alike < 0.5) > 0.5  # others are at an arm's side
    back = over[alike.argmin()]
    legs = np.setdiff1d(np.arange(len(body)), skin)
    np.testing.assert_array_equal(found[legs], own[legs])

    rest = np.asarray(model.garment.mesh.rest)
    place = int(np.argmin(np.abs(rest[:, 1] - 0.9)))  # a vertex of the skirt, put over the back of a hand
    x = np.full_like(rest, 10.0) + rest
    x[place] = np.asarray(body)[back] + 0.002 * own[back]
    terms = replace(model.terms, membrane=None, bending=False, gravity=False, inertia=False, pinning=False)

    def pushed(m):
        def energy(x):
            return energy_terms(x, m.garment, m.material, step_inputs(m, matrices), terms, m.surface)["collision"]

        return -np.asarray(jax.grad(energy)(jnp.asarray(x)))[place] @ own[back]

    assert pushed(replace(model, beside=None)) > 0 > pushed(model)


def test_the_solver_feels_the_same_contact(dress, plain_jax):
    """With a hand in the skirt: the energy that a step goes down, and its force, are those of the total."""
    model, matrices = dress.model, reaching(dress, 0.75, np.pi)
    inputs, terms = step_inputs(model, matrices), replace(model.terms, inertia=False)
    problem = Problem(model, couplings_from(model.garment.mesh), None, inputs)
    x = pose_garment(model, jnp.zeros_like(model.garment.mesh.rest), matrices, model.blend)

    def energy(x, step):
        return energy_terms(x, model.garment, model.material, step, terms, model.surface)["collision"]

    value, slope = jax.value_and_grad(energy)(x, inputs)
    contact = body_contact(problem, x)
    np.testing.assert_allclose(contact.energy, value, rtol=1e-5)
    np.testing.assert_allclose(contact.gradient, slope, atol=1e-5 * float(jnp.abs(slope).max()))
    assert float(energy(x, replace(inputs, normals=None))) != pytest.approx(float(value), rel=0.01)


def test_many_frames_are_as_each_by_itself(dress, plain_jax):
    model = dress.model
    matrices = jnp.stack([reaching(dress, bend) for bend in (0.0, 0.4, 0.8)])
    every = posed_bodies(model, matrices, 2)
    for frame, bodies in zip(matrices, every, strict=True):
        body = pose_body(model, frame)
        np.testing.assert_allclose(bodies[:, :3], body, atol=1e-6)
        np.testing.assert_allclose(bodies[:, 3:], body_normals(model, body, frame), atol=1e-4)
        np.testing.assert_array_equal(step_inputs(model, frame).normals, body_normals(model, body, frame))


def test_nothing_is_traced_where_no_skin_is_beside(dress, plain_jax):
    model = dress.model
    smooth = replace(model, terms=replace(model.terms, collision="smooth"))
    assert step_inputs(smooth, reaching(dress, 0.0)).normals is None
    assert step_inputs(replace(model, beside=None), reaching(dress, 0.0)).normals is None

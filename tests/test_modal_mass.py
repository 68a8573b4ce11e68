"""The mass of vibrations from joints alone, against sums over the vertices."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax.geometry.skinning import blend, blend_from
from ncs_jax.network.methods.modal_mass import constants, modal_mass, pulled, rotations_of


def test_joints_give_what_a_sum_over_the_vertices_gives(rng):
    verts, joints, modes, poses = 30, 4, 3, 5
    weights = rng.dirichlet(np.ones(3), verts)
    weights = blend_from(np.insert(weights, 1, 0, axis=1), dtype=jnp.float64)  # one joint carries nothing
    directions, mass = rng.normal(size=(verts, 3, modes)), rng.uniform(1, 2, verts)
    turns = Rotation.from_rotvec(rng.normal(size=(joints * 2 * poses, 3))).as_matrix().reshape(2, poses, joints, 3, 3)
    matrices = np.concatenate([turns, rng.normal(size=(2, poses, joints, 3, 1))], axis=-1)
    now, then = (jnp.asarray(np.moveaxis(m, 0, -1)) for m in matrices)
    known = constants(jnp.asarray(directions), jnp.asarray(mass), weights)
    found = modal_mass(known, rotations_of(now, weights), rotations_of(then, weights))
    moved = [np.einsum("vijp,vjk->vikp", blend(m, weights)[:, :, :3], directions) for m in (now, then)]
    np.testing.assert_allclose(found, np.einsum("v,vikp,vilp->klp", mass, *moved), atol=1e-12)
    force = rng.normal(size=(verts, 3, poses))
    expected = np.einsum("vikp,vip->kp", moved[0], force)
    np.testing.assert_allclose(pulled(jnp.asarray(directions), blend(now, weights), jnp.asarray(force)), expected, atol=1e-12)

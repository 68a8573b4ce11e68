"""What a surface encloses, on the host and in a program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.winding_number import winding_number

from .shapes import ball


@pytest.mark.parametrize("kind", ["host", "program"])
def test_the_winding_number_is_one_within_a_closed_surface_and_what_is_left_of_it_within_an_open_one(kind, rng):
    turns = winding_number if kind == "host" else lambda *given: jax.jit(winding_number)(*map(jnp.asarray, given))
    vertices, faces = ball(3, 0.1)
    away = rng.normal(size=(20, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    triangles = vertices[faces]
    np.testing.assert_allclose(turns(0.09 * away, triangles), 1, atol=1e-6)
    np.testing.assert_allclose(turns(0.11 * away, triangles), 0, atol=1e-6)
    np.testing.assert_allclose(turns(0.09 * away, triangles[:, ::-1]), -1, atol=1e-6)  # inside out
    half = vertices[faces].mean(axis=1) @ [0.1, 0.7, 0.2] > 0  # of a surface that is the same seen from the other side
    np.testing.assert_allclose(turns(np.zeros((1, 3)), triangles[half]), 0.5, atol=1e-6)


def test_what_two_touching_surfaces_with_holes_enclose_is_told():
    """Two balls, as thighs: near where they touch, the nearest skin is the other one's."""
    vertices, faces = ball(3, 0.1)
    faces = faces[vertices[faces].mean(axis=1)[:, 1] < 0.095]  # each with a hole on top
    triangles = np.concatenate([vertices[faces] + [side * 0.101, 0, 0] for side in (-1, 1)])
    inner = [[0.101, 0, 0], [-0.101, 0, 0], [0.02, 0, 0], [0.17, 0, 0]]
    outer = [[0, 0.05, 0], [0, 0, 0.15], [0.23, 0, 0], [1, 1, 1]]
    np.testing.assert_array_equal(winding_number(np.array(inner + outer), triangles) > 0.5, [True] * 4 + [False] * 4)

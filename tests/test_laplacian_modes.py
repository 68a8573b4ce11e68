"""The Dirichlet form and the smooth modes, against what is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from ncs_jax.geometry.laplacian_modes import laplacian, modal_basis
from ncs_jax.geometry.mesh import mesh_from

from .shapes import ball, equilateral, rotation, sheet, tube

SHAPES = {"sheet": sheet(9, 12, 0.01), "tube": tube(), "ball": ball(2), "equilateral": equilateral()}
every_shape = pytest.mark.parametrize("name", SHAPES)


def lumped(vertices, faces):
    return np.asarray(mesh_from(vertices, faces).vertex_area, np.float64)


def pieces(count, verts=9):
    """So many sheets apart from each other."""
    vertices, faces = sheet(3, 3, 0.01)
    return (
        np.concatenate([vertices + [0.1 * k, 0, 0] for k in range(count)]),
        np.concatenate([faces + verts * k for k in range(count)]),
    )


# --- the form -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (3.0, -2.0, 5.0)])
@pytest.mark.parametrize("name", ["sheet", "equilateral"])
def test_dirichlet_energy_of_a_linear_function(name, slope, rng):
    """A |s|^2 for the function s . x on a flat patch of area A, wherever it lies; s in the patch's plane."""
    vertices, faces = SHAPES[name]
    crumpled = vertices.copy()
    crumpled[:, :2] += 1e-3 * rng.normal(size=(len(vertices), 2))
    area = lumped(crumpled, faces).sum()
    form = laplacian(crumpled @ rotation([1, 2, 3], 1.0).T + 0.5, faces)
    function = crumpled @ np.array(slope) + 7
    np.testing.assert_allclose(function @ (form @ function), area * np.sum(np.square(slope[:2])), rtol=1e-6)


@every_shape
def test_dirichlet_energy_face_by_face(name, rng):
    vertices, faces = SHAPES[name]
    function = rng.normal(size=len(vertices))
    expected = 0.0
    for face in faces:
        p, f = vertices[face], function[face]
        e = p[1:] - p[0]
        gradient = np.linalg.lstsq(e, f[1:] - f[0], rcond=None)[0]  # of least length: in the plane
        expected += np.linalg.norm(np.cross(*e)) / 2 * gradient @ gradient
    np.testing.assert_allclose(function @ (laplacian(vertices, faces) @ function), expected, rtol=1e-9)


@every_shape
def test_the_form_is_symmetric_semidefinite_and_blind_to_constants(name):
    form = laplacian(*SHAPES[name]).toarray()
    np.testing.assert_allclose(form, form.T, atol=1e-12)
    np.testing.assert_allclose(form.sum(axis=1), 0, atol=1e-10)
    assert np.linalg.eigvalsh(form)[0] > -1e-10


def test_a_face_without_area_weighs_nothing():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]])
    whole, with_needle = laplacian(vertices, np.array([[0, 1, 2]])), laplacian(vertices, np.array([[0, 1, 2], [0, 3, 1]]))
    np.testing.assert_array_equal(whole.toarray(), with_needle.toarray())


# --- the modes ----------------------------------------------------------------------------------------------------------


def scaled_back(vertices, faces, basis, amplitude):
    """Columns as eigenvectors of mean square 1, and the scale and eigenvalue of each."""
    area = lumped(vertices, faces)
    basis = np.asarray(basis, np.float64)
    scale = np.sqrt(area @ basis**2 / area.sum()) / amplitude
    unit = basis / (amplitude * scale)
    return area, unit, scale, np.einsum("vm,vm->m", unit, laplacian(vertices, faces) @ unit) / area.sum()


@pytest.mark.parametrize(("name", "count"), [("sheet", 12), ("tube", 8), ("ball", 30), ("ball", 20)])
def test_modes_are_orthogonal_under_mass_and_stiffness_and_smoothest_first(name, count):
    """(The ball of 162 vertices is solved densely for 30 modes and by ARPACK for 20.)"""
    vertices, faces = SHAPES[name]
    basis = modal_basis(vertices, faces, lumped(vertices, faces), count, 0.02)
    assert basis.shape == (len(vertices), count) and basis.dtype == np.float32
    area, unit, scale, values = scaled_back(vertices, faces, basis, 0.02)
    np.testing.assert_allclose((unit.T * area) @ unit / area.sum(), np.eye(count), atol=2e-5)
    stiffness = unit.T @ (laplacian(vertices, faces) @ unit) / area.sum()
    np.testing.assert_allclose(stiffness, np.diag(values), atol=2e-5 * values.max())
    assert (np.diff(values) > -1e-4 * values.max()).all()
    # b_i = amplitude u_i / sqrt(1 + lambda_i / lambda_ref)
    reference = (2 * np.pi) ** 2 / np.sum(np.ptp(vertices, axis=0) ** 2)
    np.testing.assert_allclose(scale, 1 / np.sqrt(1 + values / reference), rtol=1e-4)


def lopsided(shape):
    """Without a symmetry: no two modes of one frequency, and the largest entry of a mode, whose sign is plus, is one alone."""
    vertices, faces = shape
    return vertices * [1.0, 1.3, 1.7] + 1e-3 * np.random.default_rng(8).normal(size=vertices.shape), faces


def test_dense_and_sparse_find_the_same_modes():
    vertices, faces = lopsided(sheet(9, 12, 0.01))  # 108 vertices: dense from 11 modes on
    area = lumped(vertices, faces)
    few, many = (modal_basis(vertices, faces, area, n) for n in (10, 11))
    np.testing.assert_allclose(few, many[:, :10], atol=1e-6)


@every_shape
def test_the_first_mode_moves_everything_alike(name):
    vertices, faces = SHAPES[name]
    basis = modal_basis(vertices, faces, lumped(vertices, faces), 5, 0.02)
    np.testing.assert_allclose(basis[:, 0], 0.02, rtol=1e-5)


@pytest.mark.parametrize("amplitude", [0.02, 0.005])
@every_shape
def test_no_mode_moves_the_cloth_by_more_than_the_amplitude(name, amplitude):
    vertices, faces = SHAPES[name]
    area = lumped(vertices, faces)
    basis = modal_basis(vertices, faces, area, 6, amplitude)
    rms = np.sqrt(area @ np.asarray(basis, np.float64) ** 2 / area.sum())
    assert (rms <= amplitude * (1 + 1e-5)).all() and (rms > 0).all()
    np.testing.assert_allclose(basis * (0.02 / amplitude), modal_basis(vertices, faces, area, 6, 0.02), rtol=1e-4, atol=1e-8)


def test_a_long_strip_vibrates_in_cosines():
    """Neumann modes of the interval: eigenvalues (n pi / L)^2."""
    vertices, faces = sheet(2, 101, 0.01)
    basis = modal_basis(vertices, faces, lumped(vertices, faces), 5)
    _, unit, _, values = scaled_back(vertices, faces, basis, 0.02)
    wave = np.arange(1, 5) * np.pi / 1.0
    np.testing.assert_allclose(values[1:], wave**2, rtol=5e-3)
    for n in (1, 2, 3):
        cosine = np.sqrt(2) * np.cos(wave[n - 1] * vertices[:, 0])
        np.testing.assert_allclose(np.abs(unit[:, n] @ cosine) / len(vertices), 1, rtol=2e-2)


def test_a_strip_held_at_its_end_vibrates_in_sines():
    """Modes of the interval with one end held: eigenvalues ((n + 1/2) pi / L)^2, and nothing moves there."""
    vertices, faces = sheet(2, 101, 0.01)
    held = np.flatnonzero(vertices[:, 0] == 0)
    basis = modal_basis(vertices, faces, lumped(vertices, faces), 4, held=held)
    assert len(held) == 2 and not basis[held].any()
    _, unit, _, values = scaled_back(vertices, faces, basis, 0.02)
    wave = (np.arange(4) + 0.5) * np.pi / 1.0
    np.testing.assert_allclose(values, wave**2, rtol=5e-3)
    for n in range(3):
        sine = np.sqrt(2) * np.sin(wave[n] * vertices[:, 0])
        np.testing.assert_allclose(np.abs(unit[:, n] @ sine) / len(vertices), 1, rtol=2e-2)


def test_no_mode_where_everything_is_held():
    vertices, faces = sheet(3, 3, 0.01)
    assert modal_basis(vertices, faces, lumped(vertices, faces), 5, held=np.arange(9)).shape == (9, 0)


def test_the_same_modes_every_time_and_wherever_the_garment_is():
    vertices, faces = lopsided(ball(2))
    area = lumped(vertices, faces)
    basis = modal_basis(vertices, faces, area, 12)
    np.testing.assert_array_equal(modal_basis(vertices, faces, area, 12), basis)
    np.random.seed(5)  # noqa: NPY002  nor does the global generator change them, which ARPACK's own start comes from
    np.testing.assert_array_equal(modal_basis(vertices, faces, area, 12), basis)
    turned = vertices @ rotation([1, 1, 0], np.pi).T + 0.25  # x and y change places, so the box keeps its diagonal
    np.testing.assert_allclose(modal_basis(turned, faces, area, 12), basis, atol=1e-6)


def test_separate_pieces_move_apart():
    """As many modes of frequency zero as there are pieces: each is constant on every piece."""
    vertices, faces = pieces(3)
    basis = modal_basis(vertices, faces, lumped(vertices, faces), 4, 0.02)
    parts = basis.reshape(3, 9, 4)
    assert np.ptp(parts[..., :3], axis=1).max() < 1e-6
    assert np.ptp(parts[..., 3], axis=1).max() > 1e-3
    assert np.linalg.matrix_rank(parts[:, 0, :3], tol=1e-4) == 3


def test_more_modes_than_vertices_and_loose_vertices():
    vertices, faces = sheet(2, 3, 0.01)
    loose = np.concatenate([vertices, [[0.5, 0.5, 0.5]]])
    area = np.append(lumped(vertices, faces), 0.0)
    basis = modal_basis(loose, faces, area, 128)
    assert basis.shape == (7, 6) and np.isfinite(basis).all()

"""The blocks of the stiffness matrix against the dense Hessian of the total energy, and that they are never indefinite."""

from __future__ import annotations

import dataclasses
import math
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.energies.terms import MEMBRANES, Garment, StepInputs, Terms
from ncs_jax.energies.total import distances, total
from ncs_jax.geometry.mesh import corners, dihedral, mesh_from
from ncs_jax.geometry.skinning import skin
from ncs_jax.simulation.solver.contact import evaluate_contact
from ncs_jax.simulation.solver.stiffness import couplings_from, multiply, stiffness

from .materials import material
from .shapes import ball, rotation, sheet, tube
from .simulators import dense
from .verification.newton import QUICK

NOTHING = Terms(membrane=None, bending=False, collision=None, gravity=False, inertia=False)
TURN = rotation([1, -2, 0.5], 2.0).T
FLAT, FLAT_FACES = sheet(4, 5, 0.01)
ROUND, ROUND_FACES = tube()


def of_membrane(model):
    return dataclasses.replace(NOTHING, membrane=model, bending=model is None)


@cache
def garment(shape, dtype=jnp.float64, seed=None):
    """A sheet or a tube, its vertices perhaps in another order; two of them pinned."""
    vertices, faces = {"sheet": (FLAT, FLAT_FACES), "tube": (ROUND, ROUND_FACES)}[shape]
    if seed is not None:
        new = np.random.default_rng(seed).permutation(len(vertices))
        vertices, faces = vertices[new], np.argsort(new)[faces]
    cloth = Garment(mesh_from(vertices, faces, dtype=dtype), jnp.array([0, 5], jnp.int32))
    return cloth, couplings_from(cloth.mesh)


@partial(jax.jit, static_argnames="terms", compiler_options=QUICK)
def blocks(x, couplings, cloth, numbers, frame, terms, surface=None):
    contact = None if terms.collision is None else evaluate_contact(x, frame, surface, numbers, terms).blocks
    return stiffness(x, couplings, cloth, numbers, frame, terms, contact)


@partial(jax.jit, static_argnames="terms", compiler_options=QUICK)
def column(x, v, cloth, numbers, frame, terms, surface=None):
    force = jax.grad(lambda x: total(x, cloth, numbers, frame, terms, surface))
    return jax.jvp(force, (x,), (v.reshape(x.shape),))[1].reshape(-1)


def hessian(x, *others):
    """Column by column: a program of one compiles several times as fast as one of all."""
    return np.stack([column(x, v, *others) for v in np.eye(x.size)], axis=1)


def assembled(x, shape, terms, *, numbers=None, frame=None, surface=None, seed=None):
    cloth, couplings = garment(shape, seed=seed)
    found = blocks(jnp.asarray(x), couplings, cloth, numbers or material(terms.membrane), frame or StepInputs(), terms, surface)
    return dense(couplings, *found)


def deformations():
    """Of the sheet: what a solver meets on its way, and what it should not."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=FLAT.shape)
    collapsed, folded = FLAT.copy(), FLAT.copy()
    collapsed[7] = collapsed[8]
    folded[:5, 1] = 0.015  # the first row, over its own faces
    return {
        "rest": FLAT,
        "shaken": FLAT + 2e-3 * noise,
        "torn about": FLAT + 2e-2 * noise,
        "a cloud of another size": 0.3 * noise,
        "squeezed along the warp": FLAT * [1, 0.2, 1] + 1e-4 * noise,
        "squeezed along the weft": FLAT * [0.2, 1, 1] + 1e-4 * noise,
        "squeezed in the plane": FLAT * 0.3,
        "turned over": FLAT * [-1, 1, 1],
        "folded": folded,
        "an edge collapsed": collapsed,
        "all faces flattened": FLAT * [1, 0, 0],
        "in one point": FLAT * 0,
    }


@pytest.mark.parametrize("model", [*MEMBRANES, None])
def test_matrix_is_symmetric_and_positive_semi_definite(model):
    """For every model, and for bending alone, on every deformation."""
    indefinite = 0
    for name, x in deformations().items():
        terms = of_membrane(model)
        a = assembled(x @ TURN, "sheet", terms)
        assert np.all(np.isfinite(a)), name
        size = np.abs(a).max()
        np.testing.assert_allclose(a, a.T, rtol=0, atol=1e-13 * size)
        assert np.linalg.eigvalsh(a)[0] >= -1e-12 * size, name
        true = hessian(jnp.asarray(x @ TURN), garment("sheet")[0], material(model), StepInputs(), terms)
        indefinite += np.linalg.eigvalsh(np.asarray(true))[0] < -1e-3 * np.abs(true).max()
    assert indefinite >= 3  # else nothing had to be done


@pytest.mark.parametrize("model", [*MEMBRANES, None])
def test_blocks_are_finite_and_keep_the_type_in_single_precision(model):
    cloth, couplings = garment("sheet", jnp.float32)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), material(model))
    for name, x in deformations().items():
        found = blocks(jnp.asarray(x, jnp.float32), couplings, cloth, single, StepInputs(), of_membrane(model))
        double = blocks(jnp.asarray(x), *garment("sheet")[::-1], material(model), StepInputs(), of_membrane(model))
        for got, exact in zip(found, double, strict=True):
            assert got.dtype == jnp.float32 and jnp.all(jnp.isfinite(got)), name
            if name in ("rest", "shaken", "squeezed in the plane"):
                scale = float(jnp.max(jnp.abs(exact)))
                np.testing.assert_allclose(np.asarray(got), exact, rtol=0, atol=1e-4 * scale)


@pytest.mark.parametrize("model", MEMBRANES)
def test_in_tension_and_at_the_rest_angles_it_is_the_hessian(model, rng):
    """There nothing is projected: a tube blown up evenly keeps its angles. And stretched unevenly, with no bending."""
    cloth = garment("tube")[0]
    soft = dataclasses.replace(material(model), bending=jnp.asarray(0.0))
    noise = 1e-4 * rng.normal(size=ROUND.shape)
    for x, numbers in ((1.001 * ROUND, material(model)), (1.1 * ROUND + noise, soft)):
        x = x @ TURN + [0.3, 1.0, -0.2]
        # One after the other: of bending all models then have the same program.
        both = ((of_membrane(model), numbers), (of_membrane(None), dataclasses.replace(numbers, membrane=())))
        right = sum(hessian(jnp.asarray(x), cloth, n, StepInputs(), terms) for terms, n in both)
        assert np.linalg.eigvalsh(right)[0] > -1e-9 * np.abs(right).max()
        got = sum(assembled(x, "tube", terms, numbers=n) for terms, n in both)
        np.testing.assert_allclose(got, right, rtol=0, atol=1e-6 * np.abs(right).max())


@pytest.mark.parametrize("model", MEMBRANES)
def test_it_is_never_less_than_the_hessian(model):
    """What is projected is added: the difference from the true Hessian is positive semi-definite, element by element."""
    terms = of_membrane(model)
    for name in ("shaken", "squeezed along the warp", "squeezed in the plane"):
        x = deformations()[name]
        true = np.asarray(hessian(jnp.asarray(x), garment("sheet")[0], material(model), StepInputs(), terms))
        difference = assembled(x, "sheet", terms) - true
        assert np.linalg.eigvalsh(difference)[0] > -1e-9 * np.abs(true).max(), name


def test_bending_is_the_square_of_the_angles_derivatives(rng):
    """sum_hinges 2 k l^2 / (8 (A0 + A1)) (d phi / dx)^T (d phi / dx): all of the Hessian at the rest angles."""
    mesh = garment("tube")[0].mesh
    terms = of_membrane(None)
    x = jnp.asarray(ROUND + 1e-3 * rng.normal(size=ROUND.shape))
    slopes = jax.jit(jax.jacfwd(lambda x: dihedral(corners(x, mesh.hinges), [*mesh.hinge_area.T])))(x).reshape(
        len(mesh.hinges), -1
    )
    weight = 2 * 1e-5 * np.asarray(mesh.hinge_length) ** 2 / (8 * np.asarray(mesh.hinge_area).sum(axis=1))
    expected = np.asarray(slopes).T @ (weight[:, None] * np.asarray(slopes))
    np.testing.assert_allclose(assembled(x, "tube", terms), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    right = np.asarray(hessian(jnp.asarray(ROUND), garment("tube")[0], material(None), StepInputs(), terms))
    np.testing.assert_allclose(assembled(ROUND, "tube", terms), right, rtol=0, atol=1e-9 * np.abs(right).max())


@pytest.mark.parametrize("model", ["stvk", "mass_spring"])
def test_the_order_of_the_vertices_does_not_matter(model):
    """Blocks enter transposed where an element names its pair the other way round."""
    terms = dataclasses.replace(NOTHING, membrane=model, bending=True)
    x = deformations()["shaken"]
    here = assembled(x, "sheet", terms).reshape(20, 3, 20, 3)
    new = np.random.default_rng(8).permutation(20)
    there = assembled(x[new], "sheet", terms, seed=8)
    right = here[new][:, :, new].reshape(60, 60)
    np.testing.assert_allclose(there, right, rtol=0, atol=1e-11 * np.abs(right).max())


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_product_with_a_field_is_that_of_the_dense_matrix(dtype, rng):
    _, couplings = garment("sheet")
    diagonal = rng.normal(size=(20, 3, 3))
    diagonal = diagonal + diagonal.transpose(0, 2, 1)
    off, p = rng.normal(size=(len(couplings.pairs), 3, 3)), rng.normal(size=(20, 3))
    got = jax.jit(multiply)(couplings, *(jnp.asarray(a, dtype) for a in (diagonal, off, p)))
    right = (dense(couplings, diagonal, off) @ p.reshape(-1)).reshape(-1, 3)
    assert got.dtype == dtype
    rounding = 1e-5 if dtype == jnp.float32 else 1e-13
    np.testing.assert_allclose(np.asarray(got), right, rtol=0, atol=rounding * np.abs(right).max())


# --- body and pins ------------------------------------------------------------------------------------------------------


@cache
def on_a_ball():
    """The sheet lying in the skin of a ball, a good part of it nearer than the thickness; pins turned and shrunk."""
    body, triangles = ball(2, 0.05)
    rest = FLAT - FLAT.mean(axis=0) + [0, 0, 0.05]
    x = rest + 2e-3 * np.random.default_rng(4).normal(size=rest.shape)
    turn = 0.6 * rotation([1, 2, 3], 1.2) + 0.4 * rotation([0, 1, 0], -0.5)
    blended = jnp.broadcast_to(jnp.asarray(np.concatenate([turn, [[0.01], [0.0], [0.02]]], axis=1)), (20, 3, 4))
    return jnp.asarray(x), StepInputs(body=jnp.asarray(body), vertex_transforms=blended), surface_from(rest, body, triangles)


def test_collision_with_planes_is_the_hessian():
    x, frame, surface = on_a_ball()
    terms = dataclasses.replace(NOTHING, collision="plane")
    depth = np.asarray(jax.jit(lambda x: distances(x, frame.body, surface, terms))(x))
    assert (depth < 0.004).sum() >= 5 and (depth > 0.004).sum() >= 2
    right = hessian(x, garment("sheet")[0], material(), frame, terms, surface)
    np.testing.assert_allclose(assembled(x, "sheet", terms, frame=frame, surface=surface), right, rtol=0, atol=1e-9)
    assert np.abs(right).max() > 5


@pytest.mark.parametrize(("body", "left_out"), [(sheet(3, 3, 0.06), 1e-13), (sheet(21, 21, 0.012), math.exp(-16))])
def test_smooth_collision_is_the_hessian_on_a_plane(body, left_out):
    """Exact where no tangent surface has ended; one that has, 2 h away or more, weighs at most exp(-16) and bends there."""
    body, triangles = body
    x, _, _ = on_a_ball()
    x = jnp.asarray(np.asarray(x) - np.asarray(x).mean(axis=0) + body.mean(axis=0) + [0, 0, 0.002])
    surface = surface_from(np.asarray(x), body, triangles, smooth=True)
    terms, frame = dataclasses.replace(NOTHING, collision="smooth"), StepInputs(body=jnp.asarray(body))
    right = hessian(x, garment("sheet")[0], material(), frame, terms, surface)
    found = assembled(x, "sheet", terms, frame=frame, surface=surface)
    np.testing.assert_allclose(found, right, rtol=0, atol=left_out * np.abs(right).max())
    assert 5 <= np.sum(np.diag(right) > 1) < len(x)


def test_smooth_collision_is_definite_and_of_every_vertex_alone():
    x, frame, _ = on_a_ball()
    body, triangles = ball(2, 0.05)
    surface = surface_from(np.asarray(x), body, triangles, smooth=True)
    terms = dataclasses.replace(NOTHING, collision="smooth")
    found = assembled(x, "sheet", terms, frame=frame, surface=surface).reshape(len(x), 3, len(x), 3)
    right = np.asarray(hessian(x, garment("sheet")[0], material(), frame, terms, surface)).reshape(found.shape)
    for matrix in (found, right):
        assert not matrix.transpose(0, 2, 1, 3)[~np.eye(len(x), dtype=bool)].any()
    blocks = np.einsum("vivj->vij", found)
    outward = np.asarray(x) / np.linalg.norm(x, axis=1, keepdims=True)
    along = np.einsum("vi,vij,vj->v", outward, blocks, outward)
    assert np.linalg.eigvalsh(blocks).min() > -1e-9
    deep = np.linalg.norm(x, axis=1) < 0.052
    assert deep.sum() > 3
    np.testing.assert_allclose(along[deep], np.einsum("vi,vivj,vj->v", outward, right, outward)[deep], rtol=0.15)


def test_pinning_is_the_hessian():
    x, frame, _ = on_a_ball()
    terms = dataclasses.replace(NOTHING, pinning=True)
    right = np.asarray(hessian(x, garment("sheet")[0], material(), frame, terms))
    np.testing.assert_allclose(assembled(x, "sheet", terms, frame=frame), right, rtol=0, atol=1e-9 * np.abs(right).max())
    still = np.asarray(skin(frame.vertex_transforms, garment("sheet")[0].mesh.rest))
    assert np.abs(still - np.asarray(x)).max() > 0.01 and np.abs(right).max() > 1000


def test_places_of_a_garment_of_many_vertices():
    """Their numbers' products do not fit 32 bits."""
    mesh = mesh_from(*sheet(220, 220, 0.01))
    couplings = couplings_from(mesh)
    pairs, ends = np.asarray(couplings.pairs), ((0, 1), (1, 2), (2, 0))
    for found, right in [
        (couplings.edge_pairs, mesh.edges),
        *((couplings.face_pairs[i], mesh.faces[:, np.asarray(p)]) for i, p in enumerate(ends)),
    ]:
        np.testing.assert_array_equal(pairs[np.asarray(found)], np.sort(right, axis=1))


# --- which terms there are ----------------------------------------------------------------------------------------------

ALL = Terms(collision="plane", pinning=True)
OFF = {"membrane": None, "bending": False, "collision": None, "pinning": False}
READS = {"membrane": "membrane", "bending": "bending", "collision": "collision", "pinning": "pinning"}


def read(terms):
    """The numbers of the material that the matrix is made of."""
    x, frame, surface = on_a_ball()
    cloth, couplings = garment("sheet")
    numbers = material(terms.membrane)
    names = [f.name for f in dataclasses.fields(numbers) for _ in jax.tree.leaves(getattr(numbers, f.name))]

    def made(n):
        contact = None if terms.collision is None else evaluate_contact(x, frame, surface, n, terms).blocks
        return stiffness(x, couplings, cloth, n, frame, terms, contact)

    traced = jax.make_jaxpr(made)(numbers).jaxpr
    used = {id(v) for equation in traced.eqns for v in equation.invars}
    return {name for name, v in zip(names, traced.invars, strict=True) if id(v) in used}


@pytest.mark.parametrize("off", [(), *((n,) for n in OFF), tuple(OFF)])
def test_a_term_that_is_off_is_not_traced(off):
    terms = dataclasses.replace(ALL, **{n: OFF[n] for n in off})
    expected = {READS[n] for n in OFF if n not in off} | ({"thickness"} if "collision" not in off else set())
    assert read(terms) == expected


def test_terms_add_up_and_nothing_is_nothing():
    x, frame, surface = on_a_ball()
    alone = [{"membrane": "stvk"}, {"bending": True}, {"collision": "plane"}, {"pinning": True}]
    each = [dataclasses.replace(NOTHING, **change) for change in alone]
    parts = [assembled(x, "sheet", terms, numbers=material(), frame=frame, surface=surface) for terms in each]
    assert all(np.abs(p).max() > 0 for p in parts)
    whole = assembled(x, "sheet", ALL, numbers=material(), frame=frame, surface=surface)
    np.testing.assert_allclose(whole, sum(parts), rtol=0, atol=1e-11 * np.abs(whole).max())
    # gravity is linear, and inertia is not in this matrix; a frame brings only what is asked for
    nothing = dataclasses.replace(NOTHING, gravity=True, inertia=True)
    assert not assembled(x, "sheet", nothing, numbers=material(), frame=StepInputs()).any()

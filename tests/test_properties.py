"""What holds of any mesh, rotation, motion and material inside the published range. `make thorough` draws 10,000 of each."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from ncs_jax.energies.contact.pairs import groups_from, nearby_pairs
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.energies.terms import Garment, Material, StepInputs, Terms
from ncs_jax.energies.total import energy_terms
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.geometry.rotations import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_axis_angle
from ncs_jax.geometry.skinning import skin, unpose
from ncs_jax.network.encoders import DynamicEncoder, LinearEncoder
from ncs_jax.scene.descriptors import DESCRIPTORS, Joints, dynamic, static
from tests.conftest import THOROUGH
from tests.shapes import ball, sheet, tube

drawn = settings(
    max_examples=10_000 if THOROUGH else 60, deadline=None, derandomize=not THOROUGH, database=None,
    suppress_health_check=[check for check in HealthCheck if check != HealthCheck.filter_too_much],  # few cases are rejected
)  # fmt: skip
seeds = st.integers(0, 2**32 - 1)
ALONE = Terms(None, bending=False, collision=None, gravity=False, inertia=False)
TERMS = {
    **{name: replace(ALONE, membrane=name) for name in ("stvk", "neo_hookean", "baraff_witkin", "mass_spring")},
    "bending": replace(ALONE, bending=True),
    "plane": replace(ALONE, collision="plane"),
    "smooth": replace(ALONE, collision="smooth"),
    "triangle": replace(ALONE, collision="triangle"),
    "friction": replace(ALONE, friction=True),
    "inertia": replace(ALONE, inertia=True, gravity=True),
    "pinning": replace(ALONE, pinning=True),
    "self_contact": replace(ALONE, self_contact=True),
}
FLAWS = ("none", "flat", "one point", "coincident", "no area", "needle", "inside out", "folded", "stretched", "compressed")


def flawed(x: np.ndarray, faces: np.ndarray, flaw: str, rng: np.random.Generator) -> np.ndarray:
    """Positions with something wrong with one face, or with all."""
    x = x.copy()
    a, b, c = faces[rng.integers(len(faces))]
    if flaw == "flat":
        x[:, 2] = 0
    elif flaw == "one point":
        x[:] = x[0]
    elif flaw == "coincident":
        x[c] = x[a]
    elif flaw in ("no area", "needle", "inside out"):
        middle = (x[a] + x[b]) / 2
        x[c] = middle + {"no area": 0.0, "needle": 1e-5, "inside out": -1.0}[flaw] * (x[c] - middle)
    elif flaw == "folded":
        x[:, 1] = np.abs(x[:, 1] - x[len(x) // 2, 1])
    elif flaw in ("stretched", "compressed"):
        x *= 100 if flaw == "stretched" else 0.01
    return x


def material(numbers, names, dtype=np.float32, **values) -> Material:
    base = {
        "density": 0.15, "bending": 1e-5, "collision": 10.0, "thickness": 0.004, "friction": 0.5, "pinning": 1000.0,
        "self_contact": 1.0, "self_thickness": 0.003,
    }  # fmt: skip
    found = {k: jnp.asarray(v, dtype) for k, v in (base | values).items()}
    return Material(membrane=tuple(jnp.asarray(n, dtype) for n in numbers), gravity=jnp.asarray([0, -9.81, 0], dtype), **found)


NUMBERS = {"stvk": (41.8, 22.2), "neo_hookean": (41.8, 22.2), "baraff_witkin": (40.0, 20.0), "mass_spring": (60.0,)}
BODY = ball(1, 0.1)


def cloth(rolled: bool):
    """A sheet, perhaps rolled up to a tube that is not quite closed: of one topology, so that both run one program."""
    x, faces = sheet(4, 6, 0.05)
    angle = x[:, 0] / 0.05
    return np.stack([0.05 * np.sin(angle), x[:, 1], 0.05 * np.cos(angle)], axis=1) if rolled else x, faces


@functools.partial(jax.jit, static_argnums=0)
def derivatives(terms, x, along, garment, numbers, frame, surface):
    def value(x):
        return sum(energy_terms(x, garment, numbers, frame, terms, surface).values())

    (found, slope), (_, second) = jax.jvp(jax.value_and_grad(value), (x,), (along,))
    return found, slope, second


@pytest.mark.parametrize("term", TERMS)
@drawn
@given(
    seed=seeds, size=st.floats(-2, 2), stiffness=st.floats(-3, 4), density=st.floats(-2, 1), rate=st.floats(5, 240),
    now=st.sampled_from(FLAWS), rest=st.sampled_from(FLAWS[:6]), round_=st.booleans(),
)  # fmt: skip
@example(seed=1, size=1.0, stiffness=1.0, density=0.0, rate=5.0, now="stretched", rest="no area", round_=True)  # overflowed
def test_energy_and_two_derivatives_are_finite(term, seed, size, stiffness, density, rate, now, rest, round_):
    rng, terms = np.random.default_rng(seed), TERMS[term]
    vertices, faces = cloth(round_)
    scale = 10**size
    before = flawed(vertices, faces, rest, rng) * scale
    x = flawed(vertices + 0.01 * rng.standard_normal(vertices.shape), faces, now, rng) * scale
    if terms.collision is not None:  # somewhere near the body, some of it at a vertex, on an edge, in a face of it
        scale, x = 1.0, BODY[0][rng.integers(len(BODY[0]), size=len(x))] * rng.choice([0, 0.5, 1.0, 1.02, 3.0], (len(x), 1))
        corners = BODY[0][BODY[1][rng.integers(len(BODY[1]), size=len(x))]]
        x = np.where(rng.random((len(x), 1)) < 0.5, x, corners[:, : rng.integers(2, 4)].mean(axis=1))
    single = functools.partial(jnp.asarray, dtype=jnp.float32)
    mesh = mesh_from(before.astype(np.float32), faces, dtype=jnp.float32)
    factor = 10**stiffness
    names = {n: factor * v for n, v in {"bending": 1e-5, "collision": 10, "pinning": 1000, "self_contact": 1}.items()}
    numbers = material([factor * n for n in NUMBERS.get(term, ())], (), density=10**density, **names)
    groups = groups_from(mesh) if terms.self_contact else None
    garment = Garment(mesh, jnp.arange(3, dtype=jnp.int32), groups)
    blended = np.tile(np.eye(3, 4), (len(x), 1, 1))
    pressed = rng.standard_normal(x.shape) * rng.integers(0, 2, (len(x), 1))
    other = x + 0.01 * scale * rng.standard_normal(x.shape) * rng.integers(0, 2)
    frame = StepInputs(
        single(1 / rate), single(other), single(x), single(BODY[0]), single(blended), single(other), single(pressed)
    )
    on = surface_of(terms.collision)
    values = derivatives(terms, single(x), single(rng.standard_normal(x.shape)), garment, numbers, frame, on)
    if term == "self_contact":  # more pairs near each other than the lists hold: said, by a value that is no number
        full = crowded(single(x), mesh, groups, numbers.self_thickness)
        assert np.isnan(values[0]) == full
        assume(not full)
    assert all(np.all(np.isfinite(v)) for v in values)


@jax.jit
def crowded(x, mesh, groups, radius):
    return nearby_pairs(x, mesh, groups, radius).overflow


@functools.cache
def surface_of(kind):
    if kind is None:
        return None
    return surface_from(sheet(4, 6, 0.05)[0], *BODY, smooth=kind == "smooth")


@functools.partial(jax.jit, static_argnums=0)
def slopes(terms, x, garment, numbers):
    return jax.value_and_grad(lambda x: sum(energy_terms(x, garment, numbers, StepInputs(1 / 30), terms).values()))(x)


@pytest.mark.parametrize("term", ["stvk", "neo_hookean", "baraff_witkin", "mass_spring", "bending"])
@drawn
@given(seed=seeds, size=st.floats(-2, 2), way=st.floats(-1000, 1000))
def test_elastic_energy_feels_no_rigid_motion_and_no_net_force(term, seed, size, way):
    rng = np.random.default_rng(seed)
    vertices, faces = tube(6, 4, 0.09, 0.2)
    scale = 10**size
    mesh = mesh_from(vertices * scale, faces, dtype=jnp.float64)
    x = (vertices + 0.01 * rng.standard_normal(vertices.shape)) * scale
    turn = np.asarray(axis_angle_to_matrix(jnp.asarray(rng.standard_normal(3) * 3)))
    garment, numbers = Garment(mesh, jnp.arange(1, dtype=jnp.int32)), material(NUMBERS.get(term, ()), (), np.float64)
    value, slope = slopes(TERMS[term], jnp.asarray(x), garment, numbers)
    moved, turned = slopes(TERMS[term], jnp.asarray(x @ turn.T + way), garment, numbers)
    lost = 1e-13 * (abs(way) / scale + 1)  # of every strain, to the rounding of positions
    force = np.abs(np.asarray(slope)).sum()
    assert abs(moved - value) <= 1e-9 * value + 100 * lost * force * scale
    assert np.abs(np.asarray(slope).sum(axis=0)).max() <= 1e-10 * force
    assert np.abs(np.cross(x, np.asarray(slope)).sum(axis=0)).max() <= 1e-9 * force * scale
    np.testing.assert_allclose(turned, np.asarray(slope) @ turn.T, rtol=0, atol=1e-9 * force + 1e4 * lost * force)


@drawn
@given(seed=seeds, size=st.floats(-12, 3))
def test_any_vector_is_a_rotation_and_comes_back(seed, size):
    vector = jnp.asarray(np.random.default_rng(seed).standard_normal((8, 3)) * 10**size)
    matrix = rotated(vector)
    np.testing.assert_allclose(matrix @ jnp.swapaxes(matrix, -1, -2), np.tile(np.eye(3), (8, 1, 1)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrix), 1, atol=1e-12)
    np.testing.assert_allclose(again(matrix), matrix, rtol=0, atol=1e-7)


rotated = jax.jit(axis_angle_to_matrix)
again = jax.jit(lambda m: axis_angle_to_matrix(quaternion_to_axis_angle(matrix_to_quaternion(m))))


@pytest.mark.parametrize("kind", DESCRIPTORS)
@drawn
@given(seed=seeds, turn=st.floats(0, 10), jump=st.floats(-6, 4), still=st.booleans())
def test_descriptors_are_finite_and_rest_is_zero(kind, seed, turn, jump, still):
    rng = np.random.default_rng(seed)

    def joints():
        turns = [jnp.asarray(np.asarray(rotated(jnp.asarray(turn * rng.standard_normal((3, 3))))), jnp.float32) for _ in "ab"]
        return Joints(*turns, jnp.asarray(10**jump * rng.standard_normal((3, 3)), jnp.float32))

    three = [joints()] * 3 if still else [joints() for _ in range(3)]
    fixed, moving = described(kind, *three)
    assert np.all(np.isfinite(fixed)) and np.all(np.isfinite(moving))
    if still:
        assert not np.any(moving)


@functools.partial(jax.jit, static_argnums=0)
def described(kind, now, previous, before):
    g = jnp.asarray([0, -9.81, 0], jnp.float32)
    return static(now, g, kind), dynamic(now, previous, before, g, jnp.float32(1 / 30), kind)


@pytest.mark.parametrize("cell", [DynamicEncoder, LinearEncoder])
@drawn
@given(seed=seeds, weights=st.floats(0, 30), inputs=st.floats(-3, 4))
def test_a_recurrent_state_stays_within_its_bound(cell, seed, weights, inputs):
    encoder = cell((4,), (8,), 6)
    rng = np.random.default_rng(seed)
    descriptors = jnp.asarray(10**inputs * rng.standard_normal((40, 2, 5)), jnp.float32)
    params = jax.tree.map(lambda p: p * jnp.float32(weights), begun(encoder))
    states, features = followed(encoder, params, descriptors)
    assert np.all(np.isfinite(states))
    if cell is DynamicEncoder:
        assert np.abs(states).max() <= 1
    else:  # a sum of what was read, each weighed by less than one
        assert np.abs(states).max() <= 2 * np.abs(np.asarray(features, np.float64)).sum(axis=0).max() + 1e-6


@functools.cache
def begun(encoder):
    return encoder.init(jax.random.PRNGKey(0), jnp.zeros((1, 2, 5), jnp.float32), jnp.zeros(6, jnp.float32))


@functools.partial(jax.jit, static_argnums=0)
def followed(encoder, params, descriptors):
    features = encoder.apply(params, descriptors, method="features")
    return encoder.apply(params, features, jnp.zeros(6, jnp.float32), method="states"), features


@drawn
@given(seed=seeds, away=st.floats(-3, 3))
def test_unposing_undoes_skinning(seed, away):
    rng = np.random.default_rng(seed)
    turns = np.asarray(rotated(jnp.asarray(rng.standard_normal((8, 3)) * 3)))
    blended = jnp.asarray(np.concatenate([turns, 10**away * rng.standard_normal((8, 3, 1))], axis=-1))
    x = jnp.asarray(rng.standard_normal((8, 3)))
    np.testing.assert_allclose(unpose(blended, skin(blended, x)), x, rtol=0, atol=1e-11 * (1 + 10**away))

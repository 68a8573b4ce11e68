"""The total energy: what is off is not traced, what is past is constant, and material, time step and gravity are operands."""

from __future__ import annotations

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.energies.elements import elastic
from ncs_jax.energies.terms import MEMBRANES, Garment, StepInputs, Terms
from ncs_jax.energies.total import distances, energies, total
from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import mesh_from
from ncs_jax.geometry.skinning import unpose

from .materials import DOWN, material
from .shapes import ball, rotation, sheet

ALL = Terms(collision="plane", pinning=True, self_contact=True)
NAMES = ("membrane", "bending", "collision", "gravity", "inertia", "pinning", "self_contact")
OFF = {"membrane": None, "bending": False, "collision": None, "gravity": False, "inertia": False, "pinning": False}
OFF["self_contact"] = False
DT = 0.02


@cache
def situation():
    """A crumpled sheet that moves, two of its corners pinned, partly inside a ball."""
    rng = np.random.default_rng(11)
    rest, faces = sheet(5, 6, 0.01)
    rest = rest + np.array([-0.025, -0.02, 0.046])
    body, triangles = ball(2, 0.05)
    x = rest + 1e-3 * rng.normal(size=rest.shape)
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    garment = Garment(mesh, jnp.array([0, 5], jnp.int32), groups_from(mesh))
    turn = np.concatenate([rotation([1, 2, 3], 0.2), [[0.01], [0.0], [0.02]]], axis=1)
    frame = StepInputs(
        dt=DT,
        previous=jnp.asarray(x + 3e-4 * rng.normal(size=x.shape)),
        before=jnp.asarray(x + 3e-4 * rng.normal(size=x.shape)),
        body=jnp.asarray(body),
        vertex_transforms=jnp.broadcast_to(jnp.asarray(turn), (len(x), 3, 4)),
    )
    return jnp.asarray(x), garment, frame, surface_from(rest, body, triangles)


def everything(x, numbers, frame, surface):
    """The total, its parts, and its derivative by all that may be differentiated: compiled once for all the tests."""
    garment = situation()[1]

    def value(x, numbers, dt, previous, before):
        at = dataclasses.replace(frame, dt=dt, previous=previous, before=before)
        return total(x, garment, numbers, at, ALL, surface), energies(x, garment, numbers, at, ALL, surface)

    names = ("x", "material", "dt", "previous", "before")
    (whole, parts), slopes = jax.value_and_grad(value, argnums=(0, 1, 2, 3, 4), has_aux=True)(
        x, numbers, frame.dt, frame.previous, frame.before
    )
    return whole, parts, dict(zip(names, slopes, strict=True))


compiled = jax.jit(everything)


def inertia_force(x, frame):
    garment, terms = situation()[1], dataclasses.replace(ALL, **{**OFF, "inertia": True})
    return jax.jit(jax.grad(lambda x, f: total(x, garment, material(), f, terms)))(x, frame)


def scopes(jaxpr) -> set[str]:
    """The named scopes of a program, those of its inner programs included."""
    found: set[str] = set()
    for equation in jaxpr.eqns:
        found |= set(str(equation.source_info.name_stack).replace("(", "/").replace(")", "/").split("/"))
        for value in equation.params.values():
            for inner in value if isinstance(value, list | tuple) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    found |= scopes(inner)
    return found & set(NAMES)


def traced(terms, x, garment, numbers, frame, surface, differentiate=False):
    f = lambda x, g, m, f, s: total(x, g, m, f, terms, s)  # noqa: E731
    return jax.make_jaxpr(jax.grad(f) if differentiate else f)(x, garment, numbers, frame, surface).jaxpr


# --- which terms there are ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("differentiate", [False, True])
@pytest.mark.parametrize("off", [(), *((n,) for n in NAMES), NAMES[1:], NAMES])
def test_a_term_that_is_off_is_not_traced(off, differentiate):
    x, garment, frame, surface = situation()
    terms = dataclasses.replace(ALL, **{n: OFF[n] for n in off})
    seen = scopes(traced(terms, x, garment, material(), frame, surface, differentiate))
    assert seen == set(NAMES) - set(off)
    parts = jax.eval_shape(lambda *a: energies(*a, terms, surface), x, garment, material(), frame)
    assert set(parts) == seen


@pytest.mark.parametrize(
    ("off", "lacking"),
    [
        (("inertia",), {"previous": None, "before": None}),
        (("collision",), {"body": None}),
        (("pinning",), {"vertex_transforms": None}),
        (("inertia", "collision", "pinning"), {"previous": None, "before": None, "body": None, "vertex_transforms": None}),
    ],
)
def test_a_frame_brings_only_what_is_asked_for(off, lacking):
    """And the terms that stay keep their values."""
    x, garment, frame, surface = situation()
    terms = dataclasses.replace(ALL, **{n: OFF[n] for n in off})
    bare = dataclasses.replace(frame, **lacking)
    surface_or_none = None if "collision" in off else surface
    got = jax.jit(lambda x, f: energies(x, garment, material(), f, terms, surface_or_none))(x, bare)
    whole = compiled(x, material(), frame, surface)[1]
    assert set(got) == set(NAMES) - set(off)
    for name, value in got.items():
        np.testing.assert_allclose(value, whole[name], rtol=1e-13)


@pytest.mark.parametrize(
    ("term", "field"),
    [
        ("inertia", "step.previous"),
        ("collision", "step.body"),
        ("friction", "step.advected"),
        ("pinning", "step.vertex_transforms"),
        ("self_contact", "garment.groups"),
    ],
)
def test_what_a_term_lacks_is_named(term, field):
    x, garment, _, surface = situation()
    alone = dataclasses.replace(ALL, **{**OFF, term: "plane" if term == "collision" else True})
    bare = dataclasses.replace(garment, groups=None)
    with pytest.raises(InputError, match=f"^{field}: missing"):
        energies(x, bare, material(), StepInputs(), alone, surface)
    if term == "collision":
        with pytest.raises(InputError, match=r"^surface: missing"):
            energies(x, garment, material(), StepInputs(body=x), alone)


def test_too_many_pairs_are_no_number():
    """Crushed into one point, everything is near everything: more than the lists hold, and not an energy without the rest."""
    rest, faces = sheet(9, 9, 0.01)
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    garment = Garment(mesh, jnp.zeros(0, jnp.int32), groups_from(mesh))
    terms = dataclasses.replace(ALL, **{**OFF, "self_contact": True})
    value = jax.jit(lambda x: total(x, garment, material(), StepInputs(), terms))
    assert value(0.8 * mesh.rest) > 0
    assert jnp.isnan(value(0.001 * mesh.rest))


def test_the_total_is_the_sum():
    x, garment, frame, surface = situation()
    whole, parts, _ = compiled(x, material(), frame, surface)
    assert set(parts) == set(NAMES) and all(float(abs(p)) > 0 for p in parts.values())
    np.testing.assert_allclose(whole, sum(float(p) for p in parts.values()), rtol=1e-13)
    nothing = dataclasses.replace(ALL, **OFF)
    assert total(x, garment, material(None), frame, nothing) == 0


def test_the_force_is_the_negative_gradient_of_the_total(rng):
    x, _, frame, surface = situation()
    f = lambda x: compiled(x, material(), frame, surface)[0]  # noqa: E731
    gradient = compiled(x, material(), frame, surface)[2]["x"]
    assert jnp.all(jnp.isfinite(gradient))
    for _ in range(3):
        v = jnp.asarray(rng.normal(size=x.shape))
        h = 1e-7  # m: no vertex changes its nearest feature on the way
        difference = (8 * (f(x + h * v) - f(x - h * v)) - (f(x + 2 * h * v) - f(x - 2 * h * v))) / (12 * h)
        np.testing.assert_allclose(jnp.vdot(gradient, v), difference, rtol=1e-6)


@pytest.mark.parametrize("model", MEMBRANES)
def test_every_membrane_reads_its_own_numbers_in_order(model):
    """The energy is linear in each of them, and its derivative by it is the energy at one with the others at zero."""
    x, garment, frame, _ = situation()
    terms = dataclasses.replace(ALL, **{**OFF, "membrane": model})
    numbers = material(model)

    def value(*membrane):
        return total(x, garment, dataclasses.replace(numbers, membrane=membrane), frame, terms)

    law, names = MEMBRANES[model]
    slopes = jax.jit(jax.grad(value, argnums=tuple(range(len(names)))))(*numbers.membrane)
    for name, slope in zip(names, slopes, strict=True):
        alone = jax.jit(law)(x, garment.mesh, **{n: float(n == name) for n in names})
        np.testing.assert_allclose(slope, alone, rtol=1e-9)
        assert alone > 0


@pytest.mark.parametrize("model", [*MEMBRANES, None])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_elements_differentiated_by_themselves_are_the_gradient_of_the_whole(model, dtype, rng):
    """Of several poses beside each other, against automatic differentiation of each by itself."""
    x, garment, numbers = jax.tree.map(
        lambda a: a.astype(dtype) if a.dtype == jnp.float64 else a, (*situation()[:2], material(model or "stvk"))
    )
    terms = dataclasses.replace(ALL, **{**OFF, "membrane": model, "bending": True})
    poses = x[..., None] + 1e-3 * jnp.asarray(rng.normal(size=(*x.shape, 3)), dtype)
    parts, gradient = jax.jit(lambda x: elastic(x, garment, numbers, terms))(poses)
    alone = jax.jit(jax.value_and_grad(lambda x: sum(energies(x, garment, numbers, StepInputs(), terms).values())))
    for i in range(3):
        value, slope = alone(poses[..., i])
        eps = jnp.finfo(dtype).eps
        np.testing.assert_allclose(sum(parts.values())[i], value, rtol=50 * eps)
        np.testing.assert_allclose(gradient[..., i], slope, atol=100 * eps * float(jnp.abs(slope).max()))
    assert gradient.dtype == dtype and set(parts) == {"bending"} | ({"membrane"} if model else set())
    assert all(part.dtype == dtype for part in parts.values())


def test_the_scene_chooses_the_distance():
    """To a ball both are near the distance to the sphere, one by the tangent planes of its corners, one by its faces."""
    x, _, frame, surface = situation()
    sphere = jnp.linalg.norm(x, axis=1) - 0.05
    plane, triangle = (
        jax.jit(lambda x, name=name: distances(x, frame.body, surface, Terms(collision=name)))(x)
        for name in ("plane", "triangle")
    )
    assert jnp.min(sphere) < -1e-3 and jnp.max(sphere) > 1e-3
    # a flat face of 16 mm lies up to 0.9 mm inside the sphere, a tangent plane up to as much outside
    assert jnp.all((triangle > sphere - 1e-12) & (triangle < sphere + 1e-3))
    assert jnp.all((plane < sphere + 1e-12) & (plane > sphere - 1e-3))
    assert jnp.max(triangle - plane) > 5e-4


# --- the one stop in time -----------------------------------------------------------------------------------------------


def test_the_past_has_no_gradient():
    x, _, frame, surface = situation()
    whole, _, slopes = compiled(x, material(), frame, surface)
    np.testing.assert_array_equal(slopes["previous"], 0)
    np.testing.assert_array_equal(slopes["before"], 0)
    assert jnp.all(jnp.any(slopes["x"] != 0, axis=1))
    # though the past has its say in the value
    for name in ("previous", "before"):
        other = dataclasses.replace(frame, **{name: getattr(frame, name) + 1e-3})
        assert abs(compiled(x, material(), other, surface)[0] - whole) > 1e-9


def test_only_the_last_frame_of_a_trajectory_is_pulled():
    """With x_t, x_{t-1} and x_{t-2} from the same parameters: the derivative is that of x_t alone. Without the stop, three."""
    x, garment, _, _ = situation()
    terms = dataclasses.replace(ALL, **{**OFF, "inertia": True})

    def value(shared, held):
        xs = [x + w * jnp.where(held[k], jax.lax.stop_gradient(shared), shared) for k, w in enumerate((1.0, 2.0, -3.0))]
        return total(xs[0], garment, material(), StepInputs(DT, xs[1], xs[2]), terms)

    shared = jnp.asarray(np.random.default_rng(2).normal(size=x.shape)) * 1e-3
    slope = jax.jit(jax.grad(value))
    whole, last_alone = slope(shared, jnp.zeros(3, bool)), slope(shared, jnp.array([False, True, True]))
    np.testing.assert_array_equal(whole, last_alone)
    acceleration = (1.0 - 2 * 2.0 - 3.0) * shared / DT**2
    mass = 0.15 * garment.mesh.vertex_area
    np.testing.assert_allclose(whole, mass[:, None] * acceleration, rtol=1e-9)


@pytest.mark.parametrize("dt", [1 / 15, 1 / 30, 1e-3])
def test_inertia_pulls_with_mass_times_acceleration(dt):
    x, garment, frame, _ = situation()
    mass = np.asarray(material().density * garment.mesh.vertex_area)
    acceleration = np.asarray(x - 2 * frame.previous + frame.before) / dt**2
    force = inertia_force(x, dataclasses.replace(frame, dt=dt))
    np.testing.assert_allclose(force, mass[:, None] * acceleration, rtol=1e-9)


def test_at_a_minimum_forces_balance_mass_times_acceleration():
    """Where all other energies' forces F lead, x = 2 x_{t-1} - x_{t-2} + dt^2 F / m: there is the gradient zero."""
    x, garment, frame, surface = situation()
    force = inertia_force(x, frame) - compiled(x, material(), frame, surface)[2]["x"]
    mass = material().density * garment.mesh.vertex_area
    previous = x + 1e-3  # a past from which those forces lead to x
    before = 2 * previous - x + DT**2 * force / mass[:, None]
    at = dataclasses.replace(frame, previous=previous, before=before)
    gradient = compiled(x, material(), at, surface)[2]["x"]
    assert jnp.max(jnp.abs(force)) > 1e-3
    np.testing.assert_allclose(gradient, 0, atol=1e-11 * float(jnp.max(jnp.abs(force))))


# --- operands -----------------------------------------------------------------------------------------------------------


def test_material_and_time_step_are_batched():
    x, garment, frame, surface = situation()
    leaves, tree = jax.tree.flatten(material())
    factors, dts = jnp.array([0.5, 1.0, 2.0]), jnp.array([0.01, 0.02, 0.05])
    batch = [jnp.stack([a * f for f in factors]) for a in leaves]

    def parts(leaves, dt):
        at = dataclasses.replace(frame, dt=dt)
        return energies(x, garment, jax.tree.unflatten(tree, leaves), at, ALL, surface)

    together = jax.jit(jax.vmap(parts))(batch, dts)
    for i in range(3):
        one = jax.tree.unflatten(tree, [a[i] for a in batch])
        alone = compiled(x, one, dataclasses.replace(frame, dt=float(dts[i])), surface)[1]
        for name in NAMES:
            np.testing.assert_allclose(together[name][i], alone[name], rtol=1e-12)
    # a scale of the material scales each energy as its formula says, and the time step the inertia alone
    np.testing.assert_allclose(together["membrane"] / together["membrane"][1], factors, rtol=1e-12)
    np.testing.assert_allclose(together["gravity"] / together["gravity"][1], factors**2, rtol=1e-12)  # density and g
    np.testing.assert_allclose(together["inertia"] / together["inertia"][1], factors * (DT / dts) ** 2, rtol=1e-12)


def test_material_and_time_step_are_differentiated():
    """Every energy is a product of its stiffness, so each derivative is an energy divided by a number."""
    x, _, frame, surface = situation()
    one = material()
    _, parts, slopes = compiled(x, one, frame, surface)
    np.testing.assert_allclose(slopes["dt"], -2 * parts["inertia"] / DT, rtol=1e-12)
    by = slopes["material"]
    np.testing.assert_allclose(by.density, (parts["gravity"] + parts["inertia"]) / one.density, rtol=1e-12)
    for name in ("bending", "collision", "pinning", "self_contact"):
        np.testing.assert_allclose(getattr(by, name), parts[name] / getattr(one, name), rtol=1e-12)
    lam, mu = by.membrane
    np.testing.assert_allclose(lam * one.membrane[0] + mu * one.membrane[1], parts["membrane"], rtol=1e-12)
    assert by.thickness > 0 and by.self_thickness > 0
    np.testing.assert_allclose(jnp.vdot(by.gravity, one.gravity), parts["gravity"], rtol=1e-12)


@pytest.mark.parametrize("gravity", [(0.0, -9.81, 0.0), (9.81, 0.0, 0.0), (1.0, 2.0, -3.0), (0.0, 0.0, 0.0)])
def test_gravity_in_any_direction(gravity):
    x, garment, frame, _ = situation()
    terms = dataclasses.replace(ALL, **{**OFF, "gravity": True})
    pull = -jax.jit(jax.grad(lambda x: total(x, garment, material(gravity=gravity), frame, terms)))(x)
    np.testing.assert_allclose(jnp.sum(pull, axis=0), 0.15 * 0.04 * 0.05 * np.array(gravity), rtol=1e-12)


def test_the_world_may_be_turned():
    """Cloth, body and gravity turned together cost what they cost before; the forces turn with them."""
    x, _, frame, surface = situation()
    turn = rotation([1, 1, -2], 1.9)
    move = lambda a: a @ turn.T  # noqa: E731
    blended = jnp.einsum("ab,vbc->vac", turn, frame.vertex_transforms)
    there = StepInputs(frame.dt, move(frame.previous), move(frame.before), move(frame.body), blended)
    here, _, pull = compiled(x, material(), frame, surface)
    other, _, turned_pull = compiled(move(x), material(gravity=turn @ DOWN), there, surface)
    np.testing.assert_allclose(other, here, rtol=1e-11)
    scale = float(jnp.max(jnp.abs(pull["x"])))
    np.testing.assert_allclose(turned_pull["x"], move(pull["x"]), rtol=0, atol=1e-11 * scale)


def test_pins_hold_where_skinning_puts_them():
    x, garment, frame, _ = situation()
    terms = dataclasses.replace(ALL, **{**OFF, "pinning": True})
    value = jax.jit(lambda x: total(x, garment, material(), frame, terms))
    posed = jnp.sum(frame.vertex_transforms[..., :3] * garment.mesh.rest[:, None], axis=-1) + frame.vertex_transforms[..., 3]
    assert value(posed) < 1e-25
    free = jnp.ones(len(x), bool).at[garment.pins].set(False)
    np.testing.assert_array_equal(value(jnp.where(free[:, None], posed + 1.0, posed)), value(posed))
    apart = unpose(frame.vertex_transforms, x)[garment.pins] - garment.mesh.rest[garment.pins]
    np.testing.assert_allclose(value(x), 1000 * jnp.sum(apart**2), rtol=1e-12)


def test_the_type_of_the_operands_is_kept(plain_jax):
    rest, faces = sheet(3, 3, 0.01)
    garment = Garment(mesh_from(rest, faces), jnp.array([0], jnp.int32))
    x = jnp.asarray(rest * 1.1, jnp.float32)
    blended = jnp.broadcast_to(jnp.eye(3, 4), (9, 3, 4))
    terms = Terms(collision=None, pinning=True)
    value = total(
        x, garment, jax.tree.map(lambda a: a.astype(jnp.float32), material()), StepInputs(DT, x, x, None, blended), terms
    )
    assert value.dtype == jnp.float32 and jnp.isfinite(value)

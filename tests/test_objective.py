"""The total energy: what is off is not traced, what is past is constant, and material, time step and gravity are operands."""

from __future__ import annotations

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.pairs import groups_from
from ncs_jax.energies.contact.surface import surface_from
from ncs_jax.energies.elements import elastic
from ncs_jax.energies.terms import MEMBRANES, Garment, StepInputs, Terms
from ncs_jax.energies.total import distances, energy_terms, total
from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import mesh_from

from .materials import DOWN, material
from .shapes import ball, rotation, sheet

# Of so small a body every vertex is a candidate of the search, and none is left to be searched for once more.
ALL = Terms(collision="plane", exact=False, pinning=True, self_contact=True)
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


@jax.jit
def compiled(x, numbers, frame, surface):
    """The sum of the energies, each of them, and its derivative by all that may be differentiated: once for all the tests."""
    garment = situation()[1]

    def value(x, numbers, dt, previous, before):
        at = dataclasses.replace(frame, dt=dt, previous=previous, before=before)
        parts = energy_terms(x, garment, numbers, at, ALL, surface)
        return sum(parts.values()), parts

    names = ("x", "material", "dt", "previous", "before")
    (whole, parts), slopes = jax.value_and_grad(value, argnums=(0, 1, 2, 3, 4), has_aux=True)(
        x, numbers, frame.dt, frame.previous, frame.before
    )
    return whole, parts, dict(zip(names, slopes, strict=True))


@partial(jax.jit, static_argnums=0)
def slope_of(terms, x, numbers, frame):
    """Of the total by x."""
    return jax.grad(lambda x: total(x, situation()[1], numbers, frame, terms))(x)


def inertia_force(x, frame):
    return np.asarray(slope_of(dataclasses.replace(ALL, **{**OFF, "inertia": True}), x, material(), frame))


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


# --- which terms there are ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("differentiate", [False, True])
@pytest.mark.parametrize("off", [(), *((n,) for n in NAMES), NAMES[1:], NAMES])
def test_a_term_that_is_off_is_not_traced(off, differentiate):
    x, garment, frame, surface = situation()
    terms = dataclasses.replace(ALL, **{n: OFF[n] for n in off})
    on, arguments = set(NAMES) - set(off), (x, garment, material(), frame)
    if differentiate:
        slope = jax.grad(lambda x, *others: total(x, *others, terms, surface))
        assert scopes(jax.make_jaxpr(slope)(*arguments).jaxpr) == on
    else:
        program, parts = jax.make_jaxpr(lambda *a: energy_terms(*a, terms, surface), return_shape=True)(*arguments)
        assert scopes(program.jaxpr) == set(parts) == on


@pytest.mark.parametrize(
    ("off", "lacking"),
    [
        (("inertia", "self_contact"), {"previous": None, "before": None}),
        (("collision",), {"body": None}),
        (("pinning", "self_contact"), {"vertex_transforms": None}),
        (
            ("inertia", "collision", "pinning", "self_contact"),
            {"previous": None, "before": None, "body": None, "vertex_transforms": None},
        ),
    ],
)  # self-contact, which asks for none of it and is slow to compile, stays on once
def test_a_frame_brings_only_what_is_asked_for(off, lacking):
    """And the terms that stay keep their values."""
    x, garment, frame, surface = situation()
    terms = dataclasses.replace(ALL, **{n: OFF[n] for n in off})
    bare = dataclasses.replace(frame, **lacking)
    surface_or_none = None if "collision" in off else surface
    got = jax.jit(lambda x, f: energy_terms(x, garment, material(), f, terms, surface_or_none))(x, bare)
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
        energy_terms(x, bare, material(), StepInputs(), alone, surface)
    if term == "collision":
        with pytest.raises(InputError, match=r"^surface: missing"):
            energy_terms(x, garment, material(), StepInputs(body=x), alone)


def test_too_many_pairs_are_no_number():
    """Crushed into one point, everything is near everything: more than the lists hold, and not an energy without the rest."""
    rest, faces = sheet(9, 9, 0.01)
    mesh = mesh_from(rest, faces, dtype=jnp.float64)
    garment = Garment(mesh, jnp.zeros(0, jnp.int32), groups_from(mesh))
    terms = dataclasses.replace(ALL, **{**OFF, "self_contact": True})
    value = jax.jit(lambda x: total(x, garment, material(), StepInputs(), terms))
    assert value(0.8 * rest) > 0
    assert np.isnan(value(0.001 * rest))


def test_the_total_is_the_sum():
    x, garment, frame, surface = situation()
    parts = compiled(x, material(), frame, surface)[1]
    assert set(parts) == set(NAMES) and all(float(abs(p)) > 0 for p in parts.values())
    some = dataclasses.replace(ALL, collision=None, self_contact=False)
    whole = jax.jit(lambda x, numbers, frame: total(x, garment, numbers, frame, some))(x, material(), frame)
    right = sum(float(part) for name, part in parts.items() if name not in ("collision", "self_contact"))
    np.testing.assert_allclose(whole, right, rtol=1e-13)
    nothing = dataclasses.replace(ALL, **OFF)
    assert total(x, garment, material(None), frame, nothing) == 0


def test_the_force_is_the_negative_gradient_of_the_total(rng):
    x, _, frame, surface = situation()
    x = np.asarray(x)
    f = lambda x: compiled(x, material(), frame, surface)[0]  # noqa: E731
    gradient = np.asarray(compiled(x, material(), frame, surface)[2]["x"])
    assert np.isfinite(gradient).all()
    for _ in range(3):
        v = rng.normal(size=x.shape)
        h = 1e-7  # m: no vertex changes its nearest feature on the way
        difference = (8 * (f(x + h * v) - f(x - h * v)) - (f(x + 2 * h * v) - f(x - 2 * h * v))) / (12 * h)
        np.testing.assert_allclose(np.vdot(gradient, v), difference, rtol=1e-6)


@pytest.mark.parametrize("model", MEMBRANES)
def test_every_membrane_reads_its_own_numbers_in_order(model):
    """The energy is linear in each of them, and its derivative by it is the energy at one with the others at zero."""
    x, garment, frame, _ = situation()
    terms = dataclasses.replace(ALL, **{**OFF, "membrane": model})
    numbers = material(model)

    law, names = MEMBRANES[model]

    @jax.jit
    def both(membrane):
        value = lambda m: total(x, garment, dataclasses.replace(numbers, membrane=m), frame, terms)  # noqa: E731
        apart = [law(x, garment.mesh, **{n: float(n == name) for n in names}) for name in names]
        return jax.grad(value)(membrane), apart

    for slope, alone in zip(*both(numbers.membrane), strict=True):
        np.testing.assert_allclose(slope, alone, rtol=1e-9)
        assert alone > 0


@pytest.mark.parametrize("model", [*MEMBRANES, None])
def test_elements_differentiated_by_themselves_are_the_gradient_of_the_whole(model, rng):
    """Of several poses beside each other, against automatic differentiation of each by itself. In float64: `test_elements`."""
    dtype = jnp.float32
    x, garment, numbers = jax.tree.map(
        lambda a: a.astype(dtype) if a.dtype == jnp.float64 else a, (*situation()[:2], material(model or "stvk"))
    )
    terms = dataclasses.replace(ALL, **{**OFF, "membrane": model, "bending": True})
    poses = jnp.asarray(np.asarray(x)[..., None] + 1e-3 * rng.normal(size=(*x.shape, 3)), dtype)

    @jax.jit
    def both(poses):
        value = lambda x: sum(energy_terms(x, garment, numbers, StepInputs(), terms).values())  # noqa: E731
        return elastic(poses, garment, numbers, terms), jax.lax.map(jax.value_and_grad(value), jnp.moveaxis(poses, -1, 0))

    (parts, gradient), (values, slopes) = jax.device_get(both(poses))
    for i in range(3):
        eps = jnp.finfo(dtype).eps
        np.testing.assert_allclose(sum(parts.values())[i], values[i], rtol=50 * eps)
        np.testing.assert_allclose(gradient[..., i], slopes[i], atol=100 * eps * np.abs(slopes[i]).max())
    assert gradient.dtype == dtype and set(parts) == {"bending"} | ({"membrane"} if model else set())
    assert all(part.dtype == dtype for part in parts.values())


def test_the_scene_chooses_the_distance():
    """To a ball both are near the distance to the sphere, one by the tangent planes of its corners, one by its faces."""
    x, _, frame, surface = situation()
    sphere = np.linalg.norm(x, axis=1) - 0.05
    each = [Terms(collision=name, exact=False) for name in ("plane", "triangle")]
    plane, triangle = jax.device_get(jax.jit(lambda x: [distances(x, frame.body, surface, terms) for terms in each])(x))
    assert sphere.min() < -1e-3 and sphere.max() > 1e-3
    # a flat face of 16 mm lies up to 0.9 mm inside the sphere, a tangent plane up to as much outside
    assert np.all((triangle > sphere - 1e-12) & (triangle < sphere + 1e-3))
    assert np.all((plane < sphere + 1e-12) & (plane > sphere - 1e-3))
    assert np.max(triangle - plane) > 5e-4


# --- the one stop in time -----------------------------------------------------------------------------------------------


def test_the_past_has_no_gradient():
    x, _, frame, surface = situation()
    whole, _, slopes = compiled(x, material(), frame, surface)
    np.testing.assert_array_equal(slopes["previous"], 0)
    np.testing.assert_array_equal(slopes["before"], 0)
    assert np.all(np.any(np.asarray(slopes["x"]) != 0, axis=1))
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
    factors, dts = np.array([0.5, 1.0, 2.0]), np.array([0.01, 0.02, 0.05])
    batch = [np.stack([np.asarray(a) * f for f in factors]) for a in leaves]

    def parts(leaves, dt):
        at = dataclasses.replace(frame, dt=dt)
        return energy_terms(x, garment, jax.tree.unflatten(tree, leaves), at, ALL, surface)

    together = jax.device_get(jax.jit(jax.vmap(parts))(batch, dts))
    for i in range(3):
        one = jax.tree.unflatten(tree, [jnp.asarray(a[i]) for a in batch])
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
    x, _, frame, _ = situation()
    terms = dataclasses.replace(ALL, **{**OFF, "gravity": True})
    pull = -np.asarray(slope_of(terms, x, material(gravity=gravity), frame))
    np.testing.assert_allclose(np.sum(pull, axis=0), 0.15 * 0.04 * 0.05 * np.array(gravity), rtol=1e-12)


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
    transforms, rest, pins = (np.asarray(a) for a in (frame.vertex_transforms, garment.mesh.rest, garment.pins))
    posed = np.einsum("vij,vj->vi", transforms[..., :3], rest) + transforms[..., 3]
    assert value(posed) < 1e-25
    free = np.ones(len(x), bool)
    free[pins] = False
    np.testing.assert_array_equal(value(np.where(free[:, None], posed + 1.0, posed)), value(posed))
    apart = np.linalg.solve(transforms[..., :3], (np.asarray(x) - transforms[..., 3])[..., None])[..., 0] - rest
    np.testing.assert_allclose(value(x), 1000 * np.sum(apart[pins] ** 2), rtol=1e-12)


def test_the_type_of_the_operands_is_kept(plain_jax):
    rest, faces = sheet(3, 3, 0.01)
    garment = Garment(mesh_from(rest, faces), jnp.array([0], jnp.int32))
    x = jnp.asarray(rest * 1.1, jnp.float32)
    blended = jnp.asarray(np.tile(np.eye(3, 4, dtype=np.float32), (9, 1, 1)))
    terms, numbers = Terms(collision=None, pinning=True), jax.tree.map(lambda a: a.astype(jnp.float32), material())
    value = jax.jit(lambda x: total(x, garment, numbers, StepInputs(DT, x, x, None, blended), terms))(x)
    assert value.dtype == jnp.float32 and jnp.isfinite(value)

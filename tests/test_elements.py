"""The fast path of the total energy says what `total` says: values, forces, and derivatives by the vertex transforms."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.elements import energies_and_gradient
from ncs_jax.energies.terms import MEMBRANES, StepInputs, Terms
from ncs_jax.energies.total import energy_terms

from .materials import material
from .test_objective import situation

POSES = 3


def wind(x, step):
    return -0.3 * jnp.sum(x[:, 0])


def hook(x, step):
    return 2.0 * jnp.sum((x[3] - step.body[10]) ** 2) + 0.1 * jnp.sum((step.vertex_transforms[3, :, :3] @ x[3]) ** 2)


ON = {
    "membrane": "stvk", "bending": True, "collision": "plane", "friction": True, "gravity": True, "inertia": True,
    "pinning": True, "self_contact": True, "own": (wind, hook),
}  # fmt: skip
OFF = {"membrane": None, "collision": None, "own": ()}


def combination(names, **changes):
    """Terms of which only these are on."""
    return Terms(**{name: ON[name] if name in names else OFF.get(name, False) for name in ON} | changes)


def parts_of(terms):
    """The names of its energies; the external force is always there."""
    named = {name for name in ON if name != "own" and getattr(terms, name)}
    return named | {term.__name__ for term in terms.own} | {"external"}


@cache
def inputs():
    """Some poses beside each other, and the same one after the other."""
    x, garment, step, surface = situation()
    rng = np.random.default_rng(3)
    given = {name: np.asarray(value) for name, value in vars(step).items() if value is not None and name != "dt"}
    given |= {"advected": given["previous"]}
    given |= {name: rng.normal(size=x.shape) for name in ("lagged_normal_force", "force")}
    xs = [np.asarray(x) + 1e-4 * k for k in range(POSES)]
    brought = [given | {"previous": given["previous"] - 1e-4 * k, "moving": np.float64(k != 1)} for k in range(POSES)]

    def inputs_from(x, brought):
        return jnp.asarray(x), StepInputs(step.dt, **{name: jnp.asarray(value) for name, value in brought.items()})

    lanes = {name: np.stack([each[name] for each in brought], axis=-1) for name in brought[0]}
    each = [inputs_from(*one) for one in zip(xs, brought, strict=True)]
    return garment, surface, each, inputs_from(np.stack(xs, axis=-1), lanes)


@partial(jax.jit, static_argnums=0)
def plain(terms, x, step, shares):
    """Every energy, and the derivatives of what is counted of them by x and by the vertex transforms."""
    garment, surface = inputs()[:2]

    def value(x, transforms):
        at = replace(step, vertex_transforms=transforms)
        parts = energy_terms(x, garment, material(terms.membrane), at, terms, surface)
        return sum(shares[name] * part for name, part in parts.items()), parts

    slopes, parts = jax.grad(value, argnums=(0, 1), has_aux=True)(x, step.vertex_transforms)
    return parts, *slopes


def check(terms, alone=True):
    """The poses beside each other, and perhaps each alone, against automatic differentiation of their `energies`.

    One program has all of the energies, and counts those that are on: it would take as long to compile one for each case.
    """
    garment, surface, each, (xs, steps) = inputs()
    numbers, names = material(terms.membrane), parts_of(terms)
    more = combination(ON if terms.membrane in ("stvk", None) else {"gravity", "bending"}, membrane=terms.membrane or "stvk")
    shares = {name: float(name in names) for name in parts_of(more)}

    @jax.jit
    def fast(xs, steps):
        return energies_and_gradient(xs, garment, numbers, steps, terms, surface)

    found = jax.device_get(fast(xs, steps))
    for k, one in enumerate(each):
        parts, gradient, slope = jax.device_get(plain(more, *one, shares))
        for got in (jax.tree.map(lambda a, k=k: a[..., k], found), *([fast(*one)] if alone else [])):
            assert got[0].keys() == names
            for name in names:
                np.testing.assert_allclose(got[0][name], parts[name], rtol=1e-9, atol=1e-14, err_msg=name)
            np.testing.assert_allclose(got[1], gradient, rtol=0, atol=1e-9 * (1 + np.abs(gradient).max()))
            if got[2] is None:
                assert not terms.pinning and not terms.own
            else:
                np.testing.assert_allclose(got[2], slope, rtol=0, atol=1e-9 * (1 + np.abs(slope).max()))


@pytest.mark.parametrize("name", ON)
def test_each_term_alone(name):
    check(combination({name}, exact=False), alone=name != "self_contact")


# Of poses beside each other, self-contact, friction, pins and own terms are taken a pose at a time: by what a pose alone has.
def test_all_together():
    check(combination(ON), alone=False)


@pytest.mark.parametrize("name", [name for name in ON if name != "self_contact"])
def test_all_but_one(name):
    check(combination(set(ON) - {name, "self_contact"}, exact=False), alone=False)


@pytest.mark.parametrize("membrane", [m for m in MEMBRANES if m != "stvk"])
@pytest.mark.parametrize("bending", [True, False])
def test_every_membrane(membrane, bending):
    check(combination({"gravity"}, membrane=membrane, bending=bending), alone=bending)


@pytest.mark.slow
def test_every_combination():
    for count in range(len(ON) + 1):
        for names in itertools.combinations(ON, count):
            check(combination(set(names)))

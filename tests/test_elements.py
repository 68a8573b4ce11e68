"""The fast path of the total energy says what `total` says: values, forces, and derivatives by the vertex transforms."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.elements import energies_and_gradient
from ncs_jax.energies.terms import MEMBRANES, StepInputs, Terms
from ncs_jax.energies.total import energies

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


def inputs():
    """Some poses beside each other, and the same one after the other."""
    x, garment, step, surface = situation()
    rng = np.random.default_rng(3)
    step = replace(
        step,
        advected=step.previous,
        lagged_normal_force=jnp.asarray(rng.normal(size=x.shape)),
        force=jnp.asarray(rng.normal(size=x.shape)),
        moving=jnp.asarray(1.0),
    )
    each = [
        (x + 1e-4 * k, replace(step, previous=step.previous - 1e-4 * k, moving=jnp.asarray(float(k != 1))))
        for k in range(POSES)
    ]
    brought = [{name: value for name, value in vars(s).items() if value is not None and name != "dt"} for _, s in each]
    lanes = jax.tree.map(lambda *a: jnp.stack(a, axis=-1), *brought)
    return garment, surface, each, (jnp.stack([x for x, _ in each], axis=-1), StepInputs(step.dt, **lanes))


def check(terms):
    garment, surface, each, (xs, steps) = inputs()
    numbers = material(terms.membrane)

    def one(x, step):
        def value(x, transforms):
            parts = energies(x, garment, numbers, replace(step, vertex_transforms=transforms), terms, surface)
            return sum(parts.values(), start=jnp.zeros(())), parts

        (gradient, slope), parts = jax.grad(value, argnums=(0, 1), has_aux=True)(x, step.vertex_transforms)
        return parts, gradient, slope

    def all_(xs, steps):
        return energies_and_gradient(xs, garment, numbers, steps, terms, surface)

    found, plain, alone = jax.jit(all_)(xs, steps), jax.jit(one), jax.jit(all_)
    for k, (x, step) in enumerate(each):
        parts, gradient, slope = plain(x, step)
        for fast in (jax.tree.map(lambda a, k=k: a[..., k], found), alone(x, step)):
            assert fast[0].keys() == parts.keys()
            for name, value in parts.items():
                np.testing.assert_allclose(fast[0][name], value, rtol=1e-9, atol=1e-14, err_msg=name)
            np.testing.assert_allclose(fast[1], gradient, rtol=0, atol=1e-9 * (1 + float(jnp.abs(gradient).max())))
            if fast[2] is None:
                assert not terms.pinning and not terms.own
            else:
                np.testing.assert_allclose(fast[2], slope, rtol=0, atol=1e-9 * (1 + float(jnp.abs(slope).max())))


@pytest.mark.parametrize("name", ON)
def test_each_term_alone(name):
    check(combination({name}))


def test_all_together():
    check(combination(ON))


@pytest.mark.parametrize("name", [name for name in ON if name != "self_contact"])
def test_all_but_one(name):
    check(combination(set(ON) - {name, "self_contact"}))  # whose search takes ten times as long to compile as all the rest


@pytest.mark.parametrize("membrane", [m for m in MEMBRANES if m != "stvk"])
@pytest.mark.parametrize("bending", [True, False])
def test_every_membrane(membrane, bending):
    check(combination({"gravity"}, membrane=membrane, bending=bending))


@pytest.mark.slow
def test_every_combination():
    for count in range(len(ON) + 1):
        for names in itertools.combinations(ON, count):
            check(combination(set(names)))

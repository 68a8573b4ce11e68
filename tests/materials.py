"""A material in which every number is something."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ncs_jax.energies.terms import MEMBRANES, Material

DOWN = (0.0, 0.0, -9.81)


def material(model="stvk", gravity=DOWN):
    array = lambda number: jnp.asarray(np.asarray(number))  # noqa: E731 - with a type that holds, as that of a batch does
    numbers = {"lam": 41.8, "mu": 22.2, "stretch": 40.0, "shear": 20.0, "stiffness": 60.0}
    return Material(
        density=array(0.15),
        membrane=tuple(array(numbers[n]) for n in MEMBRANES[model][1]) if model else (),
        bending=array(1e-5),
        collision=array(10.0),
        thickness=array(0.004),
        friction=array(0.0),
        pinning=array(1000.0),
        gravity=array(gravity),
        self_contact=array(50.0),
        self_thickness=array(0.009),  # nearly a spacing, so that what is crumpled is too near
    )

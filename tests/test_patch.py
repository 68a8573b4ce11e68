"""A patch is the whole garment as far as its own vertices can tell."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.energies.contact.smooth import nearby_quadrics
from ncs_jax.energies.inertia import imbalance
from ncs_jax.scene.step_inputs import Past, step_inputs
from ncs_jax.simulation.implicit_euler import simulator_from
from ncs_jax.simulation.solver import minimise
from ncs_jax.simulation.solver import problem as frame
from ncs_jax.simulation.solver.patch import SIZE, patch_around, solve_dense

from .scenes import grid
from .simulators import dense, written
from .verification.newton import QUICK

evaluated = jax.jit(frame.evaluate, compiler_options=QUICK)
relaxed = jax.jit(minimise.relax_patch, compiler_options=QUICK)


@pytest.fixture(scope="module", params=["stvk", "mass_spring"])
def problem(request, tmp_path_factory):
    """A sheet of 625 vertices in the skin of a post, shaken in one corner, and the patch there."""
    physics = {"membrane": {"model": request.param}, "collision": {"distance": "smooth"}}
    assembly = written(tmp_path_factory.mktemp("patch"), *grid(25, 25, 0.012, (0, 0.4, 0.082)), **physics)
    model = assembly.model
    rest = model.garment.mesh.rest
    model = replace(model, terms=replace(model.terms, inertia=True, through_time=True))
    inputs = step_inputs(model, assembly.track.matrices[0], Past(rest, rest, moving=jnp.asarray(1.0)))
    noise = np.random.default_rng(5).normal(size=(60, 3)) * (np.arange(60) % 25 < 6)[:, None]
    x = rest.at[:60].add(1e-3 * noise)
    near = frame.Neighbours(jax.jit(nearby_quadrics)(x, inputs.body, model.surface), None, x)
    simulator = simulator_from(model)
    step = frame.Problem(model, simulator.couplings, simulator.order, inputs, neighbours=near)
    score = imbalance(evaluated(step, x)[1] - evaluated(step, rest)[1], step.mass)
    patch = jax.jit(patch_around)(score, model, step.couplings)
    assert patch.whole
    return step, x, patch


def test_it_lies_where_the_imbalance_is(problem):
    _, _, patch = problem
    verts = np.asarray(patch.verts)
    assert len(np.unique(verts)) == SIZE
    shaken = [v for v in range(60) if v % 25 < 6]
    assert set(shaken) <= set(verts.tolist())
    np.testing.assert_array_equal(np.asarray(patch.place)[verts], np.arange(SIZE))


def test_forces_and_changes_of_energy_are_those_of_the_whole(problem, rng):
    step, x, patch = problem
    local = minimise._on_patch(step, patch)
    way = jnp.zeros_like(x).at[patch.verts].set(1e-3 * rng.normal(size=(SIZE, 3)))
    here, there = evaluated(step, x), evaluated(step, x + way)
    assert jnp.min(here[2].distance) < 0.003 < jnp.max(here[2].distance)  # some of it is touched
    mine = evaluated(local, x), evaluated(local, x + way)
    np.testing.assert_allclose(mine[1][0] - mine[0][0], there[0] - here[0], rtol=1e-9)
    for one, all_ in zip(mine, (here, there), strict=True):
        size = float(jnp.abs(all_[1]).max())
        np.testing.assert_allclose(one[1][patch.verts], all_[1][patch.verts], rtol=0, atol=1e-12 * size)


def test_its_solve_is_that_of_the_dense_matrix(problem):
    step, x, patch = problem
    gradient = evaluated(step, x)[1]
    blocks = partial(jax.jit(frame.stiffness_blocks, compiler_options=QUICK), x=x)
    local = minimise._on_patch(step, patch)
    found = jax.jit(solve_dense)(patch, *blocks(local, point=evaluated(local, x)), gradient)
    whole = dense(step.couplings, *blocks(step, point=evaluated(step, x))).reshape(len(x), 3, len(x), 3)
    v = np.asarray(patch.verts)
    right = np.linalg.solve(whole[v][:, :, v].reshape(3 * SIZE, -1), np.asarray(gradient)[v].reshape(-1))
    np.testing.assert_allclose(np.asarray(found)[v].reshape(-1), right, rtol=0, atol=1e-9 * np.abs(right).max())
    held = np.setdiff1d(np.arange(len(x)), v)
    assert not np.asarray(found)[held].any()


def test_it_comes_to_rest_alone_and_the_energy_falls(problem):
    step, x, _ = problem
    rest = step.model.garment.mesh.rest
    before = evaluated(step, x)
    left = imbalance(before[1], step.mass) - imbalance(evaluated(step, rest)[1], step.mass)
    enough = 1e-3 * float(jnp.sum(left))
    after, _, count = relaxed(step, x, None, left, enough)
    moved = np.flatnonzero(np.any(np.asarray(after != x), axis=1))
    assert count > 0 and 0 < len(moved) <= SIZE
    found = evaluated(step, after)
    assert found[0] < before[0]
    still = np.asarray(imbalance(found[1], step.mass))
    assert still[moved].sum() <= 0.25 * enough
    # what holds too little of the imbalance is left alone
    same, _, count = relaxed(step, x, None, left + jnp.max(left), enough)
    assert count == 0 and jnp.array_equal(same, x)

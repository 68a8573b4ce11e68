"""Where a training begins: outside of a limb that skinning alone lets through the garment, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.skinning import Blend, blend, skin
from ncs_jax.network.rollout import animate
from ncs_jax.prepare.outset import OUT, ROOM, WIDER, exposed, outset
from ncs_jax.prepare.skinning_weights import FREE, NEAR, hanging
from ncs_jax.runs.placed_scene import PlacedScene
from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import pose_body
from ncs_jax.scene.spec import load_scene
from ncs_jax.training.step import initial_state

from .scenes import SCENE, post, swing, write_scene
from .shapes import tube


def test_what_a_garment_surrounds_no_more_is_exposed():
    x, faces = tube(20, 14, 0.13, 0.6)
    line = np.stack([np.linspace(-0.3, 0.3, 41), np.full(41, 0.3), np.zeros(41)], axis=1)
    outside = np.abs(line[:, 0]) > 0.13
    assert exposed(line, x, faces) == pytest.approx(outside.mean(), abs=0.05)
    assert exposed(line[~outside], x, faces) == 0 and exposed(line[outside], x, faces) == 1
    assert exposed(line[~outside], x, faces[:, ::-1]) == 0  # whichever side its faces show


def test_cloth_hangs_more_freely_the_farther_it_is_from_the_skin():
    skin_, faces = tube(48, 24, 0.1, 1.0)
    away = np.array([0.0, NEAR, (NEAR + FREE) / 2, FREE, 0.4])
    x = np.stack([np.zeros(5), np.full(5, 0.5), 0.1 + away], axis=1)
    free, gap = hanging(x, skin_, faces)
    np.testing.assert_allclose(free, [0, 0, 0.5, 1, 1], atol=0.02)
    np.testing.assert_allclose(gap, np.stack([np.zeros(5), np.zeros(5), away], axis=1), atol=2e-3)


@pytest.fixture
def bent(tmp_path):
    """Return model, track and assembly: a wide tube follows the lower half of a post, whose upper half bends through it."""
    path = write_scene(tmp_path, SCENE.replace('cell = "gated"', 'method = "pbns"'))
    vertices, faces = tube(20, 14, 0.18, 0.6)
    np.savez(tmp_path / "cloth.npz", vertices=vertices + [0, 0.35, 0], faces=faces, group_pins=np.arange(0, dtype=np.int32))
    np.savez(tmp_path / "body.npz", **post(rings=40, around=24))
    np.savez(tmp_path / "swing.npz", **swing(frames=24, size=0.5))
    assembly = assemble(load_scene(path))
    lower = Blend(jnp.ones((len(vertices), 1), jnp.float32), (0,))
    model = replace(assembly.model, blend=lower)
    return model, assembly.track, replace(assembly, model=model)


def out(model, matrices, offsets):
    """How much of the skin that the garment surrounds at rest is out of it in each frame."""
    faces, rest = np.asarray(model.garment.mesh.faces), model.garment.mesh.rest
    own, found = np.abs(np.asarray(model.body)[:, 1] - 0.65) < 0.2, []
    for at, offset in zip(matrices, np.broadcast_to(offsets, (len(matrices), *rest.shape)), strict=True):
        x = np.asarray(skin(blend(at, model.blend), rest + offset))
        found.append(exposed(np.asarray(pose_body(model, at))[own], x, faces))
    return np.array(found)


def test_cloth_that_a_limb_goes_through_begins_outside_of_it_in_that_pose(bent, plain_jax):
    model, track, _ = bent
    frames, far = outset(model, track, None)
    before, after = (out(model, track.matrices[frames], offsets) for offsets in (0.0, far))
    assert before.max() > 0.05 and after.max() < 0.2 * before.max()
    size = np.linalg.norm(far, axis=2)
    still = size.max(axis=1) == 0
    assert still.any() and not still.all() and before[still].max() <= 2 * OUT
    free, _ = hanging(np.asarray(model.garment.mesh.rest), np.asarray(model.body), np.asarray(model.surface.faces))
    wider = size.max(axis=1)[~still] / free.max() - ROOM
    assert (np.abs(wider[:, None] - WIDER).min(axis=1) < 1e-4).all() and len(np.unique(np.round(wider, 3))) > 1
    outward = np.asarray(model.garment.mesh.rest) * [1, 0, 1]
    inner = np.abs(np.asarray(model.garment.mesh.rest)[:, 1] - 0.65) < 0.2
    assert (np.sum(far * outward, axis=2)[~still][:, inner] > 0).all()
    hung = np.full(model.garment.mesh.rest.shape, 1e-3, np.float32)
    _, begun = outset(model, track, jnp.asarray(hung))
    np.testing.assert_allclose(begun[still], np.broadcast_to(hung, (still.sum(), *hung.shape)), atol=1e-7)


def test_a_garment_that_shows_its_inner_side_is_made_wider_all_the_same(bent, plain_jax):
    model, track, _ = bent
    mesh = model.garment.mesh
    turned = replace(model, garment=replace(model.garment, mesh=replace(mesh, faces=mesh.faces[:, ::-1])))
    for a, b in zip(outset(model, track, None), outset(turned, track, None), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_where_nothing_comes_through_a_training_begins_as_it_did(tmp_path, plain_jax):
    assembly = assemble(load_scene(write_scene(tmp_path)))
    assert outset(assembly.model, assembly.track, None) is None
    assert outset(replace(assembly.model, body=None), assembly.track, None) is None
    assert outset(replace(assembly.model, surface=None), assembly.track, None) is None
    begun = PlacedScene(assembly, 3).initial_state().params
    fresh = initial_state(assembly.model, assembly.network, 3).params
    assert all(map(np.array_equal, jax.tree.leaves(begun), jax.tree.leaves(fresh)))


def test_a_fresh_network_begins_there_and_given_weights_stay(bent, plain_jax):
    model, track, assembly = bent
    placed = PlacedScene(assembly, 0)
    fresh, state = initial_state(model, assembly.network, 0), placed.initial_state()
    frames, far = outset(model, track, None)
    part = jax.tree.map(lambda a: a[frames], track)
    rest = model.garment.mesh.rest
    right = np.stack([skin(blend(at, model.blend), rest + y) for at, y in zip(part.matrices, far, strict=True)])
    places = (np.asarray(animate(model, assembly.network, s.params, part, None)) for s in (fresh, state))
    away = [np.linalg.norm(x - right, axis=2) for x in places]
    assert away[0].max() > 0.05 and away[1].mean() < 0.3 * away[0].mean() and np.isfinite(away[1]).all()
    assert jax.tree.structure(state.optimiser) == jax.tree.structure(fresh.optimiser)
    kept = placed.initial_state(state.params)
    assert all(map(np.array_equal, jax.tree.leaves(kept.params), jax.tree.leaves(state.params)))

"""A garment carried over from one body to another: in another pose, of other proportions, with other triangles."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_jax import InputError, io
from ncs_jax.cli import main
from ncs_jax.geometry.mesh import topology
from ncs_jax.geometry.surface_distance import border_of, distance_and_direction
from ncs_jax.io.packaged import packaged
from ncs_jax.prepare.carry_over import carry_over, spread_weights
from ncs_jax.prepare.garment_placement import place

from .shapes import rotation, tube

NAMES = ("hips", "spine", "left_arm", "left_forearm", "left_hand", "right_arm", "right_forearm", "right_hand",
         "left_thigh", "left_shin", "left_foot", "right_thigh", "right_shin", "right_foot")  # fmt: skip
PARENTS = np.array([-1, 0, 1, 2, 3, 1, 5, 6, 0, 8, 9, 0, 11, 12], np.int32)


def person(down=0.0, arm=0.3, leg=0.4, wide=1.0, around=16, rings=9):
    """A body of tubes: arms that point `down` degrees below the horizontal, bones of arms and legs so long, so wide."""
    c, s, top = np.cos(np.radians(down)), np.sin(np.radians(down)), 2 * leg + 0.5
    left = [wide * np.array([0.2, 0, 0]) + [0, top, 0] + k * arm * np.array([c, -s, 0]) for k in range(3)]
    legs = [np.array([0.09 * wide, k * leg, 0]) for k in (2, 1, 0)]
    flip = np.array([-1, 1, 1])
    joints = np.stack(
        [[0, 2 * leg, 0], [0, 2 * leg + 0.25, 0], *left, *(p * flip for p in left), *legs, *(p * flip for p in legs)]
    )
    bones = [(0, (0, 2 * leg, 0), (0, top + 0.06, 0), 0.15)]
    bones += [(j, joints[j], joints[j + 1], 0.05) for j in (2, 3, 5, 6)] + [
        (j, joints[j], joints[j + 1], 0.07) for j in (8, 9, 11, 12)
    ]
    x, faces, owner = [], [], []
    for j, start, end, radius in bones:
        points, triangles = along(np.array(start), np.array(end), wide * radius, around, rings)
        faces.append(triangles + sum(map(len, x)))
        x.append(points)
        owner.append(np.full(len(points), j))
    return io.BodyRecord(np.concatenate(x), np.concatenate(faces), joints, PARENTS, np.eye(14)[np.concatenate(owner)], NAMES)


def along(start, end, radius, around=24, rings=9):
    """A tube from one point to another."""
    x, faces = tube(around, rings, radius, np.linalg.norm(end - start))
    up = (end - start) / np.linalg.norm(end - start)
    axis = np.cross([0, 1, 0], up)
    size = np.linalg.norm(axis)
    turn = rotation(axis / size, np.arctan2(size, up[1])) if size > 1e-9 else np.diag([1, np.sign(up[1]), np.sign(up[1])])
    return x @ np.asarray(turn).T + start, faces


def from_axis(x, start, end):
    """Places along a bone, 0 to 1, and distances from it."""
    share = (x - start) @ (end - start) / np.sum((end - start) ** 2)
    return share, np.linalg.norm(x - start - share[:, None] * (end - start), axis=1)


def test_a_sleeve_keeps_its_place_on_the_arm_and_its_distance_from_the_skin():
    """From arms that are held out to longer, thicker ones that hang: 1 cm above the skin from a quarter of the bone to 3/4."""
    one, other = person(), person(down=50, arm=0.4, leg=0.35, wide=1.2, around=20)
    for j in (2, 3, 6):
        start, end = one.joints[j : j + 2]
        x, faces = along(start + 0.25 * (end - start), start + 0.75 * (end - start), 0.06)
        found = carry_over(io.GarmentRecord(x, faces), one, other)
        share, far = from_axis(found.garment.vertices, *other.joints[j : j + 2])
        assert np.abs(far - 0.07).max() < 0.003 and np.abs(share - from_axis(x, start, end)[0]).max() < 0.03
        np.testing.assert_array_equal(found.garment.faces, faces)
    assert 1.1 < found.size < 1.35 and np.percentile(found.strain, 95) < 0.2


def test_a_belly_that_the_other_body_has_carries_the_cloth_outward():
    """No map of the trunk as a whole knows of its 4.5 cm; the cloth follows all but a third, and is pushed out of the rest."""
    one, other = person(rings=25), person(around=20, rings=27)
    top, own = 1.3, other.weights[:, 0] == 1
    bulge = 1 + 0.3 * np.exp(-(((other.vertices[:, 1:2] - 1.05) / 0.12) ** 2)) * own[:, None]
    other = replace(other, vertices=other.vertices * np.where([True, False, True], bulge, 1))
    x, faces = along(np.array([0, 0.85, 0.0]), np.array([0, top - 0.05, 0.0]), 0.16)
    x = carry_over(io.GarmentRecord(x, faces), one, other).garment.vertices
    skin = 0.15 * (1 + 0.3 * np.exp(-(((x[:, 1] - 1.05) / 0.12) ** 2)))
    gap = np.linalg.norm(x[:, [0, 2]], axis=1) - skin
    assert np.abs(gap - 0.01).max() < 0.045 / 3


def test_the_same_body_leaves_it_where_it_is():
    x, faces = along(np.array([0, 0.6, 0.0]), np.array([0, 1.2, 0.0]), 0.18)
    found = carry_over(io.GarmentRecord(x, faces), person(), person())
    np.testing.assert_allclose(found.garment.vertices, x, atol=1e-6)
    assert found.size == pytest.approx(1) and found.strain.max() < 1e-4


def test_what_is_strained_or_worn_worse_is_refused():
    one, other = person(), person(leg=0.35)
    x, faces = along(np.array([0, 0.6, 0.0]), np.array([0, 1.2, 0.0]), 0.18)
    found = carry_over(io.GarmentRecord(x, faces), one, other)
    known = {"scale": 1.0, "up": "y", "turn": 0, "move": (0.0, 0.0, 0.0)}
    before = place("g.obj", io.GarmentRecord(x, faces), one, **known)
    after = place("g.obj", found.garment, other, **known)
    found.check("g.obj", before, after)
    for bad, there in (
        (replace(found, stretch=np.where(np.arange(len(found.stretch)) % 9, found.stretch, 3)), after),
        (found, replace(after, pierced=("left_arm",))),
        (found, replace(after, threaded=0.5)),
    ):
        with pytest.raises(InputError, match=r"g\.obj: vertices: two bodies of one kind expected.*that it was made for"):
            bad.check("g.obj", before, there)


def test_bodies_that_cannot_be_compared_are_refused():
    x, faces = along(np.array([0, 0.6, 0.0]), np.array([0, 1.2, 0.0]), 0.18)
    odd = replace(person(), joint_names=tuple(f"b{j}" for j in range(14)), joints=np.zeros((14, 3)))
    with pytest.raises(InputError, match=r"a\.glb: joint_names: two bodies whose joints' names tell arms and legs.*--body"):
        carry_over(io.GarmentRecord(x, faces), person(), odd, "a.glb")


def test_the_command_carries_over_and_says_what_it_did(tmp_path, capsys):
    """A tube for the arms of one body; without --from the refusal names it."""
    for name, body in (("one", person()), ("other", person(down=50, arm=0.4, leg=0.35, wide=1.2))):
        np.savez(
            tmp_path / f"{name}.npz", vertices=body.vertices, faces=body.faces, joints=body.joints, parents=body.parents,
            blend_weights=body.weights, joint_names=np.array(NAMES),
        )  # fmt: skip
    start, end = person().joints[2:4]
    x, faces = along(start + 0.2 * (end - start), start + 0.9 * (end - start), 0.06)
    np.savez(tmp_path / "g.npz", vertices=x, faces=faces)
    command = [
        "fit",
        str(tmp_path / "g.npz"),
        "--body",
        str(tmp_path / "other.npz"),
        "--out",
        str(tmp_path / "out.npz"),
        "--stay",
    ]
    assert main([*command, "--from", str(tmp_path / "one.npz")]) == 0
    told = capsys.readouterr().out
    assert "carried over to" in told and "strain" in told and "0 inside now" in told
    assert (tmp_path / "out.png").read_bytes()[:4] == b"\x89PNG"
    far = from_axis(io.read_garment(tmp_path / "out.npz").vertices, *person(down=50, arm=0.4, leg=0.35, wide=1.2).joints[2:4])[
        1
    ]
    assert np.abs(far - 0.07).max() < 0.004


@pytest.mark.slow
def test_weights_do_not_tear_a_skirt_between_the_legs():
    """Skinned alone, edges of the packaged skirt, walking, are 1.8 times as long by averaging, and 1.2 at most so."""
    import jax.numpy as jnp

    from ncs_jax.geometry.rotations import axis_angle_to_matrix
    from ncs_jax.geometry.skinning import Skeleton, blend, blend_from, forward, skin, transforms
    from ncs_jax.prepare.skinning_weights import smooth_weights, transfer_weights

    body, skirt = io.read_body(packaged("body")), io.read_garment(packaged("skirt"))
    away = distance_and_direction(skirt.vertices, body.vertices, body.faces, border_of(body.faces, len(body.vertices)))
    found = spread_weights(skirt, body, *away)
    edges, rest = topology(skirt.faces)[0], skirt.vertices
    plain = smooth_weights(transfer_weights(rest, body.vertices, body.faces, body.weights), edges, 10)
    skeleton = Skeleton(jnp.asarray(body.joints, jnp.float32), tuple(int(p) for p in body.parents))
    local = axis_angle_to_matrix(jnp.asarray(io.read_motion(packaged("walk")).poses[::10], jnp.float32))

    def stretch(weights):
        worst = 0
        for pose in local:
            matrices = transforms(skeleton, forward(skeleton, pose, jnp.zeros(3, jnp.float32)))
            x = np.asarray(skin(blend(matrices, blend_from(weights)), jnp.asarray(rest, jnp.float32)))
            long = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
            worst = max(worst, (long / np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)).max())
        return worst

    assert stretch(plain) > 1.5 and stretch(found) < 1.2
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-12)
    assert found.min() >= 0

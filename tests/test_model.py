"""What is found out once about a garment on a character: weights, joints that matter, and what it can touch."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ncs_jax.geometry.enclosure import ENCLOSED, enclosure
from ncs_jax.geometry.mesh import topology
from ncs_jax.geometry.rotations import axis_angle_to_matrix
from ncs_jax.geometry.skinning import (
    Skeleton,
    blend,
    blend_from,
    corrected,
    correctives_from,
    forward,
    skin,
    to_rest_axes,
    transforms,
)
from ncs_jax.geometry.winding_number import winding_number
from ncs_jax.io import read_body, read_garment
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.packaged import packaged
from ncs_jax.io.records import BodyRecord, GarmentRecord, MotionRecord
from ncs_jax.prepare.posing import carried, corrected_rest, joint_transforms
from ncs_jax.prepare.skinning_weights import hung_weights, smooth_weights, transfer_weights, used_joints
from ncs_jax.prepare.touchable import bare_soles, touchable, touchable_part, turned_away
from ncs_jax.runs.run import assemble
from ncs_jax.scene.model import local_rotations, pose_body
from ncs_jax.scene.spec import GarmentSpec, Scene, load_scene

from .scenes import post, write_scene
from .shapes import ball, rotation, sheet

# --- weights ------------------------------------------------------------------------------------------------------------


def test_weights_at_a_point_of_a_face_are_interpolated(rng):
    """Points a little outside a ball's faces, straight above known barycentric coordinates; corners and edges too."""
    vertices, faces = ball(1)
    weights = rng.dirichlet(np.ones(4), len(vertices))
    inside = rng.dirichlet(np.ones(3) * 2, 20)
    edge = np.concatenate([rng.dirichlet(np.ones(2), 10), np.zeros((10, 1))], axis=1)
    barycentric = np.concatenate([inside, edge, np.eye(3)])
    face = faces[rng.integers(len(faces), size=len(barycentric))]
    corners = vertices[face]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = np.einsum("vk,vkd->vd", barycentric, corners) + 0.004 * normal
    right = np.einsum("vk,vkj->vj", barycentric, weights[face])
    found = transfer_weights(points, vertices, faces, weights)
    np.testing.assert_allclose(found, right, atol=2e-5)  # searched in single precision
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-6)
    # the nearest vertex alone is another answer
    nearest = weights[np.linalg.norm(points[:, None] - vertices[None], axis=-1).argmin(axis=1)]
    assert np.abs(nearest - right)[:20].max() > 0.1


def test_a_body_vertex_between_faces_gives_its_own_weights():
    body = post()
    weights = body["blend_weights"]
    found = transfer_weights(body["vertices"], body["vertices"], body["faces"], weights)
    np.testing.assert_allclose(found, weights, atol=1e-5)


def test_a_wide_skirt_goes_where_a_thigh_goes():
    """A thigh raised by 75 degrees to the side stays within the skinned dress; by the hips alone it passes through."""
    body, dress = read_body(packaged("body")), read_garment(packaged("dress"))
    joint = {name: j for j, name in enumerate(body.joint_names)}
    lying = transfer_weights(dress.vertices, body.vertices, body.faces, body.weights)
    hung = hung_weights(dress, body, lying)
    np.testing.assert_allclose(hung.sum(axis=1), 1, atol=1e-9)
    assert hung.min() >= 0
    skirt, left = dress.vertices[:, 1] < 0.8, dress.vertices[:, 0] * np.sign(body.joints[joint["LeftUpLeg"], 0])
    thigh = hung[:, joint["LeftUpLeg"]]
    assert thigh[skirt & (left > 0.35)].min() > 0.5 and thigh[skirt & (left < -0.35)].mean() < 0.15
    assert hung[skirt][:, [joint["LeftLeg"], joint["RightLeg"]]].sum(axis=1).max() < 0.1  # a bent knee hardly counts
    arms = [j for name, j in joint.items() if "Arm" in name or "Hand" in name]
    assert hung[skirt][:, arms].max() < 0.001
    hips = np.where(skirt[:, None], np.eye(len(joint))[joint["Hips"]], lying)
    pose = np.zeros((len(joint), 3))
    pose[joint["LeftUpLeg"], 2] = np.radians(75) * np.sign(body.joints[joint["LeftUpLeg"], 0])
    skin = np.flatnonzero(body.weights[:, joint["LeftUpLeg"]] > 0.9)
    (transforms,) = joint_transforms(body, pose[None])
    raised = carried(body.vertices, blend_from(body.weights), transforms)[skin]

    def within(weights):
        return enclosure(raised, carried(dress.vertices, blend_from(weights), transforms), dress.faces) > ENCLOSED

    assert within(hung).mean() > 0.99 and within(hips).mean() < 0.8


def test_cloth_that_lies_close_keeps_its_weights():
    body, shirt = read_body(packaged("body")), read_garment(packaged("tshirt"))
    close = GarmentRecord(shirt.vertices[(shirt.vertices[:, 1] > 1.2)], np.zeros((0, 3), np.int32))
    weights = transfer_weights(close.vertices, body.vertices, body.faces, body.weights)
    assert hung_weights(close, body, weights) is weights


def test_smoothing_is_the_mean_of_the_neighbours_again_and_again(rng):
    vertices, faces = sheet(5, 6, 0.01)
    edges = topology(faces)[0]
    weights = rng.dirichlet(np.ones(3), len(vertices))
    neighbours = [[*edges[edges[:, 0] == v, 1], *edges[edges[:, 1] == v, 0]] for v in range(len(vertices))]
    right = weights
    for _ in range(4):
        right = np.stack([right[n].mean(axis=0) for n in neighbours])
    np.testing.assert_allclose(smooth_weights(weights, edges, 4), right, atol=1e-14)
    np.testing.assert_allclose(smooth_weights(weights, edges, 0), weights, atol=1e-15)


@pytest.mark.parametrize("times", [0, 1, 10, 200])
def test_smoothed_weights_are_weights(rng, times):
    vertices, faces = sheet(5, 6, 0.01)
    edges = topology(faces)[0]
    weights = rng.dirichlet(0.2 * np.ones(5), len(vertices) + 1)  # the last vertex belongs to no edge
    kept = weights.copy()
    smoothed = smooth_weights(weights, edges, times)
    np.testing.assert_allclose(smoothed.sum(axis=1), 1, rtol=1e-13)
    assert (smoothed >= 0).all()
    np.testing.assert_allclose(smoothed[-1], weights[-1], rtol=1e-12)
    np.testing.assert_array_equal(weights, kept)
    spread = lambda w: np.ptp(w[:-1], axis=0).max()  # noqa: E731
    assert spread(smoothed) <= spread(weights) * (0.7 if times else 1 + 1e-12)
    np.testing.assert_allclose(smooth_weights(np.full((31, 2), 0.5), edges, times), 0.5, rtol=1e-13)


# --- joints -------------------------------------------------------------------------------------------------------------

PARENTS = (-1, 0, 1, 2, 0, 4, 5)


@pytest.mark.parametrize(
    ("heavy", "used"),
    [([3], (0, 1, 2, 3)), ([5], (0, 4, 5)), ([2, 6], (0, 1, 2, 4, 5, 6)), ([0], (0,)), ([], (0,))],
)
def test_joints_that_matter_and_all_their_ancestors(heavy, used):
    weights = np.full((10, 7), 1e-3)
    weights[4, heavy] = 0.3
    assert used_joints(PARENTS, weights) == used
    assert used_joints(PARENTS, weights, least=1e-4) == tuple(range(7))
    weights[4, heavy] = 0.01  # just enough
    assert used_joints(PARENTS, weights) == used
    assert used_joints(PARENTS, np.zeros((0, 7))) == (0,)


def test_joints_left_out_change_nothing(tmp_path, rng):
    """A body with more joints than the garment needs: the model's small skeleton poses the garment as the whole would."""
    path = write_scene(tmp_path)
    body = post()
    more = dict(body)
    more["joints"] = np.concatenate([body["joints"], [[0, 0.9, 0], [0.3, 0.1, 0]]])
    more["parents"] = np.array([-1, 0, 1, 0])
    more["blend_weights"] = np.pad(body["blend_weights"], ((0, 0), (0, 2)))
    np.savez(tmp_path / "body.npz", **more)
    poses, translation = 0.3 * rng.normal(size=(5, 4, 3)), rng.normal(size=(5, 3))
    np.savez(tmp_path / "swing.npz", poses=poses, trans=0.1 * translation, fps=np.array(30.0))
    model = assemble(load_scene(path), dtype=jnp.float64).model
    assert model.source_joints == (0, 1) and len(model.skeleton.parents) == 2
    local = local_rotations(model, jnp.asarray(poses))
    np.testing.assert_allclose(local, axis_angle_to_matrix(jnp.asarray(poses[:, :2])), atol=1e-15)

    small = transforms(model.skeleton, forward(model.skeleton, local, jnp.asarray(translation)))
    whole = Skeleton(jnp.asarray(more["joints"]), tuple(int(p) for p in more["parents"]))
    every = axis_angle_to_matrix(jnp.asarray(poses))
    full = transforms(whole, forward(whole, every, jnp.asarray(translation)))
    blended = (blend(jnp.moveaxis(matrices, 0, -1), model.blend) for matrices in (small, full))
    np.testing.assert_allclose(*blended, atol=1e-13)
    assert np.abs(np.asarray(full[:, 2:])).max() > 0.1


def test_rest_axes_are_turned_once(tmp_path, rng):
    model = assemble(load_scene(write_scene(tmp_path)), dtype=jnp.float64).model
    q = jnp.asarray(Rotation.from_rotvec(rng.normal(size=(2, 3))).as_matrix())
    poses = jnp.asarray(rng.normal(size=(3, 2, 3)))
    turned = local_rotations(dataclasses.replace(model, rest_rotations=q), poses)
    np.testing.assert_allclose(turned, to_rest_axes(local_rotations(model, poses), q), atol=1e-14)
    assert np.abs(np.asarray(turned - local_rotations(model, poses))).max() > 0.1


# --- touch --------------------------------------------------------------------------------------------------------------


def posed_by_loop(vertices, weights, joints, parents, local):
    world, position = np.zeros_like(local), np.zeros((len(joints), 3))
    for j, parent in enumerate(parents):
        world[j] = local[j] if parent < 0 else world[parent] @ local[j]
        position[j] = joints[j] if parent < 0 else position[parent] + world[parent] @ (joints[j] - joints[parent])
    return sum(weights[:, j, None] * ((vertices - joints[j]) @ world[j].T + position[j]) for j in range(len(joints)))


@pytest.mark.parametrize("reach", [0.01, 0.035, 0.08])
def test_touchable_is_what_a_search_of_every_pair_finds(rng, reach):
    """An arm folds onto a sheet on the trunk: at rest it is far away."""
    body = post()
    cloth, _ = sheet(4, 5, 0.02)
    cloth = cloth + [-0.04, 0.2, 0.11]
    cloth_weights = np.tile([1.0, 0.0], (len(cloth), 1))
    joints, parents = body["joints"], [-1, 0]
    bent = [np.stack([rotation([1, 2, 3], 0.7), rotation([1, 0, 0], a)]) for a in (2.9, 1.2)]

    right = np.zeros(len(body["vertices"]), bool)
    by_pose = []
    for local in [np.stack([np.eye(3)] * 2), *bent]:
        x = posed_by_loop(cloth, cloth_weights, joints, parents, local)
        b = posed_by_loop(body["vertices"], body["blend_weights"], joints, parents, local)
        distance = np.linalg.norm(x[:, None] - b[None], axis=-1).min(axis=0)
        assert np.abs(distance - reach).min() > 1e-9  # no tie
        by_pose.append(distance <= reach)
        right |= distance <= reach
    record = BodyRecord(body["vertices"], body["faces"], joints, np.array(parents, np.int32), body["blend_weights"])
    blend, poses = blend_from(cloth_weights, dtype=jnp.float64), Rotation.from_matrix(np.reshape(bent, (4, 3, 3))).as_rotvec()
    found = touchable(record, cloth, blend, poses.reshape(2, 2, 3), reach)
    np.testing.assert_array_equal(found, right)
    assert not found.all()
    if reach > 0.03:
        assert by_pose[0].any()
    if reach > 0.05:
        assert (by_pose[1] & ~by_pose[0] & ~by_pose[2]).any()  # the folded arm is what the poses are looked at for
    at_rest = touchable(record, cloth, blend, np.zeros((0, 2, 3)), reach)
    np.testing.assert_array_equal(at_rest, by_pose[0])


def test_soles_are_not_touched_but_by_what_is_under_them():
    body, dress = read_body(packaged("body")), read_garment(packaged("dress"))
    soles = bare_soles(body, dress.vertices)
    normals = vertex_normals(body.vertices, body.faces)
    feet = body.weights[soles] @ np.array(["Foot" in name or "Toe" in name for name in body.joint_names], float)
    assert soles.sum() > 100 and (body.vertices[soles, 1] < 0.05).all() and (normals[soles, 1] < 0).all() and (feet > 0.9).all()
    tops = (body.vertices[:, 1] < 0.08) & (normals[:, 1] > 0.5)
    assert tops.any() and not (soles & tops).any()
    sock = body.vertices[soles] + 0.003 * normals[soles]  # cloth under both feet
    assert not bare_soles(body, sock).any()
    left = body.vertices[:, 0] > 0
    other = bare_soles(body, sock[left[soles]])
    assert other.any() and not (other & left).any()


def test_enclosure_is_the_winding_number_away_from_the_cloth(rng):
    """A wide open cone: from far above it to within its opening and below."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, 48, endpoint=False), np.linspace(0.05, 0.8, 20), indexing="ij")
    cone = np.stack([height * np.cos(angle), -height, height * np.sin(angle)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(48), np.arange(19), indexing="ij")
    a, b, c, d = (20 * ((i + p) % 48) + j + q for p, q in ((0, 0), (1, 0), (0, 1), (1, 1)))
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
    x = rng.uniform(-1, 1, (400, 3))
    x = x[cKDTree(cone).query(x)[0] > 0.15]
    right = winding_number(x, cone[faces])
    right *= np.sign(right[np.abs(right).argmax()])
    assert right.max() > 0.7 and right.min() < -0.02  # from within to beside
    for turned in (faces, faces[:, ::-1]):
        np.testing.assert_allclose(enclosure(x, cone, turned), right, atol=0.01)
    below, aside = enclosure(np.array([[0, -1.2, 0], [0.8, -0.3, 0]]), cone, faces)
    assert 0 < below < 0.5 and aside < 0


def test_a_wide_skirt_touches_the_legs_that_it_stands_off():
    """No leg is within reach of the packaged dress at rest, which stands off as a cone."""
    body, dress = read_body(packaged("body")), read_garment(packaged("dress"))
    scene = Scene(garment=GarmentSpec("ncs:dress"))
    weights = transfer_weights(dress.vertices, body.vertices, body.faces, body.weights)
    found = touchable_part(scene, body, dress, weights, [])
    near = touchable(body, dress.vertices, blend_from(weights), np.zeros((0, 31, 3)), scene.physics.collision.reach)
    shins = np.flatnonzero((body.vertices[:, 1] > 0.2) & (body.vertices[:, 1] < 0.4))
    assert np.isin(shins, found).all() and not near[shins].any()


def test_an_arm_touches_what_it_hangs_beside_by_its_inner_side():
    """The arms stand off by some 40 degrees at rest; the T-shirt is around the upper ones."""
    body, dress, shirt = read_body(packaged("body")), read_garment(packaged("dress")), read_garment(packaged("tshirt"))
    weights = {name: transfer_weights(g.vertices, *_parts(body)) for name, g in (("dress", dress), ("shirt", shirt))}
    normals, still = vertex_normals(body.vertices, body.faces), np.zeros((0, len(body.parents), 3))
    away = turned_away(body, dress, blend_from(weights["dress"]), still, 1.0)
    names = np.array(body.joint_names)[body.weights.argmax(axis=1)]
    for side, sign in (("Left", 1), ("Right", -1)):
        arm, aside = names == f"{side}ForeArm", sign * normals[:, 0]
        assert away[arm & (aside > 0.8)].all() and not away[arm & (aside < -0.8)].any()
    assert not away[np.isin(names, ["LeftUpLeg", "RightUpLeg", "LowerBack"])].any()  # under the cloth

    inside_out = dataclasses.replace(dress, faces=dress.faces[:, ::-1])
    np.testing.assert_array_equal(turned_away(body, inside_out, blend_from(weights["dress"]), still, 1.0), away)

    lowered = np.zeros((1, len(body.parents), 3))
    for name, sign in (("LeftArm", -1), ("RightArm", 1)):
        lowered[0, body.joint_names.index(name)] = [0, 0, 0.5 * sign]
    record = MotionRecord(lowered.astype(np.float32), np.zeros((1, 3), np.float32), 30.0)
    part = touchable_part(Scene(garment=GarmentSpec("ncs:tshirt")), body, shirt, weights["shirt"], [record])
    kept, arm = np.isin(np.arange(len(names)), part), (names == "LeftForeArm") & (body.vertices[:, 1] < 1.04)
    outer, inner = arm & (normals[:, 0] > 0.8), arm & (normals[:, 0] < -0.8)
    assert kept[inner].all() and kept[outer].mean() < 0.15  # some where the cloth ends
    around = np.flatnonzero((names == "LeftArm") & (body.vertices[:, 0] < shirt.vertices[:, 0].max() - 0.05))
    assert np.isin(around, part).all()  # a sleeve is touched from all sides


def _parts(body):
    return body.vertices, body.faces, body.weights


def test_the_host_corrects_a_pose_as_the_model_does(rng):
    parents = [-1, 0, 1]
    skeleton = Skeleton(jnp.asarray(rng.normal(size=(3, 3))), tuple(parents))
    local = Rotation.from_rotvec(rng.normal(size=(3, 3))).as_matrix()
    m = transforms(skeleton, forward(skeleton, jnp.asarray(local), jnp.zeros(3)))
    x, more = rng.normal(size=(5, 3)), correctives_from(rng.normal(size=(5, 3, 18)), dtype=jnp.float64)
    expected = corrected(jnp.asarray(x), more, m, parents)
    np.testing.assert_allclose(corrected_rest(x, more, np.asarray(m), parents), expected, atol=1e-12)
    assert np.abs(expected - x).max() > 0.1


def test_the_body_that_can_be_touched_is_posed_like_the_whole(tmp_path, rng):
    assembly = assemble(load_scene(write_scene(tmp_path)), dtype=jnp.float64)
    model, body = assembly.model, assembly.body
    assert 0 < len(model.body) < len(body.vertices)
    local = Rotation.from_rotvec(0.5 * rng.normal(size=(2, 3))).as_matrix()
    m = transforms(model.skeleton, forward(model.skeleton, jnp.asarray(local), jnp.zeros(3)))
    whole = posed_by_loop(np.asarray(body.vertices, np.float64), body.weights, body.joints, [-1, 0], local)
    np.testing.assert_allclose(jax.jit(pose_body)(model, m), whole[assembly.prepared.part], atol=1e-6)  # weights are float32
    everywhere = skin(blend(m, blend_from(body.weights, dtype=jnp.float64)), jnp.asarray(body.vertices, jnp.float64))
    np.testing.assert_allclose(everywhere, whole, atol=1e-6)

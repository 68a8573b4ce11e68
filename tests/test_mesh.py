"""Topology, areas, rest frames and signed dihedral angles."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from ncs_jax.geometry.mesh import dihedral, material_axes, mesh_from, topology, vertex_rings

from .shapes import ball, bracket, equilateral, rotation, sheet, tube

SHAPES = {"sheet": sheet(), "tube": tube(), "ball": ball(1), "bracket": bracket()}


@pytest.mark.parametrize("name", SHAPES)
def test_topology_against_a_plain_loop(name):
    vertices, faces = SHAPES[name]
    edges, sides, hinges = topology(faces)
    owners: dict[tuple[int, int], list[int]] = {}
    for f, face in enumerate(faces.tolist()):
        for k in range(3):
            owners.setdefault(tuple(sorted((face[k], face[(k + 1) % 3]))), []).append(f)
    assert {tuple(sorted(e)) for e in edges.tolist()} == set(owners) and len(edges) == len(owners)
    for edge, pair in zip(edges.tolist(), sides.tolist(), strict=True):
        assert sorted(f for f in pair if f >= 0) == owners[tuple(sorted(edge))]
    inner = [tuple(sorted(e)) for e, s in zip(edges.tolist(), sides.tolist(), strict=True) if s[1] >= 0]
    assert [tuple(sorted(h[:2])) for h in hinges.tolist()] == inner
    for (a, b, c, d), pair in zip(hinges.tolist(), sides[sides[:, 1] >= 0].tolist(), strict=True):
        assert {a, b, c} == set(faces[pair[0]].tolist()) and {a, b, d} == set(faces[pair[1]].tolist())
    if name in ("ball", "bracket"):
        assert len(vertices) - len(edges) + len(faces) == 2  # Euler
    rings = vertex_rings(faces, len(vertices))
    for v, ring in enumerate(rings.tolist()):
        assert sorted(f for f in ring if f < len(faces)) == [f for f, face in enumerate(faces.tolist()) if v in face]


def test_a_fin_is_refused():
    with pytest.raises(ValueError, match=r"edge \[0, 1\] has 3 faces"):
        topology(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    with pytest.raises(ValueError, match="faces name vertices 0 to 3, the mesh has 3"):
        mesh_from(np.eye(3), np.array([[0, 1, 3]]))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_areas_are_true_areas(dtype):
    vertices, faces = sheet(4, 5, 0.01)
    mesh = mesh_from(vertices, faces, dtype=dtype)
    assert mesh.face_area.dtype == mesh.rest.dtype == mesh.hinge_angle.dtype == mesh.face_axes.dtype == dtype
    assert mesh.faces.dtype == mesh.edges.dtype == mesh.hinges.dtype == jnp.int32
    np.testing.assert_allclose(np.asarray(mesh.face_area), 0.5e-4, rtol=1e-6)
    np.testing.assert_allclose(float(jnp.sum(mesh.vertex_area)), 0.03 * 0.04, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.hinge_area), 0.5e-4, rtol=1e-6)
    sphere = mesh_from(*ball(3, 1.0), dtype=dtype)
    np.testing.assert_allclose(float(jnp.sum(sphere.face_area)), 4 * np.pi, rtol=0.02)


def test_spring_weights_are_one_inside_an_equilateral_mesh_and_half_on_its_border():
    vertices, faces = equilateral()
    mesh = mesh_from(vertices, faces, dtype=jnp.float64)
    inside = topology(faces)[1][:, 1] >= 0
    np.testing.assert_allclose(mesh.edge_weight[inside], 1, rtol=1e-12)
    np.testing.assert_allclose(mesh.edge_weight[~inside], 0.5, rtol=1e-12)


def hinge(angle, *, mirrored=False):
    """A hinge about x whose second face is turned up from flat by `angle`, a fold towards +z."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0.4, 1, 0], [0.6, -np.cos(angle), np.sin(angle)]]) * 5e-3
    return jnp.asarray(x * [1, 1, -1] if mirrored else x), jnp.full(2, 1.25e-5)


def fold(x, areas):
    return dihedral([[*corner] for corner in x], [*areas])


def test_mirrored_folds_have_opposite_angles():
    for angle in np.linspace(-3.1, 3.1, 41):
        phi = fold(*hinge(angle))
        np.testing.assert_allclose(jnp.abs(phi), abs(angle), atol=1e-14)
        np.testing.assert_array_equal(fold(*hinge(angle, mirrored=True)), -phi)
    assert fold(*hinge(0.5)) != fold(*hinge(-0.5))


def test_angle_of_a_hinge_is_the_same_from_either_face():
    x, areas = hinge(0.7)
    np.testing.assert_allclose(fold(x[jnp.array([1, 0, 3, 2])], areas), fold(x, areas), rtol=1e-14)


def test_angle_does_not_depend_on_place_turn_or_winding_of_the_rest(rng):
    x, areas = hinge(-1.3)
    turned = x @ rotation([1, 2, -1], 2.1).T + jnp.array([[3.0, -2.0, 5.0]])
    np.testing.assert_allclose(fold(turned, areas), fold(x, areas), rtol=1e-9)


def test_closed_convex_meshes_fold_one_way():
    mesh = mesh_from(*ball(2), dtype=jnp.float64)
    assert len({bool(s) for s in np.sign(mesh.hinge_angle) > 0}) == 1
    block = mesh_from(*bracket(), dtype=jnp.float64)
    angles = np.asarray(block.hinge_angle)
    folded = angles[np.abs(angles) > 1e-6]
    np.testing.assert_allclose(np.abs(folded), np.pi / 2, rtol=1e-9)
    concave = np.sign(folded) != np.sign(mesh.hinge_angle[0])
    assert concave.sum() == 1  # the one inner edge


def test_material_axes_follow_the_map_and_lie_in_the_faces(rng):
    vertices, faces = tube()
    uv = rng.normal(size=(len(vertices), 2))
    for options in ({}, {"warp": (1, 0.2, 0)}, {"uv": uv}):
        u = material_axes(vertices, faces, **options)
        p = vertices[faces]
        normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1, rtol=1e-12)
        np.testing.assert_allclose(np.sum(u * normal, axis=1), 0, atol=1e-15)
    np.testing.assert_array_equal(material_axes(vertices, faces, uv[faces]), u := material_axes(vertices, faces, uv))
    cut = uv[faces]
    cut[::2] = cut[::2][..., ::-1]  # every other face lies turned in a map of its own: a seam at each of its edges
    apart = material_axes(vertices, faces, cut)
    np.testing.assert_array_equal(apart[1::2], u[1::2])
    np.testing.assert_array_equal(apart[::2], material_axes(vertices, faces, uv[:, ::-1])[::2])
    # along the warp, moving on the cloth changes v and not u
    u = material_axes(vertices, faces, uv)
    for f, face in enumerate(faces):
        edges = np.stack([vertices[face[1]] - vertices[face[0]], vertices[face[2]] - vertices[face[0]]], axis=1)
        move = np.linalg.lstsq(edges, u[f], rcond=None)[0]
        du, dv = np.stack([uv[face[1]] - uv[face[0]], uv[face[2]] - uv[face[0]]], axis=1) @ move
        assert abs(du) < 1e-9 * abs(dv) and dv > 0


def test_material_axes_exist_for_every_normal(rng):
    """A face square to the warp, or to any axis, has a frame (the published ones are undefined for a normal of exactly +z)."""
    normals = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(20, 3))])
    for n in normals / np.linalg.norm(normals, axis=1, keepdims=True):
        e1 = np.cross(n, np.eye(3)[np.abs(n).argmin()])
        vertices = np.stack([np.zeros(3), e1, np.cross(n, e1)])
        mesh = mesh_from(vertices, np.array([[0, 1, 2]]), dtype=jnp.float64)
        edges = np.stack([vertices[1] - vertices[0], vertices[2] - vertices[0]])
        frame = np.asarray(mesh.face_axes[0]).T @ edges  # images of the axes at rest
        np.testing.assert_allclose(frame @ frame.T, np.eye(2), atol=1e-12)


def test_elements_without_area_weigh_nothing():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0], [0, 0, 0]]) * 0.01
    mesh = mesh_from(vertices, np.array([[0, 1, 2], [0, 3, 1], [2, 4, 0]]))
    assert mesh.face_area[1] == mesh.face_area[2] == 0 and not jnp.any(mesh.face_axes[1:])
    for part in (mesh.edge_weight, mesh.face_axes, mesh.hinge_angle, mesh.vertex_area):
        assert jnp.all(jnp.isfinite(part))

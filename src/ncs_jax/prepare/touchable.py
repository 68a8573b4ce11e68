"""The part of the body that a garment can touch."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import jax
import numpy as np

from ncs_jax import io
from ncs_jax.energies.contact.beside import Beside
from ncs_jax.energies.contact.layers import Upper
from ncs_jax.energies.contact.points import contact_points
from ncs_jax.energies.contact.surface import Surface, compact_groups, surface_from
from ncs_jax.geometry.enclosure import ENCLOSED, beside, enclosure, facing
from ncs_jax.geometry.skinning import Blend, blend_from, correctives_from
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.mesh.surface import boundary_loops
from ncs_jax.prepare.posing import carried, corrected_rest, joint_transforms
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Layer, Model, pose_body, pose_rest, resting_body

__all__ = [
    "bare_soles",
    "beside_of",
    "covered_by_layers",
    "submesh",
    "surface_of",
    "touchable",
    "touchable_faces",
    "touchable_part",
    "turned_away",
    "uppers_of",
]

SAMPLES = 64  # vertices of a garment, at least, of which the nearest to skin beside it tells where its inside is
FRAMES = 60  # poses that are looked at, at most


def touchable(body: io.BodyRecord, garment: np.ndarray, garment_blend: Blend, poses: np.ndarray, reach: float) -> np.ndarray:
    """Return which body vertices (body,) come within `reach` (m) of the skinned rest garment in any of the given poses.

    `poses` are axis-angle (frames, joints, 3). The rest pose is always checked too. Of a moving mesh its own frames are.
    """
    from scipy.spatial import cKDTree

    near = np.zeros(len(body.vertices), bool)
    for cloth, skin in _posed(body, garment, garment_blend, poses):
        near |= np.isfinite(cKDTree(cloth).query(skin, distance_upper_bound=reach)[0])
    return near


def _posed(body, garment: np.ndarray, garment_blend: Blend, poses: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield garment and skin (V, 3), m, at rest and in the poses; of a moving mesh in frames of its own."""
    if body.frames is not None and body.carriers is not None:
        for k in np.unique(np.linspace(0, len(body.frames) - 1, min(len(body.frames), FRAMES)).astype(int)):
            yield carried(garment, garment_blend, body.carriers[k]), body.frames[k]
        return
    body_blend = blend_from(body.weights)
    more = None if body.posedirs is None else correctives_from(body.posedirs)
    for transforms in joint_transforms(body, np.concatenate([np.zeros((1, len(body.parents), 3)), poses])):
        skin = carried(corrected_rest(body.vertices, more, transforms, body.parents), body_blend, transforms)
        yield carried(garment, garment_blend, transforms), skin


THROUGH, AWAY = 0.02, -0.2  # m; and cosine of skin's normal with the way to the nearest cloth


def turned_away(
    body: io.BodyRecord, garment: io.GarmentRecord, garment_blend: Blend, poses: np.ndarray, reach: float
) -> np.ndarray:
    """Return which body vertices (body,) are beside the garment and turn their back on it, over the poses in which it is near.

    An arm touches a garment of the trunk by its inner side. If cloth touched the outer side too, an arm that presses into the
    garment would push half of it out around itself, and never get free. What is in the garment at rest, or before an opening as
    a shin below a hem is, may be touched from all sides: see `enclosure.beside`.

    poses, reach: see `touchable`.
    """
    from scipy.spatial import cKDTree

    faced, seen = np.zeros(len(body.vertices)), np.zeros(len(body.vertices))
    side = facing(garment.vertices, garment.faces)
    for cloth, skin in _posed(body, garment.vertices, garment_blend, poses):
        distance, near = cKDTree(cloth).query(skin, distance_upper_bound=reach)
        some = np.flatnonzero(np.isfinite(distance) & (distance > THROUGH))
        way = cloth[near[some]] - skin[some]
        outside = np.sum(way * vertex_normals(cloth, garment.faces)[near[some]], axis=1) * side < 0
        cosine = np.sum(way * vertex_normals(skin, body.faces)[some], axis=1) / distance[some]
        faced[some[outside]] += cosine[outside]
        seen[some[outside]] += 1
    away = np.flatnonzero(faced < AWAY * seen)
    found = np.zeros(len(body.vertices), bool)
    found[away] = beside(body.vertices[away], garment.vertices, garment.faces)
    return found


SOLE, DOWN = 0.03, 0.5  # of the body's height; and cosine of a normal with what is down
COVER = 0.06  # m; a garment covers the skin that is nearer to it;
RIM = 0.1  # m; but one below none that is nearer to its rim


def touchable_faces(model: Model, body: io.BodyRecord, part: np.ndarray) -> np.ndarray:
    """Return the triangles of the touchable part of the body and of the garments below, all facing outward."""
    from scipy.spatial import cKDTree

    faces, count = [submesh(body.faces, part, len(body.vertices))], len(part)
    for layer in model.under:
        own, rest = np.asarray(layer.model.garment.mesh.faces), np.asarray(layer.rest)
        _, near = cKDTree(body.vertices).query(rest)
        outward = np.sum(vertex_normals(rest, own) * vertex_normals(body.vertices, body.faces)[near])
        faces.append(count + (own if outward >= 0 else own[:, ::-1]))
        count += len(rest)
    return np.concatenate(faces)


def covered_by_layers(body: io.BodyRecord, under: tuple[Layer, ...]) -> np.ndarray:
    """Return which body vertices (body,) a garment below covers: its nearest point is in front of them and not at its rim.

    The garment above does not touch these vertices, because there is cloth between. If they stayed, the skin would hold it off
    where it has passed through that cloth.
    """
    from scipy.spatial import cKDTree

    hidden, normals = np.zeros(len(body.vertices), bool), vertex_normals(body.vertices, body.faces)
    for layer in under:
        rest, faces = np.asarray(layer.rest), np.asarray(layer.model.garment.mesh.faces)
        away, near = cKDTree(rest).query(body.vertices)
        gap = rest[near] - body.vertices
        rim = rest[np.concatenate([*boundary_loops(faces), np.zeros(0, int)]).astype(int)]
        inner = np.ones(len(body.vertices), bool) if not len(rim) else cKDTree(rim).query(body.vertices)[0] > RIM
        hidden |= (away < COVER) & inner & (np.sum(gap * normals, axis=1) > 0.5 * away)
    return hidden


def surface_of(
    model: Model, faces, track: MotionFeatures | None, *, smooth: bool, pieces: np.ndarray, samples: int = 8
) -> Surface:
    """Return the touchable body as a surface, with its search prepared for what comes near in some poses of the motion.

    pieces: into how many contact cuts the edges of each triangle, none where all are whole, see `contact_detail`.
    """
    poses = []
    if track is not None:
        poses = list(zip(*map(np.asarray, _worn(model, track.matrices[_spread(track, samples)])), strict=True))
    rest, body = np.asarray(model.garment.mesh.rest), resting_body(model)
    points = contact_points(np.asarray(model.garment.mesh.faces), pieces) if pieces.size else None
    return surface_from(rest, body, faces, smooth=smooth, posed=poses, points=points)


def uppers_of(
    model: Model, firsts: Sequence[int], track: MotionFeatures | None, pieces: np.ndarray, samples: int = 8
) -> tuple[Upper, ...]:
    """Return the garments of one mesh that are over others of it, each with the surface of all those below.

    firsts: the first vertex of each, from the skin outwards, but for the innermost. pieces: see `surface_of`.
    """
    rest, faces = np.asarray(model.garment.mesh.rest), np.asarray(model.garment.mesh.faces)
    poses: Iterable[np.ndarray] = () if track is None else np.asarray(_worn(model, track.matrices[_spread(track, samples)])[0])
    found = []
    for first, stop in itertools.pairwise([*firsts, len(rest)]):
        own = (first <= faces[:, 0]) & (faces[:, 0] < stop)
        points = contact_points(faces[own] - first, pieces[own]) if pieces.size else None
        posed = [(x[first:stop], x[:first]) for x in poses]
        below = surface_from(rest[first:stop], rest[:first], faces[faces[:, 0] < first], posed=posed, points=points)
        found.append(Upper(below, int(first), int(stop)))
    return tuple(found)


def beside_of(model: Model) -> Beside | None:
    """Return the skin of the touchable body that is beside the garment; None where none is."""
    mesh = model.garment.mesh
    rest, faces = np.asarray(mesh.rest), np.asarray(mesh.faces)
    found = np.flatnonzero(beside(resting_body(model), rest, faces))
    if not len(found):
        return None
    some = np.sort(compact_groups(rest, max(1, len(rest) // SAMPLES))[:, 0])
    outward = facing(rest, faces) * vertex_normals(rest, faces)
    dtype, put = np.asarray(model.basis).dtype, jax.device_put  # from the host: nothing to compile
    weights = Blend(put(np.asarray(model.blend.weights)[some]), model.blend.joints)
    return Beside(put(found.astype(np.int32)), put(rest[some].astype(dtype)), put(outward[some].astype(dtype)), weights)


def _spread(track: MotionFeatures, samples: int) -> np.ndarray:
    """Return the numbers of some frames, spread evenly."""
    return np.unique(np.linspace(0, len(track.start) - 1, samples).astype(int))


@jax.jit
def _worn(model: Model, matrices) -> tuple[jax.Array, jax.Array]:
    """Return the rest garment, skinned, and the body in several frames, m."""
    return jax.vmap(lambda m: (pose_rest(model, m), pose_body(model, m)))(matrices)


def touchable_part(scene, body, garment, weights, records) -> np.ndarray:
    """Return the numbers of the body vertices that the garment can touch in the scene's motions.

    They come near it as the body alone carries it (`touchable`), or it surrounds them at rest (`enclosure`): a wide skirt
    stands off from the legs until it hangs. `bare_soles` are not among them, nor what is `turned_away`.
    """
    if scene.body.part == "all":
        return np.arange(len(body.vertices))
    poses = np.concatenate([r.poses for r in records]) if records else np.zeros((0, len(body.parents), 3), np.float32)
    some = poses[np.unique(np.linspace(0, len(poses) - 1, min(len(poses), FRAMES)).astype(int))] if len(poses) else poses
    # A point of a triangle is at most its longest edge / sqrt(3) from a corner.
    corners = body.vertices[body.faces]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max()
    reach = scene.physics.collision.reach + edge / np.sqrt(3)
    blend = blend_from(weights)
    near = touchable(body, garment.vertices, blend, some, reach)
    far = np.flatnonzero(~near)
    near[far] = np.abs(enclosure(body.vertices[far], garment.vertices, garment.faces)) > ENCLOSED
    untouched = bare_soles(body, garment.vertices) | turned_away(body, garment, blend, some, reach + edge)
    return np.setdiff1d(body.faces[near[body.faces].any(axis=1)], np.flatnonzero(untouched))


def bare_soles(body: io.BodyRecord, garment: np.ndarray) -> np.ndarray:
    """Return which vertices of a body (body,) are under its feet, with no cloth near them at rest, as a sock's is.

    They are in the lowest `SOLE` of its height and face down. A hem that comes down on a foot lies on it; but where its
    vertices are in the foot the sole may be nearest, and contact would push them under it, from where nothing brings them back.
    """
    from scipy.spatial import cKDTree

    height, normals = body.vertices[:, 1] - body.vertices[:, 1].min(), vertex_normals(body.vertices, body.faces)
    under = np.flatnonzero((height < SOLE * height.max()) & (normals[:, 1] < -DOWN))
    bare = np.zeros(len(body.vertices), bool)
    bare[under] = cKDTree(garment).query(body.vertices[under])[0] > COVER
    return bare


def submesh(faces: np.ndarray, kept: np.ndarray, verts: int) -> np.ndarray:
    """Return the triangles of the kept vertices, which are numbered anew."""
    number = np.full(verts, -1)
    number[kept] = np.arange(len(kept))
    inside = number[faces]
    return inside[(inside >= 0).all(axis=1)]

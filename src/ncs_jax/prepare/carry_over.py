"""A garment that was made for one body, carried over to another: part by part, then by the skin that it lies on.

Both bodies are told apart into the same parts by their joints: trunk, head with neck, and each bone of the limbs. Each part of
the source has an affine map to the target's,

    A(x) = p' + R (r I + (l - r) u u^T) (x - p),

with p and p' where the part begins, u its direction in the source, R the turn to its direction in the target, l and r the
ratios of length and girth. Blended by the skinning weights, the maps take the source's skin near the target's, in the target's
pose and proportions. What is left is found from skin to skin, smoothed, and spread over the cloth. Cloth that lies on the skin
keeps its distance from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import adjacency, topology
from ncs_jax.geometry.surface_distance import border_of, closest_on_surface, distance_and_direction
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.io.records import BodyRecord, GarmentRecord
from ncs_jax.prepare.joint_names import Limbs, anatomy
from ncs_jax.prepare.placement import Placement
from ncs_jax.prepare.posing import skinned
from ncs_jax.prepare.retarget import body_names
from ncs_jax.prepare.skeleton import body_axes, least_turn
from ncs_jax.prepare.skinning_weights import transfer_weights

__all__ = ["Carried", "carry_over", "spread_weights"]

BONES = {"arm": "forearm", "forearm": "hand", "hand": "", "thigh": "shin", "shin": "foot", "foot": "toe"}  # and where they end
NEEDED = ("left arm", "right arm", "left thigh", "right thigh")  # roles that both bodies must have
ROUNDS = (0.2, 0.1, 0.05, 0.03, 0.02, 0.02)  # m; over how much of the skin what it lacks is smoothed, round by round
ALIKE = 0.5  # least cosine between normals of skin that corresponds
LYING, SMOOTH = 0.02, 0.03  # m; see `spread_weights`
LEAST = 1e-6  # how much what lies far from the body counts
STRAINED = 0.5  # a garment of which a twentieth of the edges is strained by more was made for a body of another kind


@dataclass(frozen=True, eq=False)
class Carried:
    """A garment on another body, without weights, and the new length of every edge (E,) by its old one."""

    garment: GarmentRecord
    stretch: np.ndarray

    @property
    def size(self) -> float:
        """Return the median of the stretch: how much larger the garment became."""
        return float(np.median(self.stretch))

    @property
    def strain(self) -> np.ndarray:
        """Return how much every edge (E,) is strained beside that, |stretch / size - 1|."""
        return np.abs(self.stretch / self.size - 1)

    def check(self, file: str | Path, before: Placement, after: Placement) -> None:
        """Raise an InputError where it is strained too much, or is worn worse than on the body that it was made for.

        Args:
            file: the garment's. before, after: how it lies on the body that it was made for, and on the other.
        """
        high, doubt = float(np.percentile(self.strain, 95)), ""
        if high > STRAINED:
            doubt = f"a twentieth of its edges is strained by {100 * high:.0f} % or more"
        elif after.pierced and not before.pierced:
            doubt = f"bones pass through its cloth ({', '.join(after.pierced[:4])})"
        elif after.threaded < before.threaded - 0.01 or after.lying < before.lying / 2:
            doubt = f"the body passes through {100 * after.threaded:.0f} % of its openings, {100 * after.lying:.0f} % lie on it"
        if doubt:
            raise InputError(
                f"two bodies of one kind expected: {doubt}", file=file, field="vertices", value="as it was carried over",
                mend="look at the picture; see that it lies well on the body that it was made for, or drape it in a modeller",
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Parts:
    """A body's parts by the same names as another's.

    owner: the part of every joint. skin: that of every vertex. begin, end: where a part begins and ends, m; no end: unknown.
    """

    body: BodyRecord
    owner: list[str]
    skin: np.ndarray
    begin: dict[str, np.ndarray]
    end: dict[str, np.ndarray]

    def girth(self, part: str) -> float:
        """Return the mean distance of a part's skin from its axis, or from its beginning where it has no end, m."""
        x = self.body.vertices[self.skin == part] - self.begin[part]
        if part in self.end:
            axis = self.end[part] - self.begin[part]
            along = x @ axis / (axis @ axis)
            x = (x - along[:, None] * axis)[(along > 0) & (along < 1)]
        return float(np.linalg.norm(x, axis=1).mean()) if len(x) else 0.0


def carry_over(garment: GarmentRecord, source: BodyRecord, target: BodyRecord, file: str | Path = "") -> Carried:
    """Carry a garment from the body that it lies on to another, both at rest.

    Args:
        garment: at its place on the source, m. source, target: with joints whose names, or SMPL's tree, tell what they are.
        file: the source's, for errors.

    Raises:
        InputError: the joints' names do not tell both arms and both legs of both bodies.
    """
    x, edges = garment.vertices.astype(np.float64), topology(garment.faces)[0]
    skin, corners = source.vertices.astype(np.float64), source.faces
    maps, turns, ours, theirs = _maps(source, target, file)
    laid = _laid(skinned(skin, source.weights, maps), ours, theirs)
    away = distance_and_direction(x, skin, corners, border_of(corners, len(skin)))
    moved = skinned(x, spread_weights(garment, source, *away), maps)
    near = closest_on_surface(x, skin, corners)
    under, there, weights = (
        np.einsum("vk,vk...->v...", near.weights, values[corners[near.face]]) for values in (skin, laid, source.weights)
    )
    gap = x - under
    turned = np.einsum("vj,jab,vb->va", weights, turns, gap)
    turned *= (np.linalg.norm(gap, axis=1) / np.maximum(np.linalg.norm(turned, axis=1), 1e-9))[:, None]
    moved += spread(x, edges, lying_on(garment, *away), there + turned - moved)
    before, after = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (x, moved))
    placed = replace(garment, vertices=moved.astype(garment.vertices.dtype), weights=None, joint_names=(), scale=1.0, up="y")
    return Carried(placed, after / np.maximum(before, 1e-12))


# --- part by part ---------------------------------------------------------------------------------------------------


def _maps(source: BodyRecord, target: BodyRecord, file: str | Path) -> tuple[np.ndarray, np.ndarray, _Parts, _Parts]:
    """Return the affine map (J, 3, 4) and the turn R (J, 3, 3) of each joint of the source, and the parts of both bodies."""
    limbs = []
    for body, which in ((source, "the source, `--from`"), (target, "the target, `--body`")):
        names = body_names(body)
        found = anatomy(names, body.parents.tolist(), body.joints) if names else Limbs({}, (), ())
        if missing := [role for role in NEEDED if role not in found.roles]:
            raise InputError(
                "two bodies whose joints' names tell arms and legs expected", file=file, field="joint_names",
                value=f"no {missing[0]} in {which}: {', '.join(names[:4]) or 'no names'}",
                mend="name the joints as a common rig does, or drape the garment on this body in a modeller",
            )  # fmt: skip
        limbs.append(found)
    shared = limbs[0].roles.keys() & limbs[1].roles.keys()
    ours, theirs = (_parts(body, of, shared) for body, of in zip((source, target), limbs, strict=True))
    turns = {"": body_axes(target.joints, limbs[1]) @ body_axes(source.joints, limbs[0]).T}
    maps = {}
    for part in ours.begin:  # from the trunk outward
        side, _, bone = part.partition(" ")
        above = next((f"{side} {a}" for a, b in BONES.items() if b == bone and f"{side} {a}" in turns), "")
        turn, length = turns[above], 0.0
        girth = theirs.girth(part) / ours.girth(part) if ours.girth(part) > 0 and theirs.girth(part) > 0 else 0.0
        axis = np.zeros(3)
        if part in ours.end and part in theirs.end:
            axis, wanted = ours.end[part] - ours.begin[part], theirs.end[part] - theirs.begin[part]
            length = float(np.linalg.norm(wanted) / np.linalg.norm(axis))
            turn, axis = least_turn(turn @ axis, wanted) @ turn, axis / np.linalg.norm(axis)
        girth = girth or length or 1.0
        linear = turn @ (girth * np.eye(3) + (length - girth) * np.outer(axis, axis))
        turns[part] = turn
        maps[part] = np.column_stack([linear, theirs.begin[part] - linear @ ours.begin[part]])
    owner = ours.owner
    return np.stack([maps[p] for p in owner]), np.stack([turns[p] for p in owner]), ours, theirs


def _parts(body: BodyRecord, of: Limbs, shared: set[str]) -> _Parts:
    """Tell a body apart into trunk, head and bones of the limbs whose roles are `shared` with the other body."""
    at = {role: body.joints[j].astype(np.float64) for role, j in of.roles.items() if role in shared}
    hips, chest = ((at[f"left {role}"] + at[f"right {role}"]) / 2 for role in ("thigh", "arm"))
    roots = {of.roles["hips"]: "trunk"}
    begin, end = {"trunk": hips}, {"trunk": chest}
    for side in ("left", "right"):
        for bone, tip in BONES.items():
            part = f"{side} {bone}"
            if part in at:
                roots[of.roles[part]], begin[part] = part, at[part]
                if f"{side} {tip}" in at:
                    end[part] = at[f"{side} {tip}"]
    if "head" in at:
        roots[(*of.neck, of.roles["head"])[0]] = "head"
    owner: list[str] = []
    for j, parent in enumerate(body.parents.tolist()):  # parents come first
        owner.append(roots.get(j, owner[parent] if parent >= 0 else "trunk"))
    skin = np.array(owner)[body.weights.argmax(axis=1)]
    if "head" in at:
        up = (chest - hips) / np.linalg.norm(chest - hips)
        high = ((body.vertices[skin == "head"] - chest) @ up).max(initial=0.0)
        begin["head"] = chest
        end |= {"head": chest + high * up} if high > 0 else {}
    return _Parts(body, owner, skin, begin, end)


# --- skin to skin ---------------------------------------------------------------------------------------------------


def _laid(x: np.ndarray, ours: _Parts, theirs: _Parts) -> np.ndarray:
    """Return the source's skin (V, 3), brought near the target's, laid onto it.

    Each round moves it to the nearest skin of the same part whose normal agrees, by what is lacking, smoothed over the skin.
    """
    faces, target = ours.body.faces, theirs.body
    edges = topology(faces)[0]
    corners = target.vertices[target.faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    part = theirs.skin[target.faces[:, 0]]
    for smooth in ROUNDS:
        near = closest_on_surface(x, target.vertices, target.faces)
        alike = np.sum(vertex_normals(x, faces) * normals[near.face], axis=1)
        trust = np.where((part[near.face] == ours.skin) & (alike > ALIKE), alike, 0.0)
        x = x + spread(x, edges, trust, -near.gap, smooth)
    return x


# --- over the cloth -------------------------------------------------------------------------------------------------


def spread_weights(garment: GarmentRecord, body: BodyRecord, distance: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Return smooth skinning weights (V, J) that follow the body where cloth lies on it.

        min_w  sum_v c_v (w_v - w_body(v))^2 + (L / l)^2 sum_(edges v-u) (w_v - w_u)^2,
        c_v = exp(-(d / L0)^2) max(n . n_body, 0)

    d is the distance to the body (m), l the mean edge, L = `SMOOTH` and L0 = `LYING`. So cloth that hangs free between the legs
    follows the cloth that it hangs on, and is not torn to either side. Weights are 0 to 1 and sum to 1, because the inverse of
    the system's matrix is positive. Source: the matching of Abdrashitov et al. 2023, with a smooth c_v instead of a threshold.
    """
    edges = topology(garment.faces)[0]
    own = transfer_weights(garment.vertices, body.vertices, body.faces, body.weights)
    trust = lying_on(garment, distance, away)
    weights = np.maximum(spread(garment.vertices, edges, trust, own), 0)
    return weights / weights.sum(axis=1, keepdims=True)


def lying_on(garment: GarmentRecord, distance: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Return how much each vertex (V,) lies on the body, c of `spread_weights`, from 0 to 1."""
    facing = np.maximum(np.sum(vertex_normals(garment.vertices, garment.faces) * away, axis=1), 0)
    return np.exp(-((np.maximum(distance, 0) / LYING) ** 2)) * facing


def spread(x: np.ndarray, edges: np.ndarray, trust: np.ndarray, values: np.ndarray, smooth: float = SMOOTH) -> np.ndarray:
    """Return values (V, K) of a surface's vertices, smoothed, so that those of little `trust` (V,) follow those around them.

        min_u  sum_v c_v (u_v - value_v)^2 + (L / l)^2 sum_(edges v-w) (u_v - u_w)^2,

    with c the trust, l the mean edge and L the length to smooth over, m.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    graph, trust = adjacency(edges, len(x)), trust + LEAST
    stiff = (smooth / np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1).mean()) ** 2
    system = diags_array(trust) + stiff * (diags_array(graph.sum(axis=1)) - graph)
    return splu(system.tocsc()).solve(trust[:, None] * values)

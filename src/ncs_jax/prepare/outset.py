"""Where a training begins: outside of the body, also where skinning alone lets a limb through the garment."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.geometry.enclosure import ENCLOSED, enclosure
from ncs_jax.geometry.skinning import blend, skin
from ncs_jax.io.mesh.normals import vertex_normals
from ncs_jax.prepare.skinning_weights import hanging
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body, resting_body

__all__ = ["exposed", "outset"]

FRAMES = 256  # poses that are looked at, at most
SKIN = 600  # points of the skin, at most
WIDER = (0.025, 0.05, 0.075, 0.1, 0.15)  # m, by which a garment is made wider until no limb is out, and no more than the last
ROOM = 0.03  # m, beyond that
WITHIN = 0.4  # of a full turn: what the garment surrounds by so much at rest is not at its rim
OUT = 0.003  # of the skin: as much may stand out, which contact pushes back


def outset(model: Model, track: MotionFeatures, drape: Float[Array, "verts 3"] | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Return frames (F,) and offsets (F, verts, 3), m, unposed, that take the garment outside of limbs; None where none is out.

    A dress follows hips and thighs; in a squat, skinning alone puts the knees through its front, by 7 cm and more. Contact,
    which pushes each vertex to the nearest skin, then keeps them there, and the front hangs from them to the floor. So in such
    a pose all cloth that hangs free begins farther out, and comes to lie on the knees:

        offset_v = drape_v + (A + `ROOM`) h_v n_v,   A the least of `WIDER` with which no skin is out,

    h_v how freely the vertex hangs (`skinning_weights.hanging`), n_v the drape's normal, away from the skin. Skin is out that
    the garment surrounds at rest (`enclosure`), beside cloth that hangs, and surrounds no more in the pose (`exposed`): a hand
    outside of a skirt is to stay there.

    Args:
        model: with a body that can be touched, or None is returned. track: of the training. drape: where it begins, else rest.
    """
    if model.body is None or model.surface is None:
        return None
    rest, faces = np.asarray(model.garment.mesh.rest), np.asarray(model.garment.mesh.faces)
    begun = rest if drape is None else rest + np.asarray(drape)
    body = resting_body(model)
    free, outward = hanging(rest, body, np.asarray(model.surface.faces))
    own = _own_skin(body, rest, begun, faces, free)
    if not len(own):
        return None
    along = vertex_normals(begun, faces)
    along = (free * np.sign(np.sum(along * outward)))[:, None] * along
    frames = np.unique(np.linspace(0, len(track.start) - 1, FRAMES).astype(int))
    wider, matrices, left = np.zeros(len(frames)), track.matrices[frames], np.arange(len(frames))
    for next_wider in WIDER:
        x, body = map(np.asarray, _posed(model, (begun + wider[left[0]] * along).astype(rest.dtype), matrices))
        left = left[[exposed(body[k, own], x[k], faces) > OUT for k in left]]
        if not len(left):
            break
        wider[left] = next_wider
    if not wider.any():
        return None
    wider[wider > 0] += ROOM
    return frames, (begun - rest + wider[:, None, None] * along).astype(rest.dtype)


def exposed(skin: np.ndarray, x: np.ndarray, faces: np.ndarray) -> float:
    """Return the share of skin (points, 3) that a garment (verts, 3) does not surround, m."""
    return float(np.mean(enclosure(skin, x, faces) < ENCLOSED))


def _own_skin(body: np.ndarray, rest: np.ndarray, begun: np.ndarray, faces: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the numbers of the skin's points that a garment is to hold within: surrounded, beside cloth that hangs free."""
    from scipy.spatial import cKDTree

    if not free.any():
        return np.zeros(0, int)
    beside = np.flatnonzero(free[cKDTree(rest).query(body)[1]] > 0)
    within = [enclosure(body[beside], x, faces) for x in (rest, begun)]
    own = beside[(within[0] > ENCLOSED) & (within[1] > WITHIN)]
    return own[:: -(-len(own) // SKIN) or 1]


@jax.jit
def _posed(model: Model, garment: Array, matrices: Float[Array, "frames joints 3 4"]) -> tuple[Array, Array]:
    """Return a garment, as the body alone carries it, and the body, in several frames, m."""
    return jax.lax.map(lambda at: (skin(blend(at, model.blend), garment), pose_body(model, at)), matrices)

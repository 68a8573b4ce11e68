"""A motion as the network and the energies read it: computed once, frame by frame, and then only looked up."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ncs_jax.geometry.skinning import forward, transforms
from ncs_jax.scene import descriptors
from ncs_jax.scene.descriptors import Joints
from ncs_jax.scene.model import Model

__all__ = ["MotionFeatures", "input_joints", "mirror", "motion_features"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class MotionFeatures:
    """Motions laid end to end. `start` is the first frame of the motion that a frame belongs to.

    Before its first frame a character is taken to have stood there at rest. `bodies` are what `training.loss.with_bodies` adds.
    A motion that begins far from the world's origin is measured from an `origin` of its own, so that single precision is as
    fine there as here; None: all are measured from the world's.
    """

    static: Float[Array, "frames joints numbers"]
    dynamic: Float[Array, "frames joints rates"]
    matrices: Float[Array, "frames all 3 4"]
    start: Int[Array, "frames"]
    bodies: Float[Array, "frames body 6"] | None = None  # positions in m and normals of the touchable body
    origin: Float[Array, "frames 3"] | None = None  # m
    swing: Float[Array, "frames modes"] | None = None  # of the garment, see `methods.swing`

    def __repr__(self) -> str:
        """Return in a line how many frames, joints and motions there are, and which frames are of which motion."""
        start = self.start
        if isinstance(start, jax.core.Tracer) or not isinstance(start, jax.Array | np.ndarray) or start.ndim != 1:
            return f"MotionFeatures(start={start})"
        first = np.unique(start)
        spans = [f"{a} to {b - 1}" for a, b in zip(first, [*first[1:], len(start)], strict=True)]
        shown = ", ".join(spans if len(spans) <= 6 else [*spans[:5], "...", spans[-1]])
        return f"MotionFeatures({len(start)} frames, {self.matrices.shape[-3]} joints, {len(spans)} motions: frames {shown})"

    def middle(self) -> int:
        """Return the frame whose pose, by the static descriptors, is nearest to the mean of all frames."""
        poses = np.asarray(self.static, np.float64)
        return int(np.square(poses - poses.mean(axis=0)).sum(axis=(1, 2)).argmin())

    def absolute(self, x: Float[Array, "frames verts 3"]) -> Float[Array, "frames verts 3"]:
        """Return positions measured from the track's origin, in the world, m."""
        return x if self.origin is None else x + self.origin[:, None]

    def relative(self, x: Float[Array | np.ndarray, "frames verts 3"]) -> np.ndarray:
        """Return world positions (frames, verts, 3), m, measured from the motion's own origin, as NumPy."""
        return np.asarray(x) if self.origin is None else np.asarray(x) - np.asarray(self.origin)[: len(x), None]


def input_joints(model: Model, local: Float[Array, "joints 3 3"], pose) -> Joints:
    """Return the joints that the network reads."""
    inputs = np.asarray(model.inputs)
    return Joints(local[inputs], pose.rotations[inputs], pose.positions[inputs])


@jax.jit
def motion_features(
    model: Model,
    local: Float[Array, "frames joints 3 3"],
    translation: Float[Array, "frames 3"],
    start: Int[Array, "frames"],
) -> MotionFeatures:
    """Return descriptors and joint transforms of motions laid end to end, sampled at the model's frame rate.

    Args:
        local: local rotations of the model's joints since rest. translation: of the root, m. start: first frame of the motion
            that each frame belongs to.
    """
    pose = forward(model.skeleton, local, translation)
    joints = jax.vmap(lambda r, p: input_joints(model, r, p))(local, pose)
    earlier = [jnp.maximum(jnp.arange(local.shape[0], dtype=start.dtype) - k, start) for k in (1, 2)]
    previous, before = (jax.tree.map(lambda a, k=k: a[k], joints) for k in earlier)
    g = model.material.gravity
    static = jax.vmap(lambda j: descriptors.static(j, g, model.descriptor))(joints)
    dynamic = jax.vmap(lambda j, p, b: descriptors.dynamic(j, p, b, g, 1 / model.fps, model.descriptor))(
        joints, previous, before
    )
    return MotionFeatures(static, dynamic, transforms(model.skeleton, pose), start)


def mirror(
    poses: np.ndarray, translation: np.ndarray, partner: np.ndarray, axis: int = 0, axes: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion in a mirror across the character's middle: a new one, the given one is left as it is.

    Args:
        poses: (frames, joints, 3) axis-angle. translation: (frames, 3) m. partner: (joints,) the joint on the other side, or
            itself. axis: the axis from left to right. An axis-angle vector is a pseudovector: its component along the mirror's
            normal keeps its sign and the others change theirs. axes: (joints, 3, 3) the axes of each joint at rest that its
            pose is written in; None where they are the world's.
    """
    sign = -np.ones(3, poses.dtype)
    sign[axis] = 1
    if axes is None:
        return poses[:, partner] * sign, translation * -sign
    world = np.einsum("jab,tjb->tja", axes, poses)[:, partner] * sign
    return np.einsum("jba,tjb->tja", axes, world).astype(poses.dtype), translation * -sign

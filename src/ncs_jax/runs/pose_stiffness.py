"""How stiff a garment is along its vibrations in every pose: found in some about what a network has learned, and fitted."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ncs_jax.errors import required
from ncs_jax.network.methods.method import decode
from ncs_jax.network.methods.swing import Swing
from ncs_jax.prepare.build import Assembly, swing_range
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, RitzModes
from ncs_jax.simulation.ritz_modes import displacement_slopes, stiffness_in_poses

__all__ = ["find_stiffness", "learn_pose_stiffness", "poses_of"]

MOST = 128  # poses: by then the map explains 3 quarters of what differs between a skirt's
FEWEST = 16  # poses that a map is fitted to
STEPS = 64  # of training for each pose, so that they take about a twentieth of its time
SHARE = 4  # times as much of a short training may go into `FEWEST`; a shorter one leaves it out
ALIKE = 1e-4  # of their size: descriptors that differ by less are of one pose, as of a body that only turns about gravity
RIDGES = 10.0 ** np.arange(-4, 3)  # of the mean square of the descriptors


def poses_of(steps: int) -> int:
    """Return in how many poses a training of so many steps looks, twice."""
    return min(MOST, max(FEWEST, steps // STEPS)) if SHARE * steps >= FEWEST * STEPS else 0


def learn_pose_stiffness(assembly: Assembly, params: dict, track: MotionFeatures, steps: int, seed: int) -> Assembly:
    """Return a garment whose swing knows how stiff the garment is in a pose, as the network now has the garment.

    K is found by `stiffness_in_poses` in some poses of the training, see `poses_of`; its Cholesky factor is fitted by ridge
    regression on the poses' descriptors, the ridge chosen by leaving each pose out, for `methods.swing.stiffness`. Between what
    was found in the poses it is bounded. What bounds a swing is found anew with it. A network that does not swing, and a
    training too short for that, leave all as it is.
    """
    network, model = assembly.network, assembly.model
    count = min(poses_of(steps), len(track.start))
    if not isinstance(network, Swing) or count < FEWEST or required(model.vibrations, "vibrations").by_pose is None:
        return assembly
    frames = np.sort(np.random.default_rng([seed, 2]).permutation(len(track.start))[:count])
    vibrations = required(model.vibrations, "model.vibrations")
    found = find_stiffness(network, params, model, track, frames) / float(vibrations.energy)
    by_pose = fitted(np.asarray(track.static[frames], np.float64).reshape(count, -1), found)
    if by_pose is None:
        return assembly
    dtype = model.basis.dtype
    alone = displacement_slopes(model.garment.mesh, np.asarray(vibrations.directions))
    vibrations = replace(vibrations, by_pose=jnp.asarray(by_pose, dtype), slope=jnp.asarray(alone, dtype))
    slope = swing_range(network, params, replace(model, vibrations=vibrations), track)
    return with_vibrations(assembly, replace(vibrations, slope=jnp.asarray(slope, dtype)))


def find_stiffness(network: Swing, params: dict, model: Model, track: MotionFeatures, frames: np.ndarray) -> np.ndarray:
    """Return K (frames, modes, modes) of some frames about the network's static garment, J."""
    return stiffness_in_poses(model, track.matrices[frames], _static_offsets(network, params, model, track.static[frames]))


def with_vibrations(assembly: Assembly, vibrations: RitzModes) -> Assembly:
    """Return the garment with these vibrations, and what is kept with its run."""
    kept = {"slope": np.asarray(vibrations.slope), "by_pose": np.asarray(vibrations.by_pose)}
    return replace(
        assembly,
        model=replace(assembly.model, vibrations=vibrations),
        prepared=replace(assembly.prepared, **kept),
    )


def fitted(
    descriptors: Float[np.ndarray, "poses numbers"], stiffness: Float[np.ndarray, "poses modes modes"]
) -> Float[np.ndarray, "rows entries"] | None:
    """Return the map of `RitzModes.by_pose` that ridge regression gives; None where no `FEWEST` of them are definite.

    In poses that are all `ALIKE` the garment is as stiff as it is on average: what differs then is rounding.
    """
    good = np.isfinite(stiffness).all(axis=(1, 2))
    good[good] = np.linalg.eigvalsh(stiffness[good])[:, 0] > 0
    if good.sum() < FEWEST:
        return None
    row, column = np.tril_indices(stiffness.shape[1])
    factor = np.linalg.cholesky(stiffness[good])[:, row, column]
    entries = np.where(row == column, np.log(np.where(row == column, factor, 1)), factor)
    d, y = descriptors[good], entries - entries.mean(axis=0)
    middle = d.mean(axis=0)
    d = d - middle
    gram = d @ d.T
    scale = float(np.trace(gram)) / len(gram)
    if scale <= ALIKE**2 * np.mean(np.sum(descriptors[good] ** 2, axis=1)):
        slopes = np.zeros((d.shape[1], y.shape[1]))
        return np.vstack([slopes, entries.mean(axis=0), entries.min(axis=0), entries.max(axis=0)])

    def left_out(ridge: float) -> float:
        """The square of what each pose's entries differ from by what the others tell of them."""
        hat = gram @ np.linalg.inv(gram + ridge * scale * np.eye(len(gram)))
        return float(np.sum(((y - hat @ y) / (1 - np.diag(hat))[:, None]) ** 2))

    ridge = min(RIDGES, key=left_out)
    slopes = d.T @ np.linalg.solve(gram + ridge * scale * np.eye(len(gram)), y)
    constant = entries.mean(axis=0) - middle @ slopes
    return np.vstack([slopes, constant, entries.min(axis=0), entries.max(axis=0)])


@partial(jax.jit, static_argnums=0)
def _static_offsets(network: Swing, params: dict, model: Model, static: Array) -> Float[Array, "verts 3 poses"]:
    """Return the offsets of the static garment, m."""
    return decode(network, params, model, jnp.asarray(network.static.apply({"params": params["static"]}, static)))

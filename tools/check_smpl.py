"""Compare the package's shaped and posed body with the model's own formula, on model files of SMPL, SMPL-H and SMPL-X.

    python -m tools.check_smpl SMPL_NEUTRAL.npz SMPLX_NEUTRAL.npz

Prints the largest distance for random shapes and poses in float64: with all skinning weights, and with the eight largest of a
vertex, which scenes keep. Ends with 1 where the first is above a micrometre. The files are not in the repository: their licence
keeps them out.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.spatial.transform import Rotation

from ncs_jax import io

__all__ = ["formula", "packages"]

SAMPLES = 4


def formula(fields: dict, betas, pose: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Posed vertices (V, 3), m, by Loper et al. 2015, (2)-(10), in plain loops.

    Args:
        fields: arrays of a model file, `J_regressor` dense. betas: shape. pose: (J, 3) axis times angle. translation: (3,) m.
    """
    rows = fields["kintree_table"][0].astype(np.int64)
    joints, shape = len(rows), np.asarray(betas, np.float64)
    directions = fields["posedirs"].T if len(fields["posedirs"]) == 9 * (joints - 1) else fields["posedirs"]
    x = fields["v_template"] + fields["shapedirs"][:, :, : len(shape)] @ shape
    places = fields["J_regressor"] @ x
    turns = Rotation.from_rotvec(pose).as_matrix()
    x = x + directions.reshape(len(x), 3, -1) @ (turns[1:] - np.eye(3)).reshape(-1)
    world, out = np.zeros((joints, 4, 4)), np.zeros_like(x)
    for j in range(joints):
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = turns[j], places[j] - (places[rows[j]] if j else 0)
        world[j] = world[rows[j]] @ own if j else own
        out += fields["weights"][:, j, None] * ((x - places[j]) @ world[j, :3, :3].T + world[j, :3, 3])
    return out + translation


def packages(body: io.BodyRecord, pose: np.ndarray, translation: np.ndarray, most: int = 8) -> np.ndarray:
    """Return the same by the package's own functions, with `most` weights a vertex; float64 needs JAX's x64 mode."""
    import jax.numpy as jnp

    from ncs_jax.geometry import skinning as s
    from ncs_jax.geometry.rotations import axis_angle_to_matrix

    skeleton = s.Skeleton(jnp.asarray(body.joints, jnp.float64), tuple(body.parents.tolist()))
    m = s.transforms(skeleton, s.forward(skeleton, axis_angle_to_matrix(jnp.asarray(pose)), jnp.asarray(translation)))
    more = None if body.posedirs is None else s.correctives_from(body.posedirs, dtype=jnp.float64)
    x = s.corrected(jnp.asarray(body.vertices, jnp.float64), more, m, skeleton.parents)
    return np.asarray(s.skin(s.blend(m, s.blend_from(body.weights, most, dtype=jnp.float64)), x))


def main(paths: list[str]) -> int:
    import jax

    jax.config.update("jax_enable_x64", True)
    rng, worst = np.random.default_rng(0), 0.0
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            wanted = ("v_template", "weights", "kintree_table", "J_regressor", "shapedirs", "posedirs")
            fields = {name: file[name].astype(np.float64) for name in wanted}
        away = np.zeros(2)
        for _ in range(SAMPLES):
            betas, translation = rng.normal(size=10), rng.normal(size=3)
            pose = 0.4 * rng.normal(size=(fields["weights"].shape[1], 3))
            body, right = io.read_body(path, betas=betas.tolist()), formula(fields, betas, pose, translation)
            found = [packages(body, pose, translation, most) for most in (len(pose), 8)]
            away = np.maximum(away, [np.linalg.norm(x - right, axis=1).max() for x in found])
        print(f"{path}: {away[0]:.2g} m at most, with eight weights {away[1]:.2g} m; {SAMPLES} shapes and poses")
        worst = max(worst, away[0])
    return int(worst > 1e-6)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

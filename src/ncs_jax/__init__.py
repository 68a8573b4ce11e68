"""Neural cloth simulation in JAX: a garment learns to move on an animated character from the physics energy alone."""

from ncs_jax.assembly import Assembly, assemble
from ncs_jax.errors import InputError
from ncs_jax.evaluation import measure, summarise
from ncs_jax.model import Model, local_rotations
from ncs_jax.objective import Frame, Garment, Material, Terms, energies, total
from ncs_jax.rollout import animate, stepper
from ncs_jax.runs import Report, Run, load_run, train
from ncs_jax.scene import Scene, load_scene, scene_from
from ncs_jax.simulation import Trajectory, simulate

__all__ = [
    "Assembly",
    "Frame",
    "Garment",
    "InputError",
    "Material",
    "Model",
    "Report",
    "Run",
    "Scene",
    "Terms",
    "Trajectory",
    "animate",
    "assemble",
    "energies",
    "load_run",
    "load_scene",
    "local_rotations",
    "measure",
    "scene_from",
    "simulate",
    "stepper",
    "summarise",
    "total",
    "train",
]

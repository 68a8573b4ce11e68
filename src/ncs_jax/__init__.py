"""Neural cloth simulation in JAX: a garment learns to move on an animated character from the physics energy alone."""

from ncs_jax.energies.terms import Garment, Material, StepInputs, Terms
from ncs_jax.energies.total import energies, total
from ncs_jax.errors import InputError
from ncs_jax.metrics.quality import measure, summarise
from ncs_jax.network.rollout import animate, stepper
from ncs_jax.prepare.build import Assembly
from ncs_jax.runs.log import Report
from ncs_jax.runs.run import Run, assemble, load_run
from ncs_jax.runs.simulate import Trajectory, simulate
from ncs_jax.runs.train import train
from ncs_jax.scene.model import Model, local_rotations
from ncs_jax.scene.spec import Scene, load_scene, scene_from

Frame = StepInputs  # its name until version 0.1

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
    "StepInputs",
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

"""Neural cloth simulation in JAX: a garment learns to move on an animated character from the physics energy alone."""

import importlib
import sys
import types
from importlib import metadata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ncs_jax.energies.terms import Garment, Material, StepInputs, Terms
    from ncs_jax.energies.total import energy_terms, total
    from ncs_jax.errors import InputError
    from ncs_jax.metrics.quality import measure, summarise
    from ncs_jax.network.rollout import animate, stepper
    from ncs_jax.prepare.build import Assembly
    from ncs_jax.runs.adapt import Adapted, adapt
    from ncs_jax.runs.log import Report
    from ncs_jax.runs.run import Run, assemble, load_run
    from ncs_jax.runs.simulate import Trajectory, simulate
    from ncs_jax.runs.train import train
    from ncs_jax.scene.model import Model, local_rotations
    from ncs_jax.scene.spec import Scene, load_scene, scene_from
    from ncs_jax.scene.step_inputs import frame_inputs

__all__ = [
    "Adapted",
    "Assembly",
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
    "adapt",
    "animate",
    "assemble",
    "energy_terms",
    "frame_inputs",
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

# The same names by the module that each is imported from when it is first read: JAX alone takes a second to import.
_HOMES = {
    "energies.terms": ("Garment", "Material", "StepInputs", "Terms"),
    "energies.total": ("energy_terms", "total"),
    "errors": ("InputError",),
    "metrics.quality": ("measure", "summarise"),
    "network.rollout": ("animate", "stepper"),
    "prepare.build": ("Assembly",),
    "runs.adapt": ("Adapted", "adapt"),
    "runs.log": ("Report",),
    "runs.run": ("Run", "assemble", "load_run"),
    "runs.simulate": ("Trajectory", "simulate"),
    "runs.train": ("train",),
    "scene.model": ("Model", "local_rotations"),
    "scene.spec": ("Scene", "load_scene", "scene_from"),
    "scene.step_inputs": ("frame_inputs",),
}
_HOME = {name: f"{__name__}.{home}" for home, names in _HOMES.items() for name in names}


class _Face(types.ModuleType):
    """The package itself, whose names are imported when they are first read."""

    def __getattr__(self, name: str):
        if name == "__version__":
            return metadata.version("ncs-jax")
        if name not in _HOME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(_HOME[name]), name)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *__all__})


sys.modules[__name__].__class__ = _Face

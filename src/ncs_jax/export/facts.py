"""What a host has to know of a written file: in FILE.json, and in an ONNX model's metadata under `ncs_jax`."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.export.stablehlo import expiry
from ncs_jax.export.step import Step
from ncs_jax.io.mesh.joined import garment_names
from ncs_jax.prepare.build import Assembly

__all__ = ["FORMATS", "PAGES", "FileFormat", "host_facts"]

FORMATS = {"onnx": (".onnx",), "stablehlo": ("", ".stablehlo")}  # and how a file's name may end
PAGES = {"web": (".html", ".htm")}  # what `ncs export` writes besides, see `view.living`
INTERFACE = 1  # of the step and the facts: a change that breaks a host gives the next number


@dataclass(frozen=True)
class FileFormat:
    """The form in which a step is written.

    Attributes:
        name: one of `FORMATS`. float16: store the network's matrices in 16 bits; they are widened when loaded, and the
            arithmetic is float32. opset: of the ONNX operators.

    Raises:
        InputError: the format is unknown.
    """

    name: str = "onnx"
    float16: bool = False
    opset: int = 15

    def __post_init__(self) -> None:
        """Check the name."""
        if self.name not in FORMATS:
            raise InputError(f"one of {', '.join(FORMATS)} expected", field="--format", value=self.name)

    def check_name(self, file: Path) -> None:
        """Raise an InputError where a file's name ends otherwise than this format's do."""
        endings, found = FORMATS[self.name], file.suffix.lower()
        if found not in endings:
            other = next((name for name, theirs in (FORMATS | PAGES).items() if found in theirs), None)
            mend = f"add --format {other}" if other else f"end the name in {endings[-1]}"
            raise InputError(f"a name in {endings[-1]} expected for {self.name}", file=file, value=found, mend=mend)


def host_facts(assembly: Assembly, step: Step, file: Path, format: FileFormat) -> dict:
    """Return what a host has to know of a step in a file, as JSON has it."""
    model, body, verts = assembly.model, assembly.body, len(assembly.garment.vertices)
    names = body.joint_names if body is not None else ()
    alpha = "0 is static, 1 as trained; more exaggerates, the further the less sure" if assembly.network.controlled else "idle"
    meaning = {
        "state": "zeros at a motion's start, else next_state of the frame before",
        "rotations": "local rotations of the joints below, in this order, as the body's motions have them; columns are axes",
        "translation": "of the root from where it rests, m",
        "alpha": alpha,
    }
    return {
        "file": file.name,
        "format": f"onnx, opset {format.opset}" if format.name == "onnx" else format.name,
        "interface": INTERFACE,
        "written_by": f"ncs-jax {version('ncs-jax')}, jax {jax.__version__}",
        **(expiry(jax.__version__, date.today()) if format.name == "stablehlo" else {}),
        "fps": float(model.fps),
        "vertices": verts,
        **_worn_together(assembly),
        "units": "metres, rotation matrices, float32",
        "axes": "right-handed, those of the body file: a host with left-handed ones mirrors what goes in and what comes out",
        "gravity": np.asarray(model.material.gravity, np.float64).round(6).tolist(),
        "weights": "float16, computed in float32" if format.float16 else "float32",
        "alpha": {"from": 0.0, "trained": 1.0} if assembly.network.controlled else None,
        "inputs": {name: {"shape": list(shape), "what": meaning[name]} for name, shape in step.arguments.items()},
        "outputs": {
            "next_state": {"shape": list(step.arguments["state"]), "what": "the state of the next frame"},
            "vertices": {"shape": [verts, 3], "what": "in the garment file's order, m"},
        },
        "joints": [
            {
                "name": names[source] if names else str(source),
                "number": int(source),
                "parent": parent,
                "rest": np.asarray(rest, np.float64).round(6).tolist(),
            }
            for source, parent, rest in zip(
                model.source_joints, model.skeleton.parents, np.asarray(model.skeleton.joints), strict=True
            )
        ],
    }


def _worn_together(assembly: Assembly) -> dict:
    """Return which vertices are whose, where several garments are one model."""
    garment, spec = assembly.garment, assembly.scene.garment
    if not garment.layers:
        return {}
    names, ends = garment_names((spec.file, *spec.layers)), (0, *garment.layers, len(garment.vertices))
    parts = zip(names, ends, ends[1:], strict=False)
    return {"garments": [{"name": name, "first": first, "vertices": end - first} for name, first, end in parts]}

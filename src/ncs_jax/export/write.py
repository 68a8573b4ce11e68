"""A trained garment as a file that a host runs without this package.

`export.step` says what the file computes, `export.facts` what FILE.json tells a host.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from ncs_jax.export.check import Check, check_file, load_step
from ncs_jax.export.facts import FileFormat, host_facts
from ncs_jax.export.onnx_lowering import onnx_model
from ncs_jax.export.stablehlo import stablehlo_artifact
from ncs_jax.export.step import RESULTS, flat_step, rounded
from ncs_jax.io.records import MotionRecord
from ncs_jax.io.tables.files import replacing
from ncs_jax.network.methods.method import Method, for_inference
from ncs_jax.prepare.build import Assembly

__all__ = ["Exported", "export"]


@dataclass(frozen=True)
class Exported:
    """Say what was written: the file, the facts beside it, and the check.

    The check is None where there was nothing to run the file with, or no motion.
    """

    file: Path
    facts: dict
    check: Check | None

    def __str__(self) -> str:
        """Return all of it in two or three lines."""
        size = f"{self.file.stat().st_size / 1e6:.2g} MB"
        text = f"{self.file}: {self.facts['format']}, {size}; {self.file}.json says how to run it\n  "
        if "usable_until" in self.facts:
            text += f"usable until {self.facts['usable_until']}: {self.facts['usable_until_means']}\n  "
        if self.facts.get("beyond", {}).get("told"):
            text += f"{self.facts['beyond']['motion']}: {self.facts['beyond']['means']}\n  "
        if self.check is None:
            return text + "not checked: that takes a motion (--motion FILE) and, of an ONNX file, pip install onnxruntime"
        difference, milliseconds, frames, error = self.check
        text += (
            f"{frames} frames, {milliseconds:.2g} ms each; at most {difference:.1e} m from the network that it was made from"
        )
        return text if error is None else f"{text}; {error[0]:.2g} mm from the whole network, {error[1]:.2g} at most"


def export(
    assembly: Assembly,
    params: dict,
    file: str | Path,
    format: FileFormat | None = None,
    *,
    motion: MotionRecord | None = None,
    trained: tuple[Method, dict] | None = None,
    beyond: dict | None = None,
) -> Exported:
    """Write a garment's step, and its facts into FILE.json.

    `onnx` has operators of `onnx_lowering.RULES` only, with static shapes. `stablehlo` is an artifact of `jax.export`, for any
    of `stablehlo.PLATFORMS`; the facts say until when newer versions of JAX load it.

    Args:
        format: of the file, else ONNX. motion: to check the file on, its first 240 frames. trained: network and parameters that
            the error is measured from, where those of the file are smaller or rounded. beyond: what the facts say of where the
            motion is beyond the trained ones.

    Raises:
        InputError: the format's package is missing, the network does what ONNX cannot, or the place is unwritable.
    """
    file, model, format = Path(file), assembly.model, format or FileFormat()
    format.check_name(file)
    network, params = for_inference(assembly.network, params, model)
    if format.float16:
        params = rounded(params)
    step = flat_step(model, network, params)
    facts = host_facts(assembly, step, file, format) | ({} if beyond is None else {"beyond": beyond})
    text = json.dumps(facts, indent=2)
    if format.name == "onnx":
        data = onnx_model(step.call, step.arguments, RESULTS, opset=format.opset, facts=text).SerializeToString()
    else:
        data = stablehlo_artifact(step)
    for path, content in ((file, data), (Path(f"{file}.json"), text.encode() + b"\n")):
        with replacing(path) as part:
            part.write_bytes(content)
    loaded = load_step(file, format.name) if motion is not None else None
    if motion is None or loaded is None:
        return Exported(file, facts, None)
    return Exported(file, facts, check_file(loaded, step.arguments["state"][0], model, (network, params), motion, trained))

"""A step as a StableHLO artifact of `jax.export`: written, loaded, and until when newer versions of JAX load it."""

from __future__ import annotations

import re
from calendar import monthrange
from collections.abc import Callable
from datetime import date
from importlib.util import find_spec

import jax
import jax.numpy as jnp

from ncs_jax.errors import InputError
from ncs_jax.export.step import Step

__all__ = ["PLATFORMS", "expiry", "load_stablehlo", "stablehlo_artifact"]

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")  # that an artifact is made for
RELEASED = {"0.10.1": date(2026, 5, 18), "0.12.0.1": date(2026, 10, 20)}
"""When a JAX was released, for those that `constraints/` pins: the day its wheel was built. A nightly build names its day."""


def stablehlo_artifact(step: Step) -> bytes:
    """Return a step as an artifact of `jax.export` for all `PLATFORMS`.

    A JAX loads it that was released up to three weeks before the one that writes it, or up to six months after: see `expiry`.

    Raises:
        InputError: flatbuffers is not installed.
    """
    if find_spec("flatbuffers") is None:  # which jax.export needs, there and here
        raise InputError(
            "the package flatbuffers is needed", field="--format", value="stablehlo", mend="pip install flatbuffers"
        )
    shapes = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in step.arguments.values()]
    return bytes(jax.export.export(jax.jit(step.call), platforms=PLATFORMS)(*shapes).serialize())


def load_stablehlo(artifact: bytes) -> Callable:
    """Return the step of an artifact, called with its arguments in order."""
    return jax.jit(jax.export.deserialize(bytearray(artifact)).call)


def expiry(version: str, today: date) -> dict[str, str]:
    """Return the facts that say until when an artifact is sure to load: `usable_until`, an ISO date, and what it means.

    Args:
        version: of the JAX that writes it. today: to count from where the release date of that JAX is unknown.
    """
    nightly = re.search(r"\.dev(\d{4})(\d\d)(\d\d)", version)
    released = date(*map(int, nightly.groups())) if nightly else RELEASED.get(version)
    if released is not None:
        counted = f"the release of jax {version} on {released}"
    else:
        counted = f"today, {today}, as the release date of jax {version} is not known here"
    return {
        "usable_until": _six_months_after(released or today).isoformat(),
        "usable_until_means": f"a JAX released later may refuse the file; six months, counted from {counted}",
    }


def _six_months_after(day: date) -> date:
    year, month = day.year + (day.month > 6), (day.month + 5) % 12 + 1
    return date(year, month, min(day.day, monthrange(year, month)[1]))

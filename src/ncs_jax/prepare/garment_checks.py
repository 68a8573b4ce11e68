"""Whether a garment lies on the body, and where it does not, the units and axes with which it would."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.mesh.axes import TURNS, upright
from ncs_jax.io.records import GarmentRecord

__all__ = ["FAR", "UNITS", "check_worn", "stray"]

UNITS = {
    0.01: "centimetres",
    0.001: "millimetres",
    0.0254: "inches",
    0.3048: "feet",
    1.0: "metres",
    100.0: "hundreds of metres",
}
FAR = 0.1  # of the body's size
NEAR = 0.03


def check_worn(file: Path, garment: GarmentRecord, body: np.ndarray, *, told: bool) -> None:
    """Raise an InputError unless a garment has about the size of the body (V, 3), m, lies on it, and stands as it does.

    Units and axes that would make it lie there are found by its box, and said, not applied: a box cannot tell a garment in
    inches from one that is large, all that is trained depends on it, and a scene file that states them means the same with
    another body. `told`: whether the scene states the axis that is up, so that none is looked for.
    """
    size, tall = np.ptp(garment.vertices, axis=0).max(), np.ptp(body, axis=0).max()
    sides = garment.vertices.min(axis=0) - body.max(axis=0), body.min(axis=0) - garment.vertices.max(axis=0)
    gap = np.maximum(*sides).max()
    if size > 3 * tall or size < tall / 30:
        raise InputError(
            f"a garment about the size of the body ({tall:.2f} m) expected", file=file, field="vertices",
            value=f"{size:.3g} m", mend=_mend(garment, body) or "bring it to metres: garment.scale",
        )  # fmt: skip
    if gap > FAR * tall:
        raise InputError(
            "a garment that is on the body expected", file=file, field="vertices", value=f"{gap:.2f} m apart",
            mend=_mend(garment, body) or "move it into the body's coordinates, or turn its axes to Y up: garment.up",
        )  # fmt: skip
    if not told and stray(garment.vertices, body) > FAR:
        raw = garment.vertices @ TURNS[garment.up].T
        turned = next((up for up in TURNS if stray(upright(raw, 1.0, up), body) < NEAR), "")
        if turned:
            raise InputError(
                f"a garment that stands as the body does expected: it would with {turned.upper()} up", file=file,
                field="vertices", value=f"{garment.up.upper()} up",
                mend=f'write up = "{turned}" below [garment] in the scene file, or up = "{garment.up}" if it is meant so',
            )  # fmt: skip


def _mend(garment: GarmentRecord, body: np.ndarray) -> str:
    """What to write into the scene so that the garment lies inside the body's box or little outside; empty: nothing helps."""
    raw = garment.vertices / garment.scale @ TURNS[garment.up].T
    for up in dict.fromkeys((garment.up, "y", "z", "x")):
        for scale in dict.fromkeys((garment.scale, *UNITS)):
            x = upright(raw, scale, up)
            if stray(x, body) <= FAR and np.ptp(x, axis=0).max() >= FAR * np.ptp(body, axis=0).max():
                words = [UNITS[scale]] * (scale != garment.scale) + [f"{up.upper()} up"] * (up != garment.up)
                fields = [f"scale = {scale:g}"] * (scale != garment.scale) + [f'up = "{up}"'] * (up != garment.up)
                return f"it looks like {', '.join(words)}: write {' and '.join(fields)} below [garment] in the scene file"
    return ""


def stray(x: np.ndarray, body: np.ndarray) -> float:
    """How far points stand out of the body's box, in sizes of the body."""
    low, high = body.min(axis=0), body.max(axis=0)
    return float(np.maximum(x.max(axis=0) - high, low - x.min(axis=0)).max() / (high - low).max())

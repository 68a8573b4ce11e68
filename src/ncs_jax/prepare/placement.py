"""A garment's place on a body, how it lies there, and what speaks against it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.records import GarmentRecord
from ncs_jax.prepare.garment_checks import UNITS

__all__ = ["Placement", "of_no_size"]

USUAL = (0.01, 0.001, 0.0254, 0.3048, 1.0)  # metres a unit, of modellers


@dataclass(frozen=True, eq=False)
class Placement:
    """A garment brought to where it lies best, and how well it lies there.

    garment: in metres and Y up at its place. scale, up, turn: metres a unit of the file, the axis that is up in it, and the
    turn about the vertical after it, degrees. mirrored: left and right were exchanged. shift (3,): how it was moved then, m.
    lying, inside: shares of its area on the skin, and inside the body. pierced: joints whose bones pass through the cloth.
    threaded: share of its openings, by length, that the body passes through. doubt: what speaks against it; empty: nothing.
    warning: what is left uncertain in a place that is accepted. given: its user gave the place.
    """

    garment: GarmentRecord
    scale: float
    up: str
    turn: int
    mirrored: bool
    shift: np.ndarray
    lying: float
    inside: float
    pierced: tuple[str, ...]
    threaded: float
    doubt: str = ""
    warning: str = ""
    given: bool = False

    @property
    def worn(self) -> bool:
        """Tell whether the body passes through all openings, no bone through the cloth, and next to nothing is inside."""
        return not self.pierced and self.threaded > 0.99 and self.inside < 0.01

    @property
    def options(self) -> str:
        """Return the options of `ncs fit` that bring it exactly here."""
        x, y, z = self.shift
        turn = f" --turn {self.turn}" if self.turn else ""
        return f"--scale {self.scale:g} --up={self.up}{turn} --move {x:.3f} {y:.3f} {z:.3f}"

    def check(self, file: str | Path) -> None:
        """Raise an InputError where the place is in doubt."""
        if self.doubt and self.given:
            raise InputError(
                f"a garment that lies on the body expected: {self.doubt}", file=file, field="vertices",
                value=f"as the place that was given, {self.options}", mend="look at the picture; state unit and axes by "
                "--scale and --up, or leave out --stay and --move, so that its place is found",
            )  # fmt: skip
        if self.doubt:
            other = (
                "if it was made for another body, name that by `ncs fit --from`; "
                if self.pierced or self.threaded <= 0.99
                else ""
            )
            raise InputError(
                f"a garment that lies on the body expected: {self.doubt}", file=file, field="vertices",
                value=f"as its best place {self.options}", mend=f"{other}if the picture is right, give these options; "
                "else others of --scale, --up, --turn and --move, or --stay",
            )  # fmt: skip


def of_no_size(file: str | Path, size: float, tall: float, scale: float | None, sizes: tuple[float, float]) -> InputError:
    """Return the error of a garment that is not worn in any unit, or not in the one that its user gave.

    A unit is often given in centimetres or millimetres, or as so many to a metre: the mend names it in metres, where the
    garment has some size then, and else the units in which it would have one.

    Args:
        file: the garment's. size: of the garment, units of its file. tall: the body's height, m. scale: the unit that was
            given, m. sizes: least and most size of what is worn, in heights of the body.
    """
    expected = f"a garment about the size of the body ({tall:.2f} m) expected, in any unit"
    if scale is None:
        value = f"{size:.3g} of its units"
        return InputError(expected, file=file, field="vertices", value=value, mend="state its unit with --scale, in metres")

    def worn(unit: float) -> bool:
        return sizes[0] * tall <= size * unit <= sizes[1] * tall

    def known(unit: float) -> bool:
        return any(abs(unit / usual - 1) < 0.02 for usual in USUAL)

    meant = {"centimetres": scale / 100, "millimetres": scale / 1000, "units to a metre": 1 / scale}
    told = [f"{scale:g} {what} is --scale {unit:.4g}" for what, unit in meant.items() if worn(unit) and known(unit)]
    told = told[:1] or [f"--scale {unit:g} for {UNITS[unit]}" for unit in USUAL if worn(unit)]
    mend = f"metres a unit are meant: {', '.join(told)}" if told else "leave it out, so that it is found"
    expected = f"a unit in which the garment is about the size of the body ({tall:.2f} m) expected, in metres"
    return InputError(expected, file=file, field="--scale", value=f"{scale:g}, {size * scale:.3g} m", mend=mend)

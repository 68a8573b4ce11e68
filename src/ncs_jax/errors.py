"""The one error and the one warning that a user's input can cause, and the check that what is asked for was given."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

__all__ = ["InputError", "InputWarning", "required", "shaped"]


class InputError(ValueError):
    """A file, field or argument of the user's that cannot be used.

    The message is one line: the file, the field, what was expected, the value found and the mend. The commands print it and
    exit with code 2.
    """

    def __init__(
        self,
        expected: str,
        *,
        file: str | Path | None = None,
        field: str | None = None,
        value: object = None,
        mend: str | None = None,
    ) -> None:
        self.file, self.field, self.value, self.expected, self.mend = file, field, value, expected, mend
        where = ": ".join(str(part) for part in (file, field) if part not in (None, ""))
        found = "" if value is None else f" (found {_short(value)})"
        text = f"{where}: {expected}{found}" if where else f"{expected}{found}"
        super().__init__(f"{text}; {mend}" if mend else text)


class InputWarning(UserWarning):
    """What a user gave can be used, but may not do what was meant. The commands print it as a line on stderr and go on."""


def required(value: T | None, field: str, mend: str | None = None) -> T:
    """Return a value that what is asked for needs; where it is None, raise an InputError that names it by `field`."""
    if value is None:
        raise InputError("missing, and needed here", field=field, mend=mend)
    return value


def shaped(value, last: tuple[int, ...], field: str, what: str, mend: str | None = None) -> None:
    """Check that an array ends with these axes and holds real numbers: known while it is traced, and free afterwards.

    Args:
        last: lengths of the last axes. field: the argument's name. what: the array in words, with its axes and unit.

    Raises:
        InputError: the axes are others, or the numbers are whole.
    """
    if value.shape[max(value.ndim - len(last), 0) :] != last:
        raise InputError(f"{what} expected", field=field, value=f"shape {value.shape}", mend=mend)
    if value.dtype.kind in "biuc":
        raise InputError("floating-point numbers expected", field=field, value=str(value.dtype), mend="give float32")


def _short(value: object, limit: int = 80) -> str:
    text = repr(value).replace("\n", " ")
    return text if len(text) <= limit else text[: limit - 3] + "..."

"""The one error and the one warning that a user's input can cause, and the check that what is asked for was given."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

__all__ = ["InputError", "InputWarning", "check_alpha", "for_python", "required", "shaped"]

LARGEST_ALPHA = 10.0  # far beyond 3, up to which garments were looked at; more is a slip, as 150 for 1.5

# What an option of the commands is called in Python, where that is not its own name.
ARGUMENTS = {"from": "start", "adapt": "seconds", "resume": "resume=True", "float16": "float16=True", "stay": "move=(0, 0, 0)"}


def for_python(text: str) -> str:
    """Return a text that names options of the commands, as `--resume`, with the arguments in their place: `resume=True`.

    What stands in backquotes, as a whole command, stays.
    """
    parts = text.split("`")
    parts[::2] = [re.sub(r"(?<![\w-])--([a-z][a-z0-9-]*)", _argument, part) for part in parts[::2]]
    return "`".join(parts)


def _argument(option: re.Match) -> str:
    return ARGUMENTS.get(option[1], option[1].replace("-", "_"))


class InputError(ValueError):
    """A file, field or argument of the user's that cannot be used.

    The message is one line: the file, the field, what was expected, the value found and the mend. The commands print it and
    exit with code 2. It is written in options of the commands, as `--out`, and kept so in `as_command`; the message itself,
    which is for Python, names the arguments: see `for_python`.
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
        self.as_command = f"{text}; {mend}" if mend else text
        super().__init__(for_python(self.as_command))


class InputWarning(UserWarning):
    """What a user gave can be used, but may not do what was meant. The commands print it as a line on stderr and go on.

    As an `InputError`, it is written in options of the commands, and Python shows the arguments.
    """

    def __init__(self, as_command: str) -> None:
        self.as_command = as_command
        super().__init__(for_python(as_command))


def required(value: T | None, field: str, mend: str | None = None) -> T:
    """Return a value that what is asked for needs; where it is None, raise an InputError that names it by `field`."""
    if value is None:
        raise InputError("missing, and needed here", field=field, mend=mend)
    return value


def check_alpha(alpha: float, field: str = "alpha") -> None:
    """Raise an InputError where motion control is not from 0 to `LARGEST_ALPHA`: below 0 cloth moves against its motion."""
    if not 0 <= alpha <= LARGEST_ALPHA:  # nor of what is no number
        raise InputError(
            f"a number from 0 to {LARGEST_ALPHA:g} expected", field=field, value=alpha,
            mend="0 is static, 1 as trained, 2 exaggerates; the further from 1, the more is extrapolated",
        )  # fmt: skip


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


def _short(value: object, limit: int = 120) -> str:
    text = repr(value).replace("\n", " ")
    return text if len(text) <= limit else f"{text[: limit // 2 - 3]}...{text[-limit // 2 :]}"  # a path tells most at its end

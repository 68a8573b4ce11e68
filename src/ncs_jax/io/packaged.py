"""Files that come with the package, by name."""

from __future__ import annotations

import difflib
from pathlib import Path

from ncs_jax.errors import InputError

__all__ = ["ASSETS", "packaged", "resolved"]

ASSETS = Path(__file__).parents[1] / "assets"
SCHEME = "ncs:"


def packaged(name: str, suffix: str = ".npz") -> Path:
    """Return the path of a file that comes with the package."""
    path = ASSETS / f"{name}{suffix}"
    if not path.is_file():
        known = sorted(p.stem for p in ASSETS.glob(f"*{suffix}"))
        near = next(iter(difflib.get_close_matches(name, known, n=1)), "")
        names = ", ".join(f"{SCHEME}{other}" for other in known)
        mend = f"did you mean {SCHEME}{near}? Else use one of {names}" if near else f"use one of {names}"
        raise InputError("no such packaged file", field=f"{SCHEME}{name}", mend=mend)
    return path


def resolved(path: str | Path) -> str | Path:
    """Return a path, for ncs:NAME that of the packaged file."""
    text = str(path)
    return packaged(text.removeprefix(SCHEME)) if text.startswith(SCHEME) else path

"""One self-contained page that plays animations in a browser."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np


def write_page(
    path: str | Path,
    animations: Mapping[str, np.ndarray],
    garment_faces: np.ndarray,
    body: np.ndarray | None,
    body_faces: np.ndarray | None,
    fps: float,
    title: str,
    facts: Mapping[str, str],
) -> None:
    """To be written."""
    raise NotImplementedError

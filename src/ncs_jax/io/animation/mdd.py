"""Lightwave's point caches (.mdd), which Blender and Houdini read too: big-endian positions and the time of each frame."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.files import readable, reading, replacing

__all__ = ["read_mdd", "write_mdd"]

HEADER = struct.Struct(">ii")  # frames, points; then a time of each frame in s, then the positions, all float32


def read_mdd(path: str | Path) -> tuple[Path, np.ndarray, float]:
    """Read an .mdd: the file, positions (T, V, 3) float32, not checked, and frames per second, NaN for a single frame."""
    file = readable(path)
    size = file.stat().st_size
    with reading(file, ".mdd"), file.open("rb") as stream:
        head = stream.read(HEADER.size)
        frames, points = HEADER.unpack(head) if len(head) == HEADER.size else (0, 0)
        if frames < 1 or points < 1 or size != HEADER.size + 4 * frames + 12 * frames * points:
            raise InputError(
                "numbers of frames and points above 0 expected, and as many times and positions", file=file, field="header",
                value=f"{frames} frames of {points} points, {size} bytes", mend="the file is damaged; export it again",
            )  # fmt: skip
        times = np.frombuffer(stream.read(4 * frames), ">f4").astype(np.float64)
        x = np.frombuffer(stream.read(), ">f4").astype(np.float32).reshape(frames, points, 3)
    step = (times[-1] - times[0]) / (frames - 1) if frames > 1 else np.nan
    if frames > 1 and not (0 < step < np.inf and np.allclose(np.diff(times), step, rtol=0.01)):
        raise InputError(
            "times that rise in even steps expected", file=file, field="times", value=times[:4].tolist(),
            mend="export it again, every frame once",
        )  # fmt: skip
    return file, x, float(f"{1 / step:.6g}")  # the times are in float32


def write_mdd(path: str | Path, vertices: np.ndarray, fps: float) -> None:
    """Write positions (T, V, 3), frame t at t / fps seconds; the file appears whole or not at all."""
    frames, points, _ = vertices.shape
    with replacing(path) as part, part.open("xb") as stream:
        stream.write(HEADER.pack(frames, points))
        stream.write((np.arange(frames) / fps).astype(">f4").data)
        for x in vertices:
            stream.write(x.astype(">f4").data)

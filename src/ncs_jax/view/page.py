"""One self-contained page that plays animations in a browser, without a network."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["write_page"]

STEP = 5e-5
"""The grid that positions are rounded to, in m; coarser where one frame spans more than 3.2 m."""


def write_page(
    path: str | Path,
    animations: Mapping[str, np.ndarray],
    garment_faces: np.ndarray,
    body: np.ndarray | None,
    body_faces: np.ndarray | None,
    fps: float,
    title: str,
    facts: Mapping[str, str],
    worn: int = 0,
) -> None:
    """Write one HTML file that plays a garment on a body in any browser with WebGL 2; it loads nothing from elsewhere.

    Args:
        path: of the page. animations: vertices (T, V, 3) in m with Y up, by motion alpha such as "0", "1", "1.5"; if there is
        just one, no switch is shown. garment_faces: (F, 3). body: vertices (T, B, 3) in m, or None. body_faces: its faces, or
        None. fps: frames per second. title: of the page. facts: figures shown beneath it, by name. worn: how many of the
        body's vertices, the last, are of garments worn below, whose faces come last.

    Positions are kept to 0.03 mm wherever the garment walks (`test_positions_survive`); a frame that spans more than 3.2 m is
    kept to its span over 130,000. What is not finite, or does not fit together, is an `InputError`.
    """
    if not animations:
        raise InputError("at least one animation", field="animations")
    if not (np.isfinite(fps) and fps > 0):
        raise InputError("frames per second above 0", field="fps", value=fps)
    garments = {label: _vertices(x, f"animations[{label!r}]") for label, x in animations.items()}
    first, shape = next((label, x.shape) for label, x in garments.items())
    for label, x in garments.items():
        if x.shape != shape:
            raise InputError(f"shape {shape}, as animations[{first!r}] has", field=f"animations[{label!r}]", value=x.shape)
    tracks = [_track(x) for x in garments.values()]
    data = {f"track-{i}": payload for i, (_, payload) in enumerate(tracks)}
    scene: dict[str, object] = {"fps": float(fps), "frames": shape[0], "labels": list(garments)}
    scene["garment"] = {"verts": shape[1], "tracks": [record for record, _ in tracks]}
    data["garment-faces"] = _faces(garment_faces, shape[1], "garment_faces")
    if body is not None:
        body = _vertices(body, "body")
        if len(body) != shape[0]:
            raise InputError(f"{shape[0]} frames, as many as the garment has", field="body", value=len(body))
        record, data["track-body"] = _track(body)
        scene["body"] = {"verts": body.shape[1], "worn": worn, "tracks": [record]}
        data["body-faces"] = _faces(body_faces, body.shape[1], "body_faces")
    rows = (f"<div><dt>{html.escape(str(k))}</dt><dd>{html.escape(str(v))}</dd></div>" for k, v in facts.items())
    blocks = (f'<script type="application/octet-stream" id="{name}">{text}</script>' for name, text in data.items())
    parts = {
        "TITLE": html.escape(str(title)),
        "FACTS": "\n        ".join(rows),
        "SCENE": json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c"),
        "DATA": "\n".join(blocks),
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    page = re.sub(r"\{\{([A-Z]+)\}\}", lambda match: parts[match[1]], template)
    Path(path).write_text(page, encoding="utf-8", newline="\n")


def _vertices(vertices, name):
    """Finite vertices (T, V, 3)."""
    vertices = np.asarray(vertices)
    if vertices.ndim != 3 or vertices.shape[2] != 3 or 0 in vertices.shape:
        raise InputError("vertices of shape (frames, verts, 3)", field=name, value=vertices.shape)
    bad = np.argwhere(~np.isfinite(vertices).all(2))
    if len(bad):
        frame, vertex = bad[0].tolist()
        value = vertices[frame, vertex].tolist()
        raise InputError(f"finite positions, but vertex {vertex} of frame {frame} is not", field=name, value=value)
    if np.abs(vertices).max() > 1e6:
        raise InputError("positions in m, within 1e6", field=name, value=float(np.abs(vertices).max()))
    return vertices


def _faces(faces, count, name):
    """Triangles as base64 of deflated little-endian int32."""
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise InputError("whole numbers of shape (faces, 3)", field=name, value=(faces.shape, str(faces.dtype)))
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise InputError(f"vertex numbers from 0 to {count - 1}", field=name, value=(int(faces.min()), int(faces.max())))
    return _text(faces.astype("<i4").tobytes())


def _track(vertices):
    """Where the numbers lie, and the positions themselves.

    Each frame is its mean, a float32, and for each axis and vertex a uint16 on a grid around it. These are stored as second
    differences in time modulo 65536, low bytes first: a smooth motion has small ones, which deflate to a quarter.
    """
    middle = vertices.mean(1, dtype=float).astype("<f4")
    local = vertices.astype(float) - middle[:, None].astype(float)
    low = local.min((0, 1))
    step = max(STEP, float((local.max((0, 1)) - low).max()) / 65535)
    grid = np.round((local - low) / step).astype(np.int64).transpose(0, 2, 1)
    for _ in range(2):
        grid = np.diff(grid, axis=0, prepend=np.zeros_like(grid[:1]))
    pairs = np.ascontiguousarray(grid % 65536).astype("<u2").view(np.uint8).reshape(-1, 2)
    payload = middle.tobytes() + pairs[:, 0].tobytes() + pairs[:, 1].tobytes()
    return {"low": low.tolist(), "step": step}, _text(payload)


def _text(payload):
    return base64.b64encode(zlib.compress(payload, 6)).decode("ascii")

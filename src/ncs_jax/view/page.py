"""One self-contained page that plays animations in a browser, without a network."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.view.animation import Animation

__all__ = ["Encoded", "deflated", "encode", "fill_page", "stored_faces", "stored_track", "write_encoded", "write_page"]

STEP = 5e-5
"""The grid that positions are rounded to, in m; coarser where one frame spans more than 3.2 m."""


def write_page(
    path: str | Path, animations: Mapping[str, Animation], *, title: str = "", facts: Mapping[str, str] | None = None
) -> None:
    """Write one HTML file that plays a garment on a body in any browser with WebGL 2; it loads nothing from elsewhere.

    Args:
        path: of the page. animations: by motion alpha such as "0", "1", "1.5", alike but for the garment's vertices; if
            there is just one, no switch is shown. title: of the page. facts: figures shown beneath it, by name.

    Positions are kept to 0.03 mm wherever the garment walks (`test_positions_survive`); a frame that spans more than 3.2 m is
    kept to its span over 130,000.

    Raises:
        InputError: a position is not finite, or the animations differ by more than the garment's vertices.
    """
    write_encoded(path, encode(animations), title=title, facts=facts)


class Encoded(NamedTuple):
    """Animations as a page holds them: the facts of the scene, and its blocks of data by name."""

    scene: dict[str, object]
    data: dict[str, str]


def encode(animations: Mapping[str, Animation]) -> Encoded:
    """Return what a page holds of animations, which takes most of the time of writing one.

    Raises:
        InputError: as `write_page` does.
    """
    return _scene(_checked(animations))


def write_encoded(path: str | Path, encoded: Encoded, *, title: str = "", facts: Mapping[str, str] | None = None) -> None:
    """Write what `write_page` does."""
    fill_page(path, encoded, "recorded", title=title, facts=facts)


def fill_page(
    path: str | Path,
    encoded: Encoded,
    player: str,
    *,
    title: str = "",
    facts: Mapping[str, str] | None = None,
    notices: str = "",
) -> None:
    """Write a page with a player, whose script is `page_PLAYER.js` and whose controls are in `page_PLAYER.html`.

    notices: HTML that is shown under the help.
    """
    scene, data = encoded
    rows = (f"<div><dt>{html.escape(str(k))}</dt><dd>{html.escape(str(v))}</dd></div>" for k, v in (facts or {}).items())
    blocks = (f'<script type="application/octet-stream" id="{name}">{text}</script>' for name, text in data.items())
    parts = {
        "TITLE": html.escape(str(title)),
        "FACTS": "\n        ".join(rows),
        "SCENE": json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c"),
        "DATA": "\n".join(blocks),
        "NOTICES": notices,
        "PLAYER": _beside(f"page_{player}.js"),
        **_sections(_beside(f"page_{player}.html")),
    }
    page = re.sub(r"\{\{([A-Z]+)\}\}", lambda match: parts.get(match[1], ""), _beside("page.html"))
    Path(path).write_text(page, encoding="utf-8", newline="\n")


def _beside(name: str) -> str:
    """Return the text of a file beside this one."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def _sections(text: str) -> dict[str, str]:
    """Return parts of a page by their places in `page.html`, which stand in comments before them."""
    parts = re.split(r"<!-- ([A-Z]+) -->\n", text)
    return {name: part.rstrip("\n") for name, part in zip(parts[1::2], parts[2::2], strict=True)}


def _scene(animations: dict[str, Animation]) -> Encoded:
    """Return what the page's script reads."""
    first = next(iter(animations.values()))
    frames, verts, _ = first.garment.shape
    tracks = [stored_track(each.garment) for each in animations.values()]
    data = {f"track-{i}": payload for i, (_, payload) in enumerate(tracks)}
    scene: dict[str, object] = {"fps": float(first.fps), "frames": frames, "labels": list(animations)}
    scene["garment"] = {"verts": verts, "layers": first.layers, "tracks": [record for record, _ in tracks]}
    data["garment-faces"] = stored_faces(first.garment_faces)
    if first.body is not None:
        record, data["track-body"] = stored_track(first.body.vertices)
        scene["body"] = {"verts": first.body.vertices.shape[1], "worn": first.body.worn, "tracks": [record]}
        data["body-faces"] = stored_faces(first.body.faces)
    return Encoded(scene, data)


def _checked(animations: Mapping[str, Animation]) -> dict[str, Animation]:
    """Return the animations with Y up, checked to be finite and alike."""
    if not animations:
        raise InputError("at least one animation expected", field="animations", mend="give one by its alpha, such as '1'")
    label, first = next(iter(animations.items()))
    for name, each in animations.items():
        field = f"animations[{name!r}]"
        if each.garment.shape != first.garment.shape:
            raise InputError(
                f"the shape of animations[{label!r}], {first.garment.shape}, expected", field=field, value=each.garment.shape,
                mend="animate one garment over one motion",
            )  # fmt: skip
        if not _alike(each, first):
            raise InputError(
                f"faces, body, frame rate and up of animations[{label!r}] expected", field=field,
                mend="animate one garment over one motion",
            )  # fmt: skip
        _check_finite(each.garment, field)
    if first.body is not None:
        _check_finite(first.body.vertices, "body")
    return {name: each.y_up() for name, each in animations.items()}


def _alike(one: Animation, other: Animation) -> bool:
    """Tell whether two animations differ by the garment's vertices alone."""
    if (one.fps, tuple(one.up)) != (other.fps, tuple(other.up)) or not np.array_equal(one.garment_faces, other.garment_faces):
        return False
    a, b = one.body, other.body
    if a is b or a is None or b is None:
        return a is b
    return a.worn == b.worn and np.array_equal(a.faces, b.faces) and np.array_equal(a.vertices, b.vertices)


def _check_finite(vertices: np.ndarray, name: str) -> None:
    bad = np.argwhere(~np.isfinite(vertices).all(2))
    if len(bad):
        frame, vertex = bad[0].tolist()
        value = vertices[frame, vertex].tolist()
        raise InputError(
            f"finite positions, also of vertex {vertex} in frame {frame}, expected", field=name, value=value,
            mend="leave out the frames from there on",
        )  # fmt: skip
    if np.abs(vertices).max() > 1e6:
        raise InputError(
            "positions in m within 1e6 expected", field=name, value=float(np.abs(vertices).max()),
            mend="give metres, and move the motion nearer to the origin",
        )  # fmt: skip


def stored_faces(faces: np.ndarray) -> str:
    """Return triangles as base64 of deflated little-endian int32."""
    return deflated(faces.astype("<i4").tobytes())


def stored_track(vertices):
    """Return where the numbers lie, and the positions themselves.

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
    return {"low": low.tolist(), "step": step}, deflated(payload)


def deflated(payload: bytes, level: int = 6) -> str:
    """Return bytes as base64 of what they deflate to; at level 9 they get smallest, which takes longest."""
    return base64.b64encode(zlib.compress(payload, level)).decode("ascii")

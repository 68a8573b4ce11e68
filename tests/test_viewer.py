"""The page that plays an animation: what it stores, that it needs nothing else, and that a browser draws it."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from ncs_jax.errors import InputError
from ncs_jax.view.animation import Animation, PosedBody
from ncs_jax.view.page import write_page

from .browser import CHROMIUM, Browser

FRAMES = 24


def tube(rings: int, around: int, radius: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """An open cylinder about Y, its faces outward."""
    angle = 2 * np.pi * np.arange(around) / around
    height = np.linspace(low, high, rings)
    grid = np.stack(np.broadcast_arrays(radius * np.sin(angle), height[:, None], radius * np.cos(angle)), -1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij"))
    a, b = i * around + j, i * around + (j + 1) % around
    faces = np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])
    return grid.reshape(-1, 3), faces.astype(np.int32)


@pytest.fixture
def scene(rng) -> dict:
    """A skirt about a post that walks 10 m; with alpha 1 it is half a metre to the left."""
    body, body_faces = tube(8, 16, 0.12, 0.0, 1.7)
    cloth, faces = tube(6, 24, 0.3, 0.6, 1.2)
    walk = np.linspace(0, 1, FRAMES)[:, None, None] * np.array([6.0, 0.0, 8.0])
    swing = 0.01 * rng.standard_normal((FRAMES, len(cloth), 3))
    still = cloth + walk + swing
    return {
        "animations": {"0": still.astype(np.float32), "1": (still - [0.5, 0.0, 0.0]).astype(np.float32)},
        "garment_faces": faces,
        "body": (body + walk).astype(np.float32),
        "body_faces": body_faces,
        "fps": 30.0,
        "title": "A skirt",
        "facts": {"mean strain": "2.1 %"},
    }


class Page(HTMLParser):
    """The page's elements by tag, its data blocks, and the rest of its text."""

    def __init__(self, path: Path):
        super().__init__()
        self.blocks: dict[str, str] = {}
        self.tags: list[tuple[str, dict]] = []
        self.words = ""
        self._block: str | None = None
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.scene = json.loads(self.blocks["scene"])

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._block = dict(attrs).get("id") if tag == "script" else None

    def handle_endtag(self, tag):
        self._block = None

    def handle_data(self, data):
        if self._block:
            self.blocks[self._block] = self.blocks.get(self._block, "") + data
        else:
            self.words += data

    def bytes(self, name: str) -> bytes:
        return zlib.decompress(base64.b64decode(self.blocks[name]))

    def faces(self, name: str) -> np.ndarray:
        return np.frombuffer(self.bytes(name), "<i4").reshape(-1, 3)

    def vertices(self, name: str, mesh: dict, track: dict) -> np.ndarray:
        """What the script does, in NumPy: two running sums that wrap at 65536."""
        raw, frames, verts = self.bytes(name), self.scene["frames"], mesh["verts"]
        middle = np.frombuffer(raw, "<f4", 3 * frames).reshape(frames, 1, 3)
        low, high = np.frombuffer(raw, np.uint8, offset=12 * frames).reshape(2, frames, 3, verts).astype(np.uint16)
        grid = low | high << 8
        for _ in range(2):
            grid = np.cumsum(grid, 0, dtype=np.uint16)
        return middle + np.array(track["low"]) + track["step"] * grid.transpose(0, 2, 1)


def written(tmp_path: Path, scene: dict, **changes) -> Page:
    """Write a page of the fixture's arrays, some of them changed."""
    path, given = tmp_path / "preview.html", {"worn": 0, "title": "", "facts": {}, **scene, **changes}
    body = None if given["body"] is None else PosedBody(given["body"], given["body_faces"], given["worn"])
    animations = {label: Animation(x, given["garment_faces"], given["fps"], body) for label, x in given["animations"].items()}
    write_page(path, animations, title=given["title"], facts=given["facts"])
    return Page(path)


def test_positions_survive(tmp_path, scene):
    page = written(tmp_path, scene)
    assert page.scene["labels"] == ["0", "1"] and page.scene["frames"] == FRAMES and page.scene["fps"] == 30.0
    for i, x in enumerate(scene["animations"].values()):
        stored = page.vertices(f"track-{i}", page.scene["garment"], page.scene["garment"]["tracks"][i])
        np.testing.assert_allclose(stored, x, rtol=0, atol=3e-5)
    assert np.abs(scene["body"]).max() > 7.5
    stored = page.vertices("track-body", page.scene["body"], page.scene["body"]["tracks"][0])
    np.testing.assert_allclose(stored, scene["body"], rtol=0, atol=3e-5)
    np.testing.assert_array_equal(page.faces("garment-faces"), scene["garment_faces"])
    np.testing.assert_array_equal(page.faces("body-faces"), scene["body_faces"])


def test_a_wide_frame_uses_the_whole_grid(tmp_path, scene):
    wide = scene["animations"]["0"].copy()
    wide[5, 7] += 100.0
    page = written(tmp_path, scene, animations={"0": wide})
    track = page.scene["garment"]["tracks"][0]
    np.testing.assert_allclose(page.vertices("track-0", page.scene["garment"], track), wide, rtol=0, atol=0.51 * track["step"])
    assert track["step"] < 0.002


def test_a_smooth_motion_is_small(tmp_path):
    cloth, faces = tube(32, 32, 0.3, 0.6, 1.2)
    t = np.arange(240)[:, None, None] / 30
    moving = (cloth + 0.2 * np.sin(t + cloth[:, 1:2]) * [1.0, 0.2, 0.5]).astype(np.float32)
    written(tmp_path, {}, animations={"0": moving}, garment_faces=faces, body=None, body_faces=None, fps=30)
    assert (tmp_path / "preview.html").stat().st_size < 0.5 * moving.nbytes


def test_nothing_is_loaded(tmp_path, scene):
    page = written(tmp_path, scene)
    rest = page.source.replace("http-equiv", "")
    for name, text in page.blocks.items():
        if name != "scene":
            assert re.fullmatch("[A-Za-z0-9+/]+=*", text)
            rest = rest.replace(text, "")
    for word in ("http", "//www", "src=", "@import", "url(", "fetch(", "import(", "XMLHttpRequest", "<link", "<iframe"):
        assert word not in rest, word
    policy = [a["content"] for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policy) == 1
    assert "default-src 'none'" in policy[0] and "script-src 'unsafe-inline'" in policy[0]
    assert "connect-src" not in policy[0]
    assert "{{" not in rest.replace("${{", "")


def test_words_are_escaped(tmp_path, scene):
    title, fact = '</title><script>alert("1")</script>', {"<b>key</b>": "<img onerror='x'> & {{DATA}}", "b": "{{TITLE}}"}
    label = "</script><i>"
    page = written(tmp_path, scene, title=title, facts=fact, animations={label: scene["animations"]["0"]})
    assert "<script>alert" not in page.source and "<img" not in page.source and "<b>" not in page.source
    assert "</script><i>" not in page.source and page.scene["labels"] == [label]
    for words in (title, *fact, *fact.values()):
        assert words in page.words


def test_controls_have_names(tmp_path, scene):
    page = written(tmp_path, scene)
    named = {a["aria-label"] for tag, a in page.tags if tag in ("button", "input", "select") and "aria-label" in a}
    assert {"Play", "Previous frame", "Next frame", "Frame", "Speed", "Wireframe", "Reset view"} <= named
    assert page.source.startswith("<!doctype html>") and ("html", {"lang": "en"}) in page.tags


def test_one_animation_and_no_body(tmp_path, scene):
    page = written(tmp_path, scene, animations={"0": scene["animations"]["0"]}, body=None, body_faces=None, facts={})
    assert page.scene["labels"] == ["0"] and "body" not in page.scene and "track-body" not in page.blocks


def _with(x, value):
    x = x.copy()
    x[3, 2, 1] = value
    return x


BAD = {
    "nan": (lambda s: {"animations": {**s["animations"], "1": _with(s["animations"]["1"], np.nan)}}, "animations['1']"),
    "infinite": (lambda s: {"animations": {**s["animations"], "1": _with(s["animations"]["1"], np.inf)}}, "animations['1']"),
    "huge": (lambda s: {"animations": {**s["animations"], "1": _with(s["animations"]["1"], 1e9)}}, "animations['1']"),
    "body nan": (lambda s: {"body": _with(s["body"], np.nan)}, "body"),
    "frames": (lambda s: {"body": None, "animations": {**s["animations"], "1": s["animations"]["1"][:-1]}}, "animations['1']"),
    "verts": (
        lambda s: {"animations": {**s["animations"], "1": np.repeat(s["animations"]["1"], 2, axis=1)}},
        "animations['1']",
    ),
    "body frames": (lambda s: {"body": s["body"][:-1]}, "body"),
    "flat": (lambda s: {"animations": {"0": s["animations"]["0"][0]}}, "garment"),
    "empty": (lambda s: {"animations": {"0": s["animations"]["0"][:0]}}, "garment"),
    "none": (lambda s: {"animations": {}}, "animations"),
    "faces": (lambda s: {"garment_faces": s["garment_faces"] + 1}, "garment_faces"),
    "quads": (lambda s: {"garment_faces": np.zeros((3, 4), int)}, "garment_faces"),
    "body faces": (lambda s: {"body_faces": None}, "body_faces"),
    "fps": (lambda s: {"fps": 0.0}, "fps"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_shown_is_named(tmp_path, scene, name):
    change, field = BAD[name]
    with pytest.raises(InputError) as caught:
        written(tmp_path, scene, **change(scene))
    assert caught.value.field == field
    assert not (tmp_path / "preview.html").exists()


DIFFERENT = {
    "faces": lambda a: replace(a, garment_faces=a.garment_faces[::-1]),
    "fps": lambda a: replace(a, fps=24.0),
    "up": lambda a: replace(a, up=(0.0, 0.0, 1.0)),
    "no body": lambda a: replace(a, body=None),
    "body": lambda a: replace(a, body=replace(a.body, vertices=a.body.vertices + 1)),
    "body faces": lambda a: replace(a, body=replace(a.body, faces=a.body.faces[::-1])),
    "worn": lambda a: replace(a, body=replace(a.body, worn=1)),
}


@pytest.mark.parametrize("name", DIFFERENT)
def test_one_page_has_one_body_and_one_garment(tmp_path, scene, name):
    body = PosedBody(scene["body"], scene["body_faces"])
    one = Animation(scene["animations"]["0"], scene["garment_faces"], 30.0, body)
    write_page(tmp_path / "a.html", {"0": one, "1": replace(one, body=PosedBody(body.vertices.copy(), body.faces))})
    with pytest.raises(InputError, match=r"of animations\['0'\] expected; ") as caught:
        write_page(tmp_path / "b.html", {"0": one, "1": DIFFERENT[name](one)})
    assert caught.value.field == "animations['1']" and not (tmp_path / "b.html").exists()


def test_a_page_turns_what_has_another_up(tmp_path, scene):
    garment = np.stack([scene["animations"]["0"][..., i] for i in (0, 2, 1)], -1) * np.float32([1, -1, 1])
    lying = Animation(garment, scene["garment_faces"], 30.0, up=(0.0, 0.0, 1.0))
    write_page(tmp_path / "a.html", {"0": lying})
    page = Page(tmp_path / "a.html")
    stored = page.vertices("track-0", page.scene["garment"], page.scene["garment"]["tracks"][0])
    np.testing.assert_allclose(stored, scene["animations"]["0"], rtol=0, atol=3e-5)


def screenshot(tmp_path: Path, page: Path, view: str) -> np.ndarray:
    with Browser(f"{page.as_uri()}#{view}", tmp_path / "profile") as browser:
        browser.call("Emulation.setDeviceMetricsOverride", width=640, height=480, deviceScaleFactor=1, mobile=False)
        browser.until("document.documentElement?.dataset.ready === 'true'")
        browser.evaluate("new Promise(done => setTimeout(done, 1000))")
        assert not browser.complaints
        return browser.screenshot()


def cloth_coloured(image: np.ndarray) -> np.ndarray:
    """Where the picture is as orange as the garment, above the controls."""
    r, g, b = np.moveaxis(image[:360], 2, 0)
    return (r > 120) & (r > 1.4 * g) & (g > b)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_draws_it(tmp_path, scene):
    written(tmp_path, scene, facts={})
    page = tmp_path / "preview.html"
    seen = {alpha: screenshot(tmp_path, page, f"frame=6&azimuth=0&paused&alpha={alpha}") for alpha in "01"}
    masks = {alpha: cloth_coloured(image) for alpha, image in seen.items()}
    columns = {}
    for alpha, mask in masks.items():
        assert mask.sum() > 1500, alpha
        rows, across = np.nonzero(mask)
        columns[alpha] = across.mean()
        (top, bottom), (left, right) = np.quantile(rows, [0.005, 0.995]), np.quantile(across, [0.005, 0.995])
        assert 0.9 < (bottom - top) / (right - left) < 1.2, alpha  # a skirt 0.6 m high and 0.6 m wide, and whole
        assert mask.sum() > 0.85 * (bottom - top) * (right - left), alpha
    assert columns["1"] < columns["0"] - 20  # half a metre to the left, under a camera that stays
    assert np.abs(seen["0"] - seen["1"]).max(2).mean() > 1
    assert np.abs(seen["0"][5, 320] - (247, 245, 241)).max() <= 1
    both = screenshot(tmp_path, page, "frame=6&azimuth=0&paused&alpha=all")
    halves = [cloth_coloured(both)[:, half] for half in (slice(320), slice(320, 640))]
    across = [np.nonzero(half)[1].mean() for half in halves]
    assert min(half.sum() for half in halves) > 400 and across[1] < across[0] - 5  # alpha 0, then 1, each under its own camera
    bare = screenshot(tmp_path, page, "frame=6&azimuth=0&paused&alpha=0&body=0")
    assert cloth_coloured(bare).sum() > 1500 and np.abs(bare - seen["0"]).max() > 60
    verts = scene["body"].shape[1]
    blue = {}
    for worn in (0, verts // 2, verts):  # of whose last faces the page makes garments
        own = scene["body_faces"][np.argsort(scene["body_faces"].max(axis=1), kind="stable")]
        written(tmp_path, scene, facts={}, body_faces=own, worn=worn)
        r, _, b = np.moveaxis(screenshot(tmp_path, page, "frame=6&azimuth=0&paused&alpha=0")[:360], 2, 0)
        blue[worn] = (b > r + 10).sum()
    assert blue[0] == 0 and 0 < blue[verts // 2] < blue[verts]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_draws_a_garment_alone(tmp_path, scene):
    written(tmp_path, scene, animations={"0": scene["animations"]["0"]}, body=None, body_faces=None)
    assert cloth_coloured(screenshot(tmp_path, tmp_path / "preview.html", "paused&frame=23")).sum() > 1500

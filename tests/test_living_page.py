"""The page in which a browser runs a trained garment: what it holds, what it needs, and that it gives what Python gives."""

from __future__ import annotations

import os
import tarfile
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.errors import InputError
from ncs_jax.export.facts import FileFormat
from ncs_jax.runs.run import Run
from ncs_jax.view.browser_runtime import MODULE, SCRIPT, WASM, BrowserRuntime, read_runtime
from ncs_jax.view.character import body_vertices
from ncs_jax.view.living import _shortened, write_living_page

from .browser import CHROMIUM, Browser
from .ready import edited
from .test_export import garment, long
from .test_viewer import Page, cloth_coloured

REFINED = "after 4 iterations of the solver"
RUNTIME = BrowserRuntime("1.2.3", b"a script", b"a module", b"\0asm", "Copyright (c) Somebody <else>")


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def lively(kind="gated"):
    """A run, and its motions: a long one that begins away from the origin, and a stand."""
    assembly, params, _ = garment(kind)
    far = long(60)
    return Run(assembly, params, 5), {
        "long": edited(far, translation=far.translation + np.float32([3, 0, -2])),
        "short": long(8),
    }


def numbers(page: Page, name: str, count: int) -> np.ndarray:
    """What the script does: bytes by place, and two running sums."""
    differences = np.frombuffer(page.bytes(name), np.uint8).reshape(4, -1).T.copy().view("<i4").reshape(-1, count)
    return page.scene["live"]["step"] * np.cumsum(np.cumsum(differences.astype(np.int64), axis=0), axis=0)


@pytest.mark.parametrize("kind", ["swing", "pbns"])
def test_the_page_holds_the_step_the_motions_and_the_skin(tmp_path, kind):
    run, motions = lively(kind)
    made = write_living_page(tmp_path / "a.html", run, motions, RUNTIME)
    page = Page(tmp_path / "a.html")
    live, body = page.scene["live"], run.assembly.body
    (step,) = live["steps"]
    graph = np.frombuffer(page.bytes(step["id"]), np.uint8).reshape(4, -1).T.tobytes()[: step["bytes"]]
    session, joints = onnxruntime.InferenceSession(graph), len(live["skeleton"]["parents"])
    assert live["controlled"] == (kind != "pbns") and made.motions == ("long", "short")
    for number, (name, motion) in enumerate(motions.items()):
        facts = live["motions"][number]
        rows = numbers(page, f"motion-{number}", 3 * joints + 3)
        poses, moved = rows[:, : 3 * joints].reshape(-1, joints, 3), rows[:, 3 * joints :]
        assert facts["name"] == name and facts["frames"] == len(motion.poses)
        np.testing.assert_allclose(poses, motion.poses, rtol=0, atol=1e-6)
        np.testing.assert_allclose(moved + facts["start"], motion.translation, rtol=0, atol=1e-6)
        state, frames = np.zeros(step["state"], np.float32), []
        for pose, place in zip(poses[:, step["joints"]], moved.astype(np.float32), strict=True):
            turns = Rotation.from_rotvec(pose).as_matrix().astype(np.float32)
            inputs = {"state": state, "rotations": turns, "translation": place, "alpha": np.ones(1, np.float32)}
            state, x = session.run(None, inputs)
            frames.append(x + facts["start"])
        np.testing.assert_allclose(frames, run.animate(motion), rtol=0, atol=1e-4)
    assert made.check.error[1] < 0.1 and f"{made.check.error[1]:.2g} at most" in str(made)
    rest = np.frombuffer(page.bytes("body-rest"), "<f4").reshape(-1, 3)
    columns = np.frombuffer(page.bytes("body-joints"), "<u2").reshape(-1, page.scene["body"]["influences"])
    dense = np.zeros((len(rest), joints))
    weights = np.frombuffer(page.bytes("body-weights"), "<f4").reshape(columns.shape)
    np.add.at(dense, (np.arange(len(rest))[:, None], columns), weights)
    np.testing.assert_allclose(dense, body.weights, atol=1e-6)
    np.testing.assert_allclose(rest, body.vertices, atol=1e-6)


def test_another_motion_is_compared_with_where_it_is_stored(tmp_path):
    run, motions = lively()
    x = run.animate(motions["long"]) + np.float32(0.01)
    write_living_page(tmp_path / "a.html", run, motions, RUNTIME, refined=(4, x))
    page = Page(tmp_path / "a.html")
    first, second = page.scene["live"]["motions"]
    assert first["name"] == "long" and first["refined"]["name"] == REFINED and "refined" not in second
    page.scene["frames"] = first["frames"]
    stored = page.vertices("refined-0", page.scene["garment"], first["refined"])
    np.testing.assert_allclose(stored + first["start"], x, rtol=0, atol=3e-5)


def test_smaller_networks_say_how_far_they_are(tmp_path):
    run, motions = lively()
    whole = write_living_page(tmp_path / "a.html", run, motions, RUNTIME)
    small = write_living_page(tmp_path / "b.html", run, motions, RUNTIME, rank=2, float16=True)
    assert small.check.error[1] > 5 * whole.check.error[1]
    assert f"up to {small.check.error[1]:.2g} mm from the trained network" in Page(tmp_path / "b.html").words


def test_numbers_are_rounded_to_the_nearest():
    x = np.random.default_rng(0).normal(size=1000).astype("<f4")
    near = _shortened(x)
    assert np.abs(near / x - 1).max() <= 2.0**-17 and np.abs(near / x - 1).max() > 2.0**-18
    assert not np.any(near.view("<u4") & 0x7F)


def test_nothing_is_loaded_and_licences_are_shown(tmp_path):
    run, motions = lively()
    write_living_page(tmp_path / "a.html", run, motions, RUNTIME)
    page = Page(tmp_path / "a.html")
    assert [page.bytes(f"runtime-{name}") for name in ("script", "module", "wasm")] == [b"a script", b"a module", b"\0asm"]
    assert "Copyright (c) Somebody <else>" in page.words and "onnxruntime-web 1.2.3" in page.words
    rest = page.source.replace("http-equiv", "")
    for name, text in page.blocks.items():
        rest = rest if name == "scene" else rest.replace(text, "")
    for word in ("http", "//www", "src=", "@import", "url(", "fetch(", "XMLHttpRequest", "<link", "<iframe"):
        assert word not in rest, word
    (policy,) = [a["content"] for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    allowed = (
        "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; connect-src blob:;"  # what is in the page
    )
    assert policy.startswith(allowed) and policy.count("blob:") == 2 and "{{" not in rest.replace("${{", "")


def package(folder: Path, **changes) -> Path:
    """A folder with the files of the npm package that are read."""
    parts = {"package.json": '{"name": "onnxruntime-web", "version": "9.8.7"}', SCRIPT: "s", MODULE: "m", WASM: "w", **changes}
    for name, text in parts.items():
        if text is not None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
    return folder


def test_the_runtime_is_read_from_where_npm_puts_it(tmp_path, monkeypatch):
    installed = package(tmp_path / "home" / "node_modules" / "onnxruntime-web")
    packed = tmp_path / "pack" / "onnxruntime-web-9.8.7.tgz"
    packed.parent.mkdir()
    with tarfile.open(packed, "w:gz") as archive:
        archive.add(installed, "package")
    package(tmp_path / "unpacked" / "package")
    places = (installed, tmp_path / "home", packed, tmp_path / "unpacked", tmp_path / "unpacked" / "package")
    for place in places:
        found = read_runtime(place)
        assert (found.version, found.script, found.module, found.wasm) == ("9.8.7", b"s", b"m", b"w")
        assert "Copyright (c) Microsoft Corporation" in found.notice and "onnxruntime-web 9.8.7" in found.notice
    for here in (tmp_path / "home", packed.parent):
        monkeypatch.chdir(here)
        assert read_runtime().version == "9.8.7"


def test_what_is_no_runtime_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="npm pack onnxruntime-web") as caught:
        read_runtime()
    assert caught.value.field == "--runtime"
    (tmp_path / "text.tgz").write_text("not packed")
    package(tmp_path / "other", **{"package.json": '{"name": "other"}'})
    package(tmp_path / "old", **{WASM: None})
    with tarfile.open(tmp_path / "old.tgz", "w:gz") as archive:
        archive.add(tmp_path / "old", "package")
    for place in ("text.tgz", "other", "old", "old.tgz", "nowhere"):
        with pytest.raises(InputError, match="npm pack onnxruntime-web") as caught:
            read_runtime(tmp_path / place)
        assert place in str(caught.value)


def test_what_cannot_be_a_page_is_named(tmp_path):
    run, motions = lively()
    for file, given, word in (("a.onnx", motions, ".html"), ("a.html", {}, "motion")):
        with pytest.raises(InputError, match=word):
            write_living_page(tmp_path / file, run, given, RUNTIME)
        assert not (tmp_path / file).exists()
    with pytest.raises(InputError, match="add format web"):
        FileFormat().check_name(tmp_path / "a.html")


def runtime() -> BrowserRuntime:
    """ONNX Runtime Web, where it is there."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    try:
        return read_runtime(os.environ.get("ONNXRUNTIME_WEB"))
    except InputError:
        pytest.skip("needs ONNX Runtime Web: npm pack onnxruntime-web, and ONNXRUNTIME_WEB=its .tgz")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    found, folder = runtime(), tmp_path_factory.mktemp("page")
    run, motions = lively("swing")
    x = run.animate(motions["long"])
    write_living_page(folder / "a.html", run, motions, found, refined=(4, x))
    with Browser((folder / "a.html").as_uri() + "#paused&azimuth=90&motion=long&frame=20", folder / "profile") as browser:
        browser.until(
            "document.documentElement?.dataset.ready === 'true' || document.getElementById('message')?.hidden === false"
        )
        yield run, motions, browser
        assert not browser.complaints


@pytest.mark.slow
def test_a_browser_gives_what_python_gives(page):
    run, motions, browser = page
    assert browser.evaluate("ncs.motions") == list(motions)
    for name, alpha in (("long", 0.0), ("long", 1.0), ("long", 1.5), ("short", 1.0)):
        motion = motions[name]
        flat = f"ncs.vertices('{name}', {alpha}).then(all => Float32Array.from(all.flatMap(x => [...x[WHICH]])))"
        x, skin = (browser.floats(flat.replace("WHICH", str(which))).reshape(len(motion.poses), -1, 3) for which in (0, 1))
        np.testing.assert_allclose(x, run.animate(motion, alpha), rtol=0, atol=1e-4)
        np.testing.assert_allclose(skin, body_vertices(run.assembly.body, motion), rtol=0, atol=1e-5)


def settled(browser: Browser, address: str) -> np.ndarray:
    browser.evaluate(f"location.hash = '{address}'")
    browser.evaluate("new Promise(done => setTimeout(done, 1500))")
    return browser.screenshot()


@pytest.mark.slow
def test_a_browser_shows_alpha_and_what_is_compared(page):
    _, _, browser = page
    seen = {alpha: settled(browser, f"paused&frame=20&alpha={alpha}&compare=0") for alpha in (0, 1, 2)}
    for alpha, image in seen.items():
        assert cloth_coloured(image).sum() > 400, alpha
    assert (cloth_coloured(seen[0]) != cloth_coloured(seen[2])).sum() > 50
    for elsewhere in (3, 45):  # whence it goes on, and whence it goes back
        settled(browser, f"paused&frame={elsewhere}&alpha=1&compare=0")
        assert np.array_equal(seen[1], settled(browser, "paused&frame=20&alpha=1&compare=0")), elsewhere
    settled(browser, "paused&frame=20&alpha=1&compare=1")
    names = browser.evaluate("[...document.querySelectorAll('#panes span')].map(x => x.textContent)")
    assert names == ["\N{GREEK SMALL LETTER ALPHA} = 0", "\N{GREEK SMALL LETTER ALPHA} = 1.00", REFINED]


@pytest.mark.slow
def test_a_joint_is_dragged_where_the_pointer_goes(page):
    _, _, browser = page
    settled(browser, "paused&frame=0&compare=0&posing=1&motion=short")
    places = "[...document.querySelectorAll('#handles i')].map(i => i.style.transform.match(/-?[0-9.]+/g).map(Number))"
    (root, before) = browser.evaluate(places)
    length = np.hypot(*np.subtract(before, root))
    goal = np.add(root, [0.6 * length, -0.8 * length])  # on the circle that its bone reaches
    browser.drag(before, goal)
    browser.evaluate("new Promise(done => setTimeout(done, 3000))")
    (there, after) = browser.evaluate(places)
    assert np.hypot(*np.subtract(there, root)) < 1 and np.hypot(*np.subtract(after, goal)) < 5, (after, goal)
    browser.evaluate("document.getElementById('unpose').click()")
    browser.evaluate("new Promise(done => setTimeout(done, 3000))")
    assert np.abs(np.subtract(browser.evaluate(places), [root, before])).max() < 0.2

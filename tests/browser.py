"""Headless Chromium, driven through its debugging pipe: open a page, evaluate, drag, take a screenshot."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
from PIL import Image

__all__ = ["CHROMIUM", "FLAGS", "Browser"]

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
FLAGS = [
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--hide-scrollbars", "--force-device-scale-factor=1", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


class Browser:
    """One page in a browser of its own; what it complains about is kept."""

    def __init__(self, address: str, profile: Path, size: tuple[int, int] = (800, 600)):
        down, self._out = os.pipe()
        self._in, up = os.pipe()
        self._rest, self._count, self._session, self.complaints = b"", 0, "", [""][:0]
        command = [str(CHROMIUM), *FLAGS, f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}"]
        as_it_reads = f'exec 3<&{down} 4>&{up} {down}<&- {up}>&-; exec "$@"'
        self._process = subprocess.Popen(
            ["bash", "-c", as_it_reads, "browser", *command, "--remote-debugging-pipe", "about:blank"],
            pass_fds=(down, up), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for end in (down, up):
            os.close(end)
        page = next(each for each in self.call("Target.getTargets")["targetInfos"] if each["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Runtime", "Page", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=address)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        try:
            self.call("Browser.close")
        except (EOFError, OSError):
            self._process.kill()
        self._process.wait(30)
        for end in (self._out, self._in):
            os.close(end)

    def call(self, method: str, **parameters) -> dict:
        self._count += 1
        session = {"sessionId": self._session} if self._session else {}
        message = {"id": self._count, "method": method, "params": parameters, **session}
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while (answer := self._read()).get("id") != self._count:
            kind, what = answer.get("method"), answer.get("params", {})
            if kind == "Runtime.exceptionThrown" or (kind == "Log.entryAdded" and what["entry"]["level"] == "error"):
                self.complaints.append(json.dumps(what)[:500])
        assert "error" not in answer, answer
        return answer["result"]

    def _read(self) -> dict:
        while b"\0" not in self._rest:
            more = os.read(self._in, 1 << 20)
            if not more:
                raise EOFError
            self._rest += more
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)

    def evaluate(self, text: str):
        """Return the value of an expression, or what it promises."""
        got = self.call("Runtime.evaluate", expression=text, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in got, got["exceptionDetails"]
        return got["result"].get("value")

    def until(self, text: str, seconds: float = 60.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.evaluate(text):
            assert time.monotonic() < end, (text, self.evaluate("document.body?.innerText"), self.complaints)
            time.sleep(0.05)

    def floats(self, text: str) -> np.ndarray:
        """Return the Float32Array that an expression promises."""
        pack = (
            "b => { let t = ''; for (let i = 0; i < b.length; i += 8192) t += String.fromCharCode(...b.subarray(i, i + 8192));"
        )
        got = self.evaluate(f"Promise.resolve({text}).then(x => ({pack} return btoa(t); }})(new Uint8Array(x.buffer)))")
        return np.frombuffer(base64.b64decode(got), np.float32)

    def screenshot(self) -> np.ndarray:
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def drag(self, start, end, steps: int = 8) -> None:
        """Press the left button at a place, go to another, and let go."""
        for kind, share in [
            ("mousePressed", 0),
            *(("mouseMoved", i / steps) for i in range(1, steps + 1)),
            ("mouseReleased", 1),
        ]:
            x, y = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

"""ONNX Runtime Web, which runs networks in a browser: read from its npm package, and what goes along with it."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ncs_jax.errors import InputError

__all__ = ["BrowserRuntime", "read_runtime"]

PACKAGE = "onnxruntime-web"
SCRIPT, MODULE, WASM = "dist/ort.wasm.min.mjs", "dist/ort-wasm-simd-threaded.mjs", "dist/ort-wasm-simd-threaded.wasm"
MEND = f"npm pack {PACKAGE}, then --runtime with the .tgz that it writes"

NOTICE = """\
This page contains {package} {version}, from npm, unchanged. The WebAssembly in it has parts by others, such
as Eigen (MPL-2.0), ONNX, FlatBuffers and Abseil (Apache-2.0), and Protocol Buffers (BSD-3-Clause):
ThirdPartyNotices.txt of the ONNX Runtime repository, microsoft/onnxruntime, has their notices and says where
their source is.

MIT License

Copyright (c) Microsoft Corporation

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
documentation files (the "Software"), to deal in the Software without restriction, including without
limitation the rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the
Software, and to permit persons to whom the Software is furnished to do so, subject to the following
conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions
of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED
TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL
THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF
CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER
DEALINGS IN THE SOFTWARE.
"""


@dataclass(frozen=True)
class BrowserRuntime:
    """The parts of ONNX Runtime Web that run a network on the processor, and the notice that has to go along with them.

    version: of the package. script, module: of JavaScript, which calls the WebAssembly. wasm: that. notice: licence and parts.
    """

    version: str
    script: bytes
    module: bytes
    wasm: bytes
    notice: str


def read_runtime(place: str | Path | None = None) -> BrowserRuntime:
    """Read ONNX Runtime Web from its npm package: its .tgz, its folder, or a folder in which npm has installed it.

    Nothing is fetched. Without a place, the current folder is looked through, first for `node_modules`.

    Raises:
        InputError: it is not there, or not a version that this page can use.
    """
    found = Path(place) if place is not None else _here()
    if found.is_file():
        try:
            with tarfile.open(found) as archive:
                return _read(lambda name: _member(archive, name), found)
        except tarfile.TarError as fault:
            raise InputError("the .tgz of the npm package expected", file=found, value=str(fault), mend=MEND) from fault
    inner = next((folder for folder in (found / "node_modules" / PACKAGE, found / "package") if folder.is_dir()), found)
    return _read(lambda name: (inner / name).read_bytes(), inner)


def _here() -> Path:
    if Path("node_modules", PACKAGE).is_dir():
        return Path("node_modules", PACKAGE)
    packed = sorted(Path().glob(f"{PACKAGE}-*.tgz"))
    if not packed:
        raise InputError(f"{PACKAGE}, which runs the network in the browser, is needed", field="--runtime", mend=MEND)
    return packed[-1]


def _member(archive: tarfile.TarFile, name: str) -> bytes:
    try:
        held = archive.extractfile(f"package/{name}")
    except KeyError:
        held = None
    if held is None:
        raise FileNotFoundError(name)
    return held.read()


def _read(read: Callable[[str], bytes], place: Path) -> BrowserRuntime:
    try:
        facts = json.loads(read("package.json"))
        script, module, wasm = (read(name) for name in (SCRIPT, MODULE, WASM))
    except (OSError, ValueError) as fault:
        what = f"the npm package {PACKAGE} expected, 1.19 or later, with package.json, {SCRIPT}, {MODULE} and {WASM}"
        raise InputError(what, file=place, field="--runtime", value=str(fault), mend=MEND) from fault
    if facts.get("name") != PACKAGE:
        raise InputError(f"the npm package {PACKAGE} expected", file=place, field="name", value=facts.get("name"), mend=MEND)
    version = str(facts.get("version", ""))
    return BrowserRuntime(version, script, module, wasm, notice=NOTICE.format(package=PACKAGE, version=version))

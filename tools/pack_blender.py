"""Pack the Blender add-on into a zip that Blender installs from disk: `python tools/pack_blender.py FOLDER`."""

from __future__ import annotations

import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
WHEN = (2026, 1, 1, 0, 0, 0)  # of every file, so that the same files give the same zip


def pack(folder: Path) -> Path:
    """Write the zip into a folder, and return its path."""
    source = ROOT / "blender"
    manifest = tomllib.loads((source / "blender_manifest.toml").read_text(encoding="utf-8"))
    folder.mkdir(parents=True, exist_ok=True)
    out = folder / f"{manifest['id']}-{manifest['version']}.zip"
    files = [*sorted(source.glob("*.py")), source / "blender_manifest.toml", ROOT / "LICENSE"]
    with zipfile.ZipFile(out, "w") as packed:
        for file in files:
            entry = zipfile.ZipInfo(file.name, WHEN)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            packed.writestr(entry, file.read_bytes())
    return out


if __name__ == "__main__":
    print(pack(Path(sys.argv[1])))

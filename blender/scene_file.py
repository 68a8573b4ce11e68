"""The scene file of a garment: what is chosen in Blender, what the fit found, and what the user adds."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

OWN = "own.toml"  # in the work folder: fields of the user's own, which win


def written(tables: dict, name: str = "") -> str:
    """Return tables as TOML."""
    plain = {key: value for key, value in tables.items() if not isinstance(value, dict)}
    lines = [f"[{name}]"] if name and plain else []
    lines += [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in plain.items()]
    text = "\n".join(lines) + "\n\n" if lines else ""
    inner = {key: value for key, value in tables.items() if isinstance(value, dict)}
    return text + "".join(written(table, f"{name}.{key}" if name else key) for key, table in inner.items())


def joined(*tables: dict) -> dict:
    """Return tables laid over each other; the later ones win."""
    out: dict = {}
    for table in tables:
        for key, value in table.items():
            both = isinstance(value, dict) and isinstance(out.get(key), dict)
            out[key] = joined(out[key], value) if both else value
    return out


def write_scene(folder: Path, pins: bool, motions: list[str], fps: float, own: Path) -> None:
    """Write scene.toml into a folder that holds the exported files; the fitted garment and its contact where there is one."""
    tables = {
        "body": {"file": "body.npz"},
        "garment": {"file": "garment.npz", **({"pins": "pins"} if pins else {})},
        "motion": {"files": motions, "fps": fps},
        "training": {"window": 15, "motion_augmentation": 0.5},
    }
    if (fitted := folder / "fitted.toml").exists():
        found = tomllib.loads(fitted.read_text(encoding="utf-8"))
        tables = joined(tables, {key: found[key] for key in ("garment", "physics", "training") if key in found})
    if own.exists():
        tables = joined(tables, tomllib.loads(own.read_text(encoding="utf-8-sig")))
    (folder / "scene.toml").write_text(written(tables), encoding="utf-8")


def file_names(names: list[str]) -> list[str]:
    """Return names that are good for files, all different, such as Armature_mixamo.com_Layer0."""
    out: list[str] = []
    for name in names:
        plain = re.sub(r"[^\w.-]+", "_", name).strip("._") or "motion"
        while plain.lower() in (other.lower() for other in out):
            plain += "_"
        out.append(plain)
    return out

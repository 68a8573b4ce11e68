"""The rooms of the package: how large each is, and what it imports, imports within functions included.

    python -m tools.rooms

prints them from the top floor to the lowest. `tests/test_style.py` holds every import to this order.
"""

from __future__ import annotations

import ast
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "ncs_jax"

# From the top down: a room may import those after it, and none before. Rooms on one line do not know each other.
FLOORS = (
    ("cli",),
    ("view",),
    ("runs",),
    ("export",),
    ("prepare",),
    ("training", "metrics"),
    ("network", "simulation"),
    ("scene",),
    ("energies",),
    ("io", "geometry"),
    ("errors",),
)
INNER = {  # the same within a room that has rooms of its own
    "io": (("animation",), ("character",), ("mesh",), ("tables",), ("records",)),
    "energies": (("total", "elements"), ("terms",), ("contact",)),
    "network": (("methods",), ("rollout", "compression")),
}


def modules() -> dict[str, Path]:
    """Return every module of the package by its name below `ncs_jax`, "" for the package's own face."""
    names = {p: ".".join(p.relative_to(SOURCE).with_suffix("").parts) for p in sorted(SOURCE.rglob("*.py"))}
    return {name.removesuffix("__init__").removesuffix("."): path for path, name in names.items()}


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """Return the modules of the package that a file imports anywhere, in functions and for types too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            if name.split(".")[0] == "ncs_jax":
                name = name.removeprefix("ncs_jax").removeprefix(".")
                while name not in known:
                    name = name.rpartition(".")[0]
                found.add(name)
    return found


def graph() -> dict[str, set[str]]:
    """Return what every module imports of the package."""
    known = modules()
    return {name: imports(path, known) for name, path in known.items()}


def room(module: str) -> str:
    """Return the room that a module is in."""
    return module.split(".")[0]


def main() -> None:
    """Print the rooms, from the top floor to the lowest."""
    known, edges = modules(), graph()
    for rooms in FLOORS:
        for name in rooms:
            own = [m for m in known if room(m) == name]
            lines = sum(len(known[m].read_text(encoding="utf-8").splitlines()) for m in own)
            below = sorted({room(other) for m in own for other in edges[m]} - {name})
            print(f"{name:12}{len(own):4} modules {lines:6} lines   imports {', '.join(below) or 'nothing'}")


if __name__ == "__main__":
    main()

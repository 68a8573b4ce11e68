"""Docstrings of the API pages with their arguments, results and errors as lists, each argument with its type.

Sections of a docstring may name several arguments on a line: what a function's signature names begins a new item.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import griffe

SECTION = re.compile(r"^(Args|Attributes|Returns|Raises):\n((?:    .*\n|\n)+)", re.MULTILINE)
HEADINGS = {"Args": "Arguments", "Attributes": "Attributes", "Returns": "Returns", "Raises": "Raises"}


class ArgumentLists(griffe.Extension):
    """Rewrite the docstrings of everything that a page shows."""

    def on_function_instance(self, *, func: griffe.Function, **_) -> None:
        """Rewrite a function's docstring by the names and types of its signature."""
        self._rewrite(func, {p.name.lstrip("*"): p.annotation for p in func.parameters if p.name not in ("self", "cls")})

    def on_class_members(self, *, cls: griffe.Class, **_) -> None:
        """Rewrite a class's docstring by the names and types of its fields."""
        self._rewrite(cls, {name: a.annotation for name, a in cls.members.items() if a.is_attribute})

    def _rewrite(self, thing: griffe.Object, types: dict) -> None:
        if thing.docstring is not None:
            thing.docstring.value = with_lists(thing.docstring.value, {name: str(kind or "") for name, kind in types.items()})


def with_lists(text: str, types: dict[str, str]) -> str:
    """Return a docstring with its sections as Markdown lists; `types` of what its signature names, "" where it has none."""

    def section(found: re.Match) -> str:
        words = " ".join(found[2].split())
        lines = [f"- {item}" for item in items(words, types, found[1])]
        return f"\n**{HEADINGS[found[1]]}**\n\n" + "\n".join(lines) + "\n\n"

    return SECTION.sub(section, text.rstrip() + "\n").rstrip()


def items(words: str, types: dict[str, str], kind: str) -> Iterator[str]:
    """Yield the items of a section's words: each begins with names, one or several with commas between, and a colon."""
    if kind == "Returns":
        yield words
        return
    one = r"[A-Z]\w+" if kind == "Raises" else "|".join(map(re.escape, sorted(types, key=len, reverse=True))) or r"\w+"
    start = re.compile(rf"(?:^|(?<=[.;)] ))((?:{one})(?:(?:, | and )(?:{one}))*): ")
    parts = start.split(words)
    if parts[0].strip():  # no name of the signature's
        yield parts[0].strip()
    for names, told in zip(parts[1::2], parts[2::2], strict=True):
        shown = [f"`{name}`" + (f" (`{types[name]}`)" if types.get(name) else "") for name in re.split(", | and ", names)]
        yield f"{', '.join(shown)}: {told.strip()}"

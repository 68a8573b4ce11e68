"""Check everything in the README and the pages that a reader might copy: commands, Python blocks and scenes.

    python -m tools.run_docs                    # reads only; seconds
    python -m tools.run_docs --run [PAGE ...]   # really runs them, at small sizes, in a temporary folder; tens of minutes

Reading checks that the real parser accepts every `ncs` command; that every `python -m` module exists and its own parser
accepts the options; that every `make` target, every test file and every extra of `pip install` exists; that every Python
block compiles and finds all that it takes from modules; and that every TOML block is a scene. In running text a command may
leave out what is required.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import importlib.util
import inspect
import io
import itertools
import re
import shlex
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)(?: {4}\S.*\n)+")
SPAN = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
PROGRAMS = ("ncs", "make", "python", "pytest", "pip")
OTHERS = ("python3", ".", "cd", "git", "g++", "./host", "npm")  # a shell's own, what sets things up, and what is compiled
LEADING = re.compile(r"^((?:[A-Z_]+=\S+|srun)\s+)*")
BRACKET = re.compile(r"\s*\[(-[^\]]*)\]")
PLACEHOLDERS = {"N": "1", "M": "1", "K": "1", "A": "1", "R": "8"}


@dataclass(frozen=True)
class Sample:
    """Something to copy: `kind` is sh, python, toml, or said for a command in running text."""

    page: str
    line: int
    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.text.splitlines()[0]}"


def pages() -> list[Path]:
    """Return the README and the pages that are checked."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def samples(page: str, text: str) -> list[Sample]:
    """Return all samples of a page in their order; a shell block gives one for each of its commands."""
    found = []
    for block in FENCE.finditer(text):
        body = "".join(line.removeprefix(block[1]) for line in block[3].splitlines(keepends=True))
        found.append((block.start(3), block[2], body))
    plain = FENCE.sub(lambda block: re.sub(r"[^\n]", " ", block[0]), text)
    found += [
        (block.start(), "sh", re.sub(r"^ {4}", "", block[0], flags=re.MULTILINE))
        for block in INDENTED.finditer(plain)
        if block[0].split()[0] in PROGRAMS
    ]
    found += [(span.start(), "said", span[1]) for span in SPAN.finditer(plain) if span[1].split()[0] in PROGRAMS]
    out = []
    for start, kind, body in sorted(found):
        line = text.count("\n", 0, start) + 1
        if kind in ("sh", "said"):
            lines = enumerate(body.replace("\\\n", " ").splitlines())
            told = ((i, re.sub(r"(^|\s+)#\s.*$", "", command).strip()) for i, command in lines)
            out += [Sample(page, line + i, kind, command) for i, command in told if command]
        elif kind in ("python", "toml"):
            out.append(Sample(page, line, kind, body))
    return out


def written_out(command: str) -> Iterator[list[str]]:
    """Yield the words of a command: once without what stands in brackets, and once with each choice of each bracket."""
    plain = BRACKET.sub("", command)
    choices = [[choice.strip() for choice in bracket.split(" | ")] for bracket in BRACKET.findall(command)]
    for choice in ("", *itertools.chain.from_iterable(choices)):
        yield [PLACEHOLDERS.get(word, word) for word in shlex.split(LEADING.sub("", f"{plain} {choice}"))]


class _Parsed(Exception):
    """The options were accepted."""


def refused(main: Callable, words: Sequence[str], lenient: bool = False) -> str:
    """Return why a program's own parser does not accept the words; empty where it does. Nothing runs."""
    parse = argparse.ArgumentParser.parse_args
    wrong = argparse.ArgumentParser.error

    def accepted(self, arguments=None, namespace=None):
        parse(self, arguments, namespace)
        raise _Parsed

    def error(self, message):
        if lenient and ("are required" in message or "is required" in message):
            raise _Parsed
        wrong(self, message)

    said = io.StringIO()
    with (
        mock.patch.object(argparse.ArgumentParser, "parse_args", accepted),
        mock.patch.object(argparse.ArgumentParser, "error", error),
        contextlib.redirect_stderr(said),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        try:
            main(list(words))
        except _Parsed:
            return ""
        except SystemExit as end:
            return "" if end.code == 0 else said.getvalue().strip().splitlines()[-1]
    return "reads no options" if words else ""


def fault(sample: Sample) -> str:
    """Return what is wrong with a sample; empty where nothing is."""
    if sample.kind == "toml":
        return _scene_fault(sample.text)
    if sample.kind == "python":
        return _python_fault(sample.text)
    for words in written_out(sample.text):
        if why := command_fault(words, lenient=sample.kind == "said"):
            return why
    return ""


def command_fault(words: list[str], lenient: bool) -> str:
    """Return what is wrong with a command; `lenient` lets what is required be left out."""
    program, *rest = words
    if program == "ncs":
        from ncs_jax.cli import main

        return refused(main, [word for word in rest if word != "..."], lenient) if rest else ""
    if program == "make":
        text = (ROOT / "Makefile").read_text()
        targets = [word for word in rest if "=" not in word]
        unknown = [word for word in targets if not re.search(rf"^{re.escape(word)}:", text, re.MULTILINE)]
        unknown += [word for word in rest if "=" in word and f"$({word.split('=')[0]})" not in text]
        return f"the Makefile has no {unknown[0]}" if unknown else ""
    if program == "pytest":
        missing = [word for word in rest if not word.startswith("-") and not (ROOT / word.split("::")[0]).exists()]
        return f"there is no {missing[0]}" if missing else ""
    if program == "pip":
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        named = [extra for word in rest for extra in re.findall(r"^(?:\.|ncs-jax)\[(\w+)\]", word)]
        return next((f"there is no extra {extra}" for extra in named if extra not in extras), "")
    if program == "python":
        return _python_command_fault(rest)
    return "" if program in OTHERS else f"{program}: an unknown program"


def _python_command_fault(words: list[str]) -> str:
    if words[0] != "-m":
        return "" if (ROOT / words[0]).is_file() else f"there is no {words[0]}"
    name, rest = words[1], words[2:]
    if name.startswith("tests."):  # not imported: the tests set JAX up for themselves
        return "" if importlib.util.find_spec(name) else f"there is no {name}"
    try:
        module = importlib.import_module(name)
        if hasattr(module, "__path__"):
            module = importlib.import_module(f"{name}.__main__")
    except ImportError as error:
        return str(error)
    main = getattr(module, "main", None)
    if main is None or not inspect.signature(main).parameters:
        return f"{name} reads no options" if rest else ""
    return refused(main, rest)


def _scene_fault(text: str) -> str:
    from ncs_jax import InputError, scene_from

    try:
        scene_from(tomllib.loads(text))
    except (InputError, tomllib.TOMLDecodeError) as error:
        return str(error)
    return ""


def _python_fault(text: str) -> str:
    try:
        tree = ast.parse(text)
    except SyntaxError as error:
        return str(error)
    try:
        known = _imported(tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                owner = known.get(node.value.id)
                if inspect.ismodule(owner):
                    getattr(owner, node.attr)
    except (ImportError, AttributeError) as error:
        return str(error)
    return ""


HOSTS = ("bpy",)  # modules that are there in a host alone, such as Blender


def _imported(tree: ast.Module) -> dict[str, object]:
    """Return what the imports of a block bring, by the names that they give it."""
    known: dict[str, object] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in HOSTS:
                    continue
                module, top = importlib.import_module(alias.name), alias.name.split(".")[0]
                known[alias.asname or top] = module if alias.asname else sys.modules[top]
        elif isinstance(node, ast.ImportFrom):
            module = importlib.import_module(str(node.module))
            known |= {alias.asname or alias.name: getattr(module, alias.name) for alias in node.names}
    return known


def faults(chosen: Sequence[Path] | None = None) -> list[str]:
    """Return what is wrong in the pages, one line each."""
    found = []
    for page in chosen or pages():
        name = str(page.relative_to(ROOT))
        found += [f"{sample}: {why}" for sample in samples(name, page.read_text(encoding="utf-8")) if (why := fault(sample))]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(prog="python -m tools.run_docs", description=__doc__.splitlines()[0])
    parser.add_argument("--run", action="store_true", help="really run them, at small sizes, in a temporary folder")
    parser.add_argument("--experiments", action="store_true", help="with --run: these and the benchmarks too, an hour more")
    parser.add_argument("pages", nargs="*", type=Path, metavar="PAGE", help="these pages (default: all)")
    o = parser.parse_args(arguments)
    chosen = [page.resolve() for page in o.pages]
    wrong = faults(chosen)
    if o.run and not wrong:
        from tools.follow_docs import follow

        wrong = follow(chosen or pages(), experiments=o.experiments)
    print("\n".join(wrong) or f"{len(chosen or pages())} pages: good")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())

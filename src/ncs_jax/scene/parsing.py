"""A scene file to tables, and these to dataclasses: every key a field, every value of its type and in its range."""

from __future__ import annotations

import dataclasses
import difflib
import re
import tomllib
import types
import typing
from collections.abc import Iterator
from pathlib import Path

from ncs_jax.errors import InputError

__all__ = ["checked_value", "parse_table", "read_toml"]

THOUSANDTHS = {"m": "mm", "kg/m^2": "g/m^2"}  # in which lengths and densities are often given
SINGLE = "or put the path in single quotes"
BACKSLASHES = r"\\+"
BACKSLASH = re.compile(r'"[^"]*\\[^"]*"')
UNQUOTED = re.compile(r"\s*(?P<key>[\w.-]+)\s*=\s*(?P<value>(?!true\b|false\b)[A-Za-z_./~][^\"'#]*?)\s*(?:#.*)?")
COMMA = re.compile(r"\s*(?P<key>[\w.-]+)\s*=\s*(?P<whole>[-+]?\d+),(?P<part>\d+)\s*(?:#.*)?")


def read_toml(file: Path) -> dict:
    """Return the tables of a TOML file.

    Raises:
        InputError: it cannot be read or is not TOML, or a text has a tab or a line's end, as "C:\\temp" in double quotes has.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark
        tables = tomllib.loads(text)
    except FileNotFoundError:
        raise InputError("no such scene file", file=file, mend="check the path, or try ncs:tshirt") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", file=file, mend="give a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise _not_toml(file, text, error) from None
    for where, value in _texts(tables, ""):
        if re.search(r"[\x00-\x1f\x7f]", value):
            raise InputError(
                "a text without tabs and ends of lines expected, which a backslash in double quotes may mean", file=file,
                field=where, value=value, mend=f"write / in the place of a backslash, {SINGLE}",
            )  # fmt: skip
    return tables


def _not_toml(file: Path, text: str, error: tomllib.TOMLDecodeError) -> InputError:
    """Return the error of a file that is not TOML: with its line, and the mend of what is usual."""
    found = re.search(r"at line (\d+)", str(error))
    line = text.splitlines()[int(found[1]) - 1].strip() if found and int(found[1]) <= len(text.splitlines()) else None
    mend = "correct that line"
    if line and (path := BACKSLASH.search(line)):
        mend = f"a backslash in double quotes begins a sign: write {re.sub(BACKSLASHES, '/', path[0])}, {SINGLE}"
    elif line and (bare := UNQUOTED.fullmatch(line)):
        mend = f'text stands in quotes: {bare["key"]} = "{bare["value"]}"'
    elif line and (number := COMMA.fullmatch(line)):
        mend = f"a number has a point, no comma: {number['key']} = {number['whole']}.{number['part']}"
    return InputError(f"not TOML: {error}: {line[:80]}" if line else f"not TOML: {error}", file=file, mend=mend)


def _texts(value, where: str) -> Iterator[tuple[str, str]]:
    """Yield the texts in tables and lists, each with what an error calls its place."""
    if isinstance(value, str):
        yield where, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _texts(item, f"{where}.{key}".lstrip("."))
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from _texts(item, f"{where}[{number}]")


def parse_table(cls, tables, source: str, where: str):
    """Return a dataclass from a table: every key must be a field, every value of its type and in its range."""
    if not isinstance(tables, dict):
        named = isinstance(tables, str) and any(f.name == "file" for f in dataclasses.fields(cls))
        mend = f'write file = "{tables}" below [{where}]' if named else f"write [{where}] and its fields"
        raise InputError("a table expected", file=source, field=where, value=tables, mend=mend)
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if not f.metadata.get("internal")}
    for key in tables:
        if key not in fields:
            near = next(iter(difflib.get_close_matches(key, list(fields), n=1)), "")
            mend = f"did you mean {near}?" if near else f"the fields here are {', '.join(fields)}"
            value = "a table" if isinstance(tables[key], dict) else tables[key]
            raise InputError("unknown key", file=source, field=f"{where}.{key}".lstrip("."), value=value, mend=mend)
    values = {}
    for name, f in fields.items():
        if name in tables:
            values[name] = checked_value(hints[name], tables[name], f.metadata, source, f"{where}.{name}".lstrip("."))
    return cls(**values)


def checked_value(kind, value, meta, source, where):
    """Return a value as the type of its field, after a check of type, choices and range."""
    if dataclasses.is_dataclass(kind):
        return parse_table(kind, value, source, where)
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        kinds = typing.get_args(kind)  # a list, or one word
        word = isinstance(value, str)
        meta = {**meta, "choices": meta["choices"] if word else ()}
        return checked_value(str if word else next(k for k in kinds if k is not str), value, meta, source, where)
    if origin is tuple:
        if isinstance(value, str | int | float) and not isinstance(value, bool):
            raise InputError("a list expected", file=source, field=where, value=value, mend=f"write [{value!r}]")
        if not isinstance(value, list | tuple):
            raise InputError("a list expected", file=source, field=where, value=value)
        item = typing.get_args(kind)[0]
        return tuple(checked_value(item, v, meta, source, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is dict:
        if not isinstance(value, dict):
            raise InputError("a table expected", file=source, field=where, value=value, mend='write { "theirs" = "ours" }')
        return {k: checked_value(typing.get_args(kind)[1], v, meta, source, f"{where}.{k}") for k, v in value.items()}
    if kind is str and isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    number = isinstance(value, int | float) and not isinstance(value, bool)
    good = {
        bool: isinstance(value, bool),
        int: number and float(value).is_integer(),
        float: number,
        str: isinstance(value, str),
    }
    if not good[kind]:
        names = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
        quoted = isinstance(value, str) and kind is not bool and re.fullmatch(r"[-+.]*\d[-+.\de]*", value.strip())
        mend = f"write it without quotes: {where.rsplit('.', 1)[-1]} = {value.strip()}" if quoted else None
        raise InputError(f"{names[kind]} expected ({meta['help']})", file=source, field=where, value=value, mend=mend)
    if meta["choices"] and value not in meta["choices"]:
        raise InputError(f"one of {', '.join(meta['choices'])} expected", file=source, field=where, value=value)
    if kind in (int, float):
        low, high = meta["low"], meta["high"]
        if not (low < value <= high if meta["above"] else low <= value <= high):
            bounds = f"a number {'above' if meta['above'] else 'from'} {low:g} {'up ' if meta['above'] else ''}to {high:g}"
            mend = None
            for unit, smaller in THOUSANDTHS.items():
                if value > high >= value / 1000 >= low and re.search(rf", {re.escape(unit)}(?=$|[;:])", meta["help"]):
                    mend = (
                        f"{value:g} {smaller} are {value / 1000:g} {unit}: write {where.rsplit('.', 1)[-1]} = {value / 1000:g}"
                    )
            raise InputError(f"{bounds} expected ({meta['help']})", file=source, field=where, value=value, mend=mend)
    return kind(value)

"""Opening files that are there, replacing files that are finished: every failure of the file system becomes an InputError."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ncs_jax.errors import InputError

__all__ = ["LARGEST", "check_place", "decoded", "readable", "reading", "replacing", "suffix_lacking", "text_of", "unpackable"]

LARGEST = 4 * 2**30  # bytes; no array or text of a file may need more
PACKING = 1100  # deflate packs at most 1032 to 1: a header that promises more than the file can hold is wrong

# How files begin that are no mesh, motion or table, whatever they are called.
OTHERS = {
    b"\x89PNG": "a PNG picture", b"\xff\xd8\xff": "a JPEG picture", b"GIF8": "a GIF picture", b"8BPS": "a Photoshop picture",
    b"%PDF": "a PDF", b"<!DOCTYPE": "a web page", b"<!doctype": "a web page", b"<html": "a web page", b"BLENDER": "a .blend",
}  # fmt: skip

# Characters of words for parts of a body, by the encodings in which editors on Windows save them.
PARTS = {
    "cp932": "左右上下半身首腰肩腕肘手足膝頭胸指骨盤脚ひじざつまセンターグルブ",
    "gb18030": "左右上下身首腰肩腕肘手足膝头胸指骨盆脚腿臂颈髋脊柱踝趾根",
    "euc-kr": "왼쪽오른손목팔다리발무릎어깨엉덩머척추허가슴골반상하체루트",
}


def readable(path: str | Path) -> Path:
    """Return the path of a file. Raise an InputError unless it is a file that may be read, not empty nor of `OTHERS`."""
    file = Path(path).expanduser()
    if file.is_dir():
        raise InputError("a file expected", file=file, value="a folder", mend="name a file in it")
    if not file.is_file():
        raise InputError("no such file", file=file, mend="check the path")
    try:
        with file.open("rb") as opened:
            size, begins = file.stat().st_size, opened.read(16)
    except OSError as error:
        raise InputError(f"cannot be opened: {error}", file=file, mend="check the path and its permissions") from None
    if size == 0:
        raise InputError("an empty file", file=file, value="0 bytes", mend="write it again")
    if found := next((what for start, what in OTHERS.items() if begins.startswith(start)), None):
        mend = "export it from where it was made, or get it again: another name makes no other file"
        raise InputError(f"a {file.suffix or 'file to read'} expected, by what is in it", file=file, value=found, mend=mend)
    return file


@contextmanager
def reading(file: Path, kind: str) -> Iterator[None]:
    """Turn whatever a foreign parser raises on a broken file into one InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib, h5py and trimesh each have their own dozen
        raise InputError(
            f"not a readable {kind} file: {type(error).__name__} {' '.join(str(error).split())[:200]}".rstrip(),
            file=file,
            mend="the file is damaged or of another format; write it again",
        ) from None


def suffix_lacking(path: str | Path) -> str:
    """Return what a path without a suffix is, in the words of an error."""
    return "a folder" if Path(path).is_dir() else "no suffix"


def text_of(path: str | Path) -> tuple[Path, str]:
    """Read a whole text file, in any of the encodings of `decoded`; its lines end with a newline alone."""
    file = readable(path)
    size = file.stat().st_size
    if size > LARGEST // 4:
        raise InputError(f"at most {LARGEST // 4} bytes expected", file=file, value=f"{size} bytes", mend="split it")
    with reading(file, "text"):
        return file, decoded(file.read_bytes()).replace("\r\n", "\n").replace("\r", "\n")


def decoded(data: bytes) -> str:
    """Return the text that bytes are: UTF-8, UTF-16 with or without its mark, else Shift-JIS, GB18030, EUC-KR or Latin-1.

    Of the encodings of `PARTS` it is the one in which most characters are of words for parts of a body. Where none is, bytes
    from 0x80 to 0x9f tell Japanese from Western European: they begin most Japanese characters, and are no letters there.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    if b"\0" in data[:4]:  # no text but UTF-16 has a zero byte beside its first letters
        return data.decode("utf-16-be" if data[:1] == b"\0" else "utf-16-le", errors="replace")
    with suppress(UnicodeDecodeError):
        return data.decode("utf-8-sig")
    found = {}
    for encoding, parts in PARTS.items():
        with suppress(UnicodeDecodeError):
            text = data.decode(encoding)
            found[text] = sum(text.count(part) for part in parts)
    if max(found.values(), default=0):
        return max(found, key=lambda text: found[text])
    with suppress(UnicodeDecodeError):
        return data.decode("cp932" if re.search(rb"[\x80-\x9f]", data) else "latin-1")
    return data.decode("latin-1")


def unpackable(file: Path, field: str, size: int) -> None:
    """Raise an InputError where an array needs more memory than is allowed, or more than its file can hold when packed."""
    if size > LARGEST:
        raise InputError(
            f"at most {LARGEST} bytes expected", file=file, field=field, value=f"{size} bytes", mend="split the file"
        )
    if size > PACKING * file.stat().st_size:
        raise InputError(
            f"more than a file of {file.stat().st_size} bytes can hold", file=file, field=field, value=f"{size} bytes",
            mend="the header is damaged; write it again",
        )  # fmt: skip


def check_place(path: str | Path) -> Path:
    """Return the path of a file that is to be written later. Raise an InputError where it cannot be, before work is lost.

    That is where its folder, or the one that this is to be made in, is a file or may not be written to.
    What is there already, `replacing` replaces.
    """
    file = Path(path).expanduser()
    if "\0" in str(file) or not file.name:
        raise InputError("a file name expected", file=file, value=str(path), mend="name a file")
    there = next(folder for folder in file.absolute().parents if os.path.exists(folder))  # which raises nothing
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        kind = "may not be written to" if there.is_dir() else "is not a folder"
        raise InputError(f"cannot be written: {there} {kind}", file=file, mend="choose a place that you may write to")
    return file


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; it takes the place of `path` once all is written, else it is removed.

    Missing parent folders are made. A folder may replace a folder: the caller first checks what would be lost.
    """
    file = check_place(path)
    part = file.with_name(f".{file.name}.{os.getpid()}-{secrets.token_hex(4)}.part{file.suffix}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if file.is_dir() and part.is_dir():
            old = part.with_suffix(".old")
            os.replace(file, old)
            os.replace(part, file)
            shutil.rmtree(old, ignore_errors=True)
        else:
            os.replace(part, file)
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror or error}", file=file,
            mend="choose a place that you may write to and that has room",
        ) from None  # fmt: skip
    finally:
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        else:
            with suppress(OSError):  # where its folder is a file, there is nothing to remove
                part.unlink(missing_ok=True)

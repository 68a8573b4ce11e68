"""The package's commands in processes of their own: where they are, how far they are, and how they are stopped."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

STEP = re.compile(r"\bstep (\d+)/(\d+)")
NO_WINDOW = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows would show one for each command
PATIENCE = 20.0  # s that a command has to end by itself, once it is asked to


def command_at(place: str) -> list[str]:
    """Return the command that a path means: of a Python, that of the package in it; else the path itself."""
    path = Path(place)
    if path.is_dir():  # an environment
        inner = path / ("Scripts" if os.name == "nt" else "bin")
        path = next((p for p in (inner / "ncs", inner / "ncs.exe") if p.exists()), inner / "python")
    return [str(path), "-m", "ncs_jax.cli"] if path.name.lower().startswith("python") else [str(path)]


def find_command(chosen: str, own: Path) -> list[str]:
    """Return how to call the package: as chosen, else in the add-on's own environment, else on PATH; empty: it is nowhere."""
    if chosen:
        return command_at(chosen) if Path(chosen).exists() else []
    if own.is_dir() and (found := command_at(str(own)))[0] and Path(found[0]).exists():
        return found
    there = shutil.which("ncs")
    return [there] if there else []


def install_commands(own: Path, package: str) -> list[list[str]]:
    """Return the commands that make an environment in a folder and install the package there."""
    python = own / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    return [
        [sys.executable, "-m", "venv", "--clear", str(own)],
        [str(python), "-m", "pip", "install", "--disable-pip-version-check", package],
    ]


def environment() -> dict[str, str]:
    """Return the environment of a command: ours, without what Blender sets for its own Python, and with UTF-8."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONHOME"}
    return {**kept, "PYTHONIOENCODING": "utf-8", "PYTHONUNBUFFERED": "1"}


class Process:
    """A command that runs, and the file to which all its output goes."""

    def __init__(self, command: list[str], folder: Path, log: Path) -> None:
        """Start it in a folder.

        Raises:
            OSError: there is no such program, or the file cannot be written.
        """
        self.command, self.log, self._asked = command, log, 0.0  # and when it was asked to stop
        with log.open("wb") as stream:
            self._popen = subprocess.Popen(
                command,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                env=environment(),
                start_new_session=os.name != "nt",
                creationflags=NO_WINDOW,
            )

    def running(self) -> bool:
        """Tell whether it still runs; one that was asked to stop, and does not, is ended."""
        if self._popen.poll() is None and self._asked and time.monotonic() - self._asked > PATIENCE:
            self._popen.kill()
        return self._popen.poll() is None

    @property
    def code(self) -> int | None:
        """Return the exit code, None while it runs."""
        return self._popen.poll()

    @property
    def asked(self) -> bool:
        """Tell whether it was asked to stop."""
        return self._asked > 0

    def text(self) -> str:
        """Return what it has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def stop(self, at_once: bool = False) -> None:
        """Ask it to stop, as Ctrl-C does: a training keeps what it has. At once: end it."""
        if self._popen.poll() is not None:
            return
        if os.name == "nt" or at_once or self._asked:
            self._popen.terminate()
        else:
            self._popen.send_signal(signal.SIGINT)
        self._asked = self._asked or time.monotonic()


def progress(text: str) -> tuple[str, float]:
    """Return the line that says how a command is doing, and which share of it is done, -1 where that is not said."""
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    for line in reversed(lines[-20:]):
        if found := STEP.search(line):
            return line, min(int(found[1]) / max(int(found[2]), 1), 1.0)
        if not line.startswith(("total", "strain")):
            return line, -1.0
    return (lines[-1], -1.0) if lines else ("", -1.0)


def warnings(text: str) -> list[str]:
    """Return what a command has warned of: its lines that say so, and motion beyond what the garment was trained on."""
    found = re.findall(r"^(?:ncs: warning: |  beyond +)(.+(?:\n {14}.+)*)", text, re.MULTILINE)
    return list(dict.fromkeys(" ".join(words.split()) for words in found))


def reason(text: str) -> str:
    """Return why a command failed: its last line that begins with `ncs:`, else its last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    said = [line for line in lines if line.startswith("ncs:") and not line.startswith("ncs: warning")]
    return (said or lines or ["it ended without a word"])[-1]

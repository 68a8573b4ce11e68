"""Say how work goes: a bar with what it says below it in a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

from ncs_jax.cli.clock import clock

__all__ = ["WorkProgress"]

EVERY = 10.0  # s between lines, where the output is no terminal


class WorkProgress:
    """How a piece of work goes. Where the output is a file or a pipe, a line every ten seconds, and the last.

    with WorkProgress("reading the scene") as progress:
        progress.show("frame 3/24", 3, 24)
    """

    def __init__(self, doing: str, *, console=None, quiet: bool = False) -> None:
        """Say at first what is being done. `console`: Rich's, else that of stdout. `quiet`: say nothing at all."""
        from rich.console import Console, Group
        from rich.live import Live
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._console = console or Console(quiet=quiet)
        self._lines = not self._console.is_terminal
        percent = TextColumn("{task.percentage:>3.0f}%")
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=None), percent, TimeElapsedColumn())
        self._bar = Progress(*columns, console=self._console, expand=True)
        self._task = self._bar.add_task(doing, total=None)
        self._since = time.monotonic()
        self._live = Live(Group(self._bar), console=self._console, redirect_stderr=sys.stderr.isatty())
        self._doing, self._said, self._over = doing, -EVERY, threading.Event()

    def __enter__(self) -> WorkProgress:
        if self._lines:
            threading.Thread(target=self._tick, daemon=True).start()
            self.begin(self._doing)
        else:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._over.set()
        if not self._lines:
            self._live.stop()

    def _tick(self) -> None:
        """Say again and again what is being done, and for how long already, until it shows how much is done."""
        while not self._over.wait(EVERY):
            if self._doing:
                self.say(f"{self._doing}, {clock(time.monotonic() - self._since)}")

    def begin(self, doing: str) -> None:
        """Say what is done next, of which nobody knows how long it takes."""
        self._doing, self._since = doing, time.monotonic()
        if self._lines:
            self.say(f"{doing} ...")
        else:
            self._bar.update(self._task, description=doing)

    def show(self, what: str, done: float, total: float, *details: str, left: float | None = None) -> None:
        """Show that so much of the work is done. `details`: each a line below the bar. `left`: how long it still takes, s."""
        from rich.console import Group
        from rich.text import Text

        self._doing = ""
        what = what if left is None else f"{what}, {clock(left)} left"
        if not self._lines:
            self._bar.update(self._task, description=what, completed=done, total=total)
            self._live.update(Group(self._bar, *map(Text, details)))
        elif done >= total or time.monotonic() - self._said >= EVERY:
            self._said = time.monotonic()
            self.say("  ".join((what, *(details or (f"{done / total:.0%}",)))))

    def say(self, line: str) -> None:
        """Print a line, above the bar if there is one, uncut."""
        self._console.print(line, soft_wrap=True, markup=False, highlight=False)
        self._console.file.flush()

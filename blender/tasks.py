"""One task at a time, in small pieces: Blender stays free while frames are read and a command runs."""

import tempfile
import time
from collections.abc import Generator
from pathlib import Path

import bpy

from .pose import Wrong
from .process import Process, progress, reason

EVERY = 0.2  # s between looks at a command
SLICE = 0.05  # s of work at once
WAITS = bpy.app.background  # without a window nothing else is to be done meanwhile


class Command:
    """A command to run in a folder; a task that yields it goes on when it has ended well, and gets what it printed."""

    def __init__(self, command: list[str], folder: Path, label: str) -> None:
        """Keep it. label: of the text in Blender that shows what it prints."""
        self.command, self.folder, self.label = command, folder, label


class Task:
    """What is done now, or was done last.

    text: what it says. share: how much of it is done, -1 where nobody knows. over: whether it has ended. failed: whether badly.
    """

    def __init__(self, name: str, steps: Generator) -> None:
        """Begin with steps that yield a text, or a `Command`."""
        self.name, self.text, self.share, self.over, self.failed = name, "", -1.0, False, False
        self._steps, self._process, self._label = steps, None, ""

    def begin(self) -> None:
        """Do the first step, while what was chosen is at hand."""
        self._go_on(None)

    def advance(self) -> None:
        """Look at the command that runs, or go on with the steps for a moment."""
        if self._process is not None:
            running = self._process.running()
            text = self._process.text()
            self.text, self.share = progress(text)
            if running:
                return
            process, self._process = self._process, None
            show(self._label, text)
            process.log.unlink(missing_ok=True)
            if process.code:
                self._end("stopped" if process.asked else reason(text), failed=True)
                return
            self._go_on(text)
        until = time.monotonic() + SLICE
        while not self.over and self._process is None and time.monotonic() < until:
            self._go_on(None)

    def stop(self) -> None:
        """Ask the command to stop, or leave the steps out."""
        if self._process is None:
            self._end("stopped", failed=True)
        else:
            self._process.stop()
            self.text = "stopping"

    def end(self) -> None:
        """End at once: Blender closes, or the add-on goes."""
        if self._process is not None:
            self._process.stop(at_once=True)
        self._end("stopped", failed=True)

    def _go_on(self, sent) -> None:
        try:
            step = self._steps.send(sent)
        except StopIteration as done:
            self._end(done.value or "done", failed=False)
        except (Wrong, OSError) as wrong:
            self._end(str(wrong), failed=True)
        except BaseException:
            self._end("a fault of the add-on: see the system console", failed=True)
            raise
        else:
            if isinstance(step, Command):
                log = Path(tempfile.gettempdir(), f"ncs_{time.time_ns()}.log")
                try:
                    self._process, self._label = Process(step.command, step.folder, log), step.label
                except OSError as error:
                    self._end(f"{step.command[0]} does not start: {error}", failed=True)
            else:
                self.text = step

    def _end(self, text: str, failed: bool) -> None:
        self.over, self.text, self.failed, self._process = True, text, failed, None
        self.share = -1.0
        self._steps.close()


def show(label: str, text: str) -> None:
    """Put what a command printed into a text of Blender's."""
    block = bpy.data.texts.get(label) or bpy.data.texts.new(label)
    block.clear()
    block.write(text)


current: Task | None = None


def busy() -> bool:
    """Tell whether a task is under way."""
    return current is not None and not current.over


def start(name: str, steps: Generator) -> Task:
    """Begin a task. Without a window, do all of it at once.

    Raises:
        Wrong: another one is under way, or its first step failed; without a window, or any.
    """
    global current
    if busy():
        raise Wrong(f"{current.name} is under way: wait, or cancel it")
    current = task = Task(name, steps)
    task.begin()
    while WAITS and not task.over:
        task.advance()
        time.sleep(EVERY if task._process is not None else 0)
    if task.failed:
        raise Wrong(task.text)
    if not task.over:
        bpy.app.timers.register(_tick, first_interval=0.0, persistent=True)
    return task


def _tick() -> float | None:
    """Go on with the task, and draw the panel again; Blender's timer calls it."""
    if current is None:
        return None
    if bpy.app.is_job_running("RENDER"):  # another frame now would be in the picture
        return EVERY
    current.advance()
    redraw()
    return None if current.over else EVERY if current._process is not None else 0.01


def redraw() -> None:
    """Draw the sidebars of all 3D views again."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()

"""A trained garment in a process of its own: a pose in, its vertices out."""

import contextlib
import json
import queue
import subprocess
import tempfile
import threading
from pathlib import Path

import numpy as np

from . import commands
from .pose import Skeleton, Wrong
from .process import NO_WINDOW, environment, reason

BEGIN, NEXT, AGAIN = 0, 1, 2  # a frame without a past, the one after the last, the last one once more
PATIENCE = 10.0  # s to wait for a frame
LOOK = 0.02  # s to wait for the start, each time


class Worker:
    """`ncs stream` of a trained garment; it starts by itself, and is ready when it has compiled."""

    def __init__(self, command: list[str], trained: Path, skeleton: Skeleton) -> None:
        """Start it.

        Raises:
            Wrong: there is no such program.
        """
        self._skeleton, self._answers, self._facts = skeleton, queue.Queue(), None
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        pipe = subprocess.PIPE
        try:
            self._popen = subprocess.Popen(
                [*command, *commands.stream()],
                cwd=trained,
                stdin=pipe,
                stdout=pipe,
                stderr=self._log,
                env=environment(),
                creationflags=NO_WINDOW,
            )
        except OSError as error:
            raise Wrong(f"{command[0]} does not start: {error}") from None
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        """Put what the process says into the queue: its facts, vertices, and None when it has ended."""
        try:
            if line := self._popen.stdout.readline():
                facts = json.loads(line)
                self._answers.put(facts)
                size = 12 * facts["vertices"]
                while len(data := self._popen.stdout.read(size)) == size:
                    self._answers.put(np.frombuffer(data, "<f4").reshape(-1, 3))
        finally:
            self._answers.put(None)  # and the reader is told what it said on stderr

    def ready(self) -> bool:
        """Tell whether it can answer.

        Raises:
            Wrong: it has ended, or is of another character.
        """
        if self._facts is None:
            try:
                facts = self._take(LOOK)
            except queue.Empty:
                return False
            if facts["joints"] != self._skeleton.names:
                raise Wrong("the garment was trained with other bones: train again")
            self._facts = facts
        return True

    @property
    def vertices(self) -> int:
        """Return how many vertices the garment has."""
        return self._facts["vertices"]

    def frame(self, kind: int, alpha: float, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Return the vertices (verts, 3) of a frame, m, Y up.

        Raises:
            Wrong: it has ended, takes too long, or the vertices are not finite.
        """
        head = np.array([kind, alpha, *translation], "<f4")
        try:
            self._popen.stdin.write(head.tobytes() + rotations.astype("<f4").tobytes())
            self._popen.stdin.flush()
            vertices = self._take(PATIENCE)
        except queue.Empty:
            raise Wrong(f"no answer within {PATIENCE:.0f} s") from None
        except OSError:
            raise Wrong(self._said()) from None
        if not np.isfinite(vertices).all():
            raise Wrong("the garment is torn in this pose: choose another alpha, or train with such poses")
        return vertices

    def _take(self, patience: float):
        answer = self._answers.get(timeout=patience)
        if answer is None:
            raise Wrong(self._said())
        return answer

    def _said(self) -> str:
        """Return why the process has ended."""
        self._log.seek(0)
        return reason(self._log.read().decode("utf-8", "replace"))

    def close(self) -> None:
        """End it."""
        self._popen.terminate()
        self._popen.wait()
        for stream in (self._popen.stdin, self._popen.stdout, self._log):
            with contextlib.suppress(OSError):  # what it has not read
                stream.close()

"""Write the log of a run: a CSV table, and TensorBoard's events."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Report", "RunLog"]


@dataclass(frozen=True)
class Report:
    """What training says after every chunk: the step, energies by term in J, strain and penetration in %, time and devices.

    `moved`: how far alpha = 1 is from alpha = 0 in mm, where alpha scales anything.
    """

    step: int
    steps: int
    energies: dict[str, float]
    strain: float
    penetrating: float
    dropped: int
    seconds: float
    left: float
    message: str = ""
    validation: dict[str, float] | None = None
    devices: int = 1
    moved: float | None = None


class RunLog:
    """RUN/log.csv and, where tensorboardX is installed, RUN/tensorboard. A resumed run drops the rows after its checkpoint."""

    def __init__(self, run: Path, first: int):
        self._path = run / "log.csv"
        self._names: list[str] | None = None
        if first and self._path.exists():
            with self._path.open(newline="") as file:
                rows = list(csv.reader(file))
            kept = rows[:1] + [r for r in rows[1:] if r and r[0].isdigit() and int(r[0]) <= first]
            temporary = self._path.with_suffix(".part")
            with temporary.open("w", newline="") as file:
                csv.writer(file).writerows(kept)
            os.replace(temporary, self._path)
            self._names = rows[0] if rows else None
        self._file = self._path.open("a" if self._names else "w", newline="")
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            self._board = None
        else:
            self._board = SummaryWriter(str(run / "tensorboard"), purge_step=first or None)

    def write(self, r: Report) -> None:
        """Add a report as a row."""
        validation = {f"validation_{k}": v for k, v in (r.validation or {}).items()}
        row = {"step": r.step, "total": sum(r.energies.values()), **r.energies, "strain": r.strain}
        row |= {} if r.moved is None else {"moved": r.moved}
        row |= {"penetrating": r.penetrating, "dropped": r.dropped, "seconds": round(r.seconds, 3)}
        if self._names is None:
            self._names = [*row, "validation_total", "validation_strain_mean", "validation_penetrating"]
            csv.writer(self._file).writerow(self._names)
        row |= validation
        csv.writer(self._file).writerow([row.get(n, "") for n in self._names])
        self._file.flush()
        if self._board is not None:
            for name, value in row.items():
                if name not in ("step", "seconds"):
                    self._board.add_scalar(name, value, r.step)

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        if self._board is not None:
            self._board.close()

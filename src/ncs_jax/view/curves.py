"""The curves of a training: its energies, strain and penetration over the steps."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ncs_jax.energies.terms import MEASURED, NAMES
from ncs_jax.errors import InputError
from ncs_jax.view.pictures import FAINT, INK
from ncs_jax.view.rasteriser import PAPER

__all__ = ["energy_curves"]

TERMS = {
    "membrane": "#d9643f",
    "bending": "#8c5aa8",
    "collision": "#3b7dbf",
    "friction": "#7fb2d9",
    "self_contact": "#2b4f81",
    "untangling": "#4f9fa3",
    "layers": "#a3b541",
    "gravity": "#5d9a54",
    "inertia": "#c79a2b",
    "pinning": "#7a7470",
    "hold": "#b8a68f",
    "external": "#c46a9d",
}
"""The package's energies with their colours."""
OWN = "#333333"  # of every term of one's own


def energy_curves(path: str | Path, rows: Sequence[Mapping[str, object]] | str | Path) -> None:
    """Draw a training over its steps: the total energy, its terms and, where the rows have them, strain and penetration.

    Args:
        path: of the PNG. rows: one mapping a step, or the CSV file that holds them, with columns step, total, the terms (see
            `TERMS`), strain, penetrating, and validation_total, validation_strain_mean and validation_penetrating. A column
            of another name is a term of one's own. Values that are empty or no number are ignored.

    Needs matplotlib, which the `plots` extra installs; its global state is left alone.

    Raises:
        InputError: no row has a step and a total.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if isinstance(rows, str | Path):
        with Path(rows).open(newline="") as file:
            rows = list(csv.DictReader(file))
    columns = _columns(rows)
    if "total" not in columns:
        raise InputError(
            "at least one row with a step and a total expected", field="rows", value=len(rows), mend="give the log.csv of a run"
        )
    quality = [name for name in ("strain", "penetrating") if name in columns or f"validation_{name}" in columns]
    figure = Figure(figsize=(4.6 * (2 + bool(quality)), 3.9), dpi=150, facecolor=_hex(PAPER), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2 + bool(quality), squeeze=False)[0]
    _curve(axes[0], columns["total"], "#d9643f", "training")
    for name in ("validation_total", "validation"):
        if name in columns:
            axes[0].plot(*columns[name], color=_hex(INK), marker="o", markersize=3.5, linewidth=1.4, label="validation")
            break
    _style(axes[0], "Total energy, J", [columns[n] for n in ("total", "validation_total") if n in columns])
    own = [name for name in columns if name not in (*NAMES, *MEASURED) and not name.startswith("validation")]
    terms = [name for name in (*TERMS, *own) if name in columns and np.any(columns[name][1] != 0)]
    for name in terms:
        _curve(axes[1], columns[name], TERMS.get(name, OWN), name.replace("_", " "))
    _style(axes[1], "Its terms, J", [columns[name] for name in terms])
    if quality:
        labels = {"strain": ("mean strain", "#d9643f"), "penetrating": ("penetrating vertices", "#3b7dbf")}
        for name in quality:
            label, colour = labels[name]
            if name in columns:
                _curve(axes[2], columns[name], colour, label)
            for held in (f"validation_{name}_mean", f"validation_{name}"):
                if held in columns:
                    axes[2].plot(
                        *columns[held], color=colour, marker="o", markersize=3.5, linestyle=":", label=f"{label}, validation"
                    )
                    break
        _style(axes[2], "Strain and penetration, %", [], legend=2)
        axes[2].set_ylim(bottom=0)
    figure.savefig(path, facecolor=figure.get_facecolor())


def _columns(rows):
    """Return every column of numbers as (steps, values), without the gaps."""
    columns = {}
    for place, row in enumerate(rows):
        step = _number(row.get("step", place))
        for name, value in row.items():
            number = _number(value)
            if name is not None and name != "step" and step is not None and number is not None:
                columns.setdefault(name, ([], []))
                columns[name][0].append(step)
                columns[name][1].append(number)
    return {name: (np.array(steps), np.array(values)) for name, (steps, values) in columns.items()}


def _number(value):
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _curve(axes, column, colour, label):
    """Draw a column; over it, where it is long enough to be noisy, a smoothed running median."""
    steps, values = column
    window = len(values) // 40 * 2 + 1
    if window < 5:
        axes.plot(steps, values, color=colour, linewidth=1.8, label=label, marker="o" if len(steps) == 1 else None)
        return
    axes.plot(steps, values, color=colour, linewidth=0.8, alpha=0.35)
    padded = np.pad(values, window // 2, mode="edge")
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(padded, window), axis=1)
    smooth = np.convolve(np.pad(smooth, window // 2, mode="edge"), np.full(window, 1 / window), "valid")
    axes.plot(steps, smooth, color=colour, linewidth=1.8, label=label)


def _style(axes, title, columns, legend=3):
    """Set title, legend and light axes; a log scale for what is positive and spans more than a factor of 20."""
    positive = [values[values > 0] for _, values in columns]
    every = np.concatenate(positive) if positive else np.zeros(0)
    if len(every) == sum(len(values) for _, values in columns) and len(every) and every.max() > 20 * every.min():
        axes.set_yscale("log")
        # Below a millionth of the largest nothing matters.
        axes.set_ylim(bottom=max(every.min() * 0.8, every.max() * 1e-6))
    axes.set_title(title, loc="left", fontsize=11, color=_hex(INK))
    axes.set_xlabel("step", fontsize=9, color=_hex(FAINT))
    axes.set_facecolor("white")
    axes.grid(color="#ece8e1", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8.5, colors=_hex(FAINT), length=0, which="both")
    axes.spines[:].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        style = {"fontsize": 8.5, "frameon": False, "labelcolor": _hex(INK), "handlelength": 1.4, "columnspacing": 1.2}
        axes.legend(loc="upper left", bbox_to_anchor=(-0.01, -0.16), borderaxespad=0.0, ncols=legend, **style)


def _hex(colour):
    return "#{:02x}{:02x}{:02x}".format(*colour)

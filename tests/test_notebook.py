"""The notebooks run from top to bottom, with less training."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from .conftest import AS_USERS

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def ran(name, tmp_path, first=None):
    """The notebook after it ran, another first line of code in place of its own; what its cells printed."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    if first is not None:
        assert notebook.cells[1].source.startswith(first.split("=")[0])
        notebook.cells[1].source = first
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute(env=AS_USERS)
    return notebook, ["".join(o.get("text", "") for o in c.get("outputs", [])) for c in notebook.cells]


def drawn(notebook):
    """How many pictures its cells show."""
    outputs = [o for c in notebook.cells for o in c.get("outputs", [])]
    return sum(o.output_type == "display_data" and "image/png" in o.data for o in outputs)


def test_quickstart(tmp_path):
    notebook, printed = ran("quickstart", tmp_path, "steps = 10")
    assert any("strain_mean" in text for text in printed)
    difference = next(text for text in printed if "largest difference" in text)
    assert float(difference.split()[-2]) < 1e-5
    assert drawn(notebook) == 1


def test_energies(tmp_path):
    notebook, printed = ran("energies", tmp_path)
    checks = [line.split() for text in printed for line in text.splitlines() if "by differences" in line]
    assert len(checks) == 4
    for *_, slope, _, measured, _, _ in checks:
        assert float(slope) == pytest.approx(float(measured), rel=1e-2)
    assert any("finite: True" in text for text in printed) and drawn(notebook) == 1


@pytest.mark.slow
def test_training(tmp_path):
    notebook, printed = ran("training", tmp_path, "steps = 20")
    assert any("out_of_balance" in text for text in printed) and any("settling" in text for text in printed)
    assert drawn(notebook) == 2


@pytest.mark.slow
def test_simulation(tmp_path):
    notebook, printed = ran("simulation", tmp_path, "frames = 3")
    assert any("all at tolerance: True" in text for text in printed) and any("in balance: True" in text for text in printed)
    checks = [line.split() for text in printed for line in text.splitlines() if "by differences" in line]
    assert len(checks) == 6
    for line in checks:
        assert float(line[2]) == pytest.approx(float(line[-1]), rel=1e-3)
    assert drawn(notebook) == 1


@pytest.mark.slow
def test_inference(tmp_path):
    _, printed = ran("inference", tmp_path, "steps = 10")
    difference = next(line for text in printed for line in text.splitlines() if "largest difference" in line)
    assert float(difference.split()[-2]) < 1e-5
    assert any("tshirt.onnx.json" in text for text in printed)


@pytest.mark.slow
def test_own_terms(tmp_path):
    notebook, printed = ran("own_terms", tmp_path, "steps, frames = 20, 6")
    every = "".join(printed)
    assert "'wind'" in every and "'attachment'" in every and drawn(notebook) == 1
    pushed = float(every.split("the wind's force: [")[1].split()[0])
    assert pushed == pytest.approx(float(every.split("pressure times area: ")[1].split()[0]), rel=1e-3)
    assert float(every.split("moves the simulated skirt by ")[1].split()[0]) > 5


@pytest.mark.slow
def test_own_network(tmp_path):
    _, printed = ran("own_network", tmp_path, "steps, frames = 20, 6")
    every = "".join(printed)
    counts = [int(line.split(": ")[1].split()[0]) for line in every.splitlines() if "parameters" in line]
    assert len(counts) == 2 and counts[1] < counts[0] / 2
    assert float(every.split("largest difference ")[1].split()[0]) < 1e-5

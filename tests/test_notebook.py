"""The notebook runs from top to bottom, with less training."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[1] / "notebooks" / "quickstart.ipynb"


def test_quickstart(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert notebook.cells[1].source.startswith("steps = ")
    notebook.cells[1].source = "steps = 10"
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = {i: "".join(o.get("text", "") for o in c.get("outputs", [])) for i, c in enumerate(notebook.cells)}
    assert any("strain_mean" in text for text in printed.values())
    difference = next(text for text in printed.values() if "largest difference" in text)
    assert float(difference.split()[-2]) < 1e-5
    assert any(o.output_type == "display_data" and "image/png" in o.data for c in notebook.cells for o in c.get("outputs", []))

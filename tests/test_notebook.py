"""The notebooks run from top to bottom, with less training."""

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from .conftest import AS_USERS
from .scenes import FREE, SCENE, write_scene

SHORT = ("steps, frames = 200, 12", "steps, frames = 20, 6")
NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def ran(name, folder, *changes, env=AS_USERS):
    """The notebook after it ran, with changes (what its code has, what takes its place); and what its cells printed."""
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    for old, new in changes:
        cells = [c for c in notebook.cells if c.cell_type == "code" and old in c.source]
        assert cells, f"{name}.ipynb has no {old}"
        for cell in cells:
            cell.source = cell.source.replace(old, new)
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": str(folder)}}).execute(env=env)
    return notebook, ["".join(o.get("text", "") for o in c.get("outputs", [])) for c in notebook.cells]


def ran_small(name, folder, *changes):
    """The same on the scene of the tests, compiled as they are: every line of the notebook but for what it loads."""
    return ran(name, folder, *changes, env=os.environ)


def drawn(notebook):
    """How many pictures its cells show."""
    outputs = [o for c in notebook.cells for o in c.get("outputs", [])]
    return sum(o.output_type == "display_data" and "image/png" in o.data for o in outputs)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_quickstart(tmp_path, whole):
    if whole:
        notebook, printed = ran("quickstart", tmp_path, ("steps = 100", "steps = 10"))
    else:
        scene, motion = write_scene(tmp_path, FREE), tmp_path / "swing.npz"
        small = ("steps = 100", "steps = 10"), ('"ncs:tshirt"', repr(str(scene))), ('"ncs:mixed"', repr(str(motion)))
        notebook, printed = ran_small("quickstart", tmp_path, *small)
    assert any("strain_mean" in text for text in printed)
    difference = next(text for text in printed if "largest difference" in text)
    assert float(difference.split()[-2]) < 1e-5
    assert drawn(notebook) == 1


def test_energies(tmp_path):
    pressed = ("jnp.array([0.95, 1.0, 0.95])", "jnp.array([0.5, 1.0, 0.5])")  # the tests' strip hangs beside its post
    smooth = SCENE + '[physics.collision]\ndistance = "smooth"\n'
    notebook, printed = ran_small("energies", tmp_path, pressed, ("track, 5,", "track, 3,"), *hung(tmp_path, smooth))
    checks = [line.split() for text in printed for line in text.splitlines() if "by differences" in line]
    assert len(checks) == 5 and all(float(line[-5]) != 0 for line in checks)
    for *_, slope, _, measured, _, _ in checks:
        assert float(slope) == pytest.approx(float(measured), rel=1e-2)
    assert any("finite: True" in text for text in printed) and drawn(notebook) == 1


@pytest.mark.slow
def test_training(tmp_path):
    notebook, printed = ran("training", tmp_path, ("steps = 300", "steps = 20"))
    assert any("out_of_balance" in text for text in printed) and any("settling" in text for text in printed)
    assert drawn(notebook) == 2


@pytest.mark.slow
def test_simulation(tmp_path):
    notebook, printed = ran("simulation", tmp_path, ("frames = 20", "frames = 3"))
    assert any("all at tolerance: True" in text for text in printed) and any("in balance: True" in text for text in printed)
    checks = [line.split() for text in printed for line in text.splitlines() if "by differences" in line]
    assert len(checks) == 6
    for line in checks:
        assert float(line[2]) == pytest.approx(float(line[-1]), rel=1e-3)
    assert drawn(notebook) == 1


@pytest.mark.slow
def test_inference(tmp_path):
    _, printed = ran("inference", tmp_path, ("steps = 100", "steps = 10"))
    difference = next(line for text in printed for line in text.splitlines() if "largest difference" in line)
    assert float(difference.split()[-2]) < 1e-5
    assert any("tshirt.onnx.json" in text for text in printed)


def hung(folder, text=SCENE):
    """The changes that put the tests' strip, hung from its pins, and its swing in the place of a notebook's skirt and twist."""
    text = text.replace("smoothing = 2", 'smoothing = 2\npins = "pins"').replace("fps = 30", "fps = 30\nframes = [0, 5]")
    load = f"(lambda skirt: ncs_jax.load_scene({str(write_scene(folder, text))!r}))("
    return ("ncs_jax.scene_from(", load), ("ncs:twist", str(folder / "swing.npz"))


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_own_terms(tmp_path, whole):
    if whole:
        notebook, printed = ran("own_terms", tmp_path, SHORT)
    else:
        notebook, printed = ran_small("own_terms", tmp_path, SHORT, ("track, 5,", "track, 3,"), *hung(tmp_path))
    every = "".join(printed)
    assert "'wind'" in every and "'attachment'" in every and drawn(notebook) == 1
    pushed = float(every.split("the wind's force: [")[1].split()[0])
    assert pushed == pytest.approx(float(every.split("pressure times area: ")[1].split()[0]), rel=1e-3)
    assert float(every.split("moves the simulated skirt by ")[1].split()[0]) > (5 if whole else 2)
    pulled = float(every.split("the air's force on a skirt at rest: [")[1].split()[0])
    assert pulled == pytest.approx(float(every.split("c A w: ")[1].split()[0]), rel=1e-3)
    assert float(every.split("out of balance by at most ")[1].split()[0]) <= 0.1


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_own_network(tmp_path, whole):
    if whole:
        _, printed = ran("own_network", tmp_path, SHORT)
    else:
        _, printed = ran_small("own_network", tmp_path, SHORT, *hung(tmp_path, FREE))
    every = "".join(printed)
    counts = [int(line.split(": ")[1].split()[0]) for line in every.splitlines() if "parameters" in line]
    assert "TanhEncoder: a code of" in every and "sines: 20 steps, then 40;" in every
    assert len(set(counts)) == 2 and (not whole or counts[1] < counts[0] / 2)
    assert float(every.split("largest difference ")[1].split()[0]) < 1e-5

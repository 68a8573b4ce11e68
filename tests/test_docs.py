"""The documentation builds without a warning, and everything in it that a reader might copy is accepted."""

import html
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ncs_jax
from tools.run_docs import fault, faults, pages, samples

ROOT = Path(__file__).parents[1]
REFERENCE = re.compile(r"^::: ([\w.]+)$", re.MULTILINE)


def build(folder, *options):
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--site-dir",
        str(folder),
        *options,
    ]  # --quiet hides warnings
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_the_documentation_builds(tmp_path):
    built = build(tmp_path)
    assert built.returncode == 0, built.stderr
    theory = (tmp_path / "theory.html").read_text()
    assert theory.count("<math") > 30 and "arithmatex" not in theory
    assert (tmp_path / "study.html").exists() and (tmp_path / "results" / "stability_energies.png").exists()
    terms = re.sub("<[^>]+>", "", (tmp_path / "api" / "terms.html").read_text().replace("<li>", "* "))
    items = [html.unescape(line) for line in terms.splitlines()]
    for item in (
        "* surface (Surface | None): the touchable body",
        "* garment (Garment), material (Material): what is constant.",
    ):
        assert sum(line.startswith(item) for line in items) == 1, item
    for page in tmp_path.rglob("*.html"):
        text = page.read_text()
        assert 'src="http' not in text, page


@pytest.mark.parametrize("page", pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_reader_copies_is_accepted(page):
    assert not faults([page])


def test_the_pages_have_something_to_copy():
    found = [sample for page in pages() for sample in samples(page.name, page.read_text())]
    kinds = [sample.kind for sample in found]
    assert all(kinds.count(kind) >= least for kind, least in {"sh": 40, "said": 40, "python": 5, "toml": 5}.items())
    text = "".join(page.read_text() for page in pages())
    assert text.count("```python\n") == kinds.count("python") and text.count("```toml\n") == kinds.count("toml")
    assert set(re.findall(r"```(\w+)\n", text)) == {"sh", "python", "toml"}


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ("```sh\nncs train ncs:tshirt --out runs/a --minuts 3\n```", "--minuts"),
        ("```sh\nncs train ncs:tshirt\n```", "--out"),
        ("```sh\nncs teach ncs:tshirt --out runs/a\n```", "teach"),
        ("```sh\nncs train SCENE --out RUN [--minutes M | --setps N]\n```", "--setps"),
        ("Some text.\n\n    ncs animate RUN --out a.glb --boddy\n\nMore.", "--boddy"),
        ("Say `ncs export RUN --out FILE --opset high`.", "high"),
        ("Say `python -m experiments.methods --step 3 --seed 1`.", "--seed"),
        ("Say `python -m benchmarks.speed`.", "benchmarks.speed"),
        ("Say `python -m tools.rooms --all`.", "reads no options"),
        ("Say `make stabilty`.", "stabilty"),
        ("Say `make bench SCEEN=FILE`.", "SCEEN"),
        ("Say `pytest tests/test_nothing.py`.", "test_nothing"),
        ("```sh\npip install '.[usb]'\n```", "usb"),
        ("```sh\nnsc demo\n```", "nsc"),
        ("```python\nimport ncs_jax\n\nncs_jax.trane('ncs:tshirt')\n```", "trane"),
        ("```python\nfrom ncs_jax.simulator import simulate\n```", "ncs_jax.simulator"),
        ("```python\nrun = = 3\n```", "invalid syntax"),
        ('```toml\n[garment]\nfiel = "ncs:skirt"\n```', "garment.fiel"),
        ("```toml\n[physics]\ndensity = -1\n```", "physics.density"),
        ('1. A list:\n\n    ```toml\n    [network]\n    cell = "sving"\n    ```\n', "network.cell"),
    ],
)
def test_a_wrong_word_in_a_page_is_found(wrong, why):
    found = [fault(sample) for sample in samples("page.md", wrong)]
    assert len(found) == 1 and why in found[0]


def test_running_text_may_leave_out_what_is_required():
    (told,) = samples("page.md", "Say `ncs train --resume`.")
    assert told.kind == "said" and not fault(told)


def test_every_reference_of_the_api_is_there_and_every_public_name_is_referred_to():
    names = [name for page in sorted((ROOT / "docs" / "api").glob("*.md")) for name in REFERENCE.findall(page.read_text())]
    things = []
    for name in names:
        module, _, attribute = name.rpartition(".")
        things.append(getattr(importlib.import_module(module), attribute))
    assert len(names) == len(set(names))
    assert not [name for name in ncs_jax.__all__ if getattr(ncs_jax, name) not in things]


def test_the_readme_is_one_page_of_plain_words():
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 130
    measured = readme[readme.index("## Measured") :].split("\n## ")[0]
    assert measured.count("\n| ") - 1 <= 10  # headlines
    assert (ROOT / "docs" / "swing.gif").stat().st_size < 3_000_000


@pytest.mark.slow
def test_the_pages_can_be_followed(plain_jax):
    from tools.follow_docs import follow

    assert not follow(pages())

"""The study as a page of the documentation, and links from the pages into the repository.

A page links to a file as it lies in the repository, `../experiments/README.md` or `../notebooks/quickstart.ipynb`. So the
link also works where the repository is browsed. On the site these files are pages, which this hook makes and links to.
"""

import re
from pathlib import Path

from mkdocs.structure.files import File

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
LINKS = (
    (re.compile(r"\]\(\.\./experiments/README\.md"), "](study.md"),
    (re.compile(r"\]\(\.\./experiments/results/"), "](results/"),
    (re.compile(r"\]\(\.\./notebooks/(\w+)\.ipynb"), r"](notebooks/\1.md"),
)


def on_files(files, config):
    """Called by MkDocs with all files of the site."""
    files.append(File.generated(config, "study.md", content=(EXPERIMENTS / "README.md").read_text(encoding="utf-8")))
    for picture in sorted((EXPERIMENTS / "results").glob("*.png")):
        files.append(File.generated(config, f"results/{picture.name}", content=picture.read_bytes()))
    return files


def on_page_markdown(markdown, **_):
    """Called by MkDocs with every page's text."""
    for link, target in LINKS:
        markdown = link.sub(target, markdown)
    return markdown

"""The notebooks as pages of the documentation, with the outputs that they hold."""

import base64
import json
import re
from pathlib import Path

from mkdocs.structure.files import File

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def _fenced(text: str, language: str = "") -> str:
    return f"```{language}\n{text.rstrip()}\n```\n" if text.strip() else ""


def on_files(files, config):
    """Called by MkDocs with all files of the site."""
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        name, parts, pictures = notebook.stem, [], 0
        for cell in json.loads(notebook.read_text())["cells"]:
            source = "".join(cell["source"])
            parts.append(source if cell["cell_type"] == "markdown" else _fenced(source, "python"))
            for output in cell.get("outputs", []):
                data = output.get("data", {})
                text = output.get("text", data.get("text/plain", ""))
                if "image/png" in data:
                    picture, pictures = f"notebooks/{name}_{pictures}.png", pictures + 1
                    content = base64.b64decode("".join(data["image/png"]))
                    files.append(File.generated(config, picture, content=content))
                    parts.append(f"![output]({Path(picture).name})")
                elif text:
                    parts.append(_fenced(COLOURS.sub("", "".join(text)), "text"))
        parts.append(f"This page is `notebooks/{notebook.name}`.")
        files.append(File.generated(config, f"notebooks/{name}.md", content="\n\n".join(parts)))
    return files

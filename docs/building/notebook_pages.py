"""The pages of the notebooks: their text, their code, and where the file is."""

from __future__ import annotations

import json
from pathlib import Path


def notebooks(folder: Path) -> dict[str, Path]:
    """Return the notebooks in a folder by title, the first steps first.

    Args:
        folder: folder of the notebooks.
    """
    files = sorted(folder.glob("*.ipynb"), key=lambda file: (file.stem != "first-steps", file.stem))
    return {title(file): file for file in files}


def title(file: Path) -> str:
    """Return the first heading of a notebook."""
    return _cells(file)[0][1].splitlines()[0].removeprefix("# ")


def page(file: Path) -> str:
    """Return the page of a notebook, in Markdown."""
    (_, first), *rest = _cells(file)
    head, _, lead = first.partition("\n\n")
    where = f"The notebook itself, which needs no data: [{file.name}]({file.name})."
    shown = [text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in rest]
    return "\n\n".join([head, where, lead, *shown]) + "\n"


def _cells(file: Path) -> list[tuple[str, str]]:
    """Return the kind and the text of each cell."""
    return [(cell["cell_type"], "".join(cell["source"])) for cell in json.loads(file.read_text("utf-8"))["cells"]]

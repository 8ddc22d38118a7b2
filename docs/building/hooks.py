"""Hooks of MkDocs: pages made from the code and from the notebooks, and equations as MathML, which needs no script."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import method_pages
import notebook_pages
from latex2mathml.converter import convert
from lines import keep_together
from mkdocs.structure.files import File, Files

EQUATION = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
"""Markup that pymdownx.arithmatex makes of an equation."""


def on_config(config: Any) -> Any:
    """Add every method to the menu, in alphabetical order, every notebook, and every note without a place in it yet."""
    notes = [f"notes/{file.name}" for file in sorted(Path(config.docs_dir, "notes").glob("*.md"))]
    for entry in config.nav:
        if "Methods" in entry:
            entry["Methods"] += [{name: f"methods/{name}.md"} for name in method_pages.methods()]
        if "Python" in entry:
            found = notebook_pages.notebooks(Path(config.docs_dir, "notebooks"))
            pages = [{title: f"notebooks/{file.stem}.md"} for title, file in found.items()]
            entry["Python"].append({"Notebooks": pages})
        if "How it works" in entry:
            placed = {path for page in entry["How it works"] for path in page.values()}
            entry["How it works"] += [note for note in notes if note not in placed]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Give a page to every notebook, and to every method: its own text, if any, with the facts of its code."""
    for name in method_pages.methods():
        path = f"methods/{name}.md"
        written = Path(config.docs_dir, path)
        text = written.read_text(encoding="utf-8") if written.is_file() else None
        if (existing := files.get_file_from_path(path)) is not None:
            files.remove(existing)
        files.append(File.generated(config, path, content=method_pages.page(name, text)))
    for file in notebook_pages.notebooks(Path(config.docs_dir, "notebooks")).values():
        files.append(File.generated(config, f"notebooks/{file.stem}.md", content=notebook_pages.page(file)))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Write equations as MathML, and keep words together that are read as one."""
    return keep_together(EQUATION.sub(lambda found: _mathml(html.unescape(found[2]), found[1] == "div"), content))


def _mathml(text: str, block: bool) -> str:
    tex = text.strip().removeprefix(r"\[" if block else r"\(").removesuffix(r"\]" if block else r"\)")
    if block:
        return f'<div class="equation">{convert(tex.strip(), display="block")}</div>'
    return convert(tex.strip(), display="inline")

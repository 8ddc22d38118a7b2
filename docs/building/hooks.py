"""Hooks of MkDocs: a page for each method, made from the code, and equations as MathML, which needs no script."""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

import method_pages
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

EQUATION = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
"""What pymdownx.arithmatex leaves of an equation."""


def on_config(config: Any) -> Any:
    """Add every method to the menu, in alphabetical order, and every note that has no place in it yet."""
    notes = [f"notes/{file.name}" for file in sorted(Path(config.docs_dir, "notes").glob("*.md"))]
    for entry in config.nav:
        if "Methods" in entry:
            entry["Methods"] += [{name: f"methods/{name}.md"} for name in method_pages.methods()]
        if "How it works" in entry:
            placed = {path for page in entry["How it works"] for path in page.values()}
            entry["How it works"] += [note for note in notes if note not in placed]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Give every method a page: its hand-written text, if there is one, with what is known from its code."""
    for name in method_pages.methods():
        path = f"methods/{name}.md"
        written = Path(config.docs_dir, path)
        text = written.read_text(encoding="utf-8") if written.is_file() else None
        if (existing := files.get_file_from_path(path)) is not None:
            files.remove(existing)
        files.append(File.generated(config, path, content=method_pages.page(name, text)))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Write equations as MathML."""
    return EQUATION.sub(lambda found: _mathml(html.unescape(found[2]), found[1] == "div"), content)


def _mathml(text: str, block: bool) -> str:
    tex = text.strip().removeprefix(r"\[" if block else r"\(").removesuffix(r"\]" if block else r"\)")
    if block:
        return f'<div class="equation">{convert(tex.strip(), display="block")}</div>'
    return convert(tex.strip(), display="inline")

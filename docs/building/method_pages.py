"""The generated part of each method's page: paper, parts, settings left to the data, and every flag."""

from __future__ import annotations

import inspect
import json
import re
import sys
import typing
from pathlib import Path
from typing import Any

from flags import flag_tables, help_texts

from nerfloom.base.config import AUTO, LEFT_TO_DATA
from nerfloom.method import Method
from nerfloom.registry import Entry, load_method, registered

PICTURES = Path(__file__).parents[1] / "pictures" / "methods"
"""Results of `method_pictures.py`."""
AFTER_PICTURE = "\n## When to take it\n"
"""Heading of a page written by hand that the picture stands before."""


def methods() -> dict[str, Entry]:
    """Return the methods of this repository, sorted by name; installed plugins are left out."""
    entries = registered("methods").items()
    return {name: entry for name, entry in entries if entry.module.startswith("nerfloom.methods.")}


def page(name: str, text: str | None) -> str:
    """Return the page of a method.

    Args:
        name: the method's name.
        text: the part that is written by hand; None if there is none yet.
    """
    method = load_method(name)
    module = sys.modules[registered("methods")[name].module]
    documentation = inspect.getdoc(module) or ""
    start = text if text is not None else f"# {name}\n\n{documentation}"
    idea, heading, rest = start.partition(AFTER_PICTURE)
    facts = [
        "## In short",
        "",
        "| | |",
        "|---|---|",
        f"| paper | {paper_link(method.paper)} |",
        f"| file | `{module.__name__.replace('.', '/')}.py` |",
        f"| model | `{method.model.__name__}` |",
        f"| draws | {'whole images' if method.model.batches == 'views' else 'rays through pixels'} |",
        f"| summary | {documentation.splitlines()[0] if documentation else ''} |",
    ]
    parts = [
        idea.strip(),
        picture(name),
        (heading + rest).strip(),
        "\n".join(facts),
        decided(method),
        flags(name, method),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def picture(name: str) -> str:
    """Return the section with the method's picture, and the results of its run; '' if there is none."""
    file = PICTURES / "psnr.json"
    made = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if name not in made:
        return ""
    run = made[name]
    return (
        f"## Picture\n\n![photograph, render, error, depth and opacity](../pictures/methods/{name}.jpg)\n\n"
        "From left to right: a photograph that training never saw, the render, the error, depth and opacity. "
        f"`{run['command']}` on two cores beside other programs: {run['psnr']:.2f} dB on {run['images']} held-out "
        f"images after {run['steps']:,} steps, in one run, which is no benchmark."
    )


def paper_link(paper: str) -> str:
    """Return a link to a paper that is on arXiv, and the text itself otherwise."""
    found = re.fullmatch(r"arXiv:(\d{4}\.\d{4,5})", paper)
    return f"[{paper}](https://arxiv.org/abs/{found[1]})" if found else paper


def decided(method: Method) -> str:
    """Return the section on settings that are left to the data."""
    kind, config = type(method.config), method.config
    helps, hints = help_texts(kind), typing.get_type_hints(kind, include_extras=True)
    open_ones = [name for name in hints if hasattr(config, name) and is_open(getattr(config, name), hints[name])]
    if not open_ones:
        return "## Left to the data\n\nNothing: every setting has a value by default."
    lead = "The run decides these when it has seen the data, and prints each with its reason."
    lines = [f"- `--{name.replace('_', '-')}`: {' '.join(helps.get(name, '').split())}" for name in open_ones]
    return f"## Left to the data\n\n{lead}\n\n" + "\n".join(lines)


def is_open(value: Any, hint: Any) -> bool:
    """Return whether the method's `decide` fills in a setting with this default."""
    return value == AUTO and LEFT_TO_DATA in getattr(hint, "__metadata__", ())


def flags(name: str, method: Method) -> str:
    """Return the section with every flag."""
    lead = (
        f"As `ns-train {name} --help-all` shows them, with the defaults of this method. Flags of the data format come "
        "after them."
    )
    return f"## Flags\n\n{lead}\n\n{flag_tables(name, method.config)}"

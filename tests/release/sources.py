"""Checks of the sources, before anything is built: one version, the licence, and files for pages about the project."""

import ast
import re
from pathlib import Path

from tests.release.problem import Problem

ROOT = Path(__file__).parents[2]
ABOUT = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md")
NEEDED = ("LICENSE", "CITATION.cff", *ABOUT)


def version() -> str:
    """Return the version, from the one place where it stands, without importing anything."""
    tree = ast.parse((ROOT / "framework" / "__init__.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__version__":
            return str(ast.literal_eval(node.value))
    raise Problem("framework/__init__.py has no __version__")


def check_sources() -> list[str]:
    """Check the files of the checkout; returns the passed checks."""
    current = version()
    if not re.fullmatch(r"\d+\.\d+\.\d+((a|b|rc)\d+)?", current):
        raise Problem(f"the version {current} is not of the form 1.2.3 or 1.2.3rc1")
    for name in NEEDED:
        if not (ROOT / name).is_file():
            raise Problem(f"{name} is missing")
    pyproject = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    if re.search(r"^version\s*=\s*[\"']", pyproject, re.MULTILINE):
        raise Problem("pyproject.toml has a version of its own; it is nerfloom.__version__ alone")
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    if cited is None or cited[1] != current:
        raise Problem(f"CITATION.cff cites version {cited and cited[1]}, not {current}")
    if "Apache License" not in (ROOT / "LICENSE").read_text(encoding="utf-8")[:400]:
        raise Problem("LICENSE is not the Apache License, which pyproject.toml names")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    noted = "has a section" if re.search(rf"^## .*{re.escape(current)}", changes, re.MULTILINE) else "has NO section"
    relative = relative_links((ROOT / "README.md").read_text(encoding="utf-8"))
    return [
        f"version {current}: in framework/__init__.py and CITATION.cff; CHANGELOG.md {noted} for it",
        f"licence: Apache-2.0; {len(NEEDED)} files about the project are there",
        f"README.md: {len(relative)} links and pictures are relative, and lead nowhere on a package index"
        + (f": {', '.join(relative[:8])}" if relative else ""),
    ]


def relative_links(text: str) -> list[str]:
    """Targets of links and pictures of a Markdown text that have no address, less those within the page."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    targets = re.findall(r"\[[^]]*]\(([^)\s]+)\)", text) + re.findall(r"<(?:img|a)[^>]+(?:src|href)=\"([^\"]+)\"", text)
    return [target for target in targets if not re.match(r"[a-z]+:|#", target)]

"""The documents: every link leads to a file and to a heading of it, and every path that is named exists."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("docs", "examples", "framework", "tests", ".")
DOCUMENTS = sorted(
    {file for folder in FOLDERS for file in (ROOT / folder).glob("*.md" if folder == "." else "**/*.md")}
    - set(ROOT.glob("framework/templates/**/*.md"))  # their links belong to the package that is written
)
LINK = re.compile(r"\[[^]]*]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+)$", re.MULTILINE)
BLOCK = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
PATH = re.compile(r"`((?:benchmarks|configs|dataparsers|docs|examples|framework|methods|tests)/[\w./-]*)`")


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives the headings of a document."""
    titles = (re.sub(r"[^\w\- ]", "", title.strip().lower()) for title in HEADING.findall(BLOCK.sub("", text)))
    return {title.replace(" ", "-") for title in titles}


def dead_links(file: Path) -> list[str]:
    """Relative links of a document that lead nowhere."""
    dead = []
    for target in LINK.findall(BLOCK.sub("", file.read_text(encoding="utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        other = (file.parent / name).resolve() if name else file
        if not other.exists() or (anchor and anchor not in anchors(other.read_text(encoding="utf-8"))):
            dead.append(target)
    return dead


def test_links_lead_somewhere() -> None:
    assert {file: dead for file in DOCUMENTS if (dead := dead_links(file))} == {}


def test_paths_that_are_named_exist() -> None:
    roots = (ROOT, ROOT / "examples" / "plugin-method")  # docs/plugins.md speaks of that package, too
    named = [(file, path) for file in DOCUMENTS for path in PATH.findall(file.read_text(encoding="utf-8"))]
    assert [(file, path) for file, path in named if not any((root / path).exists() for root in roots)] == []


def test_dead_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# A title: with `code`, and more\n\n```\n# no heading\n```\n")
    (tmp_path / "one.md").write_text(
        "# Own\n[a](other.md) [b](other.md#a-title-with-code-and-more) [c](#own) [d](https://example.org/x)\n"
        "[e](missing.md) [f](other.md#no-heading) ![g](missing.png) [h](#other)\n```\n[i](in-a-block.md)\n```\n"
    )
    assert dead_links(tmp_path / "one.md") == ["missing.md", "other.md#no-heading", "missing.png", "#other"]
    assert len(DOCUMENTS) > 10

"""Checks every link of the built site: `python docs/building/check_links.py site`.

Links within the site must lead to a file and, with an anchor, to an element of it. Links to elsewhere are not followed:
only their syntax is looked at. Nothing may be loaded from elsewhere: no script, style, font or image.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {("script", "src"), ("img", "src"), ("link", "href"), ("source", "src"), ("iframe", "src")}
"""Elements and attributes that make a browser fetch something when it opens a page."""


class Page(HTMLParser):
    """The links, anchors and loaded files of a page."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif value is not None and (tag, name) in LOADED and ("rel", "canonical") not in attrs:
                self.loaded.append(value)
            elif value is not None and name == "href":
                self.links.append(value)


def check(site: Path) -> tuple[int, list[str]]:
    """Return the number of links, and the faults, a line each.

    Args:
        site: folder of the built site.
    """
    pages = {file.resolve(): Page(file) for file in sorted(site.rglob("*.html"))}
    count, wrong = 0, []
    for file, page in pages.items():
        where = file.relative_to(site.resolve())
        for link in page.links + page.loaded:
            count += 1
            problem = _problem(link, file, pages, link in page.loaded)
            if problem is not None and where.name != "404.html":  # its links are from the root of a server
                wrong.append(f"{where}: {link}: {problem}")
    return count, wrong


def _problem(link: str, file: Path, pages: dict[Path, Page], loaded: bool) -> str | None:
    parts = urlsplit(link)
    if parts.scheme in ("http", "https") or link.startswith("//"):
        if loaded:
            return "it is loaded from elsewhere"
        return None if parts.scheme and "." in parts.netloc and " " not in link else "no valid address"
    if parts.scheme in ("mailto", "data"):
        return None
    if parts.scheme or link.startswith("/"):
        return "neither an address nor a path within the site"
    target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
    if target.is_dir():
        target = target / "index.html"
    if not target.exists():
        return "there is no such file"
    anchor = unquote(parts.fragment)
    if anchor and target in pages and anchor not in pages[target].anchors:
        return "there is no such anchor"
    return None


def main() -> None:
    """Check the site that the first argument names; the exit status is 1 if something is wrong."""
    site = Path(sys.argv[1])
    pages = len(list(site.rglob("*.html")))
    count, wrong = check(site)
    print(f"{site}: {pages} pages, {count:,} links, {len(wrong)} wrong")
    for line in wrong:
        print(line)
    sys.exit(bool(wrong) or not pages)


if __name__ == "__main__":
    main()

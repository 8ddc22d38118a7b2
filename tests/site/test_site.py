"""The site builds without a warning and without a network, and all of its links lead somewhere."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from nerfloom.registry import registered
from tests.site.pages import PAGES, ROOT

BUILD = """
import socket, sys
def refused(*_, **__): raise OSError("no network here")
socket.getaddrinfo = socket.create_connection = socket.socket.connect = refused
from mkdocs.__main__ import cli
cli(["build", "--strict", "--site-dir", sys.argv[1]])
"""


@pytest.fixture
def check_links(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "building"))
    import check_links as module

    return module


def test_wrong_links_are_found(check_links: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "index.html").write_text('<h1 id="top">x</h1><a href="../a.html#there">ok</a>')
    (tmp_path / "a.html").write_text(
        '<h1 id="there">x</h1><a href="sub/">ok</a><a href="sub/#top">ok</a><a href="#there">ok</a>'
        '<a href="https://example.org/x">ok</a><a href="b.html">1</a><a href="#nowhere">2</a>'
        '<a href="sub/index.html#nowhere">3</a><a href="https://no address">4</a><a href="/a.html">5</a>'
        '<script src="https://cdn.example.org/x.js"></script><img src="x.png"><a href="ftp://x.org">8</a>'
    )
    count, wrong = check_links.check(tmp_path)
    assert count == 13
    wrong_ones = {line.removeprefix("a.html: ").rpartition(": ")[0] for line in wrong}
    assert len(wrong) == 8
    assert wrong_ones == {
        "b.html", "#nowhere", "sub/index.html#nowhere", "https://no address", "/a.html", "ftp://x.org",
        "https://cdn.example.org/x.js", "x.png",
    }  # fmt: skip


@pytest.mark.slow
def test_the_site_is_whole(check_links: ModuleType, tmp_path: Path) -> None:
    for module in ("mkdocs", "material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(module, reason="the extra docs is not installed")
    site = tmp_path / "site"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-c", BUILD, str(site)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    count, wrong = check_links.check(site)
    assert wrong == []
    assert count > 2000
    pages = {file.relative_to(site).as_posix() for file in site.rglob("*.html")}
    documents = [page.relative_to(ROOT / "docs") for page in PAGES if (ROOT / "docs") in page.parents]
    assert {page.with_suffix(".html").as_posix() for page in documents} <= pages
    methods = [name for name, entry in registered("methods").items() if entry.module.startswith("nerfloom.methods.")]
    assert {f"methods/{name}.html" for name in methods} <= pages
    text = (site / "methods" / "nerfacto.html").read_text()
    assert "<math" in text
    assert "arithmatex" not in text  # every equation is written out
    assert "<merror" not in "".join(file.read_text() for file in (site / "methods").glob("*.html"))

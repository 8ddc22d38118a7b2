"""`make release-check` finds the mistakes that it is for; a whole run takes minutes and is not a test."""

import ast
import re
import tarfile
import zipfile
from pathlib import Path

import pytest

import nerfloom
from nerfloom.kernels.native import NEEDS
from tests.release import archives, sources
from tests.release.archives import PACKAGES, check_sdist, check_wheel, installed, tracked
from tests.release.install import BIN, Environment
from tests.release.problem import Problem
from tests.release.sources import ROOT, check_sources, relative_links, version

INFO = f"nerfloom-{nerfloom.__version__}.dist-info"


def metadata(**changed: str) -> str:
    text = (ROOT / "pyproject.toml").read_text()
    needs = re.findall(
        r'^    "([\w-]+>=[\d.]+)",$', text[text.index("\ndependencies") : text.index("optional-dep")], re.M
    )
    fields = {"Name": "nerfloom", "Version": nerfloom.__version__, "Requires-Python": ">=3.10"} | changed
    lines = [*(f"{name}: {value}" for name, value in fields.items()), *(f"Requires-Dist: {need}" for need in needs)]
    return "\n".join([*lines, "Requires-Dist: lpips>=0.1.4; extra == 'lpips'"]) + "\n"


def write_wheel(folder: Path, left_out: str = "", more: str = "", **changed: str) -> Path:
    """A correct wheel with empty files, except for the changes."""
    path = folder / f"nerfloom-{nerfloom.__version__}-py3-none-linux_x86_64.whl"
    libraries = [f"nerfloom/kernels/lib/{kind}.so" for kind in NEEDS]
    names = [*map(installed, tracked()), f"{INFO}/licenses/LICENSE", f"{INFO}/RECORD", *libraries, more]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{INFO}/METADATA", metadata(**changed))
        for name in filter(None, names):
            if name != left_out:
                archive.writestr(name, b"")
    return path


def write_sdist(folder: Path, left_out: str = "", more: str = "") -> Path:
    path = folder / "nerfloom.tar.gz"
    about = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "constraints.txt", "CITATION.cff")
    with tarfile.open(path, "w:gz") as archive:
        for name in filter(None, [*tracked(), *about, more]):
            if name != left_out:
                archive.addfile(tarfile.TarInfo(f"nerfloom-0/{name}"))
    return path


def test_the_version_stands_in_one_place() -> None:
    assert version() == nerfloom.__version__
    assert 'version = { attr = "nerfloom.__version__" }' in (ROOT / "pyproject.toml").read_text()


def test_the_sources_are_ready() -> None:
    said = check_sources()
    assert said[0].startswith(f"version {nerfloom.__version__}: ")
    assert "Apache-2.0" in said[1]


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("CITATION.cff", f"version: {nerfloom.__version__}", "version: 9.9.9", "cites version 9.9.9"),
        ("pyproject.toml", 'dynamic = ["version"]', 'version = "1.0"', "has a version of its own"),
        ("LICENSE", "Apache License", "My License", "LICENSE is not the Apache License"),
        ("framework/__init__.py", f'"{nerfloom.__version__}"', '"1.0"', "is not of the form"),
    ],
)
def test_sources_that_disagree(
    file: str, old: str, new: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (*sources.NEEDED, "pyproject.toml", "framework/__init__.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text())
    monkeypatch.setattr(sources, "ROOT", tmp_path)
    check_sources()
    before = (tmp_path / file).read_text()
    assert old in before
    (tmp_path / file).write_text(before.replace(old, new))
    with pytest.raises(Problem, match=said):
        check_sources()


def test_a_wheel_as_it_should_be(tmp_path: Path) -> None:
    said = check_wheel(write_wheel(tmp_path))
    assert "kernels amx_bf16, avx2, avx512, avx512_bf16, baseline; no data, licence included" in said
    assert "no tests, no data, no libraries" in check_sdist(write_sdist(tmp_path))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"left_out": "nerfloom/templates/method/README.md.template"}, "the wheel lacks nerfloom/templates"),
        ({"left_out": "nerfloom/kernels/lib/amx_bf16.so"}, "lacks the kernels for amx_bf16"),
        ({"left_out": f"{INFO}/licenses/LICENSE"}, "lacks the licence"),
        ({"more": "tests/test_light.py"}, "holds tests/test_light.py"),
        ({"more": "nerfloom/lego.PNG"}, "holds nerfloom/lego.PNG"),
        ({"more": "framework/__init__.py"}, "holds framework/__init__.py"),
        ({"more": "nerfloom/other.so"}, "only the kernels' libraries are expected"),
        ({"Version": "9.9"}, "Version is 9.9"),
        ({"Requires-Python": ">=3.8"}, "Requires-Python is >=3.8"),
        ({"Name": "nerfloom\nRequires-Dist: left-pad"}, "requires .*left-pad"),
    ],
)
def test_wheels_that_are_not(change: dict[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(Problem, match=said):
        check_wheel(write_wheel(tmp_path, **change))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"left_out": "framework/kernels/runtime/parallel.h"}, "the sdist lacks framework/kernels/runtime/parallel.h"),
        ({"left_out": "constraints.txt"}, "the sdist lacks constraints.txt"),
        ({"more": "tests/conftest.py"}, "holds tests/conftest.py"),
        ({"more": "framework/kernels/lib/avx2.so"}, "holds framework/kernels/lib/avx2.so"),
    ],
)
def test_sdists_that_are_not(change: dict[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(Problem, match=said):
        check_sdist(write_sdist(tmp_path, **change))


def test_one_that_has_grown_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "MAX_WHEEL", 10)
    with pytest.raises(Problem, match="10 at most are expected"):
        check_wheel(write_wheel(tmp_path))


def test_a_wheel_for_one_python_is_noticed(tmp_path: Path) -> None:
    wheel = write_wheel(tmp_path)
    with pytest.raises(Problem, match="is not for any Python on one platform"):
        check_wheel(wheel.rename(tmp_path / wheel.name.replace("py3-none", "cp312-cp312")))


def test_the_checkout_is_not_taken_for_the_installed(tmp_path: Path) -> None:
    """If the command that runs belongs to another package, the check says so."""
    (tmp_path / BIN).mkdir()
    command = tmp_path / BIN / "ns-train"
    command.write_text(f"#!/bin/sh\necho 'nerfloom  1.0 from {ROOT}/framework'\necho 'kernels   avx2 on the CPU'\n")
    command.chmod(0o755)
    with pytest.raises(Problem, match="not the installed package runs"):
        Environment(tmp_path, tmp_path / "x.whl").kernels()


def test_relative_links_are_found() -> None:
    text = '[a](docs/a.md) ![b](b.png) [c](https://x.org) [d](#d)\n```\n[e](e.md)\n```\n<img src="f.gif">'
    assert relative_links(text) == ["docs/a.md", "b.png", "f.gif"]


def test_packages_are_those_of_the_build() -> None:
    parts = re.search(r"^PARTS = (\{.*\})$", (ROOT / "setup.py").read_text(), re.MULTILINE)
    assert parts is not None
    assert tuple(ast.literal_eval(parts[1]).values()) == PACKAGES

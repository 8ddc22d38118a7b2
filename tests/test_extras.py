"""Messages about optional packages are right: pip finds them by these names, from a clone too."""

import re
from pathlib import Path

import pytest

from nerfloom.base import extras
from nerfloom.comparison.plots import MISSING

ROOT = Path(__file__).parents[1]


def test_the_packages_are_those_of_pyproject() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    for extra, packages in extras.EXTRAS.items():
        (line,) = re.findall(rf"^{extra} = \[(.*)\]$", text, re.MULTILINE)
        named = {re.split(r"[<>=]", word)[0] for word in re.findall(r'"([^"]+)"', line)}
        assert {package.strip("'") for package in packages.values()} == named


def test_only_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    assert extras.install_command("lpips") == "pip install lpips torchvision"
    assert extras.install_command("video") == "pip install 'imageio[ffmpeg]'"
    assert MISSING.endswith(str(extras.install_command("plots")))
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "lpips" else object())
    assert extras.install_command("lpips") == "pip install lpips"
    assert extras.install_command("video") is None


def test_no_advice_needs_this_package_on_a_registry(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert extras.reinstall_command() == f"pip install -e {ROOT}"
    sources = [path for folder in ("framework", "dataparsers", "methods") for path in (ROOT / folder).rglob("*.py")]
    assert [path.name for path in sources if "nerfloom[" in path.read_text()] == []

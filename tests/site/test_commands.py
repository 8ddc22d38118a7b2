"""Every command in the documents is understood by the command that it names."""

import re
from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError
from tests.site.commands import Checker, formats
from tests.site.pages import PAGES, ROOT, commands, words_of

UNDERSTOOD: set[tuple[str, ...]] = set()
"""Commands that were checked already: several pages have the same."""


@pytest.mark.parametrize("page", [p for p in PAGES if commands(p)], ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_understood(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checker = Checker(monkeypatch, tmp_path)
    wrong = []
    for where, command in commands(page):
        words = words_of(command)
        if tuple(words) in UNDERSTOOD:
            continue
        try:
            checker.check(words)
            UNDERSTOOD.add(tuple(words))
        except (AssertionError, ConfigError) as error:
            wrong.append(f"{where}: {command}: {error}")
    assert wrong == []


@pytest.mark.parametrize(
    "command",
    [
        "ns-train instant-ngp --no-such-flag 3",
        "ns-train no-such-method --max-seconds 3",
        "ns-train nerfacto --data data/mine nerfstudio --ndc True",
        "ns-train nerfacto --distortion-loss-mult many",
        "ns-render orbit outputs/lego/instant-ngp/TIME --output-path orbit.bmp",
        "ns-render circle outputs/lego/instant-ngp/TIME --output-path orbit.gif",
        "ns-export web outputs/lego/instant-ngp/TIME --format ply --output-dir exports",
        "ns-process-data images --data path/to/photographs --output-dir data/mine --matching-method some",
        "ns-compare --methods no-such-method --max-seconds 3",
        "ns-bench everything",
        "ns-no-such-command --data x",
        "make coffee",
        "pip install -e '.[everything]'",
        "python no_such_file.py",
        "python -m tests.no_such_module",
        "unknown-program --flag",
    ],
)
def test_wrong_commands_are_noticed(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checker = Checker(monkeypatch, tmp_path)
    with pytest.raises((AssertionError, ConfigError)):
        checker.check(words_of(command))


def test_the_commands_are_found() -> None:
    found = [command for page in PAGES for _, command in commands(page)]
    names = {words_of(command)[0] for command in found}
    scripts = re.findall(r"^(ns-[\w-]+) = ", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert set(scripts) <= names  # the documents show each of our commands
    assert len(found) > 150
    assert len(formats()) == 3

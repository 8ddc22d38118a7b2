"""The page of each method agrees with the command line about every flag."""

import dataclasses
import json
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

from nerfloom.base.errors import ConfigError
from nerfloom.cli.train import _flag_names
from nerfloom.registry import load_method, registered
from tests.site.commands import Checker
from tests.site.pages import ROOT, words_of

BUILT_IN = [name for name, entry in registered("methods").items() if entry.module.startswith("nerfloom.methods.")]
HEADINGS = ["Idea", "When to take it", "Settings that matter", "How it differs from the paper", "Measured"]
SETTING = re.compile(r"^\| `--([\w-]+)` \| (.*?) \| (.*) \|$", re.MULTILINE)
ROW = re.compile(r"^\| `--([\w.-]+)` \| (.*?) \| (.*?) \| (.*) \|$", re.MULTILINE)


@pytest.fixture(scope="module")
def method_pages() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "building"))
        import method_pages as module

        yield module


@pytest.fixture(scope="module")
def generated(method_pages: ModuleType) -> Callable[[str], str]:
    """The part of a page made from a method's code alone."""
    return cache(lambda name: method_pages.page(name, None))


def table(page: str) -> dict[str, tuple[str, str, str]]:
    return {found[1]: (found[2], found[3], found[4]) for found in ROW.finditer(page)}


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_flag_has_a_row(generated: Callable[[str], str], name: str) -> None:
    config = load_method(name).config
    found = table(generated(name))
    assert {f"--{flag}" for flag in found} == set(_flag_names(config))
    for flag, (default, _, text) in found.items():
        value = config
        for part in flag.replace("-", "_").split("."):
            value = getattr(value, part)
        assert len(text) > 10, f"--{flag} has no help"
        if value is not None and not isinstance(value, tuple):
            assert default == f"`{value}`" or (value == "auto" and default == "*decided by the data*")


@pytest.mark.parametrize("name", BUILT_IN)
def test_values_beyond_what_is_allowed_are_refused(generated: Callable[[str], str], name: str) -> None:
    config, tried = load_method(name).config, 0
    for flag, (_, allowed, _) in table(generated(name)).items():
        field = flag.replace("-", "_")
        if not re.match(r"(at least )?[\d.]", allowed) or isinstance(getattr(config, field), tuple):
            continue
        ends = [float(number.replace(",", "")) for number in re.findall(r"\d[\d,.e-]*", allowed)]
        beyond = [ends[0] - 1, *(end + 1 for end in ends[1:])]
        for value in beyond:
            with pytest.raises(ConfigError, match=flag):
                dataclasses.replace(config, **{field: value})
        tried += len(beyond)
    assert tried >= 15


@pytest.mark.parametrize("name", BUILT_IN)
def test_what_is_open_is_listed(method_pages: ModuleType, generated: Callable[[str], str], name: str) -> None:
    method = load_method(name)
    listed = set(re.findall(r"^- `--([\w-]+)`", method_pages.decided(method), re.MULTILINE))
    rows = table(generated(name))
    assert {flag for flag, (default, _, _) in rows.items() if default == "*decided by the data*"} <= listed
    assert all(rows[flag][0] in ("*decided by the data*", "`auto`") for flag in listed)


@pytest.mark.parametrize("name", BUILT_IN)
def test_pages_have_one_form(generated: Callable[[str], str], name: str) -> None:
    text = (ROOT / "docs" / "methods" / f"{name}.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == HEADINGS
    assert len(text.splitlines()) <= 110
    settings, rows = SETTING.findall(text), table(generated(name))
    assert 3 <= len(settings) <= 8
    for flag, default, _ in settings:
        known = rows[flag][0]
        assert default == known or (known.startswith("*") and "`" not in default), f"--{flag} is {known}"


def test_a_method_without_a_text_of_its_own_has_a_page(method_pages: ModuleType) -> None:
    page = method_pages.page("instant-ngp", None)
    assert page.startswith("# instant-ngp\n\nInstant-NGP: a multiresolution hash grid")
    assert "[arXiv:2201.05989](https://arxiv.org/abs/2201.05989)" in page


def test_a_text_of_its_own_comes_first_and_the_picture_behind_its_idea(method_pages: ModuleType) -> None:
    page = method_pages.page("kplanes", "# kplanes\n\n## Idea\n\nSix planes.\n\n## When to take it\n\nFor motion.\n")
    parts = ["Six planes.", "## Picture", "For motion.", "## In short", "## Flags"]
    places = [page.index(part) for part in parts]
    assert places == sorted(places)


def test_a_picture_is_shown_with_the_run_that_made_it(
    method_pages: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = method_pages.PICTURES / "psnr.json"
    made = json.loads(file.read_text()) if file.is_file() else {}
    checker = Checker(monkeypatch, tmp_path)
    assert set(made) <= set(BUILT_IN)
    for name, run in made.items():
        checker.check(words_of(run["command"]))
        with Image.open(method_pages.PICTURES / f"{name}.jpg") as shown:
            assert shown.width > 3.5 * shown.height  # five tiles side by side, and their scales
        page = method_pages.page(name, None)
        assert f"](../pictures/methods/{name}.jpg)" in page
        assert f"{run['psnr']:.2f} dB" in page


def test_a_method_without_a_picture_has_a_page(
    method_pages: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "psnr.json").write_text("{}")
    monkeypatch.setattr(method_pages, "PICTURES", tmp_path)
    assert "## Picture" not in method_pages.page("kplanes", None)

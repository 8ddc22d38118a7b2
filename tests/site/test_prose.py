"""Pages have none of the words and shapes of sentences that docs/building/prose.py lists."""

import re
from types import ModuleType

import pytest

from tests.site.pages import ROOT


@pytest.fixture(scope="module")
def prose() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "building"))
        import prose as module
    return module


@pytest.mark.parametrize(
    ("text", "line", "quoted"),
    [
        ("Of these, two hold.\n", 1, "Of"),
        ("# A page\n\nIt holds.\nWhat changed is known.\n", 4, "What"),
        ("- **By boxes** it is softer.\n", 1, "By"),
        ("1. One.\n   2. Of two.\n", 2, "Of"),
        ("| a | b |\n|---|---|\n| c | By boxes |\n", 3, "By"),
        ("```\ncode\n```\n\nA box, of\nwhich nothing is known.\n", 5, "of which"),
        ("A man whose dog, whose tail\n", 1, "whose dog, whose"),
        ("It costs 5 dB at the\nleast.\n", 1, "at the least"),
        ("It moved. That explains the blur.\n", 1, "That"),
        ("The step at\nwhich it ends.\n", 1, "at which"),
        ("It has as\nmany as ten, for any box.\n", 1, "as many as"),
        ("It holds, whatever the box.\n", 1, "whatever"),
        ("It draws what is behind the wall.\n", 1, "what is behind"),
        ("It is `x` and\nand y.\n", 1, "and and"),
    ],
)
def test_what_is_found(prose: ModuleType, text: str, line: int, quoted: str) -> None:
    ((where, message),) = prose.problems(text)
    assert where == line
    assert message.startswith(f"'{quoted}': ")


@pytest.mark.parametrize(
    "text",
    [
        "What is a scene? An answer.\n",
        "# What a run prints\n\nThe box in which it lies.\n",
        "`Of which` is $of which$, in bytes [here](of-which.md).\n",
        "```\nOf which\n```\n",
        "<!-- Of which -->\n\n$$\nOf which\n$$\n",
        "A man whose dog barks. A cat whose tail is long.\n",
        "It finds that the sum depends on which thread adds it, and what is needed.\n",
        "| is | is |\n|---|---|\n",
    ],
)
def test_what_is_left_alone(prose: ModuleType, text: str) -> None:
    assert prose.problems(text) == []


def test_every_rule_quotes_and_advises(prose: ModuleType) -> None:
    assert all(re.compile(pattern).groups == 1 and advice for pattern, advice in prose.RULES.items())


def test_pages_break_no_rule(prose: ModuleType) -> None:
    found = {str(page.relative_to(ROOT)): prose.problems(page.read_text(encoding="utf-8")) for page in prose.pages()}
    assert {name: wrong for name, wrong in found.items() if wrong} == {}
    assert len(found) > 40

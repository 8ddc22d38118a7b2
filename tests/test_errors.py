"""Errors: one short printable line, for all names and values in it."""

import pickle
import string

import pytest

from nerfloom.base.console import say
from nerfloom.base.errors import MAX_MESSAGE_LENGTH, DataError, nearest, printable, shown


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("a b/é 中.png", "a b/é 中.png"),
        ("a\nerror: b", r"a\nerror: b"),
        ("\x1b[2J\x07", r"\x1b[2J\x07"),
        ("\ud800\u202e", r"\ud800\u202e"),
    ],
)
def test_names_of_files_can_neither_break_the_line_nor_command_the_terminal(
    name: str, written: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert str(DataError(f"cannot read {name}")) == f"cannot read {written}"
    say(name)
    assert capsys.readouterr().err == f"{written}\n"
    assert printable(written) == written


def test_a_message_is_never_longer_than_a_screen() -> None:
    assert len(str(DataError("a" * 10**6))) == MAX_MESSAGE_LENGTH + 3


def test_a_hint_lists_few_names_or_the_nearest() -> None:
    many = [f"setting_{letter}" for letter in string.ascii_lowercase * 2]
    assert nearest("xyz", many[:3]) == "Known: setting_a, setting_b, setting_c."
    assert nearest("xyz", many) == "None of the 52 known names is similar."
    assert nearest("seting_q", many).startswith("Did you mean 'setting_q'")


def test_errors_pass_between_processes() -> None:
    error = pickle.loads(pickle.dumps(DataError("cannot read a\nb")))
    assert type(error) is DataError
    assert str(error) == r"cannot read a\nb"


def nested(depth: int) -> list:
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def doubled(levels: int) -> list:
    """A list of two to the power of `levels` words, made of as many small lists."""
    value: list = ["lol"]
    for _ in range(levels):
        value = [value, value]
    return value


SHOWN = {
    "nothing": (None, "None"),
    "true": (True, "True"),
    "nan": (float("nan"), "nan"),
    "text": ("a'b", '"a\'b"'),
    "list": ([1, 2.5, "x"], "[1, 2.5, 'x']"),
    "names": ({"b": 1, "a": None}, "{'a': None, 'b': 1}"),
    "huge": (10**400, "a huge integer"),
    "more digits than Python writes": (-(16**5000), "a huge integer"),
    "those in a list": ([16**5000], "a list that cannot be written"),
    "deep": (nested(900), "[[[[...]]]]"),
}
LARGE = {
    "a long text": "x" * 10**6,
    "deeper than Python goes": nested(100_000),
    "a few lines that stand for more than memory holds": doubled(60),
    "a long list": list(range(1000)),
    "bytes": b"\0" * 10**6,
}


@pytest.mark.parametrize("name", SHOWN)
def test_values_are_shown_briefly(name: str) -> None:
    value, text = SHOWN[name]
    assert shown(value) == text


@pytest.mark.parametrize("name", LARGE)
def test_large_values_take_no_more_than_a_line(name: str) -> None:
    assert len(shown(LARGE[name])) <= 60
    assert shown(LARGE[name]).isprintable()

"""How far an operation is, as people read it: share, time left, and a line now and then where there is no terminal."""

from collections.abc import Iterator

import pytest
from rich.console import Console

from nerfloom.base import console
from nerfloom.base.meter import Meter, time_text


class Clock:
    """A clock that a test sets."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_time_left_is_that_of_the_mean_unit_and_unknown_before_the_first() -> None:
    clock = Clock()
    meter = Meter("Evaluating", 50, clock=clock)
    assert meter.line == "Evaluating: 0 %, 0 of 50, – left"
    clock.now += 30
    assert meter.line == "Evaluating: 0 %, 0 of 50, – left"
    clock.now += 3
    meter.advance()
    assert meter.seconds_left == 33 * 49
    clock.now += 20  # the second unit is under way
    assert meter.seconds_left == 33 * 49 - 20
    clock.now += 7
    meter.advance()
    assert meter.line == "Evaluating: 4 %, 2 of 50, 24 min left"
    clock.now += 1e6
    assert meter.seconds_left == 0
    meter.advance(48)
    assert meter.line.endswith("100 %, 50 of 50, 0 s left")


def test_what_was_there_before_tells_nothing_of_the_speed() -> None:
    clock = Clock()
    meter = Meter("Downloading", 100, 80, clock=clock)
    assert meter.line == "Downloading: 80 %, 80 of 100, – left"
    clock.now += 40
    meter.advance(10)
    assert meter.seconds_left == 40
    assert Meter("Evaluating", 5, 1, 33.0, clock=clock).line == "Evaluating: 20 %, 1 of 5, 2 min left"


def test_an_unknown_total_and_an_empty_one_have_a_line() -> None:
    assert Meter("Reading", None).line == "Reading: 0"
    assert Meter("Reading", 0).line == "Reading: 0 %, 0 of 0, – left"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (99.4, "99 s"), (99.6, "2 min"), (5_969, "99 min"), (6_000, "1 h 40 min"), (7_500, "2 h 05 min")],
)
def test_durations_are_written_in_the_unit_that_suits(seconds: float, text: str) -> None:
    assert time_text(seconds) == text


def test_without_a_terminal_lines_come_while_one_item_takes_long(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also before the first item is done, and none comes after the last."""
    monkeypatch.setattr(console, "SECONDS_BETWEEN_LINES", 0.01)
    seen: list[str] = []

    def awaited(words: str) -> None:
        while not any(words in line for line in seen):
            seen.extend(capsys.readouterr().err.splitlines())

    def items() -> Iterator[int]:
        awaited("Working: 0 %, 0 of 2, – left")
        yield 0
        awaited("Working: 50 %, 1 of 2, ")
        yield 1

    assert list(console.track(items(), "Working", 2)) == [0, 1]


def test_what_ends_soon_prints_nothing_and_an_error_ends_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(console.track(range(3), "Working", 3)) == [0, 1, 2]
    with pytest.raises(ZeroDivisionError):
        list(console.track((1 // number for number in (1, 0)), "Working", 2))
    assert capsys.readouterr().err == ""


def test_a_terminal_has_a_bar_with_share_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Console(force_terminal=True, width=120, record=True, stderr=True, _environ={})
    monkeypatch.setattr(console, "console", terminal)
    for _ in console.track(range(2), "Working", 2):
        pass
    with console.track_bytes("Downloading", 3_000_000, 1_000_000) as advance:
        advance(1_000_000)
    shown = terminal.export_text()
    for words in ("Working", "0 %, 0 of 2, – left", "Downloading", "67 %, 2.0 MB of 3.0 MB, "):
        assert words in shown
